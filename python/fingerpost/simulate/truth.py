"""Exact ground truth of a simulated frame."""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fingerpost.errors import InvalidInputError
from fingerpost.simulate import checks
from fingerpost.simulate.camera import Camera
from fingerpost.simulate.device import Body
from fingerpost.simulate.outline import link_outlines, seen_links
from fingerpost.simulate.pose import DevicePose

Array = NDArray[np.float64]
ThumbSide = Literal["left", "right", "none"]


@dataclass(frozen=True)
class StartError:
    """Error of a start pose: of exactly this size, in a random direction."""

    offset_px: float = 0.0  # px of the tip, 0…500
    angle_deg: float = 0.0  # deg, 0…180
    scale: float = 1.0  # given length over true length, 0.1…10

    def __post_init__(self) -> None:
        checks.number("offset_px", self.offset_px, 0, 500)
        checks.number("angle_deg", self.angle_deg, 0, 180)
        checks.number("scale", self.scale, 0.1, 10)


@dataclass(frozen=True)
class StartPose:
    """Start pose of a template, as in `[view.start]` of a rig file (pictured px)."""

    tip_px: tuple[float, float]
    angle_deg: float  # direction of pointing in the image: 0 is right, 90 down
    length_px: float
    thumb: ThumbSide


@dataclass(frozen=True, eq=False)
class FingerTruth:
    """The index finger in one view, at the view's own time.

    Ideal pixels are the pinhole's, pictured pixels lie behind the lens (see `camera`); without
    distortion they are the same. Numbers are NaN where the finger is not in front of the camera.
    """

    axis_point_px: Array  # (2,) ideal; the end of the axis, on the surface of the fingertip
    axis_angle_rad: float  # ideal; direction of pointing, 0 is right, π/2 down
    apex_px: Array  # (2,) ideal; where the axis leaves the silhouette
    flanks_px: Array  # (2, 2, 2) ideal; left and right side seen along the finger, base to tip
    length_px: float  # ideal; from the start of the finger to the apex
    axis_angle_pictured_rad: float  # of the chord from the start to the end of the finger's axis
    apex_pictured_px: Array  # (2,)
    root_pictured_px: Array  # (2,) axis point at the start of the finger
    thumb: ThumbSide  # side of the thumb seen along the direction of pointing
    in_view: bool  # whether the whole finger is inside the image (it may be occluded)

    def start(
        self, error: StartError | None = None, rng: np.random.Generator | int | None = None
    ) -> StartPose:
        """Return a start pose for a tracker with an error, in a direction drawn from `rng`."""
        if not math.isfinite(self.length_px):
            raise InvalidInputError(
                "the finger is not in front of the camera; choose a time at which it is"
            )
        tip, angle = self.apex_pictured_px, self.axis_angle_pictured_rad
        length = math.dist(tip, self.root_pictured_px)
        if error is not None:
            draw = checks.generator("rng", rng)
            heading, turn = draw.uniform(0, 2 * math.pi), draw.choice([-1.0, 1.0])
            tip = tip + error.offset_px * np.array([math.cos(heading), math.sin(heading)])
            angle += turn * math.radians(error.angle_deg)
            length *= error.scale
        degrees = math.remainder(math.degrees(angle), 360)
        return StartPose((float(tip[0]), float(tip[1])), degrees, length, self.thumb)


@dataclass(frozen=True, eq=False)
class ViewTruth:
    """One view of a frame."""

    name: str
    time_s: float  # the view's own time, skew included; mid-exposure
    image_from_world: Array  # (3, 4) mm → homogeneous ideal pixels
    image_from_plane: Array  # (3, 3) mm on the plane → homogeneous ideal pixels, t33 = 1
    reference_points_px: Array  # (N, 2) ideal
    reference_points_pictured_px: Array  # (N, 2)
    indicated_px: Array | None  # (2,) ideal; projection of the indicated point at the view's time
    finger: FingerTruth | None  # None: no device


@dataclass(frozen=True, eq=False)
class FrameTruth:
    """One frame of all views; pose and indicated point hold at the rig's time."""

    time_s: float
    pose: DevicePose | None
    indicated_mm: Array | None  # (2,) intersection of the axis with the plane, if there is one
    views: tuple[ViewTruth, ...]


def view_truth(
    camera: Camera, points_mm: Array, body: Body, pose: DevicePose | None, time_s: float
) -> ViewTruth:
    """Truth of one view, of a device in the given pose at the view's own time."""
    references = camera.project(np.pad(points_mm, ((0, 0), (0, 1))))
    indicated = None if pose is None else pose.indicated_mm
    return ViewTruth(
        name=camera.name,
        time_s=time_s,
        image_from_world=camera.image_from_world,
        image_from_plane=camera.image_from_plane,
        reference_points_px=references,
        reference_points_pictured_px=camera.pictured(references),
        indicated_px=None if indicated is None else camera.project(np.append(indicated, 0.0)),
        finger=None if pose is None else finger_truth(camera, body, pose),
    )


def finger_truth(camera: Camera, body: Body, pose: DevicePose) -> FingerTruth:
    """Truth of the index finger of a body in one view."""
    world_from_device = pose.world_from_device
    finger = body.links[body.finger]
    device_points = np.array([(0.0, 0.0, 0.0), finger.start_mm, body.root_mm])
    points = device_points @ world_from_device[:, :3].T + world_from_device[:, 3]
    tip, base, root = camera.project(points)
    along = tip - base

    apex, flanks = np.full(2, np.nan), np.full((2, 2, 2), np.nan)
    seen, kept = seen_links(camera, body.placed(world_from_device)[:, [body.finger]])
    if kept.all():
        outline = link_outlines(seen)
        apex = camera.project_seen(outline.apex[0])
        if not outline.end_on[0]:
            flanks = camera.project_seen(outline.flanks[0])
    pictured = camera.pictured(np.stack([apex, root, tip, base]))
    chord = pictured[2] - pictured[3]
    return FingerTruth(
        axis_point_px=tip,
        axis_angle_rad=math.atan2(along[1], along[0]),
        apex_px=apex,
        flanks_px=flanks,
        length_px=float(np.linalg.norm(apex - root)),
        axis_angle_pictured_rad=math.atan2(chord[1], chord[0]),
        apex_pictured_px=pictured[0],
        root_pictured_px=pictured[1],
        thumb=_thumb_side(camera, body, world_from_device, tip, along),
        in_view=bool(camera.contains(pictured).all()),
    )


def _thumb_side(
    camera: Camera, body: Body, world_from_device: Array, tip: Array, along: Array
) -> ThumbSide:
    if body.thumb is None:
        return "none"
    end = np.array(body.links[body.thumb].end_mm)
    thumb = camera.project(world_from_device[:, :3] @ end + world_from_device[:, 3]) - tip
    # v points down, so a positive cross product turns clockwise: to the right.
    return "right" if along[0] * thumb[1] - along[1] * thumb[0] > 0 else "left"
