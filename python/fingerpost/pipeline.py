"""The main loop: frames of all views in, fixes out.

    rig = Rig.load("rig.toml")
    for fix in track(rig):
        print(fix.time_s, fix.status, fix.point)

One step reads like the paper: track the hand in every view (section 3.2), bring the finger lines
to one time, turn each into its constraint line on the plane and intersect them (section 2.2). The
loop exists once; whatever plays, draws, records or drives stands around it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fingerpost._core import (
    Background,
    ContourTracker,
    SearchLines,
    StartPose,
    Template,
    Track,
    update_views,
)
from fingerpost.capture import Frame, open_source, read_views
from fingerpost.config import Rig, View
from fingerpost.errors import FingerpostError, InvalidInputError
from fingerpost.finding import (
    BACKGROUND_FRAMES,
    DOUBTED_FRAMES,
    HandSearch,
    Viewpoint,
    are_one,
    are_two,
    can_be_one,
    find_hand,
    how_flat,
)
from fingerpost.first_hand import FirstHand
from fingerpost.pointing import (
    BARE_HAND,
    AlignmentState,
    FingerLine,
    Fix,
    PlaneView,
    PointingOptions,
    Status,
    align,
    indicated_point,
)
from fingerpost.recording import PointRow, TrackRow
from fingerpost.recording.picture import SearchMarks

ViewFrame = tuple[
    ContourTracker, NDArray[np.uint8], float, NDArray[np.uint8] | None, Background | None
]
"""A tracker, and the frame to update it with: grey levels, capture time [s], colours if there are
any, and what is behind the hand if that is known."""

DEFAULT_REFERENCE_SIGMA_PX = 0.5
"""Standard deviation of a reference point that a person clicked or a line fit gave [px]."""


@dataclass(frozen=True, eq=False)
class Observation:
    """What one view saw in one frame.

    Attributes
    ----------
    view
        The view's name.
    frame
        The frame; None where it could not be read.
    track
        What the tracker made of it; None without a frame, and while no hand has been found.
    contour_px
        The template's outline after the frame, (N, 2) [px].
    searched
        Where the last search looked, and what it found; None without a template.
    missing
        What a view without a track is: it looks for its first hand, or for one that it has lost.
    """

    view: str
    frame: Frame | None
    track: Track | None
    contour_px: NDArray[np.float64]
    searched: SearchLines | None
    missing: Status = Status.LOST

    @cached_property
    def search(self) -> SearchMarks:
        """The last search, to be drawn: its lines, and the edges that it chose and rejected."""
        return SearchMarks.none() if self.searched is None else _marks(self.searched)

    @cached_property
    def finger(self) -> FingerLine | Status:
        """The finger line, or why there is none."""
        if self.frame is None:
            return Status.LOST
        if self.track is None:
            return self.missing
        line = self.track.finger_line
        if line is not None:
            return FingerLine(
                np.array(line.anchor_px),
                line.angle_rad,
                line.covariance,
                np.array(line.tip_px),
                self.frame.time_s,
                line.half_length_px,
            )
        return Status.ACQUIRING if self.track.status == "acquiring" else Status.LOST

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why the frame went the way it did, for people: the verdict, then details."""
        if self.frame is None:
            return ("the frame could not be read",)
        if self.track is None and self.searched is not None:
            return ("refused: it lies on the table",)
        if self.track is None:
            return ("no hand is followed: looked for everywhere",)
        return _verdict(self.track), _details(self.track, self.search)

    def track_row(self) -> TrackRow | None:
        """Return the row of `tracks.csv`; None for a frame that could not be read."""
        if self.frame is None:
            return None
        cells: dict[str, float] = {}
        status = str(self.finger) if isinstance(self.finger, Status) else "tracking"
        line = self.track.finger_line if self.track is not None else None
        if line is not None:
            sigma_offset_px, sigma_angle_rad = np.sqrt(np.diag(line.covariance)).tolist()
            cells = {
                "tip_u": line.tip_px[0],
                "tip_v": line.tip_px[1],
                "angle_rad": line.angle_rad,
                "sigma_angle_rad": sigma_angle_rad,
                "sigma_offset_px": sigma_offset_px,
            }
        return TrackRow(
            frame=self.frame.index,
            time_s=self.frame.time_s,
            view=self.view,
            status=status,
            **cells,
        )


def _verdict(track: Track) -> str:
    """Say whether the fit of a frame counts, and by what."""
    told = track.diagnostics
    percent, least = 100 * told.agreement, 100 * told.min_agreement
    agreement = f"finger agreement {percent:.0f} % (min {least:.0f})"
    residual = f"residual {told.residual_rms_px:.2f} px (max {told.max_residual_px:.2f})"
    if told.accepted:
        verdict = "settling" if track.finger_line is None else "accepted"
        return f"{verdict}: {agreement}, {residual}"
    reasons = {
        "size": "not the size of the hand that was followed",
        "motion": "no hand moves like that",
        "agreement": agreement,
        "residual": residual,
        "background": "it is no finger before the table",
        "misfit": "the finger is bent",
    }
    return f"refused: {reasons.get(told.refusal or '', 'no fit that could be a finger')}"


def _details(track: Track, search: SearchMarks) -> str:
    """Say what the lines of the last search found, and what else is known of the fit."""
    lines, agree = len(search.agrees), int(search.agrees.sum())
    hits = int(np.isfinite(search.edges_px).all(axis=1).sum())
    details = [f"{lines} lines: {agree} agree, {hits - agree} rejected, {lines - hits} no edge"]
    if track.diagnostics.innovation is not None:
        details.append(f"innovation {track.diagnostics.innovation:.1f}")
    if track.diagnostics.bend_rad is not None:
        details.append(f"bend {np.degrees(track.diagnostics.bend_rad):.0f}°")
    if track.finger_line is not None:
        details.append(f"line from {track.finger_line.source}")
    return "   ".join(details)


@dataclass(frozen=True, eq=False, slots=True)
class Step:
    """One frame of the first view, what all views saw at it, and the fix.

    Attributes
    ----------
    index
        The frame's index in the source of the first view.
    observations
        One per view, in the rig's order, of the frames that were captured together.
    fix
        Where the hand points at the time of the first view's frame.
    """

    index: int
    observations: tuple[Observation, ...]
    fix: Fix

    def point_row(self) -> PointRow:
        """Return the row of `points.csv`; a covariance without bound is left empty."""
        fix = self.fix
        cells: dict[str, float] = {}
        if fix.crossing_angle_rad is not None:
            cells["crossing_angle_deg"] = float(np.degrees(fix.crossing_angle_rad))
        if fix.covariance is not None and np.isfinite(fix.covariance).all():
            (cells["cov_xx"], cells["cov_xy"]), (_, cells["cov_yy"]) = fix.covariance.tolist()
        if fix.point is not None:
            cells["x"], cells["y"] = fix.point.tolist()
        return PointRow(frame=self.index, time_s=fix.time_s, status=fix.status.value, **cells)


class HandView:
    """One view of the hand: its tracker, its search for the hand, and how it sees the plane.

    A view with a start pose waits there for the hand until it has followed one. A view without,
    and any view that has lost the hand, looks everywhere; see `fingerpost.finding`.

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
        self.search = HandSearch(tracker_options)
        self._tracker: ContourTracker | None = None
        self._track: Track | None = None
        self._is_table = False
        self._table_frames = 0
        self._doubts = 0
        self._has_come_elsewhere = False
        self._is_backed = False
        self._missing = Status.ACQUIRING
        self._first_hand: FirstHand | None = None
        if view.start is not None:
            template = Template.pistol(view.start.thumb)
            tip_px, angle_deg = view.start.tip_px, view.start.angle_deg
            start = StartPose(tip_px, np.radians(angle_deg), view.start.length_px)
            waiting = partial(ContourTracker, template, start, tracker_options)
            self._tracker = waiting()
            self._first_hand = FirstHand(self.search, start, waiting)

    @property
    def is_searching(self) -> bool:
        """Whether the hand may be anywhere: it is neither followed for good nor waited for.

        A hand that another view has seen come has passed a template that still waits for it.
        """
        if self._tracker is None or self._misses_hand:
            return True
        return self._track is not None and self._track.status == "lost"

    @property
    def _misses_hand(self) -> bool:
        """Whether a hand has come to another view that this one has not found where it waits."""
        return self._has_come_elsewhere and not (self._is_sure or self._shows_finger)

    @property
    def _shows_finger(self) -> bool:
        return self._track is not None and self._track.finger_line is not None

    def hear(self, others: Sequence[HandView]) -> None:
        """Take notice of a hand that has come to another view."""
        self._has_come_elsewhere = any(other.has_newcomer for other in others)

    @property
    def track(self) -> Track | None:
        """What the view's tracker, or the trial that is believed, made of the last frame."""
        return self.search.found.track if self.search.found is not None else self._track

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
    def _is_sure(self) -> bool:
        """Whether what is followed, if anything, is a hand and not perhaps the table."""
        return self._first_hand is None or self._first_hand.is_proven

    def view_frame(self, frame: Frame) -> ViewFrame | None:
        """Return what the view's tracker is to be updated with; None while there is none."""
        background = self.search.look_behind(frame)
        self._welcome(frame)
        if self._tracker is None:
            return None
        colour = frame.image if frame.image.ndim == 3 else None
        known = background if self._stands_free else None
        return self._tracker, frame.grey(), frame.time_s, colour, known

    def follow(self, frame: Frame, track: Track) -> None:
        """Take over what the tracker made of the view's frame."""
        self._track = track
        if self._first_hand is not None:
            self._first_hand.prove(frame, track.finger_line)

    @property
    def may_follow_table(self) -> bool:
        """Whether what is followed may lie on the table."""
        return self._first_hand is not None and self._first_hand.may_be_flat

    def look_flat(self, flat: float) -> None:
        """Take over how flat what is followed looks to others; see `FirstHand.look_flat`."""
        anew = None if self._first_hand is None else self._first_hand.look_flat(flat)
        if anew is not None:
            self._tracker, self._track = anew, None

    def observe(self, frame: Frame | None) -> None:
        """Learn from a frame that the tracker has had, and look for a hand that it does not follow.

        None stands for a frame that cannot be read.
        """
        if frame is None:
            return
        height_px, width_px = frame.image.shape[:2]
        if self._size_px != (width_px, height_px):
            self._size_px = width_px, height_px
            self.viewpoint = Viewpoint.of(self.plane_view, self._size_px)
        self._is_table = self.search.shows_background(frame, self._track)
        if self._first_hand is None and self._is_table:
            self._let_go()
        self.search.learn(frame, self.track if self._is_sure else None)
        if self.is_searching:
            self.search.look(frame)
        else:
            self.search.rest()

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
        return self._is_sure or (self._first_hand is not None and self._first_hand.has_come)

    def settle(self) -> None:
        """Follow for good the hand that the search has found, once it is proven."""
        found = self.search.found
        if found is not None and found.is_proven:
            self._tracker, self._track = found.tracker, found.track
            if self._first_hand is not None:
                self._first_hand.believe()
            self._missing = Status.LOST
            self.search.rest()

    def doubt(self, others: Sequence[HandView], shared: _Shared) -> None:
        """Count frames in which no other view shows what this one follows; let go after some.

        A hand that the view has found by itself must point at the plane with another view; of one
        that was held up to it, the other views must follow the same finger.
        """
        if self._first_hand is None:
            is_alone = not any(shared.can_be_one(self, other) for other in others)
        else:
            is_alone = all(shared.are_two(self, other) for other in others)
        self._doubts = self._doubts + 1 if is_alone else 0
        self._is_backed = self._is_backed_by(others, shared)
        self._recognise(others, shared)
        # A hand that has come into another view stands out from the table in this one too.
        is_table = self._is_table and not self._is_sure and any(o.has_newcomer for o in others)
        self._table_frames = self._table_frames + 1 if is_table else 0
        if self._table_frames >= BACKGROUND_FRAMES or self._doubts >= DOUBTED_FRAMES:
            self._let_go()

    def _is_backed_by(self, others: Sequence[HandView], shared: _Shared) -> bool:
        """Whether another view follows the same finger as this one, and has found nothing else.

        It matters where something else has been found here. A finger that is there but gives no
        line in a frame, as one that seems bent, is backed.
        """
        if not self.has_rival or self._track is None:
            return False
        if not self._shows_finger:
            return self._track.status == "tracking"
        return any(shared.are_one(self, other) and not other.has_rival for other in others)

    def _recognise(self, others: Sequence[HandView], shared: _Shared) -> None:
        """Take for a hand what was here before the table was known, if another view shows one come.

        What lies on the table is known for it before long.
        """
        first = self._first_hand
        if first is None or first.is_proven or first.waits_beside or self._is_table:
            return
        if not self._shows_finger:
            return
        if any(other.has_newcomer and shared.can_be_one(self, other) for other in others):
            first.recognise()

    def _let_go(self) -> None:
        """Follow nothing any more, and look everywhere."""
        self._tracker, self._track, self._doubts, self._is_table = None, None, 0, False
        self._missing = Status.LOST
        self.search.rest()

    def observation(self, frame: Frame | None) -> Observation:
        """Return what the view saw in the frame that it observed last."""
        found = self.search.found
        tracker, track = (found.tracker, found.track) if found else (self._tracker, self._track)
        if frame is None or tracker is None:
            return Observation(self.name, frame, None, np.empty((0, 2)), None, self._missing)
        contour_px, searched = tracker.contour(), tracker.search_lines()
        return Observation(self.name, frame, track, contour_px, searched, self._missing)


def _marks(lines: SearchLines) -> SearchMarks:
    """Return where a tracker looked for edges, and what it found there."""
    sides = np.array([-1.0, 1.0])[:, None] * lines.half_length_px[:, None, None]
    ends_px = lines.position_px[:, None] + sides * lines.normal[:, None]
    edges_px = lines.position_px + lines.normal * lines.offset_px[:, None]
    agrees = np.zeros(len(lines), np.bool_) if lines.agrees is None else lines.agrees
    return SearchMarks(ends_px, edges_px, agrees)


class _Shared:
    """What pairs of views may show together in one frame; each pair is judged once."""

    def __init__(self) -> None:
        self._judgements: dict[tuple[Callable[..., bool], frozenset[HandView]], bool] = {}

    def can_be_one(self, one: HandView, other: HandView) -> bool:
        return self._judged(can_be_one, one, other)

    def are_one(self, one: HandView, other: HandView) -> bool:
        return self._judged(are_one, one, other)

    def are_two(self, one: HandView, other: HandView) -> bool:
        return self._judged(are_two, one, other)

    def _judged(
        self,
        judge: Callable[[tuple[HandView, HandView]], bool],
        one: HandView,
        other: HandView,
    ) -> bool:
        key = judge, frozenset((one, other))
        if key not in self._judgements:
            self._judgements[key] = judge((one, other))
        return self._judgements[key]


@dataclass(slots=True)
class _Pending:
    """A frame of the first view that waits for the other views to reach its time."""

    index: int
    time_s: float
    observations: tuple[Observation, ...]


@dataclass(slots=True)
class _History:
    """The latest entries of one view, oldest first: a finger line or a status, and its time."""

    entries: deque[tuple[float, FingerLine | Status]] = field(
        default_factory=lambda: deque(maxlen=16)
    )

    def add(self, observation: Observation) -> None:
        if observation.frame is not None:
            self.entries.append((observation.frame.time_s, observation.finger))

    def at(self, time_s: float, options: PointingOptions) -> FingerLine | Status | None:
        """Tell what the view has at a time; None if its next frame is needed for that."""
        before: FingerLine | Status = Status.ACQUIRING
        for entry_time_s, entry in self.entries:
            if entry_time_s == time_s:
                return entry
            if entry_time_s > time_s:
                return _between(before, entry, time_s, options)
            before = entry
        return None


def _between(
    before: FingerLine | Status,
    after: FingerLine | Status,
    time_s: float,
    options: PointingOptions,
) -> FingerLine | Status:
    """Finger line between two neighbours in time; the status of the one that has none."""
    if isinstance(before, Status):
        return before
    if isinstance(after, Status):
        return after
    aligned = align([before, after], time_s, options)
    if aligned.state is AlignmentState.ALIGNED and aligned.line is not None:
        return aligned.line
    return Status.LOST


class Pointer:
    """All views of a rig: frames in, fixes out.

    Parameters
    ----------
    rig
        At least two views.
    tracker_options
        What differs from the tracker's defaults, for all views.
    pointing_options
        When a point counts as one, and the allowance for what is no noise: by default that for a
        bare hand.
    reference_sigma_px
        Standard deviation of reference points that come without a covariance [px], > 0.

    Raises
    ------
    InvalidInputError
        A rig that cannot point, or an option out of range.
    """

    def __init__(
        self,
        rig: Rig,
        *,
        tracker_options: Mapping[str, Any] | None = None,
        pointing_options: PointingOptions = BARE_HAND,
        reference_sigma_px: float = DEFAULT_REFERENCE_SIGMA_PX,
    ) -> None:
        if len(rig.views) < 2:
            raise InvalidInputError(
                f"the rig has {len(rig.views)} view; pointing needs two or more"
            )
        self.views = tuple(
            HandView(view, rig.plane.points, tracker_options, reference_sigma_px)
            for view in rig.views
        )
        self._options = pointing_options
        self._histories = tuple(_History() for _ in self.views)
        self._pending: deque[_Pending] = deque()

    @property
    def plane_views(self) -> tuple[PlaneView, ...]:
        """How each view sees the plane."""
        return tuple(view.plane_view for view in self.views)

    def update(self, frames: Sequence[Frame | None]) -> Iterator[Step]:
        """Take one frame of every view; yield the steps that can be told from them.

        Views that are captured at one time give their step at once. Where a view lags behind, the
        step of the first view's frame comes when the others have passed its time, one call later.

        Parameters
        ----------
        frames
            One per view, in the rig's order; None where a frame could not be read.
        """
        self._follow(frames)
        self._leave_table(frames)
        for view, frame in zip(self.views, frames, strict=True):
            view.hear([other for other in self.views if other is not view])
            view.observe(frame)
        if any(view.is_searching for view in self.views):
            find_hand(self.views, frames)
        shared = _Shared()
        for view in self.views:
            view.settle()
            view.doubt([other for other in self.views if other is not view], shared)
        observations = tuple(
            view.observation(frame) for view, frame in zip(self.views, frames, strict=True)
        )
        for history, observation in zip(self._histories, observations, strict=True):
            history.add(observation)
        first = frames[0]
        if first is not None:
            self._pending.append(_Pending(first.index, first.time_s, observations))
        yield from self._ready()

    def _follow(self, frames: Sequence[Frame | None]) -> None:
        """Update the trackers of all views in one call; the error of one keeps none from a frame.

        Raises
        ------
        FingerpostError
            Why a tracker has refused its frame; the first view's if there are several.
        """
        given = [
            (view, frame, taken)
            for view, frame in zip(self.views, frames, strict=True)
            if frame is not None and (taken := view.view_frame(frame)) is not None
        ]
        tracks = update_views([taken for *_, taken in given])
        errors = [track for track in tracks if isinstance(track, FingerpostError)]
        for (view, frame, _), track in zip(given, tracks, strict=True):
            if isinstance(track, Track):
                view.follow(frame, track)
        if errors:
            raise errors[0]

    def _leave_table(self, frames: Sequence[Frame | None]) -> None:
        """Have templates wait anew that have locked on to what lies on the table."""
        looks = [
            how_flat(self.views, frames, k) if view.may_follow_table else None
            for k, view in enumerate(self.views)
        ]
        for view, flat in zip(self.views, looks, strict=True):
            if flat is not None:
                view.look_flat(flat)

    def finish(self) -> Iterator[Step]:
        """Yield the last steps, whose time not every view has reached."""
        while self._pending:
            pending = self._pending.popleft()
            fingers = [
                history.at(pending.time_s, self._options) or Status.LOST
                for history in self._histories
            ]
            yield self._step(pending, fingers)

    def _ready(self) -> Iterator[Step]:
        while self._pending:
            oldest = self._pending[0]
            fingers = [history.at(oldest.time_s, self._options) for history in self._histories]
            if any(finger is None for finger in fingers):
                return
            self._pending.popleft()
            yield self._step(oldest, [finger for finger in fingers if finger is not None])

    def _step(self, pending: _Pending, fingers: Sequence[FingerLine | Status]) -> Step:
        fix = indicated_point(
            fingers, self.plane_views, time_s=pending.time_s, options=self._options
        )
        return Step(pending.index, pending.observations, fix)


def steps(pointer: Pointer, frames: Iterable[Sequence[Frame | None]]) -> Iterator[Step]:
    """Feed a pointer with frames and yield its steps to the last."""
    for together in frames:
        yield from pointer.update(together)
    yield from pointer.finish()


def track(rig: Rig, *, max_frames: int | None = None, **options: Any) -> Iterator[Fix]:
    """Yield the fixes of a rig, live or recorded, in the order of the first view's frames.

    Parameters
    ----------
    rig
        At least two views.
    max_frames
        Stop after as many frames of each view; None reads on to the end.
    **options
        Those of `Pointer`.

    Yields
    ------
    Fix
        One per frame of the first view.

    Raises
    ------
    InvalidInputError
        A rig that cannot point, or an option out of range.
    CaptureError
        A source that cannot be opened or read.
    """
    pointer = Pointer(rig, **options)
    with ExitStack() as stack:
        sources = [stack.enter_context(open_source(view.source)) for view in rig.views]
        for step in steps(pointer, islice(read_views(sources), max_frames)):
            yield step.fix
