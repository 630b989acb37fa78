"""The robot follows the pointing hand, and the hand selects by dwelling.

Section 3.4 of the paper: "the robot is instructed to move repeatedly to where the hand is
pointing, providing the operator with direct feedback of the system's output." Here the indicated
point is smoothed, and the arm follows it in strides that last a fraction of a second. The next one
is sent when half of the last is done, so at most one and a half remain to be executed when the hand
turns or is lost, even on a controller that only queues.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray

from fingerpost.checks import in_range
from fingerpost.pointing import Fix
from fingerpost.robot.errors import NotArrivedError, RefusedError, StoppedError
from fingerpost.robot.guard import Guard, Presence
from fingerpost.robot.options import CheckedOptions
from fingerpost.robot.protocol import Pose
from fingerpost.robot.smoothing import LEAST_CUTOFF_HZ, OneEuroFilter

ARRIVED_M = 0.002
"""Distance from its goal at which an arm has arrived, unless the dead band is wider [m]."""

LONGEST_DWELL_S, WIDEST_DWELL_M = 3600.0, 1.0
"""Upper limits of dwell time and radius [s, m]."""

OVERDUE, OVERDUE_S = 3.0, 2.0
"""A stride is overdue after this multiple of its own duration plus this time [s]."""


class FollowOptions(CheckedOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of following.

    Attributes
    ----------
    above_m : float
        Height above the plane [m], ≥ 0, with room for the object that the hand points at. If the
        safe region does not include it, the nearest height inside is used.
    speed_m_s : float
        Greatest speed [m/s].
    stride_s : float
        Duration of a stride at that speed [s].
    dead_band_m : float
        Distance below which the arm does not move [m].
    min_cutoff_hz, slope_hz_m, speed_cutoff_hz : float
        Parameters of the `OneEuroFilter`; the slope is per m/s in the robot's frame.
    """

    above_m: Annotated[float, msgspec.Meta(ge=0, le=10)] = 0.05
    speed_m_s: Annotated[float, msgspec.Meta(gt=0, le=10)] = 0.1
    stride_s: Annotated[float, msgspec.Meta(gt=0, le=10)] = 0.3
    dead_band_m: Annotated[float, msgspec.Meta(ge=0, le=1)] = 0.003
    min_cutoff_hz: Annotated[float, msgspec.Meta(ge=LEAST_CUTOFF_HZ, le=1000)] = 1.0
    slope_hz_m: Annotated[float, msgspec.Meta(ge=0, le=1e6)] = 20.0
    speed_cutoff_hz: Annotated[float, msgspec.Meta(ge=LEAST_CUTOFF_HZ, le=1000)] = 1.0


class FollowState(StrEnum):
    """State of the follower after a fix."""

    MOVING = "moving"
    """It has sent the arm a stride."""
    UNDER_WAY = "under_way"
    """The last stride is not finished."""
    THERE = "there"
    """The arm stands at the indicated point."""
    HOLDING = "holding"
    """The guard refuses commands, for example because of the fix; the arm stands."""


@dataclass(frozen=True, slots=True)
class FollowReport:
    """Reaction of the follower to a fix.

    Attributes
    ----------
    state : FollowState
        Its state.
    reason : str
        Why it holds; else empty.
    target : (2,) or None
        Smoothed point of the plane, inside the safe region.
    lag_s : float
        Delay of the target by the smoothing [s].
    goal : Pose or None
        End of the stride that was sent.
    fix : Fix or None
        The fix that was used.
    """

    state: FollowState
    reason: str = ""
    target: NDArray[np.float64] | None = None
    lag_s: float = 0.0
    goal: Pose | None = None
    fix: Fix | None = None


class Follower:
    """Follow mode.

    `update` reads the arm's pose, which is slow on some controllers: a third of a second for a
    moving arm at 9600 baud. Call it with the newest fix in a separate thread, and pass every fix to
    `Guard.observe` as it arrives: after the reading, the follower uses the newest fix. Otherwise a
    fix may be stale by then, and the arm holds.

    Parameters
    ----------
    guard : Guard
        Armed guard.
    options : FollowOptions
        Options of following.
    """

    def __init__(self, guard: Guard, options: FollowOptions | None = None) -> None:
        self._guard = guard
        self._options = options = options or FollowOptions()
        self._filter = OneEuroFilter(
            options.min_cutoff_hz, options.slope_hz_m, options.speed_cutoff_hz
        )
        self._near_m = max(options.dead_band_m, ARRIVED_M)
        self._goal: Pose | None = None
        self._smooth_m: NDArray[np.float64] | None = None
        self._smooth_s = 0.0
        self._interruptions = 0
        self._sent_s = 0.0

    def update(self, fix: Fix) -> FollowReport:
        """React to a fix.

        Raises
        ------
        NotArmedError, RobotError
            As for `Guard.move`; a refusal or hold by the guard is not an error: the arm stands, and
            the report gives the reason.
        """
        self._guard.observe(fix)
        if self._goal is not None and self._guard.interruptions != self._interruptions:
            self.reset()  # the arm has been stopped elsewhere during its motion
        try:
            self._guard.accept(fix)
            return self._go_after(fix)
        except RefusedError as error:
            return self._hold(str(error), fix)
        except StoppedError:
            if not self._guard.armed:
                raise
            return self._hold(self._guard.why_stopped, fix)

    def _go_after(self, fix: Fix) -> FollowReport:
        looked_s = self._guard.time_s  # the reading is not older than this
        here, here_above_m = self._guard.where()
        fix = self._guard.newest_fix or fix  # reading takes time
        point = self._guard.accept(fix)
        target, above_m = self._guard.clamp(self._smooth(point, fix.time_s), self._options.above_m)
        lag_s = self._filter.lag_s
        at = self._guard.plane.pose(here, here_above_m)
        stride_m = self._options.speed_m_s * self._options.stride_s
        if self._goal is not None and at.distance_m(self._goal) > stride_m / 2:
            return self._under_way(at, looked_s, target, fix)
        start = self._goal or at
        way_m = start.distance_m(self._guard.plane.pose(target, above_m))
        if way_m <= self._options.dead_band_m:
            if self._goal is not None and at.distance_m(self._goal) > self._near_m:
                return self._under_way(at, looked_s, target, fix)
            return FollowReport(FollowState.THERE, "", target, lag_s, None, fix)
        goal_point, goal_above_m = self._stride(start, target, above_m, min(1.0, stride_m / way_m))
        self._interruptions = self._guard.interruptions
        self._goal = self._guard.move(
            goal_point,
            goal_above_m,
            fix=fix,
            needs=Presence.FIX,
            speed_m_s=self._options.speed_m_s,
            wait=False,
        )
        self._sent_s = self._guard.time_s  # a slow line takes time to send
        return FollowReport(FollowState.MOVING, "", target, lag_s, self._goal, fix)

    def _under_way(
        self, at: Pose, looked_s: float, target: NDArray[np.float64], fix: Fix
    ) -> FollowReport:
        self._need_progress(at, looked_s)
        return FollowReport(FollowState.UNDER_WAY, "", target, self._filter.lag_s, None, fix)

    def _smooth(self, point: NDArray[np.float64], time_s: float) -> NDArray[np.float64]:
        """Return the smoothed point; a repeated fix is smoothed once."""
        if self._smooth_m is None or time_s > self._smooth_s:
            self._smooth_m = self._filter(self._guard.plane.position_m(point), time_s)
            self._smooth_s = time_s
        return self._guard.plane.point(self._smooth_m)

    def _stride(
        self, start: Pose, target: NDArray[np.float64], above_m: float, share: float
    ) -> tuple[NDArray[np.float64], float]:
        """Return the end of one stride from a pose towards a place over the plane."""
        plane = self._guard.plane
        end = plane.pose(target, above_m)
        position = start.position_m + share * (end.position_m - start.position_m)
        step = Pose(*(float(value) for value in position))
        return plane.point(position[:2]), plane.above_m(step)

    def _hold(self, reason: str, fix: Fix) -> FollowReport:
        """Stand still until there is a usable fix, and restart the smoothing then."""
        if self._goal is not None and self._guard.interruptions == self._interruptions:
            self._guard.hold(reason)
        self.reset()
        return FollowReport(FollowState.HOLDING, reason, fix=fix)

    def reset(self) -> None:
        """Reset goal and smoothing, for example after another motion of the arm."""
        self._goal = None
        self._smooth_m = None
        self._filter.reset()

    def _need_progress(self, at: Pose, looked_s: float) -> None:
        """Halt an arm whose stride is overdue."""
        waited_s = looked_s - self._sent_s
        if waited_s > OVERDUE * self._options.stride_s + OVERDUE_S:
            message = f"the arm is at {at}, {waited_s:.1f} s after it was sent to {self._goal}"
            self._guard.halt(message)
            raise NotArrivedError(message)


@dataclass(frozen=True, slots=True)
class Selection:
    """A point of the plane that the operator has selected, and its fix."""

    point: NDArray[np.float64]
    fix: Fix


class DwellSelector:
    """Selects the point at which the hand dwells, while the arm stands there too.

    The operator relies on the robot's feedback, so the dwell time starts when the arm stands within
    the radius of the indicated point; a point that it cannot reach is never selected. It restarts
    after a gap between fixes of more than `max_fix_age_s`. After a selection the hand must leave
    the place before it can select again.

    Parameters
    ----------
    guard : Guard
        Decides which fixes are usable.
    dwell_s : float
        Dwell time [s], above 0, at most `LONGEST_DWELL_S`.
    radius_m : float
        Greatest distance from the first point of the dwell [m], above 0, at most `WIDEST_DWELL_M`.

    Raises
    ------
    InvalidInputError
        A time or radius out of range.
    """

    def __init__(self, guard: Guard, *, dwell_s: float = 1.0, radius_m: float = 0.01) -> None:
        smallest = np.finfo(np.float64).tiny
        self._guard = guard
        self._dwell_s = in_range(dwell_s, "dwell_s", smallest, LONGEST_DWELL_S)
        self._radius_m = in_range(radius_m, "radius_m", smallest, WIDEST_DWELL_M)
        self._longest_gap_s = guard.options.max_fix_age_s
        self._stay: _Stay | None = None
        self._selected: NDArray[np.float64] | None = None

    @property
    def progress(self) -> float:
        """Fraction of the dwell time that has passed, 0 … 1."""
        return 0.0 if self._stay is None else min(1.0, self._stay.span_s / self._dwell_s)

    def update(self, fix: Fix, arm: FollowReport | None) -> Selection | None:
        """Process the next fix; return the selection at the end of the dwell time.

        The selected point is the mean of the points during the dwell.

        Parameters
        ----------
        fix : Fix
            The next fix.
        arm : FollowReport or None
            The follower's last report; None when the arm has been moved or stopped since.
        """
        try:
            point = self._guard.accept(fix)
        except RefusedError:
            self._stay = None
            return None
        if self._selected is not None:
            if self._distance_m(self._selected, point) <= self._radius_m:
                return None
            self._selected = None
        if not self._stands_at(point, arm):
            self._stay = None
            return None
        if self._stay is not None and fix.time_s - self._stay.seen_s > self._longest_gap_s:
            self._stay = None
        if self._stay is None or self._distance_m(self._stay.first, point) > self._radius_m:
            self._stay = _Stay(point, fix.time_s)
        self._stay.add(point, fix.time_s)
        if self.progress < 1.0:
            return None
        self._selected, self._stay = self._stay.mean, None
        return Selection(self._selected, fix)

    def select(self, fix: Fix) -> Selection:
        """Select the point of a fix at once, as on a key.

        Raises
        ------
        RefusedError
            The fix is not usable; the message says why.
        """
        return Selection(self._guard.accept(fix), fix)

    def _stands_at(self, point: NDArray[np.float64], arm: FollowReport | None) -> bool:
        if arm is None or arm.state is not FollowState.THERE or arm.target is None:
            return False
        return self._distance_m(arm.target, point) <= self._radius_m

    def _distance_m(self, first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
        positions = self._guard.plane.position_m(np.array([first, second]))
        return float(np.linalg.norm(positions[1] - positions[0]))


class _Stay:
    """A dwelling hand: first point, start, time of the last fix, and mean."""

    def __init__(self, first: NDArray[np.float64], time_s: float) -> None:
        self.first = first
        self.span_s = 0.0
        self.seen_s = time_s
        self._since_s = time_s
        self._sum = np.zeros(2)
        self._count = 0

    def add(self, point: NDArray[np.float64], time_s: float) -> None:
        """Add a point."""
        self.span_s = time_s - self._since_s
        self.seen_s = time_s
        self._sum = self._sum + point
        self._count += 1

    @property
    def mean(self) -> NDArray[np.float64]:
        """Mean of the points (2,)."""
        return np.asarray(self._sum / self._count)
