"""The robot cell with physics: an emulated controller drives MuJoCo's arm, seen by cameras.

The controller's commands become the set points of the joints' motors, step by step; the position
that it reports to the driver is that of the encoders of the arm that follows them. A block is
lifted only by friction between the fingers.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from fingerpost.closed_loop.engine import new_renderer, require_mujoco
from fingerpost.closed_loop.scene import CARD_GROUP, build_model, quaternion
from fingerpost.robot.emulator.acl import (
    PARKED_JOINTS_RAD,
    AclController,
    AclStyle,
)
from fingerpost.simulate import Body, Camera, DevicePose

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

ARM_JOINTS = ("base", "shoulder", "elbow", "pitch", "roll")
JAW_M = 0.035
"""Travel of each finger from closed to fully open [m]."""

JAW_SPEED_M_S = 0.05
"""Speed of each finger [m/s]; from fully open to closed in 0.7 s."""

BLOCK_MM = 30.0
HOMING_S = 3.0
"""Duration of homing [s]: much shorter than a Scorbot's, to save time."""

# Kinds of geoms; the sum of any two is unique.
TABLE, BLOCK, PAD, ARM = 1, 2, 5, 10


@dataclass(frozen=True)
class Optics:
    """Blur, noise and rendering options of the cameras."""

    blur_px: float = 0.8  # px, sigma of the point spread function
    noise: float = 2.0  # grey levels, sigma of white noise
    # Rendered samples per pixel, 0 or 4. Four take three times as long and look better, but after
    # the blur do not improve tracking.
    samples: int = 0
    shadows: bool = False  # whether the lamp casts shadows, which takes even longer


@dataclass(slots=True)
class Contacts:
    """Contacts during the whole session."""

    table_steps: int = 0
    """Steps of the physics in which the arm touched the table."""
    table_n: float = 0.0
    """Greatest force of such a contact [N]."""
    gripped: bool = False
    """Whether both fingers hold the block now."""


class PhysicalCell:
    """The cell.

    Parameters
    ----------
    cameras
        Pinhole cameras [mm].
    hand
        Shape of the pointing hand.
    optics
        Optics of the cameras.
    rng
        Random numbers of their noise.

    Attributes
    ----------
    controller : AclController
        The controller, to be connected to a port.
    contacts : Contacts
        Contacts of arm, block and table.
    shows_card : bool
        Whether the gripper holds the card that defines the plane.
    """

    def __init__(
        self,
        cameras: Sequence[Camera],
        hand: Body,
        *,
        rng: np.random.Generator,
        optics: Optics | None = None,
    ) -> None:
        self._mujoco = mujoco = require_mujoco()
        self._cameras = tuple(cameras)
        self._optics = optics = optics or Optics()
        self._model = model = build_model(
            cameras, hand, samples=optics.samples, shadows=optics.shadows
        )
        self._data = mujoco.MjData(model)
        self._noise = _NoiseField(optics.noise, self._cameras[0], rng)
        self._renderer: Any = None
        self._arm_qpos = np.array([model.joint(name).qposadr[0] for name in ARM_JOINTS])
        self._jaw_ctrl = model.actuator("jaw").id
        self._tool = model.site("tool").id
        self._block = model.body("block").id
        self._block_qpos = int(model.jnt_qposadr[model.body_jntadr[self._block]])
        self._kinds = _kinds(model)
        self._view = mujoco.MjvOption()
        self.contacts = Contacts()
        self.shows_card = False
        self.controller = AclController(AclStyle(homing_s=HOMING_S), encoders=self._encoders)
        self._data.qpos[self._arm_qpos] = PARKED_JOINTS_RAD
        self._data.ctrl[: len(ARM_JOINTS)] = PARKED_JOINTS_RAD
        for finger in ("left", "right"):
            self._data.qpos[model.joint(finger).qposadr[0]] = JAW_M
        self._data.ctrl[self._jaw_ctrl] = JAW_M
        mujoco.mj_forward(model, self._data)

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """The cameras."""
        return self._cameras

    @property
    def time_s(self) -> float:
        """The world's time [s]."""
        return float(self._data.time)

    @property
    def gripper_mm(self) -> Array:
        """(3,) True position of the gripper's working point [mm]."""
        return np.asarray(1000 * self._data.site_xpos[self._tool])

    @property
    def jaw(self) -> float:
        """Opening of the gripper: 0 closed … 1 open."""
        return float(self._data.qpos[self._model.joint("left").qposadr[0]]) / JAW_M

    @property
    def block_mm(self) -> Array:
        """(3,) centre of the block [mm]."""
        return np.asarray(1000 * self._data.xpos[self._block])

    @property
    def block_turn_rad(self) -> float:
        """Rotation of the block about the vertical [rad]."""
        rotation = self._data.xmat[self._block]
        return math.atan2(rotation[3], rotation[0])

    def put_block(self, point_mm: tuple[float, float], turn_rad: float) -> None:
        """Place the block on the table.

        Parameters
        ----------
        point_mm
            Position of its middle [mm].
        turn_rad
            Rotation about the vertical.
        """
        at = self._block_qpos
        self._data.qpos[at : at + 3] = [point_mm[0] / 1000, point_mm[1] / 1000, BLOCK_MM / 2000]
        self._data.qpos[at + 3 : at + 7] = [np.cos(turn_rad / 2), 0, 0, np.sin(turn_rad / 2)]
        self._mujoco.mj_forward(self._model, self._data)

    def put_arm(self, joints_rad: Array) -> None:
        """Set the arm to joint angles (5,) [rad] at once, independently of its controller."""
        self._data.qpos[self._arm_qpos] = joints_rad
        self._mujoco.mj_forward(self._model, self._data)

    def oil_the_pads(self) -> None:
        """Remove all friction from the fingers."""
        self._model.geom_friction[self._kinds == PAD] = 1e-5

    def put_hand(self, pose: DevicePose | None) -> None:
        """Move the hand; None removes it."""
        if pose is None:
            self._data.mocap_pos[0] = [0, 0, -5]
            return
        matrix = pose.world_from_device
        self._data.mocap_pos[0] = matrix[:, 3] / 1000
        self._data.mocap_quat[0] = quaternion(matrix[:, :3])

    def step_to(self, time_s: float) -> None:
        """Run the physics up to a time [s], to the nearest step."""
        step_s = self._model.opt.timestep
        for _ in range(round((time_s - self.time_s) / step_s)):
            self._command(step_s)
            self._mujoco.mj_step(self._model, self._data)
            self._look_at_contacts()

    def picture(self) -> tuple[Image, ...]:
        """Take a picture with every camera: (height, width, 3) blue-green-red."""
        renderer = self._opened_renderer()
        # The hand moves between steps; update its frame, and those of lights and cameras.
        self._mujoco.mj_kinematics(self._model, self._data)
        self._view.geomgroup[CARD_GROUP] = self.shows_card
        images = []
        for camera in self._cameras:
            renderer.update_scene(self._data, camera.name, self._view)
            image = cv2.cvtColor(renderer.render(), cv2.COLOR_RGB2BGR)
            images.append(self._noise.added(self._blurred(image)))
        return tuple(images)

    def close(self) -> None:
        """Release the renderer; harmless when closed."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _opened_renderer(self) -> Any:
        if self._renderer is None:
            camera = self._cameras[0]
            self._renderer = new_renderer(self._model, camera.width_px, camera.height_px)
        return self._renderer

    def _blurred(self, image: Any) -> Any:
        if self._optics.blur_px == 0:
            return image
        return cv2.GaussianBlur(image, (0, 0), self._optics.blur_px)

    def _encoders(self) -> Array:
        return np.array(self._data.qpos[self._arm_qpos])

    def _command(self, step_s: float) -> None:
        """Set the motors' set points to the controller's command at the end of the step."""
        now_s = self.time_s + step_s
        self._data.ctrl[: len(ARM_JOINTS)] = self.controller.commanded_rad(now_s)
        goal = JAW_M * self.controller.jaw_percent / 100
        way = goal - self._data.ctrl[self._jaw_ctrl]
        most = JAW_SPEED_M_S * step_s
        self._data.ctrl[self._jaw_ctrl] += min(max(way, -most), most)

    def _look_at_contacts(self) -> None:
        pairs = self._kinds[self._data.contact.geom[: self._data.ncon]]
        sums = pairs.sum(axis=1)
        touching = np.flatnonzero((sums == ARM + TABLE) | (sums == PAD + TABLE))
        for contact in touching:
            force = np.zeros(6)
            self._mujoco.mj_contactForce(self._model, self._data, int(contact), force)
            self.contacts.table_n = max(self.contacts.table_n, float(force[0]))
        self.contacts.table_steps += bool(len(touching))
        gripping = self._data.contact.geom[: self._data.ncon][sums == PAD + BLOCK]
        self.contacts.gripped = len(np.unique(gripping)) == 3  # two pads and the block


class _NoiseField:
    """White noise, generated once and sampled at a new offset for every picture, for speed."""

    MARGIN_PX = 64

    def __init__(self, sigma: float, camera: Camera, rng: np.random.Generator) -> None:
        shape = (camera.height_px + self.MARGIN_PX, camera.width_px + self.MARGIN_PX, 3)
        self._field = np.rint(rng.normal(0.0, sigma, shape)).astype(np.int16)
        self._size = camera.height_px, camera.width_px
        self._rng = rng

    def added(self, image: Any) -> Image:
        """Return an image with noise."""
        down, right = self._rng.integers(0, self.MARGIN_PX, 2)
        height, width = self._size
        noise = self._field[down : down + height, right : right + width]
        if self._rng.random() < 0.5:
            noise = -noise
        return np.asarray(cv2.add(image, noise, dtype=cv2.CV_8U))


def _kinds(model: Any) -> NDArray[np.int64]:
    """Return the kind of each geom: `TABLE`, `BLOCK`, `PAD`, `ARM` or 0."""
    kinds = np.zeros(model.ngeom, np.int64)
    first_of_arm = model.body("waist").id
    for geom in range(model.ngeom):
        name, body = model.geom(geom).name, model.geom_bodyid[geom]
        if name in ("table", "block"):
            kinds[geom] = TABLE if name == "table" else BLOCK
        elif name.endswith("_pad"):
            kinds[geom] = PAD
        elif model.body_rootid[body] == model.body_rootid[first_of_arm] and body >= first_of_arm:
            kinds[geom] = ARM
    return kinds
