"""A trial: a tracker that was started at a candidate, and when a pair of them is believed."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

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
from fingerpost.finding.foreground import IN_FOREGROUND, foreground_part
from fingerpost.finding.identity import Looks
from fingerpost.finding.length import Lengthening, length_px
from fingerpost.finding.look import widening

MISSES = 2
"""Frames in a row without an accepted fit that end a trial."""

FORGET = 0.8
"""What a trial's scores keep from frame to frame; the rest is what the pixels say of it now."""

PROVEN_FRAMES = 10
"""A finger that has been foreground for so many frames is followed for good."""

MOVER_FRAMES = 6
MOVER_SCORE = 0.5
"""What moves on is a hand if it has held for so many frames and is that much like a finger, before
something like a hand."""


def precedence(foreground: float) -> float:
    """Return what a finger is worth trying, as one that has come into view is tried first."""
    return 0.5 + 0.5 * foreground


@dataclass(slots=True)
class Trial:
    """A tracker that was started at a candidate, and how it fares.

    Attributes
    ----------
    candidate
        What it was started at.
    tracker, track
        The tracker, and what it made of the last frame.
    first_line, line
        The finger where it was seen first and last.
    score, foreground
        How like a finger and how like foreground it has been lately, 0 to 1.
    hand
        How far it has widened to a hand behind the finger lately, 0 to 1.
    is_late
        Whether it was started when the background had long been known.
    frames
        How many frames it has held: those with an accepted fit; one without takes half of them.
    misses
        Frames in a row without an accepted fit.
    looks
        How it looked when it was judged last.
    lengthening
        What has a template as long as the finger take over.
    """

    candidate: Candidate
    tracker: ContourTracker
    track: Track
    first_line: FingerLine
    line: FingerLine
    score: float
    foreground: float
    hand: float
    is_late: bool
    lengthening: Lengthening
    frames: int = 1
    misses: int = 0
    looks: Looks | None = None

    @property
    def is_over(self) -> bool:
        """Whether it has lost what it followed."""
        return self.misses >= MISSES or self.track.status != "tracking"

    @property
    def has_come(self) -> bool:
        """Whether it is foreground."""
        return self.foreground >= IN_FOREGROUND

    @property
    def worth(self) -> float:
        """What it is worth to go on with it, 0 to 1."""
        return self.score * precedence(self.foreground)

    @property
    def half_width_px(self) -> float:
        """Half the finger's width, by the fit if its shape space has one."""
        return fitted_half_width_px(self.track) or self.candidate.half_width_px

    @property
    def length(self) -> float:
        """How far back from its tip it is followed [half-widths]."""
        return length_px(self.tracker, self.line) / self.half_width_px

    @property
    def place(self) -> tuple[tuple[float, float], float, float]:
        """Tip, direction and half-width where it was seen last."""
        return self.line.tip_px, self.line.angle_rad, self.half_width_px

    @property
    def has_moved(self) -> bool:
        """Whether it is elsewhere than where it was seen first."""
        return self._motion > PROVEN_MOTION

    @property
    def stands(self) -> bool:
        """Whether it was there when the search began, and has kept its place since."""
        return not self.has_come and self._motion < KEPT_PLACE

    @property
    def moves_on(self) -> bool:
        """Whether it has held and is elsewhere, a finger before its hand: no part of the table."""
        is_hand = self.score >= MOVER_SCORE and self.hand >= HAND_SEEN
        return is_hand and self.frames >= MOVER_FRAMES and self._motion > MOVED_ON

    @property
    def _motion(self) -> float:
        """How far the tip is from where it was seen first [half-widths]."""
        moved_px = math.dist(self.line.tip_px, self.first_line.tip_px)
        return moved_px / self.candidate.half_width_px

    @property
    def is_proven(self) -> bool:
        """Whether it has moved, or has stood before the background for a while."""
        has_stood = self.has_come and self.frames >= PROVEN_FRAMES
        return self.track.finger_line is not None and (self.has_moved or has_stood)

    def update(self, frame: Frame, background: Background) -> None:
        """Follow for one frame; before the background, if the finger stands out from it."""
        self.track = self.tracker.update(
            frame.grey(),
            frame.time_s,
            frame.colour(),
            background=background if self.has_come else None,
        )
        if self.track.finger_line is None:
            # Before a pattern the best of fits is refused at times; what holds anew tells less.
            self.misses, self.frames = self.misses + 1, self.frames // 2
        else:
            self.misses, self.frames = 0, self.frames + 1
            self.line = self.track.finger_line

    def lengthen(self, frame: Frame, *, is_likely: bool = False, is_followed: bool = False) -> None:
        """Follow with a template as long as the finger, if this frame shows all of it.

        One that fits another view's finger well, and so is likely one, may be short; one that
        another view follows already, sooner.
        """
        self.tracker, self.track = self.lengthening.look(
            self.tracker, self.track, frame, is_likely=is_likely, is_followed=is_followed
        )
        self.line = self.track.finger_line or self.line

    def judge(self, frame: Frame, background: Background, worth: float) -> None:
        """Learn from the pixels of a frame how like a finger of a hand it is where it is now.

        `worth` is the factor of its score.
        """
        line = self.track.finger_line
        if line is None:
            return
        half_width_px = self.half_width_px
        self.looks = Looks.of(frame, line, half_width_px)
        likeness = HandFinder.likeness(
            frame.grey(), line.tip_px, line.angle_rad, half_width_px, frame.colour()
        )
        if likeness is not None:
            self.score += (1.0 - FORGET) * (likeness * worth - self.score)
        foreground = np.nan_to_num(foreground_part(background, frame, line))
        self.foreground += (1.0 - FORGET) * (float(foreground) - self.foreground)
        hand = widening(frame, line, half_width_px)
        self.hand += (1.0 - FORGET) * (hand - self.hand)

    def is_at(self, start: StartPose, half_width_px: float) -> bool:
        """Tell whether it follows what a candidate would."""
        line = self.track.finger_line
        if line is None:
            return False
        there = StartPose(line.tip_px, line.angle_rad, start.length_px)
        return are_near(start, there, 2.0 * half_width_px, 0.5)


def distinct(trials: Iterator[Trial]) -> list[Trial]:
    """Return the trials without those that have run into an older one."""
    kept: list[Trial] = []
    for trial in trials:
        line, candidate = trial.track.finger_line, trial.candidate
        here = line and StartPose(line.tip_px, line.angle_rad, candidate.start.length_px)
        if here is None or not any(k.is_at(here, candidate.half_width_px) for k in kept):
            kept.append(trial)
    return kept


FRAMES_TO_TRUST = {True: (2.0, 4.0), False: (3.0, 6.0)}
"""Frames that both trials of a pair must have held, if its score is 1 and if it is 0: for a pair
that has come into view, and for one that may have been there all the time."""

LEAST_SCORE = 0.25
"""The least score of a pair that is believed. In 150 runs on rendered films one finger's have more
in 99 % of the frames, though its skin hardly differs from the wood behind it; others in 12 %."""

HAND_SEEN = 0.5
"""A pair that may have been there all the time is worth in full from where its fingers widen that
much to a hand in both views [0 to 1]: what stands on the table, as a bottle or a pen, does not."""

HAND_COME = 0.2
NO_HAND = 0.4
"""One that has come may be a device, and is worth in full from where its fingers widen that much:
hands that came had 0.24 and more in 57 recordings, a stick and a fold of a fist 0 to 0.05. One that
does not widen at all is worth that part less, and goes after a hand that is seen as well."""

STAYS = 1.25
"""How much better another pair must be than the one that is followed already."""


def belief(
    score: float, trials: Sequence[Trial], stays: bool, *, hand: float, is_backed: bool
) -> tuple[float, bool]:
    """Return how much a pair with these trials is worth, 0 if nothing, and if it has held enough.

    One that has yet to hold may turn out to be the hand: what is worth less has to wait for it.

    Parameters
    ----------
    score
        How well the pair fits together, 0 to 1.
    trials
        One, where the other view follows its finger for good, or two.
    stays
        Whether the pair is the one that is believed already.
    hand
        How far the fingers widen to a hand, in the view where they do so less, 0 to 1.
    is_backed
        Whether the other view's finger is a hand's: then one that has moved with it is no part of
        the background, though the background may have been learned with the hand in it.
    """
    has_come = all(trial.has_come for trial in trials)
    if has_come:
        score *= 1.0 - NO_HAND * (1.0 - min(hand / HAND_COME, 1.0))
    else:
        score *= min(hand / HAND_SEEN, 1.0)
    worth = score if has_come else 0.5 * score
    if stays:
        return STAYS * worth, True
    least, most = FRAMES_TO_TRUST[has_come]
    too_new = min(trial.frames for trial in trials) < score * least + (1.0 - score) * most
    too_late = not has_come and any(
        trial.is_late and not (is_backed and trial.has_moved) for trial in trials
    )
    return 0.0 if too_late or score < LEAST_SCORE else worth, not too_new
