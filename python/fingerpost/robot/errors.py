"""Errors of robots, with one class for each reaction of a caller.

Drivers translate codes, booleans and texts of the controllers into these: none returns a success
flag.
"""

from __future__ import annotations

from fingerpost.errors import FingerpostError


class RobotError(FingerpostError):
    """Base class of the errors of robots."""


class OutOfReachError(RobotError, ValueError):
    """A pose outside the declared limits, or one that the controller cannot reach."""


class NotReadyError(RobotError):
    """The robot may not move yet: not connected, without limits, not homed or not armed."""


class NotHomedError(NotReadyError):
    """The controller does not know the positions of its axes: call `home` first."""


class NotArmedError(NotReadyError):
    """The guard has not been armed, or has been disarmed since."""


class RefusedError(RobotError):
    """The guard refuses a command: its fix is lost, stale or too uncertain to move on."""


class RobotTimeoutError(RobotError, TimeoutError):
    """No answer, or no arrival, within the time allowed."""


class ConnectionLostError(RobotError, ConnectionError):
    """The port is closed or its cable is disconnected; `connect` opens it again."""


class PortInUseError(ConnectionLostError):
    """Another program uses the robot's port: end that one first."""


class GarbledReplyError(RobotError):
    """The controller's answer cannot be parsed, so no part of it is used."""


class StoppedError(RobotError):
    """`stop` was called while this command waited or ran; the command is void."""


class StopFailedError(RobotError):
    """A stop has not succeeded, so the arm may still move: press its emergency stop."""


class NotArrivedError(RobotError):
    """The arm stands still, but not at its goal."""


class CommandRefusedError(RobotError):
    """The controller refuses a command; the arm itself has no fault."""


class GripperError(RobotError):
    """There is no gripper, or it cannot execute the command."""


class RobotFaultError(RobotError):
    """The controller reports a fault of the arm, which homing clears once its cause is removed.

    Attributes
    ----------
    number : int or None
        The controller's number of the fault, if any.
    axis : int or None
        The axis concerned, in the controller's numbering.
    """

    def __init__(self, message: str, *, number: int | None = None, axis: int | None = None) -> None:
        super().__init__(message)
        self.number = number
        self.axis = axis


class HomingError(RobotFaultError):
    """An axis did not find its home position."""
