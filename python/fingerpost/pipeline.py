"""The main loop: frames of all views in, fixes out.

    rig = Rig.load("rig.toml")
    for fix in track(rig):
        print(fix.time_s, fix.status, fix.point)

One step follows the paper: track the hand in every view (section 3.2), interpolate the finger
lines to a common time, transfer each to its constraint line on the plane and intersect these
(section 2.2). This is the only loop; display, recording and robot control are built around it.
"""

from __future__ import annotations

import logging
import numbers
import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import islice
from typing import Any, Literal, TypeVar, overload

import numpy as np

# NumPy would load them when it first needs them, within a frame.
import numpy.ma
import numpy.random
from numpy.typing import NDArray

from fingerpost._core import SearchLines, Track, update_views
from fingerpost.admission import (
    Admission,
    check_tracker_options,
    different_sides,
    reduced_view,
)
from fingerpost.capture import Frame, Loss, Source, open_views, read_views
from fingerpost.checks import in_range
from fingerpost.config import FixedReference, Rig, View
from fingerpost.consistency import Disagreement, Monitor, Scenery
from fingerpost.errors import FingerpostError, InvalidInputError
from fingerpost.finding import (
    NO_CORRECTION,
    AxisCorrection,
    Hand,
    HandView,
    Identity,
    PairTests,
    SearchRest,
    Viewpoint,
    compare_lengths,
    compare_widths,
    distinguish_body_from_hands,
    find_hand,
    flatness_of_followed,
    measured_line,
    other_fingers,
    rays_of_tips,
)
from fingerpost.locating import ReferenceSearch, meter_of, stand_in
from fingerpost.operators import Operator
from fingerpost.pointing import (
    BARE_HAND,
    FingerLine,
    Fix,
    PlaneView,
    PointingOptions,
    Status,
    align,
    indicated_point,
)
from fingerpost.pushed import Images, PushedViews
from fingerpost.recording import PointRow, TrackRow
from fingerpost.recording.picture import SearchMarks
from fingerpost.references import (
    Measured,
    Reduction,
    ReferenceFollower,
    ReferenceWatch,
)
from fingerpost.silhouette import Capsule
from fingerpost.uncertainty import joint_of

_log = logging.getLogger(__name__)

DEFAULT_REFERENCE_SIGMA_PX = 0.5
"""Standard deviation of a reference point that was clicked or is given by a line fit [px]."""

ANOTHER_FINGER = "its fingertip is not that of the other views"
"""Reason for a view whose fingertip matches that of no other view."""

MIN_REPORTED_SIGMA = 0.05
"""Least standard deviation of the axis correction that is reported to the user [half-widths]."""

LARGEST_PX = 2560
"""Longest side of a frame that is processed at full size [px]. Larger frames are reduced: a finger
is no sharper in them, and time and memory would be many times those of decoding."""

ABSENT_S = 1.0
"""Time without frames after which a camera may have been moved or replaced [s]: less than it takes
to unplug one camera and plug in another."""

# Range of the standard deviation of reference points [px]: its square exceeds rounding errors.
_REFERENCE_SIGMAS_PX = (1e-6, 1e6)

WHOLE = Reduction(1)

Frames = TypeVar("Frames")
Entry = TypeVar("Entry")


@dataclass(frozen=True, eq=False)
class Observation:
    """Result of one view for one frame.

    Attributes
    ----------
    view
        The view's name.
    frame
        The processed frame, reduced if it is large (`LARGEST_PX`); None if the view has none at
        that time. All pixel coordinates of the observation refer to this frame.
    loss
        Why the frame is missing: a damaged image, or a camera that sends nothing.
    reduction
        Reduction of the frame.
    track
        The tracker's result; None without a frame or a hand.
    contour_px
        Contour fitted to the frame, (N, 2) [px].
    searched
        Search lines of the last edge search, with their edges; None without a template.
    missing
        Status of a view without a track: acquiring its first hand, or lost.
    moved_px
        Mean displacement of the table in the image since the camera moved, 0 if static [px].
    is_adrift
        Whether the camera has moved and its homography is unknown.
    plane_view
        Homography of the view; the last known one if `is_adrift`.
    axis_correction
        Correction from the line between the visible edges to the finger's axis.
    is_body
        Whether the tracker follows a moving body of the system, such as a robot arm.
    """

    view: str
    frame: Frame | None
    track: Track | None
    contour_px: NDArray[np.float64]
    searched: SearchLines | None
    missing: Status = Status.LOST
    moved_px: float = 0.0
    is_adrift: bool = False
    plane_view: PlaneView | None = None
    axis_correction: AxisCorrection = NO_CORRECTION
    is_body: bool = False
    reduction: Reduction = WHOLE
    loss: Loss | None = None

    @classmethod
    def of(
        cls,
        view: HandView,
        frame: Frame | None,
        loss: Loss | None,
        watch: ReferenceWatch | ReferenceFollower,
        reduction: Reduction,
    ) -> Observation:
        """Collect a view's result for the last frame of the view and the watch."""
        tracker = view.tracker
        moved = watch.moved_px, watch.is_adrift
        camera = *moved, view.plane_view, view.axis_correction, view.shows_body, reduction, loss
        if frame is None or tracker is None:
            return cls(view.name, frame, None, np.empty((0, 2)), None, view.missing, *camera)
        contour_px, searched = tracker.contour(), tracker.search_lines()
        return cls(view.name, frame, view.track, contour_px, searched, view.missing, *camera)

    @cached_property
    def search(self) -> SearchMarks:
        """The last edge search for display: its lines, and the chosen and rejected edges."""
        return SearchMarks.none() if self.searched is None else _marks(self.searched)

    @cached_property
    def finger(self) -> FingerLine | Status:
        """The finger line, or the status of a view without a usable one."""
        if self.frame is None:
            return Status.LOST
        if self.track is None:
            return self.missing
        if self.is_body:
            return Status.LOST
        line = measured_line(self.track, self.frame.time_s, self.axis_correction)
        if line is not None:
            return Status.ILL_CONDITIONED if self.is_adrift else line
        return Status.ACQUIRING if self.track.status == "acquiring" else Status.LOST

    @property
    def reasons(self) -> tuple[str, ...]:
        """Explanation of the result for the user: the decision, then details."""
        if self.loss is not None:
            return (self.loss.why,)
        if self.frame is None:
            return ("no frame of this time could be read",)
        if self.is_adrift:
            return (_moved(self), *self._reasons)
        if self.moved_px > 0.0:
            *others, last = self._reasons
            moved_px = self.reduction.factor * self.moved_px
            return (*others, f"camera moved by {moved_px:.0f} px   {last}")
        return self._reasons

    @property
    def _reasons(self) -> tuple[str, ...]:
        if self.is_body:
            return ("refused: it is what the system itself moves",)
        if self.track is None and self.searched is not None:
            return ("refused: it lies on the table",)
        if self.track is None:
            return ("no hand is followed: looked for everywhere",)
        return _decision(self.track), _details(self.track, self.search, self.axis_correction)

    def track_row(self) -> TrackRow | None:
        """Return the row of `tracks.csv`; None where there is neither a frame nor a loss."""
        seen = self.frame or self.loss
        if seen is None:
            return None
        cells: dict[str, float] = {}
        line = None if self.loss else measured_line(self.track, seen.time_s, self.axis_correction)
        status = "tracking" if line is not None else str(self.finger)
        if line is not None:
            sigma_offset_px, sigma_angle_rad = np.sqrt(np.diag(line.covariance)).tolist()
            sigma_offset_px *= self.reduction.factor
            tip_u, tip_v = self.reduction.whole(line.tip_px).tolist()
            cells = {
                "tip_u": tip_u,
                "tip_v": tip_v,
                "angle_rad": line.angle_rad,
                "sigma_angle_rad": sigma_angle_rad,
                "sigma_offset_px": sigma_offset_px,
            }
        return TrackRow(
            frame=seen.index,
            time_s=seen.time_s,
            view=self.view,
            status=status,
            **cells,
        )


def _decision(track: Track) -> str:
    """Explain whether the fit of a frame is accepted, and by which quantities."""
    diagnostics = track.diagnostics
    percent, least = 100 * diagnostics.agreement, 100 * diagnostics.min_agreement
    agreement = f"finger agreement {percent:.0f} % (min {least:.0f})"
    residual = (
        f"residual {diagnostics.residual_rms_px:.2f} px (max {diagnostics.max_residual_px:.2f})"
    )
    if diagnostics.accepted:
        decision = "settling" if track.finger_line is None else "accepted"
        return f"{decision}: {agreement}, {residual}"
    reasons = {
        "size": "not the size of the hand that was followed",
        "motion": "no hand moves like that",
        "agreement": agreement,
        "residual": residual,
        "background": "it is no finger before the table",
        "misfit": "the finger is bent",
    }
    return f"refused: {reasons.get(diagnostics.refusal or '', 'no fit that could be a finger')}"


def _details(track: Track, search: SearchMarks, axis_correction: AxisCorrection) -> str:
    """Summarise the search lines' edges and further quantities of the fit."""
    lines, agree = len(search.agrees), int(search.agrees.sum())
    hits = int(np.isfinite(search.edges_px).all(axis=1).sum())
    details = [f"{lines} lines: {agree} agree, {hits - agree} rejected, {lines - hits} no edge"]
    if track.diagnostics.innovation is not None:
        details.append(f"innovation {track.diagnostics.innovation:.1f}")
    if track.diagnostics.bend_rad is not None:
        details.append(f"bend {np.degrees(track.diagnostics.bend_rad):.0f}°")
    if track.finger_line is not None:
        details.append(f"line from {track.finger_line.source}")
        # First, for an overlay has room for about half of this.
        if axis_correction.offset:
            details.insert(
                0,
                f"a flank does not show: axis {abs(axis_correction.offset):.1f} half-widths aside",
            )
        elif axis_correction.sigma >= MIN_REPORTED_SIGMA:
            details.insert(
                0, f"a flank is not the finger's: up to {axis_correction.sigma:.1f} half-widths off"
            )
    return "   ".join(details)


@dataclass(frozen=True, eq=False, slots=True)
class Step:
    """One frame of the first view with the results of all views and the fix.

    Attributes
    ----------
    index
        Index of the frame in the source of the first view.
    observations
        One per view, in the rig's order, for the frames captured together.
    fix
        Fix at the time of the first view's frame.
    hand
        Identity of the hand.
    frames
        The views' entries at full resolution.
    """

    index: int
    observations: tuple[Observation, ...]
    fix: Fix
    hand: Hand = field(default_factory=Hand)
    frames: tuple[Frame | Loss | None, ...] = ()

    def point_row(self) -> PointRow:
        """Return the row of `points.csv`; an infinite covariance is left empty."""
        fix = self.fix
        cells: dict[str, float] = {}
        if fix.crossing_angle_rad is not None:
            cells["crossing_angle_deg"] = float(np.degrees(fix.crossing_angle_rad))
        if fix.covariance is not None and np.isfinite(fix.covariance).all():
            (cells["cov_xx"], cells["cov_xy"]), (_, cells["cov_yy"]) = fix.covariance.tolist()
        if fix.point is not None:
            cells["x"], cells["y"] = fix.point.tolist()
        return PointRow(
            frame=self.index,
            time_s=fix.time_s,
            status=fix.status.value,
            reason=fix.reason,
            **cells,
        )


def _moved(seen: Observation) -> str:
    moved_px = seen.reduction.factor * seen.moved_px
    if moved_px == 0.0:
        return "its references are not seen"
    return f"the camera has moved the reference points by {moved_px:.0f} px"


def _marks(lines: SearchLines) -> SearchMarks:
    """Return a tracker's search lines and edges for display."""
    sides = np.array([-1.0, 1.0])[:, None] * lines.half_length_px[:, None, None]
    ends_px = lines.position_px[:, None] + sides * lines.normal[:, None]
    edges_px = lines.position_px + lines.normal * lines.offset_px[:, None]
    agrees = np.zeros(len(lines), np.bool_) if lines.agrees is None else lines.agrees
    return SearchMarks(ends_px, edges_px, agrees)


HELD_BACK_S = 3.0
"""Longest wait of a recording's frames for a motion that compares the clocks of its views [s]."""

HELD_BACK_BYTES = 512_000_000
"""Greatest size of the images that wait."""


@dataclass(slots=True)
class _Pending:
    """A frame of the first view that waits until the other views reach its time."""

    index: int
    time_s: float
    observations: tuple[Observation, ...]
    hand: Hand
    frames: tuple[Frame | Loss | None, ...]
    viewpoints: tuple[Viewpoint, ...]

    @property
    def may_have_point(self) -> bool:
        """Whether a view has a finger line: that of another one may be interpolated."""
        return any(isinstance(one.finger, FingerLine) for one in self.observations)

    @property
    def size_bytes(self) -> int:
        """Size of its images."""
        return sum(one.image.nbytes for one in self.frames if isinstance(one, Frame))


@dataclass(frozen=True, slots=True)
class _NoLine:
    """Status and reason of a view without a finger line at a time.

    Attributes
    ----------
    status
        Status of the view.
    reason
        Reason other than the view's own loss of the hand; else empty.
    """

    status: Status
    reason: str = ""


@dataclass(slots=True)
class _History:
    """The latest entries of one view, oldest first: time, finger line or absence, plane view."""

    entries: list[tuple[float, FingerLine | _NoLine, PlaneView]] = field(default_factory=list)

    def add(self, observation: Observation, plane_view: PlaneView) -> None:
        seen, finger = observation.frame or observation.loss, observation.finger
        if seen is not None:
            why = observation.loss.why if observation.loss else ""
            entry = _NoLine(finger, why) if isinstance(finger, Status) else finger
            self.entries.append((seen.time_s, entry, plane_view))

    def forget(self, time_s: float) -> None:
        """Drop the entries before a time, except for the last two: `align` needs them."""
        while len(self.entries) > 2 and self.entries[2][0] <= time_s:
            del self.entries[0]

    def at(self, time_s: float, options: PointingOptions) -> FingerLine | _NoLine | None:
        """Interpolate the finger line at a time; None if the next frame is needed for it."""
        earlier: FingerLine | _NoLine = _NoLine(Status.ACQUIRING)
        before = earlier
        for entry_time_s, entry, _ in self.entries:
            if entry_time_s == time_s:
                return entry
            if entry_time_s > time_s:
                return _between(earlier, before, entry, time_s, options)
            earlier, before = before, entry
        return None

    def plane_view_at(self, time_s: float, latest: PlaneView) -> PlaneView:
        """Interpolate the plane view at a time; `latest` if no later one is known."""
        before_s, before = -np.inf, latest
        for entry_time_s, _, plane_view in self.entries:
            if entry_time_s >= time_s:
                if np.isinf(before_s):
                    return plane_view
                part = (time_s - before_s) / (entry_time_s - before_s)
                return before.between(plane_view, part)
            before_s, before = entry_time_s, plane_view
        return before


def _between(
    earlier: FingerLine | _NoLine,
    before: FingerLine | _NoLine,
    after: FingerLine | _NoLine,
    time_s: float,
    options: PointingOptions,
) -> FingerLine | _NoLine:
    """Interpolate between two neighbours in time; the absence of either takes precedence."""
    if isinstance(before, _NoLine):
        return before
    if isinstance(after, _NoLine):
        return after
    history = [earlier] if isinstance(earlier, FingerLine) else []
    aligned = align([*history, before, after], time_s, options)
    return aligned.line or _NoLine(Status.LOST, aligned.reason)


class Pointer:
    """All views of a rig: frames in, fixes out.

    Parameters
    ----------
    rig
        At least two views.
    tracker_options
        Deviations from the tracker's defaults, for all views.
    pointing_options
        Conditions for a point, and the allowance for systematic errors: by default those for a
        bare hand.
    reference_sigma_px
        Standard deviation of reference points that come without a covariance [px], 1e-6 to 1e6.
    moving
        Called with every frame; returns the capsules of the system's moving bodies, such as a
        robot arm, in plane coordinates. Their silhouettes are excluded from the search for hands.
    operator
        Person whose habit of pointing is subtracted from the points; with None, a point is the
        intersection of the finger's axis with the plane.

    Raises
    ------
    InvalidInputError
        A rig with fewer than two views or whose views see the plane from different sides, an
        option out of range, or an operator who was calibrated in another unit.
    """

    def __init__(
        self,
        rig: Rig,
        *,
        tracker_options: Mapping[str, Any] | None = None,
        pointing_options: PointingOptions = BARE_HAND,
        reference_sigma_px: float = DEFAULT_REFERENCE_SIGMA_PX,
        moving: Callable[[], Sequence[Capsule]] = tuple,
        operator: Operator | None = None,
    ) -> None:
        if not isinstance(rig, Rig):
            raise InvalidInputError(
                f"rig is {rig!r}; a Rig is needed, and Rig.load() reads one from a file"
            )
        if not isinstance(pointing_options, PointingOptions):
            raise InvalidInputError(
                f"pointing_options is {pointing_options!r}; PointingOptions are needed"
            )
        check_tracker_options(tracker_options)
        in_range(reference_sigma_px, "reference_sigma_px", *_REFERENCE_SIGMAS_PX)
        if len(rig.views) < 2:
            raise InvalidInputError(
                f"the rig has {len(rig.views)} view; pointing needs two or more"
            )
        if not isinstance(operator, Operator | None):
            raise InvalidInputError(
                f"operator is {operator!r}; an Operator is needed, and Operator.load() reads one"
            )
        if operator is not None:
            operator.refuse_other_unit(rig.plane.unit)
        self._operator = operator
        self._search = ReferenceSearch(rig) if ReferenceSearch.is_needed(rig) else None
        self._admission = Admission(rig.views)
        self._rig = rig = stand_in(rig)
        self._tracker_options, self._reference_sigma_px = tracker_options, reference_sigma_px
        self._reductions: list[Reduction | None] = [None] * len(rig.views)
        self._rig_views = list(rig.views)
        self.views = tuple(self._hand_view(view, WHOLE) for view in rig.views)
        self._pushed = PushedViews(rig.views, self._admission)
        if self._search is None:
            self._refuse_different_sides()
        self._first: dict[int, Frame] | None = {}
        self._monitor = Monitor([view.name for view in rig.views])
        self._disagreement = Disagreement()
        self._moving = moving
        self._options = pointing_options
        self._still = self.plane_views
        self._watches = tuple(self._watch_of(view) for view in rig.views)
        self._seen_s = [np.inf] * len(self.views)
        self._histories = tuple(_History() for _ in self.views)
        self._pending: deque[_Pending] = deque()
        self._identity = Identity()
        self._rest = SearchRest()
        self._targets = rig.things

    def hold_back(self, sources: Sequence[Source]) -> None:
        """Hold points back until the hand has moved enough to compare clocks, if that is needed.

        It is for recordings that may have begun at different times: so no point is returned that
        does not allow for a lag which is found later. A frame waits for `HELD_BACK_S` at most, for
        less if the images are large, and not at all without a point.

        Parameters
        ----------
        sources
            Open sources of the views.
        """
        self._monitor.confirms = any(source.has_own_clock for source in sources)

    @property
    def holds_back(self) -> bool:
        """Whether points may be held back; see `hold_back`."""
        return self._monitor.confirms

    @property
    def plane_views(self) -> tuple[PlaneView, ...]:
        """Homography of each view, as of its last frame."""
        return tuple(view.plane_view for view in self.views)

    @property
    def rig(self) -> Rig:
        """The rig, including the detected reference points once `sees_plane` is true."""
        return self._rig

    @property
    def sees_plane(self) -> bool:
        """Whether the reference points of all views are known: given or detected."""
        return self._search is None

    def push(self, images: Images, time_s: float) -> list[Fix]:
        """Take images that the caller has captured; return the fixes that they complete.

        A fix has the time of a frame of the first view. It is returned once the other views have
        reached that time: by the same push if all views are pushed together.

        Parameters
        ----------
        images
            `uint8` arrays of shape (height, width), or (height, width, 3) in the order blue, green,
            red; copied. Either a mapping from view name to image, for one view or more, or a list
            with one entry per view in the rig's order, None where there is no image.
        time_s
            Capture time [s], on one clock for all views; never decreasing within a view.

        Returns
        -------
        list of Fix
            Oldest first; empty while views wait for each other.

        Raises
        ------
        InvalidInputError
            An unknown view, or images that `update` refuses.
        """
        rounds = self._pushed.take(images, time_s)
        return [step.fix for seen in rounds for step in self.update(seen)]

    def update(self, seen: Sequence[Frame | Loss | None]) -> list[Step]:
        """Process one frame of every view; return the steps that are complete.

        If all views are captured at the same time, their step is returned at once. If a view lags,
        the step of a frame of the first view is returned when the other views have passed its
        time, or after `max_wait_s`.

        Parameters
        ----------
        seen
            One entry per view, in the rig's order; None if a view has no frame at that time, a
            `Loss` if the frame was lost.

        Raises
        ------
        InvalidInputError
            The number of entries differs from that of the views; an entry is not a frame, or its
            image or time is unusable; the first frame of a view contains neither half of its
            reference points nor their middle; or a later frame has another size.
        """
        self._admission.admit(seen)
        if self._search is not None and (waiting := self._look_for_references(seen)):
            return waiting
        self._compare_scenery(seen)
        entries = self._monitor.look([self._reduced(k, entry) for k, entry in enumerate(seen)])
        losses = [entry if isinstance(entry, Loss) else None for entry in entries]
        frames = [entry if isinstance(entry, Frame) else None for entry in entries]
        self._watch(frames)
        bodies = self._moving()
        for view, frame in zip(self.views, frames, strict=True):
            view.exclude_bodies(bodies, frame)
        self._follow(frames)
        distinguish_body_from_hands(self.views, bodies)
        self._reject_table_pattern(frames)
        rests = self._rest.update(self.views, frames)
        for view in self.views:
            view.update_from_other_views(self._others(view))
        for view, frame in zip(self.views, frames, strict=True):
            view.observe(frame, rests=rests)
        if not rests and any(view.is_searching for view in self.views):
            find_hand(self.views, frames)
        for view, frame in zip(self.views, frames, strict=True):
            view.settle()
            view.test_flanks(frame)
            view.test_tip(frame)
        compare_widths(self.views)
        shared = PairTests()
        compare_lengths(self.views, shared)
        for view in [v for v in self.views if not v.validate(self._others(v), shared)]:
            view.reject()
        observations = tuple(
            Observation.of(view, frame, loss, watch, reduction or WHOLE)
            for view, frame, loss, watch, reduction in zip(
                self.views, frames, losses, self._watches, self._reductions, strict=True
            )
        )
        for history, observation, view in zip(
            self._histories, observations, self.views, strict=True
        ):
            history.add(observation, view.plane_view)
        # While a camera moves, its finger lines of different times are not comparable.
        self._monitor.take(
            [None if frame is None else frame.time_s for frame in frames],
            [one.finger if one.moved_px == 0.0 else None for one in observations],
            self.plane_views,
        )
        first = frames[0] or losses[0]
        if first is not None:
            self._identity.update(self.views, first.time_s)
            hand = self._identity.hand
            viewpoints = tuple(view.viewpoint for view in self.views)
            pending = _Pending(
                first.index, first.time_s, observations, hand, tuple(seen), viewpoints
            )
            self._pending.append(pending)
        steps = self._ready()
        needed_s = self._pending[0].time_s if self._pending else np.inf
        for history in self._histories:
            history.forget(needed_s)
        return steps

    def _look_for_references(self, seen: Sequence[Frame | Loss | None]) -> list[Step]:
        """Detect the references of all views; return a step without a fix while one is missing.

        Raises
        ------
        InvalidInputError
            Views that see the plane from different sides.
        """
        assert self._search is not None
        found = self._search.look(
            {k: frame.image for k, frame in enumerate(seen) if isinstance(frame, Frame)}
        )
        if found is None:
            first = seen[0]
            reasons = self._search.missing | self._search.undecided
            return [] if first is None else [self._step_without(first, reasons)]
        self._search, self._rig, self._rig_views = None, found, list(found.views)
        for k in range(len(found.views)):
            self._begin(k)
        self._refuse_different_sides()
        return []

    def _refuse_different_sides(self) -> None:
        if (wrong := different_sides(self._rig, self.plane_views)) is not None:
            raise InvalidInputError(f"{wrong.what}; {wrong.right}")

    def _step_without(self, first: Frame | Loss, reasons: Mapping[int, str]) -> Step:
        """Return the step of a frame while references are still missing or undecided."""
        none = np.empty((0, 2))
        observations = tuple(
            Observation(view.name, None, None, none, None, Status.ACQUIRING) for view in self.views
        )
        lines = (None,) * len(self.views)
        reason = "; ".join(reasons.values())
        return Step(
            first.index, observations, Fix(first.time_s, Status.ACQUIRING, lines, reason=reason)
        )

    def _compare_scenery(self, seen: Sequence[Frame | Loss | None]) -> None:
        """Refuse reference points that contradict the first frames.

        Doubtful ones are warned of, and their covariance is enlarged.

        Raises
        ------
        InvalidInputError
            The views show the same picture, or agree on the plane only after a common mistake in
            the rig is corrected.
        """
        if self._first is None:
            return
        for k, frame in enumerate(seen):
            if isinstance(frame, Frame):
                self._first.setdefault(k, frame)
        if len(self._first) < len(self._rig.views):
            return
        pictures = [self._first[k].image for k in range(len(self._rig.views))]
        self._first = None
        scenery = Scenery(self._rig, pictures)
        if (same := scenery.same_pictures()) is not None:
            raise InvalidInputError(f"{same.what}; {same.right}")
        has_fixed = any(isinstance(view.reference, FixedReference) for view in self._rig.views)
        if has_fixed and (mistake := scenery.mistake()) is not None:
            words = f"{mistake.what}; {mistake.advice(self._rig)}"
            if mistake.is_certain:
                raise InvalidInputError(words)
            _log.warning("%s", words)
            for k, off_px in mistake.off_px.items():
                view, sigma_px = self._rig_views[k], self._reference_sigma_px
                self._rig_views[k] = view.with_wider_references(sigma_px, off_px)
                self._begin(k)
        for k, bend in scenery.bends().items():
            view = self._rig_views[k]
            _log.warning('view "%s": %s; %s', view.name, bend.what, bend.right)
            self._rig_views[k] = bend.allowed_for(view, self._reference_sigma_px)
            self._begin(k)

    def _hand_view(self, view: View, reduction: Reduction) -> HandView:
        sigma_px = self._reference_sigma_px / reduction.factor
        return HandView(view, self._rig.plane.points, self._tracker_options, sigma_px)

    def _reduced(self, k: int, frame: Frame | Loss | None) -> Frame | Loss | None:
        """Reduce a large frame; the first one restarts its view in reduced pixels."""
        if not isinstance(frame, Frame):
            return frame
        reduction = self._reductions[k]
        if reduction is None:
            reduction = self._reductions[k] = Reduction.of(frame.image.shape, LARGEST_PX)
            if reduction.factor > 1:
                self._begin(k)
        if reduction.factor == 1:
            return frame
        return Frame(frame.index, frame.time_s, reduction.picture(frame.image))

    def _begin(self, k: int) -> None:
        """Restart a view with its present parameters."""
        reduction = self._reductions[k] or WHOLE
        view = reduced_view(self._rig_views[k], reduction)
        hand_view = self._hand_view(view, reduction)
        self.views = _with(self.views, k, hand_view)
        self._still = _with(self._still, k, hand_view.plane_view)
        self._watches = _with(self._watches, k, self._watch_of(view))

    def _watch_of(self, view: View) -> ReferenceWatch | ReferenceFollower:
        if isinstance(view.reference, FixedReference):
            return ReferenceWatch(view.reference_points_px, view.lens)
        points = np.array(self._rig.plane.points, np.float64)
        covariances = view.reference_covariances(self._reference_sigma_px)
        first = Measured(np.array(view.reference_points_px), joint_of(covariances))
        meter = meter_of(self._rig, view)
        return ReferenceFollower(points, meter, first, view.lens)

    def _watch(self, frames: Sequence[Frame | None]) -> None:
        """Update the views' homographies, in case a camera has moved."""
        for k, (view, still, watch, frame) in enumerate(
            zip(self.views, self._still, self._watches, frames, strict=True)
        ):
            if frame is None:
                continue
            if frame.time_s - self._seen_s[k] > ABSENT_S:
                watch.doubt()
            self._seen_s[k] = frame.time_s
            watch.look(frame.grey(), view.hand, frame.image)
            if (plane_view := watch.plane_view(still)) is not None:
                view.move(plane_view)

    def _follow(self, frames: Sequence[Frame | None]) -> None:
        """Update the trackers of all views in one call; an error in one does not stop the others.

        Raises
        ------
        FingerpostError
            A tracker refused its frame; with several errors, that of the first view.
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

    def _others(self, view: HandView) -> list[HandView]:
        """Return all views but one."""
        return [other for other in self.views if other is not view]

    def _reject_table_pattern(self, frames: Sequence[Frame | None]) -> None:
        """Reject fingers that are patterns on the table."""
        appearance = [
            flatness_of_followed(self.views, frames, k) if view.may_follow_table else None
            for k, view in enumerate(self.views)
        ]
        for view, flat in zip(self.views, appearance, strict=True):
            if flat is not None:
                view.reject_if_flat(flat)

    def notes(self) -> list[str]:
        """Return remarks on the views, one line each: repeated images, differing clocks."""
        return self._monitor.notes()

    def finish(self) -> list[Step]:
        """Return the remaining steps, whose time some views have not reached."""
        steps = [step for seen in self._pushed.rest() for step in self.update(seen)]
        while self._pending:
            steps.append(self._step(self._pending.popleft(), "the view has ended before"))
        return steps

    def _ready(self) -> list[Step]:
        """Return the steps whose time all views have reached, or that have waited too long."""
        steps: list[Step] = []
        while self._pending and not self._is_held_back():
            oldest_s = self._pending[0].time_s
            waited_s = self._pending[-1].time_s - oldest_s
            is_late = waited_s > self._options.max_wait_s
            if not is_late and any(h.at(oldest_s, self._options) is None for h in self._histories):
                break
            most_s = self._options.max_wait_s
            late = f"no frame for {waited_s:.4g} s; at most {most_s:g} s are waited for"
            steps.append(self._step(self._pending.popleft(), late))
        return steps

    def _is_held_back(self) -> bool:
        """Whether the oldest frame waits for the comparison of the clocks."""
        oldest, newest = self._pending[0], self._pending[-1]
        return (
            self.holds_back
            and oldest.may_have_point
            and newest.time_s - oldest.time_s < HELD_BACK_S
            and newest.size_bytes * len(self._pending) < HELD_BACK_BYTES
            and not self._monitor.has_compared_clocks
        )

    def _step(self, pending: _Pending, without_frame: str) -> Step:
        """Compute the fix at the time of a frame.

        `without_frame` is the reason for a view that has not reached that time.
        """
        lines: list[FingerLine | _NoLine] = [
            history.at(pending.time_s, self._options) or _NoLine(Status.LOST, without_frame)
            for history in self._histories
        ]
        plane_views = [
            history.plane_view_at(pending.time_s, view.plane_view)
            for history, view in zip(self._histories, self.views, strict=True)
        ]
        rays = rays_of_tips(pending.viewpoints, lines)
        for k in other_fingers(rays):
            lines[k] = _NoLine(Status.ILL_CONDITIONED, ANOTHER_FINGER)
        for k, lag in enumerate(self._monitor.lags):
            if lag is not None and isinstance(lines[k], FingerLine):
                lines[k] = _NoLine(Status.ILL_CONDITIONED, lag.why)
        displacements = self._disagreement.update(
            {
                pair: tips.distance
                for pair, tips in rays.items()
                if all(isinstance(lines[k], FingerLine) for k in pair)
            }
        )
        fingers = [finger.status if isinstance(finger, _NoLine) else finger for finger in lines]
        fix = indicated_point(
            fingers,
            plane_views,
            time_s=pending.time_s,
            options=self._options,
            names=[f'view "{view.name}"' for view in self.views],
            absences=_absences(lines, pending.observations),
            displacements={k: σ * plane_views[k].plane_size for k, σ in displacements.items()},
        )
        if self._operator is not None:
            size = max(view.plane_size for view in plane_views)
            fix = self._operator.meant(fix, self._options.max_sigma * size)
        if fix.point is not None and fix.covariance is not None:
            fix = replace(fix, targets=self._targets.probabilities(fix.point, fix.covariance))
        return Step(pending.index, pending.observations, fix, pending.hand, pending.frames)


def _with(entries: tuple[Entry, ...], k: int, entry: Entry) -> tuple[Entry, ...]:
    return (*entries[:k], entry, *entries[k + 1 :])


def _absences(
    lines: Sequence[FingerLine | _NoLine], observations: Sequence[Observation]
) -> dict[int, str]:
    """Return reasons that the status does not give, by index of the views without a line."""
    absences = {}
    for k, (finger, seen) in enumerate(zip(lines, observations, strict=True)):
        if isinstance(finger, FingerLine):
            continue
        if finger.reason:
            absences[k] = finger.reason
        elif seen.is_adrift:
            absences[k] = _moved(seen)
        elif seen.is_body:
            absences[k] = "it shows what the system itself moves"
    return absences


def at_most(frames: Iterator[Frames], count: int | None) -> Iterator[Frames]:
    """Return an iterator over the first `count` frames, or over all of them for None.

    Raises
    ------
    InvalidInputError
        `count` is neither None nor a whole number from 0.
    """
    if count is None:
        return frames
    if isinstance(count, bool) or not isinstance(count, numbers.Integral) or count < 0:
        raise InvalidInputError(f"max_frames is {count!r}; a whole number from 0 is right, or None")
    return islice(frames, min(int(count), sys.maxsize))  # more cannot be counted


def steps(pointer: Pointer, frames: Iterable[Sequence[Frame | Loss | None]]) -> Iterator[Step]:
    """Feed a pointer with frames and yield its steps to the last.

    Steps that are held back come before an error of the frames; those of live views do not, for an
    arm must not go on after an interruption.
    """
    try:
        for together in frames:
            yield from pointer.update(together)
    except (FingerpostError, KeyboardInterrupt):
        if pointer.holds_back:
            yield from pointer.finish()
        raise
    yield from pointer.finish()


Seen = tuple[Fix, tuple[Frame | Loss | None, ...]]
"""A fix and the entries of all views for its frame of the first view."""


@overload
def track(
    rig: Rig,
    *,
    frames: Literal[False] = False,
    max_frames: int | None = None,
    give_up_after_s: float | None = None,
    **options: Any,
) -> Iterator[Fix]: ...


@overload
def track(
    rig: Rig,
    *,
    frames: Literal[True],
    max_frames: int | None = None,
    give_up_after_s: float | None = None,
    **options: Any,
) -> Iterator[Seen]: ...


def track(
    rig: Rig,
    *,
    frames: bool = False,
    max_frames: int | None = None,
    give_up_after_s: float | None = None,
    **options: Any,
) -> Iterator[Fix] | Iterator[Seen]:
    """Yield the fixes of a rig, live or recorded, in the order of the first view's frames.

    Parameters
    ----------
    rig
        At least two views, each with a source.
    frames
        Yield ``(fix, frames)`` instead. `frames` has one entry per view, in the rig's order: a
        `Frame`, a `Loss` if it was lost, or None if the view has none at that time.
    max_frames
        Number of frames to read from each view; None reads to the end.
    give_up_after_s
        Longest silence of a live view before an error is raised [s]; None waits for ever.
    **options
        Keyword arguments of `Pointer`.

    Yields
    ------
    Fix
        One per frame of the first view.

    Raises
    ------
    InvalidInputError
        A rig or option that `Pointer` refuses, or frames that `Pointer.update` refuses.
    CaptureError
        A source cannot be opened or read, or has been silent for too long.
    """
    pointer = Pointer(rig, **options)
    with ExitStack() as stack:
        sources = stack.enter_context(open_views(rig.sources, rig.readings))
        together = at_most(read_views(sources, give_up_after_s=give_up_after_s), max_frames)
        pointer.hold_back(sources)
        for step in steps(pointer, together):
            yield (step.fix, step.frames) if frames else step.fix
