"""State of one view: its tracker, its search, and the validation of what it follows."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
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
from fingerpost.finding.foreground import is_background, may_have_come
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

AT_TEMPLATE = 0.5
AT_TEMPLATE_RAD = 0.6
"""Greatest distance between the fingertip and the initial template's tip [template lengths], and
greatest angle between both, at which a hand is presented: the template's capture range."""

STOOD_FRAMES = 8
"""Frames in which a finger is static while another view's moves, after which it is rejected."""


class HandView:
    """One view: its tracker, its search for the hand, and its homography.

    A view with a start pose waits there with the initial template until it has followed a hand. If
    no hand comes there, it also searches the whole image, as does a view without a start pose and
    any view that has lost the hand; see `fingerpost.finding`.

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
        self._doubtful_frames = 0
        self.search = HandSearch(tracker_options)
        self._tracker: ContourTracker | None = None
        self._track: Track | None = None
        self._latest: deque[FingerLine] = deque(maxlen=STOOD_FRAMES)
        self._last_seen: LastSeen | None = None
        self._memory = Memory()
        self.is_recognised = False
        """Whether its finger has the appearance of the hand it followed before."""
        self._background_frames = 0
        self._is_table = False
        self._table_frames = 0
        self._unsupported_frames = 0
        self._alone_frames = 0
        self._no_point_frames = 0
        self._has_camera_moved = False
        self._is_elsewhere = False
        self._is_supported = False
        self._frames = 0
        self._flat_frames = 0
        self._missed_frames = 0
        self._waiting_frames = 0
        self.missing = Status.ACQUIRING
        """Status without a tracker: acquiring the first hand, or lost."""
        self.log_width_ratio: float | None = None
        """Running mean of the logarithm of the finger's width here over that in the view that
        agrees best; None if unknown."""
        self._foreshortening: float | None = None
        self._flanks = Flanks()
        self._tip = TipTest()
        self._stripe_frames = 0
        self._extension: TemplateExtension | None = None
        self._first_hand: FirstHand | None = None
        self._start: StartPose | None = None
        if view.start is not None:
            template = Template.pistol(view.start.thumb)
            tip_px, angle_deg = view.start.tip_px, view.start.angle_deg
            start = StartPose(tip_px, np.radians(angle_deg), view.start.length_px)
            self._start = start
            waiting = partial(ContourTracker, template, start, tracker_options)
            self._tracker = waiting()
            self._first_hand = FirstHand(self.search.background, start, waiting)

    @property
    def is_searching(self) -> bool:
        """Whether the whole image is to be searched for the hand.

        True without a tracker; while there is foreground away from the initial template; while
        another view follows a hand that has bypassed the template; and while this view's finger
        has no support by another view, gives no point, or is missed.
        """
        if self._tracker is None or self._misses_hand:
            return True
        if self._is_alone_for_long or self._no_point_frames >= NO_POINT_FRAMES:
            return True
        # A trial found beside an unsupported finger is not yet proven.
        if self.search.found is not None:
            return True
        return self._missed_frames >= MISSED_FRAMES or self._waiting_frames >= WAITING_FRAMES

    @property
    def _misses_hand(self) -> bool:
        """Whether another view has a hand that has not come to this view's template."""
        return self._is_elsewhere and not (self.is_sure or self.shows_finger)

    @property
    def shows_finger(self) -> bool:
        """Whether its tracker has a finger line in this frame."""
        return self._track is not None and self._track.finger_line is not None

    @property
    def _is_alone_for_long(self) -> bool:
        return self._alone_frames >= ALONE_FRAMES

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
        return self.search.found.tracker if self.search.found is not None else self._tracker

    @property
    def track(self) -> Track | None:
        """Result for the last frame of the accepted trial, or else of the view's tracker."""
        return self.search.found.track if self.search.found is not None else self._track

    @property
    def foreshortening(self) -> float | None:
        """Running mean of the finger's image length over its true length, in (0, 1].

        None if unknown. Setting it sets the tracker's as well.
        """
        return self._foreshortening

    @foreshortening.setter
    def foreshortening(self, foreshortening: float) -> None:
        self._foreshortening = foreshortening
        if self.tracker is not None:
            self.tracker.foreshortening = foreshortening

    def may_follow(self, trial: Trial) -> bool:
        """Whether a trial may be the hand lost here, by colour and width."""
        return self._memory.is_compatible(trial.appearance, trial.track.time_s)

    @property
    def is_presented(self) -> bool | None:
        """Whether its hand is at the rig's initial template; None without one."""
        line = self.track.finger_line if self.track is not None else None
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
            if self._last_seen is None
            else self._last_seen.direction_likelihood(angle_rad, time_s)
        )

    @property
    def axis_correction(self) -> AxisCorrection:
        """Correction from the line between the visible edges to the finger's axis."""
        axis_correction = self._flanks.axis_correction
        by_width = sigma_from_width_ratio(self.log_width_ratio or 0.0)
        sigma = math.hypot(by_width, axis_correction.sigma, self._tip.sigma)
        return axis_correction._replace(sigma=sigma)

    @property
    def hand(self) -> tuple[NDArray[np.float64], NDArray[np.float64], float] | None:
        """Image region of the hand in the last frame; None without a finger line."""
        line = self.track.finger_line if self.track is not None else None
        return None if line is None else hand_region(line)

    @property
    def has_newcomer(self) -> bool:
        """Whether it has followed a hand that came after the background was learned."""
        first = self._first_hand
        return self._tracker is not None if first is None else first.is_newcomer

    @property
    def has_rival(self) -> bool:
        """Whether its second template has found another finger."""
        return self._first_hand is not None and self._first_hand.has_rival

    @property
    def is_sure(self) -> bool:
        """Whether its finger, if any, is validated as a hand and cannot be the table."""
        return self._first_hand is None or self._first_hand.is_proven

    def view_frame(self, frame: Frame) -> ViewFrame | None:
        """Return the tracker and its inputs for a frame; None without a tracker."""
        background = self.search.update_background(frame)
        self._confirm_first_hand(frame)
        if self._tracker is None:
            return None
        known = background if self._stands_free else None
        return self._tracker, frame.grey(), frame.time_s, frame.colour(), known

    def follow(self, frame: Frame, track: Track) -> None:
        """Store the tracker's result for the view's frame."""
        self.may_show_body = self._body.shows_as(track.finger_line)
        if self.may_show_body and not self.is_sure:
            self.judge_body(is_hand=False)
            return
        if self._is_other_hand(frame, track):
            self._abandon(had_hand=self.is_sure, keeps_memory=True)
            return
        self._count_missed(track)
        self._count_waiting(frame, track)
        self._track = track
        if self._extension is not None and self._tracker is not None:
            self._tracker, self._track = self._extension.update(
                self._tracker, track, frame, self.search.background
            )
        if self._stripe_frames > 0 or self._frames % TEST_EVERY == 0:
            self._stripe_frames = count_stripes(self._stripe_frames, frame, self._track)
        if self._stripe_frames >= STRIPE_FRAMES:
            self._abandon(had_hand=self.is_sure)
            return
        if self._first_hand is not None:
            self._first_hand.prove(frame, track.finger_line)
        # The jump of a template from the table to the hand is not the hand's motion.
        if track.finger_line is not None and self.is_sure:
            self._latest.append(track.finger_line)
            self._last_seen = LastSeen(track.finger_line.angle_rad, frame.time_s)
        if track.finger_line is not None and self.is_sure and not self.may_show_body:
            self._learn_appearance(frame, track.finger_line)

    def _is_other_hand(self, frame: Frame, track: Track) -> bool:
        """Whether a tracker that had lost its hand has found one of another appearance."""
        line = track.finger_line
        half_width_px = fitted_half_width_px(track)
        if line is None or half_width_px is None or self._missed_frames == 0:
            return False
        return not self._memory.is_compatible(
            Appearance.of(frame, line, half_width_px), frame.time_s
        )

    def judge_body(self, *, is_hand: bool | None) -> None:
        """Set whether the finger within a body's silhouette is a hand.

        None means unknown: it is treated as no hand, and rejected after `ALONE_FRAMES`.
        """
        self.shows_body = not is_hand
        self._doubtful_frames = self._doubtful_frames + 1 if is_hand is None else 0
        if is_hand is False or self._doubtful_frames >= ALONE_FRAMES:
            self.may_show_body = False
            self._abandon(had_hand=self.is_sure, keeps_memory=True)

    @property
    def tip_px(self) -> tuple[float, float] | None:
        """Tip of its finger line; None without one."""
        line = self.track.finger_line if self.track is not None else None
        return None if line is None else line.tip_px

    def _learn_appearance(self, frame: Frame, line: FingerLine) -> None:
        """Learn the appearance of a hand that is followed for good."""
        half_width_px = fitted_half_width_px(self._track)
        if half_width_px is not None:
            self._memory.learn(Appearance.of(frame, line, half_width_px), frame.time_s)

    def _count_waiting(self, frame: Frame, track: Track) -> None:
        """Count the consecutive frames with foreground but no hand at the template."""
        is_waiting = track.status == "acquiring"
        may_be_elsewhere = is_waiting and may_have_come(self.search.background, frame)
        self._waiting_frames = self._waiting_frames + 1 if may_be_elsewhere else 0

    def _count_missed(self, track: Track) -> None:
        """Count the consecutive frames in which the followed finger is missed."""
        is_bent = track.status == "tracking" and track.diagnostics.refusal == "misfit"
        is_missed = track.finger_line is None and track.status != "acquiring" and not is_bent
        if is_missed and self._missed_frames == 0 and self._tracker is not None:
            self._remember_length(self._tracker)
        self._missed_frames = self._missed_frames + 1 if is_missed else 0

    def _remember_length(self, tracker: ContourTracker) -> None:
        """Accept a template of the length that was followed until the last frame."""
        half_width_px = fitted_half_width_px(self._track)
        if self._latest and half_width_px is not None:
            self.search.remember_length(length_px(tracker, self._latest[-1]) / half_width_px)

    @property
    def may_follow_table(self) -> bool:
        """Whether the flatness of the followed finger is to be tested with this frame."""
        if self._first_hand is not None and self._first_hand.may_be_flat:
            return True
        return self._flat_frames > 0 or self._frames % TEST_EVERY == 0

    def reject_if_flat(self, flat: float) -> None:
        """Reject the followed finger if it lies in the plane.

        An initial template waits again (see `FirstHand.update_flatness`). A hand that has moved
        away is searched for, and so is one whose shadow was followed. In the latter case the
        background model is reset, for it contains the hand.
        """
        first = self._first_hand
        if first is None or not first.may_be_flat:
            self._flat_frames = self._flat_frames + 1 if flat >= MIN_FLATNESS else 0
            if self._flat_frames >= FLAT_FRAMES:
                self._release()
                self.search.reset_background()
            return
        if first.update_flatness(flat):
            self._abandon(had_hand=first.has_moved)

    def _abandon(self, *, had_hand: bool, keeps_memory: bool = False) -> None:
        """Reject the followed finger; an initial template that has had no hand waits again.

        With `keeps_memory` the appearance of the hand followed before is kept.
        """
        waiting = None if self._first_hand is None else self._first_hand.restart_waiting()
        if had_hand or waiting is None:
            memory = self._memory
            self._release()
            self._memory = memory if keeps_memory else self._memory
        else:
            self._tracker, self._track = waiting, None

    def is_quiet(self, frame: Frame) -> bool:
        """Whether a frame shows neither a finger nor foreground that may be a hand.

        The frame is the last one of `view_frame`.
        """
        shows_finger = self.shows_finger or self.search.found is not None
        return not (shows_finger or may_have_come(self.search.background, frame))

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
        self._is_table = self._shows_background(frame)
        if self._first_hand is None and self._is_table:
            self._release()
        self.search.learn(frame, self.track if self.is_sure else None)
        if not self.is_searching:
            self.search.stop()
        elif not rests:
            self.search.update(frame)

    def _shows_background(self, frame: Frame) -> bool:
        """Whether the followed finger has been background for `BACKGROUND_FRAMES`.

        A tracker that has lost a hand may lock on to an edge of the table.
        """
        line = self._track.finger_line if self._track is not None else None
        if line is None:
            return False
        self._background_frames += 1
        if not is_background(self.search.background, frame, line):
            self._background_frames = 0
        return self._background_frames >= BACKGROUND_FRAMES

    def _confirm_first_hand(self, frame: Frame) -> None:
        """Switch to the second template if it has found the hand; the first may be on the table."""
        if self._first_hand is None:
            return
        track = None if self._is_table else self._track
        line = track.finger_line if track is not None else None
        second = self._first_hand.confirm(frame, line, is_supported=self._is_supported)
        self._tracker = second or self._tracker

    @property
    def _stands_free(self) -> bool:
        """Whether the followed finger was not part of the background when that was learned."""
        return self.is_sure or (self._first_hand is not None and self._first_hand.has_come)

    def settle(self) -> None:
        """Follow the accepted trial for good, once it is proven."""
        found = self.search.found
        if found is not None and found.is_proven:
            self.is_recognised = self._memory.recognises(found.appearance, found.track.time_s)
            self._tracker, self._track = found.tracker, found.track
            self._extension = found.extension
            self._stripe_frames = found.stripe_frames
            if self._first_hand is not None:
                self._first_hand.accept_from_search()
            self.missing = Status.LOST
            self.search.stop()

    def test_flanks(self, frame: Frame | None) -> None:
        """Update the axis correction from a frame's flanks."""
        if frame is not None:
            self._flanks.update(frame, self.track)

    def test_tip(self, frame: Frame | None) -> None:
        """Update the axis correction from what is ahead of the tip in a frame."""
        line = self.track.finger_line if self.track is not None else None
        half_width_px = fitted_half_width_px(self.track)
        if frame is not None and line is not None and half_width_px is not None:
            self._tip.update(self.search.background, frame, line, half_width_px)

    def validate(self, others: Sequence[HandView], shared: PairTests) -> None:
        """Reject the followed finger after frames without support by another view.

        A hand that the search has found must give a point with another view. One that was held up
        to an initial template is unsupported only while every other view follows another finger.
        """
        if self._first_hand is None:
            is_alone = not any(shared.can_be_one(self, other) for other in others)
        else:
            is_alone = all(
                shared.have_two_tips(self, other) or shared.are_two(self, other) for other in others
            )
        self._unsupported_frames = self._unsupported_frames + 1 if is_alone else 0
        self._alone_frames = self._alone_frames + 1 if self._is_alone(others, shared) else 0
        self._count_frames_without_point(others, shared)
        self._is_supported = self._is_supported_by(others, shared)
        self._recognise(others, shared)
        # A hand that has come into another view is foreground in this one, too.
        is_table = self._is_table and not self.is_sure and any(o.has_newcomer for o in others)
        self._table_frames = self._table_frames + 1 if is_table else 0
        if (
            self._table_frames >= BACKGROUND_FRAMES
            or self._unsupported_frames >= UNSUPPORTED_FRAMES
            or self._is_left_behind(others, shared)
        ):
            self._release()

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
            self._no_point_frames, self._has_camera_moved = 0, False
        elif pairs:
            self._no_point_frames += 1
            if self._no_point_frames == NO_POINT_FRAMES and self._has_camera_moved:
                self.search.reset_background()

    def _is_left_behind(self, others: Sequence[HandView], shared: PairTests) -> bool:
        """Whether this finger is static while another view's has moved.

        A finger that moves towards a camera is static in its image, but the tips continue to agree.
        """
        return len(self._latest) == STOOD_FRAMES and any(
            len(other._latest) == STOOD_FRAMES
            and is_left_behind(self._latest, other._latest)
            and not shared.share_tip(self, other)
            for other in others
        )

    def _is_supported_by(self, others: Sequence[HandView], shared: PairTests) -> bool:
        """Whether another view supports this finger against the one of the second template.

        The other view must follow the same finger and have found no other. A finger without a line
        in this frame, as a bent one, is supported. A newcomer in another view supports nothing that
        was here before: a pattern on the table may agree with it by chance.
        """
        if not self.has_rival or self._track is None:
            return False
        if not self.shows_finger:
            return self._track.status == "tracking"
        return any(
            shared.are_one(self, other) and not (other.has_rival or other.has_newcomer)
            for other in others
        )

    def _recognise(self, others: Sequence[HandView], shared: PairTests) -> None:
        """Accept a finger present before the background was learned, if another view shows it come.

        A pattern on the table is identified as such within a few frames.
        """
        first = self._first_hand
        if first is None or first.is_proven or first.has_second_template or self._is_table:
            return
        if not self.shows_finger:
            return
        if any(other.has_newcomer and shared.can_be_one(self, other) for other in others):
            first.accept_from_view()

    def _release(self) -> None:
        """Reset: follow nothing and search the whole image."""
        self._tracker, self._track, self._unsupported_frames, self._is_table = None, None, 0, False
        self._alone_frames, self._no_point_frames = 0, 0
        self._flat_frames, self._missed_frames, self._doubtful_frames = 0, 0, 0
        self._extension = None
        self._flanks.forget()
        self._tip.forget()
        self._stripe_frames = 0
        self._foreshortening = None
        self._latest.clear()
        self._last_seen = None
        self._memory = Memory()
        self.missing = Status.LOST
        self.search.stop()
