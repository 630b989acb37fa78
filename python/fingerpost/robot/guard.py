"""What stands between the pointing hand and the robot.

A `Guard` is the only way by which guidance moves a robot. It lets a command pass when

* the robot is homed, has limits that hold the whole safe region, and has been armed on purpose,
* the operator has been heard of lately (a dead-man's switch),
* the fix behind the command is one, is fresh, and its ellipse is smaller than the tolerance,
* the goal is inside the safe region, into which it is moved if it is not.

`check`, called often (`watching` does it from a thread), stops the robot when one of these ends
while it moves. Whatever passes or is refused, and every stop, goes into the log with the fix that
caused it.

A log that fails never stands in the way of a stop, but nothing passes that could not be logged:
the failure is kept, and raised at the next command, when arming, or at the end of the block.
"""

from __future__ import annotations

import logging
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from types import TracebackType
from typing import Annotated, Self, TypeAlias

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from fingerpost.errors import InvalidInputError
from fingerpost.homography import transfer_jacobian_by_point
from fingerpost.pointing import Fix, Status
from fingerpost.robot.errors import (
    NotArmedError,
    NotHomedError,
    NotReadyError,
    OutOfReachError,
    RefusedError,
    RobotError,
    StoppedError,
)
from fingerpost.robot.options import CheckedOptions
from fingerpost.robot.plane import RobotPlane
from fingerpost.robot.protocol import GripperTarget, Limits, Pose, Robot, RobotState
from fingerpost.robot.region import SafeRegion
from fingerpost.robot.shape import ArmShape, along
from fingerpost.robot.signals import stopping_on
from fingerpost.silhouette import Capsule
from fingerpost.uncertainty import confidence_ellipse

logger = logging.getLogger(__name__)

WATCH_S = 0.02
"""How often `Guard.watching` looks [s]."""

AWAY_M_S = 0.05
"""Speed at which the arm makes way [m/s]: whoever is near it may not be seen."""

ROUNDING_M = 1e-6
"""A place to visit may be outside the region by this much, and is moved into it [m]."""

RECORDS_KEPT = 10_000
"""Commands that a guard remembers; `on_record` sees all."""


GOALS_KEPT = 2
"""The arm is on its way to one of so many goals: a stride is sent before the last one is done."""


class GuardOptions(CheckedOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """When a command may pass.

    The upper bounds are far from any use; they keep out what would switch a check off. Those of the
    two time-outs leave room for simulated time; the command line takes a minute at most.

    Attributes
    ----------
    tolerance_m : float
        Largest semi-axis of the fix's ellipse in the robot's frame [m]; the paper's block of
        wood needs about 10 mm.
    confidence : float
        Of that ellipse.
    max_fix_age_s : float
        A fix older than this is stale [s]: no motion starts on it, and a motion that needs one is
        stopped at most `WATCH_S` later.
    operator_timeout_s : float
        An operator not heard of for this long is gone [s].
    clearance_m : float
        Kept off the rim of the safe region for rounding by the controller [m].
    max_speed_m_s : float
        Greatest speed of any command [m/s].

    Raises
    ------
    InvalidInputError
        A value that is out of its range, or not a number.
    """

    tolerance_m: Annotated[float, msgspec.Meta(gt=0, le=1)] = 0.01
    confidence: Annotated[float, msgspec.Meta(gt=0, lt=1)] = 0.95
    max_fix_age_s: Annotated[float, msgspec.Meta(gt=0, le=1e6)] = 0.3
    operator_timeout_s: Annotated[float, msgspec.Meta(gt=0, le=1e6)] = 1.0
    clearance_m: Annotated[float, msgspec.Meta(ge=0, le=1)] = 0.001
    max_speed_m_s: Annotated[float, msgspec.Meta(gt=0, le=10)] = 0.1


class Presence(StrEnum):
    """What must last while a command runs."""

    FIX = "fix"
    """The operator and a live fix: following."""
    OPERATOR = "operator"
    """The operator: carrying out what has been selected."""


@dataclass(frozen=True, slots=True)
class CommandRecord:
    """One line of the log.

    Attributes
    ----------
    time_s : float
        When, by the guard's clock [s].
    command : str
        `arm`, `disarm`, `enter`, `visit`, `move`, `gripper`, `hold` or `halt`.
    detail : str
        The goal, or the reason.
    pose : Pose or None
        The goal of a motion.
    fix : Fix or None
        The fix that caused it.
    outcome : str
        `sent`, or why not.
    """

    time_s: float
    command: str
    detail: str
    pose: Pose | None
    fix: Fix | None
    outcome: str

    def __str__(self) -> str:
        cause = "no fix"
        if self.fix is not None:
            at = (
                "" if self.fix.point is None else f" ({self.fix.point[0]:g}, {self.fix.point[1]:g})"
            )
            cause = f"fix of {self.fix.time_s:.3f} s, {self.fix.status}{at}"
        return f"{self.time_s:.3f} s {self.command} {self.detail}: {self.outcome} [{cause}]"


RecordCallback: TypeAlias = Callable[[CommandRecord], None]


class Guard:
    """The guard of one robot.

    Parameters
    ----------
    robot : Robot
        Connected and homed before it is armed.
    plane : RobotPlane
        Where the plane lies for it.
    region : SafeRegion
        Where it may go.
    options : GuardOptions
        When a command may pass.
    clock : callable
        The clock of the fixes' `time_s` [s].
    on_record : callable, optional
        Called with every `CommandRecord`. What it raises for a stop is raised later: by the next
        command, by `arm`, or at the end of a `with` block or of `watching` that nothing else ends.
        What it raises for a command voids the command, and the arm is halted.

    Raises
    ------
    InvalidInputError
        The safe region is too small for its clearance, or beyond the horizon of `plane`.
    """

    def __init__(
        self,
        robot: Robot,
        plane: RobotPlane,
        region: SafeRegion,
        options: GuardOptions | None = None,
        *,
        clock: Callable[[], float] = time.monotonic,
        on_record: RecordCallback | None = None,
    ) -> None:
        self.options = options or GuardOptions()
        self.plane = plane
        self.region = region
        self._robot = robot
        self._clock = clock
        self._on_record = on_record or (lambda _: None)
        self._log_error: Exception | None = None
        self._allowed = self._without_rim()
        self._records: deque[CommandRecord] = deque(maxlen=RECORDS_KEPT)
        self._armed = False
        self._inside = False
        self._interruptions = 0
        self._why_stopped = ""
        self._stop_error: RobotError | None = None
        self._needs: Presence | None = None
        self._read: Pose | None = None
        self._goals: deque[Pose] = deque(maxlen=GOALS_KEPT)
        self._fix: Fix | None = None
        self._heard_s = -np.inf

    # The operator's side.

    @property
    def armed(self) -> bool:
        """Whether commands may pass."""
        return self._armed

    @property
    def records(self) -> tuple[CommandRecord, ...]:
        """The last commands, oldest first."""
        return tuple(self._records)

    @property
    def busy(self) -> bool:
        """Whether the arm may still be moving on a command that passed."""
        return self._needs is not None

    @property
    def interruptions(self) -> int:
        """How often the guard has stopped the arm: whoever gave a command can see it is void."""
        return self._interruptions

    @property
    def why_stopped(self) -> str:
        """Why the guard has stopped the arm the last time, and what if that failed; else empty."""
        return self._why_stopped

    def check_limits(self, *, speed_m_s: float | None = None) -> None:
        """See that the robot has limits, and that they hold the whole safe region and a speed.

        Parameters
        ----------
        speed_m_s : float, optional
            What commands will ask for [m/s]; `max_speed_m_s` by default and at most.

        Raises
        ------
        NotReadyError
            No limits.
        OutOfReachError
            A corner of the region is outside them.
        InvalidInputError
            The arm cannot go so slowly.
        """
        limits = self._limits()
        limits.speed(self._speed(speed_m_s))
        for corner in self._allowed.corners:
            for above_m in (self._allowed.lowest_m, self._allowed.highest_m):
                try:
                    limits.check(self.plane.pose(corner, above_m))
                except OutOfReachError as error:
                    raise OutOfReachError(
                        f"the safe region's corner ({corner[0]:g}, {corner[1]:g}): {error}"
                    ) from error

    def check_gripper(self, target: GripperTarget) -> None:
        """See that the robot has a gripper that takes a target.

        Raises
        ------
        NotReadyError
            No limits, so nothing is known of a gripper.
        GripperError
            No gripper, or a width asked of one that only opens and closes.
        InvalidInputError
            A width that it does not have.
        """
        self._limits().opening(target)

    def arm(self) -> None:
        """Let commands pass from now on: an operator's explicit command.

        Raises
        ------
        NotReadyError
            The robot is not connected, not homed, in a fault, or has no limits.
        OutOfReachError, InvalidInputError
            As for `check_limits`.
        Exception
            The log's own: this record, or that of a stop before it, could not be written.
        """
        self._need_log()
        status = self._robot.status()
        try:
            if status.state in (RobotState.DISCONNECTED, RobotState.FAULT):
                raise NotReadyError(f"the robot is in state {status.state}")
            if not status.homed:
                raise NotHomedError("home the robot before arming")
            self.check_limits()
        except (RobotError, InvalidInputError) as error:
            self._record("arm", "", outcome=str(error))
            raise
        self.heartbeat()
        self._armed = True
        self._record("arm", "")

    def disarm(self) -> None:
        """Stop, and let nothing pass until armed again."""
        self.halt("disarmed by the operator", command="disarm")

    def heartbeat(self) -> None:
        """Tell that the operator is there; call it several times per `operator_timeout_s`."""
        self._heard_s = self._clock()

    def observe(self, fix: Fix) -> None:
        """Tell the newest fix, whatever its status; never waits. One that comes late is no news."""
        if self._fix is None or fix.time_s >= self._fix.time_s:
            self._fix = fix

    @property
    def newest_fix(self) -> Fix | None:
        """The newest fix that was told."""
        return self._fix

    # The way to the robot.

    def accept(self, fix: Fix) -> NDArray[np.float64]:
        """Return the point (2,) of a fix that is good enough to move on.

        Raises
        ------
        RefusedError
            It is not; the message says why.
        """
        doubt = self._doubt(fix)
        if doubt or fix.point is None:
            raise RefusedError(doubt)
        return fix.point

    def semi_axis_m(self, fix: Fix) -> float:
        """Return the larger semi-axis of a fix's ellipse on the robot's plane [m].

        Raises
        ------
        InvalidInputError
            The fix has no point, or it is beyond the horizon of the plane's tie.
        """
        if fix.point is None or fix.covariance is None:
            raise InvalidInputError(f"a fix that is {fix.status} has no ellipse")
        centre = self.plane.position_m(fix.point)
        covariance = self.plane.covariance_m2(fix.point, fix.covariance)
        return float(confidence_ellipse(centre, covariance, self.options.confidence).semi_axes[0])

    def where(self) -> tuple[NDArray[np.float64], float]:
        """Read where the gripper is: point of the plane (2,) and height above it [m].

        Raises
        ------
        RobotError
            It cannot be read; a silent robot has been told to stop, and the guard is disarmed.
        """
        with self._halting("reading the pose"):
            pose = self._robot.pose()
        self._read = pose
        if not self.busy:
            self._goals.clear()  # an arm that has been stopped goes to none of them
        return self.plane.point(pose.position_m[:2]), self.plane.above_m(pose)

    def locate(self) -> None:
        """Read where an arm has come to rest that was stopped on its way; else do nothing.

        Raises
        ------
        RobotError
            As for `where`.
        """
        if self._goals and not self.busy:
            self.where()

    def body(self) -> tuple[Capsule, ...]:
        """Return the room that the arm may take up now, in plane coordinates; never waits.

        That is the arm with its gripper anywhere on the way from where it was read last to where it
        has been sent since. Empty until `arm`, `enter` or `where` has read a pose.
        """
        # Copied at once: the goals grow in another thread.
        poses = [pose for pose in (self._read, *tuple(self._goals)) if pose is not None]
        shape = getattr(self._robot, "shape", None) or ArmShape.of_limits(self._robot.limits)
        return self.plane.capsules(part for pose in along(poses) for part in shape.capsules(pose))

    @property
    def time_s(self) -> float:
        """The guard's clock, that of the fixes [s]."""
        return self._clock()

    @property
    def allowed(self) -> SafeRegion:
        """The safe region less its rim: where commands may send the gripper to."""
        return self._allowed

    def clamp(self, point: ArrayLike, above_m: float) -> tuple[NDArray[np.float64], float]:
        """Return the nearest place that a command may send the gripper to."""
        return self._allowed.clamp(point, above_m)

    def enter(self) -> None:
        """Move from wherever the arm is to the middle of the safe region, at its top, and wait.

        The way there is outside the region: see that it is clear.

        Raises
        ------
        NotArmedError, RobotError
            As for `move`.
        """
        interruptions = self._interruptions
        self._need_armed("enter", None)
        self.where()
        goal = self.plane.pose(self._allowed.centre, self._allowed.highest_m)
        self._send("enter", goal, None, Presence.OPERATOR, None, interruptions)
        self._finish(interruptions)
        self._inside = True

    def visit(self, point: ArrayLike, above_m: float, *, speed_m_s: float | None = None) -> Pose:
        """Move the gripper to a place over the plane because the operator's procedure says so.

        No fix stands behind it, so the place is refused rather than moved into the region.

        Parameters
        ----------
        point : (2,)
            Plane coordinates.
        above_m : float
            Height above the plane [m].
        speed_m_s : float, optional
            Speed [m/s]; `max_speed_m_s` by default and at most.

        Returns
        -------
        Pose
            The goal, where the arm stands now.

        Raises
        ------
        OutOfReachError
            The place is outside the safe region less its rim.
        NotArmedError, RefusedError, StoppedError, RobotError
            As for `move`.
        """
        interruptions = self._interruptions
        self._need_armed("visit", None)
        wanted, goal = self.plane.pose(point, above_m), self.plane.pose(*self.clamp(point, above_m))
        if wanted.distance_m(goal) > ROUNDING_M:
            problem = f"outside the safe region: {wanted}"
            self._record("visit", "", outcome=problem)
            raise OutOfReachError(f"{problem}; {goal} will do")
        self._need_inside(None)
        pose = self._send("visit", goal, None, Presence.OPERATOR, speed_m_s, interruptions)
        self._finish(interruptions)
        return pose

    def make_way(self, aside: ArrayLike | None = None, *, speed_m_s: float = AWAY_M_S) -> Pose:
        """Move the gripper up and aside, inside the safe region, so that the cameras see the hand.

        Straight up to the top of the region first, then level. Nothing shows where the hand is:
        call it on an explicit request only, and keep up the heartbeat only while that lasts.

        Parameters
        ----------
        aside : (2,), optional
            Plane coordinates of where it is out of the way; the nearest permitted place is taken.
            By default the robot's own axis, X = Y = 0: the arm draws back towards its base.
        speed_m_s : float
            Speed [m/s]; `max_speed_m_s` at most.

        Returns
        -------
        Pose
            Where the arm stands now.

        Raises
        ------
        NotArmedError, RefusedError, StoppedError, RobotError
            As for `visit`.
        """
        self._need_armed("visit", None)
        if self.busy:
            self.hold("making way")
        here, _ = self.where()
        top_m = self._allowed.highest_m
        self.visit(self.clamp(here, top_m)[0], top_m, speed_m_s=speed_m_s)
        away = self.plane.point([0.0, 0.0]) if aside is None else aside
        return self.visit(self.clamp(away, top_m)[0], top_m, speed_m_s=speed_m_s)

    def move(
        self,
        point: ArrayLike,
        above_m: float,
        *,
        fix: Fix,
        needs: Presence,
        speed_m_s: float | None = None,
        wait: bool = True,
    ) -> Pose:
        """Move the gripper over a point of the plane, or as near as the safe region allows.

        Parameters
        ----------
        point : (2,)
            Plane coordinates.
        above_m : float
            Height above the plane [m].
        fix : Fix
            What caused the command.
        needs : Presence
            What must last while it runs. With `FIX`, `fix` itself must be acceptable.
        speed_m_s : float, optional
            Speed [m/s]; `max_speed_m_s` by default and at most.
        wait : bool
            Return when the arm stands there.

        Returns
        -------
        Pose
            The goal that was sent.

        Raises
        ------
        NotArmedError
            Not armed, or the operator is gone.
        RefusedError
            The fix will not do, or the arm is outside the safe region (`enter` first).
        StoppedError
            Held or halted meanwhile.
        RobotError
            The robot's own; the guard has been disarmed.
        Exception
            The log's own; the command has not been sent, and the guard has been disarmed.
        """
        interruptions = self._interruptions
        if self._fix is None or fix.time_s > self._fix.time_s:
            self.observe(fix)
        self._need_armed("move", fix)
        self._need_inside(fix)
        if needs is Presence.FIX and (doubt := self._doubt(fix)):
            self._record("move", "", fix=fix, outcome=doubt)
            raise RefusedError(doubt)
        goal = self.plane.pose(*self.clamp(point, above_m))
        pose = self._send("move", goal, fix, needs, speed_m_s, interruptions)
        if wait:
            self._finish(interruptions)
        return pose

    def gripper(self, target: GripperTarget, *, fix: Fix) -> None:
        """Open, close or set the gripper, and wait.

        Raises
        ------
        NotArmedError, StoppedError, RobotError
            As for `move`.
        """
        interruptions = self._interruptions
        self._need_armed("gripper", fix)
        self._needs = Presence.OPERATOR
        self._record("gripper", str(target), fix=fix)
        with self._uninterrupted("gripper", interruptions):
            self._robot.gripper(target)
        self._needs = None

    def hold(self, reason: str) -> None:
        """Stop the arm and stay armed, as when the fix is lost."""
        self._interrupt("hold", reason)

    def halt(self, reason: str, *, command: str = "halt") -> None:
        """Stop the arm and disarm."""
        self._armed = self._inside = False
        self._interrupt(command, reason)

    def check(self) -> None:
        """Stop the arm if what its motion needs has ended; cheap, call it often."""
        if not self._armed:
            return
        state = self._robot.status().state
        if state in (RobotState.FAULT, RobotState.DISCONNECTED):
            self.halt(f"the robot is in state {state}")
        elif not self._operator_present():
            self.halt("the operator is gone")
        elif self._needs is Presence.FIX:
            fix = self._fix
            doubt = "no fix" if fix is None else self._doubt(fix)
            if doubt:
                self.hold(doubt)

    @contextmanager
    def watching(self) -> Iterator[Self]:
        """Call `check` from a thread every `WATCH_S`; halt when the block ends in any way.

        Raises
        ------
        Exception
            The log's own, if it has failed on a stop and nothing else has ended the block.
        """
        done = threading.Event()

        def watch() -> None:
            while not done.wait(WATCH_S):
                try:
                    self.check()
                except Exception as error:  # a watch that dies would watch nothing
                    logger.exception("the watch failed")
                    self.halt(f"the watch failed: {error}")

        thread = threading.Thread(target=watch, name="guard", daemon=True)
        thread.start()
        try:
            with self:
                yield self
        finally:
            done.set()
            thread.join()
        self._need_log()  # the watch may have stopped the arm last

    @contextmanager
    def signals(self, *numbers: signal.Signals) -> Iterator[Self]:
        """Halt on signals, every time, then let them take their course; in the main thread only.

        Parameters
        ----------
        *numbers : signal.Signals
            Which; SIGINT and SIGTERM by default.
        """
        with stopping_on(lambda name: self.halt(f"signal {name}"), *numbers):
            yield self

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._armed:
            self.halt("the end" if kind is None else f"{kind.__name__}: {error}")
            if kind is None and self._stop_error is not None:
                raise self._stop_error
        if kind is None:
            self._need_log()

    # Inside.

    def _speed(self, speed_m_s: float | None) -> float:
        fastest = self.options.max_speed_m_s
        return fastest if speed_m_s is None else min(speed_m_s, fastest)

    def _limits(self) -> Limits:
        limits = self._robot.limits
        if limits is None:
            raise NotReadyError("the robot has no limits: declare them before arming")
        return limits

    def _doubt(self, fix: Fix) -> str:
        """Return why a fix is not good enough to move on; empty if it is."""
        if fix.status is not Status.OK or fix.point is None:
            return f"fix is {fix.status}{f': {fix.reason}' if fix.reason else ''}"
        age_s = self._clock() - fix.time_s
        if not -WATCH_S <= age_s <= self.options.max_fix_age_s:
            return f"fix is {age_s:.3f} s old; at most {self.options.max_fix_age_s:g} s will do"
        try:
            semi_axis_m = self.semi_axis_m(fix)
        except InvalidInputError as error:
            return str(error)
        if not semi_axis_m <= self.options.tolerance_m:
            return (
                f"{100 * self.options.confidence:g} % ellipse reaches {1000 * semi_axis_m:.1f} mm; "
                f"at most {1000 * self.options.tolerance_m:g} mm will do"
            )
        return ""

    def _send(
        self,
        command: str,
        goal: Pose,
        fix: Fix | None,
        needs: Presence,
        speed_m_s: float | None,
        interruptions: int,
    ) -> Pose:
        """Send a motion."""
        speed = self._speed(speed_m_s)
        self._needs = needs
        self._goals.append(goal)
        self._record(command, str(goal), pose=goal, fix=fix)
        with self._uninterrupted(command, interruptions):
            self._robot.move_to(goal, speed_m_s=speed, wait=False)
        return goal

    def _finish(self, interruptions: int) -> None:
        """Wait for the arm to arrive, which one that was stopped before the wait has not."""
        with self._uninterrupted("wait", interruptions):
            self._robot.wait()
        self._needs = None
        if self._goals:
            self._read = self._goals[-1]
            self._goals.clear()

    @contextmanager
    def _uninterrupted(self, command: str, interruptions: int) -> Iterator[None]:
        """Void what has been interrupted since it began; halt on failures as `_halting` does."""
        with self._halting(command):
            self._need_uninterrupted(interruptions)
            yield
            self._need_uninterrupted(interruptions)

    def _need_uninterrupted(self, interruptions: int) -> None:
        """Raise if a stop came in between; it is repeated, as the command may have overtaken it."""
        if self._interruptions != interruptions or not self._armed:
            self._needs = None
            self._robot.stop()
            raise StoppedError("held or halted before the command was done")

    @contextmanager
    def _halting(self, command: str) -> Iterator[None]:
        """Halt on any failure but a stop, which is one already."""
        try:
            yield
        except StoppedError:
            raise
        except BaseException as error:
            self.halt(f"{command} failed: {str(error) or type(error).__name__}")
            raise

    def _interrupt(self, command: str, reason: str) -> None:
        self._why_stopped = reason
        self._interruptions += 1
        self._needs = None
        outcome, self._stop_error = "sent", None
        try:
            self._robot.stop()
        except RobotError as error:
            self._armed = self._inside = False
            outcome, self._stop_error = str(error), error
            self._why_stopped = f"{reason}; the stop failed, so the arm may still move: {error}"
        self._record(command, reason, fix=self._fix, outcome=outcome, is_stop=True)

    def _need_armed(self, command: str, fix: Fix | None) -> None:
        self._need_log()
        problem = ""
        if not self._armed:
            problem = "not armed"
        elif not self._operator_present():
            self.halt("the operator is gone")
            problem = "the operator is gone"
        if problem:
            self._record(command, "", fix=fix, outcome=problem)
            raise NotArmedError(f"{problem}: call arm()")

    def _need_inside(self, fix: Fix | None) -> None:
        """See once that the gripper is in the region: from there no straight way leads out."""
        if self._inside:
            return
        point, above_m = self.where()
        self._inside = self.region.contains(
            point, above_m, within=self._clearance(), within_m=self.options.clearance_m
        )
        if not self._inside:
            problem = (
                f"the gripper is outside the safe region, at ({point[0]:g}, {point[1]:g}), "
                f"{above_m:.4f} m above the plane: call enter()"
            )
            self._record("move", "", fix=fix, outcome=problem)
            raise RefusedError(problem)

    def _operator_present(self) -> bool:
        return self._clock() - self._heard_s <= self.options.operator_timeout_s

    def _without_rim(self) -> SafeRegion:
        self.plane.position_m(self.region.corners)
        return self.region.inset(self._clearance(), self.options.clearance_m)

    def _clearance(self) -> float:
        """Return the clearance in plane units, where the plane is stretched most."""
        jacobians = transfer_jacobian_by_point(self.plane.robot_from_plane, self.region.corners)
        least = float(np.linalg.svd(jacobians, compute_uv=False).min())
        return self.options.clearance_m / least

    def _record(
        self,
        command: str,
        detail: str,
        *,
        pose: Pose | None = None,
        fix: Fix | None = None,
        outcome: str = "sent",
        is_stop: bool = False,
    ) -> None:
        """Log a command, which does not pass if it cannot be logged; only a stop does."""
        record = CommandRecord(self._clock(), command, detail, pose, fix, outcome)
        self._records.append(record)
        logger.info("%s", record)
        try:
            self._on_record(record)
        except Exception as error:  # whatever it is, stopping must go on
            if self._log_error is None:
                logger.warning("the log failed: %s", error)
                self._log_error = error
        if not is_stop:
            self._need_log()

    def _need_log(self) -> None:
        """Halt and raise if the log has failed since this was last asked."""
        error = self._log_error
        if error is None:
            return
        if self._armed:
            self.halt(f"the log failed: {error}")
        self._log_error = None
        raise error
