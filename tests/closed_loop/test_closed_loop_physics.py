"""The robot cell with physics: kinematics, rendering, grip, contact, and the serial line."""

import contextlib

import numpy as np
import pytest

from fingerpost.capture import Frame
from fingerpost.closed_loop.layout import WORKSPACE_MM, CameraPlacement
from fingerpost.closed_loop.line import BITS_PER_BYTE
from fingerpost.closed_loop.physics import JAW_M, Optics, PhysicalCell
from fingerpost.closed_loop.scene import CARD_MARKER_MM, CARD_MARKER_UP_MM, SPIKE_MM
from fingerpost.closed_loop.setup import SCORBOT, scorbot_in
from fingerpost.closed_loop.world import World
from fingerpost.guidance import MarkerFinder
from fingerpost.robot import TOOL_DOWN_RAD, Pose, RobotFaultError
from fingerpost.robot.emulator.acl import JOINT_LIMITS_RAD, forward, inverse
from fingerpost.robot.scorbot import ScorbotOptions
from fingerpost.simulate import DevicePose, Hand, SimulatedRig

STILL_MM = 0.3
"""Position error of an arm at rest: encoder steps and the motors' compliance."""


def new_cell(**optics) -> PhysicalCell:
    return PhysicalCell(
        CameraPlacement().cameras(),
        Hand().body,
        rng=np.random.default_rng(0),
        optics=Optics(**optics),
    )


@pytest.fixture
def cell():
    cell = new_cell()
    yield cell
    cell.close()


@contextlib.contextmanager
def driven(cell, options=SCORBOT):
    """Yield the cell's world and the line with a homed driver."""
    world = World(cell, 20.0)
    with scorbot_in(cell, world, options) as line:
        yield world, line


def stand(cell, x_mm, y_mm, z_mm):
    """Place the arm instantaneously, with the gripper pointing down."""
    joints = inverse(np.array([10 * x_mm, 10 * y_mm, 10 * z_mm, -900.0, 0.0]))
    cell.put_arm(joints)


def over(x_mm, y_mm, z_mm):
    return Pose(x_mm / 1000, y_mm / 1000, z_mm / 1000, pitch_rad=TOOL_DOWN_RAD, roll_rad=0.0)


def test_the_kinematics_match_the_controllers(cell):
    rng = np.random.default_rng(1)
    for _ in range(50):
        joints = rng.uniform(*JOINT_LIMITS_RAD.T)
        cell.put_arm(joints)
        assert cell.gripper_mm == pytest.approx(forward(joints)[:3] / 10, abs=1e-6)


def test_rendering_matches_the_camera_matrices():
    # The rendered hand, compared with the exact outlines of the simulated rig.
    cell = new_cell(blur_px=0.0, noise=0.0, samples=4)
    pose = DevicePose.pointing_at((430.0, 10.0), hover_mm=90, azimuth_deg=155, slant_deg=40)
    cell.put_block((900.0, 0.0), 0.0)
    empty = cell.picture()
    cell.put_hand(pose)
    drawn = cell.picture()
    cell.close()
    exact = SimulatedRig(cell.cameras, device=Hand()).render(pose, rng=0)
    bare = SimulatedRig(cell.cameras, device=Hand()).render(None, rng=0)
    for before, after, hand, table in zip(empty, drawn, exact.images, bare.images, strict=True):
        seen = np.abs(after.astype(int) - before).max(axis=-1) > 20
        true = np.abs(hand.astype(int) - table) > 40
        assert true.sum() > 5000
        assert (seen ^ true).sum() < 0.02 * true.sum()


def test_the_card_marks_the_gripper_position(cell):
    finder = MarkerFinder(0, tip=(0.0, (CARD_MARKER_UP_MM + SPIKE_MM) / CARD_MARKER_MM))
    cell.shows_card = True
    errors = []
    for x_mm, y_mm in WORKSPACE_MM:
        stand(cell, x_mm, y_mm, SPIKE_MM)
        for camera, image in zip(cell.cameras, cell.picture(), strict=True):
            found = finder.find(0, [Frame(0, 0.0, image)], [])
            errors.append(found.pixel_px - camera.project((x_mm, y_mm, 0.0)))
    assert np.sqrt(np.mean(np.square(errors))) < 0.5


def carry_up(cell):
    """Grip the block by the driver and lift it; return its height [mm]."""
    cell.put_block((420.0, 60.0), 0.15)
    with driven(cell) as (_, line):
        robot = line.robot
        robot.gripper("open")
        robot.move_to(over(424.0, 55.0, 60.0))
        robot.move_to(over(424.0, 55.0, 15.0))
        robot.gripper("close")
        robot.move_to(over(424.0, 55.0, 90.0), speed_m_s=0.1)
        assert cell.gripper_mm == pytest.approx([424.0, 55.0, 90.0], abs=STILL_MM)
    return cell.block_mm[2]


def test_friction_lifts_the_block(cell):
    assert carry_up(cell) > 70.0
    assert cell.contacts.gripped
    assert cell.jaw * 2 * JAW_M == pytest.approx(0.03, abs=0.003)
    assert cell.contacts.table_steps == 0


def test_without_friction_the_block_stays(cell):
    cell.oil_the_pads()
    assert carry_up(cell) == pytest.approx(15.0, abs=1.0)
    assert not cell.contacts.gripped


def test_the_driver_reads_the_simulated_position(cell):
    with driven(cell) as (world, line):
        line.robot.move_to(over(400.0, -50.0, 120.0), wait=False)
        for _ in range(5):
            world.advance(0.3)
            before = cell.gripper_mm
            reported = 1000 * line.robot.pose().position_m
            # The reading is slightly old on arrival, so it lies on the path.
            way = np.linalg.norm(cell.gripper_mm - before)
            assert np.linalg.norm(reported - before) <= way + STILL_MM
            assert way > 1.0


def test_contact_with_the_table_is_detected(cell):
    careless = ScorbotOptions(lower_m=(-0.6, -0.6, -0.2), upper_m=SCORBOT.upper_m)
    with driven(cell, careless) as (_, line):
        line.robot.move_to(over(450.0, 0.0, 30.0))
        assert cell.contacts.table_steps == 0
        line.robot.move_to(over(450.0, 0.0, 8.0), wait=False)
        line.robot.pose()
        with pytest.raises(RobotFaultError, match="impact"):
            line.robot.move_to(over(450.0, 0.0, -180.0))
        assert cell.contacts.table_steps > 0
        assert cell.contacts.table_n > 1.0
        assert cell.gripper_mm[2] > 0.0


def test_sessions_are_reproducible_byte_for_byte():
    def conversation():
        cell = new_cell()
        cell.put_block((420.0, 60.0), 0.1)
        with driven(cell) as (world, line):
            line.robot.move_to(over(420.0, 60.0, 15.0))
            line.robot.gripper("close")
            line.robot.stop()
            sent = line.transfers
        return sent, world.time_s, cell.block_mm.tolist()

    assert conversation() == conversation()


def test_bytes_take_their_transmission_time(cell):
    with driven(cell) as (world, line):
        line.robot.move_to(over(420.0, 60.0, 100.0))
        before_s, before = world.time_s, line.answered_bytes
        line.robot.pose()
        span_s, count = world.time_s - before_s, line.answered_bytes - before
        assert count > 80
        assert span_s == pytest.approx(count * BITS_PER_BYTE / SCORBOT.baud, rel=0.01)
