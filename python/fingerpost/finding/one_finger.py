"""Whether what two views follow is one finger."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

from fingerpost._core import Track
from fingerpost.finding.finger import followed, measured_line
from fingerpost.finding.pairs import OTHER_TIP, Viewpoint, same_tip
from fingerpost.pointing import PlaneView, Status, indicated_point


class FollowingView(Protocol):
    """What is asked here of a view."""

    @property
    def viewpoint(self) -> Viewpoint:
        """Where it is taken from, and how it sees the plane."""

    @property
    def track(self) -> Track | None:
        """What its tracker made of the last frame."""


Pair = tuple[FollowingView, FollowingView]


def gives_point(views: Sequence[PlaneView], tracks: Sequence[Track | None]) -> bool:
    """Tell whether tracks of two views give a point; so they do while one shows no finger."""
    lines = [measured_line(track, time_s=0.0) for track in tracks]
    fingers = [line for line in lines if line is not None]
    if len(fingers) < len(views):
        return True
    return indicated_point(fingers, views, time_s=0.0).status is Status.OK


def can_be_one(views: Pair) -> bool:
    """Tell whether what two views follow may be one finger; so it is while one follows nothing."""
    return gives_point([v.viewpoint.plane_view for v in views], [v.track for v in views])


def are_one(views: Pair) -> bool:
    """Tell whether two views follow one finger: their lines give a point, and they have one tip."""
    same = _same_followed_tip(views)
    return same is not None and same >= OTHER_TIP and can_be_one(views)


def are_two(views: Pair) -> bool:
    """Tell whether two views follow different fingers.

    Then their lines give no point, and their tips are hardly one; a hand that points nowhere has
    one tip.
    """
    if can_be_one(views):
        return False
    same = _same_followed_tip(views)
    return same is not None and same < OTHER_TIP


def _same_followed_tip(views: Pair) -> float | None:
    """Return how well the tips that two views follow may be one; None unless both follow one."""
    first, second = (followed(view.track) for view in views)
    if not (first and second):
        return None
    return float(same_tip((views[0].viewpoint, views[1].viewpoint), (first, second))[0, 0])


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
        """See `are_two`."""
        return self._judged(are_two, one, other)

    def _judged(
        self, judge: Callable[[Pair], bool], one: FollowingView, other: FollowingView
    ) -> bool:
        key = judge, frozenset((one, other))
        if key not in self._judgements:
            self._judgements[key] = judge((one, other))
        return self._judgements[key]
