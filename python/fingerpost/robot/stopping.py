"""Stop of a robot, repeated until it has succeeded.

A driver's stop may raise any exception: of its line, of a vendor's library, or of its own code. For
`Stopper` each means that the arm may still move. A stop is *unsettled* from its call until it, or a
later one, has returned. A failed stop is repeated, by `retry`, until its line is known to be dead:
then only a new connection helps, and opening one stops the arm.
"""

from __future__ import annotations

import itertools
import logging
import threading

from fingerpost.robot.errors import ConnectionLostError, RobotError
from fingerpost.robot.protocol import Robot, RobotState

logger = logging.getLogger(__name__)

STOP_ATTEMPTS = 3
"""Number of immediate attempts at a failing stop: the handler of a signal that ends the program has
no later chance, and a line that is lost at every attempt is dead."""


WATCH_S = 0.02
"""Interval of a guard's checks, and so of the repetitions of a failing stop [s]: the time that a
stop may take."""

SENT = "sent"
"""The outcome of a stop that succeeded at once."""


class Stopper:
    """Stops one robot; its methods may be called from any thread and from signal handlers.

    Parameters
    ----------
    robot : Robot
        The robot; its `stop` may raise any exception.
    """

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._numbers = itertools.count()
        # By number of the call: its error, or None while it lasts. Successful calls are removed.
        # Each access is one atomic operation: a signal handler could not wait for a lock that is
        # held by the code it interrupts.
        self._unsettled: dict[int, BaseException | None] = {}
        self._failed_attempts = 0
        self._line_is_dead = False
        self._retrying = threading.Lock()

    @property
    def failure(self) -> BaseException | None:
        """Last error of a stop that has not succeeded since; None without one."""
        errors = [error for error in list(self._unsettled.values()) if error is not None]
        return errors[-1] if errors else None

    @property
    def problem(self) -> str:
        """Why a stop has not succeeded; empty if all have."""
        if (failure := self.failure) is not None:
            return described(failure)
        return "it is still being sent" if self._unsettled else ""

    @property
    def line_is_dead(self) -> bool:
        """Whether a failed stop cannot succeed before the robot is reconnected."""
        return self._line_is_dead

    def send(self) -> str:
        """Stop the robot, with up to `STOP_ATTEMPTS` calls.

        Returns
        -------
        str
            The outcome for the log: `sent`, with the attempt if not the first, or the error.
        """
        for _ in range(STOP_ATTEMPTS):
            outcome, gone_through = self._attempt()
            if gone_through:
                return outcome
        self._line_is_dead = isinstance(self.failure, ConnectionLostError) or self._disconnected()
        return outcome

    def retry(self) -> str:
        """Repeat a failed stop once.

        Returns
        -------
        str
            The outcome if it has succeeded; empty if not, or if another thread repeats it.
        """
        if not self._retrying.acquire(blocking=False):
            return ""
        try:
            if self.failure is None:
                return ""
            outcome, gone_through = self._attempt()
            if not gone_through:
                self._line_is_dead = self._line_is_dead or self._disconnected()
            return outcome if gone_through else ""
        finally:
            self._retrying.release()

    def _attempt(self) -> tuple[str, bool]:
        """Call the robot's stop; return the outcome, and whether it has succeeded."""
        number = next(self._numbers)
        self._unsettled[number] = None
        before = self.failure
        try:
            self._robot.stop()
        except BaseException as error:
            self._unsettled[number] = error
            self._supersede(number)
            self._failed_attempts += 1
            level = logging.ERROR if before is None else logging.DEBUG  # once, not 50 times a s
            logger.log(level, "the stop failed and is repeated: %s", described(error))
            if not isinstance(error, Exception):  # such as Ctrl-C: for the caller
                raise
            return described(error), False
        self._supersede(number)
        self._unsettled.pop(number)
        self._line_is_dead = False
        failed, self._failed_attempts = self._failed_attempts, 0
        if before is None:
            return SENT, True
        return f"{SENT} at attempt {failed + 1}, after {described(before)}", True

    def _supersede(self, number: int) -> None:
        """Remove the failures of earlier stops."""
        for earlier, error in list(self._unsettled.items()):
            if earlier < number and error is not None:
                self._unsettled.pop(earlier, None)

    def _disconnected(self) -> bool:
        try:
            return self._robot.status().state is RobotState.DISCONNECTED
        except Exception:  # a driver without a status may still be able to stop
            return False


def described(error: BaseException) -> str:
    """Return the text of an error: the message, with the type unless it is a `RobotError`."""
    text = str(error)
    if isinstance(error, RobotError) and text:
        return text
    return f"{type(error).__name__}: {text}" if text else type(error).__name__
