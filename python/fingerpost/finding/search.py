"""The search for a hand in one view: candidates, and the trials that were started at them."""

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
from fingerpost.finding.finger import Array, Sighting, are_near, hand_region
from fingerpost.finding.length import Lengthening
from fingerpost.finding.look import widening
from fingerpost.finding.trial import Trial, distinct, precedence

MOST_TRIALS = 8
"""Trials at a time in one view; each costs about as much as tracking."""

TRY_AGAIN = 6
"""Frames after which a candidate that the fit has refused is tried again."""

SETTLED_FRAMES = 10
"""A trial that starts in the background this many frames after that was known is no hand: that
would have been seen to come."""

UNBELIEVED_FRAMES = 3
"""What has been found in one view is dropped when no other view has shown it for so many frames."""

FLAT_WORTH = 0.1
"""What a flat finger is worth."""


@dataclass(slots=True)
class _Refusal:
    """Where a fit has found no hand, and how many frames ago."""

    start: StartPose
    frames: int = 0


class HandSearch:
    """The search for a hand in one view.

    Parameters
    ----------
    tracker_options
        What differs from the tracker's defaults.

    Attributes
    ----------
    candidates, trials
        Those of the last frame.
    found
        The trial that is believed to be the hand, if any.
    body
        What the system itself moves, as the next frame shows it: nothing is looked for there.
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
        self._worth = np.empty(0)
        self._known_frames = 0
        self._unbelieved_frames = 0
        self._known_length: float | None = None

    def look_behind(self, frame: Frame) -> Background:
        """Return what is behind the hand, as this frame shows it."""
        self.background.look(frame.grey(), frame.colour())
        return self.background

    def learn(self, frame: Frame, track: Track | None) -> None:
        """Learn what is behind the hand; a hand that is tracked is kept out of it.

        The frame is the one that `look_behind` has seen last.
        """
        line = track.finger_line if track is not None else None
        keep_out = None if line is None else hand_region(line)
        self.background.learn(frame.grey(), frame.colour(), keep_out=keep_out)
        self._known_frames = self._known_frames + 1 if self.background.is_known else 0

    def forget_behind(self) -> None:
        """Learn anew what is behind the hand: the hand itself may have been learned there."""
        self.background.clear()
        self._known_frames = 0

    def remember_length(self, length: float) -> None:
        """Take a template of this length, in half-widths, to be long enough for the finger."""
        self._known_length = length

    def look(self, frame: Frame) -> None:
        """Go on with the trials, and find what else could be tried."""
        for trial in self.trials:
            trial.update(frame, self.background)
        candidates = self._finder.find(frame.grey(), frame.colour(), background=self.background)
        self.candidates = [c for c in candidates if not self.body.shows_at(c.start)]
        for refusal in self._refused:
            refusal.frames += 1
        self._refused = [refusal for refusal in self._refused if refusal.frames < TRY_AGAIN]
        self.trials = distinct(
            trial
            for trial in self.trials
            if not (trial.is_over or self.body.shows_as(trial.track.finger_line))
        )
        if self.found not in self.trials:
            self.found = None

    def places(self) -> list[Sighting]:
        """Return where the candidates are, and after them the trials."""
        starts = [(c.start.tip_px, c.start.angle_rad, c.half_width_px) for c in self.candidates]
        trials = [trial.place for trial in self.trials]
        return [Sighting(*place) for place in starts + trials]

    def judge(self, frame: Frame, flat: Array, trials_flat: Array) -> None:
        """Take over how flat candidates and trials look, and what else the pixels tell of trials.

        The frame is the one that `look` has had last.
        """
        self._worth = 1.0 - (1.0 - FLAT_WORTH) * flat
        for trial, trial_flat in zip(self.trials, trials_flat, strict=True):
            trial.judge(frame, self.background, 1.0 - (1.0 - FLAT_WORTH) * float(trial_flat))

    def rest(self) -> None:
        """Give up the search: the hand is followed for good, or nothing is seen."""
        self.candidates, self.trials, self.found = [], [], None
        self._worth = np.empty(0)

    def is_refused(self, candidate: Candidate) -> bool:
        """Tell whether a fit has refused a candidate in the last frames."""
        start, reach_px = candidate.start, candidate.half_width_px
        return any(are_near(start, r.start, reach_px, 0.25) for r in self._refused)

    def _is_tried(self, start: StartPose, half_width_px: float) -> bool:
        return any(trial.is_at(start, half_width_px) for trial in self.trials)

    def try_out(self, candidate: Candidate, frame: Frame) -> bool:
        """Start a trial at a candidate of this frame; tell if there was none there already.

        One from which the fit leads to no finger, or to one that is tried already, is refused.
        """
        start, half_width_px = candidate.start, candidate.half_width_px
        if self._is_tried(start, half_width_px):
            return False
        worst = None
        if len(self.trials) >= MOST_TRIALS:
            worst = min(self.trials, key=lambda trial: (trial is self.found, trial.worth))
            if worst.worth >= candidate.score * precedence(candidate.foreground):
                return False
        tracker = self._tracker_at(start, half_width_px)
        track = tracker.update(frame.grey(), frame.time_s, frame.colour())
        line = track.finger_line
        if (
            line is None
            or self.body.shows_as(line)
            or self._is_tried(
                StartPose(line.tip_px, line.angle_rad, start.length_px), half_width_px
            )
        ):
            self._refused.append(_Refusal(start))
            return True
        if worst is not None:
            self.trials.remove(worst)
        place = self.candidates.index(candidate)
        score, is_late = candidate.score * self._worth[place], self._known_frames > SETTLED_FRAMES
        self.trials.append(
            Trial(
                candidate,
                tracker,
                track,
                first_line=line,
                line=line,
                score=float(score),
                foreground=candidate.foreground,
                hand=widening(frame, line, candidate.half_width_px),
                is_late=is_late,
                lengthening=Lengthening(self._tracker_at, half_width_px, self._known_length),
            )
        )
        return True

    def believe(self, trial: Trial | None) -> None:
        """Take a trial, if any, for the hand."""
        if trial is None:
            self._unbelieved_frames += 1
            if self._unbelieved_frames >= UNBELIEVED_FRAMES:
                self.found = None
            return
        self._unbelieved_frames = 0
        line = trial.track.finger_line
        if trial is not self.found and line is not None and not trial.has_come:
            # It was there from the start: what was learned there is the hand.
            self.background.forget(hand_region(line))
        self.found = trial

    def candidate_sightings(self) -> list[Sighting]:
        """Return what is seen of the candidates, one for each."""
        return [
            Sighting(
                c.start.tip_px,
                c.start.angle_rad,
                c.half_width_px,
                c.score * float(worth),
                self._if_known(c.foreground),
                c.colour,
                c.start.length_px / c.half_width_px,
            )
            for c, worth in zip(self.candidates, self._worth, strict=True)
        ]

    def trial_sightings(self) -> list[Sighting]:
        """Return what is seen of the trials, one for each, or was in the last frame."""
        return [
            Sighting(
                *trial.place,
                trial.score,
                np.nan if trial.moves_on else self._if_known(trial.foreground),
                trial.candidate.colour,
                trial.length,
            )
            for trial in self.trials
        ]

    def _if_known(self, foreground: float) -> float:
        return foreground if self.background.is_known else np.nan

    def _tracker_at(self, start: StartPose, half_width_px: float) -> ContourTracker:
        # The range that a template's proportions may have.
        half_width = min(max(half_width_px / start.length_px, 0.03), 0.4)
        template = Template.pistol("none", proportions={"half_width": half_width})
        acquire = {**self._tracker_options.get("acquire", {}), "settle_frames": 1}
        return ContourTracker.at_hand(
            template, start, {**self._tracker_options, "acquire": acquire}
        )
