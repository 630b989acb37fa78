"""Sheets of ArUco markers (Garrido-Jurado et al. 2014), and measurement of their corners.

OpenCV detects the markers and their numbers. The four sides of each are then measured like those of
any rectangle (`sides`), which gives corners without bias. All visible markers of a sheet determine
one homography; one marker suffices.
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
"""Side of a marker and white margin, relative to the sheet's shorter side: printers leave 6 mm of
A4 white."""

SHEET_IDS = 40
SHEETS = 6
"""Marker numbers reserved per sheet, and number of sheets from the dictionary's 250."""

REACH_CELLS = 0.4
"""Search range about a side as OpenCV places it [cells]."""

INSET = 0.08

CELLS_SIGMA_PX = 0.012
"""Additional standard deviation of corners [px]: the edge kernel reaches white cells near the
border."""

ROUGH_SIGMA_PX = 0.5
LEAST_SIDE_PX = 24.0
"""If the sides of a marker smaller than this cannot be measured, OpenCV's corners are used, with
this standard deviation. A larger one is covered in this case, and is not used."""

OFF_PX = 5.0
"""Greatest residual of a marker's corners; beyond, it is not part of the sheet."""


def sheet_markers(sides: tuple[float, float], sheet: int = 1) -> dict[int, Array]:
    """Return the markers of a sheet, by number.

    Parameters
    ----------
    sides
        Width and height, in any unit: sheets of one shape differ only in scale.
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
        No such sheet, or one so long that it would have more than `SHEET_IDS` markers.
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
    """Return the mask (6, 6) of a marker's black cells, from the upper left one."""
    import cv2

    picture = np.asarray(cv2.aruco.generateImageMarker(dictionary(), number, CELLS), np.uint8)
    return np.asarray(picture == 0)


def dictionary() -> cv2.aruco.Dictionary:
    """Return the dictionary of the markers: few cells, so that they may be small in the picture."""
    import cv2

    return cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_250)


class MarkersMeter:
    """Measures the corners of a sheet by its markers.

    Parameters
    ----------
    sides
        Width and height of the sheet, in the plane's unit.
    sheet
        Number of the sheet.
    plane_points
        (4, 2) The points to measure: its corners.
    lens
        The view's distortion, if known.
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
        """Measure the corners anywhere in the picture; None without a visible marker."""
        return self.search(picture)

    def search(self, picture: Picture, near_px: Array | None = None) -> Measured | None:  # noqa: ARG002
        """Search the whole picture for the sheet; None if no marker of it is visible."""
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
        """Combine all markers, except those that are not part of the sheet."""
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
        # A bent sheet or an unknown distortion displaces markers by more than noise.
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
    """Return the inliers of the homography that most markers agree on."""
    import cv2

    if len(plane) == 1:
        return [0]
    found, _ = cv2.findHomography(np.concatenate(plane), np.concatenate(ideal), cv2.RANSAC, OFF_PX)
    if found is None:
        return []
    T = np.asarray(found, np.float64)
    off_px = [np.abs(transfer_to_image(T, X) - x).max() for X, x in zip(plane, ideal, strict=True)]
    return [k for k, off in enumerate(off_px) if off < OFF_PX]
