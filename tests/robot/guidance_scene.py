"""A rendered scene to estimate the robot's plane from: table, two cameras, an arm's gripper."""

from __future__ import annotations

import math
import threading
import time

import cv2
import numpy as np
from robot_rig import ManualClock

from fingerpost.capture import Frame
from fingerpost.config import Plane, Rig, RobotTable, View
from fingerpost.simulate import DevicePose, RodAndProng, SimulatedRig

# The robot stands beside the table, rotated about the vertical: world (mm) from robot frame (m).
TURN_RAD = math.radians(20.0)
ROBOT_ORIGIN_MM = np.array([-250.0, 60.0, 0.0])

REGION_M = ((0.34, -0.02), (0.52, -0.02), (0.52, 0.2), (0.34, 0.2))
Z_M = (0.005, 0.25)
HEIGHT_M = 0.02

# Two cameras that project any world point, of a marker or of a gripper.
RIG = SimulatedRig()
NAMES = ("left", "right")
NOWHERE_PX = ((0.0, 0.0), (100.0, 0.0), (100.0, 100.0), (0.0, 100.0))
GRIPPER = RodAndProng(length_mm=250.0, diameter_mm=8.0, prong_length_mm=0.0)

# A marker on a plate that stands on the gripper's tip and faces the cameras; in robot metres.
MARKER_SIDE_M = 0.04
TILT_RAD = math.radians(40.0)


def table(**changes) -> RobotTable:
    """Return the [robot] table of a rig file."""
    fields = {"url": "sim://", "height_m": HEIGHT_M, "region_m": REGION_M, "z_m": Z_M}
    return RobotTable(**{**fields, **changes})


def cameras() -> Rig:
    """Return a rig whose plane is not yet defined."""
    return Rig(
        plane=Plane(unit="mm", points=NOWHERE_PX),
        views=tuple(
            View(name=name, source=k, reference_points_px=NOWHERE_PX)
            for k, name in enumerate(NAMES)
        ),
    )


def world_mm(position_m) -> np.ndarray:
    """Transform points of the robot's frame (..., 3) [m] to the world [mm]."""
    c, s = math.cos(TURN_RAD), math.sin(TURN_RAD)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return ROBOT_ORIGIN_MM + 1000.0 * np.asarray(position_m) @ R.T


def pixel(view: int, position_m) -> np.ndarray:
    """Project points of the robot's frame into a view [px]."""
    return RIG.cameras[view].project(world_mm(position_m))


def draw_gripper(position_m, rng=None) -> list[np.ndarray]:
    """Render both views with a vertical rod whose tip is at a point of the robot's frame."""
    pose = DevicePose(tuple(world_mm(position_m)), azimuth_deg=0.0, slant_deg=89.0)
    return list(RIG.render(pose, rng=rng, device=GRIPPER).images)


def draw_marker(position_m, *, centre_m=(0.0, 0.0, 0.0), tilt_rad=TILT_RAD) -> list:
    """Render both views with a marker, its centre offset from the gripper's tip by `centre_m`."""
    marker = cv2.aruco.generateImageMarker(
        cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50), 3, 60
    )
    plate = np.full((90, 90), 255, np.uint8)
    plate[15:75, 15:75] = marker
    images = []
    for view, camera in enumerate(RIG.cameras):
        corners = pixel(view, np.asarray(position_m) + marker_corners(1.5, tilt_rad) + centre_m)
        # Pixel centres at integers: the plate's corners lie half a pixel outside its corner pixels.
        plate_px = np.array([[-0.5, -0.5], [89.5, -0.5], [89.5, 89.5], [-0.5, 89.5]])
        first = np.clip(np.floor(corners.min(axis=0)) - 8, 0, None).astype(int)
        last = np.minimum(corners.max(axis=0) + 8, [camera.width_px, camera.height_px]).astype(int)
        image = np.full((camera.height_px, camera.width_px), 90, np.uint8)
        images.append(image)
        if (last <= first).any():
            continue  # outside the image
        scale = 4
        fine = scale * (corners - first + 0.5) - 0.5
        H = cv2.getPerspectiveTransform(plate_px.astype(np.float32), fine.astype(np.float32))
        width, height = last - first
        size = (int(scale * width), int(scale * height))
        drawn = cv2.warpPerspective(plate, H, size, flags=cv2.INTER_LINEAR, borderValue=90)
        small = cv2.resize(drawn, (int(width), int(height)), interpolation=cv2.INTER_AREA)
        blurred = cv2.GaussianBlur(small, (0, 0), 0.8)
        image[first[1] : last[1], first[0] : last[0]] = blurred
    return images


def marker_corners(size=1.0, tilt_rad=TILT_RAD) -> np.ndarray:
    """Return the marker's corners relative to its centre, in OpenCV's order and robot axes [m].

    The marker is tilted back from the vertical and faces the world's negative Y, where the cameras
    are.
    """
    c, s = math.cos(-TURN_RAD), math.sin(-TURN_RAD)
    right = np.array([c, s, 0.0])
    down = np.array([[c, -s], [s, c]]) @ np.array([0.0, -math.sin(tilt_rad)])
    down = np.array([*down, -math.cos(tilt_rad)])
    half = size * MARKER_SIDE_M / 2
    return half * np.array([-right - down, right - down, right + down, -right + down])


class DrawnViews:
    """The views of a rig; every reading renders the scene at the robot's present position."""

    def __init__(self, robot, clock, draw, *, rng=None, step_s=1 / 30):
        self.robot = robot
        self.clock = clock
        self.draw = draw
        self.rng = rng
        self.step_s = step_s
        self.count = 0
        self.spoil = {}  # per visited place, a replacement of the rendered scene

    def __call__(self):
        self.clock.sleep(self.step_s)
        position = np.array(self.robot.position[:3])
        self.count += 1
        return [
            Frame(self.count, self.clock(), image) for image in self.draw(position, rng=self.rng)
        ]


class LockstepClock(ManualClock):
    """A clock that only the main thread advances; other threads wait for it."""

    def __init__(self):
        super().__init__()
        self.changed = threading.Condition()

    def sleep(self, span_s):
        if threading.current_thread() is threading.main_thread():
            with self.changed:
                super().sleep(span_s)
                self.changed.notify_all()
            time.sleep(0)  # let the waiting threads run
            return
        end_s = self.now_s + span_s
        with self.changed:
            assert self.changed.wait_for(lambda: self.now_s >= end_s, timeout=20.0)
