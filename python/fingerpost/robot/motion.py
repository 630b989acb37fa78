"""Motion of a simulated arm: queued paths, each with a trapezoidal speed profile.

All quantities are functions of time: a position is computed for the requested time, so an emulator
may run a thousand times faster than its arm would.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Vector: TypeAlias = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Ramp:
    """A trapezoidal speed profile: accelerate, hold, decelerate; triangular for a short distance.

    Parameters
    ----------
    length : float
        Distance, ≥ 0, in any unit.
    speed : float
        Greatest speed [unit/s], > 0.
    acceleration : float
        Acceleration and deceleration [unit/s²], > 0.
    """

    length: float
    speed: float
    acceleration: float

    @property
    def peak(self) -> float:
        """Greatest speed that is reached."""
        return min(self.speed, math.sqrt(self.length * self.acceleration))

    @property
    def duration_s(self) -> float:
        """Time from start to standstill [s]."""
        if self.peak == 0:  # no distance, or one lost in rounding
            return 0.0
        return self.length / self.peak + self.peak / self.acceleration

    def at(self, time_s: float) -> float:
        """Return the distance covered after a time, from 0 to `length`."""
        if time_s >= self.duration_s:
            return self.length
        if time_s <= 0:
            return 0.0
        rise_s = self.peak / self.acceleration
        left_s = self.duration_s - time_s
        if time_s < rise_s:
            return self.acceleration * time_s**2 / 2
        if left_s < rise_s:
            return self.length - self.acceleration * left_s**2 / 2
        return self.peak * (time_s - rise_s / 2)


@dataclass(frozen=True, slots=True)
class Path:
    """A path from one configuration to another.

    Attributes
    ----------
    at : callable
        Configuration at a fraction 0 … 1 of the path.
    goal : ndarray
        Configuration at its end.
    length : float
        Its length, in the unit of the speeds it is run with.
    """

    at: Callable[[float], Vector]
    goal: Vector
    length: float


@dataclass(frozen=True, slots=True)
class _Run:
    start_s: float
    path: Path
    ramp: Ramp

    @property
    def end_s(self) -> float:
        return self.start_s + self.ramp.duration_s

    def at(self, now_s: float) -> Vector:
        if self.ramp.length == 0 or now_s >= self.end_s:
            return self.path.goal
        return self.path.at(self.ramp.at(now_s - self.start_s) / self.ramp.length)


@dataclass(frozen=True, slots=True)
class _Plan:
    """Rest position of an arm and its queued runs; the last run determines its end."""

    rest: Vector
    runs: tuple[_Run, ...] = ()

    @property
    def end(self) -> Vector:
        return self.runs[-1].path.goal if self.runs else self.rest

    def ahead(self, now_s: float) -> tuple[_Run, ...]:
        return tuple(run for run in self.runs if run.end_s > now_s)

    def position(self, now_s: float) -> Vector:
        ahead = self.ahead(now_s)
        return ahead[0].at(now_s) if ahead else self.end


class MotionQueue:
    """Paths executed one after the other.

    It may be used from several threads, and aborted from a signal handler, where a lock could wait
    for the thread that it has interrupted. Queries therefore change nothing, and changes replace
    the whole plan. Of a simultaneous `add` and `abort` either may take effect last; to make sure of
    the abort, abort again after adding.

    Parameters
    ----------
    position : ndarray
        Configuration at the beginning.
    """

    def __init__(self, position: Vector) -> None:
        self._plan = _Plan(position)

    @property
    def end(self) -> Vector:
        """Configuration at the end of all queued paths."""
        return self._plan.end

    def add(self, path: Path, speed: float, acceleration: float, now_s: float) -> float:
        """Queue a path from `end`; return the time of its end [s]."""
        plan = self._plan
        ahead = plan.ahead(now_s)
        start_s = ahead[-1].end_s if ahead else now_s
        run = _Run(start_s, path, Ramp(path.length, speed, acceleration))
        self._plan = _Plan(plan.position(now_s), (*ahead, run))
        return run.end_s

    def position(self, now_s: float) -> Vector:
        """Return the present configuration."""
        return self._plan.position(now_s)

    def is_moving(self, now_s: float) -> bool:
        """Whether a path is still in execution."""
        return bool(self._plan.ahead(now_s))

    def abort(self, now_s: float) -> None:
        """Stop at the present configuration, and drop all queued paths."""
        self._plan = _Plan(self.position(now_s))


def straight(start: Vector, goal: Vector, *, lengths: slice) -> Path:
    """Return the straight path between two configurations.

    Parameters
    ----------
    start, goal : ndarray
        Its ends.
    lengths : slice
        The components that define its length; if they do not change, the greatest change of any
        other one does, so that a rotation on the spot takes time as well.
    """
    change = goal - start
    length = float(np.linalg.norm(change[lengths]))
    if length == 0:
        length = float(np.max(np.abs(change), initial=0.0))
    return Path(lambda share: start + share * change, goal, length)
