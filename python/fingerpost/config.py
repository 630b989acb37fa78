"""The rig file: the cameras, the plane they view, and where a template waits for the hand.

A rig file is TOML. `Rig.load` reads it and resolves the views' sources relative to the file. It
refuses unknown keys and unusable values with one line that names the file, the key, the value and
what would be right. `Rig.save` writes it back. The classes below are the schema: one class per
table, one attribute per key.
"""

from __future__ import annotations

import contextlib
import difflib
import json
import os
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, Self

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from fingerpost.capture import (
    Arrangement,
    CameraSettings,
    Reading,
    resolve_source,
    source_relative_to,
)
from fingerpost.checks import finite_array, in_range, part_of
from fingerpost.errors import InvalidInputError, RigError
from fingerpost.formats import NAMES, Size, corners_of, sides_of
from fingerpost.homography import (
    MIN_REFERENCE_POINTS,
    estimate_image_from_plane,
    transfer_to_image,
)
from fingerpost.lens import Lens
from fingerpost.rig_text import parsed
from fingerpost.targets import Target, Targets

RECORDING = ".mcap"
"""Suffix of the file name of a recording."""

Pair = tuple[float, float]
Triple = tuple[float, float, float]

# What would be right for each key; the end of the message about a missing key or a wrong type.
_RIGHT = {
    "": "a [plane] table and one [[view]] table per camera",
    "plane": "one [plane] table with unit and points",
    "plane.unit": 'a short name in quotes, such as "mm"',
    "plane.points": f"at least {MIN_REFERENCE_POINTS} points [X, Y] in the plane's unit",
    "view": "one [[view]] table per camera",
    "view.name": 'a short name in quotes, such as "left"',
    "view.source": "a file, a glob of images, a camera's name or a URL in quotes, or a camera "
    "number from 0",
    "view.camera": "{ width = 1280, height = 720, fps = 30 }, or other settings of a camera",
    "view.camera.fourcc": 'four letters in quotes, such as "MJPG"',
    "view.rotate_deg": "a turn clockwise by 0, 90, 180 or 270",
    "view.mirror": "true or false",
    "view.crop": "the part of the turned picture that is kept, [x, y, width, height] in px",
    "view.reference_points_px": "one pixel [u, v] per point of the plane, in its order",
    "view.size_px": "width and height of the images in which the points were measured, [w, h]",
    "view.offset_s": "seconds to add to this view's times, such as -0.2",
    "view.reference": '{ kind = "fixed" }, { kind = "rectangle", size = "A4" }, '
    '{ kind = "markers" } or { kind = "screen", size = [w, h] }',
    "view.reference.size": NAMES,
    "view.reference.sheet": "the number of the sheet, 1 to 6",
    "view.reference.corners_px": "about where its four corners are, as pixels [u, v] in the order "
    "of the plane's points",
    "view.reference.near_px": "one pixel [u, v] inside of it",
    "view.lens": "{ fx = ..., fy = ..., cx = ..., cy = ..., k1 = ... }, and k2 where it is known",
    "view.reference_covariances_px2": "one covariance [uu, uv, vv] in px² per reference point",
    "view.start": "one [view.start] table with tip_px, angle_deg, length_px and thumb",
    "view.start.tip_px": "the tip of the index finger as one pixel [u, v]",
    "view.start.angle_deg": "the direction of pointing in degrees: 0 is right, 90 is down",
    "view.start.length_px": "the visible length of the index finger in px",
    "view.start.thumb": '"left" or "right", seen along the pointing direction, or "none"',
    "target": "one [[target]] table for each thing to point at",
    "target.name": 'a short name in quotes, such as "cup"',
    "target.point": "its middle, [X, Y] in the plane's unit, and a radius",
    "target.polygon": "three corners [X, Y] or more, in the plane's unit",
    "target.radius": "how far it reaches about its point or polygon, in the plane's unit",
    "target.rest": "true for a place where the hand rests and nothing is selected",
    "robot": "one [robot] table with url, height_m, region_m and z_m",
    "robot.url": 'the robot in quotes, such as "acl:///dev/ttyUSB0"',
    "robot.height_m": "the plane's Z in the robot's frame, in m",
    "robot.region_m": "at least 3 corners [X, Y] of the safe region, in m of the robot's frame",
    "robot.z_m": "the lowest and the highest Z of the safe region, in m of the robot's frame",
}

_UNIT_SQUARE = [[0, 0], [1, 0], [1, 1], [0, 1]]

_MAX_SHOWN = 60

# Bounds that every camera keeps; squares of larger numbers may overflow.
_LARGEST_CAMERA = 2**31 - 1
_LENGTHS_PX = (0.1, 1e5)
_CAMERA_RANGES = {
    "width": (1, 32767),
    "height": (1, 32767),
    "fps": (0.1, 1e4),
    "exposure": (-1e6, 1e6),
    "gain": (-1e6, 1e6),
    "focus": (-1e6, 1e6),
    "white_balance_k": (100, 1e5),
}
_FOCAL_LENGTHS_PX = (1.0, 1e9)
_LARGEST_OFFSET_S = 3600.0
_MOST_SHEETS = 6
_VARIANCES_PX2 = (1e-12, 1e12)

# Largest relative difference between the sides of one rectangle: people round them.
_SAME_SIZE = 0.01


class _Table(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Base of all tables of a rig file: unknown keys are refused, and instances are immutable.

    In Python, lists and arrays are accepted for the file's lists; other types are refused.
    """

    def __post_init__(self) -> None:
        for field in msgspec.structs.fields(type(self)):
            value = getattr(self, field.name)
            try:
                taken = msgspec.convert(_plain(value), field.type)
            except msgspec.ValidationError as error:
                named = {kind: name for name, kind in _TABLES.items()}
                table = named.get(type(self), "view.reference")
                right = _right(f"{table}.{field.encode_name}".strip("."))
                raise InvalidInputError(
                    f"{field.name} is {_shown(value)}; needed: {right}"
                ) from error
            msgspec.structs.force_setattr(self, field.name, taken)


class Plane(_Table, kw_only=True, frozen=True):
    """The working plane and its reference points.

    Attributes
    ----------
    unit
        Name of the plane's unit; a label, nothing is computed from it.
    points
        At least four reference points (X, Y), in that unit.
    """

    unit: str
    points: tuple[Pair, ...]

    def __post_init__(self) -> None:
        super().__post_init__()
        _refuse_unprintable(self.unit, "unit")
        finite_array(self.points, "points", ("N", 2))
        if len(self.points) < MIN_REFERENCE_POINTS:
            raise InvalidInputError(
                f"points: {len(self.points)} found; at least {MIN_REFERENCE_POINTS} are needed"
            )


class FixedReference(_Table, frozen=True, tag_field="kind", tag="fixed"):
    """A static camera: the reference points stay where the rig file says.

    While the camera is displaced, its view provides no constraint line; see
    `fingerpost.references`.
    """


class RectangleReference(_Table, kw_only=True, frozen=True, tag_field="kind", tag="rectangle"):
    """A rectangle that lies on the plane, whose corners are the reference points.

    They are found in the first frames and followed in every later one; see
    `fingerpost.references`.

    Attributes
    ----------
    size
        Its name, or its sides (w, h) in the plane's unit; see `fingerpost.formats`.
    corners_px
        Approximate positions (u, v) of its corners, in px, in the order of the plane's points: they
        identify the rectangle and its corners.
    near_px
        A pixel (u, v) inside the rectangle, which identifies only the rectangle.
    """

    size: Size
    corners_px: tuple[Pair, Pair, Pair, Pair] | None = None
    near_px: Pair | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        sides_of(self.size, "mm")
        for name, shape in (("corners_px", (4, 2)), ("near_px", (2,))):
            if getattr(self, name) is not None:
                finite_array(getattr(self, name), name, shape)


class MarkersReference(_Table, kw_only=True, frozen=True, tag_field="kind", tag="markers"):
    """A sheet of markers that lies on the plane, as `fingerpost markers` writes it.

    The plane's points are the corners of the paper: its lower left one is the origin, X runs to the
    right. One visible marker is enough.

    Attributes
    ----------
    size
        Size of the paper; see `fingerpost.formats`.
    sheet
        Number of the sheet, 1 to 6.
    """

    size: Size = "A4"
    sheet: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        sides_of(self.size, "mm")
        if not 1 <= self.sheet <= _MOST_SHEETS:
            raise InvalidInputError(f"sheet is {self.sheet}; 1 to {_MOST_SHEETS} are right")


class ScreenReference(_Table, kw_only=True, frozen=True, tag_field="kind", tag="screen"):
    """A screen that shows a sheet of markers in full size, as `fingerpost markers --screen` does.

    Attributes
    ----------
    size
        Width and height of the lit area, in the plane's unit.
    sheet
        Number of the sheet, 1 to 6.
    """

    size: Size
    sheet: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        MarkersReference(size=self.size, sheet=self.sheet)


Reference = FixedReference | RectangleReference | MarkersReference | ScreenReference


class LensParameters(_Table, kw_only=True, frozen=True):
    """A view's lens, as `fingerpost.lens.Lens` takes it.

    Attributes
    ----------
    fx, fy
        Focal lengths in px, 1 to 1e9.
    cx, cy
        Principal point in px, at most 1e9 from the first pixel.
    k1, k2
        Radial distortion, dimensionless.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    k1: float
    k2: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        shortest, longest = _FOCAL_LENGTHS_PX
        for name in ("fx", "fy"):
            in_range(getattr(self, name), f"lens {name}", shortest, longest)
        for name in ("cx", "cy"):
            in_range(getattr(self, name), f"lens {name}", -longest, longest)
        self.lens()

    @classmethod
    def of(cls, lens: Lens) -> LensParameters:
        """Return the parameters of a model."""
        return cls(fx=lens.fx, fy=lens.fy, cx=lens.cx, cy=lens.cy, k1=lens.k1, k2=lens.k2)

    def lens(self) -> Lens:
        """Return the model with these parameters."""
        return Lens(**msgspec.structs.asdict(self))


class CameraTable(_Table, kw_only=True, frozen=True):
    """Requested settings of a view's camera; omitted ones are left unchanged.

    Attributes
    ----------
    width, height
        Size of its pictures in px, 1 to 32767.
    fps
        Frames a second, 0.1 to 10000.
    fourcc
        Pixel format in four letters, such as "MJPG" and "YUYV"; on a pipe, the layout of the raw
        frames, such as "BGR3" and "YU12".
    exposure, gain, focus
        Held constant at this value, in the driver's own unit.
    white_balance_k
        Held constant at this colour temperature in K.
    """

    width: int | None = None
    height: int | None = None
    fps: float | None = None
    fourcc: str | None = None
    exposure: float | None = None
    gain: float | None = None
    focus: float | None = None
    white_balance_k: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, (least, most) in _CAMERA_RANGES.items():
            if (value := getattr(self, name)) is not None:
                in_range(value, name, least, most)
        if self.fourcc is not None and not re.fullmatch(r"[!-~]{3}[ -~]", self.fourcc):
            raise InvalidInputError(
                f"fourcc is {_shown(self.fourcc)}; needed: {_RIGHT['view.camera.fourcc']}"
            )

    def settings(self) -> CameraSettings:
        """Return the settings for `fingerpost.capture.open_source`."""
        return CameraSettings(**msgspec.structs.asdict(self))


class Start(_Table, kw_only=True, frozen=True):
    """Start pose of the template in the image, where it waits for the hand.

    Attributes
    ----------
    tip_px
        Tip of the index finger (u, v), in px.
    angle_deg
        Direction of pointing in the image, in degrees: 0 is +u (right), 90 is +v (down).
    length_px
        Visible length of the index finger, in px, 0.1 to 1e5.
    thumb
        Side of the thumb, seen along the pointing direction; "none" for a finger alone.
    """

    tip_px: Pair
    angle_deg: float
    length_px: float
    thumb: Literal["left", "right", "none"]

    def __post_init__(self) -> None:
        super().__post_init__()
        finite_array(self.tip_px, "tip_px", (2,))
        finite_array(self.angle_deg, "angle_deg", ())
        in_range(self.length_px, "length_px", *_LENGTHS_PX)


class View(_Table, kw_only=True, frozen=True):
    """One camera's image stream and its properties.

    Attributes
    ----------
    name
        Name of the view in files and messages; unique within the rig.
    source
        Source for `fingerpost.capture.open_source`; None if a program pushes the images.
    reference_points_px
        The reference points (u, v) in this view's image, in px: one per point of the plane, in
        its order. They may lie outside the image. None if the reference is to be found.
    size_px
        Width and height of the images in which pixels of this table were measured: images of
        another size are refused. None if unknown.
    offset_s
        Added to this view's capture times, in s, at most an hour either way: for clocks that
        differ, and recordings that were not begun at the same time.
    reference_covariances_px2
        Covariance (uu, uv, vv) of each reference point in px², uu and vv from 1e-12 to 1e12; None
        if unknown: then the user of the rig has to assume one.
    reference
        How the reference points are found and followed.
    camera
        Settings requested when the camera is opened, or the layout of the raw frames on a pipe.
    rotate_deg, mirror, crop
        Transformation of its images before any processing: a rotation by `rotate_deg` (0, 90, 180
        or 270) clockwise, then an exchange of left and right, then a crop to (x, y, width, height)
        in px. All pixels of this table are those of the result.
    lens_parameters
        The key `lens`: the view's lens, if known.
    start
        Where a template waits for the hand, if given; a hand elsewhere is found as well.
    """

    name: str
    source: str | int | None = None
    reference_points_px: tuple[Pair, ...] = ()
    size_px: tuple[int, int] | None = None
    offset_s: float = 0.0
    reference_covariances_px2: tuple[Triple, ...] | None = None
    reference: Reference = FixedReference()
    camera: CameraTable | None = None
    rotate_deg: int = 0
    mirror: bool = False
    crop: tuple[int, int, int, int] | None = None
    lens_parameters: LensParameters | None = msgspec.field(default=None, name="lens")
    start: Start | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        _refuse_unprintable(self.name, "name")
        if self.source == "" or (
            isinstance(self.source, int) and not 0 <= self.source <= _LARGEST_CAMERA
        ):
            raise InvalidInputError(
                f"source is {_shown(self.source)}; needed: {_RIGHT['view.source']}"
            )
        if self.reference_points_px or isinstance(self.reference, FixedReference):
            self._refuse_no_points()
        self.arrangement  # noqa: B018 - refuses an invalid one
        in_range(self.offset_s, "offset_s", -_LARGEST_OFFSET_S, _LARGEST_OFFSET_S)
        if self.size_px is not None and not 1 <= min(self.size_px) <= max(self.size_px) < 2**31:
            raise InvalidInputError(
                f"size_px is {_shown(self.size_px)}; needed: {_RIGHT['view.size_px']}"
            )
        if self.reference_covariances_px2 is not None:
            self._refuse_no_covariances(self.reference_covariances_px2)

    @classmethod
    def from_homography(
        cls, name: str, image_from_plane: ArrayLike, plane: Plane, **others: Any
    ) -> Self:
        """Make a view from its homography instead of its reference points.

        Parameters
        ----------
        name
            Name of the view.
        image_from_plane : (3, 3)
            From points (X, Y, 1) of the plane to pixels (u, v, 1), up to scale; with a lens, into
            the pixels of its ideal pinhole.
        plane
            The rig's plane: the images of its points represent the homography exactly.
        **others
            The view's other attributes. `reference_covariances_px2` represents the uncertainty of
            the homography.

        Raises
        ------
        InvalidInputError
            Not a finite 3 × 3 matrix, or one with points of the plane on or beyond its horizon.
        """
        T = finite_array(image_from_plane, "image_from_plane", (3, 3))
        depths = np.column_stack([plane.points, np.ones(len(plane.points))]) @ T[2]
        points_px = transfer_to_image(T if depths.sum() > 0.0 else -T, plane.points)
        beyond = np.flatnonzero(~np.isfinite(points_px).all(axis=1))
        if len(beyond):
            raise InvalidInputError(
                f"image_from_plane puts plane.points[{beyond[0]}] on the horizon or beyond; all "
                "are to be in front of the camera"
            )
        lens = others.get("lens_parameters")
        if lens is not None:
            points_px = lens.lens().distort(points_px)
        pairs = tuple((u, v) for u, v in points_px.tolist())
        return cls(name=name, reference_points_px=pairs, **others)

    def _refuse_no_points(self) -> None:
        if not self.reference_points_px:
            right = _RIGHT["view.reference_points_px"]
            raise InvalidInputError(f"reference_points_px is missing; needed: {right}")
        finite_array(self.reference_points_px, "reference_points_px", ("N", 2))

    def _refuse_no_covariances(self, covariances_px2: tuple[Triple, ...]) -> None:
        name = "reference_covariances_px2"
        if len(covariances_px2) != len(self.reference_points_px):
            raise InvalidInputError(
                f"{name}: {len(covariances_px2)} found; one for each of the "
                f"{len(self.reference_points_px)} reference points is needed"
            )
        uu, uv, vv = finite_array(covariances_px2, name, ("N", 3)).T
        least, most = _VARIANCES_PX2
        with np.errstate(over="ignore"):  # an overflow is out of range
            known = (np.minimum(uu, vv) >= least) & (np.maximum(uu, vv) <= most)
            wrong = np.flatnonzero(~(known & (uu * vv > uv * uv)))
        if len(wrong):
            raise InvalidInputError(
                f"{name}[{wrong[0]}] is {_shown(covariances_px2[wrong[0]])}; "
                f"[uu, uv, vv] with uu and vv from {least:g} to {most:g} and uu · vv > uv² is right"
            )

    def reference_covariances(self, otherwise_sigma_px: float) -> NDArray[np.float64]:
        """Return the covariance of each reference point.

        Parameters
        ----------
        otherwise_sigma_px
            Standard deviation to assume if the rig gives none, in px, > 0.

        Returns
        -------
        (N, 2, 2)
            In px².
        """
        if self.reference_covariances_px2 is None:
            return np.tile(otherwise_sigma_px**2 * np.eye(2), (len(self.reference_points_px), 1, 1))
        return np.array([[[uu, uv], [uv, vv]] for uu, uv, vv in self.reference_covariances_px2])

    def with_wider_references(self, otherwise_sigma_px: float, sigma_px: float) -> Self:
        """Return this view with an independent error added to each reference point.

        Parameters
        ----------
        otherwise_sigma_px
            As for `reference_covariances`.
        sigma_px
            Standard deviation of either coordinate of the error [px].
        """
        wider = self.reference_covariances(otherwise_sigma_px) + sigma_px**2 * np.eye(2)
        cells = tuple((float(c[0, 0]), float(c[0, 1]), float(c[1, 1])) for c in wider)
        return msgspec.structs.replace(self, reference_covariances_px2=cells)

    def recorded_as(self, source: str) -> Self:
        """Return this view for a recording, whose frames are already transformed and retimed."""
        return msgspec.structs.replace(
            self, source=source, offset_s=0.0, camera=None, rotate_deg=0, mirror=False, crop=None
        )

    @property
    def arrangement(self) -> Arrangement:
        """Transformation of its images."""
        return Arrangement(self.rotate_deg, self.mirror, self.crop)

    @property
    def lens(self) -> Lens | None:
        """The view's lens, if known."""
        return self.lens_parameters.lens() if self.lens_parameters else None


class TargetTable(_Table, kw_only=True, frozen=True):
    """A thing on the plane to point at: `point` and `radius`, or `polygon`.

    Attributes
    ----------
    name
        Its name; unique within the rig.
    point
        Its centre (X, Y), in the plane's unit.
    polygon
        Its corners (X, Y), three or more, in the plane's unit.
    radius
        Radius about its point, above 0, or margin around its polygon, in the plane's unit.
    rest
        Whether it is a place for the hand to rest at: nothing is selected there, and before each
        selection by dwelling the hand must have been at such a place.
    """

    name: str
    point: Pair | None = None
    polygon: tuple[Pair, ...] | None = None
    radius: float = 0.0
    rest: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        _refuse_unprintable(self.name, "name")
        if (self.point is None) == (self.polygon is None):
            found = "both" if self.point else "neither"
            raise InvalidInputError(
                f"target {_shown(self.name)} has {found} of point and polygon; one of them is right"
            )
        self.target()

    def target(self) -> Target:
        """Return it as a place of the plane.

        Raises
        ------
        InvalidInputError
            An invalid radius or polygon.
        """
        corners = (self.point,) if self.polygon is None else self.polygon
        return Target(self.name, np.array(corners, np.float64), self.radius, self.rest)


class RobotTable(_Table, kw_only=True, frozen=True):
    """The robot that goes where the hand points.

    A rig with this table has the robot's own X and Y, in metres, as its plane coordinates, as
    `fingerpost robot plane` writes them.

    Attributes
    ----------
    url
        URL for `fingerpost.robot.open_robot`.
    height_m
        The plane's Z in the robot's frame, in m.
    region_m
        Corners (X, Y) of the convex safe region, in m.
    z_m
        The lowest and the highest Z of the safe region, in m; the lower first.
    pitch_deg, roll_deg, yaw_deg
        Orientation of the gripper, in degrees; None keeps the present one, or one that the arm
        cannot set.
    """

    url: str
    height_m: float
    region_m: tuple[Pair, ...]
    z_m: Pair
    pitch_deg: float | None = None
    roll_deg: float | None = None
    yaw_deg: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        _refuse_unprintable(self.url, "url")
        finite_array(self.height_m, "height_m", ())
        finite_array(self.z_m, "z_m", (2,))
        finite_array(self.region_m, "region_m", ("N", 2))
        if len(self.region_m) < 3:
            raise InvalidInputError(
                f"region_m: {len(self.region_m)} corners found; at least 3 are needed"
            )
        if not self.z_m[0] < self.z_m[1]:
            raise InvalidInputError(f"z_m is {_shown(self.z_m)}; the lower first is right")
        for name in ("pitch_deg", "roll_deg", "yaw_deg"):
            if getattr(self, name) is not None:
                finite_array(getattr(self, name), name, ())


class Rig(_Table, kw_only=True, frozen=True):
    """Cameras, working plane, and optionally a robot and targets: all parameters of a set-up.

    Attributes
    ----------
    plane
        The working plane.
    views
        At least one view, in the order of the file (key `view`); pointing needs two or more.
    robot
        The robot, if there is one.
    targets
        Things to point at (key `target`).

    Raises
    ------
    InvalidInputError
        Values that cannot be used, or contradict each other: repeated names, a number of pixels
        other than that of the reference points, reference points that determine no homography.
    """

    plane: Plane
    views: tuple[View, ...] = msgspec.field(name="view")
    robot: RobotTable | None = None
    targets: tuple[TargetTable, ...] = msgspec.field(name="target", default=())

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.views:
            raise InvalidInputError(f"view: none found; needed: {_RIGHT['view']}")
        for key, tables in (("view", self.views), ("target", self.targets)):
            for name, count in Counter(table.name for table in tables).most_common(1):
                if count > 1:
                    raise InvalidInputError(
                        f"{key}: {count} {key}s are called {_shown(name)}; each needs a name of "
                        "its own"
                    )
        for view in self.views:
            if not isinstance(view.reference, FixedReference):
                self._refuse_other_rectangle(view, view.reference)
            if view.reference_points_px:
                self._refuse_undetermined(view)

    @property
    def sources(self) -> dict[str, str | int]:
        """Sources for `fingerpost.capture.open_views` by view name, in the views' order.

        Raises
        ------
        InvalidInputError
            A view has none.
        """
        sources = {}
        for view in self.views:
            if view.source is None:
                raise InvalidInputError(
                    f"view {_shown(view.name)} has no source; needed: {_RIGHT['view.source']}"
                )
            sources[view.name] = view.source
        return sources

    @property
    def things(self) -> Targets:
        """The targets as places of the plane."""
        return Targets([table.target() for table in self.targets])

    @property
    def readings(self) -> tuple[Reading, ...]:
        """Readings of the sources for `fingerpost.capture.open_views`, in the views' order."""
        return tuple(
            Reading(
                view.offset_s, view.arrangement, view.camera.settings() if view.camera else None
            )
            for view in self.views
        )

    def _refuse_other_rectangle(
        self, view: View, reference: RectangleReference | MarkersReference | ScreenReference
    ) -> None:
        """Refuse a rectangle whose corners are not the points of the plane."""
        place = f"view {_shown(view.name)}: reference"
        try:
            size = sides_of(reference.size, self.plane.unit)
        except InvalidInputError as error:
            raise InvalidInputError(f"{place}: {error}") from error
        # The contents of a sheet of markers distinguish its width from its height.
        is_bare = isinstance(reference, RectangleReference)
        points = np.array(self.plane.points)
        sides = np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1)
        across = np.linalg.norm(points[2:4] - points[:2], axis=1)
        is_right = len(points) == 4 and any(
            np.allclose(sides, [w, h, w, h], rtol=_SAME_SIZE)
            and np.allclose(across, np.hypot(w, h), rtol=_SAME_SIZE)
            for w, h in ([size, size[::-1]] if is_bare else [size])
        )
        if not is_right:
            raise InvalidInputError(
                f"{place}: size is {_shown(reference.size)}, and plane.points are not the corners "
                f"of such a rectangle; leave them out, or give "
                f"{_shown([list(corner) for corner in corners_of(size)])}"
            )

    def _refuse_undetermined(self, view: View) -> None:
        points_px = finite_array(view.reference_points_px, "reference_points_px", ("N", 2))
        if len(points_px) != len(self.plane.points):
            raise InvalidInputError(
                f"view {_shown(view.name)}: reference_points_px: {len(points_px)} found; "
                f"one for each of the {len(self.plane.points)} points of the plane is needed"
            )
        try:
            if view.lens is not None:
                points_px = _undistorted(points_px, view.lens)
            estimate_image_from_plane(self.plane.points, points_px)
        except InvalidInputError as error:
            # The name of the argument in the rig file.
            message = str(error).replace("image_points_px", "reference_points_px")
            message = message.replace("plane_points", "plane.points")
            raise type(error)(f"view {_shown(view.name)}: {message}") from error

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a rig file; relative sources become relative to where the file lies.

        Parameters
        ----------
        path
            The file, TOML in UTF-8; or a recording (`.mcap`), whose rig has its views as sources.

        Raises
        ------
        RigError
            The file cannot be read or used. The message is one line: the file, the key's path,
            its value, and what would be right.
        SourceError
            The recording cannot be read, or was not made by fingerpost.
        MissingExtraError
            Recordings need the extra `mcap`.
        """
        path = Path(path)
        if path.suffix == RECORDING:
            return cls._of_recording(path)
        return cls._of(_tables(path), path)

    @classmethod
    def _of_recording(cls, path: Path) -> Self:
        from fingerpost.mcap_file import read_about  # needs the extra mcap

        _, text = read_about(path)
        try:
            rig = cls._of(parsed(text), path)
        except RigError:
            raise
        except InvalidInputError as error:
            raise RigError(f"{path}: {error}") from error
        views = (view.recorded_as(f"{path}#{view.name}") for view in rig.views)
        return msgspec.structs.replace(rig, views=tuple(views))

    @classmethod
    def load_cameras(cls, path: str | Path) -> Self:
        """Read a rig file whose plane is not yet defined; otherwise like `load`.

        [plane] and every view's reference_points_px may be omitted; the unit square replaces them,
        with the unit "undefined".

        Raises
        ------
        RigError
            As `load`.
        """
        path = Path(path)
        tables = _tables(path)
        if "plane" not in tables:
            tables["plane"] = {"unit": "undefined", "points": _UNIT_SQUARE}
            views = tables.get("view")
            for view in views if isinstance(views, list) else ():
                if isinstance(view, dict):
                    view.setdefault("reference_points_px", _UNIT_SQUARE)
        return cls._of(tables, path)

    @classmethod
    def _of(cls, tables: dict[str, Any], path: Path) -> Self:
        """Turn a file's tables into a rig."""
        _complete(tables)
        try:
            rig = msgspec.convert(tables, cls)
        except msgspec.ValidationError as error:
            raise RigError(f"{path}: {_explained(error, tables)}") from error
        views = (
            msgspec.structs.replace(view, source=resolve_source(view.source, path.parent))
            if view.source is not None
            else view
            for view in rig.views
        )
        return msgspec.structs.replace(rig, views=tuple(views))

    def save(self, path: str | Path) -> None:
        """Write the rig to a file that `load` reads back as the same rig.

        Sources below the file's directory are written relative to it, so that the directory can
        be moved; all other files with their absolute path.

        Raises
        ------
        RigError
            The file cannot be written.
        """
        path = Path(path)
        _refuse_null(path)
        views = (
            msgspec.structs.replace(view, source=source_relative_to(view.source, path.parent))
            if view.source is not None
            else view
            for view in self.views
        )
        text = msgspec.structs.replace(self, views=tuple(views)).dumps()
        if not path.name or os.path.isdir(path):  # noqa: PTH112 - a name may be too long to exist
            raise RigError(f"{path}: cannot be written: it is a directory, not a file")
        part = part_of(path)
        try:
            part.write_text(text, encoding="utf-8")
            part.replace(path)  # atomic: at any moment either the old rig or the new one exists
        except OSError as error:
            raise RigError(f"{path}: cannot be written: {error.strerror}") from error
        except UnicodeEncodeError as error:
            raise RigError(f"{path}: cannot be written: a source is no text in UTF-8") from error
        finally:
            with contextlib.suppress(OSError):
                part.unlink()  # an incomplete file

    def dumps(self) -> str:
        """Return the rig as TOML, with unchanged sources."""
        tables = msgspec.to_builtins(self)
        blocks = ["[plane]", *_lines(tables["plane"])]
        if "robot" in tables:
            blocks += ["", "[robot]", *_lines(tables["robot"])]
        for target in tables.get("target", ()):
            blocks += ["", "[[target]]", *_lines(target)]
        for view in tables["view"]:
            start = view.pop("start", None)
            blocks += ["", "[[view]]", *_lines(view)]
            if start is not None:
                blocks += ["[view.start]", *_lines(start)]
        return "\n".join(blocks) + "\n"


_TABLES: dict[str, type[_Table]] = {
    "": Rig,
    "plane": Plane,
    "view": View,
    "view.camera": CameraTable,
    "view.lens": LensParameters,
    "view.start": Start,
    "target": TargetTable,
    "robot": RobotTable,
}

_REFERENCES: dict[object, type[_Table]] = {
    "fixed": FixedReference,
    "rectangle": RectangleReference,
    "markers": MarkersReference,
    "screen": ScreenReference,
}


def _complete(tables: dict[str, Any]) -> None:
    """Derive the plane's points, and a unit if none is given, from a rectangle.

    Entries that are not tables, or have unusable values, are left to later checks.
    """
    views = tables.get("view")
    for view in views if isinstance(views, list) else ():
        if isinstance(view, dict) and "references" in view and "reference" not in view:
            view["reference"] = view.pop("references")
        reference = view.get("reference") if isinstance(view, dict) else None
        kind = reference.get("kind") if isinstance(reference, dict) else None
        if not isinstance(reference, dict) or kind not in ("rectangle", "markers", "screen"):
            continue
        plane = tables.setdefault("plane", {"unit": "mm"})
        if not isinstance(plane, dict) or "points" in plane:
            continue
        with contextlib.suppress(msgspec.ValidationError, InvalidInputError):
            default = "A4" if kind == "markers" else None
            size = msgspec.convert(reference.get("size", default), Size)
            plane["points"] = corners_of(sides_of(size, str(plane.get("unit"))))


def rig_tables() -> dict[str, type[msgspec.Struct]]:
    """Return the schema of every table of a rig file, by its dotted name; "" is the file."""
    kinds = {f"view.reference of kind {kind}": table for kind, table in _REFERENCES.items()}
    return {**_TABLES, **kinds}


def _tables(path: Path) -> dict[str, Any]:
    """Read a TOML file."""
    _refuse_null(path)
    try:
        return parsed(path.read_bytes())
    except OSError as error:
        raise RigError(f"{path}: {error.strerror}; a rig file (TOML) is needed") from error
    except InvalidInputError as error:
        raise RigError(f"{path}: {error}") from error


def _refuse_null(path: Path) -> None:
    if "\0" in str(path):
        raise RigError(f"{str(path)!r}: no file can have this name; a rig file is needed")


def _undistorted(points_px: NDArray[np.float64], lens: Lens) -> NDArray[np.float64]:
    undistorted = lens.undistort(points_px)
    outside = np.flatnonzero(np.isnan(undistorted).any(axis=1))
    if len(outside):
        raise InvalidInputError(
            f"reference_points_px[{outside[0]}] is where the lens model folds back; "
            "k1 and k2 must hold as far out as the reference points"
        )
    return undistorted


def _lines(table: dict[str, object]) -> list[str]:
    return [f"{key} = {_toml(value)}" for key, value in table.items()]


def _toml(value: object) -> str:
    if isinstance(value, dict):
        return f"{{ {', '.join(_lines(value))} }}"
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(_toml, value))}]"
    # JSON writes numbers and text as TOML does, except for one control character, left unescaped.
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def _plain(value: object) -> object:
    """Convert arrays and numbers of NumPy to lists and numbers of Python."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return [_plain(entry) for entry in value] if isinstance(value, list | tuple) else value


def _refuse_unprintable(text: str, key: str) -> None:
    if not text or not text.isprintable():
        raise InvalidInputError(f"{key} is {_shown(text)}; one line of printable text is right")


def _shown(value: object) -> str:
    """Return a value as a TOML file would show it, cut to a length that fits one line."""
    text = json.dumps(value, ensure_ascii=False, default=str)
    return text if len(text) <= _MAX_SHOWN else f"{text[:_MAX_SHOWN]}..."


def _explained(error: msgspec.ValidationError, tables: dict[str, object]) -> str:
    """Reword an error of msgspec in the terms of the rig file."""
    message, _, path = str(error).removesuffix("`").partition(" - at `$.")
    if isinstance(error.__cause__, InvalidInputError):
        return f"{path}: {message}" if path else message

    steps = re.findall(r"\w+", path)
    table = ".".join(step for step in steps if not step.isdecimal())
    field = re.fullmatch(
        r"Object (missing required|contains unknown) field `(.*?)`?", message, re.S
    )
    if field is None:
        value: Any = tables
        for step in steps:
            value = value[int(step) if step.isdecimal() else step]
        return f"{path} is {_shown(value)}; needed: {_right(table)}"
    key = field[2] if field[2].isidentifier() else _shown(field[2])
    place = f"{path}.{key}" if path else key
    if field[1] == "missing required":
        return f"{place} is missing; needed: {_right(f'{table}.{key}'.strip('.'))}"
    schema = _REFERENCES[_kind(tables, steps)] if table == "view.reference" else _TABLES[table]
    known = [known.encode_name for known in msgspec.structs.fields(schema)]
    if schema.__struct_config__.tag_field is not None:
        known.append(schema.__struct_config__.tag_field)
    close = difflib.get_close_matches(key, known, n=1)
    advice = f"did you mean {close[0]}?" if close else f"known are {', '.join(known)}"
    return f"{place} is not a key of a rig file; {advice}"


def _kind(tables: Any, steps: Sequence[str]) -> object:
    """Return the kind of the reference at a path."""
    for step in steps:
        tables = tables[int(step) if step.isdecimal() else step]
    return tables["kind"]


def _right(key: str) -> str:
    """Return what would be right for a key, or for the nearest table or list around it."""
    while key not in _RIGHT:
        key = key.rpartition(".")[0]
    return _RIGHT[key]
