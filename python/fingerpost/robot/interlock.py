"""Whether commands may pass to a robot: armed by an operator, disarmed by stops, on record.

Stops come from every thread and from signal handlers, also while the robot is being armed. So each
has a number of its own, and to be armed means that no stop that disarms has come since: no lock is
needed, and arming cannot undo a stop that it has not seen.
"""

from __future__ import annotations

import itertools
import logging
import math
import time
from collections.abc import Callable
from contextlib import suppress

from fingerpost.pointing import Fix
from fingerpost.robot.errors import NotReadyError, RobotError, StopFailedError, StoppedError
from fingerpost.robot.protocol import Pose, Robot
from fingerpost.robot.records import CommandRecord, RecordCallback, Records
from fingerpost.robot.stopping import SENT, WATCH_S, Stopper, described

logger = logging.getLogger(__name__)

LAST_STOP_S = 1.0
"""The end of a block repeats a stop that fails for this long [s], and then says that it failed."""


class Interlock:
    """Arms and stops one robot, and records what passes.

    Parameters
    ----------
    robot : Robot
        Whose stop may raise anything.
    clock : callable
        The clock of the records [s].
    newest_fix : callable
        Returns the fix that goes into the record of a stop.
    on_record : callable, optional
        Called with every record; what it raises is raised later, by `need_log`.
    """

    def __init__(
        self,
        robot: Robot,
        *,
        clock: Callable[[], float],
        newest_fix: Callable[[], Fix | None],
        on_record: RecordCallback | None = None,
    ) -> None:
        self._clock = clock
        self._newest_fix = newest_fix
        self._records = Records(on_record)
        self._stopper = Stopper(robot)
        self._numbers = itertools.count(1)
        self._last_stop = 0
        self._last_disarming = 0
        self._armed_after: int | None = None
        self._cause = ("", "")
        self._why_stopped = ""

    @property
    def armed(self) -> bool:
        """Whether commands may pass."""
        return self._armed_after == self._last_disarming

    @property
    def last_stop(self) -> int:
        """The number of the last stop."""
        return self._last_stop

    @property
    def last_disarming(self) -> int:
        """The number of the last stop that has disarmed."""
        return self._last_disarming

    @property
    def why_stopped(self) -> str:
        """Why the arm was stopped the last time, and what of that failed; else empty."""
        return self._why_stopped

    @property
    def records(self) -> tuple[CommandRecord, ...]:
        """The last records, oldest first."""
        return self._records.kept

    def arm(self, last_disarming: int) -> None:
        """Let commands pass, unless a stop has disarmed since one of a given number.

        Raises
        ------
        StoppedError
            One has.
        Exception
            The log's own; the interlock stays disarmed.
        """
        self._armed_after = last_disarming
        self.record("arm", "")
        if not self.armed:
            raise StoppedError(f"halted while being armed: {self._why_stopped}")

    def stop(self, command: str, reason: str, *, disarm: bool) -> None:
        """Stop the arm; a stop that fails disarms, and is repeated by `repeat`."""
        self._cause = (command, reason)
        self._why_stopped = reason  # known before anyone sees that commands may not pass
        if disarm:
            self._disarm()
        self._last_stop = next(self._numbers)
        self._report(self._send())

    def stop_again(self) -> None:
        """Send the last stop once more, for a command that it may have overtaken."""
        if (outcome := self._send()) != SENT:
            self._report(outcome)

    def repeat(self) -> None:
        """Repeat a stop that has failed, unless its line is dead."""
        if not self._stopper.line_is_dead:
            self._repeat()

    def need_stops(self) -> None:
        """See that every stop has gone through, after one more attempt if one has failed.

        Raises
        ------
        NotReadyError
            One has not, so the arm may still move, or be stopped later.
        """
        self._repeat()
        if problem := self._stopper.problem:
            raise NotReadyError(
                f"the last stop has not gone through, so the arm may still move: {problem}"
            )

    def finish(self) -> RobotError | None:
        """Repeat a failing stop for `LAST_STOP_S`; return an error if it has not gone through."""
        for _ in range(round(LAST_STOP_S / WATCH_S)):
            self.repeat()
            if self._stopper.failure is None or self._stopper.line_is_dead:
                break
            time.sleep(WATCH_S)
        failure = self._stopper.failure
        if failure is None:
            return None
        message = (
            f"the stop failed, so the arm may still move: {described(failure)}; "
            "press its emergency stop"
        )
        logger.error(message)
        if isinstance(failure, RobotError):
            return failure
        error = StopFailedError(message)
        error.__cause__ = failure
        return error

    def record(
        self,
        command: str,
        detail: str,
        *,
        pose: Pose | None = None,
        fix: Fix | None = None,
        outcome: str = SENT,
    ) -> None:
        """Record a command, which does not pass if that fails.

        Raises
        ------
        Exception
            The log's own; the arm has been stopped.
        """
        self._add(command, detail, pose, fix, outcome)
        self.need_log()

    def need_log(self) -> None:
        """Halt and raise if the log has failed since this was last asked."""
        error = self._records.error
        if error is None:
            return
        if self.armed:
            self.stop("halt", f"the log failed: {error}", disarm=True)
        self._records.forget_error()
        raise error

    def _disarm(self) -> None:
        self._last_disarming = next(self._numbers)

    def _send(self) -> str:
        try:
            return self._stopper.send()
        except BaseException as error:  # Ctrl-C in the middle of it: it is repeated as well
            self._report(described(error))
            raise

    def _repeat(self) -> None:
        if outcome := self._stopper.retry():
            self._report(outcome)

    def _report(self, outcome: str) -> None:
        """Say how a stop went; commands may not pass while the arm may still move."""
        command, reason = self._cause
        if self._stopper.failure is not None:
            self._disarm()
            self._why_stopped = f"{reason}; the stop failed, so the arm may still move: {outcome}"
        elif outcome == SENT:
            self._why_stopped = reason
        else:
            self._why_stopped = f"{reason}; the stop was {outcome}"
        self._add(command, reason, None, self._newest_fix(), outcome)

    def _add(
        self, command: str, detail: str, pose: Pose | None, fix: Fix | None, outcome: str
    ) -> None:
        time_s = math.nan
        with suppress(Exception):  # a clock that fails does not keep a stop from the record
            time_s = self._clock()
        self._records.add(CommandRecord(time_s, command, detail, pose, fix, outcome))
