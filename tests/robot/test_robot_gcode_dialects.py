"""Dialects of G-code arms: bytes, paths, speeds, tools and stops."""

import itertools
import logging
import math
import re
import threading

import numpy as np
import pytest
from gcode_rig import FAR, GOAL, gcode_rig, wait_until
from hypothesis import given
from hypothesis import strategies as st

from fingerpost.errors import InvalidInputError
from fingerpost.robot.emulator.faults import Fault
from fingerpost.robot.emulator.gcode import MarlinController, UarmController, make_dexarm
from fingerpost.robot.errors import (
    CommandRefusedError,
    NotHomedError,
    OutOfReachError,
    RobotFaultError,
    StoppedError,
)
from fingerpost.robot.gcode_dialects import MARLIN, UARM, Tool, marlin_firmware
from fingerpost.robot.gcode_dialogue import checksummed
from fingerpost.robot.palletiser import DEXARM, UARM_SWIFT_PRO
from fingerpost.robot.protocol import Pose, RobotState
from fingerpost.robot.registry import open_robot

PIECE_MM = 0.1
"""Limit of the deviation of joint-space segments from the straight path of the hand [mm]."""


# Kinematics.


@pytest.mark.parametrize("arm", [UARM_SWIFT_PRO, DEXARM], ids=["uarm", "dexarm"])
def test_forward_and_inverse_kinematics_agree(arm):
    rng = np.random.default_rng(20_941)
    low, high = np.array([arm.base_deg, arm.upper_deg, arm.fore_deg]).T
    joints = rng.uniform(low, high, (2000, 3))
    elbow = joints[:, 1] - joints[:, 2]
    joints = joints[(elbow > arm.elbow_deg[0]) & (elbow < arm.elbow_deg[1])]
    positions = arm.position_mm(joints)
    # Behind the axis of the base, a second solution has the base rotated by a half turn.
    ahead = np.hypot(positions[:, 0], positions[:, 1]) > arm.hand_out_mm
    np.testing.assert_allclose(
        arm.joints_deg(positions[ahead & (joints[:, 1] < 90)]),
        joints[ahead & (joints[:, 1] < 90)],
        atol=1e-6,
    )


@pytest.mark.parametrize(
    ("arm", "position", "joints"),
    [
        # The vendor's example of home; one computed by hand, with one link upright, one horizontal.
        (DEXARM, (0.0, 300.0, 0.0), (90.0, 52.53, -52.53)),
        (UARM_SWIFT_PRO, (158.81 + 69.85, 0.0, 142.07 + 32.85), (0.0, 90.0, 0.0)),
    ],
)
def test_known_configurations(arm, position, joints):
    np.testing.assert_allclose(arm.joints_deg(position), joints, atol=0.01)


@pytest.mark.parametrize("position", [(0, 0, 0), (400, 0, 50), (-200, 0, 50), (80, 0, 50)])
def test_unreachable_positions_of_a_uarm(position):
    assert np.isnan(UARM_SWIFT_PRO.joints_deg(position)).all()


# Paths: `G0` and `G1` in the region of the documentation page.

REGION_MM = np.array([(170, -90), (280, -90), (280, 80), (170, 80)])
AHEAD_MM = {"uarm": 0.0, "dexarm": 25.0}
"""Offset of the region: a DexArm reaches less close to its base."""

FEED = {"uarm": 20.0, "dexarm": 3000.0}
"""About 100 mm/s; for `G0`, 30 or 50 °/s."""

HEIGHT_MM = 20.0
BEGIN_S = 1000.0
"""Time at which the emulated arm certainly stands at the start of the examined path [s]."""

TURNS = {"uarm": 0.0, "dexarm": math.pi / 2}
"""A uArm points along X, a DexArm along Y."""


def turned(xy, angle):
    c, s = math.cos(angle), math.sin(angle)
    return np.asarray(xy, dtype=float) @ np.array([[c, s], [-s, c]])


def way_mm(name, start, goal, word, feed, step_s=0.005):
    """Sample the path of an emulated hand from a start to a goal [mm]."""
    controller = UarmController() if name == "uarm" else make_dexarm(1.0)
    controller.homed = True
    for number, (now_s, command) in enumerate(
        [(0.0, "G0 X{} Y{} Z{} F200"), (BEGIN_S, f"{word} X{{}} Y{{}} Z{{}} F{feed}")], start=1
    ):
        line = command.format(*(goal if number == 2 else start))
        numbered = f"#{number} {line}" if name == "uarm" else checksummed(number, line)
        controller.receive(f"{numbered}\n".encode(), now_s)
        controller.poll(BEGIN_S)
    times = itertools.count(BEGIN_S, step_s)
    way = [
        controller.position_mm(time_s)
        for time_s in itertools.takewhile(lambda now_s: controller.is_moving(now_s), times)
    ]
    np.testing.assert_allclose(way[0], start, atol=1e-6)
    return np.array(way)


def extremes_mm(name, word):
    """Return the largest deviations from the region and from straight paths between its corners."""
    outside, lateral = 0.0, 0.0
    region = REGION_MM + np.array([AHEAD_MM[name], 0.0])
    low, high = np.min(region, axis=0), np.max(region, axis=0)
    for a, b in itertools.permutations(turned(region, TURNS[name]), 2):
        start, goal = np.array([*a, HEIGHT_MM]), np.array([*b, HEIGHT_MM])
        way = way_mm(name, start, goal, word, FEED[name])
        flat = turned(way[:, :2], -TURNS[name])
        outside = max(outside, float(np.max([low - flat, flat - high])))
        along = (goal - start) / np.linalg.norm(goal - start)
        off = (way - start) - np.outer((way - start) @ along, along)
        lateral = max(lateral, float(np.linalg.norm(off, axis=1).max()))
    return outside, lateral


@pytest.mark.parametrize(
    ("name", "leaves_mm", "bows_mm"), [("uarm", 12.6, 27.9), ("dexarm", 11.6, 24.7)]
)
def test_g0_leaves_the_region_of_the_page_and_g1_does_not(name, leaves_mm, bows_mm):
    outside, lateral = extremes_mm(name, "G0")
    assert outside == pytest.approx(leaves_mm, abs=0.1)
    assert lateral == pytest.approx(bows_mm, abs=1.0)
    outside, lateral = extremes_mm(name, "G1")
    assert outside < PIECE_MM
    assert lateral < PIECE_MM


def test_g0_passes_below_the_path_and_g1_does_not():
    """A straight path between points of equal height never passes below them."""
    deepest = {}
    for word in ("G0", "G1"):
        deepest[word] = min(
            way_mm("uarm", (x, y, z), (u, v, z), word, 20.0)[:, 2].min() - z
            for (x, y), (u, v) in itertools.permutations(REGION_MM, 2)
            for z in (5.0, 120.0)
        )
    assert deepest["G0"] < -1.0
    assert deepest["G1"] > -PIECE_MM


@pytest.mark.parametrize("name", ["uarm", "dexarm"])
def test_a_move_goes_straight(name):
    with gcode_rig(name) as rig:
        rig.robot.move_to(GOAL)
        mover = threading.Thread(target=rig.robot.move_to, args=(FAR,), kwargs={"speed_m_s": 0.02})
        mover.start()
        wait_until(rig.is_moving)
        way = []
        while rig.is_moving():
            way.append(rig.true_m())
        mover.join(5.0)
    way = np.array(way)
    assert len(way) > 100
    start, goal = GOAL.position_m, FAR.position_m
    along = (goal - start) / np.linalg.norm(goal - start)
    off = (way - start) - np.outer((way - start) @ along, along)
    assert 1000 * np.linalg.norm(off, axis=1).max() < PIECE_MM
    assert (np.diff((way - start) @ along) > -1e-9).all()
    assert not any(re.search(r"\bG0\b", text) for text in rig.sent())


# Speeds: a uArm's `F` turns its joints.


@pytest.mark.parametrize("speed_m_s", [0.1, 0.02, 0.001])
def test_a_uarm_never_exceeds_the_given_speed(speed_m_s):
    rng = np.random.default_rng(7)
    for _ in range(10):
        start, goal = rng.uniform((170, -90, 5), (280, 80, 120), (2, 3))
        stroke = UARM.feed.stroke(start, goal, 1000 * speed_m_s)
        step_s = 5e-4 / speed_m_s
        way = way_mm("uarm", start, goal, "G1", stroke.feed, step_s)
        speeds = np.linalg.norm(np.diff(way, axis=0), axis=1) / step_s / 1000
        assert speeds.max() <= speed_m_s * 1.01  # the driver samples the path every millimetre
        assert speeds.max() > 0.9 * speed_m_s
        assert step_s * len(way) == pytest.approx(stroke.duration_s, rel=0.05, abs=0.7)


def test_a_uarm_refuses_a_goal_without_a_straight_path():
    """Both ends are in reach, but the path between them passes too close to the base."""
    with gcode_rig("uarm") as rig:
        rig.robot.move_to(Pose(0.02, 0.13, 0.0))
        moves = rig.controller.moves
        with pytest.raises(OutOfReachError, match="straight"):
            rig.robot.move_to(Pose(0.02, -0.13, 0.0))
        assert rig.controller.moves == moves
        assert rig.robot.status().state is RobotState.IDLE


def test_a_long_move_of_a_uarm_does_not_time_out():
    """While the firmware plans, it answers no query, here for longer than the answer time-out."""
    with gcode_rig("uarm", max_speed_m_s=0.1) as rig:
        rig.robot.move_to(GOAL)
        rig.robot.move_to(FAR, speed_m_s=0.005)  # a minute, four time-outs
        np.testing.assert_allclose(rig.true_m(), FAR.position_m, atol=1e-3)


# Tools.


@pytest.mark.parametrize(
    ("name", "options", "close", "opened"),
    [
        ("uarm", {}, "M2231 V1", "M2231 V0"),
        ("uarm", {"tool": "suction"}, "M2231 V1", "M2231 V0"),
        ("uarm", {"tool": "gripper"}, "M2232 V1", "M2232 V0"),
        ("dexarm", {}, "M1000", "M1001"),
        ("dexarm", {"tool": "gripper"}, "M1001", "M1000"),
        ("uarm", {"close_gripper": "M2240 N9 V1"}, "M2240 N9 V1", "M2231 V0"),
    ],
)
def test_each_tool_has_its_command(name, options, close, opened):
    arguments = "&".join(f"{key}={value}".replace(" ", "%20") for key, value in options.items())
    robot = open_robot(f"{name}:///dev/null?lower_m=0,0,0&upper_m=1,1,1&{arguments}".rstrip("&"))
    assert (robot._grip.close, robot._grip.open) == (close, opened)


@pytest.mark.parametrize(("tool", "command"), [("suction", "M2231"), ("gripper", "M2232")])
def test_the_tool_of_a_uarm_closes_once(tool, command):
    with gcode_rig("uarm", tool=Tool(tool)) as rig:
        rig.robot.gripper("close")
        assert rig.controller.closed
        rig.robot.gripper("open")
        assert not rig.controller.closed
        assert [f"{command} V1" in text for text in rig.sent()].count(True) == 1


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("marlin:///dev/null?tool=suction", "give open_gripper, close_gripper"),
        ("marlin:///dev/null?close_gripper=M3", "open_gripper is missing"),
        ("uarm:///dev/null?tool=magnet", "'magnet'"),
    ],
)
def test_an_invalid_tool_is_refused(url, words):
    with pytest.raises(InvalidInputError, match=words) as refused:
        open_robot(url)
    assert "\n" not in str(refused.value)


# Firmware versions and effective stops.


@pytest.mark.parametrize("firmware", ["V3.2.0", "V3.1.20"])
def test_a_uarm_that_does_not_stop_on_ctrl_x_is_refused(firmware):
    controller = UarmController(firmware)
    with gcode_rig("uarm", controller, connect=False) as rig:
        with pytest.raises(CommandRefusedError, match=f"{firmware} does not stop.*V4.0") as refused:
            rig.robot.connect()
        assert "\n" not in str(refused.value)
        assert rig.robot.status().state is RobotState.DISCONNECTED
        assert controller.moves == controller.stops == 0


@pytest.mark.parametrize(
    ("answer", "name", "stops"),
    [
        (
            "FIRMWARE_NAME:Marlin 2.1.2 (May 2023) SOURCE_CODE_URL:x PROTOCOL_VERSION:1.0\n"
            "Cap:EEPROM:1\nCap:EMERGENCY_PARSER:1\nCap:PROMPT_SUPPORT:0\n",
            "Marlin 2.1.2 (May 2023)",
            True,
        ),
        ("FIRMWARE_NAME:Marlin 2.0.x\nCap:EMERGENCY_PARSER:0\n", "Marlin 2.0.x", False),
        ("FIRMWARE_NAME:Marlin V1; Sprinter FIRMWARE_URL:http://x\n", "Marlin V1; Sprinter", False),
        ("", "unnamed firmware", False),
    ],
)
def test_a_marlins_firmware_report_is_parsed(answer, name, stops):
    firmware = marlin_firmware(answer)
    assert (firmware.name, firmware.stops_at_once) == (name, stops)


@pytest.mark.parametrize("emergency_parser", [True, False])
def test_a_marlin_without_an_emergency_parser_is_logged_as_a_warning(emergency_parser, caplog):
    controller = MarlinController(homing_s=1.0, emergency_parser=emergency_parser)
    with caplog.at_level(logging.WARNING), gcode_rig("marlin", controller) as rig:
        assert rig.robot.firmware.stops_at_once is emergency_parser
    assert ("EMERGENCY_PARSER" in caplog.text) is not emergency_parser


@pytest.mark.parametrize("emergency_parser", [True, False])
def test_a_stop_takes_effect_during_the_wait_for_a_move(emergency_parser):
    """A board that reads no lines during `M400` is sent `M400` only after the motion."""
    controller = MarlinController(homing_s=1.0, emergency_parser=emergency_parser)
    with gcode_rig("marlin", controller) as rig:
        rig.robot.move_to(GOAL)
        stops, errors = controller.stops, []

        def move():
            try:
                rig.robot.move_to(FAR, speed_m_s=0.01)
            except StoppedError as error:
                errors.append(error)

        mover = threading.Thread(target=move)
        mover.start()
        wait_until(rig.is_moving)
        rig.robot.stop()
        wait_until(lambda: controller.stops > stops)
        assert not rig.is_moving()
        mover.join(5.0)
        assert len(errors) == 1
        assert np.linalg.norm(rig.true_m() - FAR.position_m) > 0.05


def test_after_m410_the_position_of_a_marlin_is_unknown():
    with gcode_rig("marlin") as rig:
        rig.robot.move_to(GOAL)
        rig.robot.stop()  # without motion, no steps are lost
        assert rig.robot.status().homed
        rig.robot.move_to(FAR, wait=False)
        wait_until(lambda: np.linalg.norm(rig.true_m() - GOAL.position_m) > 0.05)
        rig.robot.stop()
        assert rig.robot.status().state is RobotState.NOT_HOMED
        with pytest.raises(NotHomedError, match=r"M410.*slipped.*call home\(\) first"):
            rig.robot.pose()
        with pytest.raises(NotHomedError):
            rig.robot.move_to(GOAL)
        # The board reports a position, wrong by the lost steps.
        believed = rig.controller._arm.position(rig.clock()) / 1000
        assert np.linalg.norm(believed - rig.true_m()) > 1e-6
        rig.robot.home()
        rig.robot.move_to(GOAL)
        rig.assert_at(GOAL)


@pytest.mark.parametrize(("dialect", "make"), [(MARLIN, MarlinController), (UARM, UarmController)])
def test_no_single_garbled_byte_loses_a_stop(dialect, make):
    for place in range(len(dialect.stop)):
        for noise in (b"?", b"", b"\x00"):
            controller = make()
            controller.receive(b"N7 G1 X1", 0.0)  # an incomplete line
            controller.receive(dialect.stop[:place] + noise + dialect.stop[place + 1 :], 0.0)
            assert controller.stops > 0


@pytest.mark.parametrize("name", ["uarm", "dexarm", "marlin"])
def test_arms_without_lost_steps_know_their_position_after_a_stop(name):
    controller = MarlinController(homing_s=1.0, slips=False) if name == "marlin" else None
    with gcode_rig(name, controller, keeps_steps=name == "marlin") as rig:
        rig.robot.move_to(GOAL)
        rig.robot.move_to(FAR, speed_m_s=0.05, wait=False)
        wait_until(lambda: np.linalg.norm(rig.true_m() - GOAL.position_m) > 0.05)
        rig.robot.stop()
        assert rig.robot.status().state is RobotState.IDLE
        pose = rig.robot.pose()
        np.testing.assert_allclose(pose.position_m, rig.true_m(), atol=1e-5)
        rig.robot.move_to(FAR)
        rig.assert_at(FAR)


# Marlin's numbered lines.

STOP = "\nM410\n\nM410\n"


@given(st.integers(0, 99_999), st.text("GMXYZF0123456789. -", min_size=1, max_size=40))
def test_a_line_and_its_checksum_cancel(number, command):
    line = checksummed(number, command)
    body, total = line.rsplit("*", 1)
    assert body == f"N{number} {command}"
    left = int(total)
    for byte in body.encode():
        left ^= byte
    assert left == 0


def test_golden_dialogue_with_marlin():
    controller = MarlinController(homing_s=5.0)
    dialogue = [
        (0.0, checksummed(0, "M110 N0"), "ok\n"),
        (0.0, checksummed(1, "G21"), "ok\n"),
        (0.0, "N2 G90*1", "Error:checksum mismatch, Last Line: 1\nResend: 2\nok\n"),
        (
            0.0,
            checksummed(3, "G90"),
            "Error:Line Number is not Last Line Number+1, Last Line: 1\nResend: 2\nok\n",
        ),
        (0.0, "N2 G90", "Error:No Checksum with line number, Last Line: 1\nResend: 2\nok\n"),
        (0.0, "G90", "ok\n"),
        (0.0, checksummed(2, "G0 X200"), "echo:Home XYZ First\nok\n"),
        (0.0, checksummed(3, "G28"), ""),
        (3.0, "", "echo:busy: processing\n"),
        (4.5, "", "echo:busy: processing\n"),
        (6.0, "", "ok\n"),
        (6.0, checksummed(4, "G01 X200 Y50 Z150 F6000"), "ok\n"),
        # The goal, while the arm has hardly started.
        (6.0, checksummed(5, "M114"), "X:200.00 Y:50.00 Z:150.00 E:0.00 Count X:0 Y:0 Z:0\nok\n"),
        (6.0, checksummed(6, "M400"), ""),
        (6.4, "", ""),
        (6.6, "", "ok\n"),
        (6.6, checksummed(7, "M999"), 'echo:Unknown command: "M999"\nok\n'),
        (6.6, checksummed(8, "G0 X900"), "Error:target out of reach\nok\n"),
        (6.6, checksummed(9, "G0 X100 F60"), "ok\n"),
        (6.6, checksummed(10, "M400"), ""),
        # It stops ahead of the queue, which continues; later its own line is executed.
        (7.0, "M410", "ok\nok\n"),
    ]
    for now_s, line, answer in dialogue:
        if line:
            controller.receive(f"{line}\n".encode(), now_s)
        assert (line, controller.poll(now_s).decode()) == (line, answer)


def test_without_an_emergency_parser_m410_waits_behind_m400():
    controller = MarlinController(homing_s=1.0, emergency_parser=False)
    controller.receive(b"G28\n", 0.0)
    assert controller.poll(1.0) == b"ok\n"
    controller.receive(b"G1 X100 F600\nM400\n", 1.0)
    assert controller.poll(1.1) == b"ok\n"
    controller.receive(b"M410\n", 1.2)
    assert controller.poll(1.3) == b""
    assert controller.is_moving(1.3)
    controller.poll(100.0)
    assert not controller.is_moving(100.0)
    controller.receive(b"G1 X200 F600\n", 100.0)
    controller.receive(b"M410\n", 101.0)  # the board reads lines again
    assert not controller.is_moving(101.1)


def lines_of(*commands):
    return [f"{checksummed(number, command)}\n" for number, command in enumerate(commands)]


def test_golden_conversation_with_marlin():
    with gcode_rig("marlin") as rig:
        rig.robot.move_to(Pose(0.2, 0.0, 0.15))
    assert rig.sent() == [
        STOP,
        *lines_of(
            "M110 N0",
            "M114",
            "M115",
            "G21",
            "G90",
            "G28",
            "M400",
            "M400",  # the start of the path
            "M114",
            "M114",
            "G01 X200.00 Y0.00 Z150.00 F12000",
            "M400",
            "M114",
            "M400",
            "M114",
        ),
        STOP,
    ]


def test_golden_conversation_with_a_dexarm():
    with gcode_rig("dexarm", max_speed_m_s=0.1) as rig:
        rig.robot.move_to(Pose(0.0, 0.3, 0.05))
        rig.robot.gripper("close")
    assert rig.sent() == [
        STOP,
        *lines_of(
            "M110 N0",
            "M114",
            "M115",
            "G21",
            "G90",
            "M1112",
            "M400",
            "M400",
            "M114",
            "M114",
            "G1 X0.00 Y300.00 Z50.00 F6000",
            "M400",
            "M114",
            "M114",
            "M400",
            "M114",
            "M1000",
        ),
        STOP,
    ]


def test_golden_conversation_with_a_uarm():
    with gcode_rig("uarm", max_speed_m_s=0.1) as rig:
        rig.robot.move_to(Pose(0.2, 0.0, 0.05))
        rig.robot.gripper("close")
        rig.robot.gripper("open")
    first, *sent, last = "".join(rig.sent()).split("\n")
    assert first == last == "\x18\x18"
    numbers, commands = zip(*(line.split(" ", 1) for line in sent), strict=True)
    assert list(numbers) == [f"#{number + 1}" for number in range(len(numbers))]
    # The number of position queries depends on the duration.
    assert [command for command, _ in itertools.groupby(commands)] == [
        "M17",
        "P2203",
        "M17",
        "G1 X200 Y0 Z150 F10",
        "P2220",
        "G1 X200.00 Y0.00 Z50.00 F28.50",
        "P2220",
        "M2231 V1",
        "M2231 V0",
    ]


def test_golden_dialogue_with_a_uarm():
    controller = UarmController()
    x, y, z = controller.position_mm(0.0)
    dialogue = [
        (0.0, "#1 M17", "$1 ok\n"),
        (0.0, "#2 P2220", f"$2 ok X{x:.4f} Y{y:.4f} Z{z:.4f}\n"),
        (0.0, "#3 P2203", "$3 ok V4.10.0\n"),
        (0.0, "#4 M2231 V1", "$4 ok\n"),
        (0.0, "#5 G0 X900 Y0 Z0 F100", "$5 E22\n"),
        (0.0, "#6 Q1", "$6 E20\n"),
        (0.0, "#7 G1 X200 Y0 Z150 F10", ""),
        (0.0, "#8 P2220", ""),  # it is planning
        (0.0, "nonsense", ""),
        (9.0, "", "$8 ok X201.2883 Y2.5764 Z146.1354\n$7 ok\n"),  # planned, nearly there
        (9.0, "#9 G0 X250 Y0 Z100 F10", ""),
        (9.0, "#10 M2231 V0", ""),  # answered once the arm stands
        (60.0, "", "$9 ok\n$10 ok\n"),
        (60.0, "#11 G1 X200 Y0 Z150 F1", ""),
        (61.0, "\x18", "ok\n$11"),
        (61.0, "#12 M17", "$12 ok\n"),
    ]
    for now_s, line, answer in dialogue:
        if line:
            controller.receive(f"{line}\n".encode(), now_s)
        assert (line, controller.poll(now_s).decode()) == (line, answer)


def test_a_restarted_controller_needs_homing():
    with gcode_rig("marlin") as rig:
        rig.robot.move_to(FAR, speed_m_s=0.01, wait=False)
        rig.emulator.inject(Fault.IMPACT)
        with pytest.raises(RobotFaultError, match="restarted"):
            rig.robot.wait()
        assert rig.robot.status().state is RobotState.FAULT
        rig.robot.home()
        rig.robot.move_to(GOAL)
