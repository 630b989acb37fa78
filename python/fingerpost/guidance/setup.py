"""Makes a guarded robot from the [robot] table of a rig file."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from fingerpost.config import Rig, RobotTable
from fingerpost.errors import RigError
from fingerpost.robot import (
    TOOL_DOWN_RAD,
    Angle,
    Guard,
    GuardOptions,
    Pose,
    Robot,
    RobotPlane,
    SafeRegion,
)
from fingerpost.robot.guard import RecordCallback


def robot_of(rig: Rig) -> RobotTable:
    """Return the [robot] table of a rig.

    Raises
    ------
    RigError
        It has no robot, or the unit of its plane is not the metre.
    """
    if rig.robot is None:
        raise RigError(
            "the rig has no [robot] table: `fingerpost robot plane` writes a rig that has one"
        )
    if rig.plane.unit != "m":
        raise RigError(
            f'plane.unit is "{rig.plane.unit}"; a rig with a [robot] table has the robot\'s own X '
            'and Y in metres as its plane coordinates, and "m" there'
        )
    return rig.robot


def plane_of(robot: RobotTable) -> RobotPlane:
    """Return the plane of a [robot] table: its coordinates are the robot's own X and Y [m]."""
    pitch_rad, roll_rad, yaw_rad = (
        None if degrees is None else math.radians(degrees)
        for degrees in (robot.pitch_deg, robot.roll_deg, robot.yaw_deg)
    )
    return replace(
        RobotPlane.same(robot.height_m), pitch_rad=pitch_rad, roll_rad=roll_rad, yaw_rad=yaw_rad
    )


def region_of(robot: RobotTable) -> SafeRegion:
    """Return the safe region of a [robot] table.

    Raises
    ------
    InvalidInputError
        Its corners are not a convex polygon.
    """
    lowest_m, highest_m = robot.z_m
    return SafeRegion(
        np.array(robot.region_m), lowest_m - robot.height_m, highest_m - robot.height_m
    )


def guard_of(
    robot: Robot,
    table: RobotTable,
    options: GuardOptions | None = None,
    *,
    clock: Callable[[], float] = time.monotonic,
    on_record: RecordCallback | None = None,
) -> Guard:
    """Return the guard of a robot over the plane and the safe region of a [robot] table.

    Parameters
    ----------
    robot
        The robot, connected before the guard is armed.
    table
        Plane, region, and orientation of the gripper.
    options, clock, on_record
        As in `fingerpost.robot.Guard`.

    Raises
    ------
    InvalidInputError
        An invalid region, or one that is too small.
    """
    return Guard(
        robot, plane_of(table), region_of(table), options, clock=clock, on_record=on_record
    )


def held_down(robot: Robot, pose: Pose) -> dict[str, float]:
    """Return the angles at which a gripper points straight down, for a [robot] table.

    Parameters
    ----------
    robot
        The robot, which knows the angles that it can set.
    pose
        Its present pose; roll and yaw are kept.

    Returns
    -------
    dict
        `pitch_deg` and the other angles of the arm; empty for an arm whose gripper always points
        down.
    """
    limits = robot.limits
    if limits is None or Angle.PITCH not in limits.angles:
        return {}
    angles = {"pitch_deg": math.degrees(TOOL_DOWN_RAD)}
    for angle, key, now in (
        (Angle.ROLL, "roll_deg", pose.roll_rad),
        (Angle.YAW, "yaw_deg", pose.yaw_rad),
    ):
        if angle in limits.angles:
            angles[key] = math.degrees(now or 0.0)
    return angles
