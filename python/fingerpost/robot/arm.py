"""The bookkeeping of every driver: order, readiness, arrival, and a stop that nothing delays.

A driver says how its controller opens, homes, starts a move, reports its pose and stops; `Arm` says
when it may. Three rules hold for all of them:

* A command counts the stops made before it came. If the count has changed when its turn comes, it
  is void (`StoppedError`): after `stop`, nothing that waited moves the arm.
* `stop` waits for nobody. A command that starts motion looks at the count again after its bytes
  have gone out, under the lock that `stop` tries for a moment only; so a stop that overtakes the
  command is repeated after it.
* A command that fails in any way stops the arm before its error is raised, an interrupt from the
  keyboard included.
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
"""How long `stop` lets a command finish its own write; the stop itself has 20 ms in all."""

SLICE_S = 0.02
"""Every wait looks this often whether it has been stopped."""

READING_TIMEOUT_S = 10.0
"""A pose is read within this, waiting behind another command included [s]."""

MOVE_MARGIN_S = 5.0
"""Added to three times a move's own time when no time-out is given [s]."""

GRIPPER_TIMEOUT_S = 10.0
"""A gripper has moved within this [s]."""


@dataclass(frozen=True, slots=True)
class ArrivalRule:
    """When an arm counts as standing at its goal.

    Attributes
    ----------
    poll_s : float
        Pause between two readings of the pose [s], ≥ 0.
    still_m, still_rad : float
        Readings no further from the first of them than this are the same place [m, rad].
    near_m, near_rad : float
        A standing arm this near its goal has arrived [m, rad].
    readings : int
        So many equal readings in a row mean that it stands, ≥ 2.
    stall_s : float
        Standing elsewhere for this long means that it will not arrive [s].
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
    """One command's place in the order: the stops counted before it, and when it must be done."""

    stops: int
    deadline_s: float


class Arm(ABC):
    """Base of the drivers; implements `fingerpost.robot.protocol.Robot` over a few hooks.

    Parameters
    ----------
    limits : Limits or None
        What may be asked; None refuses every motion.
    arrival : ArrivalRule
        When a move has ended.
    clock : callable
        Monotonic time [s].
    sleep : callable
        Waits for so many seconds of that clock.
    """

    shape: ArmShape | None = None
    """The arm's build, for drivers that know it; others are taken for the usual one."""

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
        self._issue_lock = threading.Lock()  # held while the bytes that start a motion go out
        self._stop_numbers = itertools.count(1)
        self._stops = 0
        self._state = RobotState.DISCONNECTED
        self._homed = False
        self._home_lost = ""  # why it is not homed any more
        self._fault: str | None = None
        self._goal: Pose | None = None
        self._due_s = 0.0  # when the arm must have come to its goal
        self._last_pose: Pose | None = None

    # What a driver provides. Each raises a RobotError, and none waits past the turn's deadline.

    @abstractmethod
    def _open(self) -> None:
        """Open the connection and stop whatever moves."""

    @abstractmethod
    def _close(self) -> None:
        """Close the connection; harmless when closed."""

    @abstractmethod
    def _home(self, turn: Turn, report: Callable[[str], None]) -> None:
        """Home every axis."""

    @abstractmethod
    def _start_move(self, pose: Pose, speed_m_s: float, turn: Turn) -> None:
        """Start a straight move; send what starts it through `_issue`."""

    @abstractmethod
    def _read_pose(self, turn: Turn) -> Pose:
        """Read the pose."""

    @abstractmethod
    def _send_stop(self) -> None:
        """Send the stop past every queue, without waiting for an answer."""

    @abstractmethod
    def _move_gripper(self, opening: float, turn: Turn) -> None:
        """Set the gripper to a share of its opening and wait until it is there."""

    def _advice(self, error: RobotError) -> str:
        """Return what else is known of why a command failed; a driver may know nothing."""
        del error
        return ""

    # The protocol.

    @property
    def limits(self) -> Limits | None:
        """What may be asked of this robot."""
        return self._limits

    def connect(self) -> None:
        """Open the connection; whatever still moves is stopped.

        Afterwards the robot counts as not homed, whatever it was before: nobody saw what happened
        to it in between.

        Raises
        ------
        ConnectionLostError
            The port cannot be opened.
        RobotTimeoutError, GarbledReplyError
            It opens, but nothing sensible answers.
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
        """Try `connect` until it works, as after a cable has been pulled and put back.

        Raises
        ------
        RobotError
            The last attempt's error, when none has worked within `timeout_s`.
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
        """Let every axis find its home position. The arm moves.

        Parameters
        ----------
        progress : callable, optional
            Called with a `HomingProgress` for every line the controller sends and once a second.
        timeout_s : float
            Given up and stopped after this [s].

        Raises
        ------
        HomingError
            An axis failed; the error names it.
        RobotTimeoutError
            Not done in time.
        StoppedError
            Stopped meanwhile.
        InvalidInputError
            A time-out that is no number from 0.
        """
        start_s = self._clock()
        turn = Turn(self._stops, start_s + _span_s(timeout_s))
        tell = progress or (lambda _: None)
        with self._waiting(self._motion_lock, turn), self._waiting(self._exchange_lock, turn):
            self._need_connection()
            self._homed, self._goal = False, None
            self._state = RobotState.HOMING
            with self._failing_safely():
                self._home(
                    turn,
                    lambda text: tell(HomingProgress(self._clock() - start_s, timeout_s, text)),
                )
            self._homed, self._home_lost, self._fault = True, "", None
            self._state = RobotState.IDLE

    def pose(self) -> Pose:
        """Read where the gripper is.

        Raises
        ------
        NotHomedError
            The controller's numbers mean nothing before homing.
        RobotTimeoutError, GarbledReplyError, ConnectionLostError
            No reading that can be believed.
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
            The goal, inside `limits`; angles left None stay as they are.
        speed_m_s : float, optional
            Speed of the gripper [m/s]; the limit by default and at most.
        wait : bool
            Return when the arm stands at the goal, rather than when the move has been accepted.
        timeout_s : float, optional
            Time from this move's turn to its end [s], what is queued before it included; by
            default three times what all of it should take, and 5 s for each.

        Raises
        ------
        NotReadyError
            Not connected, no limits, not homed, or a fault not yet cleared by homing.
        OutOfReachError
            Outside `limits`, or the controller says so.
        RobotTimeoutError, NotArrivedError, RobotFaultError, GarbledReplyError, ConnectionLostError
            The move failed; the arm has been stopped.
        StoppedError
            `stop` was called after this call.
        InvalidInputError
            A speed or time-out that is none.
        """
        stops = self._stops
        limits = self._need_limits()
        limits.check(pose)
        speed = limits.speed(speed_m_s)
        if timeout_s is not None:
            timeout_s = _span_s(timeout_s)
        self._need_homing()
        with self._waiting(self._motion_lock, Turn(stops, math.inf)):
            self._need_homing()  # what went before may have failed
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
            Longest wait [s]; by default what the queued moves were given.

        Raises
        ------
        RobotError
            As for `move_to`.
        """
        stops = self._stops
        if timeout_s is not None:
            timeout_s = _span_s(timeout_s)
        with self._waiting(self._motion_lock, Turn(stops, math.inf)):
            self._need_homing()  # a fault that was seen meanwhile has ended the motion
            with self._failing_safely():
                self._finish_motion(stops, timeout_s)

    def gripper(self, target: GripperTarget) -> None:
        """Open or close the gripper, or set its width [m], and wait until it has moved.

        A move that still runs is waited for first: nothing is gripped on the way.

        Raises
        ------
        GripperError
            There is none, or it cannot be set to a width.
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
        """Stop all motion at once and void every command that waits.

        May be called from any thread and from a signal handler. It takes no lock for longer than
        `STOP_PATIENCE_S` and waits for no answer.

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
        """Tell what is known, without waiting."""
        return RobotStatus(self._state, self._homed, self._last_pose, self._fault)

    # What drivers use.

    def _check(self, turn: Turn) -> None:
        """Raise if a command has been stopped or its time is over."""
        if self._stops != turn.stops:
            raise StoppedError("stopped while the command waited or ran")
        if self._clock() > turn.deadline_s:
            raise RobotTimeoutError("the command did not end within its time-out")

    def _issue(self, send: Callable[[], None], turn: Turn) -> None:
        """Send what starts a motion so that no stop can be overtaken by it."""
        with self._issue_lock:
            self._check(turn)
            send()
            if self._stops != turn.stops:
                self._send_stop()
                raise StoppedError("stopped while the command was being sent")

    def _pause(self, span_s: float, turn: Turn) -> None:
        """Wait, but not longer than until a stop or the turn's deadline."""
        end_s = self._clock() + span_s
        while (left_s := end_s - self._clock()) > 0:
            self._check(turn)
            self._sleep_for(min(left_s, SLICE_S))
        self._check(turn)

    def _lose_home(self, reason: str) -> None:
        """Believe no position from here on until the arm has been homed."""
        self._homed, self._home_lost = False, reason

    # Inside.

    @contextmanager
    def _explaining(self) -> Iterator[None]:
        """Add what else is known to an error that names only what has not happened."""
        try:
            yield
        except (RobotTimeoutError, GarbledReplyError, NotArrivedError) as error:
            if advice := self._advice(error):
                raise type(error)(f"{error}; {advice}") from error
            raise

    @contextmanager
    def _waiting(self, lock: threading.Lock, turn: Turn) -> Iterator[None]:
        """Hold a lock, unless stopped or late while waiting for it."""
        while not lock.acquire(timeout=SLICE_S):
            self._check(turn)
        try:
            self._check(turn)
            yield
        finally:
            lock.release()

    @contextmanager
    def _failing_safely(self) -> Iterator[None]:
        """Stop the arm and keep the books when a command fails in any way."""
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
        except Exception as error:  # the error that it is called for is the one to be raised
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
        except InvalidInputError as error:  # of what was read: not a number, say
            raise GarbledReplyError(f"a reading that is no pose: {error}") from error
        except (RobotFaultError, ConnectionLostError):
            with self._failing_safely():
                raise
        self._last_pose = pose
        return pose

    def _await_arrival(self, goal: Pose, turn: Turn) -> None:
        """Read the pose until the arm stands, then see whether that is the goal."""
        rule = self._arrival
        still_since_s, readings, stands_at = self._clock(), 0, None
        while True:
            # An answer may be late: the pose is of some time after this one.
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
        """Wait for the arm to stand at the last commanded pose, if it is under way."""
        if self._goal is not None:
            due_s = self._due_s if timeout_s is None else self._clock() + timeout_s
            self._await_arrival(self._goal, Turn(stops, due_s))

    def _due(self, pose: Pose, speed_m_s: float, timeout_s: float | None) -> float:
        """Return when a move must have ended, what is queued before it included [s]."""
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
    """Return a time-out; NaN would be one that never comes."""
    return in_range(timeout_s, "timeout_s", 0.0)


def _same(a: Pose, b: Pose, within_m: float, within_rad: float) -> bool:
    """Whether two poses agree; an angle missing in either does not count.

    Three angles are compared as one rotation: near the vertical, roll and yaw of the same
    orientation can be shared out in any way.
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
