"""Findings about a rig, as data, as lines of text and as JSON."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Any


class Severity(StrEnum):
    """Severity of a finding."""

    ERROR = "error"
    """It prevents tracking or pointing."""
    WARNING = "warning"
    """It reduces accuracy, or loses the hand at times."""


class Check(StrEnum):
    """Subject of a finding."""

    PICTURES = "pictures"
    EXPOSURE = "exposure"
    NOISE = "noise"
    FOCUS = "focus"
    CONTRAST = "contrast"
    HAND = "hand"
    REFERENCES = "references"
    LENS = "lens"
    TIMING = "timing"


@dataclass(frozen=True, slots=True)
class Finding:
    """A problem.

    Attributes
    ----------
    severity
        Its severity.
    check
        Its subject.
    view
        Name of the view; empty if it concerns several.
    what
        The problem, with the measured value.
    right
        The remedy.
    """

    severity: Severity
    check: Check
    view: str
    what: str
    right: str

    def __str__(self) -> str:
        place = f"{self.view}: " if self.view else ""
        return f"{self.severity.value}: {place}{self.what}; {self.right}"


@dataclass(frozen=True, slots=True)
class ViewReadings:
    """Measurements of one view; None where not measurable.

    Attributes
    ----------
    view
        Its name.
    frames
        Number of examined frames.
    size_px
        Width and height.
    frames_per_s
        Median rate.
    grey_percentiles
        1st, 50th and 95th percentile of the grey levels in the region of interest.
    clipped
        Share of its pixels at the brightest level, 0 to 1.
    noise
        Standard deviation of the image noise [grey levels].
    blur_px
        Standard deviation of the blur of the sharper edges [px].
    hand_found
        Whether the tracker confirmed a hand; None after too few frames, or if it did not run,
        because of other problems.
    contrast
        Contrast of the finger against its surroundings [grey levels].
    finger_px
        Visible length of the index finger [px].
    """

    view: str
    frames: int
    size_px: tuple[int, int]
    frames_per_s: float | None
    grey_percentiles: tuple[float, float, float]
    clipped: float
    noise: float
    blur_px: float | None
    hand_found: bool | None
    contrast: float | None
    finger_px: float | None


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """Result of the examination of a rig.

    Attributes
    ----------
    readings
        Measurements, one per view.
    findings
        Problems, the gravest first; empty if there are none.
    notes
        Further remarks on the pictures, such as their scaling.
    """

    readings: tuple[ViewReadings, ...]
    findings: tuple[Finding, ...]
    notes: tuple[str, ...] = ()

    @property
    def serious(self) -> bool:
        """Whether a problem prevents tracking or pointing."""
        return any(finding.severity is Severity.ERROR for finding in self.findings)

    def table(self) -> list[str]:
        """Return everything as lines of text."""
        head = (
            f"{'view':<12}{'size':>12}{'frames/s':>10}{'grey 1/50/95 %':>16}{'clipped':>9}"
            f"{'noise':>7}{'blur px':>9}{'hand':>6}{'contrast':>10}{'finger px':>11}"
        )
        rows = [head, *(_row(reading) for reading in self.readings), "", *self.notes]
        if not self.findings:
            return [*rows, "nothing is wrong"]
        return [*rows, *(str(finding) for finding in self.findings)]

    def as_dict(self) -> dict[str, Any]:
        """Return everything for programs, as JSON values."""
        return {
            "serious": self.serious,
            "readings": [asdict(reading) for reading in self.readings],
            "findings": [asdict(finding) for finding in self.findings],
            "notes": list(self.notes),
        }


def _row(reading: ViewReadings) -> str:
    width, height = reading.size_px
    levels = "/".join(f"{level:.0f}" for level in reading.grey_percentiles)
    hand = {True: "yes", False: "no", None: "–"}[reading.hand_found]
    return (
        f"{reading.view:<12}{f'{width} × {height}':>12}{_cell(reading.frames_per_s, 1):>10}"
        f"{levels:>16}{reading.clipped:>9.1%}{reading.noise:>7.1f}{_cell(reading.blur_px, 2):>9}"
        f"{hand:>6}{_cell(reading.contrast, 0):>10}{_cell(reading.finger_px, 0):>11}"
    )


def _cell(value: float | None, digits: int) -> str:
    return "–" if value is None else f"{value:.{digits}f}"
