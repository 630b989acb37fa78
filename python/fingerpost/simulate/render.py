"""Pictures of pointing devices over the table.

For each view, device and table are composed on the fine grid of `optics`: every link is an exact
polygon there, nearer parts cover farther ones, and the result is blurred and averaged over pixels
once. Only the device's surroundings are rendered; the rest of the picture is the table, whose
blurred picture is cached.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from fingerpost.checks import finite_array
from fingerpost.simulate import checks
from fingerpost.simulate.camera import Camera
from fingerpost.simulate.coverage import Patch, polygon_coverage
from fingerpost.simulate.device import Body, Material
from fingerpost.simulate.optics import Optics, Picture
from fingerpost.simulate.outline import ARC_STEPS, link_outlines, pictured_outlines, seen_links
from fingerpost.simulate.scene import Background, Lighting, Sensor
from fingerpost.simulate.table import Table

Array = NDArray[np.float64]

# Greatest distance of sub-exposures, in sigmas of the blur, so that their sum shows no steps.
EXPOSURE_STEP_SIGMAS = 0.7
MOST_EXPOSURES = 64
# Rows per band in which the device is rendered: an arm fills only a small part of its bounding box.
BAND_PX = 96
# The lamp that casts the shadow, in the world, and its size: the penumbra of a point at height h is
# about h·size/height wide, here four sigmas. Parts above `LAMP_HIGHEST_MM` cast no shadow.
LAMP_MM = (-900.0, 500.0, 1800.0)
LAMP_SIZE_MM = 250.0
LAMP_HIGHEST_MM = 1500.0
PENUMBRA_SIGMAS = 4
# Side of the cells on which shadows are computed, as they are soft.
SHADE_CELL_PX = 4
# A flank is lit if it faces this direction in the image: the lamp stands on the left.
LIT_SIDE = (-1.0, 0.0)


@dataclass(frozen=True, eq=False)
class Placed:
    """A body put into the world: (2, L, 4) spheres in mm, and the body's materials."""

    spheres_mm: Array
    materials: tuple[Material, ...]

    @classmethod
    def of(cls, body: Body, world_from_device: Array) -> "Placed":
        """Place a body by a pose's (3, 4) matrix."""
        materials = tuple(link.material for link in body.links)
        return cls(body.placed(world_from_device), materials)


@dataclass(frozen=True, eq=False)
class Occluder:
    """A disc in the picture, in front of everything."""

    centre_px: tuple[float, float]  # px, in the pictured image
    radius_px: float  # px, 0.01…10,000
    level: float  # grey level, 0…255

    def __post_init__(self) -> None:
        finite_array(self.centre_px, "centre_px", (2,))
        checks.number("radius_px", self.radius_px, 0.01, 10_000)
        checks.number("level", self.level, 0, 255)


@dataclass(frozen=True, eq=False)
class _Piece:
    """One link or occluder in one view, for the compositor."""

    polygon_px: Array  # (V, 2) pictured outline
    level: float
    tint: tuple[float, ...]  # one for each channel
    spine: "_Spine | None"  # None: flat, and nearest of all


@dataclass(frozen=True, eq=False)
class _Spine:
    """The axis of a link in one view, for shading and occlusion; values at both ends."""

    middle_px: Array  # (2, 2) pictured
    radius_px: Array  # (2,)
    distance_mm: Array  # (2,) from the eye
    radius_mm: Array  # (2,)


@dataclass(frozen=True)
class _Window:
    """Pixel rows top…bottom − 1 and columns left…right − 1."""

    top: int
    bottom: int
    left: int
    right: int

    @property
    def place(self) -> tuple[slice, slice]:
        """Index of the window in the picture."""
        return slice(self.top, self.bottom), slice(self.left, self.right)


class ViewRenderer:
    """Renders one view; caches the picture of its table."""

    def __init__(
        self,
        camera: Camera,
        table: Table,
        background: Background,
        lighting: Lighting,
        sensor: Sensor,
    ) -> None:
        self.camera = camera
        self._background = background
        self._lighting = lighting
        self._optics = Optics(sensor.blur_px, sensor.cells_per_sigma)
        self._channels = 3 if sensor.channels == "bgr" else 1
        self._shaded = lighting.side_light > 0 or lighting.limb_darkening > 0
        self._exposure_step_px = EXPOSURE_STEP_SIGMAS * math.hypot(sensor.blur_px, 12**-0.5)
        self._fine_table = table.paint(camera, self._optics, self._channels)
        if background.is_uniform:
            corner = self._fine_table[:, 0, 0]
            size = (self._channels, camera.height_px, camera.width_px)
            self._table = np.broadcast_to(corner[:, None, None], size)
        else:
            self._table = np.stack([self._optics.pixels(plane) for plane in self._fine_table])

    def exposures(self, opening: Sequence[Placed], closing: Sequence[Placed]) -> int:
        """Return the number of sub-exposures that blur a motion without visible steps."""
        farthest = 0.0
        for before, after in zip(opening, closing, strict=True):
            centres = [
                self.camera.project(placed.spheres_mm[..., :3]) for placed in (before, after)
            ]
            moved = np.linalg.norm(centres[1] - centres[0], axis=-1)
            seen = self.camera.contains(centres[0], -50) | self.camera.contains(centres[1], -50)
            farthest = max(farthest, float(np.max(moved, where=seen, initial=0)))
        return min(max(math.ceil(farthest / self._exposure_step_px), 1), MOST_EXPOSURES)

    def light(
        self, exposures: Sequence[Sequence[Placed]], occluders: Sequence[Occluder], gain: float
    ) -> Picture:
        """Noise-free picture, the mean over sub-exposures.

        Returns
        -------
        numpy.ndarray
            (H, W) or (H, W, 3) float32 grey levels, neither rounded nor clipped.
        """
        moments = [
            [self._disc(occluder) for occluder in occluders] + self._pieces(placed)
            for placed in exposures
        ]
        planes: Picture = np.array(self._table)
        shade = self._shade(exposures[len(exposures) // 2]) if self._lighting.shadow else None
        if shade is not None:
            planes *= shade
        outlines = [_stacked([piece.polygon_px for piece in pieces]) for pieces in moments]
        for window in self._windows(outlines):
            self._render_window(planes, window, moments, outlines, shade)
        if gain != 1:
            planes *= np.float32(gain)
        return planes[0] if self._channels == 1 else np.ascontiguousarray(planes.transpose(1, 2, 0))

    def _render_window(
        self,
        planes: Picture,
        window: _Window,
        moments: Sequence[Sequence[_Piece]],
        outlines: Sequence[Array],
        shade: Picture | None,
    ) -> None:
        """Render the pixels of a window into the picture."""
        step, margin = self._optics.fineness, self._optics.margin_px
        rows = slice(window.top * step, (window.bottom + 2 * margin) * step)
        columns = slice(window.left * step, (window.right + 2 * margin) * step)
        ground = self._fine_table[:, rows, columns]
        if shade is not None:
            ground = ground * self._fine_shade(shade, window)
        corner = np.array([columns.start, rows.start])
        fine = np.zeros(ground.shape, np.float32)
        for pieces, polygons in zip(moments, outlines, strict=True):
            fine += self._composed(ground, pieces, self._optics.cells(polygons) - corner, corner)
        if len(moments) > 1:
            fine /= len(moments)
        for plane, fine_plane in zip(planes, fine, strict=True):
            plane[window.place] = self._optics.pixels(fine_plane)

    def _composed(
        self,
        ground: Picture,
        pieces: Sequence[_Piece],
        outlines: Array,
        corner: NDArray[np.int64],
    ) -> Picture:
        """Light (C, rows, columns) of pieces over the ground at one moment."""
        patches = polygon_coverage(outlines, *ground.shape[1:])
        shown = [
            (piece, patch)
            for piece, patch in zip(pieces, patches, strict=True)
            if patch is not None
        ]
        # Outlines that share a cell mostly coincide there or are nested, as at the joints of a
        # chain, so their union is the larger one. Where outlines cross, this is too small by a
        # fraction of that one cell.
        cover = np.zeros(ground.shape[1:], np.float32)
        for _, patch in shown:
            np.maximum(cover[patch.place], patch.coverage, out=cover[patch.place])
        light = self._light_of_nearest(shown, cover, corner) - ground
        light *= cover
        light += ground
        return light

    def _light_of_nearest(
        self, shown: Sequence[tuple[_Piece, Patch]], cover: Picture, corner: NDArray[np.int64]
    ) -> Picture:
        """Light (C, rows, columns) of the nearest piece in each cell; C × 1 × 1 if all equal."""
        shades = {(piece.level, piece.tint) for piece, _ in shown}
        if len(shades) == 1 and not self._shaded:
            only_level, only_tint = shades.pop()
            return np.array(only_tint, np.float32)[:, None, None] * np.float32(only_level)
        light = np.zeros((self._channels, *cover.shape), np.float32)
        nearest = np.full(cover.shape, np.inf, np.float32)
        for piece, patch in shown:
            level, distance = self._surface(piece, patch, corner)
            # A cell belongs to the nearest piece that has a substantial share of its covered area.
            wins = (patch.coverage > 0) & (patch.coverage >= 0.5 * cover[patch.place])
            wins &= distance < nearest[patch.place]
            np.copyto(nearest[patch.place], distance, where=wins)
            for plane, tint in zip(light, piece.tint, strict=True):
                np.copyto(plane[patch.place], level * np.float32(tint), where=wins)
        return light

    def _surface(
        self, piece: _Piece, patch: Patch, corner: NDArray[np.int64]
    ) -> tuple[Picture | np.float32, Picture | np.float32]:
        """Grey level and distance [mm] of a piece in its cells.

        Side light and limb darkening act on the piece's contrast. `across` and `beyond` are the
        place in the cross-section, in radii: sideways, and over the rounded end.
        """
        spine = piece.spine
        if spine is None:
            return np.float32(piece.level), np.float32(-1)
        ends = (self._optics.cells(spine.middle_px) - corner).astype(np.float32)
        run = ends[1] - ends[0]
        length = max(float(np.hypot(*run)), 1e-6)
        ex, ey = run / np.float32(length)
        x = np.arange(patch.columns.start, patch.columns.stop, dtype=np.float32) + 0.5 - ends[0, 0]
        y = np.arange(patch.rows.start, patch.rows.stop, dtype=np.float32) + 0.5 - ends[0, 1]
        along = x * ex + y[:, None] * ey
        part = (along / np.float32(length)).clip(0, 1)
        radius = _between(spine.radius_px * self._optics.fineness, part)
        across = (y[:, None] * ex - x * ey) / radius
        beyond = (along - part * np.float32(length)) / radius
        towards_eye = np.sqrt((1 - across**2 - beyond**2).clip(0))
        distance = _between(spine.distance_mm, part) - _between(spine.radius_mm, part) * towards_eye

        shade: Picture | np.float32 = np.float32(1)
        if self._lighting.side_light:
            lit = math.copysign(0.5, ex * LIT_SIDE[1] - ey * LIT_SIDE[0])
            shade = shade + np.float32(lit * self._lighting.side_light) * across.clip(-1, 1)
        if self._lighting.limb_darkening:
            shade = shade * (1 - np.float32(self._lighting.limb_darkening) * (1 - towards_eye))
        ground = np.float32(self._background.level)
        level = ground + (np.float32(piece.level) - ground) * shade
        return np.clip(level, 0, 255), distance

    def _pieces(self, bodies: Sequence[Placed]) -> list[_Piece]:
        """Every link that is in front of the camera."""
        pieces = []
        for placed in bodies:
            seen, kept = seen_links(self.camera, placed.spheres_mm)
            if not kept.any():
                continue
            polygons = pictured_outlines(self.camera, link_outlines(seen))
            middles = self.camera.pictured_everywhere(self.camera.project_seen(seen[..., :3]))
            radii = seen[..., 3] / seen[..., 2] * self.camera.f_px
            distances = np.linalg.norm(seen[..., :3], axis=-1)
            for i, link in enumerate(np.flatnonzero(kept)):
                material = placed.materials[link]
                level = self._background.level + self._lighting.contrast * material.contrast_ratio
                pieces.append(
                    _Piece(
                        polygon_px=polygons[i],
                        level=min(max(level, 0.0), 255.0),
                        tint=material.tint if self._channels == 3 else (1.0,),
                        spine=_Spine(middles[:, i], radii[:, i], distances[:, i], seen[:, i, 3]),
                    )
                )
        return pieces

    def _disc(self, occluder: Occluder) -> _Piece:
        angle = np.linspace(0, 2 * np.pi, 2 * ARC_STEPS, endpoint=False)
        circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1) * occluder.radius_px
        tint = (1.0,) * self._channels
        return _Piece(circle + occluder.centre_px, occluder.level, tint, None)

    def _windows(self, outlines: Sequence[Array]) -> list[_Window]:
        """Pixels that polygons (L, V, 2) can change: bands of rows, each with its own columns."""
        start = np.concatenate([some.reshape(-1, 2) for some in outlines])
        if len(start) == 0:
            return []
        end = np.concatenate([np.roll(some, -1, axis=1).reshape(-1, 2) for some in outlines])
        reach = self._optics.margin_px + 1
        height, width = self.camera.height_px, self.camera.width_px
        top = min(max(math.floor(start[:, 1].min() - reach), 0), height)
        bottom = min(max(math.ceil(start[:, 1].max() + reach), 0), height)
        bands = math.ceil((bottom - top) / BAND_PX)
        cuts = np.linspace(top, bottom, bands + 1).astype(int).tolist()
        windows = []
        for first, last in pairwise(cuts):
            x = _columns_of_rows(start, end, first - reach, last + reach)
            left = min(max(math.floor(x.min(initial=width) - reach), 0), width)
            right = min(max(math.ceil(x.max(initial=0) + reach), 0), width)
            if left < right:
                windows.append(_Window(first, last, left, right))
        return windows

    def _shade(self, bodies: Sequence[Placed]) -> Picture:
        """Light that the bodies leave on the table, 0…1, per pixel (H, W)."""
        height, width = self.camera.height_px, self.camera.width_px
        dark = np.zeros((-(-height // SHADE_CELL_PX), -(-width // SHADE_CELL_PX)), np.float32)
        for placed in bodies:
            tip = placed.spheres_mm[1, 0, :3]
            if placed.spheres_mm[..., 2].max() > LAMP_HIGHEST_MM:
                continue  # it extends above the lamp's limit
            # One softness for the whole shadow, that at the fingertip, which is the most important.
            spread_mm = LAMP_SIZE_MM * max(tip[2], 0.0) / LAMP_MM[2] / PENUMBRA_SIGMAS
            distance_mm = float(np.linalg.norm(self.camera.centre_mm - tip))
            sigma = max(spread_mm * self.camera.f_px / distance_mm / SHADE_CELL_PX, 0.7)
            soft = cv2.GaussianBlur(self._shadow_of(placed, dark.shape), (0, 0), sigma)
            np.maximum(dark, soft, out=dark)
        size = (dark.shape[1] * SHADE_CELL_PX, dark.shape[0] * SHADE_CELL_PX)
        wide = cv2.resize(dark, size, interpolation=cv2.INTER_LINEAR)[:height, :width]
        return np.asarray(1 - np.float32(self._lighting.shadow) * wide)

    def _shadow_of(self, placed: Placed, shape: tuple[int, ...]) -> Picture:
        """Sharp shadow of one body, 0…1, per shade cell."""
        lamp = np.array(LAMP_MM)
        # A right-handed frame at the lamp that looks straight down.
        lamp_from_world = np.diag([1.0, -1.0, -1.0])
        spheres = placed.spheres_mm.copy()
        spheres[..., :3] = (spheres[..., :3] - lamp) @ lamp_from_world
        rays = link_outlines(spheres).points @ lamp_from_world
        on_plane = lamp - rays * (lamp[2] / rays[..., 2:])
        pictured = self.camera.pictured_everywhere(self.camera.project(on_plane))
        cover = np.zeros(shape, np.float32)
        seen = np.isfinite(pictured).all(axis=(1, 2))
        for patch in polygon_coverage((pictured[seen] + 0.5) / SHADE_CELL_PX, *shape):
            if patch is not None:
                np.maximum(cover[patch.place], patch.coverage, out=cover[patch.place])
        return cover

    def _fine_shade(self, shade: Picture, window: _Window) -> Picture:
        """Shade of a window and its margin on the fine grid; the shade itself is smooth."""
        margin, step = self._optics.margin_px, self._optics.fineness
        wide = cv2.copyMakeBorder(shade, margin, margin, margin, margin, cv2.BORDER_REPLICATE)
        rows = slice(window.top, window.bottom + 2 * margin)
        part = wide[rows, window.left : window.right + 2 * margin]
        size = (part.shape[1] * step, part.shape[0] * step)
        return np.asarray(cv2.resize(part, size, interpolation=cv2.INTER_LINEAR))


def _between(ends: Array, part: Picture) -> Picture:
    """Values that run linearly from one end to the other."""
    return np.asarray(np.float32(ends[0]) + np.float32(ends[1] - ends[0]) * part)


def _columns_of_rows(start: Array, end: Array, top: float, bottom: float) -> Array:
    """Columns where edges (E, 2) enter or leave the rows top…bottom, or begin or end in them."""
    x0, y0 = start.T
    x1, y1 = end.T
    rise = np.where(y1 == y0, 1.0, y1 - y0)
    enter, leave = ((row - y0) / rise for row in (top, bottom))
    enter, leave = np.where(y1 == y0, 0.0, enter), np.where(y1 == y0, 1.0, leave)
    crosses = (np.maximum(y0, y1) >= top) & (np.minimum(y0, y1) <= bottom)
    parts = np.stack([enter, leave])[:, crosses].clip(0, 1)
    return np.asarray(x0[crosses] + parts * (x1 - x0)[crosses])


def _stacked(polygons: Sequence[Array]) -> Array:
    """Polygons as one array (L, V, 2), the shorter ones with their last vertex repeated."""
    vertices = np.arange(max((len(polygon) for polygon in polygons), default=0))
    rows = [polygon[np.minimum(vertices, len(polygon) - 1)] for polygon in polygons]
    return np.stack(rows) if rows else np.empty((0, 0, 2))
