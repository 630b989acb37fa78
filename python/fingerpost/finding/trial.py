"""Trial: a tracker initialised at a candidate, and the rank of a pair of trials."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from fingerpost._core import (
    Background,
    Candidate,
    ContourTracker,
    FingerLine,
    HandFinder,
    StartPose,
    Track,
)
from fingerpost.capture import Frame
from fingerpost.finding.finger import (
    KEPT_PLACE,
    MOVED_ON,
    PROVEN_MOTION,
    are_near,
    fitted_half_width_px,
)
from fingerpost.finding.foreground import MIN_FOREGROUND, foreground_part
from fingerpost.finding.identity import Appearance
from fingerpost.finding.length import TemplateExtension, length_px
from fingerpost.finding.pixel_tests import is_stripe, widening

MAX_MISSES = 2
"""Consecutive frames without an accepted fit that end a trial."""

SCORE_DECAY = 0.8
"""Factor of the previous mean in the running means of a trial's scores."""

PROVEN_FRAMES = 10
"""Frames after which a trial in the foreground is followed for good."""

MOVER_FRAMES = 6
MOVER_SCORE = 0.5
"""Least number of frames and least finger score of a moving trial with a hand behind it that is
taken for a hand."""


STRIPE_FRAMES = 8
"""Count of frames as a stripe among stripes after which a finger is rejected: a finger beside
others that is before a table of their brightness looks like one for up to 5."""


def count_stripes(before: int, frame: Frame, track: Track | None) -> int:
    """Count the frames in which what is tracked is a stripe among stripes, less the others.

    Parameters
    ----------
    before
        The count of the frame before.
    frame, track
        The frame, and the tracker's result for it; one without a finger line changes nothing.
    """
    line = track.finger_line if track is not None else None
    half_width_px = fitted_half_width_px(track)
    if line is None or half_width_px is None:
        return before
    return before + 1 if is_stripe(frame, line, half_width_px) else max(before - 1, 0)


def precedence(foreground: float) -> float:
    """Return the factor of a finger's priority: foreground is tried first."""
    return 0.5 + 0.5 * foreground


@dataclass(slots=True)
class Trial:
    """A tracker initialised at a candidate, with its scores.

    Attributes
    ----------
    candidate
        Its start.
    tracker, track
        The tracker, and its result for the last frame.
    first_line, line
        Its first and last finger line.
    score, foreground
        Running means of the finger score and of the foreground probability, 0 to 1.
    widening
        Running mean of the widening to a hand behind the finger, 0 to 1.
    is_late
        Whether it was started long after the background there became known.
    frames
        Number of frames with an accepted fit; each frame without one halves it.
    misses
        Consecutive frames without an accepted fit.
    stripe_frames
        Count of frames as a stripe among stripes, less the others.
    appearance
        Appearance at the last update of the scores.
    extension
        Replaces the template by one as long as the finger.
    """

    candidate: Candidate
    tracker: ContourTracker
    track: Track
    first_line: FingerLine
    line: FingerLine
    score: float
    foreground: float
    widening: float
    is_late: bool
    extension: TemplateExtension
    frames: int = 1
    misses: int = 0
    stripe_frames: int = 0
    appearance: Appearance | None = None

    @property
    def is_over(self) -> bool:
        """Whether its tracker has lost the finger, or follows a stripe."""
        is_lost = self.misses >= MAX_MISSES or self.track.status != "tracking"
        return is_lost or self.stripe_frames >= STRIPE_FRAMES

    @property
    def is_foreground(self) -> bool:
        """Whether it is foreground, and so has come into view."""
        return self.foreground >= MIN_FOREGROUND

    @property
    def is_hand_before_background(self) -> bool:
        """Whether it is foreground with a hand behind the finger."""
        return self.is_foreground and self.widening >= MIN_WIDENING_FOREGROUND

    @property
    def priority(self) -> float:
        """Priority of continuing it, 0 to 1."""
        return self.score * precedence(self.foreground)

    @property
    def half_width_px(self) -> float:
        """Fitted half-width, or the candidate's if the shape space has none [px]."""
        return fitted_half_width_px(self.track) or self.candidate.half_width_px

    @property
    def length(self) -> float:
        """Length of its template [half-widths]."""
        return length_px(self.tracker, self.line) / self.half_width_px

    @property
    def pose(self) -> tuple[tuple[float, float], float, float]:
        """Tip, direction and half-width of the last finger line."""
        return self.line.tip_px, self.line.angle_rad, self.half_width_px

    @property
    def has_moved(self) -> bool:
        """Whether the tip has moved by more than `PROVEN_MOTION`."""
        return self._motion > PROVEN_MOTION

    @property
    def is_static(self) -> bool:
        """Whether it is background and has not moved since its start."""
        return not self.is_foreground and self._motion < KEPT_PLACE

    @property
    def is_moving(self) -> bool:
        """Whether it has held, has moved and has a hand behind it: no part of the table."""
        is_hand = self.score >= MOVER_SCORE and self.widening >= MIN_WIDENING
        return is_hand and self.frames >= MOVER_FRAMES and self._motion > MOVED_ON

    @property
    def _motion(self) -> float:
        """Distance of the tip from its first position [half-widths]."""
        moved_px = math.dist(self.line.tip_px, self.first_line.tip_px)
        return moved_px / self.candidate.half_width_px

    @property
    def is_proven(self) -> bool:
        """Whether it has moved, or has been foreground for `PROVEN_FRAMES`."""
        has_stood = self.is_foreground and self.frames >= PROVEN_FRAMES
        return self.track.finger_line is not None and (self.has_moved or has_stood)

    def update(self, frame: Frame, background: Background) -> None:
        """Track one frame, with the background model if the finger is foreground."""
        self.track = self.tracker.update(
            frame.grey(),
            frame.time_s,
            frame.colour(),
            background=background if self.is_foreground else None,
        )
        self.stripe_frames = count_stripes(self.stripe_frames, frame, self.track)
        if self.track.finger_line is None:
            # On a pattern even a good fit is rejected at times; one found anew is weaker evidence.
            self.misses, self.frames = self.misses + 1, self.frames // 2
        else:
            self.misses, self.frames = 0, self.frames + 1
            self.line = self.track.finger_line

    def extend(self, frame: Frame, *, is_likely: bool = False, is_followed: bool = False) -> None:
        """Replace the template by one as long as the finger, if this frame shows it in full.

        For the keywords see `TemplateExtension.update`.
        """
        self.tracker, self.track = self.extension.update(
            self.tracker, self.track, frame, is_likely=is_likely, is_followed=is_followed
        )
        self.line = self.track.finger_line or self.line

    def update_scores(self, frame: Frame, background: Background, factor: float) -> None:
        """Update the appearance and the running means of the scores from a frame's pixels.

        `factor` multiplies the finger score.
        """
        line = self.track.finger_line
        if line is None:
            return
        half_width_px = self.half_width_px
        self.appearance = Appearance.of(frame, line, half_width_px)
        likeness = HandFinder.likeness(
            frame.grey(), line.tip_px, line.angle_rad, half_width_px, frame.colour()
        )
        if likeness is not None:
            self.score += (1.0 - SCORE_DECAY) * (likeness * factor - self.score)
        foreground = float(foreground_part(background, frame, line))
        if not math.isnan(foreground):
            self.foreground += (1.0 - SCORE_DECAY) * (foreground - self.foreground)
        now = widening(frame, line, half_width_px)
        self.widening += (1.0 - SCORE_DECAY) * (now - self.widening)

    def is_at(self, start: StartPose, half_width_px: float) -> bool:
        """Whether it follows the same finger as a candidate at this pose."""
        line = self.track.finger_line
        if line is None:
            return False
        there = StartPose(line.tip_px, line.angle_rad, start.length_px)
        return are_near(start, there, 2.0 * half_width_px, 0.5)


def distinct(trials: Iterator[Trial]) -> list[Trial]:
    """Return the trials without those that have converged to an older one."""
    kept: list[Trial] = []
    for trial in trials:
        line, candidate = trial.track.finger_line, trial.candidate
        here = line and StartPose(line.tip_px, line.angle_rad, candidate.start.length_px)
        if here is None or not any(k.is_at(here, candidate.half_width_px) for k in kept):
            kept.append(trial)
    return kept


MIN_FRAMES = {True: (2.0, 4.0), False: (3.0, 6.0)}
"""Least number of frames that both trials of a pair have held, at score 1 and at score 0: for a
pair in the foreground (True), and for one that may have been there from the start."""

MIN_PAIR_SCORE = 0.25
"""Least score of an accepted pair. In 150 runs on rendered films the pairs of one finger exceed it
in 99 % of the frames, though its colour hardly differs from the wood behind it; others in 12 %."""

MIN_WIDENING = 0.5
"""Widening in both views from which the score of a pair that may have been there from the start is
not reduced [0 to 1]: an object that stands on the table, such as a bottle or a pen, has less."""

MIN_WIDENING_FOREGROUND = 0.2
NO_WIDENING_PENALTY = 0.4
"""Widening from which the score of a foreground pair is not reduced, and the part by which it is
reduced without any: the pair may be a pointing device, which ranks below a hand. In 57 recordings
hands that entered had 0.24 and more, a stick and a fold of a fist 0 to 0.05."""

CURRENT_PAIR_FACTOR = 1.25
"""Factor of the rank of the pair that is followed already."""


def pair_rank(
    score: float,
    trials: Sequence[Trial],
    is_current: bool,
    *,
    least_widening: float,
    is_supported: bool,
) -> tuple[float, bool]:
    """Return the rank of a pair, 0 if it cannot be the hand, and whether it has held long enough.

    A pair that has not may turn out to be the hand: pairs of lower rank wait for it.

    Parameters
    ----------
    score
        Score of the pair, 0 to 1.
    trials
        Two, or one where the other view follows its finger for good.
    is_current
        Whether the pair is the accepted one.
    least_widening
        Widening to a hand, in the view where it is less, 0 to 1.
    is_supported
        Whether the other view's finger is validated as a hand: then a trial that has moved is no
        background, though the background may have been learned with the hand in it.
    """
    is_foreground = all(trial.is_foreground for trial in trials)
    if is_foreground:
        score *= 1.0 - NO_WIDENING_PENALTY * (
            1.0 - min(least_widening / MIN_WIDENING_FOREGROUND, 1.0)
        )
    else:
        score *= min(least_widening / MIN_WIDENING, 1.0)
    rank = score if is_foreground else 0.5 * score
    if is_current:
        return CURRENT_PAIR_FACTOR * rank, True
    least, most = MIN_FRAMES[is_foreground]
    too_new = min(trial.frames for trial in trials) < score * least + (1.0 - score) * most
    has_come = any(trial.is_foreground for trial in trials)
    too_late = any(
        _is_too_late(trial, has_come=has_come, is_supported=is_supported) for trial in trials
    )
    may_be_stripe = any(trial.stripe_frames > 0 for trial in trials)
    is_refused = too_late or may_be_stripe or score < MIN_PAIR_SCORE
    return 0.0 if is_refused else rank, not too_new


def _is_too_late(trial: Trial, *, has_come: bool, is_supported: bool) -> bool:
    """Whether a trial is background that would be foreground if it were the hand.

    A hand that was there from the start is background in all views. One that has come into another
    view must have moved in this one.

    Parameters
    ----------
    trial
        The trial.
    has_come
        Whether a trial of its pair is foreground.
    is_supported
        Whether the other view's finger is validated as a hand.
    """
    if trial.is_foreground:
        return False
    if trial.is_late:
        return not (trial.has_moved and is_supported)
    return has_come and not trial.has_moved
