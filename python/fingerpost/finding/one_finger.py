"""Tests whether two views follow the same finger."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import combinations
from typing import Protocol

from fingerpost._core import Track
from fingerpost.finding.finger import (
    AxisCorrection,
    FingerDetection,
    fitted_half_width_px,
    followed,
    measured_line,
)
from fingerpost.finding.pairs import (
    MIN_SAME_TIP,
    TipRays,
    Viewpoint,
    foreshortenings,
    same_tip,
    tip_rays,
    width_ratio,
)
from fingerpost.pointing import FingerLine, PlaneView, Status, indicated_point

WIDTH_RATE = 0.2
"""Weight of a frame in the running mean of a view's width ratio: single frames may be blurred."""

LENGTH_RATE = 0.1
"""Weight of a frame in the running mean of the foreshortening: a hand turns slowly."""

MAX_LOG_WIDTH_RATIO = 0.6
"""Greatest absolute logarithm of the ratio of the widths of one finger in two views; beyond it, one
view follows another finger or wrong edges. In the recordings it is 0.45 at most."""

MIN_CERTAIN_SAME_TIP = 0.99
"""Least `same_tip` score for which tips are one although one is static and the other moves. The
median for one finger is 0.999 on real footage and 0.9999 in rendered films. The score of a view
that has locked on to an edge of the table falls below as the finger moves away from it."""


class FollowingView(Protocol):
    """The view's properties that the tests use."""

    @property
    def viewpoint(self) -> Viewpoint:
        """Its camera centre and homography."""

    @property
    def track(self) -> Track | None:
        """Its tracker's result for the last frame."""

    @property
    def axis_correction(self) -> AxisCorrection:
        """Correction from the line between the visible edges to the finger's axis."""

    log_width_ratio: float | None
    """Running mean of the logarithm of the finger's width here over that in the view that agrees
    best; None if unknown."""

    @property
    def foreshortening(self) -> float | None:
        """Running mean of the finger's image length over its true length, in (0, 1].

        None if unknown.
        """

    @foreshortening.setter
    def foreshortening(self, foreshortening: float) -> None: ...


Pair = tuple[FollowingView, FollowingView]


def compare_widths(views: Sequence[FollowingView]) -> None:
    """Update every view's width ratio to the view that agrees best with it."""
    ratios: list[list[float]] = [[] for _ in views]
    for i, j in combinations(range(len(views)), 2):
        ratio = _followed_width_ratio((views[i], views[j]))
        if math.isfinite(ratio):
            ratios[i].append(ratio)
            ratios[j].append(-ratio)
    for view, known in zip(views, ratios, strict=True):
        now = min(known, key=abs, default=None)
        if now is None or view.log_width_ratio is None:
            view.log_width_ratio = now
        else:
            view.log_width_ratio += WIDTH_RATE * (now - view.log_width_ratio)


def compare_lengths(views: Sequence[FollowingView], shared: PairTests) -> None:
    """Update every view's foreshortening from the other views' lines."""
    for pair in combinations(views, 2):
        first, second = (followed(view.track) for view in pair)
        if not (first and second) or shared.have_two_tips(*pair):
            continue
        viewpoints = pair[0].viewpoint, pair[1].viewpoint
        ratios = foreshortenings(viewpoints, (first[0], second[0]))
        for view, now in zip(pair, ratios, strict=True):
            if not now > 0.0:
                continue
            before = now if view.foreshortening is None else view.foreshortening
            view.foreshortening = before + LENGTH_RATE * (now - before)


def gives_point(views: Sequence[PlaneView], lines: Sequence[FingerLine | None]) -> bool:
    """Whether the lines of two views give a point; True while one has no finger line."""
    fingers = [line for line in lines if line is not None]
    if len(fingers) < len(views):
        return True
    return indicated_point(fingers, views, time_s=0.0).status is Status.OK


def can_be_one(views: Pair) -> bool:
    """Whether two views may follow the same finger; True while one follows nothing."""
    if _widths_differ(views):
        return False
    lines = [measured_line(view.track, 0.0, view.axis_correction) for view in views]
    return gives_point([view.viewpoint.plane_view for view in views], lines)


def are_one(views: Pair) -> bool:
    """Whether two views follow the same finger: their lines give a point and their tips agree."""
    same = _same_followed_tip(views)
    return same is not None and same >= MIN_SAME_TIP and can_be_one(views)


def are_two(views: Pair) -> bool:
    """Whether two views follow different fingers.

    Then their lines give no point, and their tips or widths differ. The tips of a hand that points
    nowhere agree.
    """
    if can_be_one(views):
        return False
    return have_two_tips(views) or (_same_followed_tip(views) is not None and _widths_differ(views))


def have_two_tips(views: Pair) -> bool:
    """Whether the fingers that two views follow have different tips.

    Lines of two different fingers give a point, too.
    """
    same = _same_followed_tip(views)
    return same is not None and same < MIN_SAME_TIP


def rays_of_tips(
    viewpoints: Sequence[Viewpoint], lines: Sequence[object]
) -> dict[tuple[int, int], TipRays]:
    """Return the rays through the tips that every two views follow.

    Parameters
    ----------
    viewpoints
        Camera centres and homographies of the views.
    lines
        The finger line of each; any other object for a view without one.
    """
    fingers = {
        k: FingerDetection((line.tip_px[0], line.tip_px[1]), line.angle_rad, line.half_width_px)
        for k, line in enumerate(lines)
        if isinstance(line, FingerLine)
    }
    return {
        (i, j): tip_rays((viewpoints[i], viewpoints[j]), (fingers[i], fingers[j]))
        for i, j in combinations(fingers, 2)
    }


def other_fingers(rays: Mapping[tuple[int, int], TipRays]) -> list[int]:
    """Return the views whose fingertip agrees with that of no other view, by `rays_of_tips`.

    Both of two views that follow different fingers are among them.
    """
    backed = {k for pair, tips in rays.items() if tips.likelihood >= MIN_SAME_TIP for k in pair}
    return sorted({k for pair in rays for k in pair} - backed)


def share_tip(views: Pair) -> bool:
    """Whether the tips agree by at least `MIN_CERTAIN_SAME_TIP`."""
    same = _same_followed_tip(views)
    return same is not None and same >= MIN_CERTAIN_SAME_TIP


def _same_followed_tip(views: Pair) -> float | None:
    """Return the `same_tip` score of the followed fingers; None unless both views have one."""
    first, second = (followed(view.track) for view in views)
    if not (first and second):
        return None
    return same_tip((views[0].viewpoint, views[1].viewpoint), (first[0], second[0]))


def _widths_differ(views: Pair) -> bool:
    """Whether a view's width of the finger agrees with that of no other view."""
    return any(abs(view.log_width_ratio or 0.0) > MAX_LOG_WIDTH_RATIO for view in views)


def _followed_width_ratio(views: Pair) -> float:
    """Return the logarithm of the first view's width over the second's; NaN if unknown."""
    tracks = [view.track for view in views]
    if any(track is None or fitted_half_width_px(track) is None for track in tracks):
        return math.nan
    first, second = (followed(track) for track in tracks)
    if not (first and second):
        return math.nan
    between_edges = width_ratio((views[0].viewpoint, views[1].viewpoint), (first[0], second[0]))
    return (
        between_edges
        + views[0].axis_correction.log_width_ratio
        - views[1].axis_correction.log_width_ratio
    )


class PairTests:
    """Results of the tests for pairs of views in one frame, each computed once."""

    def __init__(self) -> None:
        self._results: dict[tuple[Callable[..., bool], frozenset[FollowingView]], bool] = {}

    def can_be_one(self, one: FollowingView, other: FollowingView) -> bool:
        """See `can_be_one`."""
        return self._cached(can_be_one, one, other)

    def are_one(self, one: FollowingView, other: FollowingView) -> bool:
        """See `are_one`."""
        return self._cached(are_one, one, other)

    def are_two(self, one: FollowingView, other: FollowingView) -> bool:
        """See `are_two`; `can_be_one` decides most cases at less cost."""
        return not self.can_be_one(one, other) and self._cached(are_two, one, other)

    def have_two_tips(self, one: FollowingView, other: FollowingView) -> bool:
        """See `have_two_tips`."""
        return self._cached(have_two_tips, one, other)

    def share_tip(self, one: FollowingView, other: FollowingView) -> bool:
        """See `share_tip`."""
        return self._cached(share_tip, one, other)

    def _cached(
        self, test: Callable[[Pair], bool], one: FollowingView, other: FollowingView
    ) -> bool:
        key = test, frozenset((one, other))
        if key not in self._results:
            self._results[key] = test((one, other))
        return self._results[key]
