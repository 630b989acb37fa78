"""Whether the operator is there."""

from __future__ import annotations

from collections.abc import Iterator
from enum import StrEnum

from fingerpost.pipeline import Step
from fingerpost.robot import Guard


class Attendance(StrEnum):
    """What shows that the operator is there; `Guard` stops the arm when it has been missing."""

    KEY = "key"
    """He holds a key down: a dead-man's switch."""
    HAND = "hand"
    """The hand that guides is tracked in a view; while the arm stands, it may be away."""


def attended_at_first(guard: Guard, steps: Iterator[Step]) -> Iterator[Step]:
    """Give steps; until there is the first, take it that the operator is there.

    The first frames take longest, on a slow computer longer than he may be missing, and before
    them nothing moves the arm.
    """
    with guard.attended():
        first = next(steps, None)
    if first is not None:
        yield first
        yield from steps
