"""Whether what two views follow is one finger."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import combinations
from typing import Protocol

from fingerpost._core import Track
from fingerpost.finding.finger import Aside, Sighting, fitted_half_width_px, followed, measured_line
from fingerpost.finding.pairs import (
    OTHER_TIP,
    Viewpoint,
    foreshortenings,
    same_tip,
    width_ratio,
)
from fingerpost.pointing import FingerLine, PlaneView, Status, indicated_point

WIDTH_RATE = 0.2
"""What a frame counts in how much wider a view shows the finger: a blurred moment tells little."""

LENGTH_RATE = 0.1
"""The same in how much shorter it shows the finger than it is: a hand turns slowly."""

OTHER_WIDTH = 0.6
"""Fingers whose widths differ by this logarithm are two, or one not seen for what it is. One
finger's differ by 0.45 at most in the recordings."""

SURELY_ONE = 0.99
"""Tips of which one stands still while the other moves are one point with this, by `same_tip`: the
median of one finger is 0.999 on real footage, and 0.9999 in rendered films. A view that holds on to
an edge of the table falls below as the finger moves on from there."""


class FollowingView(Protocol):
    """What is asked here of a view."""

    @property
    def viewpoint(self) -> Viewpoint:
        """Where it is taken from, and how it sees the plane."""

    @property
    def track(self) -> Track | None:
        """What its tracker made of the last frame."""

    @property
    def aside(self) -> Aside:
        """How the finger's axis lies to the line between the edges that show."""

    odd_width: float | None
    """Logarithm of how many times as wide it has shown the finger lately as the view that agrees
    best; None where that is not known."""

    @property
    def foreshortening(self) -> float | None:
        """By how much it has shown the finger shorter lately than it is, above 0 and at most 1.

        None where that is not known.
        """

    @foreshortening.setter
    def foreshortening(self, foreshortening: float) -> None: ...


Pair = tuple[FollowingView, FollowingView]


def compare_widths(views: Sequence[FollowingView]) -> None:
    """Tell every view how much wider it shows the finger than the view that agrees best with it."""
    ratios: list[list[float]] = [[] for _ in views]
    for i, j in combinations(range(len(views)), 2):
        ratio = _followed_width_ratio((views[i], views[j]))
        if math.isfinite(ratio):
            ratios[i].append(ratio)
            ratios[j].append(-ratio)
    for view, known in zip(views, ratios, strict=True):
        now = min(known, key=abs, default=None)
        if now is None or view.odd_width is None:
            view.odd_width = now
        else:
            view.odd_width += WIDTH_RATE * (now - view.odd_width)


def compare_lengths(views: Sequence[FollowingView], shared: Shared) -> None:
    """Tell every view how much shorter it shows the finger than it is, as other views know."""
    for pair in combinations(views, 2):
        first, second = (followed(view.track) for view in pair)
        if not (first and second) or shared.have_two_tips(*pair):
            continue
        viewpoints = pair[0].viewpoint, pair[1].viewpoint
        told = foreshortenings(viewpoints, (first[0], second[0]))
        for view, now in zip(pair, told, strict=True):
            if not now > 0.0:
                continue
            before = now if view.foreshortening is None else view.foreshortening
            view.foreshortening = before + LENGTH_RATE * (now - before)


def gives_point(views: Sequence[PlaneView], lines: Sequence[FingerLine | None]) -> bool:
    """Tell whether lines of two views give a point; so they do while one shows no finger."""
    fingers = [line for line in lines if line is not None]
    if len(fingers) < len(views):
        return True
    return indicated_point(fingers, views, time_s=0.0).status is Status.OK


def can_be_one(views: Pair) -> bool:
    """Tell whether what two views follow may be one finger; so it is while one follows nothing."""
    if _is_odd(views):
        return False
    lines = [measured_line(view.track, 0.0, view.aside) for view in views]
    return gives_point([view.viewpoint.plane_view for view in views], lines)


def are_one(views: Pair) -> bool:
    """Tell whether two views follow one finger: their lines give a point, and they have one tip."""
    same = _same_followed_tip(views)
    return same is not None and same >= OTHER_TIP and can_be_one(views)


def are_two(views: Pair) -> bool:
    """Tell whether two views follow different fingers.

    Then their lines give no point, and their tips are hardly one or as wide; a hand that points
    nowhere has one tip.
    """
    if can_be_one(views):
        return False
    return have_two_tips(views) or (_same_followed_tip(views) is not None and _is_odd(views))


def have_two_tips(views: Pair) -> bool:
    """Tell whether the fingers that two views follow have different tips.

    Lines of two fingers give a point, like any others.
    """
    same = _same_followed_tip(views)
    return same is not None and same < OTHER_TIP


def other_fingers(viewpoints: Sequence[Viewpoint], lines: Sequence[object]) -> list[int]:
    """Tell which views show another finger at one time than all others do, by its tip.

    Parameters
    ----------
    viewpoints
        Where the views are taken from.
    lines
        The finger line of each; anything else of one that shows none.

    Returns
    -------
    list of int
        Their places among the views; of two that show different fingers, both.
    """
    fingers = {
        k: Sighting((line.tip_px[0], line.tip_px[1]), line.angle_rad, line.half_width_px)
        for k, line in enumerate(lines)
        if isinstance(line, FingerLine)
    }
    tips_are_one = {
        (i, j): same_tip((viewpoints[i], viewpoints[j]), (fingers[i], fingers[j])) >= OTHER_TIP
        for i, j in combinations(fingers, 2)
    }
    backed = {k for pair, is_one in tips_are_one.items() if is_one for k in pair}
    return [k for k in fingers if len(fingers) > 1 and k not in backed]


def share_tip(views: Pair) -> bool:
    """Tell whether two views follow fingers of one tip, as surely as geometry can tell."""
    same = _same_followed_tip(views)
    return same is not None and same >= SURELY_ONE


def _same_followed_tip(views: Pair) -> float | None:
    """Return how well the tips that two views follow may be one; None unless both follow one."""
    first, second = (followed(view.track) for view in views)
    if not (first and second):
        return None
    return same_tip((views[0].viewpoint, views[1].viewpoint), (first[0], second[0]))


def _is_odd(views: Pair) -> bool:
    """Tell whether a view shows a finger of a width that no other view shows it to have."""
    return any(abs(view.odd_width or 0.0) > OTHER_WIDTH for view in views)


def _followed_width_ratio(views: Pair) -> float:
    """Return the logarithm of how many times as wide the first shows its finger; NaN if unknown."""
    tracks = [view.track for view in views]
    if any(track is None or fitted_half_width_px(track) is None for track in tracks):
        return math.nan
    first, second = (followed(track) for track in tracks)
    if not (first and second):
        return math.nan
    between_edges = width_ratio((views[0].viewpoint, views[1].viewpoint), (first[0], second[0]))
    return between_edges + views[0].aside.wider - views[1].aside.wider


class Shared:
    """What pairs of views show together in one frame; each pair is judged once."""

    def __init__(self) -> None:
        self._judgements: dict[tuple[Callable[..., bool], frozenset[FollowingView]], bool] = {}

    def can_be_one(self, one: FollowingView, other: FollowingView) -> bool:
        """See `can_be_one`."""
        return self._judged(can_be_one, one, other)

    def are_one(self, one: FollowingView, other: FollowingView) -> bool:
        """See `are_one`."""
        return self._judged(are_one, one, other)

    def are_two(self, one: FollowingView, other: FollowingView) -> bool:
        """See `are_two`; mostly it is enough that they can be one."""
        return not self.can_be_one(one, other) and self._judged(are_two, one, other)

    def have_two_tips(self, one: FollowingView, other: FollowingView) -> bool:
        """See `have_two_tips`."""
        return self._judged(have_two_tips, one, other)

    def share_tip(self, one: FollowingView, other: FollowingView) -> bool:
        """See `share_tip`."""
        return self._judged(share_tip, one, other)

    def _judged(
        self, judge: Callable[[Pair], bool], one: FollowingView, other: FollowingView
    ) -> bool:
        key = judge, frozenset((one, other))
        if key not in self._judgements:
            self._judgements[key] = judge((one, other))
        return self._judgements[key]
