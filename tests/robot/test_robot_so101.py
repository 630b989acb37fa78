"""SO-101 on emulated servos: packets of the manual, kinematics of the URDF, stops and faults."""

import itertools
import json
import math
import threading
import time

import numpy as np
import pytest
from robot_rig import assert_in_time, best_of_three
from so101_rig import (
    URDF_APPROACH,
    URDF_SIDE,
    so101_rig,
    urdf_angles,
    urdf_tip,
    wait_until,
)

from fingerpost.errors import InvalidInputError
from fingerpost.robot import open_robot
from fingerpost.robot.emulator.faults import Fault
from fingerpost.robot.emulator.feetech import CALIBRATION, NAMES, FeetechBus, calibration_file
from fingerpost.robot.errors import (
    CommandRefusedError,
    ConnectionLostError,
    GarbledReplyError,
    GripperError,
    NotArrivedError,
    OutOfReachError,
    RobotFaultError,
    RobotTimeoutError,
    StoppedError,
)
from fingerpost.robot.protocol import TOOL_DOWN_RAD, Pose, RobotState
from fingerpost.robot.so101 import JOINTS, SO101, _angles, _counts, _kinematics, read_calibration

DOWN = {"pitch_rad": TOOL_DOWN_RAD, "roll_rad": 0.0}
NEAR, FAR = Pose(0.2, -0.08, 0.06, **DOWN), Pose(0.2, 0.08, 0.06, **DOWN)

COUNT_M = 1e-3
"""Tip error due to rounding five joints to counts of 0.088° [m]."""

URDF_M = 3e-4
"""The URDF's joints lie 0.2 mm beside the arm's plane."""


def packet(text):
    return bytes.fromhex(text)


# The servos' packets, by the examples of Feetech's protocol manual.


@pytest.fixture
def bus():
    bus = FeetechBus()
    bus.servos[1].position = 0x0518
    return bus


def ask(bus, text, now_s=0.0):
    bus.receive(packet(text), now_s)
    return bus.poll(now_s).hex(" ").upper()


def test_servos_answer_as_in_the_manual(bus):
    assert ask(bus, "FF FF 01 02 01 FB") == "FF FF 01 02 00 FC"
    assert ask(bus, "FF FF 01 04 02 38 02 BE") == "FF FF 01 04 00 18 05 DD"
    assert ask(bus, "FF FF 01 09 03 2A 00 08 00 00 E8 03 D5") == "FF FF 01 02 00 FC"
    for number, (position, volts, celsius) in {
        1: (0x0800, 0x79, 0x1E),
        2: (0x07FF, 0x77, 0x23),
    }.items():
        bus.servos[number].position = position
        bus.servos[number].memory[62:64] = bytes([volts, celsius])
    assert ask(bus, "FF FF FE 06 82 38 08 01 02 36") == (
        "FF FF 01 0A 00 00 08 00 00 00 00 79 1E 55 FF FF 02 0A 00 FF 07 00 00 00 00 77 23 53"
    )


def test_a_sync_write_moves_four_servos_at_the_speed_of_the_manual(bus):
    for servo in bus.servos.values():
        servo.memory[40] = 1
        servo.position = 1048.0
    example = (
        "FF FF FE 20 83 2A 06 " + " ".join(f"0{k} 00 08 00 00 E8 03" for k in range(1, 5)) + " 58"
    )
    assert ask(bus, example) == ""
    assert [round(bus.positions(0.5)[k]) for k in range(1, 5)] == [1548] * 4
    assert bus.positions(2.0)[1] == 0x0800


def test_servos_ignore_a_packet_with_a_wrong_checksum_and_find_the_next(bus):
    assert ask(bus, "FF FF 01 02 01 FA") == ""
    assert ask(bus, "00 FF FF 01 02 01 FB") == "FF FF 01 02 00 FC"


def test_the_drivers_packets(tmp_path, caplog):
    with so101_rig(tmp_path) as rig:
        sent = b"".join(data for way, data in rig.tape.transfers if way == "out").hex(" ").upper()
        assert sent.startswith("FF FF FE 05 82 38 02 01 3F FF FF FE 05 82 38 02 02 3E")
        assert "FF FF FE 0A 82 1F 02 01 02 03 04 05 06 3F" in sent  # the offsets
        assert "FF FF 01 04 03 28 01 CE" in sent  # torque on
        assert "XOFF" not in caplog.text  # XOFF bytes in binary data are no flow control
        # The goals are where the servos stand, written before the torque is switched on.
        goals = sent.index("FF FF FE 34 83 29 07 01 FE E9 07 00 00 18 05 02 FE DC 05")
        assert goals < sent.index("FF FF 01 04 03 28 01 CE")
        assert rig.bus.positions(rig.clock()) == {
            1: 2025,
            2: 1500,
            3: 2500,
            4: 2600,
            5: 2048,
            6: 3000,
        }


# Kinematics, by the URDF.


@pytest.fixture
def servos(tmp_path):
    (tmp_path / "arm.json").write_bytes(calibration_file())
    return read_calibration(str(tmp_path / "arm.json"))


def test_kinematics_match_the_urdf_and_invert(servos):
    arm, rng, back = _kinematics(SO101, servos), np.random.default_rng(5), 0
    for _ in range(200):
        counts = np.array([rng.integers(servos[n].range_min, servos[n].range_max) for n in JOINTS])
        x, y, z, pitch, roll = place = arm.place(_angles(counts, servos))
        tip, turn = urdf_tip(urdf_angles({k + 1: float(c) for k, c in enumerate(counts)}))
        np.testing.assert_allclose((x, y, z), tip, atol=URDF_M)
        azimuth = -urdf_angles({k + 1: float(c) for k, c in enumerate(counts)})[0]
        ahead = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
        left = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
        approach = math.cos(pitch) * ahead + math.sin(pitch) * np.array([0.0, 0.0, 1.0])
        np.testing.assert_allclose(turn @ URDF_APPROACH, approach, atol=1e-4)
        side = math.cos(roll) * left + math.sin(roll) * np.cross(approach, left)
        np.testing.assert_allclose(turn @ URDF_SIDE, side, atol=1e-4)
        joints = arm.joints_rad(place)
        elbow_up, ahead_of_base = _angles(counts, servos)[2] < 0, np.dot(ahead[:2], (x, y)) > 0
        if joints is not None and elbow_up and ahead_of_base:
            np.testing.assert_array_equal(_counts(joints, servos), counts)
            back += 1
    assert back > 50


# Motion.


def test_it_moves_straight_at_the_given_speed_and_stops_at_the_goal(tmp_path):
    with so101_rig(tmp_path) as rig:
        rig.robot.move_to(NEAR)
        done = threading.Event()
        mover = threading.Thread(target=lambda: (rig.robot.move_to(FAR, speed_m_s=0.1), done.set()))
        mover.start()
        track = []
        while not done.is_set():
            track.append((rig.clock(), *rig.true_m()))
            time.sleep(0.004)
        mover.join()
        times, places = np.array(track)[:, 0], np.array(track)[:, 1:]
        np.testing.assert_allclose(places[:, 0], 0.2, atol=2 * COUNT_M)
        np.testing.assert_allclose(places[:, 2], 0.06, atol=2 * COUNT_M)
        under_way = (places[:, 1] > -0.05) & (places[:, 1] < 0.05)
        speed = np.polyfit(times[under_way], places[under_way, 1], 1)[0]
        assert 0.04 < speed < 0.11  # a loaded machine makes it slower, never faster
        np.testing.assert_allclose(rig.true_m(), FAR.position_m, atol=COUNT_M)
        assert rig.robot.pose().distance_m(FAR) < COUNT_M
        assert rig.robot.status().state is RobotState.IDLE


def test_joint_speeds_are_limited(tmp_path):
    with so101_rig(tmp_path, max_joint_rad_s=0.5, near_m=0.002) as rig:
        rig.robot.move_to(Pose(0.12, -0.05, 0.1, **DOWN))
        begin_s = rig.clock()
        # The base turns by 45°, in at least 1.6 s; at 0.15 m/s the path would take 0.7 s.
        rig.robot.move_to(Pose(0.12, 0.05, 0.1, **DOWN))
        assert rig.clock() - begin_s > math.radians(45) / 0.5


def test_queued_moves_are_made_in_sequence(tmp_path):
    with so101_rig(tmp_path, near_m=0.002) as rig:
        for y_m in (-0.06, -0.03, 0.0, 0.03):
            rig.robot.move_to(Pose(0.2, y_m, 0.06, **DOWN), wait=False)
        rig.robot.wait()
        np.testing.assert_allclose(rig.true_m(), (0.2, 0.03, 0.06), atol=COUNT_M)


@pytest.mark.parametrize(
    "goal", [Pose(0.3, 0.0, 0.0, **DOWN), Pose(0.05, 0.0, 0.06, **DOWN), Pose(-0.2, 0.0, 0.1)]
)
def test_an_unreachable_goal_is_refused_before_anything_moves(tmp_path, goal):
    with so101_rig(tmp_path) as rig:
        before = rig.bus.goals
        with pytest.raises(OutOfReachError, match="cannot be reached: nearer"):
            rig.robot.move_to(goal)
        wait_until(lambda: rig.bus.goals == before + 1)  # the stop after a failure
        assert not rig.is_moving()


def test_the_gripper_opens_closes_and_holds_an_object(tmp_path):
    with so101_rig(tmp_path) as rig:
        gripper = rig.bus.servos[6]
        rig.robot.gripper("open")
        assert gripper.at(rig.clock()) == pytest.approx(CALIBRATION["gripper"]["range_max"], abs=20)
        gripper.blocked_at = 2700.0
        rig.robot.gripper("close")
        assert gripper.at(rig.clock()) == 2700.0
        rig.robot.stop()
        assert gripper._word(42) == CALIBRATION["gripper"]["range_min"]  # it keeps its grip
        gripper.blocked_at, gripper.faults = None, 0x20
        rig.robot.gripper("close")
        gripper.faults = 0
        rig.emulator.inject(Fault.STICK)
        with pytest.raises(GripperError, match="to open"):
            rig.robot.gripper("open")


# Stopping.


def stop_in_time(rig):
    """Stop, and assert from the emulator's log that the holding goals arrived in time."""
    held, write_now = [], rig.robot._bus.write_now
    rig.robot._bus.write_now = lambda *given: (held.append(given[1]), write_now(*given))
    seen, called_s = len(rig.emulator.wire), time.monotonic()
    rig.robot.stop()
    rig.robot._bus.write_now = write_now
    hold = b"".join(bytes([servo, *data]) for servo, data in held[0].items())
    events = []
    wait_until(
        lambda: (
            events.extend(
                event
                for event in itertools.islice(rig.emulator.wire, seen, None)
                if not event.sent and hold in event.data
            )
            or events
        )
    )
    assert_in_time(called_s, events[0].time_s)


@best_of_three
def test_a_stop_arrives_within_20_ms_and_leaves_the_torque_on(tmp_path):
    with so101_rig(tmp_path) as rig:
        for goal in (FAR, NEAR):
            rig.robot.move_to(FAR if goal is NEAR else NEAR)
            rig.robot.move_to(goal, wait=False)
            wait_until(rig.is_moving)
            time.sleep(0.05)
            at = rig.true_m()
            stop_in_time(rig)
            wait_until(lambda: not rig.is_moving())
            time.sleep(0.05)
            goals = {number: servo._word(42) for number, servo in rig.bus.servos.items()}
            assert goals == {k: round(at) for k, at in rig.bus.positions(rig.clock()).items()}
            assert np.linalg.norm(rig.true_m() - at) < 0.02
            assert np.linalg.norm(rig.true_m() - goal.position_m) > 0.02
            assert all(servo.memory[40] for servo in rig.bus.servos.values())
        rig.robot.move_to(NEAR)
        np.testing.assert_allclose(rig.true_m(), NEAR.position_m, atol=COUNT_M)


@best_of_three
def test_a_stop_that_may_have_collided_with_an_answer_is_sent_again(tmp_path):
    with so101_rig(tmp_path) as rig:
        rig.emulator.inject(Fault.SILENT, count=1)
        errors = []

        def wait():
            try:
                rig.robot.move_to(FAR)
            except StoppedError as error:
                errors.append(error)

        waiting = threading.Thread(target=wait)
        waiting.start()
        wait_until(rig.robot._bus._lock.locked)
        goals = rig.bus.goals
        stop_in_time(rig)
        waiting.join()
        assert len(errors) == 1
        wait_until(lambda: rig.bus.goals >= goals + 2)


def test_a_stop_that_overtakes_a_goal_is_repeated_after_it(tmp_path):
    with so101_rig(tmp_path) as rig:
        rig.robot.move_to(NEAR)
        send_place, sent = rig.robot._send_place, []

        def send_late(place):
            sent.append(place)
            if len(sent) == 8:
                rig.robot.stop()
            send_place(place)

        rig.robot._send_place = send_late
        with pytest.raises(StoppedError):
            rig.robot.move_to(FAR)
        time.sleep(0.05)
        assert len(sent) == 8
        goals = {number: servo._word(42) for number, servo in rig.bus.servos.items()}
        assert [goals[k] for k in range(1, 6)] == [rig.robot._measured[k] for k in range(1, 6)]


def test_a_sagging_arm_does_not_sink_with_every_stop(tmp_path):
    with so101_rig(tmp_path) as rig:
        rig.robot.move_to(NEAR)
        goals = {number: servo._word(42) for number, servo in rig.bus.servos.items()}
        for servo in rig.bus.servos.values():
            servo.position, servo.stuck = servo.at(rig.clock()) + 15, True  # 1.3°
        for _ in range(3):
            rig.robot.pose()
            rig.robot.stop()
        time.sleep(0.05)
        assert goals == {number: servo._word(42) for number, servo in rig.bus.servos.items()}


def test_servos_without_torque_are_sent_nothing_before_homing(tmp_path):
    with so101_rig(tmp_path, home=False) as rig:
        rig.robot.connect()
        rig.robot.stop()
        assert rig.bus.goals == 0
        assert not any(servo.memory[40] for servo in rig.bus.servos.values())


def test_a_stop_of_a_closed_arm_is_an_error(tmp_path):
    with (
        so101_rig(tmp_path, home=False) as rig,
        pytest.raises(ConnectionLostError, match="connect"),
    ):
        rig.robot.stop()


# Faults.


def corrupt(rig):
    """Corrupt the checksum of every answer."""
    poll = rig.bus.poll
    rig.bus.poll = lambda now_s: (data := poll(now_s)) and data[:-1] + bytes([data[-1] ^ 1])


FAULTS = {
    "lost servo": (
        lambda rig: rig.emulator.inject(Fault.LOST_SERVO),
        RobotTimeoutError,
        r"servo 3 \(elbow_flex\): no answer; see to the cable",
    ),
    "overload": (
        lambda rig: rig.emulator.inject(Fault.OVERLOAD),
        RobotFaultError,
        r"servo 2 \(shoulder_lift\): it is overloaded: .*; then home again",
    ),
    "overheated": (
        lambda rig: rig.emulator.inject(Fault.OVERHEAT),
        RobotFaultError,
        r"servo 4 \(wrist_flex\): it is overheated \(31 °C\)",
    ),
    "voltage": (
        lambda rig: rig.emulator.inject(Fault.UNDERVOLTAGE),
        RobotFaultError,
        r"servo 1 \(shoulder_pan\): its supply is out of range \(7\.4 V\)",
    ),
    "current": (
        lambda rig: rig.emulator.inject(Fault.IMPACT),
        RobotFaultError,
        r"servo 3 \(elbow_flex\): it draws too much current",
    ),
    "checksum": (corrupt, GarbledReplyError, r"cut or its checksum wrong"),
    "unplugged": (
        lambda rig: rig.emulator.inject(Fault.UNPLUG),
        ConnectionLostError,
        "closed or unplugged",
    ),
    "stuck": (lambda rig: rig.emulator.inject(Fault.STICK), NotArrivedError, "stands at"),
}


@pytest.mark.parametrize("kind", FAULTS)
def test_a_fault_during_a_move_is_named_in_one_line(tmp_path, kind):
    inject, error, words = FAULTS[kind]
    with so101_rig(tmp_path, stall_s=0.3) as rig:
        rig.robot.move_to(NEAR)
        threading.Timer(0.1, lambda: inject(rig)).start()
        with pytest.raises(error, match=words) as caught:
            rig.robot.move_to(FAR)
        assert "\n" not in str(caught.value)
        assert np.linalg.norm(rig.true_m() - FAR.position_m) > 0.01
        wait_until(lambda: not rig.is_moving())


def test_a_garbled_answer_is_requested_again(tmp_path):
    with so101_rig(tmp_path) as rig:
        for fault in (Fault.GARBAGE, Fault.CUT, Fault.SILENT, Fault.GARBLED_INPUT):
            rig.emulator.inject(fault, count=1)
            assert rig.robot.pose().distance_m(Pose(*rig.true_m())) < COUNT_M


@pytest.mark.parametrize(
    ("lost", "words"),
    [
        (range(1, 7), "no servo answers; plug in the arm's own power supply"),
        ({3}, r"^servo 3 \(elbow_flex\): no answer"),
        ({5, 6}, r"^servo 5 \(wrist_roll\), servo 6 \(gripper\): no answer"),
    ],
)
def test_servos_that_do_not_answer_are_named(tmp_path, lost, words):
    with so101_rig(tmp_path, home=False) as rig:
        rig.bus.lost.update(lost)
        with pytest.raises(RobotTimeoutError, match=words):
            rig.robot.connect()


def test_the_calibration_of_another_arm_is_refused(tmp_path):
    with so101_rig(tmp_path, home=False) as rig:
        rig.bus.servos[2].memory[31:33] = bytes([10, 0])
        with pytest.raises(CommandRefusedError, match=r"servo 2 .* offset 10, .* says -1126"):
            rig.robot.connect()


def changed(name, **fields):
    return json.dumps({**CALIBRATION, name: {**CALIBRATION[name], **fields}})


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (None, "No such file"),
        ("{", "truncated"),
        ("[]", "Expected `object`"),
        (json.dumps({n: CALIBRATION[n] for n in NAMES[:5]}), "gripper missing"),
        (changed("elbow_flex", range_max=9999), "Expected `int` <= 4095"),
        (changed("elbow_flex", range_max=100), "elbow_flex ranges from 870 to 100"),
        (changed("elbow_flex", id=2), "two servos have one id"),
    ],
)
def test_an_invalid_calibration_is_refused_in_one_line(tmp_path, text, words):
    path = tmp_path / "arm.json"
    if text is not None:
        path.write_text(text)
    with pytest.raises(InvalidInputError, match=rf"calibration={path}: .*{words}"):
        open_robot(f"so101:///dev/ttyACM0?calibration={path}")


def test_an_so100_differs_only_by_its_lengths(tmp_path):
    (tmp_path / "arm.json").write_bytes(calibration_file())
    arms = [open_robot(f"{n}:///dev/x?calibration={tmp_path}/arm.json") for n in ("so100", "so101")]
    assert arms[0].shape.base_height_m == 0.119
    assert [arm.limits.reach_m for arm in arms] == pytest.approx([0.4398, 0.4406], abs=1e-4)
    with pytest.raises(InvalidInputError, match="missing required field `calibration`"):
        open_robot("so101:///dev/ttyACM0")
