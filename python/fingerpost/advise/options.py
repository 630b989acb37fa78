"""Options of the advisor about hands, images and units."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from fingerpost.checks import in_range
from fingerpost.errors import InvalidInputError
from fingerpost.formats import UNITS_MM
from fingerpost.pipeline import DEFAULT_REFERENCE_SIGMA_PX
from fingerpost.pointing import UNSEEN_HAND, PointingOptions
from fingerpost.simulate import PoseLimits

LEAST = 1e-6
"""Negligible noise and error of reference points [grey levels, px], whose squares are still far
above the least float."""

STRICT = replace(UNSEEN_HAND, max_sigma=0.05)
"""Stricter options than those of tracking, so that cameras are placed well."""


@dataclass(frozen=True, kw_only=True)
class AdviceOptions:
    """Options; the defaults are the hand of the accuracy experiment in an ordinary picture."""

    poses: PoseLimits = field(default_factory=PoseLimits)
    """Expected hover, slant and azimuth, the angle to the viewing ray below which a finger is seen
    end-on, and its least distance from the edge of an image."""

    length_mm: float = 80.0
    """Straight, visible part of the index finger [mm], 1 to 1000."""

    diameter_mm: float = 16.0
    """Its thickness [mm], 0.1 to 1000, below `length_mm`."""

    contrast: float = 80.0
    """Contrast of the finger against the background [grey levels], 0.1 to 255."""

    noise: float = 2.0
    """Standard deviation of the image noise [grey levels], `LEAST` to 255."""

    blur_px: float = 1.0
    """Standard deviation of the point spread function [px], 0 to 100."""

    efficiency: float = 0.6
    """Ratio of the least possible variance of a finger line's angle to the tracker's, 0.001 to 1.
    `fingerpost experiment` measures it: "angle variance, bound / meas."."""

    reference_sigma_px: float = DEFAULT_REFERENCE_SIGMA_PX
    """Standard deviation of each reference point in u and in v [px], `LEAST` to 1000."""

    pointing: PointingOptions = STRICT
    """Conditions for a point, and the allowance for bias."""

    unit_mm: float | None = None
    """Length of a plane unit [mm], 1e-6 to 1e6; None: by the unit's name."""

    cells: int = 7
    """Cells of the map along the longer side of the workspace, 2 to 50."""

    sectors: int = 36
    """Number of pointing directions, 8 to 360."""

    samples: int = 300
    """Number of poses by which moves of the cameras are compared, 10 to 100,000."""

    def __post_init__(self) -> None:
        for name, low, high in (
            ("length_mm", 1.0, 1000.0),
            ("diameter_mm", 0.1, 1000.0),
            ("contrast", 0.1, 255.0),
            ("noise", LEAST, 255.0),
            ("blur_px", 0.0, 100.0),
            ("efficiency", 1e-3, 1.0),
            ("reference_sigma_px", LEAST, 1000.0),
        ):
            in_range(getattr(self, name), name, low, high)
        if self.diameter_mm >= self.length_mm:
            raise InvalidInputError(
                f"diameter_mm is {self.diameter_mm:g} with length_mm {self.length_mm:g}; a finger "
                "is longer than wide"
            )
        if self.unit_mm is not None:
            in_range(self.unit_mm, "unit_mm", 1e-6, 1e6)
        for name, least, most in (("cells", 2, 50), ("sectors", 8, 360), ("samples", 10, 100_000)):
            value = getattr(self, name)
            if not isinstance(value, int) or not least <= value <= most:
                raise InvalidInputError(
                    f"{name} is {value!r}; a whole number from {least} to {most}"
                )

    def unit_length_mm(self, unit: str) -> float:
        """Length of a plane unit [mm].

        Raises
        ------
        InvalidInputError
            Its name gives no length, and `unit_mm` is not given.
        """
        if self.unit_mm is not None:
            return self.unit_mm
        if unit not in UNITS_MM:
            raise InvalidInputError(
                f'plane.unit is "{unit}", which is no known length; a hand has millimetres: give '
                f"unit_mm, the length of a unit in mm, or one of {', '.join(UNITS_MM)}"
            )
        return UNITS_MM[unit]
