"""What stands between the pointing hand and the robot.

A `Guard` is the only way by which guidance moves a robot. It lets a command pass when

* the robot is homed, has limits that hold the whole safe region, and has been armed on purpose,
* the operator has been heard of lately (a dead-man's switch),
* the fix behind the command is one, is fresh, and its ellipse is smaller than the tolerance,
* the goal is inside the safe region, into which it is moved if it is not.

`check`, called often (`watching` does it from a thread), stops the robot when one of these ends
while it moves. Whatever passes or is refused, and every stop, goes into the log with the fix that
caused it.

A stop that raises anything is repeated, by `check`, until it has gone through or its line is known
to be dead (`fingerpost.robot.stopping`). Until then the guard cannot be armed, and a block that
ends meanwhile raises an error.

A log that fails never stands in the way of a stop, but nothing passes that could not be logged:
the failure is kept, and raised at the next command, when arming, or at the end of the block.
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
"""Speed at which the arm makes way [m/s]: whoever is near it may not be seen."""

ROUNDING_M = 1e-6
"""A place to visit may be outside the region by this much, and is moved into it [m]."""


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
        self._gate = FixGate(plane, clock)
        self._whereabouts = Whereabouts(robot, plane)
        self._interlock = Interlock(
            robot, clock=clock, newest_fix=lambda: self.newest_fix, on_record=on_record
        )
        self._allowed = self._without_rim()
        # Both end with a stop, so each stands beside the number of the last one when it began.
        self._running: tuple[Presence | None, int] = (None, 0)
        self._entered_after: int | None = None
        self._heard_s = -np.inf
        self._vouchers = 0

    # The operator's side.

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
        """Whether the arm may still be moving on a command that passed."""
        return self._needs is not None

    @property
    def interruptions(self) -> int:
        """Changes whenever the guard stops the arm: whoever gave a command can see it is void."""
        return self._interlock.last_stop

    @property
    def why_stopped(self) -> str:
        """Why the guard has stopped the arm the last time, and what of that failed; else empty."""
        return self._interlock.why_stopped

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

    @property
    def disarmings(self) -> int:
        """Changes whenever the guard is disarmed."""
        return self._interlock.last_disarming

    def arm(self, disarmings: int | None = None) -> None:
        """Let commands pass from now on: an operator's explicit command.

        Parameters
        ----------
        disarmings : int, optional
            `disarmings` of when the operator asked for it, so that a stop since then makes it
            void; of now by default.

        Raises
        ------
        NotReadyError
            The robot is not connected, not homed, in a fault, or has no limits; or a stop has not
            gone through yet, after one more attempt.
        OutOfReachError, InvalidInputError
            As for `check_limits`.
        StoppedError
            Halted meanwhile.
        Exception
            The log's own: this record, or that of a stop before it, could not be written.
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
        """Stop, and let nothing pass until armed again."""
        self.halt("disarmed by the operator", command="disarm")

    def heartbeat(self) -> None:
        """Tell that the operator is there; call it several times per `operator_timeout_s`."""
        self._heard_s = self._clock()

    @contextmanager
    def attended(self) -> Iterator[None]:
        """Take it that the operator is there as long as the block lasts, as he has just started it.

        For what a person starts and watches over; the signals that end a program end this too.
        """
        self._vouchers += 1
        try:
            yield
        finally:
            self.heartbeat()
            self._vouchers -= 1

    def observe(self, fix: Fix) -> None:
        """Take the newest fix, whatever its status; never waits.

        One that is late is no news, and one that no camera can have seen is dropped
        (`FixGate.observe`): its time or its point is not finite, or ahead of the guard's clock.
        """
        self._gate.observe(fix)

    @property
    def newest_fix(self) -> Fix | None:
        """The newest fix that was observed."""
        return self._gate.newest

    # The way to the robot.

    def accept(self, fix: Fix) -> NDArray[np.float64]:
        """Return the point (2,) of a fix that is good enough to move on.

        Raises
        ------
        RefusedError
            It is not; the message says why.
        """
        doubt = self._gate.doubt(fix, self.options)
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
        return self._gate.semi_axis_m(fix, self.options.confidence)

    def where(self) -> tuple[NDArray[np.float64], float]:
        """Read where the gripper is: point of the plane (2,) and height above it [m].

        Raises
        ------
        RobotError
            It cannot be read; a silent robot has been sent a stop, and the guard is disarmed.
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
        """Read where an arm has come to rest that was stopped on its way; else do nothing.

        Raises
        ------
        RobotError
            As for `where`.
        """
        if self._whereabouts.is_doubtful and not self.busy:
            self.where()

    def body(self) -> tuple[Capsule, ...]:
        """Return the room that the arm may take up now, in plane coordinates; never waits.

        As `fingerpost.robot.whereabouts.Whereabouts.body`.
        """
        return self._whereabouts.body()

    @property
    def pose(self) -> Pose | None:
        """Where the gripper was read last, or has arrived since; None before; never waits."""
        return self._whereabouts.pose

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
        interruptions, last_disarming = self.interruptions, self._interlock.last_disarming
        self._need_armed("enter", None)
        self.where()
        goal = self.plane.pose(self._allowed.centre, self._allowed.highest_m)
        self._send("enter", goal, None, Presence.OPERATOR, None, interruptions)
        self._finish(interruptions)
        self._entered_after = last_disarming

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
        """Stop the arm if what its motion needs has ended; cheap, call it often.

        A stop that has failed is repeated, unless its line is dead.
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
            As at the end of a `with` block: a stop has not gone through, or the log has failed on
            one, and nothing else has ended the block.
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

    # Inside.

    @property
    def _needs(self) -> Presence | None:
        """What must last while the command that passed last runs; None if none does."""
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
        """Wait for the arm to arrive, which one that was stopped before the wait has not."""
        with self._uninterrupted("wait", interruptions):
            self._robot.wait()
        self._running = (None, 0)
        self._whereabouts.arrived()

    @contextmanager
    def _uninterrupted(self, command: str, interruptions: int) -> Iterator[None]:
        """Void what has been interrupted since it began; halt on failures as `_halting` does."""
        with self._halting(command):
            self._need_uninterrupted(interruptions)
            yield
            self._need_uninterrupted(interruptions)

    def _need_uninterrupted(self, interruptions: int) -> None:
        """Raise if a stop came in between; it is repeated, as the command may have overtaken it."""
        if self.interruptions != interruptions or not self.armed:
            self._interlock.stop_again()
            raise StoppedError("held or halted before the command was done")

    @contextmanager
    def _halting(self, command: str) -> Iterator[None]:
        """Halt on any failure but a stop, which is one already."""
        try:
            yield
        except StoppedError:
            raise
        except BaseException as error:
            self.halt(f"{command} failed: {described(error)}")
            raise

    def _watch(self) -> None:
        """Check, and halt if that fails in any way: a watch that ended would watch nothing."""
        try:
            self.check()
        except BaseException as error:
            logger.exception("the watch failed")
            with suppress(BaseException):  # kept by the stopper, and repeated by the next check
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
        """See that the robot is connected, well and homed."""
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
        """See once that the gripper is in the region: from there no straight way leads out."""
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
        """Return where the gripper is outside of the region; None if it is inside."""
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
        heard_s = self._heard_s  # before the clock: another thread may hear of him in between
        # Of a clock that runs backwards, or gives no number, nothing is believed.
        return 0 <= self._clock() - heard_s <= self.options.operator_timeout_s

    def _without_rim(self) -> SafeRegion:
        self.plane.position_m(self.region.corners)
        return self.region.inset(self._clearance(), self.options.clearance_m)

    def _clearance(self) -> float:
        """Return the clearance in plane units, where the plane is stretched most."""
        jacobians = transfer_jacobian_by_point(self.plane.robot_from_plane, self.region.corners)
        least = float(np.linalg.svd(jacobians, compute_uv=False).min())
        return self.options.clearance_m / least
