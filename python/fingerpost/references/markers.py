"""Sheets of ArUco markers (Garrido-Jurado et al. 2014), and where a picture shows their corners.

OpenCV finds the markers and reads their numbers; the four sides of each are then measured as those
of any rectangle are (`sides`), whose corners have no bias. All markers of a sheet in sight give one
homography: one of them is enough.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fingerpost.errors import InvalidInputError
from fingerpost.homography import (
    estimate_image_from_plane,
    transfer_jacobian_by_entries,
    transfer_to_image,
)
from fingerpost.lens import Lens
from fingerpost.references.following import Measured
from fingerpost.references.rectangles import tone
from fingerpost.references.sides import as_shown, fit_sides
from fingerpost.uncertainty import blocks_of, homography_covariance

if TYPE_CHECKING:
    import cv2

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]

CELLS = 6
"""Cells along a side of a marker, its black border included."""

ACROSS = 4
"""Markers along the shorter side of a sheet."""

SIDE = 0.16
MARGIN = 0.06
"""A marker's side and the sheet's white margin, as parts of its shorter side: printers leave 6 mm
of A4 white."""

SHEET_IDS = 40
SHEETS = 6
"""Numbers from one sheet to the next, and how many sheets there are of the dictionary's 250."""

REACH_CELLS = 0.4
"""How far from where OpenCV puts it a side is looked for, in cells."""

INSET = 0.08

CELLS_SIGMA_PX = 0.012
"""What corners are off by besides: white cells near the border are in reach of the kernel."""

ROUGH_SIGMA_PX = 0.5
LEAST_SIDE_PX = 24.0
"""Of a marker with smaller sides that cannot be measured, OpenCV's corners are taken, and are known
so well. A larger one is covered then."""

OFF_PX = 5.0
"""A marker whose corners are off by more is of another sheet, or none."""


def sheet_markers(sides: tuple[float, float], sheet: int = 1) -> dict[int, Array]:
    """Return where a sheet has its markers, by their numbers.

    Parameters
    ----------
    sides
        Width and height, in any unit: sheets of one shape differ in scale alone.
    sheet
        Number of the sheet, 1 to `SHEETS`.

    Returns
    -------
    dict from int to (4, 2)
        Corners of each marker in the order of OpenCV: the upper left one, then clockwise. X runs to
        the right, Y upwards, from the lower left corner of the sheet.

    Raises
    ------
    InvalidInputError
        No such sheet, or one so long that it has more than `SHEET_IDS` markers.
    """
    if not 1 <= sheet <= SHEETS:
        raise InvalidInputError(f"sheet is {sheet}; 1 to {SHEETS} are right")
    width, height = sides
    short = min(sides)
    side, room = SIDE * short, np.array(sides) - (2 * MARGIN + SIDE) * short
    pitch = (short - (2 * MARGIN + SIDE) * short) / (ACROSS - 1)
    columns, rows = (int(r / pitch + 1e-6) + 1 for r in room)
    if columns * rows > SHEET_IDS:
        raise InvalidInputError(
            f"a sheet of {width:g} × {height:g} is too long: its longer side may be twice the other"
        )
    markers = {}
    for k in range(columns * rows):
        row, column = divmod(k, columns)
        left = MARGIN * short + room[0] * column / max(columns - 1, 1)
        top = height - MARGIN * short - room[1] * row / max(rows - 1, 1)
        corners = [(0.0, 0.0), (side, 0.0), (side, -side), (0.0, -side)]
        markers[(sheet - 1) * SHEET_IDS + k] = np.array([left, top]) + corners
    return markers


def marker_cells(number: int) -> NDArray[np.bool_]:
    """Return which cells (6, 6) of a marker are black, from its upper left one."""
    import cv2

    picture = np.asarray(cv2.aruco.generateImageMarker(dictionary(), number, CELLS), np.uint8)
    return np.asarray(picture == 0)


def dictionary() -> cv2.aruco.Dictionary:
    """Return the markers' dictionary: few cells, so that markers may be small in the picture."""
    import cv2

    return cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_250)


class MarkersMeter:
    """Measures the corners of a sheet by the markers on it.

    Parameters
    ----------
    sides
        Width and height of the sheet, in the plane's unit.
    sheet
        Its number.
    plane_points
        (4, 2) The points to be measured: its corners.
    lens
        The view's distortion, if it is known.
    """

    def __init__(
        self,
        sides: tuple[float, float],
        sheet: int,
        plane_points: Array,
        lens: Lens | None = None,
    ) -> None:
        import cv2

        self._markers = sheet_markers(sides, sheet)
        self._plane_points = plane_points
        self._lens = lens
        self._detector = cv2.aruco.ArucoDetector(dictionary())

    def measure(self, picture: Picture, near_px: Array) -> Measured | None:  # noqa: ARG002
        """Measure the corners, wherever they are; None if no marker of the sheet is seen."""
        return self.search(picture)

    def search(self, picture: Picture, near_px: Array | None = None) -> Measured | None:  # noqa: ARG002
        """Look for the sheet in all of a picture; None if no marker of it is seen."""
        grey = tone(picture, None)
        corners, numbers, _ = self._detector.detectMarkers(grey)
        if numbers is None:
            return None
        plane, points, covariances = [], [], []
        for number, rough in zip(map(int, np.ravel(numbers)), corners, strict=True):
            if number in self._markers:
                seen = self._seen(grey, np.asarray(rough, np.float64).reshape(4, 2))
                if seen is not None:
                    plane.append(self._markers[number])
                    points.append(seen.points_px)
                    covariances.append(seen.covariance)
        return self._joined(plane, points, covariances) if plane else None

    def _seen(self, grey: Picture, rough_px: Array) -> Measured | None:
        """Measure one marker by its sides, which step from white to black."""
        side_px = float(np.linalg.norm(np.roll(rough_px, -1, axis=0) - rough_px, axis=1).min())
        sides = fit_sides(
            grey,
            rough_px,
            self._lens,
            reach_px=max(REACH_CELLS * side_px / CELLS, 1.0),
            steps=-np.ones(4),
            inset=INSET,
        )
        if sides is not None:
            return Measured(sides.corners_px, sides.covariance + CELLS_SIGMA_PX**2 * np.eye(8))
        if side_px >= LEAST_SIDE_PX:
            return None
        return Measured(rough_px, ROUGH_SIGMA_PX**2 * np.eye(8))

    def _joined(
        self, plane: list[Array], points: list[Array], covariances: list[Array]
    ) -> Measured | None:
        """Bring all markers together, but for those that are none of the sheet."""
        ideal = [px if self._lens is None else self._lens.undistort(px) for px in points]
        kept = _agreeing(plane, ideal)
        if not kept:
            return None
        X, x = np.concatenate([plane[k] for k in kept]), np.concatenate([ideal[k] for k in kept])
        joint = np.zeros((2 * len(x), 2 * len(x)))
        for place, k in enumerate(kept):
            block = slice(8 * place, 8 * place + 8)
            joint[block, block] = covariances[k]
        each = blocks_of(joint)
        T = estimate_image_from_plane(X, x, each)
        left = x - transfer_to_image(T, X)
        squares = float(np.einsum("ki,kij,kj->", left, np.linalg.inv(each), left))
        # A sheet that bends, or an unknown distortion, puts markers off by more than noise.
        worse = max(squares / max(2 * len(x) - 8, 1), 1.0)
        Σ = worse * homography_covariance(T, X, joint)
        return self._corners_of(T, Σ)

    def _corners_of(self, T: Array, entries_covariance: Array) -> Measured | None:
        corners = transfer_to_image(T, self._plane_points)
        if not np.isfinite(corners).all():
            return None
        by_entries = transfer_jacobian_by_entries(T, self._plane_points).reshape(8, 9)
        covariance = by_entries @ entries_covariance @ by_entries.T
        shown = as_shown(corners, covariance, self._lens)
        return None if shown is None else Measured(*shown)


def _agreeing(plane: list[Array], ideal: list[Array]) -> list[int]:
    """Return the markers that most of them agree with on one homography."""
    import cv2

    if len(plane) == 1:
        return [0]
    found, _ = cv2.findHomography(np.concatenate(plane), np.concatenate(ideal), cv2.RANSAC, OFF_PX)
    if found is None:
        return []
    T = np.asarray(found, np.float64)
    off_px = [np.abs(transfer_to_image(T, X) - x).max() for X, x in zip(plane, ideal, strict=True)]
    return [k for k, off in enumerate(off_px) if off < OFF_PX]
