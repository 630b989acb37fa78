"""Evaluation of moves of one camera.

Each camera in turn is moved around the workspace, raised or lowered, brought nearer or further
away, and zoomed, with a fixed aim; the poses are predicted again. Moves are compared by the typical
error (`Forecast.typical_error`) of the poses that were in view before: a move gains nothing by
other poses, but loses those that are no longer in view.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from fingerpost.advise.camera import PlaneCamera, rotation_by
from fingerpost.advise.forecast import Figures, predict
from fingerpost.advise.options import AdviceOptions
from fingerpost.advise.poses import Poses, Workspace

Array = NDArray[np.float64]

ELEVATIONS_DEG = (15.0, 75.0)
"""Range of elevations of moved cameras: lower, the plane is seen edge-on; higher, an arm hides the
hand."""

WORTHWHILE_SHARE = 0.9
"""Ratio of the typical errors after and before, below which a move is recommended."""

_TURNS_DEG = (-60.0, -45.0, -30.0, -15.0, 15.0, 30.0, 45.0, 60.0)
_RAISES_DEG = (-20.0, -10.0, 10.0, 20.0)
_DISTANCES = (0.5, 0.7, 1.4)
_ZOOMS = (0.7, 1.4, 2.0)

# Straight above the workspace, elevation is undefined.
_LEAST_LEVEL = 1e-9


class Way(StrEnum):
    """Kind of a camera's move."""

    TURN = "turn"
    """Around the workspace [deg], positive to the right as seen from behind the camera."""
    RAISE = "raise"
    """Up [deg of elevation]."""
    DISTANCE = "distance"
    """Away from the workspace [factor]."""
    ZOOM = "zoom"
    """To a longer focal length [factor]."""


@dataclass(frozen=True, eq=False)
class Move:
    """One move of one camera, and its prediction.

    Attributes
    ----------
    view
        Index of the view.
    way, amount
        Kind and size of the move.
    camera
        The camera after the move.
    typical_error
        Typical error of all poses that were in view before [plane units].
    before, after
        Figures of the poses that were in view before.
    """

    view: int
    way: Way
    amount: float
    camera: PlaneCamera
    typical_error: float
    before: Figures
    after: Figures

    def words(self, name: str) -> str:
        """Return an instruction for the move."""
        amount, view = abs(self.amount), f'view "{name}"'
        match self.way:
            case Way.TURN:
                side = "right" if self.amount > 0.0 else "left"
                return f"move {view} {amount:.0f}° around the workspace to its {side}"
            case Way.RAISE:
                return f"{'raise' if self.amount > 0.0 else 'lower'} {view} by {amount:.0f}°"
            case Way.DISTANCE:
                way = "away to" if self.amount > 1.0 else "nearer, to"
                return f"move {view} {way} {amount:g} times its distance"
            case Way.ZOOM:
                way = "in" if self.amount > 1.0 else "out"
                return f"zoom {view} {way} by {amount:g}"


@dataclass(frozen=True, eq=False)
class Bearings:
    """Direction and distance of a camera from the middle of the workspace.

    Attributes
    ----------
    azimuth_deg
        −180 to 180, from "towards the cameras", positive anticlockwise seen from above.
    elevation_deg
        Elevation above the plane, 0 to 90.
    distance
        Distance [plane units].
    """

    azimuth_deg: float
    elevation_deg: float
    distance: float

    @classmethod
    def of(cls, camera: PlaneCamera, workspace: Workspace) -> Bearings:
        """Bearings of a camera."""
        x, y, up = (camera.centre - np.append(workspace.middle, 0.0)).tolist()
        level = math.hypot(x, y)
        turn = workspace.anticlockwise * (math.atan2(y, x) - workspace.towards_rad)
        azimuth = math.degrees(math.remainder(turn, math.tau)) if level > 0.0 else 0.0
        return cls(azimuth, math.degrees(math.atan2(up, level)), math.hypot(level, up))


def try_moves(
    poses: Poses,
    cameras: Sequence[PlaneCamera],
    workspace: Workspace,
    plane_points: Array,
    options: AdviceOptions,
    unit_mm: float,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[float, list[Move]]:
    """Try every move of every camera.

    Parameters
    ----------
    poses
        The expected poses.
    plane_points : (N, 2)
        The reference points; moves after which a camera sees fewer of them are excluded.
    progress
        Called with the number of moves done and of all.

    Returns
    -------
    float
        Typical error of the present cameras [plane units].
    list of Move
        Moves, the best first.
    """
    now = predict(poses, cameras, plane_points, options, unit_mm)
    limit = options.pointing.max_sigma * float(np.ptp(plane_points, axis=0).max())
    seen = now.in_view
    before = now.figures(seen)
    candidates = [
        (k, way, amount, moved)
        for k, camera in enumerate(cameras)
        for way, amount, moved in _moves(camera, workspace)
        if _shows_as_much(moved, camera, plane_points)
    ]
    moves = []
    for done, (k, way, amount, moved) in enumerate(candidates, start=1):
        standing = [moved if i == k else camera for i, camera in enumerate(cameras)]
        after = predict(poses, standing, plane_points, options, unit_mm)
        error = after.typical_error(seen, limit)
        moves.append(Move(k, way, amount, moved, error, before, after.figures(seen)))
        if progress is not None:
            progress(done, len(candidates))
    return now.typical_error(seen, limit), sorted(moves, key=lambda move: move.typical_error)


def _moves(camera: PlaneCamera, workspace: Workspace) -> Iterator[tuple[Way, float, PlaneCamera]]:
    """Yield all moves of one camera."""
    middle = np.append(workspace.middle, 0.0)
    elevation = Bearings.of(camera, workspace).elevation_deg
    up = np.array([0.0, 0.0, 1.0])
    # As seen from behind the camera, a move to the right is anticlockwise.
    for turn in _TURNS_DEG:
        angle = workspace.anticlockwise * math.radians(turn)
        yield Way.TURN, turn, camera.moved(_rotation(up, angle), middle)
    away = camera.centre - middle
    level = np.array([-away[1], away[0], 0.0])
    if np.linalg.norm(level) > _LEAST_LEVEL * np.linalg.norm(away):
        for rise in _RAISES_DEG:
            if ELEVATIONS_DEG[0] <= elevation + rise <= ELEVATIONS_DEG[1]:
                angle = -math.radians(rise)
                yield Way.RAISE, rise, camera.moved(_rotation(level, angle), middle)
    for factor in _DISTANCES:
        yield Way.DISTANCE, factor, camera.moved(factor * np.eye(3), middle)
    for factor in _ZOOMS:
        yield Way.ZOOM, factor, camera.zoomed(factor)


def _shows_as_much(moved: PlaneCamera, camera: PlaneCamera, plane_points: Array) -> bool:
    """Whether all reference points stay in front, and those inside the image stay inside."""
    points = np.pad(plane_points, ((0, 0), (0, 1)))
    before, after = camera.project(points), moved.project(points)
    kept = moved.shows(after) | ~camera.shows(before)
    return bool(np.isfinite(after).all() and kept.all())


def _rotation(axis: Array, angle_rad: float) -> Array:
    """Rotation about an axis of any length."""
    return rotation_by(angle_rad * axis / np.linalg.norm(axis))
