"""Whose hand it is: a hand that was followed is recognised by how it looked.

Colour, width and the side from which the arm enters the image are remembered while a finger is
followed. After the finger has been lost, what differs in colour or width does not take its place
for a while; and only what agrees in all three counts as the same hand.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np

from fingerpost._core import FingerLine
from fingerpost.capture import Frame
from fingerpost.finding.look import inside_levels

REMEMBERED_S = 5.0
"""How long a hand that is out of sight is remembered [s]; whoever comes later is somebody else."""

KEPT = 0.9
"""What the remembered looks keep from frame to frame: the memory of ten frames."""

CHROMATICITY_SPREAD = 0.08
"""Logarithm of a ratio of two channels by which one hand differs from itself in other light and
other places of the table, as a standard deviation."""

BRIGHTNESS_SPREAD = 0.5
"""The same for its brightness, shade and exposure included."""

WIDTH_SPREAD = 0.3
"""The same for its width in the image: a hand comes back nearer to the camera or farther away."""

ENTRY_SPREAD_RAD = 0.6
"""By how much the place where the line of its finger, led back, enters the image turns about the
image's centre, as a standard deviation [rad]."""

PRESENTED_FRAMES = 5
"""A hand that is at its template for so many frames in a row is held up to it; one that points
elsewhere passes."""

UNLIKE = 9.0
"""Squared distance of looks, in standard deviations, beyond which they are not one hand's."""

DARK = 16.0
"""Grey levels added before a ratio is taken: dark ones are mostly noise."""


class Looks(NamedTuple):
    """How a finger looks in one view.

    Attributes
    ----------
    levels : tuple
        Mean level of its inside, a channel each.
    half_width_px : float
        Half its width.
    entry_rad : float
        Direction from the image's centre to where its line, led back, enters the image.
    """

    levels: tuple[float, ...]
    half_width_px: float
    entry_rad: float

    @classmethod
    def of(cls, frame: Frame, line: FingerLine, half_width_px: float) -> Looks | None:
        """Return how a finger looks in a frame; None where too little of its inside is seen."""
        levels = inside_levels(frame, line, half_width_px)
        if levels is None:
            return None
        height_px, width_px = frame.image.shape[:2]
        entry_rad = _entry_rad(line, width_px, height_px)
        return cls(tuple(levels.mean(axis=0).tolist()), half_width_px, entry_rad)

    def blended(self, now: Looks) -> Looks:
        """Return these looks brought up to date by those of one more frame."""
        turn_rad = math.remainder(now.entry_rad - self.entry_rad, 2 * math.pi)
        levels = (KEPT * a + (1 - KEPT) * b for a, b in zip(self.levels, now.levels, strict=True))
        half_width_px = KEPT * self.half_width_px + (1 - KEPT) * now.half_width_px
        return Looks(tuple(levels), half_width_px, self.entry_rad + (1 - KEPT) * turn_rad)

    def unlike(self, other: Looks) -> float:
        """Return the squared distance of colour and width, in standard deviations."""
        if len(self.levels) != len(other.levels):
            return 0.0  # a camera that switches between grey and colour: nothing is known
        one, two = (np.log(np.add(looks.levels, DARK)) for looks in (self, other))
        change = one - two
        brightness = change.mean() / BRIGHTNESS_SPREAD
        chromaticity = (change - change.mean()) / CHROMATICITY_SPREAD
        width = math.log(self.half_width_px / other.half_width_px) / WIDTH_SPREAD
        return float(brightness**2 + width**2 + (chromaticity**2).sum())

    def is_same_hand(self, other: Looks) -> bool:
        """Say whether both may be one hand's, the side from which it comes included."""
        turn_rad = math.remainder(self.entry_rad - other.entry_rad, 2 * math.pi)
        return self.unlike(other) + (turn_rad / ENTRY_SPREAD_RAD) ** 2 <= UNLIKE


def _entry_rad(line: FingerLine, width_px: int, height_px: int) -> float:
    centre = np.array([(width_px - 1) / 2, (height_px - 1) / 2])
    away = -np.array([math.cos(line.angle_rad), math.sin(line.angle_rad)])
    start = np.asarray(line.tip_px) - centre
    with np.errstate(divide="ignore"):
        ways = (np.copysign(centre, away) - start) / away
    entry = start + max(min(ways), 0.0) * away
    return math.atan2(entry[1], entry[0])


class Memory:
    """What a view remembers of the hand that it has followed."""

    def __init__(self) -> None:
        self._looks: Looks | None = None
        self._seen_s = -math.inf

    def learn(self, looks: Looks | None, time_s: float) -> None:
        """Learn from how the hand looks at a time; what is unlike it teaches nothing."""
        if looks is None:
            return
        known = self._remembered(time_s)
        if known is None:
            self._looks, self._seen_s = looks, time_s
        elif known.unlike(looks) <= UNLIKE:
            self._looks, self._seen_s = known.blended(looks), time_s

    def may_be(self, looks: Looks | None, time_s: float) -> bool:
        """Say whether what looks so may be the hand; anything may where none is remembered."""
        known = self._remembered(time_s)
        return known is None or looks is None or known.unlike(looks) <= UNLIKE

    def recognises(self, looks: Looks | None, time_s: float) -> bool:
        """Say whether a hand is remembered that looks so, and comes from the same side."""
        known = self._remembered(time_s)
        return known is not None and looks is not None and known.is_same_hand(looks)

    def _remembered(self, time_s: float) -> Looks | None:
        return self._looks if time_s - self._seen_s <= REMEMBERED_S else None


class Hand(NamedTuple):
    """The hand that is followed.

    Attributes
    ----------
    number : int
        Counts the hands that have been followed, from 1; one that is recognised keeps its number.
        0 before the first.
    is_presented : bool
        Whether it has been held up to its template, in every view that has one and follows it,
        and is a hand beyond doubt: it has come or moved.
    """

    number: int = 0
    is_presented: bool = False


class IdentifiedView(Protocol):
    """What is asked here of a view."""

    @property
    def shows_finger(self) -> bool:
        """Whether it follows a finger that shows in this frame."""

    @property
    def is_sure(self) -> bool:
        """Whether what it follows, if anything, is a hand and not perhaps the table."""

    @property
    def is_recognised(self) -> bool:
        """Whether what it follows looks like the hand that it has followed before."""

    @property
    def is_presented(self) -> bool | None:
        """Whether the hand it follows is held up to the rig's template; None if that has none."""


class Identity:
    """Counts the hands that the views of a rig follow."""

    def __init__(self) -> None:
        self.hand = Hand()
        self._is_followed = False
        self._presented_frames = 0
        self._was_held_up = False
        self._seen_s = -math.inf

    def update(self, views: Sequence[IdentifiedView], time_s: float) -> None:
        """Take what the views follow at a time: one hand as long as any of them follows it."""
        following = [view for view in views if view.shows_finger]
        if following:
            if not self._is_followed and not self._is_known(following, time_s):
                self.hand, self._was_held_up = Hand(self.hand.number + 1), False
            self._look_at_template(following)
            is_presented = self._was_held_up and all(view.is_sure for view in following)
            if is_presented and not self.hand.is_presented:
                self.hand = self.hand._replace(is_presented=True)
            self._seen_s = time_s
        self._is_followed = bool(following)

    def _look_at_template(self, following: Sequence[IdentifiedView]) -> None:
        """Count the frames in a row in which the hand is at its template."""
        presented = [p for view in following if (p := view.is_presented) is not None]
        is_there = bool(presented) and all(presented)
        self._presented_frames = self._presented_frames + 1 if is_there else 0
        self._was_held_up |= self._presented_frames >= PRESENTED_FRAMES

    def _is_known(self, views: Sequence[IdentifiedView], time_s: float) -> bool:
        is_recent = time_s - self._seen_s <= REMEMBERED_S
        return is_recent and all(view.is_recognised for view in views)
