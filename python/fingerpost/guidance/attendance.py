"""Whether the operator is there, and recordings played as if live."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from enum import StrEnum
from itertools import chain, pairwise, zip_longest

from fingerpost.capture import Frame, Loss
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


def paced(
    frames: Iterator[Sequence[Frame | Loss | None]],
    clock: Callable[[], float],
    sleep: Callable[[float], None],
) -> Iterator[Sequence[Frame | Loss | None]]:
    """Play a recording as if it were live: each frame when it is due, and stamped with that time.

    Whoever is slower than the recording misses frames, as with cameras: of those that are due by
    the time he asks for the next, each view's newest is given. Otherwise he would see the hand ever
    later.

    Parameters
    ----------
    frames
        Of recorded views.
    clock
        The time to stamp them with [s]; the first frame is due at once.
    sleep
        Waits for so many seconds of it.
    """
    begin_s = math.nan  # nothing is before or after it: until there is a frame, none is due
    newest: Sequence[Frame | Loss | None] = ()
    for together, following in pairwise(chain(frames, [()])):
        newest = [old if new is None else new for new, old in zip_longest(together, newest)]
        if math.isnan(begin_s):
            begin_s = clock() - _last_s(newest)
        if begin_s + _last_s(following) <= clock():
            continue
        if (early_s := begin_s + _last_s(newest) - clock()) > 0:
            sleep(early_s)
        yield [
            None if frame is None else replace(frame, time_s=begin_s + frame.time_s)
            for frame in newest
        ]
        newest = ()


def _last_s(frames: Sequence[Frame | Loss | None]) -> float:
    return max((frame.time_s for frame in frames if frame is not None), default=math.nan)
