"""What can go wrong with a robot, one class for each thing a caller can do about it.

Codes, booleans and texts of the controllers all end here: no driver returns a success flag.
"""

from __future__ import annotations

from fingerpost.errors import FingerpostError


class RobotError(FingerpostError):
    """Base of everything that goes wrong with a robot."""


class OutOfReachError(RobotError, ValueError):
    """A pose outside the declared limits, or one that the controller cannot reach."""


class NotReadyError(RobotError):
    """The robot may not move yet: not connected, without limits, not homed or not armed."""


class NotHomedError(NotReadyError):
    """The controller does not know where its axes are: call `home` first."""


class NotArmedError(NotReadyError):
    """The guard has not been armed, or something has disarmed it since."""


class RefusedError(RobotError):
    """The guard refuses a command: its fix is lost, stale or too uncertain to move on."""


class RobotTimeoutError(RobotError, TimeoutError):
    """No answer, or no arrival, within the time allowed."""


class ConnectionLostError(RobotError, ConnectionError):
    """The port is closed or its cable is out; `connect` opens it again."""


class PortInUseError(ConnectionLostError):
    """Another program talks to the robot through the same port: end that one first."""


class GarbledReplyError(RobotError):
    """The controller's answer cannot be read, so nothing of it is believed."""


class StoppedError(RobotError):
    """`stop` was called while this command waited or ran; the command is void."""


class StopFailedError(RobotError):
    """A stop has not gone through, so the arm may still move: press its emergency stop."""


class NotArrivedError(RobotError):
    """The arm stands still, but not where it was sent."""


class CommandRefusedError(RobotError):
    """The controller does not take a command; the arm itself is well."""


class GripperError(RobotError):
    """There is no gripper, or it cannot do what was asked."""


class RobotFaultError(RobotError):
    """The controller reports a fault of the arm, which homing clears once it has been seen to.

    Attributes
    ----------
    number : int or None
        The controller's own number of the fault, where it gave one.
    axis : int or None
        The axis it names, counted as the controller counts.
    """

    def __init__(self, message: str, *, number: int | None = None, axis: int | None = None) -> None:
        super().__init__(message)
        self.number = number
        self.axis = axis


class HomingError(RobotFaultError):
    """An axis did not find its home position."""
