"""Published form of a fix: flat, with all data that a receiver needs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import msgspec
import numpy as np
from numpy.typing import NDArray

from fingerpost.formats import UNITS_MM


class PublishedFix(msgspec.Struct, frozen=True, kw_only=True):
    """The fix of one frame, as in JSON.

    Attributes
    ----------
    frame
        Index in the source of the first view.
    time_s
        Time of the fix [s]: since the start of a recording, or on the machine's monotonic clock for
        live views.
    unix_time_s
        The same since 1970; None for recordings.
    status
        `ok`, `acquiring`, `lost` or `ill_conditioned`.
    unit
        Unit of the plane.
    x, y
        Indicated point [plane units]; None without one.
    cov_xx, cov_xy, cov_yy
        Its covariance [plane units²]; None if unknown.
    crossing_angle_deg
        Angle at which the constraint lines cross, 0 to 90.
    target
        The most probable target; None if it is more probable that there is none.
    reason
        Why the status is not `ok`; else empty.
    """

    frame: int
    time_s: float
    unix_time_s: float | None = None
    status: str
    unit: str
    x: float | None = None
    y: float | None = None
    cov_xx: float | None = None
    cov_xy: float | None = None
    cov_yy: float | None = None
    crossing_angle_deg: float | None = None
    target: str | None = None
    reason: str = ""

    @property
    def is_recorded(self) -> bool:
        """Whether it comes from recorded views."""
        return self.unix_time_s is None

    @property
    def point(self) -> tuple[float, float] | None:
        """Indicated point [plane units]; None without a usable one."""
        return None if self.x is None or self.y is None else (self.x, self.y)

    @property
    def covariance(self) -> NDArray[np.float64] | None:
        """Covariance (2, 2) of the point [plane units²]."""
        if self.cov_xx is None or self.cov_xy is None or self.cov_yy is None:
            return None
        return np.array([[self.cov_xx, self.cov_xy], [self.cov_xy, self.cov_yy]])

    @property
    def stamp_ns(self) -> int:
        """Time since 1970, or since the start of a recording, never below 0 [ns]."""
        time_s = self.time_s if self.unix_time_s is None else self.unix_time_s
        return max(0, round(1e9 * time_s))

    def as_json(self) -> bytes:
        """Return one JSON object, without a line's end."""
        return msgspec.json.encode(self)


class Picture(Protocol):
    """A frame of a view, as in `fingerpost.capture`."""

    @property
    def index(self) -> int:
        """Index in its source."""

    @property
    def time_s(self) -> float:
        """Capture time [s]."""

    @property
    def image(self) -> NDArray[np.uint8]:
        """Grey or blue-green-red."""

    @property
    def encoded(self) -> bytes:
        """The JPEG or PNG that it was received as; else empty."""


Pictures = Sequence[tuple[str, Picture]]
"""Views and their newest frames."""


@dataclass(frozen=True, slots=True)
class Extent:
    """The rectangle about a plane's reference points, and its unit.

    Attributes
    ----------
    lower, upper
        Least and largest coordinates [plane units].
    unit
        Unit of the plane.
    """

    lower: tuple[float, float]
    upper: tuple[float, float]
    unit: str

    @classmethod
    def of(cls, points: Sequence[Sequence[float]], unit: str) -> Extent:
        """Return the extent of reference points."""
        (x_min, y_min), (x_max, y_max) = np.min(points, axis=0), np.max(points, axis=0)
        return cls((float(x_min), float(y_min)), (float(x_max), float(y_max)), unit)

    @property
    def unit_m(self) -> float | None:
        """Length of the unit [m]; None for a name that is not a unit of length."""
        length_mm = UNITS_MM.get(self.unit)
        return None if length_mm is None else length_mm / 1e3
