"""Definition of the plane by the robot: section 3.4 of the paper.

"The reference points are defined by observing the robot gripper as it visits 4 points in a plane
(this not only defines the working coordinate system but relates it to the robot's own world
coordinate system)." Here the gripper visits more than four places, each from above. Its position is
read from the robot and detected in every view; inconsistent places are visited again or, if that
fails, excluded and reported. The result is a rig whose plane coordinates are the robot's X and Y.
"""

from __future__ import annotations

import logging
import math
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Annotated, TypeAlias

import msgspec
import numpy as np
from numpy.typing import NDArray

from fingerpost.capture import Frame
from fingerpost.config import FixedReference, Plane, Rig, RobotTable, View
from fingerpost.errors import CaptureError, InvalidInputError
from fingerpost.guidance.agreement import (
    Agreement,
    Sightings,
    ViewTie,
    agree,
    need_certainty,
)
from fingerpost.guidance.errors import GripperNotFoundError, InconsistentPlaneError
from fingerpost.guidance.finders import GripperFinder, Sighting
from fingerpost.homography import MIN_REFERENCE_POINTS
from fingerpost.robot import Guard, OutOfReachError, SafeRegion
from fingerpost.robot.options import CheckedOptions

logger = logging.getLogger(__name__)

CANDIDATES = 41
"""Side of the square grid over the safe region from which places are chosen."""

PATIENCE_S = 5.0
"""Time limit for each further frame of a standing gripper [s]."""

FrameReader = Callable[[], Sequence[Frame | None]]
"""Returns the next, or newest, frame of every view, with times on the guard's clock."""

Offset: TypeAlias = Annotated[float, msgspec.Meta(ge=-1, le=1)]
"""One component of a position on the gripper [m]."""


class PlaneOptions(CheckedOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the definition of a plane by the robot.

    Attributes
    ----------
    points : int
        Number of places to visit, 4 to 50; with 6 or more, a wrong one is identified.
    offset_m : tuple of 3 floats
        Offset of the detected point from the gripper's working point, in the robot's axes [m]:
        (0, 0, 0.04) for a marker whose centre is 40 mm above the tip. This point visits the plane,
        so the tip goes below it by that height.
    lift_m : float
        Height above the plane at which the gripper moves from place to place [m], ≥ 0.
    speed_m_s : float
        Its speed [m/s], > 0.
    settle_s : float
        Time after the arm has stopped until frames are used [s], ≥ 0.
    frames : int
        Number of frames used per place and view.
    arm_sigma_m : float
        Standard deviation of the arm's position relative to its reading, in X and in Y [m], ≥ 0.
    max_sigma_m : float
        Largest accepted standard deviation of the plane in the safe region, in a view [m].
    revisits : int
        Number of repeated visits to a place where the gripper was not, or wrongly, detected.
    """

    points: Annotated[int, msgspec.Meta(ge=MIN_REFERENCE_POINTS, le=50)] = 9
    offset_m: tuple[Offset, Offset, Offset] = (0.0, 0.0, 0.0)
    lift_m: Annotated[float, msgspec.Meta(ge=0, le=10)] = 0.03
    speed_m_s: Annotated[float, msgspec.Meta(gt=0, le=10)] = 0.1
    settle_s: Annotated[float, msgspec.Meta(ge=0, le=60)] = 0.3
    frames: Annotated[int, msgspec.Meta(ge=1, le=1000)] = 5
    arm_sigma_m: Annotated[float, msgspec.Meta(ge=0, le=1)] = 0.0003
    max_sigma_m: Annotated[float, msgspec.Meta(gt=0, le=1)] = 0.003
    revisits: Annotated[int, msgspec.Meta(ge=0, le=100)] = 1


@dataclass(frozen=True, eq=False, slots=True)
class Visit:
    """One visit to a place.

    Attributes
    ----------
    place
        Number of the place, from 0.
    position_m : (3,)
        Position of the point to detect, by the robot's reading and the offset [m].
    sightings
        One per view; None where it was not detected.
    problem
        Why it was not detected in a view; empty if it was in all.
    """

    place: int
    position_m: NDArray[np.float64]
    sightings: tuple[Sighting | None, ...]
    problem: str = ""


@dataclass(frozen=True, eq=False)
class PlaneByRobot:
    """A plane that the robot has defined.

    Attributes
    ----------
    visits
        The last visit to every place, in the order of places.
    left_out
        Reasons for excluded places, by number from 0.
    agreement
        Registration of the views with the robot by the other places.
    height_m
        The plane's Z in the robot's frame [m].
    sigma_m : (V, C)
        Standard deviation of each view's plane at each corner of the safe region [m].
    revisited
        Places that were visited more than once.
    """

    visits: tuple[Visit, ...]
    left_out: dict[int, str]
    agreement: Agreement
    height_m: float
    sigma_m: NDArray[np.float64]
    revisited: frozenset[int] = field(default_factory=frozenset)

    @property
    def ties(self) -> tuple[ViewTie, ...]:
        """One per view: homography from the robot's X, Y [m], covariance, residuals."""
        return self.agreement.ties

    @property
    def positions_m(self) -> NDArray[np.float64]:
        """The robot's X, Y of the places used, (N, 2) [m]."""
        return np.asarray(self.ties[0].plane_view.plane_points)

    def rig(self, cameras: Rig, robot: RobotTable) -> Rig:
        """Return the rig with this plane.

        Parameters
        ----------
        cameras
            Rig from which views, sources, lenses and start poses are copied, but not the plane.
        robot
            The robot; its `height_m` is replaced by this plane's.

        Returns
        -------
        Rig
            The plane's points are the robot's X, Y in metres; the views' reference points are the
            detected pixels, with the covariance of finder and arm.
        """
        counted = [visit for visit in self.visits if visit.place not in self.left_out]
        views = [
            _view_of(view, tie, [visit.sightings[v] for visit in counted])
            for v, (view, tie) in enumerate(zip(cameras.views, self.ties, strict=True))
        ]
        points = tuple((float(x), float(y)) for x, y in self.positions_m)
        return Rig(
            plane=Plane(unit="m", points=points),
            views=tuple(views),
            robot=msgspec.structs.replace(robot, height_m=self.height_m),
        )

    def lines(self) -> list[str]:
        """Return the summary, line by line."""
        said = [
            f"plane at Z = {self.height_m:.4f} m by {len(self.positions_m)} of "
            f"{len(self.visits)} places"
        ]
        for tie, sigma_m in zip(self.ties, self.sigma_m, strict=True):
            line = f"{tie.name:<12} residuals {tie.rms_px:.2f} px RMS"
            if tie.freedom:
                line += f"   χ² {tie.chi2:.1f} for {tie.freedom}"
                line += f"   worst place {np.max(tie.distances):.1f} σ"
            said.append(f"{line}   plane to {1000 * sigma_m.max():.2f} mm (σ, worst corner)")
        said += [f"place {place + 1} left out: {why}" for place, why in self.left_out.items()]
        if not self.agreement.checked:
            said.append("4 places check nothing: a wrong one would not show; visit 6 or more")
        return said

    def as_dict(self) -> dict[str, object]:
        """Return the summary for programs."""
        return {
            "height_m": self.height_m,
            "positions_m": self.positions_m.tolist(),
            "left_out": {str(place + 1): why for place, why in self.left_out.items()},
            "revisited": sorted(place + 1 for place in self.revisited),
            "views": [
                {
                    "name": tie.name,
                    "image_from_robot": tie.plane_view.image_from_plane.tolist(),
                    "entries_covariance": tie.plane_view.entries_covariance.tolist(),
                    "residuals_px": tie.residuals_px.tolist(),
                    "distances_sigma": [d if math.isfinite(d) else None for d in tie.distances],
                    "chi2": tie.chi2,
                    "freedom": tie.freedom,
                    "sigma_m": sigma_m.tolist(),
                }
                for tie, sigma_m in zip(self.ties, self.sigma_m, strict=True)
            ],
        }


def spread_places(region: SafeRegion, count: int) -> NDArray[np.float64]:
    """Choose places over a region, as far from each other as possible.

    First the region's corners, if there are enough places for all of them; then repeatedly the
    place furthest from all chosen ones: the middle of a rectangle, the middles of its sides.

    Parameters
    ----------
    region
        The region.
    count
        Number of places, ≥ 2.

    Returns
    -------
    (count, 2)
        Ordered for short moves from one to the next.

    Raises
    ------
    InvalidInputError
        More places than fit into the region.
    """
    lower, upper = region.corners.min(axis=0), region.corners.max(axis=0)
    shares = np.linspace(0.0, 1.0, CANDIDATES)
    grid = np.stack(np.meshgrid(shares, shares), axis=-1).reshape(-1, 2)
    inside = [
        point for point in lower + grid * (upper - lower) if region.contains(point, region.lowest_m)
    ]
    corners = len(region.corners)
    candidates = np.array([*region.corners, *inside])
    between = np.linalg.norm(candidates[:corners, None] - candidates[:corners], axis=2)
    furthest_pair = np.unravel_index(int(np.argmax(between)), between.shape)
    chosen = list(range(corners)) if corners <= count else [int(k) for k in furthest_pair]
    nearest = np.linalg.norm(candidates[:, None] - candidates[chosen], axis=2).min(axis=1)
    while len(chosen) < count:
        furthest = int(np.argmax(nearest))
        if nearest[furthest] <= 0:
            raise InvalidInputError(
                f"points is {count}; the safe region has room for {len(chosen)}"
            )
        chosen.append(furthest)
        nearest = np.minimum(nearest, np.linalg.norm(candidates - candidates[furthest], axis=1))
    return _short_way(candidates[chosen])


def places_to_visit(guard: Guard, options: PlaneOptions | None = None) -> NDArray[np.float64]:
    """Choose the places that `define_plane` visits, in their order; nothing moves.

    Call it before the arm is homed, to detect errors in heights, region and number of places.

    Parameters
    ----------
    guard
        Guard with plane and safe region; its robot is not used.
    options
        Options of the definition.

    Returns
    -------
    (N, 2)
        Plane coordinates.

    Raises
    ------
    OutOfReachError
        The places, or the paths above them, are outside the safe region.
    InvalidInputError
        More places than fit into the region.
    """
    options = options or PlaneOptions()
    region, plane = guard.region, guard.plane
    above_m = -options.offset_m[2]
    for what, height_m in (
        ("the places", above_m),
        ("the way over them", above_m + options.lift_m),
    ):
        _, allowed_m = guard.clamp(region.centre, height_m)
        if allowed_m != height_m:
            pose, allowed = (plane.pose(region.centre, z) for z in (height_m, allowed_m))
            raise OutOfReachError(
                f"{what} would have the gripper at Z = {pose.z_m:.4f} m, outside the safe "
                f"region; {allowed.z_m:.4f} m is the nearest inside: choose another height, "
                "lift or offset, or another region"
            )
    return spread_places(guard.allowed, options.points)


def define_plane(
    guard: Guard,
    cameras: Rig,
    frames: FrameReader,
    finders: Sequence[GripperFinder],
    options: PlaneOptions | None = None,
    *,
    progress: Callable[[Visit], None] = lambda _: None,
) -> PlaneByRobot:
    """Move the gripper over a plane, and register every view with the robot by its detections.

    Parameters
    ----------
    guard
        Armed guard, with the plane to define: the robot's own X and Y (`RobotPlane.same`) at the
        plane's height. The caller provides the operator's heartbeat.
    cameras
        Names and lenses of the views; its plane is not used.
    frames
        Frames of these views, in their order.
    finders
        One per view, in the same order.
    options
        Options of the definition.
    progress
        Called with every visit.

    Returns
    -------
    PlaneByRobot

    Raises
    ------
    InvalidInputError
        The numbers of finders and views differ, or the region is too small.
    OutOfReachError
        The places, or the paths above them, are outside the safe region.
    PlaneError
        The gripper was detected too rarely, or the places contradict each other or leave the plane
        too uncertain; the message says what would be right.
    CaptureError
        The views stopped.
    RobotError
        An error of the arm, which has been stopped.
    """
    options = options or PlaneOptions()
    if len(finders) != len(cameras.views):
        raise InvalidInputError(
            f"{len(finders)} finders for {len(cameras.views)} views; one for each is needed"
        )
    return _Procedure(guard, cameras, frames, finders, options, progress).run()


class _Procedure:
    """The visits of one plane."""

    def __init__(
        self,
        guard: Guard,
        cameras: Rig,
        frames: FrameReader,
        finders: Sequence[GripperFinder],
        options: PlaneOptions,
        progress: Callable[[Visit], None],
    ) -> None:
        self._guard = guard
        self._cameras = cameras
        self._frames = frames
        self._finders = finders
        self._options = options
        self._progress = progress
        self._offset_m = np.array(options.offset_m)
        self._above_m = -options.offset_m[2]
        self._places = places_to_visit(guard, options)
        self._visits: dict[int, Visit] = {}
        self._counts = dict.fromkeys(range(options.points), 0)
        self._elsewhere: list[list[NDArray[np.uint8]]] = [[] for _ in finders]

    def run(self) -> PlaneByRobot:
        for seen, frames in zip(self._elsewhere, self._standing(), strict=True):
            seen.append(frames[-1].grey())
        self._guard.enter()
        self._watch_standing()
        for place in range(len(self._places)):
            self._visit(place)
        while again := self._to_visit_again():
            for place in again:
                self._visit(place)
        found = self._found()
        if len(found) < MIN_REFERENCE_POINTS:
            raise GripperNotFoundError(self._not_found(found))
        agreement = self._agreement(found)
        left_out = {
            place: visit.problem for place, visit in sorted(self._visits.items()) if visit.problem
        }
        left_out |= {
            found[k]: "what was found there does not agree with the other places"
            for k in agreement.wrong
        }
        corners = self._guard.region.corners
        sigma_m = need_certainty(agreement, corners, self._options.max_sigma_m)
        counted = [self._visits[found[k]] for k in agreement.kept]
        return PlaneByRobot(
            tuple(visit for _, visit in sorted(self._visits.items())),
            dict(sorted(left_out.items())),
            agreement,
            float(np.mean([visit.position_m[2] for visit in counted])),
            sigma_m,
            frozenset(place for place, count in self._counts.items() if count > 1),
        )

    def _watch_standing(self) -> None:
        """Let finders that follow the gripper acquire it over the region's middle."""
        if any(finder.watches for finder in self._finders):
            for finder, frames in zip(self._finders, self._standing(), strict=True):
                for frame in frames:
                    finder.watch(frame)

    def _visit(self, place: int) -> None:
        """Approach a place from above, so that backlash has one sign; detect; move up."""
        point = self._places[place]
        high_m = self._above_m + self._options.lift_m
        self._counts[place] += 1
        self._go(point, high_m)
        self._go(point, self._above_m)
        visit = self._look(place)
        self._visits[place] = visit
        logger.info("place %d at %s: %s", place + 1, visit.position_m, visit.problem or "found")
        self._progress(visit)
        self._go(point, high_m)

    def _go(self, point: NDArray[np.float64], above_m: float) -> None:
        """Move; meanwhile pass frames to the finders if one of them watches."""
        speed = self._options.speed_m_s
        if not any(finder.watches for finder in self._finders):
            self._guard.visit(point, above_m, speed_m_s=speed)
            return
        with ThreadPoolExecutor(1, thread_name_prefix="visit") as mover:
            moving = mover.submit(self._guard.visit, point, above_m, speed_m_s=speed)
            try:
                while not moving.done():
                    for finder, frame in zip(self._finders, self._frames(), strict=True):
                        if frame is not None:
                            finder.watch(frame)
            except BaseException as error:
                self._guard.halt(f"{type(error).__name__}: {error}")
                raise
            moving.result()

    def _look(self, place: int) -> Visit:
        """Detect the gripper in every view while it stands."""
        standing = self._standing()
        point, above_m = self._guard.where()
        z_m = self._guard.plane.pose(point, above_m).z_m
        position_m = np.array([*point, z_m]) + self._offset_m
        sightings: list[Sighting | None] = []
        problems = []
        for view, finder, frames, elsewhere in zip(
            self._cameras.views, self._finders, standing, self._elsewhere, strict=True
        ):
            try:
                sightings.append(finder.find(place, frames, elsewhere))
            except GripperNotFoundError as error:
                sightings.append(None)
                problems.append(f"not found in view {view.name}: {error}")
        for seen, frames in zip(self._elsewhere, standing, strict=True):
            seen.append(frames[-1].grey())
        return Visit(place, position_m, tuple(sightings), "; ".join(problems))

    def _standing(self) -> list[list[Frame]]:
        """Collect the required frames of every view, after the arm has settled."""
        from_s = self._guard.time_s + self._options.settle_s
        collected: list[list[Frame]] = [[] for _ in self._finders]
        while any(len(frames) < self._options.frames for frames in collected):
            for finder, frames, frame in zip(self._finders, collected, self._frames(), strict=True):
                if frame is None or len(frames) == self._options.frames:
                    continue
                if frame.time_s >= from_s:
                    frames.append(frame)
                else:
                    finder.watch(frame)
            if self._guard.time_s > from_s + PATIENCE_S * self._options.frames:
                raise CaptureError(
                    "the views give no frames from after the arm stood still: are they live, on "
                    "the guard's clock?"
                )
        return collected

    def _found(self) -> list[int]:
        return [place for place, visit in sorted(self._visits.items()) if not visit.problem]

    def _not_found(self, found: Sequence[int]) -> str:
        problems = Counter(visit.problem for visit in self._visits.values() if visit.problem)
        problem, count = problems.most_common(1)[0]
        return (
            f"the gripper was found at {len(found)} of {len(self._visits)} places, at least "
            f"{MIN_REFERENCE_POINTS} are needed; at {count}: {problem}"
        )

    def _agreement(self, found: Sequence[int]) -> Agreement:
        """Return the agreement of the places with detections."""
        positions = np.array([self._visits[place].position_m[:2] for place in found]).reshape(-1, 2)
        views = []
        for v, view in enumerate(self._cameras.views):
            seen = [s for place in found if (s := self._visits[place].sightings[v]) is not None]
            views.append(
                Sightings(
                    view.name,
                    np.array([s.pixel_px for s in seen]).reshape(-1, 2),
                    np.array([s.covariance_px2 for s in seen]).reshape(-1, 2, 2),
                    view.lens,
                )
            )
        return agree(
            positions,
            views,
            arm_sigma_m=self._options.arm_sigma_m,
            numbers=[place + 1 for place in found],
        )

    def _to_visit_again(self) -> list[int]:
        """Return places without a detection, or suspected, that may be visited again."""
        found = self._found()
        again = set(self._visits) - set(found)
        if len(found) >= MIN_REFERENCE_POINTS:
            try:
                again |= {found[k] for k in self._agreement(found).wrong}
            except InconsistentPlaneError:
                again |= set(found)
        return sorted(place for place in again if self._counts[place] <= self._options.revisits)


def _view_of(view: View, tie: ViewTie, sightings: Sequence[Sighting | None]) -> View:
    """Return a view with the detected pixels as its reference points."""
    pixels = [tuple(map(float, one.pixel_px)) for one in sightings if one is not None]
    covariances = [(float(Σ[0, 0]), float(Σ[0, 1]), float(Σ[1, 1])) for Σ in tie.covariances_px2]
    return msgspec.structs.replace(
        view,
        reference_points_px=tuple(pixels),
        reference_covariances_px2=tuple(covariances),
        reference=FixedReference(),
    )


def _short_way(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Order points, starting at the first corner, by the nearest of the remaining ones."""
    left = list(range(len(points)))
    way = [left.pop(int(np.lexsort(points.T)[0]))]
    while left:
        distances = np.linalg.norm(points[left] - points[way[-1]], axis=1)
        way.append(left.pop(int(np.argmin(distances))))
    return points[way]
