"""`fingerpost robot follow` end to end, on a recording and an emulated Scorbot; refusals."""

import json
import re
import socket
import subprocess
import sys
from collections import defaultdict

import command_line
import numpy as np
import pytest
from guided_process import (
    BY_HAND,
    EMPTY_FRAMES,
    FIRST_MM,
    HEIGHT_M,
    HOLD_FRAMES,
    SECOND_MM,
    EmulatedArm,
    Guided,
    commands,
    cut_film,
    robot_xy,
    write_rig,
)
from recordings import messages as recorded_messages
from scipy.spatial.transform import Rotation

FAST = ("--speed", "0.3")
OPTIONS = (*FAST, *BY_HAND)


@pytest.fixture
def rig(hand_film, tmp_path):
    frames = [*range(HOLD_FRAMES + 45), *([HOLD_FRAMES + 44] * 120)]
    return write_rig(tmp_path, hand_film, cut_film(tmp_path / "film", hand_film, frames))


def test_the_arm_follows_the_hand_and_every_command_has_its_fix(rig, tmp_path):
    log, recording = tmp_path / "commands.csv", tmp_path / "session.mcap"
    with EmulatedArm() as arm, socket.socket(type=socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        address = f"osc://127.0.0.1:{receiver.getsockname()[1]}"
        options = ("--log", log, "--record", recording, "--publish", address, *OPTIONS)
        with Guided("follow", rig, "--url", arm.url, "--arm", *options) as guided:
            assert guided.end() == 0, guided.said()
        assert b"/fingerpost/status" in receiver.recv(1 << 16)
        there = arm.pose()
        assert not arm.is_moving()
    np.testing.assert_allclose(there.position_m, [*robot_xy(SECOND_MM), HEIGHT_M + 0.05], atol=0.01)
    assert "lag      smoothing makes the target late by" in guided.out
    assert int(re.search(r"(\d+) ok", guided.out)[1]) >= 119
    rows = commands(log)
    assert [row["command"] for row in rows][:2] == ["arm", "enter"]
    assert rows[-1]["command"] == "halt"
    moves = [row for row in rows if row["command"] == "move"]
    assert len(moves) == sum(row["outcome"] == "sent" for row in moves) > 5
    for row in moves:
        assert row["fix_status"] == "ok"
        assert 0 <= float(row["time_s"]) - float(row["fix_time_s"]) < 0.3
        assert float(row["fix_cov_xx"]) > 0
    ends = [[float(moves[k][f"fix_{axis}"]) for axis in "xy"] for k in (0, -1)]
    np.testing.assert_allclose(ends, [robot_xy(FIRST_MM), robot_xy(SECOND_MM)], atol=0.008)
    assert_recorded(recording, rows, there)


def assert_recorded(recording, rows, there):
    """Assert that the recording holds the log's commands and the arm's states and poses."""
    topics = defaultdict(list)
    for topic, schema, message, content in recorded_messages(recording):
        topics[topic, schema].append((message.log_time, content))
    recorded = [row for _, row in topics["/robot/command", "fingerpost.CommandRow"]]
    assert [
        {name: "" if value is None else str(value) for name, value in row.items()}
        for row in recorded
    ] == rows
    states = [row for _, row in topics["/robot/state", "fingerpost.ArmRow"]]
    fixes = [row for _, row in topics["/fix", "fingerpost.PointRow"]]
    assert [row["time_s"] for row in states] == [row["time_s"] for row in fixes]
    assert {row["state"] for row in states} >= {"moving", "idle"}
    assert all(row["homed"] and row["armed"] for row in states)
    poses = topics["/robot/pose", "foxglove.PoseInFrame"]
    assert len(poses) == len(states)
    assert all(
        of_pose == of_fix
        for (of_pose, _), (of_fix, _) in zip(
            poses, topics["/fix", "fingerpost.PointRow"], strict=True
        )
    )
    last = poses[-1][1]
    assert last.frame_id == "robot"
    position, q = last.pose.position, last.pose.orientation
    np.testing.assert_allclose([position.x, position.y, position.z], there.position_m, atol=0.01)
    # The gripper's x axis, its approach direction, points down.
    turned = Rotation.from_quat([q.x, q.y, q.z, q.w]).apply([1.0, 0.0, 0.0])
    np.testing.assert_allclose(turned, [0.0, 0.0, -1.0], atol=1e-3)


def test_json_lines_report_lag_and_goal(rig):
    with EmulatedArm() as arm:
        options = ("--arm", "--json", "--max-frames", EMPTY_FRAMES + 150, *FAST, *BY_HAND)
        with Guided("follow", rig, "--url", arm.url, *options) as guided:
            assert guided.end() == 0, guided.said()
    *reports, summary = map(json.loads, guided.out.splitlines())
    assert summary["fixes"]["ok"] >= 59
    assert sum(summary["states"].values()) == len(reports)
    assert summary["lag_ms"]["largest"] <= 160.0
    moving = [report for report in reports if report["state"] == "moving"]
    assert moving
    assert all(len(report["goal_m"]) == 3 for report in moving)
    assert max(report["lag_s"] for report in reports) == pytest.approx(0.16, abs=0.03)
    assert reports[0]["state"] == "holding"
    assert "acquiring" in reports[0]["reason"]


# Refusals: exit code 2, one line, no motion.


def refused(*arguments):
    by_hand = () if "--attendance" in arguments else BY_HAND
    return command_line.refused("robot", *arguments, *by_hand)


def test_nothing_moves_without_the_explicit_command(rig):
    with EmulatedArm() as arm:
        for command in ("follow", "pick"):
            line = refused(command, rig, "--url", arm.url)
            assert f"robot {command} moves the arm" in line
            assert "--arm" in line
        assert arm.emulator.wire == []


def test_on_a_terminal_the_explicit_command_can_be_typed(rig):
    with EmulatedArm() as arm:
        for answer, code in (("no\n", 130), ("arm\n", None)):
            with Guided("follow", rig, "--url", arm.url, *FAST, terminal=True) as guided:
                guided.until_said("Type 'arm'")
                assert not arm.controller.homed
                guided.press(answer)
                if code is None:
                    guided.until(lambda: arm.controller.homed)
                else:
                    assert guided.end() == code
                    assert arm.emulator.wire == []


def test_a_rig_without_a_robot_is_refused(hand_film):
    line = refused("follow", hand_film / "rig.toml", "--arm")
    assert "no [robot] table" in line
    assert "robot plane" in line


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"region_m": ((0.4, 0.0), (0.5, 0.0), (0.45, 0.0))}, "convex"),
        ({"region_m": ((0.4, 0.0), (0.9, 0.0), (0.9, 0.1))}, "0.85"),
        ({"z_m": (0.03, 0.031)}, "too small"),
    ],
)
def test_an_invalid_region_is_refused_before_homing(hand_film, tmp_path, changes, words):
    rig = write_rig(tmp_path, hand_film, **changes)
    with EmulatedArm() as arm:
        with Guided("follow", rig, "--url", arm.url, "--arm", *BY_HAND) as guided:
            assert guided.end() in (1, 2)
        assert words in guided.said()
        assert not arm.controller.homed


@pytest.mark.parametrize("command", ["follow", "pick"])
def test_the_log_does_not_overwrite_the_rig(rig, command):
    before = rig.read_bytes()
    assert "would overwrite" in refused(command, rig, "--arm", "--log", rig)
    assert rig.read_bytes() == before


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("follow", "--attendance", "key"), "terminal"),
        (("pick", "--select", "key"), "terminal"),
        (("follow", "--speed", "-1"), "speed_m_s"),
        (("follow", "--tolerance", "0"), "tolerance_m"),
        (("follow", "--max-age", "inf"), "--max-age"),
        (("follow", "--operator-timeout", "inf"), "--operator-timeout"),
        (("pick", "--homing-timeout", "nan"), "--homing-timeout"),
        (("pick", "--grip-height", "x"), "grip-height"),
        *((("follow", "--above", value), "'--above': above_m") for value in ("nan", "-1", "1e300")),
        (("follow", "--speed", "1e308"), "'--speed': max_speed_m_s"),
        (("follow", "--stride", "inf"), "'--stride': stride_s"),
        (("follow", "--tolerance", "inf"), "'--tolerance': tolerance_m"),
        (("follow", "--max-age", "61"), "--max-age"),
        (("follow", "--operator-timeout", "61"), "--operator-timeout"),
        (("follow", "--min-cutoff", "1e-300"), "'--min-cutoff': min_cutoff_hz"),
        (("follow", "--slope", "inf"), "'--slope': slope_hz_m"),
        (("follow", "--max-frames", 10**20), "--max-frames"),
        *(
            (("pick", option, value), f"'{option}': {field}")
            for option, field in (
                ("--travel", "travel_m"),
                ("--grip-height", "grip_m"),
                ("--release-height", "release_m"),
                ("--grip-width", "grip"),
            )
            for value in ("nan", "-1", "1e300", 10**20)
        ),
        (("pick", "--travel", "0.01"), "'--travel': travel_m is 0.01; at least grip_m"),
        (
            ("pick", "--travel", "0.05", "--grip-height", "0.06"),
            "travel_m is 0.05; at least grip_m",
        ),
        (("pick", "--travel", "5"), "travel_m is 5, outside the safe region; 0.229 m"),
        *((("pick", "--dwell", value), "'--dwell': dwell_s") for value in ("nan", "inf", "0")),
        *((("pick", "--radius", value), "'--radius': radius_m") for value in ("nan", "1e300")),
    ],
)
def test_unusable_options_are_refused(rig, options, words):
    command, *rest = options
    # Refused before the arm is connected, for this address does not exist.
    assert words in refused(command, rig, "--url", "acl:///dev/nothing", "--arm", *rest)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("pick", "--grip-width", "0.5"), "gripper: 0.5 m"),
        (("follow", "--speed", "0.002"), "this arm's least speed is 0.01 m/s"),
    ],
)
def test_options_beyond_the_arms_abilities_are_refused_before_homing(rig, options, words):
    command, *rest = options
    with EmulatedArm() as arm:
        assert words in refused(command, rig, "--url", arm.url, "--arm", *rest)
        assert not arm.controller.servos


def test_options_valid_only_together_are_accepted(rig):
    with Guided(
        *("pick", rig, "--url", "acl:///dev/nothing", "--arm", *BY_HAND),
        *("--travel", "0.013", "--grip-height", "0.012", "--release-height", "0.012"),
    ) as guided:
        assert guided.end() == 1
    assert "/dev/nothing cannot be opened" in guided.said()


def test_a_robot_that_is_not_there_is_an_error_in_one_line(rig):
    with Guided("follow", rig, "--url", "acl:///dev/nothing", "--arm", *BY_HAND) as guided:
        assert guided.end() == 1
    assert len(guided.said().splitlines()) == 1
    assert "/dev/nothing" in guided.said()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        # Runs without keys, up to the missing device.
        ("follow --arm --attendance hand", "/dev/nothing cannot be opened"),
        ("follow --attendance hand", "give --arm"),
        ("follow", "--attendance key needs a terminal"),
        ("pick --arm --select key --attendance hand", "need a terminal"),
        ("pick --arm --step --attendance hand", "need a terminal"),
    ],
)
def test_standard_input_may_be_closed(rig, options, words):
    command, *rest = options.split()
    line = [sys.executable, "-m", "fingerpost", "robot", command, rig, *rest]
    ended = subprocess.run(
        ["bash", "-c", 'exec "$@" <&-', "bash", *map(str, line), "--url", "acl:///dev/nothing"],
        capture_output=True,
        text=True,
        check=False,
    )
    (said,) = ended.stderr.splitlines()
    assert words in said
