"""State of one view: its tracker, its search, and the validation of what it follows."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fingerpost._core import Background, ContourTracker, FingerLine, StartPose, Template, Track
from fingerpost.capture import Frame
from fingerpost.config import View
from fingerpost.finding.body import Body
from fingerpost.finding.finger import (
    AxisCorrection,
    LastSeen,
    are_near,
    fitted_half_width_px,
    hand_region,
    is_left_behind,
    sigma_from_width_ratio,
)
from fingerpost.finding.first_hand import FirstHand
from fingerpost.finding.flanks import Flanks
from fingerpost.finding.foreground import any_foreground, is_background
from fingerpost.finding.identity import Appearance, Memory
from fingerpost.finding.length import TemplateExtension, length_px
from fingerpost.finding.one_finger import PairTests
from fingerpost.finding.pairs import Viewpoint
from fingerpost.finding.search import HandSearch
from fingerpost.finding.tip import TipTest
from fingerpost.finding.trial import STRIPE_FRAMES, Trial, count_stripes
from fingerpost.pointing import PlaneView, Status
from fingerpost.silhouette import Capsule

ViewFrame = tuple[
    ContourTracker, NDArray[np.uint8], float, NDArray[np.uint8] | None, Background | None
]
"""A tracker, and the frame to update it with: grey levels, capture time [s], colours if there are
any, and the background model if it is to be used."""

BACKGROUND_FRAMES = 8
"""Frames as background after which a finger is rejected."""

UNSUPPORTED_FRAMES = 20
"""Frames without support by another view after which a finger is rejected."""

ALONE_FRAMES = 10
"""Frames in which no other view follows a view's finger, after which the whole image is searched as
well: the finger may be another digit, such as the thumb. With fewer, a second hand would replace
one that the other view is about to find."""

NO_POINT_FRAMES = 10
"""Frames in which a view's finger gives no point with that of any other view, after which the whole
image is searched as well: the template may have locked on to another part of the hand."""

MIN_FLATNESS = 0.5
FLAT_FRAMES = 5
"""Flatness, and consecutive frames with at least that, after which a moving finger is rejected: it
is a shadow on the table. Fingers of 22 recordings reach it for one frame at most."""

TEST_EVERY = 4
"""Interval between tests of a followed finger for flatness and stripes; every frame is tested after
a positive one."""

WAITING_FRAMES = 3
"""Frames with a foreground but no hand at the template, after which the whole image is searched. A
hand at the template is found within as many; a search in between would cost it its first frames."""

MISSED_FRAMES = 2
"""Frames without a finger line after which the whole image is searched: the tracker may still wait
at the hand's last position."""

CERTAIN_FRAMES = 10
"""Consecutive frames in which a finger gives a point, after which its appearance is the hand's: a
forearm whose finger is hidden may give one by chance."""

AT_TEMPLATE = 0.5
AT_TEMPLATE_RAD = 0.6
"""Greatest distance between the fingertip and the initial template's tip [template lengths], and
greatest angle between both, at which a hand is presented: the template's capture range."""

STOOD_FRAMES = 8
"""Frames in which a finger is static while another view's moves, after which it is rejected."""


@dataclass(slots=True)
class Streak:
    """Number of consecutive frames in which a condition has held."""

    frames: int = 0

    def update(self, holds: bool) -> None:
        """Count a frame: one more if the condition holds in it, else none."""
        self.frames = self.frames + 1 if holds else 0


@dataclass(slots=True, eq=False)
class Followed:
    """What a view follows: a tracker, and the state of all tests of its finger.

    It is replaced as a whole when the finger is rejected, so that no test of the next finger begins
    with the evidence against the last one.
    """

    tracker: ContourTracker | None = None
    track: Track | None = None
    """Result for the last frame."""
    lines: deque[FingerLine] = field(default_factory=lambda: deque(maxlen=STOOD_FRAMES))
    """Latest lines of a validated finger."""
    last_seen: LastSeen | None = None
    memory: Memory = field(default_factory=Memory)
    extension: TemplateExtension | None = None
    flanks: Flanks = field(default_factory=Flanks)
    tip: TipTest = field(default_factory=TipTest)
    foreshortening: float | None = None
    is_table: bool = False
    """Whether its finger has been background for `BACKGROUND_FRAMES`."""
    stripe_frames: int = 0
    """Count of `count_stripes`."""
    background: Streak = field(default_factory=Streak)
    table: Streak = field(default_factory=Streak)
    unsupported: Streak = field(default_factory=Streak)
    alone: Streak = field(default_factory=Streak)
    without_point: Streak = field(default_factory=Streak)
    with_point: Streak = field(default_factory=Streak)
    flat: Streak = field(default_factory=Streak)
    missed: Streak = field(default_factory=Streak)
    doubtful: Streak = field(default_factory=Streak)
    waiting: Streak = field(default_factory=Streak)

    @property
    def line(self) -> FingerLine | None:
        """Finger line of the last frame; None without one."""
        return None if self.track is None else self.track.finger_line


class HandView:
    """One view: its tracker, its search for the hand, and its homography.

    A view with a start pose waits there with the initial template until it has followed a hand. If
    no hand comes there, it also searches the whole image, as does a view without a start pose and
    any view that has lost the hand; see `fingerpost.finding`.

    The order of a frame's calls is that of `fingerpost.pipeline.Pointer.update`: `exclude_bodies`,
    `view_frame`, `follow`, `judge_body`, `reject_if_flat`, `update_from_other_views`, `observe`,
    `settle`, `test_flanks`, `test_tip`, `validate`.

    Parameters
    ----------
    view
        The view of the rig.
    plane_points : (N, 2)
        The plane's reference points.
    tracker_options
        Deviations from the tracker's defaults; see `fingerpost.ContourTracker`.
    reference_sigma_px
        Standard deviation of reference points that come without a covariance [px], > 0.
    """

    def __init__(
        self,
        view: View,
        plane_points: Sequence[tuple[float, float]],
        tracker_options: Mapping[str, Any] | None,
        reference_sigma_px: float,
    ) -> None:
        self.name = view.name
        self.plane_view = PlaneView.from_reference_points(
            plane_points,
            view.reference_points_px,
            view.reference_covariances(reference_sigma_px),
            view.lens,
        )
        self.viewpoint = Viewpoint(self.plane_view, np.full(3, np.nan))
        self._size_px: tuple[int, int] | None = None
        self._body = Body.none()
        self.shows_body = False
        """Whether its tracker follows a moving body of the system in the last frame."""
        self.may_show_body = False
        """Whether its finger lies within the silhouette of such a body."""
        self.search = HandSearch(tracker_options)
        self._followed = Followed()
        self.is_recognised = False
        """Whether its finger has the appearance of the hand it followed before."""
        self._has_camera_moved = False
        self._is_elsewhere = False
        self._is_supported = False
        self._frames = 0
        self.missing = Status.ACQUIRING
        """Status without a tracker: acquiring the first hand, or lost."""
        self.log_width_ratio: float | None = None
        """Running mean of the logarithm of the finger's width here over that in the view that
        agrees best; None if unknown."""
        self._first_hand: FirstHand | None = None
        self._start: StartPose | None = None
        if view.start is not None:
            template = Template.pistol(view.start.thumb)
            tip_px, angle_deg = view.start.tip_px, view.start.angle_deg
            start = StartPose(tip_px, np.radians(angle_deg), view.start.length_px)
            self._start = start
            waiting = partial(ContourTracker, template, start, tracker_options)
            self._followed.tracker = waiting()
            self._first_hand = FirstHand(self.search.background, start, waiting)

    @property
    def is_searching(self) -> bool:
        """Whether the whole image is to be searched for the hand.

        True without a tracker; while there is foreground away from the initial template; while
        another view follows a hand that has bypassed the template; and while this view's finger
        has no support by another view, gives no point, or is missed.
        """
        if self._followed.tracker is None or self._misses_hand:
            return True
        if self._is_alone_for_long or self._followed.without_point.frames >= NO_POINT_FRAMES:
            return True
        # A trial found beside an unsupported finger is not yet proven.
        if self.search.found is not None:
            return True
        return (
            self._followed.missed.frames >= MISSED_FRAMES
            or self._followed.waiting.frames >= WAITING_FRAMES
        )

    @property
    def _misses_hand(self) -> bool:
        """Whether another view has a hand that has not come to this view's template."""
        return self._is_elsewhere and not (self.is_validated or self.shows_finger)

    @property
    def shows_finger(self) -> bool:
        """Whether its tracker has a finger line in this frame."""
        return self._followed.line is not None

    @property
    def _is_alone_for_long(self) -> bool:
        return self._followed.alone.frames >= ALONE_FRAMES

    def move(self, plane_view: PlaneView) -> None:
        """Set the homography after a motion of the camera."""
        if plane_view is self.plane_view:
            return
        self.plane_view, self._has_camera_moved = plane_view, True
        if self._size_px is not None:
            self.viewpoint = Viewpoint.of(plane_view, self._size_px)

    def exclude_bodies(self, bodies: Sequence[Capsule], frame: Frame | None) -> None:
        """Exclude the silhouettes of the system's moving bodies from the next frame.

        Parameters
        ----------
        bodies
            Their capsules, in plane coordinates.
        frame
            The view's next frame; None where there is none.
        """
        self.may_show_body = self.shows_body = False
        if frame is None:
            return
        height_px, width_px = frame.image.shape[:2]
        if self._size_px != (width_px, height_px):
            self._size_px = width_px, height_px
            self.viewpoint = Viewpoint.of(self.plane_view, self._size_px)
        self._body = Body.none()
        if bodies:
            self._body = Body(self.viewpoint.silhouette(bodies), self.plane_view.lens)
        self.search.body = self._body
        if self._first_hand is not None:
            self._first_hand.body = self._body

    def update_from_other_views(self, others: Sequence[HandView]) -> None:
        """Update from the other views: whether one has a new hand, or follows a hand alone."""
        self._is_elsewhere = any(other.has_newcomer or other._is_alone_for_long for other in others)

    @property
    def tracker(self) -> ContourTracker | None:
        """The tracker that follows: that of the accepted trial, or else the view's."""
        return (
            self.search.found.tracker if self.search.found is not None else self._followed.tracker
        )

    @property
    def track(self) -> Track | None:
        """Result for the last frame of the accepted trial, or else of the view's tracker."""
        return self.search.found.track if self.search.found is not None else self._followed.track

    @property
    def line(self) -> FingerLine | None:
        """Finger line of that result; None without one."""
        return None if self.track is None else self.track.finger_line

    @property
    def foreshortening(self) -> float | None:
        """Running mean of the finger's image length over its true length, in (0, 1].

        None if unknown. Setting it sets the tracker's as well.
        """
        return self._followed.foreshortening

    @foreshortening.setter
    def foreshortening(self, foreshortening: float) -> None:
        self._followed.foreshortening = foreshortening
        if self.tracker is not None:
            self.tracker.foreshortening = foreshortening

    def may_follow(self, trial: Trial) -> bool:
        """Whether a trial may be the hand lost here, by colour and width."""
        return self._followed.memory.is_compatible(trial.appearance, trial.track.time_s)

    @property
    def is_presented(self) -> bool | None:
        """Whether its hand is at the rig's initial template; None without one."""
        line = self.line
        if self._start is None or line is None:
            return None
        start = self._start
        here = StartPose(line.tip_px, line.angle_rad, start.length_px)
        return are_near(start, here, AT_TEMPLATE * start.length_px, AT_TEMPLATE_RAD)

    def direction_likelihood(self, angle_rad: float, time_s: float) -> float:
        """Return the likelihood of a direction of the finger lost here, relative, 0 to 1.

        1 if none was lost.
        """
        return (
            1.0
            if self._followed.last_seen is None
            else self._followed.last_seen.direction_likelihood(angle_rad, time_s)
        )

    @property
    def axis_correction(self) -> AxisCorrection:
        """Correction from the line between the visible edges to the finger's axis."""
        axis_correction = self._followed.flanks.axis_correction
        by_width = sigma_from_width_ratio(self.log_width_ratio or 0.0)
        sigma = math.hypot(by_width, axis_correction.sigma, self._followed.tip.sigma)
        return axis_correction._replace(sigma=sigma)

    @property
    def hand(self) -> tuple[NDArray[np.float64], NDArray[np.float64], float] | None:
        """Image region of the hand in the last frame; None without a finger line."""
        return None if self.line is None else hand_region(self.line)

    @property
    def has_newcomer(self) -> bool:
        """Whether its hand counts as evidence for the other views.

        Every hand that the search has found does; one at the initial template, if it came after the
        background was learned.
        """
        first = self._first_hand
        return self._followed.tracker is not None if first is None else first.is_newcomer

    @property
    def has_rival(self) -> bool:
        """Whether its second template has found another finger."""
        return self._first_hand is not None and self._first_hand.has_rival

    @property
    def is_validated(self) -> bool:
        """Whether its finger, if any, is validated as a hand and cannot be the table."""
        return self._first_hand is None or self._first_hand.is_proven

    def view_frame(self, frame: Frame) -> ViewFrame | None:
        """Return the tracker and its inputs for a frame; None without a tracker."""
        background = self.search.update_background(frame)
        self._confirm_first_hand(frame)
        if self._followed.tracker is None:
            return None
        known = background if self._stands_free else None
        return self._followed.tracker, frame.grey(), frame.time_s, frame.colour(), known

    def follow(self, frame: Frame, track: Track) -> None:
        """Store the tracker's result for the view's frame."""
        self.may_show_body = self._body.shows_as(track.finger_line)
        if self.may_show_body and not self.is_validated:
            self.judge_body(is_hand=False)
            return
        if self._is_other_hand(frame, track):
            self._abandon(had_hand=self.is_validated, keeps_memory=True)
            return
        self._count_missed(track)
        self._count_waiting(frame, track)
        self._followed.track = track
        if self._followed.extension is not None and self._followed.tracker is not None:
            self._followed.tracker, self._followed.track = self._followed.extension.update(
                self._followed.tracker, track, frame, self.search.background
            )
        if self._followed.stripe_frames > 0 or self._frames % TEST_EVERY == 0:
            self._followed.stripe_frames = count_stripes(
                self._followed.stripe_frames, frame, self._followed.track
            )
        if self._followed.stripe_frames >= STRIPE_FRAMES:
            self._abandon(had_hand=self.is_validated)
            return
        if self._first_hand is not None:
            self._first_hand.prove(frame, track.finger_line)
        # The jump of a template from the table to the hand is not the hand's motion.
        if track.finger_line is not None and self.is_validated:
            self._followed.lines.append(track.finger_line)
            self._followed.last_seen = LastSeen(track.finger_line.angle_rad, frame.time_s)
        if track.finger_line is not None and self.is_validated and not self.may_show_body:
            self._learn_appearance(frame, track.finger_line)

    def _is_other_hand(self, frame: Frame, track: Track) -> bool:
        """Whether a tracker that had lost its hand has found one of another appearance."""
        line = track.finger_line
        half_width_px = fitted_half_width_px(track)
        if line is None or half_width_px is None or self._followed.missed.frames == 0:
            return False
        return not self._followed.memory.is_compatible(
            Appearance.of(frame, line, half_width_px), frame.time_s
        )

    def judge_body(self, *, is_hand: bool | None) -> None:
        """Set whether the finger within a body's silhouette is a hand.

        None means unknown: it is treated as no hand, and rejected after `ALONE_FRAMES`.
        """
        self.shows_body = not is_hand
        self._followed.doubtful.update(is_hand is None)
        if is_hand is False or self._followed.doubtful.frames >= ALONE_FRAMES:
            self.may_show_body = False
            self._abandon(had_hand=self.is_validated, keeps_memory=True)

    @property
    def tip_px(self) -> tuple[float, float] | None:
        """Tip of its finger line; None without one."""
        return None if self.line is None else self.line.tip_px

    def _learn_appearance(self, frame: Frame, line: FingerLine) -> None:
        """Learn the appearance of a hand that is followed for good."""
        half_width_px = fitted_half_width_px(self._followed.track)
        if half_width_px is not None:
            self._followed.memory.learn(
                Appearance.of(frame, line, half_width_px),
                frame.time_s,
                is_certain=self._followed.with_point.frames >= CERTAIN_FRAMES,
            )

    def _count_waiting(self, frame: Frame, track: Track) -> None:
        """Count the consecutive frames with foreground but no hand at the template."""
        is_waiting = track.status == "acquiring"
        may_be_elsewhere = is_waiting and any_foreground(self.search.background, frame, self._body)
        self._followed.waiting.update(may_be_elsewhere)

    def _count_missed(self, track: Track) -> None:
        """Count the consecutive frames in which the followed finger is missed."""
        is_bent = track.status == "tracking" and track.diagnostics.refusal == "misfit"
        is_missed = track.finger_line is None and track.status != "acquiring" and not is_bent
        if is_missed and self._followed.missed.frames == 0 and self._followed.tracker is not None:
            self._remember_length(self._followed.tracker)
        self._followed.missed.update(is_missed)

    def _remember_length(self, tracker: ContourTracker) -> None:
        """Accept a template of the length that was followed until the last frame."""
        half_width_px = fitted_half_width_px(self._followed.track)
        if self._followed.lines and half_width_px is not None:
            self.search.remember_length(
                length_px(tracker, self._followed.lines[-1]) / half_width_px
            )

    @property
    def may_follow_table(self) -> bool:
        """Whether the flatness of the followed finger is to be tested with this frame."""
        if self._first_hand is not None and self._first_hand.may_be_flat:
            return True
        return self._followed.flat.frames > 0 or self._frames % TEST_EVERY == 0

    def reject_if_flat(self, flat: float) -> None:
        """Reject the followed finger if it lies in the plane.

        An initial template waits again (see `FirstHand.update_flatness`). A hand that has moved
        away is searched for, and so is one whose shadow was followed. In the latter case the
        background model is reset, for it contains the hand.
        """
        first = self._first_hand
        if first is None or not first.may_be_flat:
            self._followed.flat.update(flat >= MIN_FLATNESS)
            if self._followed.flat.frames >= FLAT_FRAMES:
                self.reject()
                self.search.reset_background()
            return
        if first.update_flatness(flat):
            self._abandon(had_hand=first.has_moved)

    def _abandon(self, *, had_hand: bool, keeps_memory: bool = False) -> None:
        """Reject the followed finger; an initial template that has had no hand waits again.

        With `keeps_memory` the appearance of the hand followed before is kept.
        """
        waiting = None if self._first_hand is None else self._first_hand.restart_waiting()
        memory = self._followed.memory
        if had_hand or waiting is None:
            self.reject()
        else:
            self._followed = Followed(waiting)
        if keeps_memory:
            self._followed.memory = memory

    def is_quiet(self, frame: Frame) -> bool:
        """Whether a frame shows neither a finger nor foreground that may be a hand.

        The frame is the last one of `view_frame`.
        """
        shows_finger = self.shows_finger or self.search.found is not None
        return not (shows_finger or any_foreground(self.search.background, frame, self._body))

    def observe(self, frame: Frame | None, *, rests: bool = False) -> None:
        """Learn the background from the tracker's last frame, and search it if required.

        Parameters
        ----------
        frame
            None stands for a frame that cannot be read.
        rests
            Whether the search rests: its candidates and trials stay as they are.
        """
        if frame is None:
            return
        self._frames += 1
        self._followed.is_table = self._shows_background(frame)
        if self._first_hand is None and self._followed.is_table:
            self.reject()
        self.search.learn(frame, self.track if self.is_validated else None)
        if not self.is_searching:
            self.search.stop()
        elif not rests:
            self.search.update(frame)

    def _shows_background(self, frame: Frame) -> bool:
        """Whether the followed finger has been background for `BACKGROUND_FRAMES`.

        A tracker that has lost a hand may lock on to an edge of the table. Frames without a line
        do not change the count.
        """
        line = self._followed.line
        if line is None:
            return False
        self._followed.background.update(is_background(self.search.background, frame, line))
        return self._followed.background.frames >= BACKGROUND_FRAMES

    def _confirm_first_hand(self, frame: Frame) -> None:
        """Switch to the second template if it has found the hand; the first may be on the table."""
        if self._first_hand is None:
            return
        line = None if self._followed.is_table else self._followed.line
        second = self._first_hand.confirm(frame, line, is_supported=self._is_supported)
        self._followed.tracker = second or self._followed.tracker

    @property
    def _stands_free(self) -> bool:
        """Whether the followed finger was not part of the background when that was learned."""
        return self.is_validated or (
            self._first_hand is not None and self._first_hand.entered_free_template
        )

    def settle(self) -> None:
        """Follow the accepted trial for good, once it is proven."""
        found = self.search.found
        if found is not None and found.is_proven:
            self.is_recognised = self._followed.memory.recognises(
                found.appearance, found.track.time_s
            )
            self._followed.tracker, self._followed.track = found.tracker, found.track
            self._followed.extension = found.extension
            self._followed.stripe_frames = found.stripe_frames
            if self._first_hand is not None:
                self._first_hand.accept_from_search()
            self.missing = Status.LOST
            self.search.stop()

    def test_flanks(self, frame: Frame | None) -> None:
        """Update the axis correction from a frame's flanks."""
        if frame is not None:
            self._followed.flanks.update(frame, self.track)

    def test_tip(self, frame: Frame | None) -> None:
        """Update the axis correction from what is ahead of the tip in a frame."""
        half_width_px = fitted_half_width_px(self.track)
        if frame is not None and self.line is not None and half_width_px is not None:
            background = self.search.background
            self._followed.tip.update(background, frame, self.line, half_width_px, self._body)

    def validate(self, others: Sequence[HandView], shared: PairTests) -> bool:
        """Return False for a followed finger after frames without support by another view.

        It is to be rejected once all views are validated: each is judged by the fingers of all.
        A hand that the search has found must give a point with another view. One that was held up
        to an initial template is unsupported only while every other view follows another finger.
        """
        if self._first_hand is None:
            is_alone = not any(shared.can_be_one(self, other) for other in others)
        else:
            is_alone = all(
                shared.have_two_tips(self, other) or shared.are_two(self, other) for other in others
            )
        self._followed.unsupported.update(is_alone)
        self._followed.alone.update(self._is_alone(others, shared))
        self._count_frames_without_point(others, shared)
        self._is_supported = self._is_supported_by(others, shared)
        self._recognise(others, shared)
        # A hand that has come into another view is foreground in this one, too.
        is_table = (
            self._followed.is_table
            and not self.is_validated
            and any(o.has_newcomer for o in others)
        )
        self._followed.table.update(is_table)
        return not (
            self._followed.table.frames >= BACKGROUND_FRAMES
            or self._followed.unsupported.frames >= UNSUPPORTED_FRAMES
            or self._is_left_behind(others, shared)
        )

    def _is_alone(self, others: Sequence[HandView], shared: PairTests) -> bool:
        """Whether it has a finger, and every other view another one or none."""
        return self.shows_finger and all(
            shared.are_two(self, other) or not other.shows_finger for other in others
        )

    def _count_frames_without_point(self, others: Sequence[HandView], shared: PairTests) -> None:
        """Count the frames in which no other view's finger gives a point with this one.

        Frames without another finger do not change the count. If the camera has moved meanwhile,
        the background model may contain the hand and is reset.
        """
        pairs = [other for other in others if self.shows_finger and other.shows_finger]
        if any(shared.can_be_one(self, other) for other in pairs):
            self._followed.with_point.update(self.search.found is None)  # else the trial gives it
            self._followed.without_point.update(False)
            self._has_camera_moved = False
        elif pairs:
            self._followed.with_point.update(False)
            self._followed.without_point.update(True)
            if self._followed.without_point.frames == NO_POINT_FRAMES and self._has_camera_moved:
                self.search.reset_background()

    def _is_left_behind(self, others: Sequence[HandView], shared: PairTests) -> bool:
        """Whether this finger is static while another view's has moved.

        A finger that moves towards a camera is static in its image, but the tips continue to agree.
        """
        return len(self._followed.lines) == STOOD_FRAMES and any(
            len(other._followed.lines) == STOOD_FRAMES
            and is_left_behind(self._followed.lines, other._followed.lines)
            and not shared.share_tip(self, other)
            for other in others
        )

    def _is_supported_by(self, others: Sequence[HandView], shared: PairTests) -> bool:
        """Whether another view supports this finger against the one of the second template.

        The other view must follow the same finger and have found no other. A finger without a line
        in this frame, as a bent one, is supported. A newcomer in another view supports nothing that
        was here before: a pattern on the table may agree with it by chance.
        """
        if not self.has_rival or self._followed.track is None:
            return False
        if not self.shows_finger:
            return self._followed.track.status == "tracking"
        return any(
            shared.are_one(self, other) and not (other.has_rival or other.has_newcomer)
            for other in others
        )

    def _recognise(self, others: Sequence[HandView], shared: PairTests) -> None:
        """Accept a finger present before the background was learned, if another view shows it come.

        A pattern on the table is identified as such within a few frames.
        """
        first = self._first_hand
        if first is None or first.is_proven or first.has_second_template or self._followed.is_table:
            return
        if not self.shows_finger:
            return
        if any(other.has_newcomer and shared.can_be_one(self, other) for other in others):
            first.accept_from_view()

    def reject(self) -> None:
        """Reject the followed finger, and search the whole image."""
        self._followed = Followed()
        self.missing = Status.LOST
        self.search.stop()
