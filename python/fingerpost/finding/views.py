"""Search for a hand in all views: pairs of trials that agree on a finger above the plane."""

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
    FingerDetection,
    followed,
    measured_line,
)
from fingerpost.finding.one_finger import FollowingView, gives_point
from fingerpost.finding.pairs import (
    MAX_DIGIT_DISTANCE,
    pair_scores,
    reaches_farther,
    reaches_farther_in_view,
)
from fingerpost.finding.pixel_tests import flatness
from fingerpost.finding.search import HandSearch
from fingerpost.finding.trial import Trial, pair_rank, precedence


class SearchingView(FollowingView, Protocol):
    """The view's properties and methods that `find_hand` uses."""

    search: HandSearch

    @property
    def is_searching(self) -> bool:
        """Whether the whole image is to be searched."""

    @property
    def is_validated(self) -> bool:
        """Whether its finger, if any, is validated as a hand and cannot be the table."""

    def may_follow(self, trial: Trial) -> bool:
        """Whether a trial may be the hand that this view has lost."""

    def direction_likelihood(self, angle_rad: float, time_s: float) -> float:
        """Return the likelihood of a direction of the finger lost here, relative, 0 to 1."""


def find_hand(views: Sequence[SearchingView], frames: Sequence[Frame | None]) -> None:
    """Search one frame for the hand in all views that are searching.

    Pairs of trials that have held long enough, and trials that agree with a view that follows the
    hand already, are accepted in the order of their rank. Then trials are started at the pairs of
    candidates with the greatest score.

    Parameters
    ----------
    views
        All views, after `HandView.observe`.
    frames
        Their frames, in the same order; None where there is none.
    """
    for k, (view, frame) in enumerate(zip(views, frames, strict=True)):
        if view.is_searching and frame is not None:
            fingers = view.search.poses()
            flat = _flatness(views, frames, k, fingers)
            view.search.score_trials(frame, *np.split(flat, [len(view.search.candidates)]))
    _accept_pairs(views, frames)
    for i, j in combinations(range(len(views)), 2):
        if any(views[k].is_searching and frames[k] is not None for k in (i, j)):
            _start_trials(views, frames, (i, j))


NEW_TRIALS = 4
"""Greatest number of pairs of candidates at which trials are started per frame."""


def _start_trials(
    views: Sequence[SearchingView],
    frames: Sequence[Frame | None],
    pair: tuple[int, int],
) -> None:
    """Start trials at the pairs of candidates of two views with the greatest score."""
    i, j = pair
    candidates_i, seen_i = _candidates(views[i], frames[i])
    candidates_j, seen_j = _candidates(views[j], frames[j])
    if not (seen_i and seen_j):
        return
    scores = pair_scores((views[i].viewpoint, views[j].viewpoint), (seen_i, seen_j))
    priorities = scores * _priorities(seen_i)[:, None] * _priorities(seen_j)
    started = 0
    for a, b in _best_first(priorities):
        both = ((i, candidates_i[a]), (j, candidates_j[b]))
        chosen = {k: candidate for k, candidate in both if candidate is not None}
        if any(views[k].search.is_refused(candidate) for k, candidate in chosen.items()):
            continue
        new = False
        for k, candidate in chosen.items():
            frame = frames[k]
            new |= frame is not None and views[k].search.start_trial(candidate, frame)
        started += new
        if started == NEW_TRIALS:
            return


def _priorities(seen: Sequence[FingerDetection]) -> Array:
    """Return the priorities of fingers; without a background model, all may be foreground."""
    return np.array([precedence(np.nan_to_num(finger.foreground, nan=1.0)) for finger in seen])


def _best_first(scores: Array) -> Iterator[tuple[int, int]]:
    """Yield the indices of the positive entries in descending order."""
    for place in np.argsort(-scores, axis=None, kind="stable"):
        row, column = np.unravel_index(place, scores.shape)
        if scores[row, column] <= 0.0:
            return
        yield int(row), int(column)


@dataclass(frozen=True, eq=False, slots=True)
class TriedPair:
    """Finger in two views: trials in both, or in one beside the other view's followed finger.

    Attributes
    ----------
    views
        Indices of the views.
    seen
        The finger in each of them.
    trials
        The trials, by view.
    score
        Score of `pair_scores`, 0 to 1.
    is_current
        Whether it is the accepted pair.
    """

    views: tuple[int, int]
    seen: tuple[FingerDetection, FingerDetection]
    trials: dict[int, Trial]
    score: float
    is_current: bool

    @property
    def least_widening(self) -> float:
        """Widening to a hand, in the view where it is less, 0 to 1."""
        return min(trial.widening for trial in self.trials.values())


MIN_LIKELY_SCORE = 0.7
"""Least score for which a pair is a finger although a view shows it short. Two such fingers on
films have 0.79 and more, a fold of a fist 0.61."""


def _accept_pairs(views: Sequence[SearchingView], frames: Sequence[Frame | None]) -> None:
    """Accept the pairs of trials of greatest rank that have held long enough."""
    claimed: dict[int, Trial] = {}
    accepted: dict[int, Trial] = {}
    for pair, has_held in ranked_pairs(views):
        trials = pair.trials
        if any(claimed.get(k, trial) is not trial for k, trial in trials.items()):
            continue
        if has_held:
            is_likely, is_followed = pair.score >= MIN_LIKELY_SCORE, len(trials) == 1
            for k, trial in trials.items():
                frame = frames[k]
                if frame is not None and k not in claimed:
                    trial.extend(frame, is_likely=is_likely, is_followed=is_followed)
            is_long = all(trial.extension.is_long for trial in trials.values())
            if is_long and not pair.is_current and not _point_at_plane(views, trials, pair.views):
                continue
            if is_long:
                accepted.update(trials)
        claimed.update(trials)
    for k, (view, frame) in enumerate(zip(views, frames, strict=True)):
        if frame is not None:
            view.search.accept(accepted.get(k))


def ranked_pairs(views: Sequence[SearchingView]) -> list[tuple[TriedPair, bool]]:
    """Return the pairs of positive rank, greatest first, and whether each has held long enough.

    Of two digits of one hand only the one that reaches farther is returned, although a thumb may
    have the greater score. The hand behind either digit counts for both.
    """
    pairs = _possible_pairs(views)
    behind = {one: [p for p in pairs if is_behind(views, p, one)] for one in pairs}
    ranks: dict[TriedPair, tuple[float, bool]] = {}
    for pair in pairs:
        rank, has_held = pair_rank(
            pair.score,
            list(pair.trials.values()),
            pair.is_current,
            least_widening=max(p.least_widening for p in (pair, *behind[pair])),
            is_supported=any(views[k].is_validated for k in pair.views if k not in pair.trials),
        )
        if rank > 0.0:
            ranks[pair] = rank, has_held
    behind_others = {p for pair in ranks for p in behind[pair]}
    foremost = [pair for pair in ranks if pair not in behind_others]
    return [(pair, ranks[pair][1]) for pair in sorted(foremost, key=lambda pair: -ranks[pair][0])]


def _possible_pairs(views: Sequence[SearchingView]) -> list[TriedPair]:
    """Return the pairs of trials, and of trials and followed fingers, that may be of a hand.

    Two digits of one hand form a pair, too, which measures the hand behind them.
    """
    pairs = []
    moving = movers(views)
    for i, j in combinations(range(len(views)), 2):
        if not (views[i].is_searching or views[j].is_searching):
            continue
        (tried_i, seen_i), (tried_j, seen_j) = _tried(views[i]), _tried(views[j])
        if not (seen_i and seen_j):
            continue
        scores = pair_scores((views[i].viewpoint, views[j].viewpoint), (seen_i, seen_j))
        for a, b in _best_first(scores):
            both = ((i, tried_i[a]), (j, tried_j[b]))
            trials = {k: trial for k, trial in both if trial is not None}
            if not trials or stand_beside_mover(trials, moving):
                continue
            if not all(views[k].may_follow(trial) for k, trial in trials.items()):
                continue
            score, seen = float(scores[a, b]), (seen_i[a], seen_j[b])
            if len(trials) == 1:
                # The other view has followed the hand meanwhile, so its direction changed little.
                ((k, trial),) = trials.items()
                score *= views[k].direction_likelihood(trial.line.angle_rad, trial.track.time_s)
            is_current = all(views[k].search.found is trial for k, trial in trials.items())
            pairs.append(TriedPair((i, j), seen, trials, score, is_current))
    return pairs


MIN_SCORE_RATIO = 0.5
"""Least ratio of the score of a pair that reaches farther to that of the one behind it."""


def is_behind(views: Sequence[SearchingView], pair: TriedPair, other: TriedPair) -> bool:
    """Whether another pair of the same two views is a digit of the same hand that reaches farther.

    If both pairs share the trial of one view, or that view follows its finger for good, the other
    view decides. A background trial never precedes a foreground one.
    """
    if other.views != pair.views or other.trials.keys() != pair.trials.keys():
        return False
    differ = [k for k in pair.trials if pair.trials[k] is not other.trials[k]]
    is_foreground = all(
        other.trials[k].is_foreground or not pair.trials[k].is_foreground for k in differ
    )
    if not differ or not is_foreground or other.score < MIN_SCORE_RATIO * pair.score:
        return False
    if len(differ) == len(pair.views):
        i, j = pair.views
        return reaches_farther((views[i].viewpoint, views[j].viewpoint), pair.seen, other.seen)
    place = pair.views.index(differ[0])
    return reaches_farther_in_view(pair.seen[place], other.seen[place])


def movers(views: Sequence[SearchingView]) -> dict[int, list[Trial]]:
    """Return the moving trials of each view."""
    return {k: [t for t in view.search.trials if t.is_moving] for k, view in enumerate(views)}


def stand_beside_mover(trials: Mapping[int, Trial], moving: Mapping[int, Sequence[Trial]]) -> bool:
    """Whether the fingers of a pair are static while another hand moves.

    True for a hand that rests on the table while the pointing one moves. A moving trial within
    `MAX_DIGIT_DISTANCE` of the fingertip is not another hand: fits oscillate on a fist's folds.

    Parameters
    ----------
    trials
        The pair's trials, by view.
    moving
        The moving trials, by view.
    """
    return all(trial.is_static for trial in trials.values()) and any(
        math.dist(mover.line.tip_px, trial.line.tip_px) > MAX_DIGIT_DISTANCE * trial.half_width_px
        for k, trial in trials.items()
        for mover in moving[k]
    )


def _candidates(
    view: SearchingView, frame: Frame | None
) -> tuple[Sequence[Candidate | None], Sequence[FingerDetection]]:
    """Return a view's candidates and detections; None stands for the followed hand."""
    seen = _followed_for_good(view)
    if not view.is_searching or frame is None:
        return [None] * len(seen), seen
    search = view.search
    return [*search.candidates, *[None] * len(seen)], [*search.candidate_detections(), *seen]


def _tried(view: SearchingView) -> tuple[Sequence[Trial | None], Sequence[FingerDetection]]:
    """Return a view's trials and detections; None stands for the followed hand."""
    seen = _followed_for_good(view)
    if not view.is_searching:
        return [None] * len(seen), seen
    return [*view.search.trials, *[None] * len(seen)], [*view.search.trial_detections(), *seen]


def _followed_for_good(view: SearchingView) -> Sequence[FingerDetection]:
    """Return the finger that a view follows, not as a trial."""
    return followed(view.track) if view.search.found is None else []


def _point_at_plane(
    views: Sequence[SearchingView], trials: Mapping[int, Trial], pair: tuple[int, int]
) -> bool:
    """Whether the finger lines of two views give a point, with their covariances.

    A thumb points away from the plane: its constraint lines meet behind it, or at a small angle.
    """
    tracks = [trials[k].track if k in trials else views[k].track for k in pair]
    lines = [measured_line(track, time_s=0.0) for track in tracks]
    return gives_point([views[k].viewpoint.plane_view for k in pair], lines)


def flatness_of_followed(
    views: Sequence[SearchingView], frames: Sequence[Frame | None], k: int
) -> float | None:
    """Return the flatness of a view's followed finger; None without one.

    See `flatness`, and `find_hand` for the arguments; `k` is the view's index.
    """
    seen = followed(views[k].track)
    return float(_flatness(views, frames, k, seen)[0]) if seen else None


def _flatness(
    views: Sequence[SearchingView],
    frames: Sequence[Frame | None],
    k: int,
    seen: Sequence[FingerDetection],
) -> Array:
    """Return the flatness of fingers of a view: the maximum over the other views."""
    one = frames[k]
    flat = np.zeros(len(seen))
    for other, frame in zip(views, frames, strict=True):
        if one is not None and frame is not None and other is not views[k]:
            plane_views = views[k].viewpoint.plane_view, other.viewpoint.plane_view
            flat = np.maximum(flat, flatness(plane_views, (one.grey(), frame.grey()), seen))
    return flat
