"""Detection of the gripper in a view, by four methods.

A finder must detect the same point of the gripper at every place. It need not be the gripper's tip
if its offset from the tip is known (`PlaneOptions.offset_m`) or, for a marker, if the tip lies in
the marker's plane (`MarkerFinder`).
"""

from __future__ import annotations

import csv
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from fingerpost._core import ContourTracker, StartPose, Template
from fingerpost.capture import Frame
from fingerpost.checks import covariance_array, finite_array, in_range
from fingerpost.errors import InvalidInputError
from fingerpost.guidance.errors import GripperNotFoundError

SIGMAS_PX = (1e-3, 1e3)
"""Range of a finder's standard deviation [px]: its covariance keeps full rank, and the result is
meaningful."""

FURTHEST_SIDES = 100.0
"""Greatest distance of a tip from its marker, in sides of the marker."""

_SMALLEST = float(np.finfo(np.float64).tiny)


@dataclass(frozen=True, eq=False, slots=True)
class Sighting:
    """Detected position of the gripper in a view.

    Parameters
    ----------
    pixel_px : (2,)
        Position [px].
    covariance_px2 : (2, 2)
        Covariance of the detection, positive definite [px²].
    """

    pixel_px: NDArray[np.float64]
    covariance_px2: NDArray[np.float64]

    def __post_init__(self) -> None:
        object.__setattr__(self, "pixel_px", finite_array(self.pixel_px, "pixel_px", (2,)))
        Σ = covariance_array(self.covariance_px2, "covariance_px2", (2, 2))
        object.__setattr__(self, "covariance_px2", Σ)


class GripperFinder(ABC):
    """Detects the gripper in one view; each view has its own finder."""

    watches = False
    """Whether `watch` needs the frames in which the gripper moves."""

    def watch(self, frame: Frame) -> None:  # noqa: B027 - nothing to watch is the usual case
        """Process a frame in which the gripper moves."""

    @abstractmethod
    def find(
        self, place: int, frames: Sequence[Frame], elsewhere: Sequence[NDArray[np.uint8]]
    ) -> Sighting:
        """Detect the gripper while it stands still.

        Parameters
        ----------
        place
            Number of the place, from 0.
        frames
            One or more frames in which it stands there.
        elsewhere
            Grey images of the same view in which it stands elsewhere: first one from before the
            visits, then one of each place visited.

        Raises
        ------
        GripperNotFoundError
            It is not visible, or not clearly; the message states the reason.
        """


class MarkerFinder(GripperFinder):
    """Finds an ArUco marker on the gripper, or a point of its plane.

    Parameters
    ----------
    marker_id
        The marker's number.
    dictionary
        Its dictionary, as OpenCV names it without `DICT_`.
    tip
        Position of the point to detect in the marker's plane, from its centre, in sides of the
        marker: x to the right, y downwards, as the marker is printed. (0, 0) is the centre. The
        homography of the marker's corners projects it, so perspective is correct, but a point far
        from a small marker has a large covariance.
    sigma_px
        Standard deviation of one corner in one frame [px], in `SIGMAS_PX`. That of OpenCV's
        sub-pixel corners was 0.3 px.

    Raises
    ------
    InvalidInputError
        No such dictionary or marker, or a tip too far from it.
    """

    def __init__(
        self,
        marker_id: int = 0,
        *,
        dictionary: str = "4X4_50",
        tip: ArrayLike = (0.0, 0.0),
        sigma_px: float = 0.3,
    ) -> None:
        known = [name[5:] for name in dir(cv2.aruco) if name.startswith("DICT_")]
        if dictionary not in known:
            raise InvalidInputError(
                f"there is no ArUco dictionary {dictionary!r}; there are {', '.join(known)}"
            )
        words = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{dictionary}"))
        if not 0 <= marker_id < len(words.bytesList):
            raise InvalidInputError(
                f"marker_id is {marker_id}; {dictionary} has 0 to {len(words.bytesList) - 1}"
            )
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        self._detector = cv2.aruco.ArucoDetector(words, parameters)
        self._marker_id = marker_id
        self._tip = finite_array(tip, "tip", (2,))
        if abs(self._tip).max() > FURTHEST_SIDES:
            raise InvalidInputError(
                f"tip is {self._tip.tolist()}; at most {FURTHEST_SIDES:g} sides from the marker's "
                "centre, right and down, is right"
            )
        self._sigma_px = in_range(sigma_px, "sigma_px", *SIGMAS_PX)

    def find(
        self,
        place: int,  # noqa: ARG002
        frames: Sequence[Frame],
        elsewhere: Sequence[NDArray[np.uint8]],  # noqa: ARG002
    ) -> Sighting:
        """Find the marker in every frame and average."""
        found = [corners for frame in frames if (corners := self._corners(frame)) is not None]
        if not found:
            raise GripperNotFoundError(f"no marker {self._marker_id} in {len(frames)} frames")
        pixels = np.array([self._tip_px(corners) for corners in found])
        by_corners = self._jacobian(np.mean(found, axis=0))
        # Not reduced by the number of frames: errors of corners are mostly common to all frames.
        return Sighting(pixels.mean(axis=0), self._sigma_px**2 * by_corners @ by_corners.T)

    def _corners(self, frame: Frame) -> NDArray[np.float64] | None:
        corners, numbers, _ = self._detector.detectMarkers(frame.grey())
        if numbers is None:
            return None
        places = np.flatnonzero(np.asarray(numbers).ravel() == self._marker_id)
        if len(places) != 1:  # none, or several that cannot be distinguished
            return None
        return np.asarray(corners[places[0]], dtype=np.float64).reshape(4, 2)

    def _tip_px(self, corners: NDArray[np.float64]) -> NDArray[np.float64]:
        image_from_marker = cv2.getPerspectiveTransform(
            _MARKER_CORNERS.astype(np.float32), corners.astype(np.float32)
        )
        x = image_from_marker @ np.append(self._tip, 1.0)
        return np.asarray(x[:2] / x[2])

    def _jacobian(self, corners: NDArray[np.float64]) -> NDArray[np.float64]:
        """Differentiate the tip by the eight corner coordinates (2, 8), by finite differences."""
        step = 0.01
        columns = []
        for k in range(8):
            change = np.zeros(8)
            change[k] = step
            ahead, behind = (corners + sign * change.reshape(4, 2) for sign in (1, -1))
            columns.append((self._tip_px(ahead) - self._tip_px(behind)) / (2 * step))
        return np.transpose(columns)


_MARKER_CORNERS = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
"""A marker's corners in OpenCV's order, in sides of the marker from its centre, y downwards."""


class ContourFinder(GripperFinder):
    """Follows the gripper's outline with the package's own tracker.

    The template waits at the gripper's position before the first visit, over the middle of the safe
    region at its top, and follows it from place to place, so the gripper must move slowly.

    Parameters
    ----------
    template
        The gripper's outline: `fingerpost.Template.from_outline` of a traced one (see
        `load_outline`), or `Template.pistol("none")` for a gripper like a rod.
    start
        Its start pose: tip, direction and length in the image.
    along_sigma_px
        Standard deviation of the tip along the gripper, beyond the fit's own [px], in
        `SIGMAS_PX`.
    across_sigma_px
        The same across it [px], ≥ 0.
    polarity
        Whether the gripper is brighter or darker than the background; required for a thin one,
        because the search lines reach across it.
    options
        Further deviations from the tracker's defaults.
    """

    watches = True

    def __init__(
        self,
        template: Template,
        start: StartPose,
        *,
        along_sigma_px: float = 1.0,
        across_sigma_px: float = 0.5,
        polarity: Literal["bright", "dark", "unknown"] = "unknown",
        options: Mapping[str, Any] | None = None,
    ) -> None:
        model = "paper" if template.proportions is None else "ribbon"
        self._tracker = ContourTracker(
            template, start, {"model": model, "polarity": polarity, **(options or {})}
        )
        self._along_sigma_px = in_range(along_sigma_px, "along_sigma_px", *SIGMAS_PX)
        self._across_sigma_px = in_range(across_sigma_px, "across_sigma_px", 0.0, SIGMAS_PX[1])

    def watch(self, frame: Frame) -> None:
        """Follow the outline."""
        self._tracker.update(frame.grey(), frame.time_s)

    def find(
        self,
        place: int,  # noqa: ARG002
        frames: Sequence[Frame],
        elsewhere: Sequence[NDArray[np.uint8]],  # noqa: ARG002
    ) -> Sighting:
        """Average the tip over the frames."""
        tips, covariances = [], []
        status = "lost"
        for frame in frames:
            track = self._tracker.update(frame.grey(), frame.time_s)
            status, line = track.status, track.finger_line
            if line is not None:
                tips.append(line.tip_px)
                covariances.append(self._tip_covariance(line))
        if not tips:
            raise GripperNotFoundError(f"the outline is not on the gripper (tracker: {status})")
        return Sighting(np.mean(tips, axis=0), np.mean(covariances, axis=0))

    def _tip_covariance(self, line: Any) -> NDArray[np.float64]:
        e = np.array([math.cos(line.angle_rad), math.sin(line.angle_rad)])
        n = np.array([-e[1], e[0]])
        lever = np.array([1.0, float((np.subtract(line.tip_px, line.anchor_px)) @ e)])
        across = float(lever @ line.covariance @ lever) + self._across_sigma_px**2
        return np.asarray(self._along_sigma_px**2 * np.outer(e, e) + across * np.outer(n, n))


class MotionFinder(GripperFinder):
    """Detects changes relative to images of the view with the gripper elsewhere.

    The gripper's tip is the extreme point of the largest changed area in one direction of the
    image. A shadow as dark as the gripper would count as part of it.

    Parameters
    ----------
    towards_deg
        That direction [°]: 0 is right, 90 is down.
    threshold
        Least change [grey levels], > 0.
    min_area_px
        Least size of the area [px²], > 0.
    sigma_px
        Standard deviation of the tip found [px], in `SIGMAS_PX`.
    """

    def __init__(
        self,
        *,
        towards_deg: float = 90.0,
        threshold: float = 25.0,
        min_area_px: float = 50.0,
        sigma_px: float = 1.0,
    ) -> None:
        angle = math.radians(in_range(towards_deg, "towards_deg", -360.0, 360.0))
        self._towards = np.array([math.cos(angle), math.sin(angle)])
        self._threshold = in_range(threshold, "threshold", _SMALLEST, 255.0)
        self._min_area_px = in_range(min_area_px, "min_area_px", _SMALLEST)
        self._sigma_px = in_range(sigma_px, "sigma_px", *SIGMAS_PX)

    def find(
        self,
        place: int,  # noqa: ARG002
        frames: Sequence[Frame],
        elsewhere: Sequence[NDArray[np.uint8]],
    ) -> Sighting:
        """Compare the mean of the frames with the view without the gripper."""
        if not elsewhere:
            raise GripperNotFoundError("there is no image with the gripper elsewhere")
        here = np.mean([frame.grey() for frame in frames], axis=0)
        # The median needs three images: of two, the one from before the visits is used.
        empty = np.median(elsewhere, axis=0) if len(elsewhere) > 2 else elsewhere[0]
        change = cv2.GaussianBlur(np.abs(here - empty).astype(np.float32), (0, 0), 1.0)
        area = self._largest_area(change)
        return Sighting(self._furthest(change, area), self._sigma_px**2 * np.eye(2))

    def _largest_area(self, change: NDArray[np.float32]) -> NDArray[np.bool_]:
        mask = (change > self._threshold).astype(np.uint8)
        count, labels, statistics, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
        areas = np.asarray(statistics)[1:, cv2.CC_STAT_AREA]
        if count < 2 or areas.max() < self._min_area_px:
            raise GripperNotFoundError(
                f"nothing as large as {self._min_area_px:g} px² has changed by more than "
                f"{self._threshold:g} grey levels"
            )
        return np.asarray(labels == 1 + int(np.argmax(areas)))

    def _furthest(
        self, change: NDArray[np.float32], area: NDArray[np.bool_]
    ) -> NDArray[np.float64]:
        """Return the area's end in the given direction, weighted by the change near the end."""
        rows, columns = np.nonzero(area)
        pixels = np.column_stack([columns, rows]).astype(np.float64)
        reach = pixels @ self._towards
        end = reach > reach.max() - 2.0
        weights = change[rows[end], columns[end]].astype(np.float64)
        middle = (weights[:, None] * pixels[end]).sum(axis=0) / weights.sum()
        tip = middle + (reach.max() - middle @ self._towards) * self._towards
        if not (tip > 0.5).all() or not (tip < np.array(area.shape[::-1]) - 1.5).all():
            raise GripperNotFoundError("what has changed reaches out of the image")
        return np.asarray(tip)


class GivenFinder(GripperFinder):
    """Uses pixels that a person has marked.

    Parameters
    ----------
    ask
        Called with the place's number from 0 and the last frame; returns the pixel (u, v), or None
        if the gripper is not visible. See `load_pixels` for a file.
    sigma_px
        Standard deviation of such a pixel [px], in `SIGMAS_PX`.
    """

    def __init__(
        self,
        ask: Callable[[int, Frame], ArrayLike | None],
        *,
        sigma_px: float = 1.0,
    ) -> None:
        self._ask = ask
        self._sigma_px = in_range(sigma_px, "sigma_px", *SIGMAS_PX)

    def find(
        self,
        place: int,
        frames: Sequence[Frame],
        elsewhere: Sequence[NDArray[np.uint8]],  # noqa: ARG002
    ) -> Sighting:
        """Ask for the pixel."""
        pixel = self._ask(place, frames[-1])
        if pixel is None:
            raise GripperNotFoundError("no pixel is given")
        pixel = pixel_of(pixel, frames[-1], f"pixel of place {place + 1}")
        return Sighting(pixel, self._sigma_px**2 * np.eye(2))


def pixel_of(value: ArrayLike, frame: Frame, name: str) -> NDArray[np.float64]:
    """Return `value` as a pixel (u, v) of a frame.

    Raises
    ------
    InvalidInputError
        Not two finite numbers, or outside the image.
    """
    height, width = frame.image.shape[:2]
    u, v = finite_array(value, name, (2,))
    if not (-0.5 <= u <= width - 0.5 and -0.5 <= v <= height - 0.5):
        raise InvalidInputError(
            f"{name} is ({u:g}, {v:g}), outside the image of {width} x {height} px"
        )
    return np.array([u, v])


def load_pixels(path: str | Path) -> dict[str, dict[int, tuple[float, float]]]:
    """Read given pixels from a CSV file with the columns `place,view,u,v`.

    Parameters
    ----------
    path
        The file; places count from 1, views go by name, u and v are in px.

    Returns
    -------
    dict
        By view, the pixel (u, v) of every place, numbered from 0.

    Raises
    ------
    InvalidInputError
        Not such a file; the message names the line.
    """
    path = Path(path)
    pixels: dict[str, dict[int, tuple[float, float]]] = {}
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            rows = csv.DictReader(file)
            missing = {"place", "view", "u", "v"} - set(rows.fieldnames or ())
            if missing:
                raise InvalidInputError(
                    f"{path}: no column {', '.join(sorted(missing))}; place,view,u,v are needed"
                )
            for row in rows:
                try:
                    place, pixel = int(row["place"]), (float(row["u"]), float(row["v"]))
                except (TypeError, ValueError):
                    place, pixel = 0, (math.nan, math.nan)
                if place < 1 or not all(map(math.isfinite, pixel)):
                    raise InvalidInputError(
                        f"{path}, line {rows.line_num}: a place from 1, finite u and v are needed"
                    )
                view = pixels.setdefault(str(row["view"]), {})
                if place - 1 in view:
                    raise InvalidInputError(
                        f"{path}, line {rows.line_num}: place {place} of view {row['view']} is "
                        "given twice"
                    )
                view[place - 1] = pixel
    except OSError as error:
        raise InvalidInputError(f"{path}: {error.strerror}; a CSV file is needed") from error
    except UnicodeDecodeError as error:
        raise InvalidInputError(f"{path}: not a text file in UTF-8 ({error.reason})") from error
    return pixels


def load_outline(path: str | Path) -> Template:
    """Read a gripper's traced outline into a template.

    Parameters
    ----------
    path
        CSV without header: first the start and the tip of the gripper's axis, then the outline in
        order along the contour; one point u,v per line, in pixels of any image of the gripper. The
        gripper lies to the right of the direction of travel (v points down).

    Raises
    ------
    InvalidInputError
        Not such a file, or an outline that `fingerpost.Template.from_outline` refuses.
    """
    path = Path(path)
    try:
        points = np.loadtxt(path, delimiter=",", ndmin=2, encoding="utf-8-sig")
    except OSError as error:
        raise InvalidInputError(f"{path}: {error.strerror}; an outline is needed") from error
    except ValueError as error:
        raise InvalidInputError(f"{path}: {error}; one point u,v per line is needed") from error
    if points.ndim != 2 or points.shape[1] != 2 or len(points) < 6:
        raise InvalidInputError(
            f"{path}: {points.shape[0]} lines of {points.shape[1]} numbers; the axis's beginning, "
            "its tip and at least 4 points of the outline are needed, u,v each"
        )
    try:
        return Template.from_outline(points[2:], knuckle=points[0], tip=points[1], hand="right")
    except InvalidInputError as error:
        raise InvalidInputError(f"{path}: {error}") from error
