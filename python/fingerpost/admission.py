"""Input checks of the main loop: rigs, options and frames that fit together.

Bad input is refused before any part of it is used, with a message that says what would be right.
The checks of a rig against its own images are shared by the main loop, the doctor and the advisor.
"""

from __future__ import annotations

import logging
import math
import numbers
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from fingerpost._core import ContourTracker, StartPose, Template
from fingerpost.capture import Frame, Loss
from fingerpost.config import LensParameters, Pair, Rig, View
from fingerpost.consistency import Contradiction
from fingerpost.errors import InvalidInputError
from fingerpost.homography import transfer_jacobian_by_point
from fingerpost.pointing import PlaneView
from fingerpost.references import Reduction

_log = logging.getLogger(__name__)


def different_sides(rig: Rig, plane_views: Sequence[PlaneView]) -> Contradiction | None:
    """Return a contradiction if views see the plane from different sides, which is impossible.

    Either side may be the upper one: the plane's axes may turn either way, equally in all views.

    Parameters
    ----------
    rig
        One view or more.
    plane_views
        Homographies of its views, in its order.
    """
    turns = [_turn(view) for view in plane_views]
    if len(set(turns)) <= 1:
        return None
    ways = ", ".join(
        f"{view.name} {'clockwise' if turn > 0 else 'anticlockwise'}"
        for view, turn in zip(rig.views, turns, strict=True)
    )
    return Contradiction(
        f"the views see the plane from different sides: from X to Y it turns {ways}",
        "reference_points_px must be [u, v] in the order of plane.points, and no image mirrored; "
        "`fingerpost doctor` compares them with the images",
    )


def _turn(plane_view: PlaneView) -> float:
    """Sense of rotation of the plane's axes in the image: 1 or −1."""
    centroid = plane_view.plane_points.mean(axis=0)
    jacobian = transfer_jacobian_by_point(plane_view.image_from_plane, centroid)
    return float(np.sign(np.linalg.det(jacobian)))


def other_size(view: View, size_px: tuple[int, int]) -> Contradiction | None:
    """Return a contradiction if a rig's pixels were measured in images of another size."""
    if view.size_px is None or view.size_px == size_px:
        return None
    width, height = size_px
    return Contradiction(
        f"its images have {width} × {height} px, and size_px = [{view.size_px[0]}, "
        f"{view.size_px[1]}] says in which its points were measured",
        "set the camera to that size, or measure reference_points_px and [view.start] anew",
    )


def refuse_unknown_points(rig: Rig) -> None:
    """Refuse a rig without reference points, for callers that do not search images for them.

    Raises
    ------
    InvalidInputError
        A view has no reference points.
    """
    for view in rig.views:
        if not view.reference_points_px:
            raise InvalidInputError(
                f'view "{view.name}": its reference points are still to be found; '
                "`fingerpost init` finds them and writes them into a rig file"
            )


def points_outside(view: View, size_px: tuple[int, int]) -> Contradiction | None:
    """Return a contradiction if most reference points lie outside an image (width, height).

    Most do if they were measured in larger images, or if a camera shows a part of the plane; it is
    the latter if `shows_middle`. Points that were measured in smaller images lie inside and are not
    detected.
    """
    points_px = np.array(view.reference_points_px)
    if len(points_px) == 0:
        return None
    inside = ((points_px >= -0.5) & (points_px <= np.array(size_px) - 0.5)).all(axis=1)
    if inside.sum() * 2 >= len(points_px):
        return None
    return Contradiction(
        f"{len(points_px) - int(inside.sum())} of {len(points_px)} reference points lie outside "
        f"the image of {size_px[0]} × {size_px[1]} px",
        "were they measured in images of another size? the workspace should be in view",
    )


def shows_middle(view: View, size_px: tuple[int, int]) -> bool:
    """Whether an image (width, height) shows the middle of the reference points.

    A camera that is close to the plane may show it without any of the points. In an image of half
    the size in which they were measured, the middle of the image is at its corner.
    """
    points_px = np.array(view.reference_points_px)
    middle_px = (points_px.min(axis=0) + points_px.max(axis=0)) / 2.0
    return bool(((middle_px >= -0.5) & (middle_px <= np.array(size_px) - 0.5)).all())


def reduced_view(view: View, reduction: Reduction) -> View:
    """Return the parameters of a view in the pixels of reduced images."""
    lens, start = reduction.lens(view.lens), view.start
    covariances_px2 = view.reference_covariances_px2
    return structs.replace(
        view,
        size_px=None,
        reference_points_px=_pairs(reduction.points(view.reference_points_px)),
        reference_covariances_px2=None
        if covariances_px2 is None
        else tuple(
            (uu / reduction.factor**2, uv / reduction.factor**2, vv / reduction.factor**2)
            for uu, uv, vv in covariances_px2
        ),
        lens_parameters=None if lens is None else LensParameters.of(lens),
        start=None
        if start is None
        else structs.replace(
            start,
            tip_px=_pairs(reduction.points([start.tip_px]))[0],
            length_px=start.length_px / reduction.factor,
        ),
    )


def _pairs(points_px: NDArray[np.float64]) -> tuple[Pair, ...]:
    return tuple((u, v) for u, v in points_px.tolist())


def check_tracker_options(options: Mapping[str, Any] | None) -> None:
    """Refuse options that a tracker would refuse, before there is one.

    Raises
    ------
    InvalidInputError
        Not a mapping, an unknown key or a value out of range; the message names the key's path.
    """
    if not isinstance(options, Mapping | None):
        raise InvalidInputError(
            f"tracker_options is {options!r}; a mapping from option to value is needed"
        )
    try:
        ContourTracker(Template.pistol("none"), StartPose((0.0, 0.0), 0.0, 50.0), options)
    except InvalidInputError as error:  # the tracker calls them options
        raise InvalidInputError(str(error).replace("options", "tracker_options", 1)) from error


class Admission:
    """Checks the frames of one rig's cameras.

    Parameters
    ----------
    views
        Views of the rig.
    """

    def __init__(self, views: Sequence[View]) -> None:
        self._views = views
        self._sizes_px: list[tuple[int, int] | None] = [None] * len(views)

    def admit(self, frames: Sequence[Frame | Loss | None]) -> None:
        """Refuse frames that are unusable or do not fit this rig; losses are accepted.

        Raises
        ------
        InvalidInputError
            The number of entries differs from that of the views; an entry is not a frame, or its
            image or time is unusable; the first frame of a view contains neither half of its
            reference points nor their middle; or a later frame has another size.
        """
        self._refuse_unusable(frames)
        self._refuse_other_sizes(frames)

    def _refuse_unusable(self, frames: Sequence[Frame | Loss | None]) -> None:
        """Refuse entries that no camera produces, before any part of them is used."""
        views = self._views
        if not isinstance(frames, Sequence) or len(frames) != len(views):
            given = isinstance(frames, Sequence)
            found = f"{len(frames) if given else type(frames).__name__} found"
            raise InvalidInputError(
                f"frames: {found}; one for each of the {len(views)} views is needed, None where a "
                "view has none"
            )
        for view, frame in zip(views, frames, strict=True):
            if not isinstance(frame, Loss | None) and (complaint := _unusable(frame)):
                raise InvalidInputError(f'view "{view.name}": {complaint}')

    def _refuse_other_sizes(self, frames: Sequence[Frame | Loss | None]) -> None:
        """Refuse frames of another size than the rig's pixel coordinates are for, if known."""
        for k, (view, frame) in enumerate(zip(self._views, frames, strict=True)):
            if not isinstance(frame, Frame):
                continue
            height, width = frame.image.shape[:2]
            size_px, first_px = (width, height), self._sizes_px[k]
            if size_px == first_px:
                continue
            if first_px is not None:
                raise InvalidInputError(
                    f'view "{view.name}": frame {frame.index} has {width} × {height} px, the first '
                    f"one has {first_px[0]} × {first_px[1]}; all must have one size"
                )
            wrong = other_size(view, size_px)
            outside = points_outside(view, size_px)
            if outside is not None and shows_middle(view, size_px):
                _log.warning('view "%s": %s; %s', view.name, *outside)
            elif outside is not None:
                wrong = wrong or outside
            if wrong is not None:
                raise InvalidInputError(f'view "{view.name}": {wrong.what}; {wrong.right}')
            self._sizes_px[k] = size_px


def _unusable(frame: object) -> str:
    """Return what is wrong with a frame made by the caller; empty if nothing is."""
    if not isinstance(frame, Frame):
        return f"{type(frame).__name__} found; a Frame is needed, or None"
    image, place = frame.image, f"the image of frame {frame.index}"
    needed = "(height, width) or (height, width, 3) of uint8 is needed"
    if not isinstance(image, np.ndarray):
        return f"{place} is a {type(image).__name__}; an array {needed}"
    if image.dtype != np.uint8 or image.shape[2:] not in ((), (3,)) or image.ndim < 2:
        return f"{place} has the shape {image.shape} and type {image.dtype}; {needed}"
    if not image.size:
        return f"{place} has the shape {image.shape}; one pixel at least is needed"
    time_s = frame.time_s
    if not isinstance(time_s, numbers.Real) or not math.isfinite(time_s):
        return f"time_s of frame {frame.index} is {time_s!r}; a finite number is needed"
    return ""
