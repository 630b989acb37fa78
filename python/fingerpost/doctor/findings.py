"""Findings about a rig, as data, as lines of text and as JSON."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Any


class Severity(StrEnum):
    """How much a finding matters."""

    ERROR = "error"
    """It prevents tracking or pointing."""
    WARNING = "warning"
    """It costs accuracy, or will lose the hand now and then."""


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
    """Something that is wrong.

    Attributes
    ----------
    severity
        How much it matters.
    check
        What was looked at.
    view
        Name of the view, or empty where it concerns several.
    what
        What is wrong, with the value found.
    right
        What would be right.
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
        How many were looked at.
    size_px
        Width and height.
    frames_per_s
        Median rate.
    grey_percentiles
        1st, 50th and 95th percentile of the grey levels in the region that counts.
    clipped
        Share of its pixels at the brightest level, 0 to 1.
    noise
        Standard deviation of the image noise [grey levels].
    blur_px
        Standard deviation of the blur of the sharper edges [px].
    hand_found
        Whether the tracker settled on a hand.
    contrast
        Of the finger against what is beside it [grey levels].
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
        What was measured, one per view.
    findings
        What is wrong, the gravest first; empty if nothing is.
    notes
        What else there is to say of the pictures: how they are scaled.
    """

    readings: tuple[ViewReadings, ...]
    findings: tuple[Finding, ...]
    notes: tuple[str, ...] = ()

    @property
    def serious(self) -> bool:
        """Whether something prevents tracking or pointing."""
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
        """Return everything for programs, fit for JSON."""
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
