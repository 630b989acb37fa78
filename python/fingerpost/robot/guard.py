"""The guard between the pointing hand and the robot.

Guidance moves a robot only through its `Guard`. A command passes if

* the robot is homed, has limits that contain the whole safe region, and has been armed explicitly,
* there has been a recent heartbeat of the operator (a dead-man's switch),
* the fix behind the command has a point, is fresh, and its ellipse is within the tolerance,
* the goal is inside the safe region; otherwise the goal is moved into it.

`check`, called often (`watching` does so from a thread), stops the robot when one of these
conditions fails during motion. Every command, passed or refused, and every stop are logged with the
fix that caused them.

If a stop raises any exception, `check` repeats it until it has succeeded or its line is known to be
dead (`fingerpost.robot.stopping`). Until then the guard cannot be armed, and a block that ends
meanwhile raises an error.

A failing log never prevents a stop, but a command that could not be logged does not pass: the error
is stored, and raised by the next command, by arming, or at the end of the block.
"""

from __future__ import annotations

import logging
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fingerpost.homography import transfer_jacobian_by_point
from fingerpost.pointing import Fix
from fingerpost.robot.errors import (
    NotArmedError,
    NotHomedError,
    NotReadyError,
    OutOfReachError,
    RefusedError,
    StoppedError,
)
from fingerpost.robot.fix_gate import FixGate, GuardOptions, Presence
from fingerpost.robot.interlock import Interlock
from fingerpost.robot.plane import RobotPlane
from fingerpost.robot.protocol import GripperTarget, Limits, Pose, Robot, RobotState
from fingerpost.robot.records import CommandRecord, RecordCallback
from fingerpost.robot.region import SafeRegion
from fingerpost.robot.signals import stopping_on
from fingerpost.robot.stopping import WATCH_S, described
from fingerpost.robot.whereabouts import Whereabouts
from fingerpost.silhouette import Capsule

__all__ = ["WATCH_S", "CommandRecord", "Guard", "GuardOptions", "Presence", "RecordCallback"]

logger = logging.getLogger(__name__)

AWAY_M_S = 0.05
"""Speed of a retreat [m/s]: a person near the arm may not be visible."""

ROUNDING_M = 1e-6
"""Distance outside the region up to which a place to visit is moved into it [m]."""


class Guard:
    """The guard of one robot.

    Parameters
    ----------
    robot : Robot
        The robot; connected and homed before it is armed.
    plane : RobotPlane
        Position of the plane in the robot's frame.
    region : SafeRegion
        Permitted region.
    options : GuardOptions
        Conditions for commands.
    clock : callable
        The clock of the fixes' `time_s` [s].
    on_record : callable, optional
        Called with every `CommandRecord`. An exception for a stop is raised later: by the next
        command, by `arm`, or at the end of a `with` block or of `watching` without another
        exception. An exception for a command voids the command, and the arm is halted.

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
        self._gate = FixGate(plane, clock)
        self._whereabouts = Whereabouts(robot, plane)
        self._interlock = Interlock(
            robot, clock=clock, newest_fix=lambda: self.newest_fix, on_record=on_record
        )
        self._allowed = self._without_rim()
        # A stop ends both, so each is stored with the number of the last stop before it began.
        self._running: tuple[Presence | None, int] = (None, 0)
        self._entered_after: int | None = None
        self._heartbeat_s = -np.inf
        self._vouchers = 0

    # Operator interface.

    @property
    def armed(self) -> bool:
        """Whether commands may pass."""
        return self._interlock.armed

    @property
    def records(self) -> tuple[CommandRecord, ...]:
        """The last commands, oldest first."""
        return self._interlock.records

    @property
    def busy(self) -> bool:
        """Whether the arm may still execute a command."""
        return self._needs is not None

    @property
    def interruptions(self) -> int:
        """Number that changes with every stop, which voids the commands given before it."""
        return self._interlock.last_stop

    @property
    def why_stopped(self) -> str:
        """Reason for the last stop, and whether it failed; empty without one."""
        return self._interlock.why_stopped

    def check_limits(self, *, speed_m_s: float | None = None) -> None:
        """Check that the robot has limits that contain the whole safe region and a speed.

        Parameters
        ----------
        speed_m_s : float, optional
            Speed of the commands [m/s]; `max_speed_m_s` by default and at most.

        Raises
        ------
        NotReadyError
            No limits.
        OutOfReachError
            A corner of the region is outside them.
        InvalidInputError
            The arm cannot move so slowly.
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
        """Check that the robot's gripper accepts a target.

        Raises
        ------
        NotReadyError
            No limits, so the gripper is unknown.
        GripperError
            No gripper, or a width for one that only opens and closes.
        InvalidInputError
            A width out of range.
        """
        self._limits().opening(target)

    @property
    def disarmings(self) -> int:
        """Number that changes whenever the guard is disarmed."""
        return self._interlock.last_disarming

    def arm(self, disarmings: int | None = None) -> None:
        """Permit commands from now on, by an explicit command of the operator.

        Parameters
        ----------
        disarmings : int, optional
            Value of `disarmings` at the time of the operator's command, so that a stop since then
            voids it; by default the present value.

        Raises
        ------
        NotReadyError
            The robot is not connected, not homed, in a fault, or has no limits; or a stop has still
            not succeeded after one more attempt.
        OutOfReachError, InvalidInputError
            As for `check_limits`.
        StoppedError
            Halted meanwhile.
        Exception
            Error of the log: this record, or that of an earlier stop, could not be written.
        """
        self._interlock.need_log()
        last_disarming = self.disarmings if disarmings is None else disarmings
        try:
            self._need_ready()
            self._interlock.need_stops()
            self.check_limits()
        except Exception as error:
            self._interlock.record("arm", "", outcome=described(error))
            raise
        self.heartbeat()
        self._interlock.arm(last_disarming)

    def disarm(self) -> None:
        """Stop, and refuse commands until armed again."""
        self.halt("disarmed by the operator", command="disarm")

    def heartbeat(self) -> None:
        """Confirm the operator's presence; call it several times per `operator_timeout_s`."""
        self._heartbeat_s = self._clock()

    @contextmanager
    def attended(self) -> Iterator[None]:
        """Assume the operator's presence for the duration of the block.

        For a procedure that a person starts and supervises; signals that end the program end it.
        """
        self._vouchers += 1
        try:
            yield
        finally:
            self.heartbeat()
            self._vouchers -= 1

    def observe(self, fix: Fix) -> None:
        """Process the newest fix, of any status; never waits.

        An older fix is ignored, and an impossible one is dropped (`FixGate.observe`): its time or
        its point is not finite, or its time is ahead of the guard's clock.
        """
        self._gate.observe(fix)

    @property
    def newest_fix(self) -> Fix | None:
        """The newest fix that was observed."""
        return self._gate.newest

    # Commands to the robot.

    def accept(self, fix: Fix) -> NDArray[np.float64]:
        """Return the point (2,) of a fix that permits motion.

        Raises
        ------
        RefusedError
            It does not; the message says why.
        """
        doubt = self.doubt(fix)
        if doubt or fix.point is None:
            raise RefusedError(doubt)
        return fix.point

    def doubt(self, fix: Fix) -> str:
        """Return why a fix does not permit motion; empty if it does."""
        return self._gate.doubt(fix, self.options)

    def semi_axis_m(self, fix: Fix) -> float:
        """Return the larger semi-axis of a fix's ellipse on the robot's plane [m].

        Raises
        ------
        InvalidInputError
            The fix has no point, or it is beyond the horizon of the plane's tie.
        """
        return self._gate.semi_axis_m(fix, self.options.confidence)

    def where(self) -> tuple[NDArray[np.float64], float]:
        """Read the gripper's position: point of the plane (2,) and height above it [m].

        Raises
        ------
        RobotError
            It cannot be read; if the robot does not answer, it has been sent a stop, and the guard
            is disarmed.
        """
        with self._halting("reading the pose"):
            pose = self._robot.pose()
            self._whereabouts.read(pose, moving=self.busy)
            return self.plane.point(pose.position_m[:2]), self.plane.above_m(pose)

    def is_inside(self) -> bool:
        """Whether the gripper is in the safe region; read once after each arming.

        Raises
        ------
        RobotError
            As for `where`.
        """
        return self._outside() is None

    def locate(self) -> None:
        """Read the position of an arm that was stopped during a motion; else do nothing.

        Raises
        ------
        RobotError
            As for `where`.
        """
        if self._whereabouts.is_doubtful and not self.busy:
            self.where()

    def body(self) -> tuple[Capsule, ...]:
        """Return the volume that the arm may occupy now, in plane coordinates; never waits.

        As `fingerpost.robot.whereabouts.Whereabouts.body`.
        """
        return self._whereabouts.body()

    @property
    def pose(self) -> Pose | None:
        """Last known pose of the gripper, read or reached; None before any; never waits."""
        return self._whereabouts.pose

    @property
    def time_s(self) -> float:
        """The guard's clock, that of the fixes [s]."""
        return self._clock()

    @property
    def allowed(self) -> SafeRegion:
        """The safe region without its rim: the permitted goals of commands."""
        return self._allowed

    def clamp(self, point: ArrayLike, above_m: float) -> tuple[NDArray[np.float64], float]:
        """Return the nearest permitted goal of a command."""
        return self._allowed.clamp(point, above_m)

    def enter(self) -> None:
        """Move from any position to the middle of the safe region, at its top, and wait.

        The path may lie outside the region: make sure that it is clear.

        Raises
        ------
        NotArmedError, RobotError
            As for `move`.
        """
        interruptions, last_disarming = self.interruptions, self._interlock.last_disarming
        self._need_armed("enter", None)
        self.where()
        goal = self.plane.pose(self._allowed.centre, self._allowed.highest_m)
        self._send("enter", goal, None, Presence.OPERATOR, None, interruptions)
        self._finish(interruptions)
        self._entered_after = last_disarming

    def visit(self, point: ArrayLike, above_m: float, *, speed_m_s: float | None = None) -> Pose:
        """Move the gripper to a place over the plane, as part of a procedure of the operator.

        Without a fix, a place outside the region is refused rather than moved into it.

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
            The goal, at which the arm now stands.

        Raises
        ------
        OutOfReachError
            The place is outside the safe region less its rim.
        NotArmedError, RefusedError, StoppedError, RobotError
            As for `move`.
        """
        interruptions = self.interruptions
        self._need_armed("visit", None)
        wanted, goal = self.plane.pose(point, above_m), self.plane.pose(*self.clamp(point, above_m))
        if wanted.distance_m(goal) > ROUNDING_M:
            problem = f"outside the safe region: {wanted}"
            self._interlock.record("visit", "", outcome=problem)
            raise OutOfReachError(f"{problem}; {goal} will do")
        self._need_inside(None)
        pose = self._send("visit", goal, None, Presence.OPERATOR, speed_m_s, interruptions)
        self._finish(interruptions)
        return pose

    def make_way(self, retreat: ArrayLike | None = None, *, speed_m_s: float = AWAY_M_S) -> Pose:
        """Move the gripper out of the way, inside the safe region, so that the hand is visible.

        It moves straight up to the top of the region, then horizontally. The position of the hand
        is unknown: call it only on an explicit request, and send heartbeats only while that lasts.

        Parameters
        ----------
        retreat : (2,), optional
            Plane coordinates of the destination; the nearest permitted place is used. By default
            the robot's own axis, X = Y = 0: the arm retreats towards its base.
        speed_m_s : float
            Speed [m/s]; `max_speed_m_s` at most.

        Returns
        -------
        Pose
            Pose of the arm after the retreat.

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
        away = self.plane.point([0.0, 0.0]) if retreat is None else retreat
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
            The fix that caused the command.
        needs : Presence
            Condition for the whole motion. With `FIX`, `fix` itself must be acceptable.
        speed_m_s : float, optional
            Speed [m/s]; `max_speed_m_s` by default and at most.
        wait : bool
            Whether to wait until the arm stands there.

        Returns
        -------
        Pose
            The goal that was sent.

        Raises
        ------
        NotArmedError
            Not armed, or the operator is absent.
        RefusedError
            The fix does not permit motion, or the arm is outside the safe region (`enter` first).
        StoppedError
            Held or halted meanwhile.
        RobotError
            Error of the robot; the guard has been disarmed.
        Exception
            Error of the log; the command has not been sent, and the guard has been disarmed.
        """
        interruptions = self.interruptions
        newest = self.newest_fix
        if newest is None or fix.time_s > newest.time_s:
            self.observe(fix)
        self._need_armed("move", fix)
        self._need_inside(fix)
        if needs is Presence.FIX and (doubt := self._gate.doubt(fix, self.options)):
            self._interlock.record("move", "", fix=fix, outcome=doubt)
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
        interruptions = self.interruptions
        self._need_armed("gripper", fix)
        self._running = (Presence.OPERATOR, interruptions)
        self._interlock.record("gripper", str(target), fix=fix)
        with self._uninterrupted("gripper", interruptions):
            self._robot.gripper(target)
        self._running = (None, 0)

    def hold(self, reason: str) -> None:
        """Stop the arm and stay armed, as when the fix is lost."""
        self._interlock.stop("hold", reason, disarm=False)

    def halt(self, reason: str, *, command: str = "halt") -> None:
        """Stop the arm and disarm."""
        self._interlock.stop(command, reason, disarm=True)

    def check(self) -> None:
        """Stop the arm if a condition of its motion has failed; cheap, call it often.

        A failed stop is repeated, unless its line is dead.
        """
        self._interlock.repeat()
        if not self.armed:
            return
        try:
            state = self._robot.status().state
        except Exception as error:
            self.halt(f"the robot's status cannot be read: {described(error)}")
            return
        with self._halting("the check"):
            self._check_needs(state)

    @contextmanager
    def watching(self) -> Iterator[Self]:
        """Call `check` from a thread every `WATCH_S`; halt when the block ends in any way.

        Raises
        ------
        StopFailedError, ConnectionLostError, Exception
            As at the end of a `with` block: a stop has not succeeded or could not be logged, and no
            other exception has ended the block.
        """
        done = threading.Event()

        def watch() -> None:
            while not done.wait(WATCH_S):
                self._watch()

        thread = threading.Thread(target=watch, name="guard", daemon=True)
        thread.start()
        try:
            with self:
                yield self
        finally:
            done.set()
            thread.join()
        self._interlock.need_log()  # the watch may have stopped the arm last

    @contextmanager
    def signals(self, *numbers: signal.Signals) -> Iterator[Self]:
        """Halt on signals, every time, before their usual effect; in the main thread only.

        Parameters
        ----------
        *numbers : signal.Signals
            The signals; SIGINT and SIGTERM by default.
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
        if self.armed:
            self.halt("the end" if kind is None else f"{kind.__name__}: {error}")
        failure = self._interlock.finish()
        if error is not None:
            if failure is not None and failure is not error:
                error.add_note(str(failure))
            return
        if failure is not None:
            raise failure
        self._interlock.need_log()

    # Internals.

    @property
    def _needs(self) -> Presence | None:
        """Condition of the running command; None without one."""
        needs, interruptions = self._running
        return needs if interruptions == self.interruptions else None

    def _speed(self, speed_m_s: float | None) -> float:
        fastest = self.options.max_speed_m_s
        return fastest if speed_m_s is None else min(speed_m_s, fastest)

    def _limits(self) -> Limits:
        limits = self._robot.limits
        if limits is None:
            raise NotReadyError("the robot has no limits: declare them before arming")
        return limits

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
        self._running = (needs, interruptions)
        self._whereabouts.sent(goal)
        self._interlock.record(command, str(goal), pose=goal, fix=fix)
        with self._uninterrupted(command, interruptions):
            self._robot.move_to(goal, speed_m_s=speed, wait=False)
        return goal

    def _finish(self, interruptions: int) -> None:
        """Wait until the arm arrives; raise if it has been stopped before."""
        with self._uninterrupted("wait", interruptions):
            self._robot.wait()
        self._running = (None, 0)
        self._whereabouts.arrived()

    @contextmanager
    def _uninterrupted(self, command: str, interruptions: int) -> Iterator[None]:
        """Raise if the command has been interrupted; halt on failures as `_halting` does."""
        with self._halting(command):
            self._need_uninterrupted(interruptions)
            yield
            self._need_uninterrupted(interruptions)

    def _need_uninterrupted(self, interruptions: int) -> None:
        """Raise if there was a stop meanwhile; repeat it, as the command may have overtaken it."""
        if self.interruptions != interruptions or not self.armed:
            self._interlock.stop_again()
            raise StoppedError("held or halted before the command was done")

    @contextmanager
    def _halting(self, command: str) -> Iterator[None]:
        """Halt on any failure, except for a stop, which has halted the arm already."""
        try:
            yield
        except StoppedError:
            raise
        except BaseException as error:
            self.halt(f"{command} failed: {described(error)}")
            raise

    def _watch(self) -> None:
        """Check, and halt on any error: the watch must continue."""
        try:
            self.check()
        except BaseException as error:
            logger.exception("the watch failed")
            with suppress(BaseException):  # stored by the stopper, and repeated by the next check
                self.halt(f"the watch failed: {described(error)}")

    def _check_needs(self, state: RobotState) -> None:
        if state in (RobotState.FAULT, RobotState.DISCONNECTED):
            self.halt(f"the robot is in state {state}")
        elif not self._operator_present():
            self.halt("the operator is gone")
        elif self._needs is Presence.FIX:
            fix = self.newest_fix
            doubt = "no fix" if fix is None else self._gate.doubt(fix, self.options)
            if doubt:
                self.hold(doubt)

    def _need_ready(self) -> None:
        """Check that the robot is connected, without fault, and homed."""
        try:
            status = self._robot.status()
            state, homed = status.state, status.homed
        except Exception as error:
            raise NotReadyError(f"the robot's status cannot be read: {described(error)}") from error
        if state in (RobotState.DISCONNECTED, RobotState.FAULT):
            raise NotReadyError(f"the robot is in state {state}")
        if not homed:
            raise NotHomedError("home the robot before arming")

    def _need_armed(self, command: str, fix: Fix | None) -> None:
        self._interlock.need_log()
        problem = ""
        if not self.armed:
            problem = "not armed"
        elif not self._operator_present():
            self.halt("the operator is gone")
            problem = "the operator is gone"
        if problem:
            self._interlock.record(command, "", fix=fix, outcome=problem)
            raise NotArmedError(f"{problem}: call arm()")

    def _need_inside(self, fix: Fix | None) -> None:
        """Check once that the gripper is in the region: straight moves then stay inside it."""
        place = self._outside()
        if place is None:
            return
        point, above_m = place
        problem = (
            f"the gripper is outside the safe region, at ({point[0]:g}, {point[1]:g}), "
            f"{above_m:.4f} m above the plane: call enter()"
        )
        self._interlock.record("move", "", fix=fix, outcome=problem)
        raise RefusedError(problem)

    def _outside(self) -> tuple[NDArray[np.float64], float] | None:
        """Return the gripper's position if it is outside the region; None if it is inside."""
        last_disarming = self._interlock.last_disarming
        if self._entered_after == last_disarming:
            return None
        point, above_m = self.where()
        inside = self.region.contains(
            point, above_m, within=self._clearance(), within_m=self.options.clearance_m
        )
        if not inside:
            return point, above_m
        self._entered_after = last_disarming
        return None

    def _operator_present(self) -> bool:
        if self._vouchers:
            return True
        # Read before the clock: another thread may renew it in between.
        heartbeat_s = self._heartbeat_s
        # A clock that runs backwards, or returns NaN, is not trusted.
        return 0 <= self._clock() - heartbeat_s <= self.options.operator_timeout_s

    def _without_rim(self) -> SafeRegion:
        self.plane.position_m(self.region.corners)
        return self.region.inset(self._clearance(), self.options.clearance_m)

    def _clearance(self) -> float:
        """Return the clearance in plane units, at the greatest scale of the plane."""
        jacobians = transfer_jacobian_by_point(self.plane.robot_from_plane, self.region.corners)
        least = float(np.linalg.svd(jacobians, compute_uv=False).min())
        return self.options.clearance_m / least
