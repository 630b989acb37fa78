"""One view of the hand: what it follows, what it looks for, and when it lets go."""

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
    Aside,
    LastSeen,
    are_near,
    fitted_half_width_px,
    hand_region,
    is_left_behind,
    off_by_width,
)
from fingerpost.finding.first_hand import FirstHand
from fingerpost.finding.flanks import Flanks
from fingerpost.finding.foreground import is_background, may_have_come
from fingerpost.finding.identity import Looks, Memory
from fingerpost.finding.length import Lengthening, length_px
from fingerpost.finding.one_finger import Shared
from fingerpost.finding.pairs import Viewpoint
from fingerpost.finding.search import HandSearch
from fingerpost.finding.trial import Trial
from fingerpost.pointing import PlaneView, Status
from fingerpost.silhouette import Capsule

ViewFrame = tuple[
    ContourTracker, NDArray[np.uint8], float, NDArray[np.uint8] | None, Background | None
]
"""A tracker, and the frame to update it with: grey levels, capture time [s], colours if there are
any, and what is behind the hand if that is known."""

BACKGROUND_FRAMES = 8
"""A finger that has been background for so many frames is none."""

DOUBTED_FRAMES = 20
"""Views that have given no point for so many frames follow different things."""

ALONE_FRAMES = 10
"""What no other view has followed for so many frames may be another finger than the one that
points, as the thumb: the hand is looked for everywhere beside it. Sooner, a second hand would take
the place of one that the other view is about to see."""

POINTLESS_FRAMES = 10
"""What has given no point with any other view's finger for so many frames may be a part of the hand
that its finger has passed the template with: the hand is looked for everywhere beside it, too."""

SEEMS_FLAT = 0.5
FLAT_FRAMES = 5
"""What has looked so flat to another view for so many frames lies on the table: it is no finger,
though it moves as one does, but its shadow. Fingers of 22 recordings did for one frame at most."""

FLAT_EVERY = 4
"""One frame in so many is asked for that, and every one once it has looked so."""

WAITED_FRAMES = 3
"""What has come within so many frames, and not to the template, may be a hand elsewhere. One that
is at the template has settled in as many; sooner, the search would cost it the first frames."""

MISSED_FRAMES = 2
"""A finger that was not seen for so many frames is looked for everywhere, for its tracker may still
wait for it where it was."""

AT_TEMPLATE = 0.5
AT_TEMPLATE_RAD = 0.6
"""A hand is held up to its template within so many of its lengths and so large an angle: those by
which a template still takes it."""

STOOD_FRAMES = 8
"""What has stood still for so many frames while another view's finger has moved is no finger."""


class HandView:
    """One view of the hand: its tracker, its search for the hand, and how it sees the plane.

    A view with a start pose waits there for the hand until it has followed one, and where that does
    not come at once looks everywhere beside it, as a view without does, and any that has lost the
    hand; see `fingerpost.finding`.

    Parameters
    ----------
    view
        The view of the rig.
    plane_points : (N, 2)
        The plane's reference points.
    tracker_options
        What differs from the tracker's defaults; see `fingerpost.ContourTracker`.
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
        """Whether its tracker has followed in the last frame what the system itself moves."""
        self.may_show_body = False
        """Whether the hand that it follows lies within the silhouette of what that may be."""
        self._doubtful_frames = 0
        self.search = HandSearch(tracker_options)
        self._tracker: ContourTracker | None = None
        self._track: Track | None = None
        self._latest: deque[FingerLine] = deque(maxlen=STOOD_FRAMES)
        self._last_seen: LastSeen | None = None
        self._memory = Memory()
        self.is_recognised = False
        """Whether what it follows looks like the hand that it had followed before."""
        self._background_frames = 0
        self._is_table = False
        self._table_frames = 0
        self._doubts = 0
        self._alone_frames = 0
        self._pointless_frames = 0
        self._has_camera_moved = False
        self._is_elsewhere = False
        self._is_backed = False
        self._frames = 0
        self._flat_frames = 0
        self._missed_frames = 0
        self._waited_frames = 0
        self.missing = Status.ACQUIRING
        """What it is while it follows nothing: looking for its first hand, or for a lost one."""
        self.odd_width: float | None = None
        """Logarithm of how many times as wide it has shown the finger lately as the view that
        agrees best; None where that is not known."""
        self._foreshortening: float | None = None
        self._flanks = Flanks()
        self._lengthening: Lengthening | None = None
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
        """Whether the hand may be anywhere: it is neither followed for good nor waited for.

        What has come, and not to the template, may be a hand elsewhere. One that another view has
        seen come, or follows alone, has passed a template that still waits for it; and what is
        followed here alone, or gives no point, may be none.
        """
        if self._tracker is None or self._misses_hand:
            return True
        if self._is_alone_for_long or self._pointless_frames >= POINTLESS_FRAMES:
            return True
        # What has been found beside what is followed alone is not yet proven.
        if self.search.found is not None:
            return True
        return self._missed_frames >= MISSED_FRAMES or self._waited_frames >= WAITED_FRAMES

    @property
    def _misses_hand(self) -> bool:
        """Whether another view has a hand that this one has not found where it waits."""
        return self._is_elsewhere and not (self.is_sure or self.shows_finger)

    @property
    def shows_finger(self) -> bool:
        """Whether it follows a finger that shows in this frame."""
        return self._track is not None and self._track.finger_line is not None

    @property
    def _is_alone_for_long(self) -> bool:
        return self._alone_frames >= ALONE_FRAMES

    def move(self, plane_view: PlaneView) -> None:
        """See the plane in another way from now on: the camera has moved."""
        if plane_view is self.plane_view:
            return
        self.plane_view, self._has_camera_moved = plane_view, True
        if self._size_px is not None:
            self.viewpoint = Viewpoint.of(plane_view, self._size_px)

    def look_past(self, bodies: Sequence[Capsule], frame: Frame | None) -> None:
        """Take nothing for a hand in this frame that is a part of what the system itself moves.

        Parameters
        ----------
        bodies
            Where that may be, in plane coordinates.
        frame
            The view's next; None where there is none.
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

    def hear(self, others: Sequence[HandView]) -> None:
        """Take notice of a hand that has come to another view, or is followed there alone."""
        self._is_elsewhere = any(other.has_newcomer or other._is_alone_for_long for other in others)

    @property
    def tracker(self) -> ContourTracker | None:
        """What follows: the view's tracker, or that of the trial that is believed."""
        return self.search.found.tracker if self.search.found is not None else self._tracker

    @property
    def track(self) -> Track | None:
        """What the view's tracker, or the trial that is believed, made of the last frame."""
        return self.search.found.track if self.search.found is not None else self._track

    @property
    def foreshortening(self) -> float | None:
        """By how much it has shown the finger shorter lately than it is; what follows is told.

        Above 0 and at most 1; None where that is not known.
        """
        return self._foreshortening

    @foreshortening.setter
    def foreshortening(self, foreshortening: float) -> None:
        self._foreshortening = foreshortening
        if self.tracker is not None:
            self.tracker.foreshortening = foreshortening

    def may_follow(self, trial: Trial) -> bool:
        """Whether a trial may be the hand that was lost here, by its colour and width."""
        return self._memory.may_be(trial.looks, trial.track.time_s)

    @property
    def is_presented(self) -> bool | None:
        """Whether the hand it follows is held up to the rig's template; None if that has none."""
        line = self.track.finger_line if self.track is not None else None
        if self._start is None or line is None:
            return None
        start = self._start
        here = StartPose(line.tip_px, line.angle_rad, start.length_px)
        return are_near(start, here, AT_TEMPLATE * start.length_px, AT_TEMPLATE_RAD)

    def would_lead_to(self, angle_rad: float, time_s: float) -> float:
        """Return how likely the finger that was lost here leads there now, 0 to 1.

        1 where none was lost.
        """
        return 1.0 if self._last_seen is None else self._last_seen.leads_to(angle_rad, time_s)

    @property
    def aside(self) -> Aside:
        """How the finger's axis lies to the line between the edges that show."""
        aside = self._flanks.aside
        by_width = off_by_width(self.odd_width or 0.0)
        return aside._replace(off=math.hypot(by_width, aside.off))

    @property
    def hand(self) -> tuple[NDArray[np.float64], NDArray[np.float64], float] | None:
        """The part of the last frame that the hand covers; None where no finger is followed."""
        line = self.track.finger_line if self.track is not None else None
        return None if line is None else hand_region(line)

    @property
    def has_newcomer(self) -> bool:
        """Whether it has followed a hand that came after the table was known."""
        first = self._first_hand
        return self._tracker is not None if first is None else first.is_newcomer

    @property
    def has_rival(self) -> bool:
        """Whether it has found something else beside what it follows."""
        return self._first_hand is not None and self._first_hand.has_rival

    @property
    def is_sure(self) -> bool:
        """Whether what is followed, if anything, is a hand and not perhaps the table."""
        return self._first_hand is None or self._first_hand.is_proven

    def view_frame(self, frame: Frame) -> ViewFrame | None:
        """Return what the view's tracker is to be updated with; None while there is none."""
        background = self.search.look_behind(frame)
        self._welcome(frame)
        if self._tracker is None:
            return None
        known = background if self._stands_free else None
        return self._tracker, frame.grey(), frame.time_s, frame.colour(), known

    def follow(self, frame: Frame, track: Track) -> None:
        """Take over what the tracker made of the view's frame."""
        self.may_show_body = self._body.shows_as(track.finger_line)
        if self.may_show_body and not self.is_sure:
            self.judge_body(is_hand=False)
            return
        if self._is_stranger(frame, track):
            self._leave(had_hand=self.is_sure, keeps_memory=True)
            return
        self._count_missed(track)
        self._count_waited(frame, track)
        self._track = track
        if self._lengthening is not None and self._tracker is not None:
            self._tracker, self._track = self._lengthening.look(
                self._tracker, track, frame, self.search.background
            )
        if self._first_hand is not None:
            self._first_hand.prove(frame, track.finger_line)
        # What leaves the table for the hand that has come has not moved like one.
        if track.finger_line is not None and self.is_sure:
            self._latest.append(track.finger_line)
            self._last_seen = LastSeen(track.finger_line.angle_rad, frame.time_s)
        if track.finger_line is not None and self.is_sure and not self.may_show_body:
            self._learn_looks(frame, track.finger_line)

    def _is_stranger(self, frame: Frame, track: Track) -> bool:
        """Whether a tracker that waits for the hand it has lost has taken something unlike it."""
        line = track.finger_line
        half_width_px = fitted_half_width_px(track)
        if line is None or half_width_px is None or self._missed_frames == 0:
            return False
        return not self._memory.may_be(Looks.of(frame, line, half_width_px), frame.time_s)

    def judge_body(self, *, is_hand: bool | None) -> None:
        """Learn whether what is followed within the body's silhouette is a hand.

        None stands for what nothing tells: then it counts as none, and is left after a while.
        """
        self.shows_body = not is_hand
        self._doubtful_frames = self._doubtful_frames + 1 if is_hand is None else 0
        if is_hand is False or self._doubtful_frames >= ALONE_FRAMES:
            self.may_show_body = False
            self._leave(had_hand=self.is_sure, keeps_memory=True)

    @property
    def tip_px(self) -> tuple[float, float] | None:
        """Tip of the finger that it follows, if it shows one in this frame."""
        line = self.track.finger_line if self.track is not None else None
        return None if line is None else line.tip_px

    def _learn_looks(self, frame: Frame, line: FingerLine) -> None:
        """Learn how the hand looks that is followed for good."""
        half_width_px = fitted_half_width_px(self._track) if self._track is not None else None
        if half_width_px is not None:
            self._memory.learn(Looks.of(frame, line, half_width_px), frame.time_s)

    def _count_waited(self, frame: Frame, track: Track) -> None:
        """Count the frames in which a hand may be there, but not where a template waits for it."""
        is_waiting = track.status == "acquiring"
        may_be_elsewhere = is_waiting and may_have_come(self.search.background, frame)
        self._waited_frames = self._waited_frames + 1 if may_be_elsewhere else 0

    def _count_missed(self, track: Track) -> None:
        """Count the frames in which what was followed is not seen."""
        is_bent = track.status == "tracking" and track.diagnostics.refusal == "misfit"
        is_missed = track.finger_line is None and track.status != "acquiring" and not is_bent
        if is_missed and self._missed_frames == 0 and self._tracker is not None:
            self._remember_length(self._tracker)
        self._missed_frames = self._missed_frames + 1 if is_missed else 0

    def _remember_length(self, tracker: ContourTracker) -> None:
        """Be content with a finger as short as what was followed until the last frame."""
        half_width_px = fitted_half_width_px(self._track) if self._track is not None else None
        if self._latest and half_width_px is not None:
            self.search.remember_length(length_px(tracker, self._latest[-1]) / half_width_px)

    @property
    def may_follow_table(self) -> bool:
        """Whether this frame is to tell if what is followed lies on the table."""
        if self._first_hand is not None and self._first_hand.may_be_flat:
            return True
        return self._flat_frames > 0 or self._frames % FLAT_EVERY == 0

    def look_flat(self, flat: float) -> None:
        """Leave what is followed if it looks flat to others.

        What the template was waiting for waits anew (see `FirstHand.looks_flat`); a hand that it
        has followed elsewhere is looked for, and so is one whose shadow is followed: what has been
        behind it all the while is known no more, for the hand was taken for a part of that.
        """
        first = self._first_hand
        if first is None or not first.may_be_flat:
            self._flat_frames = self._flat_frames + 1 if flat >= SEEMS_FLAT else 0
            if self._flat_frames >= FLAT_FRAMES:
                self._let_go()
                self.search.forget_behind()
            return
        if first.looks_flat(flat):
            self._leave(had_hand=first.has_moved)

    def _leave(self, *, had_hand: bool, keeps_memory: bool = False) -> None:
        """Leave what is no hand: a template that has followed none yet waits for it anew.

        The hand that was followed before is remembered if what is left is known not to be it.
        """
        waiting = None if self._first_hand is None else self._first_hand.wait_anew()
        if had_hand or waiting is None:
            memory = self._memory
            self._let_go()
            self._memory = memory if keeps_memory else self._memory
        else:
            self._tracker, self._track = waiting, None

    def observe(self, frame: Frame | None) -> None:
        """Learn from a frame that the tracker has had, and look for a hand that it does not follow.

        None stands for a frame that cannot be read.
        """
        if frame is None:
            return
        self._frames += 1
        self._is_table = self._shows_background(frame)
        if self._first_hand is None and self._is_table:
            self._let_go()
        self.search.learn(frame, self.track if self.is_sure else None)
        if self.is_searching:
            self.search.look(frame)
        else:
            self.search.rest()

    def _shows_background(self, frame: Frame) -> bool:
        """Tell whether what is followed has turned out to be the background.

        A tracker that has lost a hand may hold on to an edge of the table.
        """
        line = self._track.finger_line if self._track is not None else None
        if line is None:
            return False
        self._background_frames += 1
        if not is_background(self.search.background, frame, line):
            self._background_frames = 0
        return self._background_frames >= BACKGROUND_FRAMES

    def _welcome(self, frame: Frame) -> None:
        """Follow the hand that has come to where the template waits, if it is seen beside another.

        What has been followed there may be the table.
        """
        if self._first_hand is None:
            return
        track = None if self._is_table else self._track
        line = track.finger_line if track is not None else None
        second = self._first_hand.welcome(frame, line, is_backed=self._is_backed)
        self._tracker = second or self._tracker

    @property
    def _stands_free(self) -> bool:
        """Whether what is followed was no part of the background while that was learned."""
        return self.is_sure or (self._first_hand is not None and self._first_hand.has_come)

    def settle(self) -> None:
        """Follow for good the hand that the search has found, once it is proven."""
        found = self.search.found
        if found is not None and found.is_proven:
            self.is_recognised = self._memory.recognises(found.looks, found.track.time_s)
            self._tracker, self._track = found.tracker, found.track
            self._lengthening = found.lengthening
            if self._first_hand is not None:
                self._first_hand.believe()
            self.missing = Status.LOST
            self.search.rest()

    def look_at_flanks(self, frame: Frame | None) -> None:
        """Learn from some frames whether the finger that is followed is outlined on both sides."""
        if frame is not None:
            self._flanks.look(frame, self.track)

    def doubt(self, others: Sequence[HandView], shared: Shared) -> None:
        """Count frames in which no other view shows what this one follows; let go after some.

        A hand that the view has found by itself must point at the plane with another view; of one
        that was held up to it, the other views must follow the same finger.
        """
        if self._first_hand is None:
            is_alone = not any(shared.can_be_one(self, other) for other in others)
        else:
            is_alone = all(
                shared.have_two_tips(self, other) or shared.are_two(self, other) for other in others
            )
        self._doubts = self._doubts + 1 if is_alone else 0
        self._alone_frames = self._alone_frames + 1 if self._is_alone(others, shared) else 0
        self._count_pointless(others, shared)
        self._is_backed = self._is_backed_by(others, shared)
        self._recognise(others, shared)
        # A hand that has come into another view stands out from the table in this one too.
        is_table = self._is_table and not self.is_sure and any(o.has_newcomer for o in others)
        self._table_frames = self._table_frames + 1 if is_table else 0
        if (
            self._table_frames >= BACKGROUND_FRAMES
            or self._doubts >= DOUBTED_FRAMES
            or self._is_left_behind(others, shared)
        ):
            self._let_go()

    def _is_alone(self, others: Sequence[HandView], shared: Shared) -> bool:
        """Whether a finger is followed here, and in every other view another one or none."""
        return self.shows_finger and all(
            shared.are_two(self, other) or not other.shows_finger for other in others
        )

    def _count_pointless(self, others: Sequence[HandView], shared: Shared) -> None:
        """Count frames in which no other view's finger gives a point with the one followed here.

        Those in which there is no other count for nothing. What a camera that has moved meanwhile
        has learned of the table may be the hand.
        """
        pairs = [other for other in others if self.shows_finger and other.shows_finger]
        if any(shared.can_be_one(self, other) for other in pairs):
            self._pointless_frames, self._has_camera_moved = 0, False
        elif pairs:
            self._pointless_frames += 1
            if self._pointless_frames == POINTLESS_FRAMES and self._has_camera_moved:
                self.search.forget_behind()

    def _is_left_behind(self, others: Sequence[HandView], shared: Shared) -> bool:
        """Whether another view's finger has moved while what is followed here has stood still.

        A finger that moves towards a camera stands still there, but its tip stays one with that of
        the other view.
        """
        return len(self._latest) == STOOD_FRAMES and any(
            len(other._latest) == STOOD_FRAMES
            and is_left_behind(self._latest, other._latest)
            and not shared.share_tip(self, other)
            for other in others
        )

    def _is_backed_by(self, others: Sequence[HandView], shared: Shared) -> bool:
        """Whether another view follows the same finger as this one, and has found nothing else.

        It matters where something else has been found here. A finger that is there but gives no
        line in a frame, as one that seems bent, is backed. A hand that came when the table was
        known backs only what has come, too: the table may well look like its other view.
        """
        if not self.has_rival or self._track is None:
            return False
        if not self.shows_finger:
            return self._track.status == "tracking"
        return any(
            shared.are_one(self, other) and not (other.has_rival or other.has_newcomer)
            for other in others
        )

    def _recognise(self, others: Sequence[HandView], shared: Shared) -> None:
        """Take for a hand what was here before the table was known, if another view shows one come.

        What lies on the table is known for it before long.
        """
        first = self._first_hand
        if first is None or first.is_proven or first.waits_beside or self._is_table:
            return
        if not self.shows_finger:
            return
        if any(other.has_newcomer and shared.can_be_one(self, other) for other in others):
            first.recognise()

    def _let_go(self) -> None:
        """Follow nothing any more, and look everywhere."""
        self._tracker, self._track, self._doubts, self._is_table = None, None, 0, False
        self._alone_frames, self._pointless_frames = 0, 0
        self._flat_frames, self._missed_frames, self._doubtful_frames = 0, 0, 0
        self._lengthening = None
        self._flanks.forget()
        self._foreshortening = None
        self._latest.clear()
        self._last_seen = None
        self._memory = Memory()
        self.missing = Status.LOST
        self.search.rest()
