"""Search for a hand in one view: candidates, and the trials initialised at them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from fingerpost._core import (
    Background,
    Candidate,
    ContourTracker,
    HandFinder,
    StartPose,
    Template,
    Track,
)
from fingerpost.capture import Frame
from fingerpost.finding.body import Body
from fingerpost.finding.finger import Array, FingerDetection, are_near, hand_region
from fingerpost.finding.foreground import foreground_part
from fingerpost.finding.length import TemplateExtension
from fingerpost.finding.pixel_tests import widening
from fingerpost.finding.trial import Trial, count_stripes, distinct, precedence

MAX_TRIALS = 8
"""Greatest number of simultaneous trials in a view; each costs as much as tracking."""

RETRY_FRAMES = 6
"""Frames after which a candidate that the fit has rejected is tried again."""

SETTLED_FRAMES = 10
"""Frames after the background became known from which a new trial that is background is rejected: a
hand would have been foreground when it entered."""

UNCONFIRMED_FRAMES = 3
"""Frames without confirmation by another view after which a found trial is dropped."""

FLAT_SCORE_FACTOR = 0.1
"""Factor of the score of a finger that lies in the plane (flatness 1)."""


@dataclass(slots=True)
class _Refusal:
    """Start pose that a fit has rejected, and the frames since."""

    start: StartPose
    frames: int = 0


class HandSearch:
    """Search for a hand in one view.

    Parameters
    ----------
    tracker_options
        Deviations from the tracker's defaults.

    Attributes
    ----------
    candidates, trials
        Those of the last frame.
    found
        The trial that is accepted as the hand, if any.
    body
        Silhouette of the system's moving bodies in the next frame: excluded from the search.
    """

    def __init__(self, tracker_options: Mapping[str, Any] | None = None) -> None:
        self.background = Background()
        self.candidates: list[Candidate] = []
        self.trials: list[Trial] = []
        self.found: Trial | None = None
        self.body = Body.none()
        self._tracker_options = dict(tracker_options or {})
        self._finder = HandFinder()
        self._refused: list[_Refusal] = []
        self._score_factors = np.empty(0)
        self._known_frames = 0
        self._unconfirmed_frames = 0
        self._known_length: float | None = None

    def update_background(self, frame: Frame) -> Background:
        """Return the background model, prepared for this frame."""
        self.background.look(frame.grey(), frame.colour())
        return self.background

    def learn(self, frame: Frame, track: Track | None) -> None:
        """Learn the background from `update_background`'s last frame.

        Excluded are a tracked hand and, before a known background, moving bodies and trials that
        may be hands: one that rests while it is hidden, here or in another view, would be learned
        otherwise before it can be found.
        """
        line = track.finger_line if track is not None else None
        hands = [trial.line for trial in self.trials if trial.is_hand_before_background]
        keep_out = [hand_region(hand) for hand in (line, *hands) if hand is not None]
        if self.background.is_known:
            keep_out += self.body.discs()
        self.background.learn(frame.grey(), frame.colour(), keep_out=keep_out)
        self._known_frames = self._known_frames + 1 if self.background.is_known else 0

    def reset_background(self) -> None:
        """Reset the background model: it may contain the hand."""
        self.background.clear()
        self._known_frames = 0

    def remember_length(self, length: float) -> None:
        """Take over the length of the finger's template before its loss [half-widths]."""
        self._known_length = length

    def update(self, frame: Frame) -> None:
        """Update the trials and detect candidates."""
        for trial in self.trials:
            trial.update(frame, self.background)
        candidates = self._finder.find(frame.grey(), frame.colour(), background=self.background)
        self.candidates = [c for c in candidates if not self.body.shows_at(c.start)]
        for refusal in self._refused:
            refusal.frames += 1
        self._refused = [refusal for refusal in self._refused if refusal.frames < RETRY_FRAMES]
        self.trials = distinct(
            trial
            for trial in self.trials
            if not (trial.is_over or self.body.shows_as(trial.track.finger_line))
        )
        if self.found not in self.trials:
            self.found = None

    def poses(self) -> list[FingerDetection]:
        """Return the poses of the candidates, followed by those of the trials."""
        starts = [(c.start.tip_px, c.start.angle_rad, c.half_width_px) for c in self.candidates]
        trials = [trial.pose for trial in self.trials]
        return [FingerDetection(*pose) for pose in starts + trials]

    def score_trials(self, frame: Frame, flat: Array, trials_flat: Array) -> None:
        """Update the scores from the flatness of candidates and trials and the trials' pixels.

        The frame is the last one of `update`.
        """
        self._score_factors = 1.0 - (1.0 - FLAT_SCORE_FACTOR) * flat
        for trial, trial_flat in zip(self.trials, trials_flat, strict=True):
            factor = 1.0 - (1.0 - FLAT_SCORE_FACTOR) * float(trial_flat)
            trial.update_scores(frame, self.background, factor)

    def stop(self) -> None:
        """End the search, once a hand is followed for good or the view is reset."""
        self.candidates, self.trials, self.found = [], [], None
        self._score_factors = np.empty(0)

    def is_refused(self, candidate: Candidate) -> bool:
        """Whether a fit has rejected a candidate in the last frames."""
        start, reach_px = candidate.start, candidate.half_width_px
        return any(are_near(start, r.start, reach_px, 0.25) for r in self._refused)

    def _is_tried(self, start: StartPose, half_width_px: float) -> bool:
        return any(trial.is_at(start, half_width_px) for trial in self.trials)

    def start_trial(self, candidate: Candidate, frame: Frame) -> bool:
        """Start a trial at a candidate of this frame; False if there is one already, or no room.

        A candidate is rejected if its fit gives no finger line, a stripe among stripes, or the line
        of an existing trial.
        """
        start, half_width_px = candidate.start, candidate.half_width_px
        if self._is_tried(start, half_width_px):
            return False
        worst = None
        if len(self.trials) >= MAX_TRIALS:
            worst = min(self.trials, key=lambda trial: (trial is self.found, trial.priority))
            if worst.priority >= candidate.score * precedence(candidate.foreground):
                return False
        tracker = self._tracker_at(start, half_width_px)
        track = tracker.update(frame.grey(), frame.time_s, frame.colour())
        line = track.finger_line
        if (
            line is None
            or self.body.shows_as(line)
            or count_stripes(0, frame, track) > 0
            or self._is_tried(
                StartPose(line.tip_px, line.angle_rad, start.length_px), half_width_px
            )
        ):
            self._refused.append(_Refusal(start))
            return True
        if worst is not None:
            self.trials.remove(worst)
        factor = self._score_factors[self.candidates.index(candidate)]
        score, is_settled = candidate.score * factor, self._known_frames > SETTLED_FRAMES
        is_known = not np.isnan(foreground_part(self.background, frame, line))
        self.trials.append(
            Trial(
                candidate,
                tracker,
                track,
                first_line=line,
                line=line,
                score=float(score),
                foreground=candidate.foreground,
                widening=widening(frame, line, candidate.half_width_px),
                is_late=is_settled and is_known,
                extension=TemplateExtension(self._tracker_at, half_width_px, self._known_length),
            )
        )
        return True

    def accept(self, trial: Trial | None) -> None:
        """Accept a trial as the hand; None counts an unconfirmed frame."""
        if trial is None:
            self._unconfirmed_frames += 1
            if self._unconfirmed_frames >= UNCONFIRMED_FRAMES:
                self.found = None
            return
        self._unconfirmed_frames = 0
        line = trial.track.finger_line
        if trial is not self.found and line is not None and not trial.is_foreground:
            # It was present from the start: the background learned there is the hand.
            self.background.forget(hand_region(line))
        self.found = trial

    def candidate_detections(self) -> list[FingerDetection]:
        """Return the detections of the candidates, in their order."""
        return [
            FingerDetection(
                c.start.tip_px,
                c.start.angle_rad,
                c.half_width_px,
                c.score * float(factor),
                self._if_known(c.foreground),
                c.colour,
                c.start.length_px / c.half_width_px,
            )
            for c, factor in zip(self.candidates, self._score_factors, strict=True)
        ]

    def trial_detections(self) -> list[FingerDetection]:
        """Return the detections of the trials, in their order, each of its last finger line."""
        return [
            FingerDetection(
                *trial.pose,
                trial.score,
                np.nan if trial.is_moving else self._if_known(trial.foreground),
                trial.candidate.colour,
                trial.length,
            )
            for trial in self.trials
        ]

    def _if_known(self, foreground: float) -> float:
        return foreground if self.background.is_known else np.nan

    def _tracker_at(self, start: StartPose, half_width_px: float) -> ContourTracker:
        # Admissible range of a template's proportions.
        half_width = min(max(half_width_px / start.length_px, 0.03), 0.4)
        template = Template.pistol("none", proportions={"half_width": half_width})
        acquire = {**self._tracker_options.get("acquire", {}), "settle_frames": 1}
        return ContourTracker.at_hand(
            template, start, {**self._tracker_options, "acquire": acquire}
        )
