"""The simulated rig: cameras, table and pointing device, rendered with exact truth."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fingerpost.errors import InvalidInputError
from fingerpost.simulate import checks
from fingerpost.simulate.camera import Camera, Placement, Workspace
from fingerpost.simulate.device import Body, PointingDevice, RodAndProng
from fingerpost.simulate.motion import Motion
from fingerpost.simulate.occlusion import occluders_on
from fingerpost.simulate.optics import sensed
from fingerpost.simulate.pose import DevicePose
from fingerpost.simulate.render import Occluder, Placed, ViewRenderer
from fingerpost.simulate.scene import Background, Lighting, Sensor, check_contrast
from fingerpost.simulate.table import Table
from fingerpost.simulate.truth import FrameTruth, view_truth

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class SimulatedFrame:
    """One picture per view, and their ground truth.

    `images` are uint8, or float32 where rendered with ``quantise=False``; (H, W) grey or (H, W, 3)
    BGR.
    """

    images: tuple[NDArray[Any], ...]
    truth: FrameTruth


class SimulatedRig:
    """Cameras over a table, with a pointing device.

    Parameters
    ----------
    cameras
        A `Placement`, or the cameras themselves; default: the paper's two.
    workspace
        Square and reference points on the working plane.
    device
        The pointing device, unless `render` is given another.
    background, lighting, sensor
        Appearance; see each class.

    Raises
    ------
    InvalidInputError
        No camera, two of one name, or a reference point that a camera cannot image.

    Examples
    --------
    >>> rig = SimulatedRig()
    >>> pose = DevicePose.pointing_at((150, 260), hover_mm=120)
    >>> frame = rig.render(pose, rng=0)
    >>> frame.images[0].shape, frame.truth.indicated_mm.round(6).tolist()
    ((480, 640), [150.0, 260.0])
    """

    def __init__(
        self,
        cameras: Placement | Sequence[Camera] | None = None,
        *,
        workspace: Workspace | None = None,
        device: PointingDevice | None = None,
        background: Background | None = None,
        lighting: Lighting | None = None,
        sensor: Sensor | None = None,
    ) -> None:
        self.workspace = checks.instance("workspace", workspace or Workspace(), Workspace)
        self.background = checks.instance("background", background or Background(), Background)
        self.lighting = checks.instance("lighting", lighting or Lighting(), Lighting)
        self.sensor = checks.instance("sensor", sensor or Sensor(), Sensor)
        check_contrast(self.background, self.lighting)
        self.device: PointingDevice = device or RodAndProng()
        _body_of(self.device)
        self.cameras = _cameras(Placement() if cameras is None else cameras, self.workspace)
        if not self.cameras:
            raise InvalidInputError("cameras is empty; a rig needs one or more")
        self.reference_points_px = tuple(self._references(camera) for camera in self.cameras)
        self._table = Table(self.background, self.workspace, self.cameras)
        self._views = self._renderers()

    @property
    def plane_points(self) -> Array:
        """(N, 2) reference points on the plane [mm]."""
        return self.workspace.points_mm

    def seen_by(self, cameras: Sequence[Camera]) -> "SimulatedRig":
        """Return the same scene with other cameras; the table is not generated again.

        Parameters
        ----------
        cameras
            The cameras; for a moving camera, its pose at one time, under the same name.

        Raises
        ------
        InvalidInputError
            As the constructor.
        """
        seen = copy.copy(self)
        seen.cameras = _cameras(cameras, self.workspace)
        seen.reference_points_px = tuple(seen._references(camera) for camera in seen.cameras)
        seen._views = seen._renderers()
        return seen

    def _renderers(self) -> tuple[ViewRenderer, ...]:
        return tuple(
            ViewRenderer(camera, self._table, self.background, self.lighting, self.sensor)
            for camera in self.cameras
        )

    def render(
        self,
        motion: Motion | None,
        *,
        time_s: float = 0.0,
        rng: np.random.Generator | int | None = None,
        device: PointingDevice | None = None,
        others: Sequence[tuple[PointingDevice, Motion]] = (),
        occluders: Sequence[Sequence[Occluder]] | None = None,
        quantise: bool = True,
        mirrored: bool = False,
    ) -> SimulatedFrame:
        """Take one picture per view.

        Parameters
        ----------
        motion
            A pose, a trajectory, or anything with `pose_at`; None shows the table alone.
        time_s
            The rig's time [s]; each view adds its own skew.
        rng
            Source of the noise, or its seed. Required unless the sensor has no noise.
        device
            The pointing device; default: the rig's.
        others
            More devices in the picture, each with its own motion, such as a second hand.
        occluders
            Discs in front of everything, one sequence per view (see `occluders`).
        quantise
            False returns float32 grey levels, noise included, neither rounded nor clipped.
        mirrored
            Whether to invert the sign of all noise, so that its linear effects cancel in the mean
            over both pictures.

        Returns
        -------
        SimulatedFrame
            The pictures and their truth, reproducible to the last bit.
        """
        time = checks.number("time_s", time_s, -1e6, 1e6)
        noise = -self.sensor.noise if mirrored else self.sensor.noise
        draw = None if noise == 0 else checks.generator("rng", rng)
        covers = [()] * len(self.cameras) if occluders is None else occluders
        if len(covers) != len(self.cameras):
            raise InvalidInputError(
                f"occluders has {len(covers)} entries; it must have one for each of the "
                f"{len(self.cameras)} views"
            )
        body = _body_of(device or self.device)
        actors = [(body, motion)] if motion is not None else []
        actors += [(_body_of(other), its_motion) for other, its_motion in others]
        images = []
        for view, discs in zip(self._views, covers, strict=True):
            view_time = time + view.camera.time_skew_s
            change = self.lighting.change
            gain = 1.0 if change is None else change.gain_at(view_time)
            light = view.light(self._moments(view, actors, view_time), discs, gain)
            images.append(sensed(light, noise, draw, quantise=quantise))
        return SimulatedFrame(tuple(images), self.truth(motion, time_s=time, device=device))

    def truth(
        self, motion: Motion | None, *, time_s: float = 0.0, device: PointingDevice | None = None
    ) -> FrameTruth:
        """Return the ground truth of a frame, without rendering pictures."""
        time = checks.number("time_s", time_s, -1e6, 1e6)
        body = _body_of(device or self.device)
        pose = _pose_at(motion, time)
        views = []
        for camera in self.cameras:
            view_time = time + camera.time_skew_s
            view_pose = _pose_at(motion, view_time)
            views.append(view_truth(camera, self.plane_points, body, view_pose, view_time))
        return FrameTruth(time, pose, None if pose is None else pose.indicated_mm, tuple(views))

    def occluders(
        self,
        pose: DevicePose,
        fraction: float,
        rng: np.random.Generator | int,
        *,
        device: PointingDevice | None = None,
        levels: tuple[float, float] = (20.0, 235.0),
    ) -> tuple[tuple[Occluder, ...], ...]:
        """Discs that cover a fraction of the contour of finger and thumb in every view.

        Parameters
        ----------
        pose
            Pose of the device; the discs do not move with it later.
        fraction
            Fraction of the contour's length in each view, 0 to 0.9.
        rng
            Source of positions, sizes and levels of the discs, or its seed.
        device
            The pointing device; default: the rig's.
        levels
            Range of the discs' grey levels.

        Returns
        -------
        tuple
            One tuple of occluders per view, for `render`.
        """
        checks.number("fraction", fraction, 0, 0.9)
        checks.interval("levels", levels, 0, 255)
        draw = checks.generator("rng", rng)
        body = _body_of(device or self.device)
        checks.instance("pose", pose, DevicePose)
        return tuple(
            occluders_on(camera, body, pose, fraction, levels, draw) for camera in self.cameras
        )

    def _references(self, camera: Camera) -> Array:
        pictured = camera.pictured(camera.project(np.pad(self.plane_points, ((0, 0), (0, 1)))))
        if not np.isfinite(pictured).all():
            place = int(np.argwhere(~np.isfinite(pictured))[0, 0])
            raise InvalidInputError(
                f"reference point {place} at {self.plane_points[place].tolist()} mm is behind the "
                f"camera {camera.name!r} or outside what its lens images; move the camera away"
            )
        return pictured

    def _moments(
        self, view: ViewRenderer, actors: Sequence[tuple[Body, Motion]], time_s: float
    ) -> list[list[Placed]]:
        """All devices at each sub-exposure around the middle of the exposure."""
        exposure = self.sensor.exposure_s
        count = 1
        if exposure:
            ends = [_placed(actors, time_s + side * exposure / 2) for side in (-1, 1)]
            if len(ends[0]) == len(ends[1]):
                count = view.exposures(*ends)
        offsets = ((np.arange(count) + 0.5) / count - 0.5) * exposure
        return [_placed(actors, time_s + float(offset)) for offset in offsets]


def _placed(actors: Sequence[tuple[Body, Motion]], time_s: float) -> list[Placed]:
    placed = []
    for body, motion in actors:
        pose = _pose_at(motion, time_s)
        if pose is not None:
            placed.append(Placed.of(body, pose.world_from_device))
    return placed


def _pose_at(motion: Motion | None, time_s: float) -> DevicePose | None:
    if motion is None:
        return None
    if not callable(getattr(motion, "pose_at", None)):
        raise InvalidInputError(
            f"motion is {motion!r}; it must be a DevicePose, a Trajectory or None"
        )
    return motion.pose_at(time_s)


def _body_of(device: PointingDevice) -> Body:
    body = getattr(device, "body", None)
    if not isinstance(body, Body):
        raise InvalidInputError(
            f"device is {device!r}; it must be a RodAndProng, a Hand or the like"
        )
    return body


def _cameras(given: Placement | Sequence[Camera], workspace: Workspace) -> tuple[Camera, ...]:
    if isinstance(given, Placement):
        return given.cameras(workspace)
    if not isinstance(given, Sequence) or not all(isinstance(one, Camera) for one in given):
        raise InvalidInputError(f"cameras is {given!r}; it must be a Placement or a list of Camera")
    names = [camera.name for camera in given]
    if len(set(names)) < len(names):
        raise InvalidInputError(f"cameras are named {names}; every name must be unique")
    return tuple(given)
