"""Shape and whereabouts of an arm, compared with the emulated Scorbot's kinematics."""

import math
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from robot_rig import over_table

from fingerpost.robot import Limits, Pose, RobotPlane
from fingerpost.robot.emulator.acl import (
    BASE_HEIGHT_MM,
    FOREARM_MM,
    JOINT_LIMITS_RAD,
    SHOULDER_OFFSET_MM,
    UPPER_ARM_MM,
    forward,
    inverse,
)
from fingerpost.robot.scorbot import SCORBOT_ER7_SHAPE
from fingerpost.robot.shape import STEP_M, ArmShape, along
from fingerpost.robot.whereabouts import Whereabouts


def joints_m(joints_rad):
    """Return shoulder, elbow and wrist of the emulated arm [m]."""
    base, shoulder, elbow = joints_rad[:3]
    radius, height = SHOULDER_OFFSET_MM, BASE_HEIGHT_MM
    places = [(radius, height)]
    for length, angle in ((UPPER_ARM_MM, shoulder), (FOREARM_MM, shoulder + elbow)):
        radius += length * math.cos(angle)
        height += length * math.sin(angle)
        places.append((radius, height))
    return np.array([[r * math.cos(base), r * math.sin(base), z] for r, z in places]) / 1000


@pytest.mark.parametrize("seed", range(20))
def test_the_links_meet_at_the_scorbots_joints(seed):
    rng = np.random.default_rng(seed)
    while True:
        joints = rng.uniform(*JOINT_LIMITS_RAD.T)
        units = forward(joints)
        x, y, z = units[:3] / 1e4
        again = inverse(units)  # only joints with the elbow up and no reach behind the base
        if again is not None and np.allclose(again, joints, atol=1e-6):
            break
    pitch, roll = np.radians(units[3:] / 10)
    pose = Pose(float(x), float(y), float(z), pitch_rad=float(pitch), roll_rad=float(roll))
    gripper, tool, forearm, upper_arm, column = SCORBOT_ER7_SHAPE.capsules(pose)
    shoulder, elbow, wrist = joints_m(joints)
    np.testing.assert_allclose(tool.end, wrist, atol=1e-6)
    np.testing.assert_allclose(forearm.start, wrist, atol=1e-6)
    np.testing.assert_allclose(forearm.end, elbow, atol=1e-6)
    np.testing.assert_allclose(upper_arm.end, shoulder, atol=1e-6)
    assert column.end == (0.0, 0.0, 0.0)
    assert gripper.distance(pose.position_m) < gripper.radius


def test_a_wrist_out_of_reach_still_has_all_links():
    links = ArmShape.of_limits(None).capsules(Pose(5.0, 0.0, 0.1))
    assert all(np.isfinite([*part.start, *part.end]).all() for part in links)
    for first, second in pairwise(links[1:]):
        assert first.end == second.start


def test_the_default_shape_reaches_its_limits():
    limits = Limits(lower_m=(-0.3, -0.4, 0.0), upper_m=(0.3, 0.4, 0.3), max_speed_m_s=0.1)
    shape = ArmShape.of_limits(limits)
    assert shape.upper_arm_m + shape.forearm_m == pytest.approx(0.5)


def test_the_path_between_poses_has_no_gaps():
    poses = list(along([over_table(0.4, 0.0), over_table(0.4, 0.2), over_table(0.5, 0.2)]))
    steps = [a.distance_m(b) for a, b in pairwise(poses)]
    assert max(steps) <= STEP_M + 1e-9
    assert poses[0].y_m == 0.0
    assert poses[-1].x_m == pytest.approx(0.5)


class ShapeOnly:
    """A robot reduced to its shape, and to the readings of its driver."""

    shape = SCORBOT_ER7_SHAPE
    limits = None
    reading = None

    def status(self):
        return SimpleNamespace(pose=self.reading)


def covers(whereabouts, x_m, y_m):
    """Return whether the gripper may be 0.1 m above a place."""
    point = np.array([x_m, y_m, 0.1])
    return any(part.distance(point) <= part.radius for part in whereabouts.body())


def test_the_arm_may_be_anywhere_from_its_last_reading_to_its_goal():
    arm = Whereabouts(ShapeOnly(), RobotPlane.same(0.0))
    assert arm.body() == ()
    arm.read(over_table(0.4, -0.2), moving=False)
    assert covers(arm, 0.4, -0.2)
    assert not covers(arm, 0.4, 0.0)
    arm.sent(over_table(0.4, 0.2))
    assert arm.is_doubtful
    assert all(covers(arm, 0.4, y_m) for y_m in np.linspace(-0.2, 0.2, 21))
    arm.read(over_table(0.4, 0.1), moving=True)
    assert covers(arm, 0.4, 0.2)
    assert not covers(arm, 0.4, -0.1)
    arm.arrived()
    assert not arm.is_doubtful
    assert covers(arm, 0.4, 0.2)
    assert not covers(arm, 0.4, 0.1)


def test_a_stopped_arm_is_at_its_last_reading():
    arm = Whereabouts(ShapeOnly(), RobotPlane.same(0.0))
    arm.read(over_table(0.4, -0.2), moving=False)
    arm.sent(over_table(0.4, 0.2))
    arm.read(over_table(0.4, -0.1), moving=False)
    assert not covers(arm, 0.4, 0.1)
    assert covers(arm, 0.4, -0.1)


def test_what_the_driver_has_read_since_shortens_the_path():
    robot = ShapeOnly()
    arm = Whereabouts(robot, RobotPlane.same(0.0))
    arm.read(over_table(0.4, -0.2), moving=False)
    robot.reading = over_table(0.4, 0.3)  # of an earlier motion
    arm.sent(over_table(0.4, 0.2))
    for y_m, from_m in ((-0.2, -0.2), (-0.1, -0.2), (-0.05, -0.1), (0.05, -0.05)):
        robot.reading = over_table(0.4, y_m)
        for _ in range(3):  # frames between two readings
            assert all(covers(arm, 0.4, y) for y in np.linspace(from_m, 0.2, 21))
            assert not covers(arm, 0.4, from_m - 0.1)
    arm.sent(over_table(0.5, 0.2))  # the readings may date from the motion before
    assert covers(arm, 0.4, -0.2)
    arm.arrived()
    assert not covers(arm, 0.4, 0.05)


def test_a_plug_in_without_a_status_is_anywhere_on_its_path():
    robot = ShapeOnly()
    robot.status = None
    arm = Whereabouts(robot, RobotPlane.same(0.0))
    arm.read(over_table(0.4, -0.2), moving=False)
    arm.sent(over_table(0.4, 0.2))
    assert all(covers(arm, 0.4, y_m) for y_m in np.linspace(-0.2, 0.2, 21))


def test_capsules_in_plane_units():
    plane = RobotPlane.same(0.05, unit_m=0.001)
    (part,) = plane.capsules([SCORBOT_ER7_SHAPE.capsules(over_table(0.4, 0.1, 0.15))[0]])
    assert part.radius == pytest.approx(1000 * SCORBOT_ER7_SHAPE.gripper_radius_m)
    assert part.start[:2] == pytest.approx((400.0, 100.0))
    assert part.start[2] == pytest.approx(120.0)  # 20 mm above the working point, over the plane
