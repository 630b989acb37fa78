"""The search for a hand in all views: a pair of trials that agree on a finger above the plane."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Protocol

import numpy as np

from fingerpost._core import Candidate
from fingerpost.capture import Frame
from fingerpost.finding.finger import (
    Array,
    Sighting,
    followed,
    measured_line,
)
from fingerpost.finding.look import flatness
from fingerpost.finding.one_finger import FollowingView, gives_point
from fingerpost.finding.pairs import (
    DIGITS_APART,
    pair_scores,
    reaches_farther,
    reaches_farther_in_view,
)
from fingerpost.finding.search import HandSearch
from fingerpost.finding.trial import Trial, belief, precedence


class SearchingView(FollowingView, Protocol):
    """What `find_hand` needs of a view."""

    search: HandSearch

    @property
    def is_searching(self) -> bool:
        """Whether the hand may be anywhere in it."""

    @property
    def is_sure(self) -> bool:
        """Whether what it follows, if anything, is a hand and not perhaps the table."""

    def may_follow(self, trial: Trial) -> bool:
        """Whether a trial may be the hand that was lost here."""

    def would_lead_to(self, angle_rad: float, time_s: float) -> float:
        """Return how likely the finger that was lost here leads there now, 0 to 1."""


def find_hand(views: Sequence[SearchingView], frames: Sequence[Frame | None]) -> None:
    """Go on with the search for the hand in all views that are searching.

    Pairs of trials that have held long enough, and trials that agree with a view that follows the
    hand already, are believed, the best first. Then the likeliest pairs of candidates are tried.

    Parameters
    ----------
    views
        All views, each after it has observed its frame.
    frames
        Their frames, in the same order; None where there is none.
    """
    for k, (view, frame) in enumerate(zip(views, frames, strict=True)):
        if view.is_searching and frame is not None:
            fingers = view.search.places()
            flat = _flatness(views, frames, k, fingers)
            view.search.judge(frame, *np.split(flat, [len(view.search.candidates)]))
    _believe(views, frames)
    for i, j in combinations(range(len(views)), 2):
        if any(views[k].is_searching and frames[k] is not None for k in (i, j)):
            _try_out(views, frames, (i, j))


NEW_TRIALS = 4
"""Pairs of candidates that are tried anew, per frame."""


def _try_out(
    views: Sequence[SearchingView],
    frames: Sequence[Frame | None],
    pair: tuple[int, int],
) -> None:
    """Start trials at the likeliest pairs of candidates of two views."""
    i, j = pair
    candidates_i, seen_i = _candidates(views[i], frames[i])
    candidates_j, seen_j = _candidates(views[j], frames[j])
    scores = pair_scores((views[i].viewpoint, views[j].viewpoint), (seen_i, seen_j))
    worth = scores * _worth(seen_i)[:, None] * _worth(seen_j)
    started = 0
    for a, b in _best_first(worth):
        both = ((i, candidates_i[a]), (j, candidates_j[b]))
        chosen = {k: candidate for k, candidate in both if candidate is not None}
        if any(views[k].search.is_refused(candidate) for k, candidate in chosen.items()):
            continue
        new = False
        for k, candidate in chosen.items():
            frame = frames[k]
            new |= frame is not None and views[k].search.try_out(candidate, frame)
        started += new
        if started == NEW_TRIALS:
            return


def _worth(seen: Sequence[Sighting]) -> Array:
    """Return what fingers are worth trying; where no background is known, all may have come."""
    return np.array([precedence(np.nan_to_num(finger.foreground, nan=1.0)) for finger in seen])


def _best_first(scores: Array) -> Iterator[tuple[int, int]]:
    """Yield the places of the entries above 0, in falling order."""
    for place in np.argsort(-scores, axis=None, kind="stable"):
        row, column = np.unravel_index(place, scores.shape)
        if scores[row, column] <= 0.0:
            return
        yield int(row), int(column)


@dataclass(frozen=True, eq=False, slots=True)
class TriedPair:
    """A finger that two views may both show: a trial in either, or in one that the other backs.

    Attributes
    ----------
    views
        The views' places among all.
    seen
        The finger in each of them.
    trials
        The trials, by view.
    score
        How well it fits together, 0 to 1.
    stays
        Whether it is the one that is believed already.
    """

    views: tuple[int, int]
    seen: tuple[Sighting, Sighting]
    trials: dict[int, Trial]
    score: float
    stays: bool

    @property
    def hand(self) -> float:
        """How far its fingers widen to a hand, in the view where they do so less, 0 to 1."""
        return min(trial.hand for trial in self.trials.values())


FITS_WELL = 0.7
"""A pair that fits together so well is likely a finger, though a view does not show it at length:
two that were so on films have 0.79 and more, and a fold of a fist 0.61."""


def _believe(views: Sequence[SearchingView], frames: Sequence[Frame | None]) -> None:
    """Let views follow the best pairs of trials that have held long enough."""
    taken: dict[int, Trial] = {}
    believed: dict[int, Trial] = {}
    for pair, has_held in worthiest_first(views):
        trials = pair.trials
        if any(taken.get(k, trial) is not trial for k, trial in trials.items()):
            continue
        if has_held:
            is_likely, is_followed = pair.score >= FITS_WELL, len(trials) == 1
            for k, trial in trials.items():
                frame = frames[k]
                if frame is not None and k not in taken:
                    trial.lengthen(frame, is_likely=is_likely, is_followed=is_followed)
            is_long = all(trial.lengthening.is_long for trial in trials.values())
            if is_long and not pair.stays and not _point_at_plane(views, trials, pair.views):
                continue
            if is_long:
                believed.update(trials)
        taken.update(trials)
    for k, (view, frame) in enumerate(zip(views, frames, strict=True)):
        if frame is not None:
            view.search.believe(believed.get(k))


def worthiest_first(views: Sequence[SearchingView]) -> list[tuple[TriedPair, bool]]:
    """Return the pairs that are worth something, and whether each has held long enough.

    Of two digits of a hand the one that reaches farther points, though a thumb does so as well, and
    is the better seen of the two at times. The hand behind either is that of both.
    """
    pairs = _possible_pairs(views)
    behind = {one: [p for p in pairs if is_behind(views, p, one)] for one in pairs}
    told: dict[TriedPair, tuple[float, bool]] = {}
    for pair in pairs:
        worth, has_held = belief(
            pair.score,
            list(pair.trials.values()),
            pair.stays,
            hand=max(p.hand for p in (pair, *behind[pair])),
            is_backed=any(views[k].is_sure for k in pair.views if k not in pair.trials),
        )
        if worth > 0.0:
            told[pair] = worth, has_held
    outdone = {p for pair in told for p in behind[pair]}
    foremost = [pair for pair in told if pair not in outdone]
    return [(pair, told[pair][1]) for pair in sorted(foremost, key=lambda pair: -told[pair][0])]


def _possible_pairs(views: Sequence[SearchingView]) -> list[TriedPair]:
    """Return the pairs of trials, and of trials and followed fingers, that may be of a hand.

    Two digits of one hand are such a pair, too: they tell what hand is behind either.
    """
    pairs = []
    moving = movers(views)
    for i, j in combinations(range(len(views)), 2):
        if not (views[i].is_searching or views[j].is_searching):
            continue
        (tried_i, seen_i), (tried_j, seen_j) = _tried(views[i]), _tried(views[j])
        scores = pair_scores((views[i].viewpoint, views[j].viewpoint), (seen_i, seen_j))
        for a, b in _best_first(scores):
            both = ((i, tried_i[a]), (j, tried_j[b]))
            trials = {k: trial for k, trial in both if trial is not None}
            if not trials or are_left_standing(trials, moving):
                continue
            if not all(views[k].may_follow(trial) for k, trial in trials.items()):
                continue
            score, seen = float(scores[a, b]), (seen_i[a], seen_j[b])
            if len(trials) == 1:
                # The other view has followed the hand meanwhile: it has hardly turned round.
                ((k, trial),) = trials.items()
                score *= views[k].would_lead_to(trial.line.angle_rad, trial.track.time_s)
            stays = all(views[k].search.found is trial for k, trial in trials.items())
            pairs.append(TriedPair((i, j), seen, trials, score, stays))
    return pairs


LIKELY = 0.5
"""How well another pair must fit together to go before one that is behind it, in parts of how well
that does."""


def is_behind(views: Sequence[SearchingView], pair: TriedPair, other: TriedPair) -> bool:
    """Tell whether another pair of the same two views is a digit of the hand that reaches farther.

    Where both pairs have the same trial in one view, or it follows its finger for good, the other
    view tells. What was there from the start goes before nothing that has come.
    """
    if other.views != pair.views or other.trials.keys() != pair.trials.keys():
        return False
    differ = [k for k in pair.trials if pair.trials[k] is not other.trials[k]]
    has_come = all(other.trials[k].has_come or not pair.trials[k].has_come for k in differ)
    if not differ or not has_come or other.score < LIKELY * pair.score:
        return False
    if len(differ) == len(pair.views):
        i, j = pair.views
        return reaches_farther((views[i].viewpoint, views[j].viewpoint), pair.seen, other.seen)
    place = pair.views.index(differ[0])
    return reaches_farther_in_view(pair.seen[place], other.seen[place])


def movers(views: Sequence[SearchingView]) -> dict[int, list[Trial]]:
    """Return the trials in each view whose finger moves on."""
    return {k: [t for t in view.search.trials if t.moves_on] for k, view in enumerate(views)}


def are_left_standing(trials: Mapping[int, Trial], moving: Mapping[int, Sequence[Trial]]) -> bool:
    """Tell whether fingers that were there from the start stand while another hand moves on.

    A hand that lies on the table does, as long as the one that points moves. What is no farther
    from a finger's tip than another digit may be is no other hand: a fit goes to and fro on the
    folds of a fist.

    Parameters
    ----------
    trials
        A pair's, by view.
    moving
        What moves on, by view.
    """
    return all(trial.stands for trial in trials.values()) and any(
        math.dist(mover.line.tip_px, trial.line.tip_px) > DIGITS_APART * trial.half_width_px
        for k, trial in trials.items()
        for mover in moving[k]
    )


def _candidates(
    view: SearchingView, frame: Frame | None
) -> tuple[Sequence[Candidate | None], Sequence[Sighting]]:
    """Return the candidates of a view; None for the hand that it follows."""
    seen = _followed_for_good(view)
    if not view.is_searching or frame is None:
        return [None] * len(seen), seen
    search = view.search
    return [*search.candidates, *[None] * len(seen)], [*search.candidate_sightings(), *seen]


def _tried(view: SearchingView) -> tuple[Sequence[Trial | None], Sequence[Sighting]]:
    """Return the trials of a view; None for the hand that it follows."""
    seen = _followed_for_good(view)
    if not view.is_searching:
        return [None] * len(seen), seen
    return [*view.search.trials, *[None] * len(seen)], [*view.search.trial_sightings(), *seen]


def _followed_for_good(view: SearchingView) -> Sequence[Sighting]:
    """Return the finger that a view follows and does not merely try."""
    return followed(view.track) if view.search.found is None else []


def _point_at_plane(
    views: Sequence[SearchingView], trials: Mapping[int, Trial], pair: tuple[int, int]
) -> bool:
    """Tell whether the finger lines of two views give a point, with what is known of their errors.

    A thumb leads up and away from the plane: its lines meet behind it, or hardly meet.
    """
    tracks = [trials[k].track if k in trials else views[k].track for k in pair]
    lines = [measured_line(track, time_s=0.0) for track in tracks]
    return gives_point([views[k].viewpoint.plane_view for k in pair], lines)


def how_flat(
    views: Sequence[SearchingView], frames: Sequence[Frame | None], k: int
) -> float | None:
    """Tell how flat what a view follows looks to the others; None if it follows nothing.

    See `flatness`, and `find_hand` for the arguments; `k` is the view's place among all.
    """
    seen = followed(views[k].track)
    return float(_flatness(views, frames, k, seen)[0]) if seen else None


def _flatness(
    views: Sequence[SearchingView],
    frames: Sequence[Frame | None],
    k: int,
    seen: Sequence[Sighting],
) -> Array:
    """Return how flat fingers in a view look to the others."""
    one = frames[k]
    flat = np.zeros(len(seen))
    for other, frame in zip(views, frames, strict=True):
        if one is not None and frame is not None and other is not views[k]:
            plane_views = views[k].viewpoint.plane_view, other.viewpoint.plane_view
            flat = np.maximum(flat, flatness(plane_views, (one.grey(), frame.grey()), seen))
    return flat
