"""Whether the operator is there, and recordings played as if live."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from enum import StrEnum

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

    No frame is left out. Where the caller works longer on a frame than the recording lasts, the
    recording waits, and everything after it is due later: what is seen of it does not depend on
    the speed of the computer, and no frame is old when it is given.

    Parameters
    ----------
    frames
        Of recorded views.
    clock
        The time to stamp them with [s]; the first frame is due at once.
    sleep
        Waits for so many seconds of it.
    """
    begin_s = -math.inf  # of the recording, in the time of the clock
    for together in frames:
        last_s = max((frame.time_s for frame in together if frame is not None), default=math.nan)
        if not math.isnan(last_s):
            begin_s = max(begin_s, clock() - last_s)
        if (early_s := begin_s + last_s - clock()) > 0:
            sleep(early_s)
        yield [
            None if frame is None else replace(frame, time_s=begin_s + frame.time_s)
            for frame in together
        ]
