"""Advice on a rig: expected accuracy of the present cameras, and improvements."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fingerpost.admission import different_sides, refuse_unknown_points
from fingerpost.advise.camera import USABLE_FOCAL_SIGMA, PlaneCamera, recover_camera
from fingerpost.advise.forecast import (
    Doubt,
    Figures,
    Forecast,
    ideal_view,
    predict,
    without,
)
from fingerpost.advise.moves import WORTHWHILE_SHARE, Bearings, Move, try_moves
from fingerpost.advise.options import AdviceOptions
from fingerpost.advise.poses import Poses, Workspace
from fingerpost.config import Rig
from fingerpost.errors import InvalidInputError
from fingerpost.experiment.table import number
from fingerpost.homography import transfer_jacobian_by_entries
from fingerpost.pointing import PlaneView

Array = NDArray[np.float64]
Progress = Callable[[int, int], None]

DOUBTFUL_MISFIT = 9.0
LARGEST_MISFIT = 25.0
"""Limits of the squared misfit of reference points to any camera. Above 3 standard deviations a
view is doubted, above 5 it is refused, because a forecast would be for another camera."""

SMALL_VERGENCE_DEG = 15.0
"""Below this angle between the views' rays to the middle of the workspace, constraint lines run
nearly parallel in every direction of pointing."""

SHORT_FINGER_PX = 30.0
"""Length below which the finger limits the accuracy more than the cameras' placement: its line's
error grows as length^-3/2."""

WEAK_REFERENCES = 2.0
"""Standard deviation of a point of the workspace relative to that of the reference points, in the
image: 0.5 to 1 between four corners that are well apart."""

NOTABLE_SHARE = 0.05
HOPELESS_SHARE = 0.5
"""Share of poses without a point above which a direction is called hopeless."""

_POSES_EACH = 3


class Concern(StrEnum):
    """Subject of a flag."""

    SCALE = "scale"
    """The plane's coordinates are not to scale, or the image is cropped."""
    FOCAL_LENGTH = "focal_length"
    """The view does not determine its own focal length; one is assumed."""
    VERGENCE = "vergence"
    """Two cameras have nearly the same direction."""
    REFERENCES = "references"
    """Reference points cover a small area, or are nearly collinear."""
    REFERENCE_ERROR = "reference_error"
    """Reference points cause most of the error."""
    SHORT_FINGER = "short_finger"
    """The finger is small in the image."""
    OUT_OF_VIEW = "out_of_view"
    """The hand is outside an image in some of the poses."""
    END_ON = "end_on"
    """A camera sees the finger end-on in some of the poses."""
    COPLANAR = "coplanar"
    """The finger is coplanar with the cameras in some of the poses."""
    BEHIND = "behind"
    """A camera does not see the indicated point of the plane in some of the poses."""


@dataclass(frozen=True, slots=True)
class Flag:
    """A remark on the set-up.

    Attributes
    ----------
    concern
        Its subject.
    view
        Name of the view, or empty for the rig.
    text
        One sentence: the problem and its remedy.
    """

    concern: Concern
    view: str
    text: str


@dataclass(frozen=True, eq=False)
class ViewAdvice:
    """One camera, recovered from its reference points.

    Attributes
    ----------
    name
        Name of the view.
    camera
        The camera.
    bearings
        Its direction and distance from the workspace.
    px_per_mm
        Scale of a hand in the middle of the workspace.
    finger_px
        Median length of the finger's flanks in the image, over the expected poses [px].
    in_view
        Share of the expected poses inside the image, 0 to 1.
    """

    name: str
    camera: PlaneCamera
    bearings: Bearings
    px_per_mm: float
    finger_px: float
    in_view: float


@dataclass(frozen=True, eq=False)
class Cell:
    """A square of the workspace and the expected poses that point into it."""

    middle: Array
    figures: Figures


@dataclass(frozen=True, eq=False)
class Direction:
    """A sector of pointing directions, with its poses.

    Attributes
    ----------
    azimuth_deg
        Its middle, −180 to 180: 0 towards the cameras, positive anticlockwise from above.
    expected
        Whether it is in the range of expected poses.
    figures
        Figures of all targets.
    """

    azimuth_deg: float
    expected: bool
    figures: Figures

    @property
    def hopeless(self) -> bool:
        """Whether most poses in view, if there are any, have no point."""
        return not self.figures.hopeless <= HOPELESS_SHARE


@dataclass(frozen=True, eq=False)
class Advice:
    """Expected accuracy of a rig, and improvements. Lengths are in plane units.

    Attributes
    ----------
    unit
        Name of the plane's unit.
    views
        The cameras.
    flags
        Problems and doubts, the gravest first; empty if there are none.
    expected
        Figures of all expected poses.
    shares
        Shares of the mean squared error from ``references``, ``noise`` and ``bias``; they sum to 1.
    cells, cell_size
        The map: expected poses by target; and the side of a cell.
    directions
        All poses, by azimuth.
    moves
        All tried moves of one camera, the best first.
    recommended
        The best of them if it is worthwhile, else None.
    workspace, plane_points
        The workspace, and the reference points.
    """

    unit: str
    views: tuple[ViewAdvice, ...]
    flags: tuple[Flag, ...]
    expected: Figures
    shares: dict[str, float]
    cells: tuple[Cell, ...]
    cell_size: float
    directions: tuple[Direction, ...]
    moves: tuple[Move, ...]
    recommended: Move | None
    workspace: Workspace
    plane_points: Array

    @property
    def recommendation(self) -> str:
        """One sentence: which camera to move and why, or that none need be moved."""
        move = self.recommended
        if move is None and self.expected.hopeless <= HOPELESS_SHARE:
            return "leave the cameras where they are: no single move makes much of a difference"
        if move is None:
            return "no move of one camera alone is enough: heed the notes first"
        return f"{move.words(self.views[move.view].name)}: {_why(move, self.unit)}"

    def table(self) -> list[str]:
        """Return everything as lines of text."""
        from fingerpost.advise.table import table_lines

        return list(table_lines(self))

    def as_dict(self) -> dict[str, Any]:
        """Return all results as JSON values: None where there is no number."""
        from fingerpost.advise.table import as_dict

        return as_dict(self)

    def draw(self, path: str | Path) -> None:
        """Draw map, directions and cameras into an image file.

        Raises
        ------
        InvalidInputError
            An image format that OpenCV cannot write, or a path that is not writable.
        """
        from fingerpost.advise.drawing import draw_advice

        draw_advice(self, Path(path))


def advise(
    rig: Rig,
    sizes_px: Sequence[tuple[int, int]],
    options: AdviceOptions | None = None,
    *,
    progress: Progress | None = None,
) -> Advice:
    """Predict the accuracy of a rig before it is used, and which camera to move.

    Parameters
    ----------
    rig
        At least two views of one plane, whose coordinates are true to scale. Their sources are not
        opened.
    sizes_px
        Width and height of each view's images.
    options
        Expected hands and pictures.
    progress
        Called with the number of moves tried and of all.

    Returns
    -------
    Advice

    Raises
    ------
    InvalidInputError
        Fewer than two views, another number of sizes, a plane unit without a length, reference
        points that are inconsistent with any camera, or views that see the plane from different
        sides.
    """
    options = options or AdviceOptions()
    if len(rig.views) < 2:
        raise InvalidInputError(f"the rig has {len(rig.views)} view; pointing needs two or more")
    if len(sizes_px) != len(rig.views):
        raise InvalidInputError(
            f"{len(sizes_px)} sizes_px for {len(rig.views)} views; one for each is needed"
        )
    unit_mm = options.unit_length_mm(rig.plane.unit)
    names = [view.name for view in rig.views]
    refuse_unknown_points(rig)
    given = _given_views(rig, options)
    cameras = _recovered(rig, given, sizes_px, options)
    plane_points = given[0].plane_points
    views = [ideal_view(camera, plane_points, options.reference_sigma_px) for camera in cameras]
    workspace = Workspace.between(plane_points, cameras)

    usual = Poses.expected(workspace, options.poses, unit_mm, options.samples)
    typical, moves = try_moves(usual, cameras, workspace, plane_points, options, unit_mm, progress)
    worthwhile = moves and moves[0].typical_error < WORTHWHILE_SHARE * typical
    cells = workspace.cells(options.cells)
    poses, cell, sector = Poses.all_round(
        workspace, options.poses, unit_mm, cells, options.sectors, _POSES_EACH
    )
    forecast = predict(poses, cameras, plane_points, options, unit_mm)
    wanted = _is_expected(poses.azimuth_deg, options)
    middles = np.arange(options.sectors) * 360.0 / options.sectors
    middles = (middles + 180.0) % 360.0 - 180.0
    expected = forecast.figures(wanted)
    each_view = tuple(
        _view_advice(name, k, camera, workspace, forecast, wanted, unit_mm)
        for k, (name, camera) in enumerate(zip(names, cameras, strict=True))
    )
    shares = _shares(usual, cameras, plane_points, options, unit_mm)
    return Advice(
        unit=rig.plane.unit,
        views=each_view,
        flags=tuple(
            _flags(each_view, views, workspace, expected, shares, forecast, wanted, options)
        ),
        expected=expected,
        shares=shares,
        cells=tuple(
            Cell(middle, forecast.figures(wanted & (cell == k)))
            for k, middle in enumerate(cells[0])
        ),
        cell_size=cells[1],
        directions=tuple(
            Direction(float(azimuth), bool(expects), forecast.figures(sector == k))
            for k, (azimuth, expects) in enumerate(
                zip(middles, _is_expected(middles, options), strict=True)
            )
        ),
        moves=tuple(moves),
        recommended=moves[0] if worthwhile else None,
        workspace=workspace,
        plane_points=plane_points,
    )


def _is_expected(azimuth_deg: Array, options: AdviceOptions) -> NDArray[np.bool_]:
    """Whether pointing directions are in the expected range; at least one sector always is."""
    low, high = options.poses.azimuth_deg
    half_deg = max((high - low) / 2.0, 180.0 / options.sectors)
    off_deg = np.abs((azimuth_deg - (low + high) / 2.0 + 180.0) % 360.0 - 180.0)
    return np.asarray(off_deg <= half_deg)


def _given_views(rig: Rig, options: AdviceOptions) -> list[PlaneView]:
    return [
        PlaneView.from_reference_points(
            rig.plane.points,
            view.reference_points_px,
            options.reference_sigma_px**2 * np.eye(2),
            view.lens,
        )
        for view in rig.views
    ]


def _recovered(
    rig: Rig,
    given: Sequence[PlaneView],
    sizes_px: Sequence[tuple[int, int]],
    options: AdviceOptions,
) -> list[PlaneCamera]:
    """Return the cameras of all views; raise if a view fits none."""
    cameras = [
        recover_camera(
            plane_view, view.reference_points_px, size, sigma_px=options.reference_sigma_px
        )
        for plane_view, view, size in zip(given, rig.views, sizes_px, strict=True)
    ]
    if (wrong := different_sides(rig, given)) is not None:
        raise InvalidInputError(f"{wrong.what}; {wrong.right}")
    for view, camera in zip(rig.views, cameras, strict=True):
        if camera.misfit > LARGEST_MISFIT:
            raise InvalidInputError(
                f'view "{view.name}": no camera with square pixels shows plane.points where '
                f"reference_points_px are (misfit {math.sqrt(camera.misfit):.1f} standard "
                "deviations): measure plane.points to scale in both directions, or give the "
                "view's lens if its image is cropped"
            )
    return cameras


def _view_advice(
    name: str,
    k: int,
    camera: PlaneCamera,
    workspace: Workspace,
    forecast: Forecast,
    wanted: NDArray[np.bool_],
    unit_mm: float,
) -> ViewAdvice:
    lengths = forecast.length_px[wanted, k]
    held = forecast.inside[wanted, k]
    return ViewAdvice(
        name=name,
        camera=camera,
        bearings=Bearings.of(camera, workspace),
        px_per_mm=camera.px_per_unit(np.append(workspace.middle, 0.0)) / unit_mm,
        finger_px=float(np.median(lengths[held])) if held.any() else math.nan,
        in_view=float(held.mean()),
    )


def _shares(
    poses: Poses,
    cameras: Sequence[PlaneCamera],
    plane_points: Array,
    options: AdviceOptions,
    unit_mm: float,
) -> dict[str, float]:
    """Share of each part in the mean squared error: the reduction without it."""

    def squared(options: AdviceOptions) -> Array:
        covariance = predict(poses, cameras, plane_points, options, unit_mm).covariance
        return np.asarray(np.trace(covariance, axis1=1, axis2=2))

    whole = squared(options)
    is_finite = np.isfinite(whole)
    if not is_finite.any():
        return {}
    parts = {
        part: float((whole - squared(without(options, part)))[is_finite].clip(min=0.0).sum())
        for part in ("references", "noise", "bias")
    }
    total = sum(parts.values())
    return {part: value / total for part, value in parts.items()}


def _flags(
    views: Sequence[ViewAdvice],
    ideal: Sequence[PlaneView],
    workspace: Workspace,
    expected: Figures,
    shares: dict[str, float],
    forecast: Forecast,
    wanted: NDArray[np.bool_],
    options: AdviceOptions,
) -> list[Flag]:
    """Return all remarks."""
    flags = []
    for view in views:
        flags += _camera_flags(view)
    flags += _vergence_flags(views, workspace)
    for name, plane_view in zip((view.name for view in views), ideal, strict=True):
        weakness = reference_weakness(plane_view, options.reference_sigma_px, workspace.outline)
        if weakness > WEAK_REFERENCES:
            flags.append(
                Flag(
                    Concern.REFERENCES,
                    name,
                    f"its reference points hold the workspace weakly: errors of theirs grow "
                    f"{weakness:.1f} times inside it; spread them, no three near one line, or use "
                    "more",
                )
            )
    for k, view in enumerate(views):
        flags += _pose_flags(view, forecast.ray_rad[wanted, k], options)
    for doubt, concern, what in (
        (
            Doubt.COPLANAR,
            Concern.COPLANAR,
            "the finger lies in one plane with the cameras and its constraint lines run parallel",
        ),
        (Doubt.BEHIND, Concern.BEHIND, "the finger points where a camera does not see the plane"),
    ):
        share = expected.doubts.get(doubt.value, 0.0)
        if share > NOTABLE_SHARE:
            flags.append(Flag(concern, "", f"in {share:.0%} of the poses in view {what}"))
    if shares.get("references", 0.0) > 0.5:
        flags.append(
            Flag(
                Concern.REFERENCE_ERROR,
                "",
                f"{shares['references']:.0%} of the squared error comes from reference points "
                f"known to {options.reference_sigma_px:g} px: locate them better, or use more "
                "than four",
            )
        )
    return flags


def _camera_flags(view: ViewAdvice) -> list[Flag]:
    flags = []
    camera = view.camera
    if camera.misfit > DOUBTFUL_MISFIT:
        flags.append(
            Flag(
                Concern.SCALE,
                view.name,
                "its reference points fit no camera with square pixels well "
                f"({math.sqrt(camera.misfit):.1f} standard deviations): check plane.points and "
                "their order, or give its lens",
            )
        )
    if camera.focal_sigma > USABLE_FOCAL_SIGMA:
        flags.append(
            Flag(
                Concern.FOCAL_LENGTH,
                view.name,
                f"it looks too straight onto the plane to determine its focal length; "
                f"{camera.focal_px[0]:.0f} px ± {camera.focal_sigma:.0%} is assumed: give its "
                "lens for a prediction that can be trusted",
            )
        )
    return flags


def _vergence_flags(views: Sequence[ViewAdvice], workspace: Workspace) -> list[Flag]:
    middle = np.append(workspace.middle, 0.0)
    rays = np.array([view.camera.centre - middle for view in views])
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    widest = math.degrees(math.acos(float(np.clip(rays @ rays.T, -1.0, 1.0).min())))
    if widest >= SMALL_VERGENCE_DEG:
        return []
    return [
        Flag(
            Concern.VERGENCE,
            "",
            f"the cameras look from nearly the same direction, {widest:.0f}° apart at the middle "
            "of the workspace; 30° to 60° is right",
        )
    ]


def _pose_flags(view: ViewAdvice, ray_rad: Array, options: AdviceOptions) -> list[Flag]:
    flags = []
    out = 1.0 - view.in_view
    if out > NOTABLE_SHARE:
        flags.append(
            Flag(
                Concern.OUT_OF_VIEW,
                view.name,
                f"its image does not hold the hand in {out:.0%} of the expected poses: zoom out, "
                "step back or aim higher, unless hands stay lower",
            )
        )
    end_on = float(np.mean(ray_rad < math.radians(options.poses.view_ray_deg)))
    if end_on > NOTABLE_SHARE:
        flags.append(
            Flag(
                Concern.END_ON,
                view.name,
                f"it sees the finger end-on in {end_on:.0%} of the expected poses: "
                "a hand that points at a camera has no direction there",
            )
        )
    if view.finger_px < SHORT_FINGER_PX:
        flags.append(
            Flag(
                Concern.SHORT_FINGER,
                view.name,
                f"the finger takes {view.finger_px:.0f} px in its image; {SHORT_FINGER_PX:.0f} or "
                "more is right: zoom in, come closer or choose a higher resolution",
            )
        )
    return flags


def reference_weakness(plane_view: PlaneView, sigma_px: float, points: Array) -> float:
    """Return the growth of the reference points' errors at the worst of some points of the plane.

    Parameters
    ----------
    plane_view
        A view in ideal pixels whose reference points have the standard deviation `sigma_px`.
    points : (N, 2)
        Points that span the relevant part of the plane; tested are their centroid and the midpoints
        between it and each of them.

    Returns
    -------
    float
        Standard deviation of the point's image in its weakest direction, over `sigma_px`.
    """
    centroid = points.mean(axis=0)
    looked_at = np.concatenate([centroid[None], (points + centroid) / 2])
    jacobian = transfer_jacobian_by_entries(plane_view.image_from_plane, looked_at)
    covariance = jacobian @ plane_view.entries_covariance @ np.swapaxes(jacobian, 1, 2)
    return math.sqrt(float(np.linalg.eigvalsh(covariance).max())) / sigma_px


def _why(move: Move, unit: str) -> str:
    """Describe the effect of a move."""
    before, after = move.before, move.after
    reasons = []
    angles = [math.degrees(figures.crossing_rad) for figures in (before, after)]
    if abs(angles[1] - angles[0]) >= 2.0:
        reasons.append(f"constraint lines meet at {angles[0]:.0f}°, then {angles[1]:.0f}°")
    lost = before.hopeless - after.hopeless
    if abs(lost) >= 0.01:
        reasons.append(
            f"{before.hopeless:.0%} of the poses in view have no point, then {after.hopeless:.0%}"
        )
    out = 1.0 - after.in_view
    if out >= 0.01:
        reasons.append(f"{out:.0%} of them leave the image")
    bounds = [
        "unknown" if math.isnan(error) else f"{number(error)} {unit}"
        for error in (before.percentile_95, after.percentile_95)
    ]
    return "; ".join([*reasons, f"95 % of the errors are below {bounds[0]}, then {bounds[1]}"])
