"""Whether the views show one hand at one time: the main loop itself is asked."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import zip_longest

from fingerpost.capture import Frame
from fingerpost.config import Rig
from fingerpost.consistency import unannounced
from fingerpost.doctor.findings import Check, Finding, Severity
from fingerpost.errors import FingerpostError
from fingerpost.pipeline import Pointer

FEWEST_FRAMES = 3
"""With fewer nothing is seen to move, and no picture to be given out again and again."""


def judge_times_by_motion(rig: Rig, frames: Sequence[Sequence[Frame]]) -> Iterator[Finding]:
    """Say which views lag behind others, or hand out old pictures, by how the hand moves.

    Nothing is said of a rig that cannot point, nor where no hand is seen to move in both views.
    """
    if min(map(len, frames)) < FEWEST_FRAMES:
        return
    with unannounced():
        try:
            pointer = Pointer(rig)
            for together in zip_longest(*frames):
                pointer.update(together)
        except FingerpostError:
            return
    for note in pointer.notes():
        what, _, right = note.partition("; ")
        yield Finding(Severity.WARNING, Check.TIMING, "", what, right)
