"""The table in the pictures: uniform or wooden, with a sheet of paper and clutter on it.

All objects are generated once on the working plane, from the background's seed, and then drawn into
each view: shapes as exact polygons, the grain of wood by the plane point of every cell.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from fingerpost.simulate.camera import Camera, Workspace
from fingerpost.simulate.coverage import polygon_coverage
from fingerpost.simulate.optics import Optics, Picture
from fingerpost.simulate.scene import Background, Tint, tint

Array = NDArray[np.float64]

TABLE_TINT = tint(0.97, 1.0, 1.01)
WOOD_TINT = tint(0.48, 0.72, 1.0)
SHEET_TINT = tint(1.0, 0.97, 0.96)
# Deviation of a clutter shape's colour from grey.
CLUTTER_COLOUR = 0.2

# Extent of the generated area, in sides of the workspace from its middle.
FARTHEST_SIDES = 6.0
# Clutter: mean distance between shapes and their number of vertices; sizes are in shape().
CLUTTER_SPACING_SIDES = 0.11
MOST_SHAPES = 2500
VERTICES = 48
# Clearance of clutter from the sheet's edges, because those are reference features.
SHEET_CLEARANCE_SIDES = 0.03
GRAIN_CELLS = 1024
GRAIN_ROWS = 32


@dataclass(frozen=True, eq=False)
class _Shape:
    """A uniform polygon on the plane."""

    vertices_mm: Array  # (VERTICES, 2)
    level: float
    tint: Tint


class Table:
    """Objects on the working plane, the same for every camera."""

    def __init__(
        self, background: Background, workspace: Workspace, cameras: Sequence[Camera]
    ) -> None:
        self._background = background
        self._workspace = workspace
        self._low, self._high = _seen_area(cameras, workspace)
        rng = np.random.default_rng(background.seed)
        self._grain = _wood_grain(rng) if background.texture == "wood" else None
        self._shapes: list[_Shape] = []
        if background.sheet:
            sheet = _densified(workspace.points_mm[:4])
            self._shapes.append(_Shape(sheet, background.level + background.sheet, SHEET_TINT))
        if background.clutter:
            self._shapes += self._strewn(rng)

    def paint(self, camera: Camera, optics: Optics, channels: int) -> Picture:
        """Paint the table on the fine grid of a view, blur margins included.

        Returns
        -------
        numpy.ndarray
            (channels, rows, columns) light per cell; read-only if the background is uniform.
        """
        margin, step = optics.margin_px, optics.fineness
        rows, columns = (n + 2 * margin for n in (camera.height_px, camera.width_px))
        shape = (channels, rows * step, columns * step)
        ground = self._background.level
        colour = WOOD_TINT if self._grain is not None else TABLE_TINT
        tints = np.array(colour if channels == 3 else (1.0,), dtype=np.float32)
        if self._background.is_uniform:
            return np.broadcast_to((tints * np.float32(ground))[:, None, None], shape)
        level = np.full(shape[1:], ground, np.float32)
        if self._grain is not None:
            level += self._grain_seen(camera, optics, shape[1:])
        light = level * tints[:, None, None]
        for shape_batch in _batches(self._shapes, 64):
            self._paint_shapes(light, shape_batch, camera, optics)
        return light.clip(0, 255)

    def _paint_shapes(
        self, light: Picture, shapes: Sequence[_Shape], camera: Camera, optics: Optics
    ) -> None:
        points = np.stack([shape.vertices_mm for shape in shapes])
        ideal = camera.project(np.pad(points, ((0, 0), (0, 0), (0, 1))))
        seen = np.isfinite(ideal).all(axis=(1, 2))
        pictured = camera.pictured_everywhere(ideal[seen])
        cells = optics.cells(pictured)
        patches = polygon_coverage(cells, *light.shape[1:])
        for shape, patch in zip(np.array(shapes, dtype=object)[seen], patches, strict=True):
            if patch is None:
                continue
            tints = shape.tint if len(light) == 3 else (1.0,)
            for plane, share in zip(light, tints, strict=True):
                under = plane[patch.place]
                under += patch.coverage * (np.float32(shape.level * share) - under)

    def _strewn(self, rng: np.random.Generator) -> list[_Shape]:
        """Clutter: convex polygons, ellipses and stripes, one over the other."""
        side, clutter = self._workspace.side_mm, self._background.clutter
        spacing = CLUTTER_SPACING_SIDES * side
        count = min(int(np.prod((self._high - self._low) / spacing)), MOST_SHAPES)
        shapes = []
        for _ in range(count):
            centre = rng.uniform(self._low, self._high)
            outline = _random_outline(rng) * side + centre
            level = self._background.level + rng.uniform(-clutter, clutter)
            colour = tint(*(1 + CLUTTER_COLOUR * rng.uniform(-1, 1, 3)))
            if self._background.sheet and self._touches_sheet_edge(outline):
                continue
            shapes.append(_Shape(outline, level, colour))
        return shapes

    def _touches_sheet_edge(self, outline: Array) -> bool:
        side, clearance = self._workspace.side_mm, SHEET_CLEARANCE_SIDES * self._workspace.side_mm
        low, high = outline.min(axis=0), outline.max(axis=0)
        outside = (high < -clearance).any() or (low > side + clearance).any()
        inside = (low > clearance).all() and (high < side - clearance).all()
        return not (outside or inside)

    def _grain_seen(self, camera: Camera, optics: Optics, shape: tuple[int, int]) -> Picture:
        """Grey levels that the wood's grain adds to each cell of a view."""
        assert self._grain is not None
        plane_from_image = np.linalg.inv(camera.image_from_plane)
        columns, grain = np.arange(shape[1]) + 0.5, np.empty(shape, np.float32)
        # A few rows at a time, which fit into the processor's caches.
        for top in range(0, shape[0], GRAIN_ROWS):
            rows = np.arange(top, min(top + GRAIN_ROWS, shape[0])) + 0.5
            cells = np.stack(np.broadcast_arrays(columns, rows[:, None]), axis=-1)
            ideal = camera.ideal_everywhere(optics.pixels_of_cells(cells))
            X, Y, W = (a * ideal[..., 0] + b * ideal[..., 1] + c for a, b, c in plane_from_image)
            # The third coordinate is positive below the horizon; above it, the table's far end is
            # used.
            ahead, size = np.maximum(W, 1e-9), self._high - self._low
            x_texels, y_texels = (
                (((x / ahead - low) / far).clip(0, 1) * (GRAIN_CELLS - 1)).astype(np.float32)
                for x, low, far in zip((X, Y), self._low, size, strict=True)
            )
            grain[top : top + len(rows)] = cv2.remap(
                self._grain, x_texels, y_texels, cv2.INTER_LINEAR
            )
        return np.asarray(grain * np.float32(self._background.texture_amplitude))


def _seen_area(cameras: Sequence[Camera], workspace: Workspace) -> tuple[Array, Array]:
    """Corners of the rectangle on the plane that all images together show."""
    middle, farthest = workspace.side_mm / 2, FARTHEST_SIDES * workspace.side_mm
    points = [workspace.points_mm]
    for camera in cameras:
        u, v = camera.width_px, camera.height_px
        edge = np.linspace(0, 1, 9)
        border = np.concatenate(
            [np.stack([edge * u, edge * 0 + end * v], -1) for end in (0, 1)]
            + [np.stack([edge * 0 + end * u, edge * v], -1) for end in (0, 1)]
        )
        ideal = np.pad(camera.ideal_everywhere(border), ((0, 0), (0, 1)), constant_values=1)
        rays: Array = (
            ideal @ np.linalg.inv(camera.image_from_camera).T @ camera.camera_from_world[:, :3]
        )
        # Rays that do not meet the plane extend to the end of the generated area.
        down = np.minimum(rays[:, 2], -1e-6)
        points.append((camera.centre_mm - rays * (camera.centre_mm[2] / down)[:, None])[:, :2])
    seen: Array = np.concatenate(points).clip(middle - farthest, middle + farthest)
    return seen.min(axis=0), seen.max(axis=0)


def _random_outline(rng: np.random.Generator) -> Array:
    """Vertices of a random shape around the origin, in sides of the workspace."""
    kind, turn = rng.uniform(), rng.uniform(0, 2 * np.pi)
    rotation = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    if kind < 0.4:
        angles = np.sort(rng.uniform(0, 2 * np.pi, rng.integers(3, 7)))
        corners = np.stack([np.cos(angles), np.sin(angles)], -1) * rng.uniform(0.03, 0.12)
        return _densified(corners)
    if kind < 0.7:
        angles = np.linspace(0, 2 * np.pi, VERTICES, endpoint=False)
        axes = rng.uniform(0.02, 0.10, 2)
        return np.asarray(np.stack([np.cos(angles), np.sin(angles)], -1) * axes @ rotation.T)
    half = np.array([rng.uniform(0.10, 0.5), rng.uniform(0.005, 0.03)])
    return _densified(np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half @ rotation.T)


def _densified(corners: Array) -> Array:
    """Return a polygon of VERTICES vertices with the given corners, for lens distortion."""
    count = len(corners)
    position = np.arange(VERTICES) * count / VERTICES
    # Every corner is a vertex.
    first = np.searchsorted(position, np.arange(count))
    position[first] = np.arange(count)
    side = position.astype(int)
    following = corners[(side + 1) % count]
    return np.asarray(corners[side] + (position - side)[:, None] * (following - corners[side]))


def _wood_grain(rng: np.random.Generator) -> Picture:
    """(GRAIN_CELLS, GRAIN_CELLS) texture of peak 1, its grain along x: year rings and fibres."""
    size = (GRAIN_CELLS, GRAIN_CELLS)

    def smooth(rows: int, columns: int) -> Picture:
        noise = rng.standard_normal((rows, columns)).astype(np.float32)
        return np.asarray(cv2.resize(noise, size, interpolation=cv2.INTER_CUBIC))

    across = np.linspace(0, 1, GRAIN_CELLS, dtype=np.float32)[:, None]
    rings = np.sin(2 * np.pi * (22 * across + 0.9 * smooth(7, 3) + 0.12 * smooth(60, 6)))
    fibres = smooth(420, 12)
    grain = 0.55 * rings + 0.3 * fibres + 0.25 * smooth(24, 5)
    return np.asarray((grain / np.abs(grain).max()).astype(np.float32))


def _batches(shapes: list[_Shape], size: int) -> list[list[_Shape]]:
    return [shapes[i : i + size] for i in range(0, len(shapes), size)]
