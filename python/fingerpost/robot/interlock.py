"""Interlock of the commands to a robot: armed by an operator, disarmed by stops, recorded.

Stops may come from any thread and from signal handlers, also while the robot is being armed. Each
stop therefore has a number, and armed means that there has been no disarming stop since arming: no
lock is needed, and arming cannot undo a stop that it did not know.
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
"""Time for which a failing stop is repeated at the end of a block, before it is reported [s]."""


class Interlock:
    """Arms and stops one robot, and records commands.

    Parameters
    ----------
    robot : Robot
        The robot; its stop may raise any exception.
    clock : callable
        The clock of the records [s].
    newest_fix : callable
        Returns the fix for the record of a stop.
    on_record : callable, optional
        Called with every record; its exceptions are raised later, by `need_log`.
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
        """The number of the last disarming stop."""
        return self._last_disarming

    @property
    def why_stopped(self) -> str:
        """Reason for the last stop, and whether it failed; empty without one."""
        return self._why_stopped

    @property
    def records(self) -> tuple[CommandRecord, ...]:
        """The last records, oldest first."""
        return self._records.kept

    def arm(self, last_disarming: int) -> None:
        """Permit commands, unless there has been a disarming stop after the one given.

        Raises
        ------
        StoppedError
            There has been one.
        Exception
            Error of the log; the interlock stays disarmed.
        """
        self._armed_after = last_disarming
        self.record("arm", "")
        if not self.armed:
            raise StoppedError(f"halted while being armed: {self._why_stopped}")

    def stop(self, command: str, reason: str, *, disarm: bool) -> None:
        """Stop the arm; a stop that fails disarms, and is repeated by `repeat`."""
        self._cause = (command, reason)
        self._why_stopped = reason  # set before the interlock is seen to be disarmed
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
        """Check that every stop has succeeded, after one more attempt if one has failed.

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
        """Repeat a failing stop for `LAST_STOP_S`; return an error if it has not succeeded."""
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
        """Record a command, which is refused if that fails.

        Raises
        ------
        Exception
            Error of the log; the arm has been stopped.
        """
        self._add(command, detail, pose, fix, outcome)
        self.need_log()

    def need_log(self) -> None:
        """Halt and raise if the log has failed since the last call."""
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
        except BaseException as error:  # interrupted by Ctrl-C: it is repeated as well
            self._report(described(error))
            raise

    def _repeat(self) -> None:
        if outcome := self._stopper.retry():
            self._report(outcome)

    def _report(self, outcome: str) -> None:
        """Report the outcome of a stop; disarm while the arm may still move."""
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
        with suppress(Exception):  # a failing clock must not prevent the record of a stop
            time_s = self._clock()
        self._records.add(CommandRecord(time_s, command, detail, pose, fix, outcome))
