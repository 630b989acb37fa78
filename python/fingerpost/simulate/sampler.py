"""Random poses of a pointing device over the workspace."""

from dataclasses import dataclass

import numpy as np

from fingerpost.errors import InvalidInputError
from fingerpost.simulate import checks
from fingerpost.simulate.device import PointingDevice
from fingerpost.simulate.pose import DevicePose
from fingerpost.simulate.rig import SimulatedRig

# Number of poses tried for a target before it is given up.
DRAWS_PER_TARGET = 100
MOST_TARGETS = 50


@dataclass(frozen=True)
class PoseLimits:
    """Ranges from which poses are drawn, each uniformly; equal ends fix a value."""

    hover_mm: tuple[float, float] = (50.0, 250.0)  # mm, height of the tip, 1…1000
    slant_deg: tuple[float, float] = (25.0, 65.0)  # deg below the horizontal, 1…89
    azimuth_deg: tuple[float, float] = (-100.0, 100.0)  # deg from "towards the cameras", −180…180
    roll_deg: tuple[float, float] = (0.0, 0.0)  # deg, −90…90
    view_ray_deg: float = 25.0  # deg, least angle between finger and view ray in any view, 0…89
    border_px: float = 6.0  # px that finger and thumb keep from the image border, 0…1000

    def __post_init__(self) -> None:
        checks.interval("hover_mm", self.hover_mm, 1, 1000)
        checks.interval("slant_deg", self.slant_deg, 1, 89)
        checks.interval("azimuth_deg", self.azimuth_deg, -180, 180)
        checks.interval("roll_deg", self.roll_deg, -90, 90)
        checks.number("view_ray_deg", self.view_ray_deg, 0, 89)
        checks.number("border_px", self.border_px, 0, 1000)


class PoseSampler:
    """Draws poses that point at a random place in the workspace and are well visible in all views.

    Targets are uniform over the workspace. For each, hover, slant, azimuth and roll are drawn,
    uniform in their limits, until no camera sees the finger nearly end-on and finger and thumb are
    inside every image: near the borders of the images the distribution is not uniform (first, high
    hands over the far edge of the workspace are missing).

    Parameters
    ----------
    rig
        Cameras, workspace and, unless `draw` is given another, the device.
    limits
        Ranges and conditions.
    """

    def __init__(self, rig: SimulatedRig, limits: PoseLimits | None = None) -> None:
        self.rig = rig
        self.limits = limits or PoseLimits()
        outwards = np.mean([camera.centre_mm[:2] for camera in rig.cameras], axis=0)
        outwards = outwards - rig.workspace.side_mm / 2
        # If the cameras are straight above, every direction is towards them.
        self._towards_deg = (
            float(np.degrees(np.arctan2(outwards[0], -outwards[1])))
            if np.linalg.norm(outwards) > 1e-6
            else 0.0
        )

    def draw(
        self, rng: np.random.Generator | int, *, device: PointingDevice | None = None
    ) -> DevicePose:
        """Draw one pose.

        Raises
        ------
        InvalidInputError
            None of many draws is acceptable.
        """
        generator = checks.generator("rng", rng)
        device = device or self.rig.device
        limits = self.limits
        for _ in range(MOST_TARGETS):
            target = generator.uniform(0, self.rig.workspace.side_mm, 2)
            for _ in range(DRAWS_PER_TARGET):
                azimuth = self._towards_deg + generator.uniform(*limits.azimuth_deg)
                pose = DevicePose.pointing_at(
                    target,
                    hover_mm=generator.uniform(*limits.hover_mm),
                    slant_deg=generator.uniform(*limits.slant_deg),
                    azimuth_deg=(azimuth + 180) % 360 - 180,
                    roll_deg=generator.uniform(*limits.roll_deg),
                )
                if self.accepts(pose, device=device):
                    return pose
        raise InvalidInputError(
            f"none of {MOST_TARGETS * DRAWS_PER_TARGET} poses drawn from {limits} is seen well by "
            "every camera; widen the limits or move the cameras"
        )

    def accepts(self, pose: DevicePose, *, device: PointingDevice | None = None) -> bool:
        """Whether finger and thumb are inside every image, and the finger is not seen end-on."""
        body = (device or self.rig.device).body
        ends = [np.zeros(3), np.array(body.root_mm)]
        if body.thumb is not None:
            ends.append(np.array(body.links[body.thumb].end_mm))
        matrix = pose.world_from_device
        points = np.array(ends) @ matrix[:, :3].T + matrix[:, 3]
        radius = body.links[body.finger].start_radius_mm
        for camera in self.rig.cameras:
            ray = points[0] - camera.centre_mm
            cosine = abs(ray @ pose.direction) / np.linalg.norm(ray)
            if cosine > np.cos(np.radians(self.limits.view_ray_deg)):
                return False
            pictured = camera.pictured(camera.project(points))
            around = radius * camera.f_px / np.linalg.norm(ray)
            if not camera.contains(pictured, self.limits.border_px + float(around)).all():
                return False
        return True
