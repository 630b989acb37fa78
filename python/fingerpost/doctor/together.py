"""Test by the main loop itself whether a hand is found, and whether the views show one time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import zip_longest

from fingerpost.capture import Frame
from fingerpost.config import Rig
from fingerpost.consistency import unannounced
from fingerpost.doctor.findings import Check, Finding, Severity
from fingerpost.errors import FingerpostError
from fingerpost.pipeline import Pointer
from fingerpost.pointing import FingerLine

FEWEST_FRAMES = 3
"""Least number of frames to detect motion and repeated pictures."""

FINDING_FRAMES = 30
"""Least number of frames without a hand to say so: one that has just come is tested for some."""


@dataclass(frozen=True, slots=True)
class Tracked:
    """Result of the main loop.

    Attributes
    ----------
    found
        Whether a hand was found in each view; None after too few frames without one.
    notes
        Remarks of the pointer.
    """

    found: tuple[bool | None, ...]
    notes: tuple[str, ...]


def track_together(rig: Rig, frames: Sequence[Sequence[Frame]]) -> Tracked | None:
    """Run the main loop; return None for an unusable rig, or with too few frames."""
    if min(map(len, frames)) < FEWEST_FRAMES:
        return None
    found = [False] * len(frames)
    with unannounced():
        try:
            pointer = Pointer(rig)
            for together in zip_longest(*frames):
                for step in pointer.update(together):
                    for k, one in enumerate(step.observations):
                        found[k] |= isinstance(one.finger, FingerLine)
        except FingerpostError:
            return None
    is_long = min(map(len, frames)) >= FINDING_FRAMES
    return Tracked(tuple(one if one or is_long else None for one in found), tuple(pointer.notes()))


def judge_tracked(rig: Rig, tracked: Tracked, frames: int) -> Iterator[Finding]:
    """Find views without a hand, that lag behind others, or that repeat pictures."""
    for view, found in zip(rig.views, tracked.found, strict=True):
        if found is False and view.start is None:  # a start has tests of its own
            yield Finding(
                Severity.WARNING,
                Check.HAND,
                view.name,
                f"no hand is found in {frames} frames",
                "point at the plane with a stretched index finger, unlike the table in colour or "
                "brightness and without stripes; if it comes later, look at more frames",
            )
    for note in tracked.notes:
        what, _, right = note.partition("; ")
        yield Finding(Severity.WARNING, Check.TIMING, "", what, right)
