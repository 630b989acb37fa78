"""The robot protocol: poses, limits, orientations, readings, motion, and robots by name."""

import math
import sys
from dataclasses import replace
from importlib.metadata import EntryPoint

import msgspec
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from robot_rig import ManualClock
from scipy.integrate import cumulative_trapezoid
from scipy.spatial.transform import Rotation

from fingerpost.errors import InvalidInputError
from fingerpost.guidance import PlaneOptions
from fingerpost.robot import (
    FollowOptions,
    GuardOptions,
    PickPlaceOptions,
    open_robot,
    registry,
    robot_names,
)
from fingerpost.robot.arm import ArrivalRule
from fingerpost.robot.emulator import make_emulator
from fingerpost.robot.errors import (
    GarbledReplyError,
    GripperError,
    NotReadyError,
    OutOfReachError,
    RobotError,
)
from fingerpost.robot.gcode import GcodeArm
from fingerpost.robot.motion import MotionQueue, Ramp, straight
from fingerpost.robot.orientation import (
    angle_between,
    fixed_angles,
    from_fixed_angles,
    pose_angles,
    rotation_matrix,
    rotation_vector,
    tool_rotation,
)
from fingerpost.robot.protocol import Angle, GripperKind, Limits, Pose, Robot, RobotState
from fingerpost.robot.readings import ReadingFilter
from fingerpost.robot.scorbot import Scorbot, ScorbotOptions
from fingerpost.robot.serial_line import Flow
from fingerpost.robot.simulated import HOME, SIMULATED_LIMITS, SimulatedRobot

ROUNDING_RAD = 1e-6
"""Near half turns and the vertical, the error of an angle is the square root of the rounding."""

angles = st.one_of(
    st.floats(-math.pi, math.pi),
    st.sampled_from([0.0, math.pi / 2, -math.pi / 2, math.pi, -math.pi, 1e-9, math.pi - 1e-9]),
)

BOX = Limits(
    lower_m=(-0.5, -0.5, 0.0),
    upper_m=(0.5, 0.5, 0.5),
    max_speed_m_s=0.2,
    reach_m=0.6,
    min_reach_m=0.1,
    angles=frozenset({Angle.ROLL}),
    gripper=GripperKind.WIDTH,
    gripper_opening_m=0.08,
)


# Poses and limits.


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("field", ["x_m", "y_m", "z_m", "pitch_rad", "roll_rad", "yaw_rad"])
def test_a_pose_must_be_finite(field, value):
    with pytest.raises(InvalidInputError, match=field):
        Pose(**{"x_m": 0.0, "y_m": 0.0, "z_m": 0.0, field: value})


def test_a_pose_prints_and_moves_to_a_height():
    pose = Pose(0.1, -0.2, 0.3, roll_rad=math.pi / 6)
    assert str(pose) == "(0.1000, -0.2000, 0.3000) m roll 30.0°"
    assert pose.at_height(0.5) == Pose(0.1, -0.2, 0.5, roll_rad=math.pi / 6)
    assert pose.distance_m(pose.at_height(0.5)) == pytest.approx(0.2)


@pytest.mark.parametrize(
    ("pose", "words"),
    [
        (Pose(0.6, 0.0, 0.1), "x = 0.6000 m"),
        (Pose(0.3, -0.51, 0.1), "y = -0.5100 m"),
        (Pose(0.3, 0.0, -0.001), "z = -0.0010 m"),
        (Pose(0.49, 0.49, 0.1), "0.6930 m from the base axis"),
        (Pose(0.05, 0.0, 0.1), "0.0500 m from the base axis"),
    ],
)
def test_limits_name_the_coordinate_outside(pose, words):
    with pytest.raises(OutOfReachError, match=words):
        BOX.check(pose)


def test_limits_name_an_angle_that_cannot_be_set():
    BOX.check(Pose(0.3, 0.0, 0.1, roll_rad=0.2))
    with pytest.raises(InvalidInputError, match=r"cannot set pitch_rad.*it sets roll_rad"):
        BOX.check(Pose(0.3, 0.0, 0.1, pitch_rad=0.2))


@pytest.mark.parametrize(
    "change",
    [
        {"lower_m": (0.0, 0.0, 1.0)},
        {"upper_m": (0.5, math.nan, 0.5)},
        {"max_speed_m_s": 0.0},
        {"reach_m": -1.0},
        {"min_reach_m": 0.7},
        {"gripper_opening_m": None},
        {"gripper_opening_m": 0.0},
    ],
)
def test_invalid_limits_are_refused(change):
    fields = {name: getattr(BOX, name) for name in BOX.__dataclass_fields__}
    with pytest.raises(InvalidInputError):
        Limits(**{**fields, **change})


def test_speed_is_clamped_and_must_be_positive():
    assert BOX.speed(None) == 0.2
    assert BOX.speed(5.0) == 0.2
    assert BOX.speed(0.05) == 0.05
    for speed in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(InvalidInputError):
            BOX.speed(speed)


def test_openings_are_fractions_of_the_width():
    assert [BOX.opening(target) for target in ("open", "close", 0.02)] == [1.0, 0.0, 0.25]
    with pytest.raises(InvalidInputError):
        BOX.opening(0.09)
    with pytest.raises(InvalidInputError):
        BOX.opening(math.nan)
    plain = Limits(lower_m=BOX.lower_m, upper_m=BOX.upper_m, max_speed_m_s=0.1)
    with pytest.raises(GripperError):
        plain.opening("open")


# Orientations, against SciPy.


@given(angles, angles, angles)
def test_rotations_agree_with_scipy(a, b, c):
    R = Rotation.from_euler("xyz", [a, b, c]).as_matrix()
    np.testing.assert_allclose(from_fixed_angles(a, b, c), R, atol=1e-12)
    np.testing.assert_allclose(from_fixed_angles(*fixed_angles(R)), R, atol=ROUNDING_RAD)
    vector = rotation_vector(R)
    assert np.linalg.norm(vector) <= math.pi + 1e-12
    np.testing.assert_allclose(Rotation.from_rotvec(vector).as_matrix(), R, atol=1e-9)
    np.testing.assert_allclose(rotation_matrix(vector), R, atol=1e-9)


@given(angles, angles, angles)
def test_angles_of_a_pose_round_trip_as_a_rotation(pitch, roll, yaw):
    R = tool_rotation(pitch, roll, yaw)
    again = tool_rotation(*pose_angles(R))
    assert angle_between(R, again) <= ROUNDING_RAD


@given(angles, st.floats(-1.5, 1.5))
def test_the_tool_points_in_the_direction_of_the_pose(yaw, pitch):
    approach = tool_rotation(pitch, 0.3, yaw)[:, 2]
    azimuth, elevation = math.atan2(approach[1], approach[0]), math.asin(approach[2])
    assert abs(math.remainder(azimuth - yaw, 2 * math.pi)) < 1e-9
    assert elevation == pytest.approx(pitch, abs=1e-9)


def test_a_pose_has_all_angles_or_none():
    assert Pose(0, 0, 0).angles() is None
    assert Pose(0, 0, 0, 0.1, 0.2, 0.3).angles() == (0.1, 0.2, 0.3)
    with pytest.raises(InvalidInputError, match="roll_rad, yaw_rad not given"):
        Pose(0, 0, 0, 0.1).angles()


# Readings.


def reading_filter(speed=10.0, slack=2.0):
    return ReadingFilter(lambda: 0.0, speed, slack)


def take(readings, *values):
    source = iter(values)
    return readings.read(lambda: next(source))


def test_a_reading_counts_only_when_another_agrees():
    readings = reading_filter()
    assert take(readings, (1, 2, 3), (1, 2, 3)) == (1, 2, 3)
    assert take(readings, (1, 2, 3)) == (1, 2, 3)  # unchanged
    assert take(readings, (1, 2, 4), (1, 2, 3)) == (1, 2, 3)
    readings.forget()
    with pytest.raises(StopIteration):
        take(readings, (1, 2, 3))


@given(
    st.lists(st.integers(-5000, 5000), min_size=3, max_size=3, unique=True),
    st.integers(0, 2),
    st.integers(-9999, 9999),
)
def test_one_wrong_reading_of_three_never_leaves_the_arms_path(way, place, noise):
    way = sorted(way)
    wrong = [*way]
    wrong[place] = noise
    assume(len(set(wrong)) == 3)
    believed = take(reading_filter(slack=1e6), *((value, 0, 0) for value in wrong))
    assert way[0] <= believed[0] <= way[2]


def test_readings_further_apart_than_the_arm_can_move_are_refused():
    with pytest.raises(GarbledReplyError, match="disagree"):
        take(reading_filter(slack=20.0), (0, 0, 0), (10, 0, 0), (40, 0, 0))


# Motion.


@given(
    st.one_of(st.sampled_from([0.0, 5e-324]), st.floats(1e-6, 1e3)),
    st.floats(0.1, 1e3),
    st.floats(0.1, 1e4),
)
def test_a_ramp_keeps_its_speed_and_acceleration_and_arrives(length, speed, acceleration):
    ramp = Ramp(length, speed, acceleration)
    times_s = np.linspace(0.0, ramp.duration_s, 2001)
    way = np.array([ramp.at(time_s) for time_s in times_s])
    assert way[0] == pytest.approx(0.0, abs=1e-300)
    assert way[-1] == length
    if length >= 1e-6:
        step_s = times_s[1]
        speeds = np.diff(way) / step_s
        assert speeds.max() <= speed * (1 + 1e-6)
        assert np.abs(np.diff(speeds)).max() / step_s <= acceleration * (1 + 1e-3)
        distance = cumulative_trapezoid(np.append(speeds, 0.0), times_s)[-1]
        assert distance == pytest.approx(length, rel=1e-2, abs=1e-9)


def test_queued_motions_follow_each_other_and_an_abort_drops_them():
    queue = MotionQueue(np.zeros(3))
    for goal in ([1.0, 0.0, 0.0], [1.0, 1.0, 0.0]):
        queue.add(straight(queue.end, np.array(goal), lengths=slice(0, 3)), 1.0, 1e9, 0.0)
    np.testing.assert_allclose(queue.position(0.5), [0.5, 0.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(queue.position(1.25), [1.0, 0.25, 0.0], atol=1e-6)
    queue.abort(1.25)
    np.testing.assert_allclose(queue.position(9.0), [1.0, 0.25, 0.0], atol=1e-6)
    assert not queue.is_moving(9.0)


# Robots by name.


def test_every_built_in_has_a_name():
    assert set(registry.BUILT_IN) <= set(robot_names())
    gcode, streamed = {"uarm", "marlin", "dexarm"}, {"so100", "so101", "rosbridge"}
    assert {"acl", "ur", "xarm", "sim"} | gcode | streamed == set(registry.BUILT_IN)


@pytest.mark.parametrize(
    ("target", "address"),
    [
        ("acl:///dev/ttyUSB0", "/dev/ttyUSB0"),
        ("acl://COM3", "COM3"),
        ("acl+socket://10.0.0.7:4001", "socket://10.0.0.7:4001"),
        ("acl+rfc2217://server:2217", "rfc2217://server:2217"),
    ],
)
def test_a_url_names_robot_and_address(target, address):
    robot = open_robot(target)
    assert isinstance(robot, Scorbot)
    assert isinstance(robot, Robot)
    assert robot._line.url == address
    assert robot.status().state is RobotState.DISCONNECTED


def test_a_url_may_have_options():
    robot = open_robot(
        "acl:///dev/ttyUSB0?flow=xonxoff&baud=19200&lower_m=0.2,-0.3,0.05&upper_m=0.6,0.3,0.4"
    )
    assert robot._options.flow is Flow.XON_XOFF
    assert robot._options.baud == 19200
    assert robot.limits.lower_m == (0.2, -0.3, 0.05)


def test_keyword_options_override_those_of_the_url():
    robot = open_robot("marlin://COM9?gripper_s=3", gripper_s=0.5, address="COM4")
    assert isinstance(robot, GcodeArm)
    assert robot._options.gripper_s == 0.5
    assert robot._line.url == "COM4"


@pytest.mark.parametrize(
    ("target", "words"),
    [
        ("scorbat:///dev/ttyUSB0", "no robot 'scorbat'; there are acl"),
        ("acl:///dev/ttyUSB0?buad=9600", r"unknown field `buad`.*it takes baud"),
        ("acl:///dev/ttyUSB0?baud=fast", "Expected `int`"),
        ("acl:///dev/ttyUSB0?baud=-1", "`baud`|> 0|>= 1"),
        ("acl:///dev/ttyUSB0?flow=maybe", "Invalid enum value 'maybe'"),
        ("acl:///dev/ttyUSB0?lower_m=1,2", "length 3"),
        ("acl:///dev/ttyUSB0?baud", "name=value"),
        ("acl://", r"^acl://: the address is empty; acl:///dev/ttyUSB0"),
        ("acl", r"^acl://: the address is empty"),
        ("acl+socket://host", r"^acl\+socket://host: the port is missing; acl\+socket://host:4001"),
        (
            "acl+socket://:4001",
            r"^acl\+socket://:4001: the host is missing; acl\+socket://host:4001",
        ),
        ("acl+socket://host:99999", r"^acl\+socket://host:99999: '99999' is no port"),
        ("acl+socket://host:0", "'0' is no port"),
        ("acl+socket://host:x", "'x' is no port"),
        ("acl+socket://[::1]", "port is missing"),
        ("acl+socket://host:1/x", "after the port, but /x"),
        (
            "acl+sockt://host:1",
            r"^acl\+sockt://host:1: 'sockt' is no kind.*acl\+socket://host:4001",
        ),
        ("marlin+rfc2217://host", r"^marlin\+rfc2217://host: .*; marlin\+rfc2217://host:4001"),
        ("acl://host:4001", r"^acl://host:4001: a server.*; acl\+socket://host:4001 is right"),
        ("scorbat+socket://host:1", r"^'scorbat\+socket://host:1': there is no robot 'scorbat'"),
        ("my_arm://x", "no robot 'my_arm'; .* acl:///dev/ttyUSB0"),
        ("ur://host/x", "^ur://host/x: a host alone"),
        ("acl:///dev/ttyUSB0?reply_s=inf", "reply_s"),
        ("acl:///dev/ttyUSB0?lower_m=inf,0,0", "lower_m"),
        ("sim://?homing_s=1e308", "homing_s"),
        ("ur://", "ur://10.0.0.5"),
        ("sim://somewhere", "takes no address"),
    ],
)
def test_an_invalid_url_is_refused_in_one_line(target, words):
    with pytest.raises(InvalidInputError, match=words) as caught:
        open_robot(target)
    assert "\n" not in str(caught.value)


def open_arm(address, options):
    """Factory of a plug-in."""
    return SimulatedRobot() if address == "good" else object()


def test_a_plug_in_adds_a_robot(monkeypatch):
    point = EntryPoint("myarm", f"{__name__}:open_arm", registry.ENTRY_POINT_GROUP)
    monkeypatch.setattr(EntryPoint, "load", lambda _: open_arm)
    monkeypatch.setattr(registry, "entry_points", lambda *, group: [point] if group else [])
    assert "myarm" in robot_names()
    assert isinstance(open_robot("myarm://good"), SimulatedRobot)
    with pytest.raises(InvalidInputError, match="object, which is no Robot"):
        open_robot("myarm://bad")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("import no_such_library\n", "ModuleNotFoundError: No module named 'no_such_library'"),
        ("raise RuntimeError('no\\nlicence')\n", "RuntimeError: no licence"),
        ("def open_(\n", "SyntaxError"),
        ("", "has no attribute 'open_arm'"),
        (None, "No module named 'broken_plug_in'"),
    ],
)
def test_an_import_error_of_a_plug_in_is_reported_in_one_line(text, words, tmp_path, monkeypatch):
    if text is not None:
        (tmp_path / "broken_plug_in.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    point = EntryPoint("myarm", "broken_plug_in:open_arm", registry.ENTRY_POINT_GROUP)
    monkeypatch.setattr(registry, "entry_points", lambda *, group: [point] if group else [])
    assert "myarm" in robot_names()
    with pytest.raises(InvalidInputError, match="'myarm', broken_plug_in:open_arm") as refused:
        open_robot("myarm://somewhere")
    assert words in str(refused.value)
    assert "\n" not in str(refused.value)
    sys.modules.pop("broken_plug_in", None)


def test_a_plug_in_may_be_named_dobot(monkeypatch):
    point = EntryPoint("dobot", f"{__name__}:open_arm", registry.ENTRY_POINT_GROUP)
    monkeypatch.setattr(EntryPoint, "load", lambda _: open_arm)
    monkeypatch.setattr(registry, "entry_points", lambda *, group: [point] if group else [])
    assert isinstance(open_robot("dobot://good"), SimulatedRobot)


# The simulated robot.


def test_the_simulated_robot_implements_the_protocol():
    clock = ManualClock()
    robot = SimulatedRobot(clock=clock, sleep=clock.sleep)
    assert isinstance(robot, Robot)
    with robot:
        with pytest.raises(NotReadyError):
            robot.move_to(Pose(0.3, 0.0, 0.1))
        robot.home()
        assert robot.pose().distance_m(Pose(*HOME[:3])) == 0.0
        start_s = clock()
        robot.move_to(Pose(0.3, 0.2, 0.3), speed_m_s=0.1)
        assert 2.0 <= clock() - start_s < 2.3
        robot.gripper(0.02)
        assert robot.opening == pytest.approx(0.25)
        robot.move_to(Pose(0.3, -0.2, 0.3), speed_m_s=0.1, wait=False)
        clock.sleep(1.0)
        robot.stop()
        stopped = robot.pose()
        clock.sleep(5.0)
        assert robot.pose() == stopped
        assert -0.2 < stopped.y_m < 0.2


def test_an_arrival_needs_two_readings():
    with pytest.raises(InvalidInputError):
        ArrivalRule(readings=1)


def test_unknown_emulators_are_refused():
    with pytest.raises(InvalidInputError, match="acl, dexarm, marlin, rosbridge, so101, uarm"):
        make_emulator("puma")
    with pytest.raises(InvalidInputError, match="time_scale"):
        make_emulator("acl", time_scale=0.0)


def test_every_error_is_documented():
    kinds = RobotError.__subclasses__()
    assert kinds
    assert all(kind.__doc__ for kind in kinds)


@pytest.mark.parametrize("address", ["socket://host", "socket://host:99999", "spoy://host:1", ""])
def test_a_drivers_address_is_checked_without_a_url_too(address):
    with pytest.raises(InvalidInputError, match=r"is right"):
        Scorbot(address)


# Options made by a program.


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, -1.0, 1e308, 10**400, "a", True])
@pytest.mark.parametrize(
    ("kind", "name"),
    [
        *((GuardOptions, name) for name in GuardOptions.__struct_fields__),
        *((FollowOptions, name) for name in FollowOptions.__struct_fields__),
        *((PlaneOptions, name) for name in PlaneOptions.__struct_fields__),
        (PickPlaceOptions, "travel_m"),
        (PickPlaceOptions, "grip_m"),
        (PickPlaceOptions, "grip"),
        (ScorbotOptions, "reply_s"),
    ],
)
def test_options_made_by_a_program_are_checked(kind, name, value):
    with pytest.raises(InvalidInputError, match=f"^{name} is .* right$"):
        kind(**{name: value})
    with pytest.raises(InvalidInputError):
        msgspec.structs.replace(kind(), **{name: value})


@pytest.mark.parametrize("place", range(3))
def test_options_are_checked_in_every_component(place):
    offset_m = [0.0, 0.0, 0.0]
    offset_m[place] = math.nan
    with pytest.raises(InvalidInputError, match=r"^offset_m is .* each a finite number from -1"):
        PlaneOptions(offset_m=tuple(offset_m))


def test_options_take_every_kind_of_number():
    assert GuardOptions(tolerance_m=np.float64(0.01), max_speed_m_s=1).max_speed_m_s == 1
    assert PlaneOptions(points=np.int64(6)).points == 6
    assert FollowOptions(above_m=-0.0).above_m == 0.0
    assert PickPlaceOptions(grip=0.02).grip == 0.02


def test_a_block_is_not_carried_lower_than_it_is_released():
    with pytest.raises(InvalidInputError, match=r"travel_m is 0\.05; at least release_m, 0\.06"):
        PickPlaceOptions(travel_m=0.05, release_m=0.06)


@pytest.mark.parametrize("timeout_s", [math.nan, -1.0])
def test_an_invalid_time_out_is_refused(timeout_s):
    clock = ManualClock()
    robot = SimulatedRobot(clock=clock, sleep=clock.sleep)
    with robot:
        for act in (
            lambda: robot.home(timeout_s=timeout_s),
            lambda: robot.reconnect(timeout_s=timeout_s),
        ):
            with pytest.raises(InvalidInputError, match="timeout_s"):
                act()
        robot.home()
        for act in (
            lambda: robot.move_to(Pose(0.3, 0.0, 0.2), timeout_s=timeout_s),
            lambda: robot.wait(timeout_s=timeout_s),
        ):
            with pytest.raises(InvalidInputError, match="timeout_s"):
                act()


def test_limits_must_have_their_speeds_in_order():
    with pytest.raises(InvalidInputError, match=r"at least min_speed_m_s, 0\.6"):
        replace(SIMULATED_LIMITS, min_speed_m_s=0.6)
