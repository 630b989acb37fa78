"""Test whether the views show one hand at one time, by the main loop itself."""

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
"""Least number of frames to detect motion and repeated pictures."""


def judge_times_by_motion(rig: Rig, frames: Sequence[Sequence[Frame]]) -> Iterator[Finding]:
    """Find views that lag behind others or repeat pictures, by the motion of the hand.

    Nothing is found for an unusable rig, or without a moving hand in both views.
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
