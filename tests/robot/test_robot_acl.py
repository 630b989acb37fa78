"""Parsing of ACL: positions by label, errors by number, at any spacing and case."""

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fingerpost.robot.acl import ABORT, AXES, FAULTS, AclError, find_errors, parse_position
from fingerpost.robot.emulator.acl import AclController, AclStyle, forward, inverse
from fingerpost.robot.emulator.faults import Fault
from fingerpost.robot.errors import (
    CommandRefusedError,
    GarbledReplyError,
    OutOfReachError,
    RobotFaultError,
)

GUIDE = "1:0 2: 1791 3: 2746 4:0 5:-1\r\nX: 5197 Y:0 Z: 9963 P: 623 R:-3\r\n"


def test_the_listing_of_the_reference_guide_is_read():
    position = parse_position(GUIDE)
    assert position.counts == (0, 1791, 2746, 0, -1)
    assert position.coordinates == (5197, 0, 9963, 623, -3)


@given(
    counts=st.lists(st.integers(-99_999, 99_999), min_size=5, max_size=5),
    coordinates=st.lists(st.integers(-9_999, 9_999), min_size=5, max_size=5),
    data=st.data(),
)
def test_listings_are_read_by_label_at_any_spacing_and_case(counts, coordinates, data):
    def line(labels, values):
        words = []
        for label, value in zip(labels, values, strict=True):
            gaps = [" " * data.draw(st.integers(0, 3)) for _ in range(2)]
            case = label.lower() if data.draw(st.booleans()) else label
            words.append(f"{case}{gaps[0]}:{gaps[1]}{value}")
        return (" " * data.draw(st.integers(1, 3))).join(words)

    text = f"{line('12345', counts)}\r\n{line(AXES, coordinates)}\r\n"
    position = parse_position(text)
    assert position.counts == tuple(counts)
    assert position.coordinates == tuple(coordinates)


@given(
    place=st.integers(0, len(GUIDE)),
    noise=st.binary(min_size=1, max_size=3).map(lambda data: data.decode("latin-1")),
)
def test_noise_in_a_listing_is_refused_unless_it_could_be_part_of_a_number(place, noise):
    text = GUIDE[:place] + noise + GUIDE[place:]
    try:
        position = parse_position(text)
    except GarbledReplyError:
        return
    # Noise passes as digits, signs or spaces, or as a line of its own, never as letters inside.
    kept = re.sub(r"[\s\d+-]", "", noise)
    assert kept == "" or place in (0, len(GUIDE)) or position == parse_position(GUIDE)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "X: 5197 Y:0 Z: 9963 P: 623 R:-3",
        GUIDE.replace("Z: 9963 ", ""),
        GUIDE.replace("P:", "X:"),
        GUIDE + GUIDE,
        GUIDE.replace("5197", "51q97"),
        GUIDE.replace("5197", "51 97"),
        GUIDE.replace("5197", "5197\x80"),
        GUIDE.replace("5197", "519700000"),
    ],
)
def test_malformed_listings_are_refused(text):
    with pytest.raises(GarbledReplyError):
        parse_position(text)


@pytest.mark.parametrize(
    ("line", "number", "axis"),
    [
        ("*** 53 IMPACT PROTECTION AXIS 2", 53, 2),
        ("***   54   out of range", 54, None),
        ("*** ERROR 55: thermic overload, axis 3", 55, 3),
        ("*** Impact  Protection axis 4", 53, 4),
        ("*** no position assigned", 303, None),
        ("*** HOME FAILURE AXIS 3", None, 3),
        ("*** UNDEFINED POSITION FP01", None, None),
        (">*** 304 AXIS DISABLED", 304, None),
    ],
)
def test_errors_are_identified_by_number_or_by_text(line, number, axis):
    (error,) = find_errors(f"FP01\r\n{line}\r\n>")
    assert (error.number, error.axis) == (number, axis)


def test_only_complete_error_lines_count():
    assert find_errors("*** 53 IMP") == []
    assert find_errors("Done.\r\n>") == []
    assert [error.number for error in find_errors("*** 303 X\r\n>\r\n*** 53 Y\r\n")] == [303, 53]


@pytest.mark.parametrize("number", FAULTS)
def test_errors_concern_the_goal_the_arm_or_the_command(number):
    kinds = {**dict.fromkeys((54, 312, 317), OutOfReachError), 303: CommandRefusedError}
    error = AclError(number, None, "").exception()
    assert type(error) is kinds.get(number, RobotFaultError)
    assert FAULTS[number] in str(error)


# The emulated controller, byte for byte.


def converse(controller, data, now_s=0.0):
    controller.receive(data, now_s)
    return controller.poll(now_s)


def homed_controller(**style):
    controller = AclController(AclStyle(homing_s=10.0, **style))
    converse(controller, b"HOME\r")
    assert controller.poll(10.0) == b"HOMING COMPLETE (ROBOT)\r\n>"
    return controller


def test_golden_dialogue_with_the_controller():
    controller = AclController(AclStyle(homing_s=10.0))
    dialogue = [
        (0.0, b"\r", b"\r\n>"),
        (0.0, b"DEFP P1\r", b"DEFP P1\r\nDone.\r\n>"),
        (0.0, b"defp p1\r", b"defp p1\r\n*** POSITION P1 ALREADY DEFINED\r\n>"),
        (0.0, b"DEFP 1P\r", b"DEFP 1P\r\n*** BAD POSITION NAME\r\n>"),
        (0.0, b"DEFP ABCDEF\r", b"DEFP ABCDEF\r\n*** BAD POSITION NAME\r\n>"),
        (0.0, b"MOVE P1\r", b"MOVE P1\r\n*** 303 NO POSITION ASSIGNED\r\n>"),
        (0.0, b"SETPVC P1 X 250\r", b"SETPVC P1 X 250\r\n*** 303 NO POSITION ASSIGNED\r\n>"),
        (0.0, b"HERE P1\r", b"HERE P1\r\nDone.\r\n>"),
        (0.0, b"MOVE P1\r", b"MOVE P1\r\n*** 304 AXIS DISABLED\r\n>"),
        (0.0, b"HOME\r", b"HOME\r\nWAIT!! HOMING...\r\n"),
        (10.0, b"", b"HOMING COMPLETE (ROBOT)\r\n>"),
        (
            10.0,
            b"LISTPV POSITION\r",
            b"LISTPV POSITION\r\n1:0 2:0 3:0 4:0 5:0\r\nX: 5197 Y:0 Z: 9963 P: 623 R:-3\r\n>",
        ),
        (10.0, b"HERE P1\r", b"HERE P1\r\nDone.\r\n>"),
        (10.0, b"SETPVC P1 Q 250\r", b"SETPVC P1 Q 250\r\n*** 312 BAD POINT COORDINATE\r\n>"),
        (10.0, b"SETPVC P1 X 4500\r", b"SETPVC P1 X 4500\r\nDone.\r\n>"),
        (10.0, b"SETPVC P1 P 0\r", b"SETPVC P1 P 0\r\nDone.\r\n>"),
        (10.0, b"SETPVC P1 Z 5000\r", b"SETPVC P1 Z 5000\r\nDone.\r\n>"),
        (  # setting X and Z has changed P and R
            10.0,
            b"LISTPV P1\r",
            b"LISTPV P1\r\n1:0 2: 5402 3:-14959 4: 457 5:-28\r\nX: 4500 Y:0 Z: 5000 P: 4 R:-7\r\n>",
        ),
        (10.0, b"DEFP P2\r", b"DEFP P2\r\nDone.\r\n>"),
        (10.0, b"SETP P2=P1\r", b"SETP P2=P1\r\nDone.\r\n>"),
        (10.0, b"TEACH P2\r", b"TEACH P2\r\nX --[4500] >"),
        (10.0, b"3000\r", b"3000\r\nY --[0] >"),
        (10.0, b"\r", b"\r\nZ --[5000] >"),
        (10.0, b"\r", b"\r\nP --[4] >"),
        (10.0, b"\r", b"\r\nR --[-7] >"),
        (10.0, b"\r", b"\r\nDone.\r\n>"),
        (10.0, b"SETPV P1\r", b"SETPV P1\r\n1 -- [0] >"),
        (10.0, b"100\r", b"100\r\n2 -- [5402] >"),
        (10.0, b"x\r", b"x\r\n*** 312 BAD POINT COORDINATE\r\n>"),
        (10.0, b"SPEED 101\r", b"SPEED 101\r\n*** 312 BAD POINT COORDINATE\r\n>"),
        (10.0, b"SPEED 20\r", b"SPEED 20\r\nDone.\r\n>"),
        (10.0, b"JAW 40\r", b"JAW 40\r\nDone.\r\n>"),
        (10.0, b"OPEN\r", b"OPEN\r\nDone.\r\n>"),
        (10.0, b"COFF\r", b"COFF\r\nCONTROL DISABLED.\r\n>"),
        (10.0, b"CON\r", b"CON\r\nCONTROL ENABLED.\r\n>"),
        (10.0, b"MOVED P1\r", b"MOVED P1\r\n*** MOVED IS ALLOWED IN PROGRAMS ONLY\r\n>"),
        (10.0, b"FLY P1\r", b"FLY P1\r\n*** UNKNOWN COMMAND\r\n>"),
        (10.0, b"NOECHO\r", b"NOECHO\r\nDone.\r\n>"),
        (10.0, b"SPEED 20\r", b"Done.\r\n>"),
        (10.0, b"ECHO\r", b"Done.\r\n>"),
        (10.0, b"SPE", b"SPE"),
        (10.0, b"\x01", b"\r\n>"),
        (10.0, b"\r", b"\r\n>"),
        (10.0, b"SPEX\x08ED 30\r", b"SPEXED 30\r\nDone.\r\n>"),
        (10.0, b"A\r", b"A\r\nDone.\r\n>"),
    ]
    for now_s, sent, answer in dialogue:
        assert (sent, converse(controller, sent, now_s)) == (sent, answer)
    assert controller.speed_percent == 30
    assert controller.jaw_percent == 100


def test_a_long_listing_pauses_at_the_end_of_a_page():
    controller = AclController(AclStyle(page_lines=2))
    for name in (b"A1", b"B2", b"C3"):
        converse(controller, b"DEFP " + name + b"\r")
    assert converse(controller, b"LISTP\r") == b"LISTP\r\nA1\r\nB2\r\nType <cr>"
    assert converse(controller, b"\r") == b"\r\nC3\r\n>"


def test_failed_homing_names_the_axis():
    controller = AclController(AclStyle(homing_s=10.0))
    controller.inject(Fault.HOME_FAILURE, 0.0)
    converse(controller, b"HOME\r")
    assert controller.poll(10.0) == b"*** HOME FAILURE AXIS 3\r\n>"
    assert not controller.homed


def test_moves_are_queued_and_an_abort_clears_them():
    controller = homed_controller()
    converse(controller, b"DEFP P1\rHERE P1\rSETPVC P1 Z 6000\rSETPVC P1 P 0\r", 10.0)
    home = controller.units(10.0)
    for _ in range(5):
        converse(controller, b"MOVEL P1\r", 10.0)
    assert controller.is_moving(10.5)
    stopped = controller.units(10.5)
    assert not np.allclose(stopped, home)
    assert converse(controller, b"\x01", 10.5) == b"\r\n>"
    np.testing.assert_allclose(controller.units(99.0), stopped, atol=1e-6)


def test_a_linear_move_keeps_to_the_line_and_to_its_speed():
    controller = homed_controller()
    commands = b"SPEED 50\rDEFP P1\rHERE P1\rSETPVC P1 Y 2000\rSETPVC P1 Z 6000\r"
    converse(controller, commands + b"SETPVC P1 P 0\rSETPVC P1 R 0\rMOVEL P1\r", 10.0)
    start, goal = controller.units(10.0)[:3], np.array([5197.0, 2000.0, 6000.0])
    times_s = np.linspace(10.0, 12.0, 401)
    places = np.array([controller.units(t)[:3] for t in times_s])
    along = (places - start) @ (goal - start) / np.dot(goal - start, goal - start)
    np.testing.assert_allclose(places, start + along[:, None] * (goal - start), atol=1e-3)
    speeds_mm_s = np.linalg.norm(np.diff(places, axis=0), axis=1) / 10 / np.diff(times_s)
    assert speeds_mm_s.max() <= 500.0 * (1 + 1e-6)
    np.testing.assert_allclose(places[-1], goal, atol=1e-6)


def test_unreachable_goals_are_out_of_range():
    controller = homed_controller()
    converse(controller, b"DEFP P1\rHERE P1\rSETPVC P1 X 12000\r", 10.0)
    assert converse(controller, b"MOVEL P1\r", 10.0) == b"MOVEL P1\r\n*** 54 OUT OF RANGE\r\n>"
    assert not controller.is_moving(10.0)


def test_an_impact_stops_the_arm_and_switches_it_off():
    controller = homed_controller()
    converse(controller, b"DEFP P1\rHERE P1\rSETPVC P1 Z 6000\rSETPVC P1 P 0\r", 10.0)
    converse(controller, b"MOVEL P1\rLISTPV", 10.0)
    assert controller.is_moving(10.1)
    controller.inject(Fault.IMPACT, 10.2)
    assert controller.poll(10.2) == b"\r\n*** 53 IMPACT PROTECTION AXIS 2\r\n>"
    assert not controller.servos
    assert not controller.is_moving(10.2)


def test_an_xoff_holds_the_controllers_output_until_clrcom():
    controller = AclController()
    assert converse(controller, b"\x13\r") == b""
    assert converse(controller, b"CLRCOM\r") == b"\r\n>CLRCOM\r\nDone.\r\n>"


def test_abort_bytes_act_in_the_middle_of_a_line_and_never_complete_it():
    controller = homed_controller()
    converse(controller, b"DEFP P1\rHERE P1\rSETPVC P1 Z 6000\rSETPVC P1 P 0\r", 10.0)
    before = len(controller.moves)
    converse(controller, b"MOVEL P1" + ABORT, 10.0)
    assert len(controller.moves) == before


@given(st.floats(3600, 5000), st.floats(-2500, 2500), st.floats(300, 2000), st.floats(-1700, 1700))
def test_forward_and_inverse_kinematics_agree(x, y, z, roll):
    units = np.array([x, y, z, -900.0, roll])
    joints = inverse(units)
    if joints is not None:
        np.testing.assert_allclose(forward(joints), units, atol=1e-6)
