"""Common part of all drivers: order, readiness, arrival, and a stop that nothing delays.

A driver implements how its controller opens, homes, starts a move, reports its pose and stops;
`Arm` decides when. Three rules hold for all of them:

* A command stores the number of earlier stops when it is called. If the number has changed when its
  turn comes, it is void (`StoppedError`): after `stop`, no waiting command moves the arm.
* `stop` never waits. A command that starts motion checks the number again after its bytes have been
  sent, under a lock that `stop` tries only for a moment; a stop that overtakes the command is
  therefore repeated after it.
* A command that fails in any way, including a keyboard interrupt, stops the arm before its error is
  raised.
"""

from __future__ import annotations

import itertools
import logging
import math
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import NDArray

from fingerpost.checks import in_range
from fingerpost.errors import InvalidInputError
from fingerpost.robot.errors import (
    ConnectionLostError,
    GarbledReplyError,
    NotArrivedError,
    NotHomedError,
    NotReadyError,
    RobotError,
    RobotFaultError,
    RobotTimeoutError,
    StoppedError,
)
from fingerpost.robot.orientation import angle_between, tool_rotation
from fingerpost.robot.protocol import (
    Angle,
    GripperTarget,
    HomingCallback,
    HomingProgress,
    Limits,
    Pose,
    RobotState,
    RobotStatus,
)
from fingerpost.robot.shape import ArmShape

logger = logging.getLogger(__name__)

STOP_PATIENCE_S = 0.002
"""Time that `stop` leaves a command to finish its own write [s]; the stop has 20 ms in all."""

SLICE_S = 0.02
"""Interval at which every wait checks for a stop [s]."""

READING_TIMEOUT_S = 10.0
"""Time limit to read a pose, including the wait for another command [s]."""

MOVE_MARGIN_S = 5.0
"""Added to three times a move's own duration for the default time-out [s]."""

GRIPPER_TIMEOUT_S = 10.0
"""Time limit of a motion of the gripper [s]."""


@dataclass(frozen=True, slots=True)
class ArrivalRule:
    """Conditions under which an arm stands at its goal.

    Attributes
    ----------
    poll_s : float
        Pause between two readings of the pose [s], ≥ 0.
    still_m, still_rad : float
        Greatest distance from the first of a series of readings at which they are equal [m, rad].
    near_m, near_rad : float
        Greatest distance of a standing arm from its goal at which it has arrived [m, rad].
    readings : int
        Number of consecutive equal readings that mean that it stands, ≥ 2.
    stall_s : float
        Time standing elsewhere after which it will not arrive [s].
    """

    poll_s: float = 0.05
    still_m: float = 2e-4
    still_rad: float = math.radians(0.25)
    near_m: float = 1e-3
    near_rad: float = math.radians(1.5)
    readings: int = 2
    stall_s: float = 1.5

    def __post_init__(self) -> None:
        if self.readings < 2:
            raise InvalidInputError(f"readings is {self.readings}; at least 2 show a standstill")


@dataclass(frozen=True, slots=True)
class Turn:
    """One command: the number of stops before it, and its deadline."""

    stops: int
    deadline_s: float


class Arm(ABC):
    """Base class of the drivers; implements `fingerpost.robot.protocol.Robot` by a few hooks.

    Parameters
    ----------
    limits : Limits or None
        Limits of commands; None refuses every motion.
    arrival : ArrivalRule
        Conditions for the end of a move.
    clock : callable
        Monotonic time [s].
    sleep : callable
        Waits for a time on that clock [s].
    """

    shape: ArmShape | None = None
    """Shape of the arm, for drivers that know it; otherwise the usual one is assumed."""

    def __init__(
        self,
        limits: Limits | None,
        *,
        arrival: ArrivalRule | None = None,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._limits = limits
        self._arrival = arrival or ArrivalRule()
        self._clock = clock
        self._sleep_for = sleep
        self._motion_lock = threading.Lock()  # one motion at a time
        self._exchange_lock = threading.Lock()  # one command and its answer at a time
        self._issue_lock = threading.Lock()  # held while the bytes that start a motion are sent
        self._stop_numbers = itertools.count(1)
        self._stops = 0
        self._state = RobotState.DISCONNECTED
        self._homed = False
        self._home_lost = ""  # why it is no longer homed
        self._fault: str | None = None
        self._goal: Pose | None = None
        self._due_s = 0.0  # time by which the arm must have reached its goal
        self._last_pose: Pose | None = None

    # Hooks of a driver. Each raises a RobotError, and none waits past the turn's deadline.

    @abstractmethod
    def _open(self) -> None:
        """Open the connection and stop any motion."""

    @abstractmethod
    def _close(self) -> None:
        """Close the connection; harmless when closed."""

    @abstractmethod
    def _home(self, turn: Turn, report: Callable[[str], None]) -> None:
        """Home every axis."""

    @abstractmethod
    def _start_move(self, pose: Pose, speed_m_s: float, turn: Turn) -> None:
        """Start a straight move; send the bytes that start it through `_issue`."""

    @abstractmethod
    def _read_pose(self, turn: Turn) -> Pose:
        """Read the pose."""

    @abstractmethod
    def _send_stop(self) -> None:
        """Send the stop, bypassing every queue, without waiting for an answer."""

    @abstractmethod
    def _move_gripper(self, opening: float, turn: Turn) -> None:
        """Set the gripper to a share of its opening and wait until it is there."""

    def _advice(self, error: RobotError) -> str:
        """Return further information on why a command failed; may be empty."""
        del error
        return ""

    # The protocol.

    @property
    def limits(self) -> Limits | None:
        """Limits of commands to this robot."""
        return self._limits

    def connect(self) -> None:
        """Open the connection; stop any motion.

        Afterwards the robot counts as not homed, because its state while disconnected is unknown.

        Raises
        ------
        ConnectionLostError
            The port cannot be opened.
        RobotTimeoutError, GarbledReplyError
            It opens, but there is no valid answer.
        """
        with self._motion_lock, self._exchange_lock:
            self._forget()
            try:
                with self._explaining():
                    self._open()
            except BaseException:
                self._close()
                raise
            self._state = RobotState.NOT_HOMED

    def reconnect(self, *, timeout_s: float = 10.0) -> None:
        """Repeat `connect` until it succeeds, for example after a cable was disconnected.

        Raises
        ------
        RobotError
            The error of the last attempt, if none has succeeded within `timeout_s`.
        """
        deadline_s = self._clock() + _span_s(timeout_s)
        while True:
            try:
                return self.connect()
            except RobotError:
                if self._clock() >= deadline_s:
                    raise
                self._sleep_for(SLICE_S)

    def close(self) -> None:
        """Stop and close the connection; harmless when closed."""
        if self._state is not RobotState.DISCONNECTED:
            self._stop_if_possible()
        self._close()
        self._forget()

    def __enter__(self) -> Self:
        if self._state is RobotState.DISCONNECTED:
            self.connect()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def home(self, progress: HomingCallback | None = None, *, timeout_s: float = 180.0) -> None:
        """Home every axis. The arm moves.

        Parameters
        ----------
        progress : callable, optional
            Called with a `HomingProgress` for every line of the controller and once a second.
        timeout_s : float
            Time limit, after which the arm is stopped [s].

        Raises
        ------
        HomingError
            An axis failed; the error names it.
        RobotTimeoutError
            Not done in time.
        StoppedError
            Stopped meanwhile.
        InvalidInputError
            A time-out that is not a number from 0.
        """
        start_s = self._clock()
        turn = Turn(self._stops, start_s + _span_s(timeout_s))
        report = progress or (lambda _: None)
        with self._waiting(self._motion_lock, turn), self._waiting(self._exchange_lock, turn):
            self._need_connection()
            self._homed, self._goal = False, None
            self._state = RobotState.HOMING
            with self._failing_safely():
                self._home(
                    turn,
                    lambda text: report(HomingProgress(self._clock() - start_s, timeout_s, text)),
                )
            self._homed, self._home_lost, self._fault = True, "", None
            self._state = RobotState.IDLE

    def pose(self) -> Pose:
        """Read the pose of the gripper.

        Raises
        ------
        NotHomedError
            The controller's numbers are meaningless before homing.
        RobotTimeoutError, GarbledReplyError, ConnectionLostError
            No valid reading.
        """
        self._need_homing()
        with self._explaining():
            try:
                return self._measured_pose(self._short_turn())
            except StoppedError:  # the stop of another command cut the answer in two; ask again
                return self._measured_pose(self._short_turn())

    def move_to(
        self,
        pose: Pose,
        *,
        speed_m_s: float | None = None,
        wait: bool = True,
        timeout_s: float | None = None,
    ) -> None:
        """Move in a straight line.

        Parameters
        ----------
        pose : Pose
            The goal, inside `limits`; angles that are None are kept.
        speed_m_s : float, optional
            Speed of the gripper [m/s]; the limit by default and at most.
        wait : bool
            Whether to return when the arm stands at the goal, not when the move has been accepted.
        timeout_s : float, optional
            Time from this move's turn to its end, including queued moves [s]; by default three
            times their expected duration, and 5 s for each.

        Raises
        ------
        NotReadyError
            Not connected, no limits, not homed, or a fault not yet cleared by homing.
        OutOfReachError
            Outside `limits`, or outside the controller's reach.
        RobotTimeoutError, NotArrivedError, RobotFaultError, GarbledReplyError, ConnectionLostError
            The move failed; the arm has been stopped.
        StoppedError
            `stop` was called after this call.
        InvalidInputError
            An invalid speed or time-out.
        """
        stops = self._stops
        limits = self._need_limits()
        limits.check(pose)
        speed = limits.speed(speed_m_s)
        if timeout_s is not None:
            timeout_s = _span_s(timeout_s)
        self._need_homing()
        with self._waiting(self._motion_lock, Turn(stops, math.inf)):
            self._need_homing()  # an earlier command may have failed
            turn = Turn(stops, self._due(pose, speed, timeout_s))
            with self._failing_safely():
                with self._waiting(self._exchange_lock, turn):
                    self._start_move(pose, speed, turn)
                self._goal = pose
                self._state = RobotState.MOVING
                if wait:
                    self._await_arrival(pose, turn)

    def wait(self, *, timeout_s: float | None = None) -> None:
        """Return when the arm stands at the last commanded pose.

        Parameters
        ----------
        timeout_s : float, optional
            Longest wait [s]; by default the time limit of the queued moves.

        Raises
        ------
        RobotError
            As for `move_to`.
        """
        stops = self._stops
        if timeout_s is not None:
            timeout_s = _span_s(timeout_s)
        with self._waiting(self._motion_lock, Turn(stops, math.inf)):
            self._need_homing()  # a fault detected meanwhile has ended the motion
            with self._failing_safely():
                self._finish_motion(stops, timeout_s)

    def gripper(self, target: GripperTarget) -> None:
        """Open or close the gripper, or set its width [m], and wait until it has moved.

        It first waits for a running move, so that the gripper never acts during motion.

        Raises
        ------
        GripperError
            No gripper, or one that cannot be set to a width.
        NotReadyError, RobotError
            As for `move_to`.
        """
        stops = self._stops
        opening = self._need_limits().opening(target)
        self._need_homing()
        with self._waiting(self._motion_lock, Turn(stops, math.inf)):
            self._need_homing()
            with self._failing_safely():
                self._finish_motion(stops)
                turn = Turn(stops, self._clock() + GRIPPER_TIMEOUT_S)
                with self._waiting(self._exchange_lock, turn):
                    self._move_gripper(opening, turn)

    def stop(self) -> None:
        """Stop all motion at once and void every waiting command.

        May be called from any thread and from a signal handler. It waits for a lock no longer than
        `STOP_PATIENCE_S`, and for no answer.

        Raises
        ------
        ConnectionLostError
            The stop cannot reach the robot.
        """
        self._stops = next(self._stop_numbers)
        held = self._issue_lock.acquire(timeout=STOP_PATIENCE_S)
        try:
            self._send_stop()
        finally:
            if held:
                self._issue_lock.release()
        self._goal = None
        if self._state in (RobotState.MOVING, RobotState.IDLE):
            self._state = RobotState.IDLE if self._homed else RobotState.NOT_HOMED

    def status(self) -> RobotStatus:
        """Return the known status, without waiting."""
        return RobotStatus(self._state, self._homed, self._last_pose, self._fault)

    # Used by drivers.

    def _check(self, turn: Turn) -> None:
        """Raise if a command has been stopped or its deadline has passed."""
        if self._stops != turn.stops:
            raise StoppedError("stopped while the command waited or ran")
        if self._clock() > turn.deadline_s:
            raise RobotTimeoutError("the command did not end within its time-out")

    def _issue(self, send: Callable[[], None], turn: Turn) -> None:
        """Send the bytes that start a motion, so that they cannot overtake a stop."""
        with self._issue_lock:
            self._check(turn)
            send()
            if self._stops != turn.stops:
                self._send_stop()
                raise StoppedError("stopped while the command was being sent")

    def _pause(self, span_s: float, turn: Turn) -> None:
        """Wait, at most until a stop or the turn's deadline."""
        end_s = self._clock() + span_s
        while (left_s := end_s - self._clock()) > 0:
            self._check(turn)
            self._sleep_for(min(left_s, SLICE_S))
        self._check(turn)

    def _lose_home(self, reason: str) -> None:
        """Treat positions as invalid until the arm has been homed."""
        self._homed, self._home_lost = False, reason

    # Internals.

    @contextmanager
    def _explaining(self) -> Iterator[None]:
        """Add further information to an error that only names a missing event."""
        try:
            yield
        except (RobotTimeoutError, GarbledReplyError, NotArrivedError) as error:
            if advice := self._advice(error):
                raise type(error)(f"{error}; {advice}") from error
            raise

    @contextmanager
    def _waiting(self, lock: threading.Lock, turn: Turn) -> Iterator[None]:
        """Hold a lock; raise if stopped or late while waiting for it."""
        while not lock.acquire(timeout=SLICE_S):
            self._check(turn)
        try:
            self._check(turn)
            yield
        finally:
            lock.release()

    @contextmanager
    def _failing_safely(self) -> Iterator[None]:
        """Stop the arm and update the state if a command fails in any way."""
        try:
            with self._explaining():
                yield
        except StoppedError:
            self._state = RobotState.IDLE if self._homed else RobotState.NOT_HOMED
            raise
        except ConnectionLostError:
            self._close()
            self._forget()
            raise
        except RobotFaultError as error:
            self._stop_if_possible()
            self._homed, self._fault = False, str(error)
            self._state = RobotState.FAULT
            raise
        except BaseException:
            self._stop_if_possible()
            if self._state is not RobotState.DISCONNECTED:
                self._state = RobotState.IDLE if self._homed else RobotState.NOT_HOMED
            raise

    def _stop_if_possible(self) -> None:
        try:
            self.stop()
        except Exception as error:  # the original error is the one to be raised
            logger.warning("the stop failed: %s", str(error) or type(error).__name__)

    def _forget(self) -> None:
        self._state = RobotState.DISCONNECTED
        self._homed, self._home_lost, self._fault, self._goal = False, "", None, None
        self._last_pose = None

    def _short_turn(self) -> Turn:
        return Turn(self._stops, self._clock() + READING_TIMEOUT_S)

    def _measured_pose(self, turn: Turn) -> Pose:
        try:
            with self._waiting(self._exchange_lock, turn):
                pose = self._read_pose(turn)
        except InvalidInputError as error:  # in the reading, such as NaN
            raise GarbledReplyError(f"a reading that is no pose: {error}") from error
        except (RobotFaultError, ConnectionLostError):
            with self._failing_safely():
                raise
        self._last_pose = pose
        return pose

    def _await_arrival(self, goal: Pose, turn: Turn) -> None:
        """Read the pose until the arm stands, then check whether it is the goal."""
        rule = self._arrival
        still_since_s, readings, stands_at = self._clock(), 0, None
        while True:
            # An answer may be late: the pose was taken some time after this.
            asked_s = self._clock()
            pose = self._measured_pose(turn)
            if stands_at is not None and _same(pose, stands_at, rule.still_m, rule.still_rad):
                readings += 1
            else:
                still_since_s, readings, stands_at = self._clock(), 1, pose
            if readings >= rule.readings:
                if _same(pose, goal, rule.near_m, rule.near_rad):
                    self._goal, self._state = None, RobotState.IDLE
                    return
                if asked_s - still_since_s > rule.stall_s:
                    raise NotArrivedError(f"the arm stands at {pose}, sent to {goal}")
            self._pause(rule.poll_s, turn)

    def _finish_motion(self, stops: int, timeout_s: float | None = None) -> None:
        """Wait until the arm stands at the last commanded pose, if it is moving."""
        if self._goal is not None:
            due_s = self._due_s if timeout_s is None else self._clock() + timeout_s
            self._await_arrival(self._goal, Turn(stops, due_s))

    def _due(self, pose: Pose, speed_m_s: float, timeout_s: float | None) -> float:
        """Return the deadline of a move, including queued moves [s]."""
        now_s = self._clock()
        if timeout_s is not None:
            self._due_s = now_s + timeout_s
            return self._due_s
        start = self._goal or self._last_pose
        limits = self._need_limits()
        distance_m = (
            math.dist(limits.lower_m, limits.upper_m) if start is None else start.distance_m(pose)
        )
        begin_s = now_s if self._goal is None else max(now_s, self._due_s)
        self._due_s = begin_s + 3 * distance_m / speed_m_s + MOVE_MARGIN_S
        return self._due_s

    def _need_limits(self) -> Limits:
        if self._limits is None:
            raise NotReadyError("no limits are declared for this robot: declare them before moving")
        return self._limits

    def _need_connection(self) -> None:
        if self._state is RobotState.DISCONNECTED:
            raise ConnectionLostError("not connected: call connect() first")

    def _need_homing(self) -> None:
        self._need_connection()
        if self._state is RobotState.FAULT:
            raise NotReadyError(f"fault not cleared ({self._fault}): see to it, then call home()")
        if not self._homed:
            reason = f" ({self._home_lost})" if self._home_lost else ""
            raise NotHomedError(f"not homed{reason}: call home() first")


def _span_s(timeout_s: float) -> float:
    """Return a valid time-out; NaN would never expire."""
    return in_range(timeout_s, "timeout_s", 0.0)


def _same(a: Pose, b: Pose, within_m: float, within_rad: float) -> bool:
    """Whether two poses agree; an angle missing in either is ignored.

    Three angles are compared as one rotation: near the vertical, roll and yaw of an orientation are
    not unique.
    """
    if a.distance_m(b) > within_m:
        return False
    if (first := _rotation(a)) is not None and (second := _rotation(b)) is not None:
        return angle_between(first, second) <= within_rad
    return all(
        abs(math.remainder(one - other, 2 * math.pi)) <= within_rad
        for angle in Angle
        if (one := getattr(a, angle)) is not None and (other := getattr(b, angle)) is not None
    )


def _rotation(pose: Pose) -> NDArray[np.float64] | None:
    if pose.pitch_rad is None or pose.roll_rad is None or pose.yaw_rad is None:
        return None
    return tool_rotation(pose.pitch_rad, pose.roll_rad, pose.yaw_rad)
