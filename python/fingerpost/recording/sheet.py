"""Anti-aliased lines, areas, marks and text on an image, for any coordinates.

OpenCV draws at integer multiples of a fraction of a pixel, and fails on points at infinity. A
`Sheet` accepts any coordinates, including NaN, clips shapes to the image, and leaves out invisible
parts.
"""

from __future__ import annotations

import math
from functools import cache, lru_cache
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fingerpost.checks import in_range
from fingerpost.errors import InvalidInputError
from fingerpost.recording.interrupts import uninterrupted

Image = NDArray[np.uint8]
Points = NDArray[np.float64]
Colour = tuple[int, int, int]
"""Blue, green, red."""

CASING: Colour = (0x1C, 0x16, 0x11)
"""Dark edge of marks that must stand out from any ground."""

LARGEST_PX = 2**15 - 1
"""Longest side of a sheet: the limit of OpenCV."""

# Coordinates are passed to OpenCV as integers of 1/16 px. Beyond this limit nothing is visible, and
# the integers would overflow.
_SHIFT = 4
_FARTHEST_PX = 1e6

# Distance outside the border at which lines and areas are clipped: over half of any line's width.
_BORDER_PX = 8.0


class Sheet:
    """Pixels to draw on, and the transform to them from coordinates of a scene.

    `line` and `area` take coordinates of the scene; `dot`, `cross` and `text`, whose size does not
    scale with it, take pixels, which `place` computes.

    Parameters
    ----------
    pixels : (height, width, 3)
        Blue-green-red; modified in place.
    pixels_from_scene : (2, 3)
        Scaling, possibly with reflection, and shift.
    """

    def __init__(self, pixels: Image, pixels_from_scene: Points) -> None:
        self.pixels = pixels
        self._pixels_from_scene = pixels_from_scene

    @classmethod
    def blank(cls, size_px: tuple[int, int], colour: Colour) -> Self:
        """Return a sheet of one colour, whose scene is in pixels.

        Raises
        ------
        InvalidInputError
            A side below 1 px or above `LARGEST_PX`.
        """
        width, height = (int(in_range(side, "size_px", 1, LARGEST_PX)) for side in size_px)
        row = np.full((width, 3), colour, np.uint8)
        return cls(np.broadcast_to(row, (height, width, 3)).copy(), np.eye(2, 3))

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height."""
        return self.pixels.shape[1], self.pixels.shape[0]

    def on_pixels(self) -> Sheet:
        """Return the same sheet with a scene in pixels."""
        return Sheet(self.pixels, np.eye(2, 3))

    def with_image(self, image: Image, origin: ArrayLike = (0.0, 0.0)) -> Sheet:
        """Draw an image on the sheet, as large as fits; return a sheet whose scene is its pixels.

        For a part of an image, `origin` (2,) is the pixel of the full image at which it begins.

        Raises
        ------
        InvalidInputError
            Not (height, width) or (height, width, 3) of uint8.
        """
        import cv2

        if image.dtype != np.uint8 or image.ndim not in (2, 3) or image.shape[2:] not in ((), (3,)):
            raise InvalidInputError(
                f"image of shape {image.shape} and type {image.dtype}: "
                "(height, width) or (height, width, 3) of uint8 is needed"
            )
        given, size = np.array([image.shape[1], image.shape[0]]), np.array(self.size_px)
        shown = np.maximum((given * (size / given).min()).round().astype(int), 1)
        scale = shown / given
        # A strong reduction must average over all pixels, so that none is skipped.
        way = cv2.INTER_AREA if scale.max() < 0.5 else cv2.INTER_LINEAR
        if image.ndim == 2:
            image = np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), np.uint8)
        x, y = (size - shown) // 2
        self.pixels[y : y + shown[1], x : x + shown[0]] = cv2.resize(
            image, shown.tolist(), interpolation=way
        )
        offset = np.array([x, y]) + (scale - 1.0) / 2.0  # pixel (0, 0) is a pixel's centre
        offset -= scale * np.asarray(origin, np.float64)
        return Sheet(self.pixels, np.column_stack([np.diag(scale), offset]))

    def place(self, points: Points) -> Points:
        """Return the pixels of points (..., 2) of the scene; NaN where they are invisible."""
        with np.errstate(invalid="ignore", over="ignore"):  # points at infinity
            pixels = affine(self._pixels_from_scene, points)
        near = (np.abs(pixels) < _FARTHEST_PX).all(axis=-1, keepdims=True)  # false for NaN
        return np.where(near, pixels, np.nan)

    def corners(self) -> Points:
        """(2, 2) least and largest coordinates of the scene on the sheet."""
        scene_from_pixels = np.linalg.inv(self._pixels_from_scene[:, :2])
        ends = np.array([[0.0, 0.0], self.size_px]) - 0.5 - self._pixels_from_scene[:, 2]
        return np.sort(ends @ scene_from_pixels.T, axis=0)

    def line(
        self,
        points: Points,
        colour: Colour,
        width: int,
        *,
        dash: tuple[float, float] | None = None,
        cased: bool = False,
    ) -> None:
        """Draw a line through points of the scene, interrupted by NaN.

        Parameters
        ----------
        points : (N, 2)
        colour, width
            Colour, and width [px].
        dash
            Lengths of dash and gap [px], > 0; None for a solid line.
        cased
            Whether to add a dark edge, to stand out from any ground.
        """
        import cv2

        pieces = _pieces(self.place(points), np.array(self.size_px))
        if dash is not None:
            pieces = [part for piece in pieces for part in _dashed(piece, *dash)]
        fixed = [_fixed(piece) for piece in pieces]
        if cased:
            cv2.polylines(
                self.pixels, fixed, False, CASING, width + min(width, 2), cv2.LINE_AA, _SHIFT
            )
        cv2.polylines(self.pixels, fixed, False, colour, width, cv2.LINE_AA, _SHIFT)

    def area(self, points: Points, colour: Colour, opacity: float = 1.0) -> None:
        """Fill a polygon (N, 2) of the scene; nothing if any corner is not finite.

        `opacity` is from 0 to 1 (opaque).
        """
        import cv2

        polygon = _clipped(self.place(points), np.array(self.size_px))
        if not len(polygon):
            return
        x, y = np.maximum(np.floor(polygon.min(axis=0)).astype(int) - 1, 0)
        right, bottom = np.ceil(polygon.max(axis=0)).astype(int) + 2
        below = self.pixels[y:bottom, x:right]
        if not below.size:
            return
        above = below.copy()
        cv2.fillPoly(above, [_fixed(polygon - (x, y))], colour, cv2.LINE_AA, _SHIFT)
        below[:] = cv2.addWeighted(above, opacity, below, 1.0 - opacity, 0.0)

    def dot(self, place: Points, radius: float, colour: Colour) -> None:
        """Draw a disc about a pixel (2,)."""
        import cv2

        if self._shows(place):
            centre, around = _fixed(place).ravel().tolist(), round(radius * (1 << _SHIFT))
            cv2.circle(self.pixels, centre, around, colour, -1, cv2.LINE_AA, _SHIFT)

    def cross(self, place: Points, reach: float, colour: Colour) -> None:
        """Draw an upright cross about a pixel (2,)."""
        if self._shows(place):
            (x, y), gap = place.tolist(), np.nan
            arms = [[x - reach, y], [x + reach, y], [gap, gap], [x, y - reach], [x, y + reach]]
            self.on_pixels().line(np.array(arms), colour, 2, cased=True)

    def text(
        self,
        words: str,
        at: ArrayLike,
        height_px: int,
        colour: Colour,
        *,
        bold: bool = False,
        anchor: float = 0.0,
        room: float = math.inf,
    ) -> tuple[float, float]:
        """Write a line of text.

        Parameters
        ----------
        words
            The text; characters that the typeface lacks become question marks.
        at : (2,)
            A pixel of the baseline.
        height_px
            Size of the typeface [px].
        anchor
            Share of the text to the left of `at`: 0 starts there, 1 ends there.
        room
            Greatest width, to which the text is cut [px].

        Returns
        -------
        tuple of float
            Columns where the text begins and ends.
        """
        place = np.asarray(at, np.float64)
        x, y = place.tolist()
        words = _cut(words, room, height_px, bold)
        if not words or not self._shows(place):
            return x, x
        width = _text_width(words, height_px, bold)
        begin = x - anchor * width
        _write(self.pixels, words, (round(begin), round(y)), height_px, colour, bold)
        return begin, begin + width

    def _shows(self, place: Points) -> bool:
        """Whether a mark at a pixel is visible; one at NaN is not."""
        return bool((np.abs(place) < max(self.size_px) + 100.0).all())


def affine(matrix: Points, points: Points) -> Points:
    """Points (..., 2) through a (2, 3) matrix."""
    return np.asarray(points @ matrix[:, :2].T + matrix[:, 2])


def _fixed(pixels: Points) -> NDArray[np.int32]:
    """Return pixels in OpenCV's fixed-point format."""
    return np.rint(pixels * (1 << _SHIFT)).astype(np.int32).reshape(-1, 1, 2)


def _pieces(pixels: Points, size: NDArray[np.intp]) -> list[Points]:
    """Return the visible parts of a line: split at NaN, clipped (Liang & Barsky)."""
    if len(pixels) < 2:
        return []
    if _is_on_sheet(pixels, size):
        return [pixels]
    start, step = pixels[:-1], np.diff(pixels, axis=0)
    # Parameters at which a segment crosses the two sides of each axis. One parallel to an axis
    # crosses them at ±∞, or nowhere (NaN) if exactly on a side, which counts as outside.
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        sides = [(-_BORDER_PX - start) / step, (size + _BORDER_PX - start) / step]
    near, far = np.sort(sides, axis=0)
    enter, leave = np.maximum(near.max(axis=1), 0.0), np.minimum(far.min(axis=1), 1.0)
    seen = np.flatnonzero(enter < leave)  # false for NaN
    if not len(seen):
        return []
    start, step, enter, leave = start[seen], step[seen], enter[seen, None], leave[seen, None]
    first, last = start + enter * step, start + leave * step
    joined = (np.diff(seen) == 1) & (leave[:-1, 0] == 1.0) & (enter[1:, 0] == 0.0)
    runs = np.split(np.arange(len(seen)), np.flatnonzero(~joined) + 1)
    return [np.concatenate([first[run], last[run[-1:]]]) for run in runs]


def _is_on_sheet(pixels: Points, size: NDArray[np.intp]) -> bool:
    """Whether no clipping is needed: false for NaN."""
    return bool((pixels >= -_BORDER_PX).all() and (pixels <= size + _BORDER_PX).all())


def _dashed(piece: Points, dash: float, gap: float) -> list[Points]:
    """Split a line into dashes that follow it."""
    run = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(piece, axis=0).T))])
    starts = np.arange(0.0, run[-1], dash + gap)
    along = starts[:, None] + np.linspace(0.0, dash, 4)
    return list(np.stack([np.interp(along, run, column) for column in piece.T], axis=-1))


def _clipped(polygon: Points, size: NDArray[np.intp]) -> Points:
    """Clip a polygon to the sheet (Sutherland and Hodgman 1974); empty if it contains NaN."""
    if _is_on_sheet(polygon, size):
        return polygon
    if not np.isfinite(polygon).all():
        return np.empty((0, 2))
    for axis in (0, 1):
        for sign, limit in ((1.0, -_BORDER_PX), (-1.0, size[axis] + _BORDER_PX)):
            depth = sign * (polygon[:, axis] - limit)
            inside, following = depth >= 0.0, np.roll(depth, -1)
            crosses = inside != np.roll(inside, -1)
            share = depth / np.where(crosses, depth - following, 1.0)
            crossing = polygon + share[:, None] * (np.roll(polygon, -1, axis=0) - polygon)
            corners = np.stack([polygon, crossing], axis=1)
            polygon = corners[np.column_stack([inside, crosses])]
    return polygon


# --- lettering --------------------------------------------------------------------------------

# OpenCV 5 includes a Unicode typeface; older versions have stroke letters in ASCII.
_STROKE_HEIGHT_PX = 30.0  # of stroke letters at scale 1
_IN_ASCII = str.maketrans(
    {
        "±": "+-",
        "°": " deg",
        "…": "...",
        "µ": "u",
        "μ": "u",
        "×": "x",
        "–": "-",
        "²": "^2",
        "é": "e",
    }
)
_REGULAR, _BOLD = 400, 600
_WIDTHS = 4096  # number of cached text widths


@cache
def _typeface() -> Any:
    import cv2

    return cv2.FontFace("sans") if hasattr(cv2, "FontFace") else None


def _write(
    pixels: Image, words: str, origin: tuple[int, int], height_px: int, colour: Colour, bold: bool
) -> None:
    import cv2

    face = _typeface()
    if face is not None:
        weight = _BOLD if bold else _REGULAR
        with uninterrupted():  # an exception of a handler crashes OpenCV 5 as it reads a typeface
            cv2.putText(pixels, words, origin, colour, face, height_px, weight)
        return
    letters, scale = words.translate(_IN_ASCII), height_px / _STROKE_HEIGHT_PX
    font, width = cv2.FONT_HERSHEY_SIMPLEX, 2 if bold else 1
    cv2.putText(pixels, letters, origin, font, scale, colour, width, cv2.LINE_AA)


def _text_width(words: str, height_px: int, bold: bool) -> float:
    return _width_in(_typeface(), words, height_px, bold)


@lru_cache(_WIDTHS)
def _width_in(face: Any, words: str, height_px: int, bold: bool) -> float:
    import cv2

    if face is not None:
        weight = _BOLD if bold else _REGULAR
        with uninterrupted():
            x, _, width, _ = cv2.getTextSize((0, 0), words, (0, 0), face, height_px, weight)
        return float(x + width)
    letters, scale = words.translate(_IN_ASCII), height_px / _STROKE_HEIGHT_PX
    font, width = cv2.FONT_HERSHEY_SIMPLEX, 2 if bold else 1
    return float(cv2.getTextSize(letters, font, scale, width)[0][0])


def _cut(words: str, room: float, height_px: int, bold: bool) -> str:
    """Return a text cut to a width, with … for a missing end."""
    if room == math.inf or _text_width(words, height_px, bold) <= room:
        return words
    fits, too_long = 0, len(words)
    while too_long - fits > 1:
        middle = (fits + too_long) // 2
        if _text_width(f"{words[:middle]}…", height_px, bold) <= room:
            fits = middle
        else:
            too_long = middle
    return f"{words[:fits].rstrip()}…" if fits else ""
