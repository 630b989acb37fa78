"""Presence of the operator."""

from __future__ import annotations

from collections.abc import Iterator
from enum import StrEnum

from fingerpost.pipeline import Step
from fingerpost.robot import Guard


class Attendance(StrEnum):
    """Evidence of the operator's presence, in whose absence `Guard` stops the arm."""

    KEY = "key"
    """A key is held down: a dead-man's switch."""
    HAND = "hand"
    """The guiding hand is tracked in a view; it may be absent while the arm stands."""


def attended_at_first(guard: Guard, steps: Iterator[Step]) -> Iterator[Step]:
    """Yield steps; until the first one, assume that the operator is present.

    The first frames take longest, on a slow computer longer than the operator may be absent, and
    before them nothing moves the arm.
    """
    with guard.attended():
        first = next(steps, None)
    if first is not None:
        yield first
        yield from steps
