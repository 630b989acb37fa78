"""The One-Euro filter (Casiez, Roussel & Vogel 2012) of a point, and its delay.

A first-order low-pass filter whose cutoff rises with speed: still hands are smoothed strongly, fast
ones hardly. Here the speed is that of the point, not of each coordinate, so that the result does
not depend on the axes. The resulting delay is given by `OneEuroFilter.lag_s`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fingerpost.checks import finite_array, in_range
from fingerpost.errors import InvalidInputError

LEAST_CUTOFF_HZ = 1e-3
"""Least cutoff [Hz]: such a filter is minutes late, a much lower one never converges in floating
point."""


class OneEuroFilter:
    """A One-Euro filter of a point.

    Parameters
    ----------
    min_cutoff_hz : float
        Cutoff for a point at rest [Hz], at least `LEAST_CUTOFF_HZ`. A lower one is smoother, with
        more delay.
    slope_hz_s : float
        Rise of the cutoff with speed [Hz per unit/s], ≥ 0: the paper's β.
    speed_cutoff_hz : float
        Cutoff of the speed's own low-pass [Hz], at least `LEAST_CUTOFF_HZ`.

    Raises
    ------
    InvalidInputError
        A parameter out of range.
    """

    def __init__(
        self,
        min_cutoff_hz: float = 1.0,
        slope_hz_s: float = 0.0,
        speed_cutoff_hz: float = 1.0,
    ) -> None:
        self._min_cutoff_hz = in_range(min_cutoff_hz, "min_cutoff_hz", LEAST_CUTOFF_HZ)
        self._slope_hz_s = in_range(slope_hz_s, "slope_hz_s", 0.0)
        self._speed_cutoff_hz = in_range(speed_cutoff_hz, "speed_cutoff_hz", LEAST_CUTOFF_HZ)
        self.reset()

    def reset(self) -> None:
        """Reset: the next point passes unchanged."""
        self._time_s: float | None = None
        self._point: NDArray[np.float64] | None = None
        self._velocity: NDArray[np.float64] | None = None
        self._lag_s = 0.0

    @property
    def lag_s(self) -> float:
        """Delay behind a uniformly moving point, at the present cutoff [s].

        The filter ``y ← y + α (x − y)`` follows a ramp at a distance of (1 − α) / α steps.
        """
        return self._lag_s

    def __call__(self, point: ArrayLike, time_s: float) -> NDArray[np.float64]:
        """Return the smoothed point (N,) at a time [s].

        Raises
        ------
        InvalidInputError
            The time is not after the last one.
        """
        point = finite_array(point, "point", ("N",))
        if self._time_s is None or self._point is None or self._velocity is None:
            self._time_s, self._point, self._velocity = time_s, point, np.zeros_like(point)
            return point
        step_s = time_s - self._time_s
        if not step_s > 0:
            raise InvalidInputError(f"time_s is {time_s}; a time after {self._time_s} is needed")
        measured = (point - self._point) / step_s
        self._velocity = self._velocity + _share(self._speed_cutoff_hz, step_s) * (
            measured - self._velocity
        )
        speed = float(np.linalg.norm(self._velocity))
        share = _share(self._min_cutoff_hz + self._slope_hz_s * speed, step_s)
        self._point = self._point + share * (point - self._point)
        self._time_s, self._lag_s = time_s, step_s * (1 - share) / share
        return self._point


def _share(cutoff_hz: float, step_s: float) -> float:
    """Return α of a first-order low-pass sampled at a step [s]."""
    return 1.0 / (1.0 + 1.0 / (2 * math.pi * cutoff_hz * step_s))
