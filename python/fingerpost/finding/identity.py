"""Identity of the hand: a hand is recognised by its appearance.

Colour, width and the direction from which the arm enters the image are averaged while a finger is
followed. For `MEMORY_S` after its loss, a detection of another colour or width is not accepted in
its place, and only one that agrees in all three is the same hand.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np

from fingerpost._core import FingerLine
from fingerpost.capture import Frame
from fingerpost.finding.pixel_tests import inside_levels

MEMORY_S = 5.0
"""Time after which a lost hand is forgotten [s]; a later one is another person's."""

KEPT = 0.9
"""Factor of the previous mean in the running mean of the appearance: ten frames."""

CHROMATICITY_SPREAD = 0.08
"""Standard deviation of the logarithm of the ratio of two channels of one hand, under other light
and at other places of the table."""

BRIGHTNESS_SPREAD = 0.5
"""Standard deviation of the logarithm of its brightness, shade and exposure included."""

WIDTH_SPREAD = 0.3
"""Standard deviation of the logarithm of its image width: the distance to the camera varies."""

ENTRY_SPREAD_RAD = 0.6
"""Standard deviation of the direction from the image centre to the point where the finger line,
extended backwards, enters the image [rad]."""

PRESENTED_FRAMES = 5
"""Consecutive frames at its template after which a hand is held up to it; a hand that only passes
stays for fewer."""

MAX_SQUARED_DISTANCE = 9.0
"""Greatest squared Mahalanobis distance of the appearances of one hand."""

DARK = 16.0
"""Grey levels added before a ratio is taken: dark levels are mostly noise."""


class Appearance(NamedTuple):
    """Appearance of a finger in one view.

    Attributes
    ----------
    levels : tuple
        Mean level of its inside in each channel.
    half_width_px : float
        Half its width.
    entry_rad : float
        Direction from the image centre to where its line, extended backwards, enters the image.
    """

    levels: tuple[float, ...]
    half_width_px: float
    entry_rad: float

    @classmethod
    def of(cls, frame: Frame, line: FingerLine, half_width_px: float) -> Appearance | None:
        """Measure a finger's appearance; None where too little of its inside is visible."""
        levels = inside_levels(frame, line, half_width_px)
        if levels is None:
            return None
        height_px, width_px = frame.image.shape[:2]
        entry_rad = _entry_rad(line, width_px, height_px)
        return cls(tuple(levels.mean(axis=0).tolist()), half_width_px, entry_rad)

    def updated(self, now: Appearance) -> Appearance:
        """Return the running mean after one more frame."""
        turn_rad = math.remainder(now.entry_rad - self.entry_rad, 2 * math.pi)
        levels = (KEPT * a + (1 - KEPT) * b for a, b in zip(self.levels, now.levels, strict=True))
        half_width_px = KEPT * self.half_width_px + (1 - KEPT) * now.half_width_px
        return Appearance(tuple(levels), half_width_px, self.entry_rad + (1 - KEPT) * turn_rad)

    def squared_distance(self, other: Appearance) -> float:
        """Return the squared Mahalanobis distance of colour and width."""
        if len(self.levels) != len(other.levels):
            return 0.0  # the camera has switched between grey and colour: not comparable
        one, two = (np.log(np.add(appearance.levels, DARK)) for appearance in (self, other))
        change = one - two
        brightness = change.mean() / BRIGHTNESS_SPREAD
        chromaticity = (change - change.mean()) / CHROMATICITY_SPREAD
        width = math.log(self.half_width_px / other.half_width_px) / WIDTH_SPREAD
        return float(brightness**2 + width**2 + (chromaticity**2).sum())

    def is_same_hand(self, other: Appearance) -> bool:
        """Whether both may be of one hand, the direction of entry included."""
        turn_rad = math.remainder(self.entry_rad - other.entry_rad, 2 * math.pi)
        return (
            self.squared_distance(other) + (turn_rad / ENTRY_SPREAD_RAD) ** 2
            <= MAX_SQUARED_DISTANCE
        )


def _entry_rad(line: FingerLine, width_px: int, height_px: int) -> float:
    centre = np.array([(width_px - 1) / 2, (height_px - 1) / 2])
    away = -np.array([math.cos(line.angle_rad), math.sin(line.angle_rad)])
    start = np.asarray(line.tip_px) - centre
    with np.errstate(divide="ignore"):
        ways = (np.copysign(centre, away) - start) / away
    entry = start + max(min(ways), 0.0) * away
    return math.atan2(entry[1], entry[0])


class Memory:
    """Mean appearance of the hand that a view has followed."""

    def __init__(self) -> None:
        self._appearance: Appearance | None = None
        self._seen_s = -math.inf

    def learn(
        self, appearance: Appearance | None, time_s: float, *, is_certain: bool = True
    ) -> None:
        """Update the mean; an appearance beyond `MAX_SQUARED_DISTANCE` changes nothing.

        One that is not certain to be a hand's, such as that of a forearm whose finger is hidden, is
        not remembered in place of a forgotten one: the finger would not be accepted afterwards.
        """
        if appearance is None:
            return
        known = self._recent(time_s)
        if known is None:
            if is_certain:
                self._appearance, self._seen_s = appearance, time_s
        elif known.squared_distance(appearance) <= MAX_SQUARED_DISTANCE:
            self._appearance, self._seen_s = known.updated(appearance), time_s

    def is_compatible(self, appearance: Appearance | None, time_s: float) -> bool:
        """Whether an appearance may be the hand's; True if none is remembered."""
        known = self._recent(time_s)
        return (
            known is None
            or appearance is None
            or known.squared_distance(appearance) <= MAX_SQUARED_DISTANCE
        )

    def recognises(self, appearance: Appearance | None, time_s: float) -> bool:
        """Whether a hand of this appearance and direction of entry is remembered."""
        known = self._recent(time_s)
        return known is not None and appearance is not None and known.is_same_hand(appearance)

    def _recent(self, time_s: float) -> Appearance | None:
        return self._appearance if time_s - self._seen_s <= MEMORY_S else None


class Hand(NamedTuple):
    """The hand that is followed.

    Attributes
    ----------
    number : int
        Number of the hand, counted from 1; a recognised hand keeps its number. 0 before the first.
    is_presented : bool
        Whether it has been held up to the initial template, in every view that has one and
        follows it, and is validated as a hand: it has come into view or moved.
    """

    number: int = 0
    is_presented: bool = False


class IdentifiedView(Protocol):
    """The view's properties that `Identity` uses."""

    @property
    def shows_finger(self) -> bool:
        """Whether it has a finger line in this frame."""

    @property
    def is_validated(self) -> bool:
        """Whether its finger, if any, is validated as a hand and cannot be the table."""

    @property
    def is_recognised(self) -> bool:
        """Whether its finger has the appearance of the hand it followed before."""

    @property
    def is_presented(self) -> bool | None:
        """Whether its hand is at the rig's initial template; None without one."""


class Identity:
    """Numbers the hands that the views of a rig follow."""

    def __init__(self) -> None:
        self.hand = Hand()
        self._is_followed = False
        self._presented_frames = 0
        self._was_held_up = False
        self._seen_s = -math.inf

    def update(self, views: Sequence[IdentifiedView], time_s: float) -> None:
        """Update for one time: it is one hand as long as any view follows it."""
        following = [view for view in views if view.shows_finger]
        if following:
            if not self._is_followed and not self._is_known(following, time_s):
                self.hand, self._was_held_up = Hand(self.hand.number + 1), False
            self._look_at_template(following)
            is_presented = self._was_held_up and all(view.is_validated for view in following)
            if is_presented and not self.hand.is_presented:
                self.hand = self.hand._replace(is_presented=True)
            self._seen_s = time_s
        self._is_followed = bool(following)

    def _look_at_template(self, following: Sequence[IdentifiedView]) -> None:
        """Count the consecutive frames in which the hand is at its template."""
        presented = [p for view in following if (p := view.is_presented) is not None]
        is_there = bool(presented) and all(presented)
        self._presented_frames = self._presented_frames + 1 if is_there else 0
        self._was_held_up |= self._presented_frames >= PRESENTED_FRAMES

    def _is_known(self, views: Sequence[IdentifiedView], time_s: float) -> bool:
        is_recent = time_s - self._seen_s <= MEMORY_S
        return is_recent and all(view.is_recognised for view in views)
