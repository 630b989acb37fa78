"""Whether both flanks of a followed finger show, and where its axis lies if they do not."""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np

from fingerpost._core import FingerLine, RoundFinger, Track
from fingerpost.capture import Frame
from fingerpost.finding.finger import Aside, fitted_half_width_px
from fingerpost.finding.look import softness

LOOK_EVERY = 4
"""One frame in so many is looked at."""

SOFT_RATE = 0.5
"""How soft the flanks are in one of them counts that much of what is known."""

SOFTER = (0.29, 0.35)
"""How much softer the one flank of a finger is than the other, from where it may be none, and from
where it is none [half-widths]: mostly below 0.2 of real and rendered fingers in the shade, and 0.28
at most. A hand of the table's brightness, which shows where it turns from the light and not where
it ends, has 0.3 to 0.38."""

LOOKS = 5
"""So many looks at the shading together tell, by their median: one in some lands elsewhere."""

RARELY = 3
"""While no look has told of a flank that does not show, one time in so many is enough."""

BETTER = 1.2
"""How many times as well as one about the line between the edges a round finger aside of it must
explain what is seen. Where both flanks show, one does up to 1.1 times as well, where one does not,
1.3 to 8 times."""

LEAST_ASIDE = 0.15
LEAST_WIDER = 0.1
"""How far aside [half-widths], and how much wider by its logarithm, a finger is one of whose flanks
does not show. Less is told better by the edges of both."""

MOST_WIDER = 0.8
MOST_TURN_RAD = 0.1
"""What is wider, or turned by more, is not the finger that is followed."""

MOST_HIDDEN = 1.5
"""So many times as much of the finger as when it was looked at may be hidden a few frames later."""

UNSURE = 0.08
"""How far off the axis of such a finger may be [half-widths]: in films mostly 0.03, and up to 0.1;
it is turned by 1 to 2 degrees."""


class Shaded(NamedTuple):
    """What the shading across a finger tells, one of whose flanks does not show."""

    offset_px: float
    """How far its axis runs beside the line between the edges that show, to the side of the normal
    (−sin, cos) [px]."""
    turn_rad: float
    """By how much it is turned against that line."""
    half_width_px: float
    """Half its width [px]."""
    shown_px: float
    """Half the way from one of those edges to the other [px]."""

    @classmethod
    def of(cls, frame: Frame, line: FingerLine, half_width_px: float) -> Shaded | None:
        """Look at the shading across a finger.

        Parameters
        ----------
        frame
            What shows it: its colours, if it has any.
        line, half_width_px
            The line between the edges that show, and half the way from one to the other [px].

        Returns
        -------
        Shaded or None
            None where it says no more than the edges do: both flanks show.
        """
        finger = line.anchor_px, line.tip_px, half_width_px
        seen = RoundFinger.fit(frame.grey(), *finger, frame.colour())
        if seen is None or seen.misfit_about_given <= BETTER * seen.misfit:
            return None
        aside, wider = seen.offset_px / half_width_px, math.log(seen.half_width_px / half_width_px)
        if abs(aside) < LEAST_ASIDE or not LEAST_WIDER <= wider <= MOST_WIDER:
            return None
        if abs(seen.turn_rad) > MOST_TURN_RAD:
            return None
        return cls(seen.offset_px, seen.turn_rad, seen.half_width_px, half_width_px)

    def beside_edges(self, half_width_px: float) -> Aside:
        """Tell how its axis lies to the line between edges that are perhaps others by now.

        As soon as both flanks show, the edges are as far apart as it is wide, and the line between
        them is its axis.
        """
        hidden = (self.half_width_px - half_width_px) / (self.half_width_px - self.shown_px)
        part = min(max(hidden, 0.0), MOST_HIDDEN)
        return Aside(
            part * self.offset_px / half_width_px,
            part * self.turn_rad,
            math.log(self.half_width_px / half_width_px) if part > 0.0 else 0.0,
        )


class Flanks:
    """What is learned of the flanks of the finger that a view follows.

    An outline is as sharp as the picture. One flank that shades off where the other is sharp is
    none (`softness`): the axis may be off by as much as half the width. Where the shading across
    the finger tells how wide it is (`fingerpost._core.RoundFinger`), the axis is known again.
    """

    def __init__(self) -> None:
        self._frames = 0
        self.forget()

    def forget(self) -> None:
        """Know nothing: another finger will be followed, or none."""
        # How much softer one flank has been lately than the other; None where that is not known.
        self._softer: float | None = None
        self._looks: deque[Shaded | None] = deque(maxlen=LOOKS)
        self._half_width_px = 0.0
        # What the looks say together; None while most of them tell of no flank that does not show.
        self._shaded: Shaded | None = None
        self._spread_px = 0.0

    @property
    def aside(self) -> Aside:
        """How the axis lies to the line between the edges that show."""
        if self._shaded is None:
            return Aside(off=off_by_softness(self._softer or 0.0))
        off = math.hypot(UNSURE, self._spread_px / self._half_width_px)
        return self._shaded.beside_edges(self._half_width_px)._replace(off=off)

    def look(self, frame: Frame, track: Track | None) -> None:
        """Learn from a frame, if it is one of those that are looked at."""
        self._frames += 1
        line = track.finger_line if track is not None else None
        half_width_px = fitted_half_width_px(track) if track is not None else None
        if line is None or half_width_px is None:
            return
        self._half_width_px = half_width_px
        looks, skipped = divmod(self._frames, LOOK_EVERY)
        if not skipped or self._softer is None:
            self._compare(softness(frame, line, half_width_px))
        is_rare = len(self._looks) == LOOKS and not any(self._looks)
        if not self._looks or not (skipped or (is_rare and looks % RARELY)):
            self._looks.append(Shaded.of(frame, line, half_width_px))
            self._agree()

    def _agree(self) -> None:
        """Work out what most of the looks say, if they do."""
        told = [look for look in self._looks if look is not None]
        if 2 * len(told) <= len(self._looks):
            self._shaded = None
            return
        looks = np.array(told)
        self._shaded = Shaded(*np.median(looks, axis=0).tolist())
        off_px = np.abs(looks[:, 0] - self._shaded.offset_px)
        self._spread_px = 1.4826 * float(np.median(off_px))

    def _compare(self, softer: float) -> None:
        """Learn how much softer one flank is than the other; NaN tells nothing."""
        if np.isfinite(softer):
            before = softer if self._softer is None else self._softer
            self._softer = before + SOFT_RATE * (softer - before)


def off_by_softness(softer: float) -> float:
    """Return how far a finger's axis may be off if one flank is that much softer than the other.

    Parameters
    ----------
    softer
        See `fingerpost.finding.look.softness` [half-widths²].

    Returns
    -------
    float
        [half-widths]
    """
    low, high = SOFTER
    return min(max((math.sqrt(abs(softer)) - low) / (high - low), 0.0), 1.0)
