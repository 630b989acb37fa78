"""Sessions move the arm by the operator's hand alone; other hands, and the start of a session."""

import contextlib
from types import SimpleNamespace

import numpy as np
import pytest
from robot_rig import ManualClock
from test_robot_guard import fix_at

from fingerpost.finding import Hand
from fingerpost.guidance import Attendance, Session, Turns
from fingerpost.guidance.session import STRANGER
from fingerpost.pointing import FingerLine, Status
from fingerpost.robot import (
    Follower,
    Guard,
    GuardOptions,
    NotArmedError,
    RobotPlane,
    SafeRegion,
    SimulatedRobot,
)

REGION = SafeRegion(np.array([[0.2, -0.2], [0.5, -0.2], [0.5, 0.2], [0.2, 0.2]]), 0.02, 0.3)
FINGER = FingerLine(np.zeros(2), 0.0, np.eye(2), np.array([1.0, 0.0]), 0.0)
TIMEOUT_S = 1.0


class Stage:
    """A session with a simulated robot in simulated time."""

    def __init__(self, *, attendance=Attendance.KEY, keys=True):
        self.clock = ManualClock()
        self.robot = SimulatedRobot(clock=self.clock, sleep=self.sleep)
        self.guard = Guard(
            self.robot,
            RobotPlane.same(0.0),
            REGION,
            GuardOptions(operator_timeout_s=TIMEOUT_S),
            clock=self.clock,
        )
        self.said = []
        self.turns = Turns()
        self.held = ""
        self.session = Session(
            self.guard,
            Follower(self.guard),
            attendance=attendance,
            keys=keys,
            worker=self.turns,
            sleep=self.sleep,
            say=self.said.append,
        )
        self.robot.connect()
        self.robot.home()

    def sleep(self, span_s):
        """Advance the time in small steps, with keys held down and the guard checking."""
        end_s = self.clock() + span_s
        while self.clock() < end_s:
            self.clock.sleep(min(0.02, end_s - self.clock()))
            for key in self.held:
                self.session.press(key)
            self.guard.check()

    def show(self, point, hand, frames=15):
        """Show a hand that points at a place for some frames."""
        for _ in range(frames):
            status = Status.OK if point is not None else Status.LOST
            fix = fix_at(point, self.clock(), 1e-6 * np.eye(2), status=status)
            seen = SimpleNamespace(finger=FINGER if point is not None else status)
            self.session.take(SimpleNamespace(fix=fix, observations=(seen,), hand=hand))
            self.turns.run()
            self.sleep(1 / 30)

    @property
    def moves(self):
        """The follower's move commands."""
        return [record for record in self.guard.records if record.command == "move"]


@contextlib.contextmanager
def begun(**fields):
    stage = Stage(**fields)
    stage.held = " "
    with stage.session:
        stage.session.begin()
        yield stage


def test_an_unconfirmed_hand_moves_nothing():
    with begun() as stage:
        before = stage.robot.position.copy()
        stage.show([0.4, 0.1], Hand(1))
        assert not stage.moves
        assert stage.robot.position == pytest.approx(before)
        assert stage.guard.newest_fix.reason == STRANGER
        assert sum(line.startswith(STRANGER) for line in stage.said) == 1
        assert stage.session.sees_stranger
        stage.show([0.4, 0.1], Hand(1, is_presented=True))
        assert not stage.session.sees_stranger


def test_a_hand_presented_at_its_template_is_followed():
    with begun() as stage:
        stage.show([0.4, 0.1], Hand(1, is_presented=True), frames=120)
        assert stage.session.has_hand
        assert stage.robot.position[:2] == pytest.approx([0.4, 0.1], abs=0.005)


def test_a_key_confirms_the_hand_that_is_tracked_now():
    with begun() as stage:
        stage.session.press("h")
        stage.show(None, Hand(), frames=3)
        assert not stage.session.has_hand  # no hand was tracked
        stage.show([0.4, 0.1], Hand(1), frames=3)
        stage.session.press("h")
        stage.show([0.4, 0.1], Hand(1), frames=120)
        assert stage.robot.position[:2] == pytest.approx([0.4, 0.1], abs=0.005)


def test_another_hand_does_not_take_the_operators_place():
    with begun() as stage:
        stage.show([0.4, 0.1], Hand(1, is_presented=True), frames=120)
        moves = len(stage.moves)
        stage.show([0.3, -0.1], Hand(2), frames=120)
        assert len(stage.moves) == moves
        assert stage.robot.position[:2] == pytest.approx([0.4, 0.1], abs=0.005)
        stage.show([0.3, -0.1], Hand(2, is_presented=True), frames=150)
        assert stage.robot.position[:2] == pytest.approx([0.3, -0.1], abs=0.005)


def test_the_arm_moves_only_while_a_key_is_held():
    stage = Stage()
    with stage.session:
        stage.clock.at(stage.clock() + 5.0, lambda: setattr(stage, "held", " "))
        before = stage.robot.position.copy()
        stage.clock.at(
            stage.clock() + 4.9, lambda: np.testing.assert_array_equal(stage.robot.position, before)
        )
        stage.session.begin()
        assert stage.said[0].startswith("hold the space bar down")
        assert stage.guard.armed
        stage.show([0.5, 0.2], Hand(1, is_presented=True), frames=6)
        assert stage.guard.busy
        stage.held = ""
        stage.show([0.5, 0.2], Hand(1, is_presented=True), frames=round(30 * TIMEOUT_S) + 3)
        assert not stage.guard.armed
        assert "stopped: the operator is gone" in " ".join(stage.said)


def test_a_stopped_entry_resumes_at_the_continue_key():
    stage = Stage()
    stage.held = " "
    with stage.session:
        stage.clock.at(stage.clock() + 0.3, lambda: stage.session.press("x"))
        stage.clock.at(stage.clock() + 3.0, lambda: stage.session.press("c"))
        stage.session.begin()
        assert any(line.startswith("stopped: stopped by key") for line in stage.said)
        assert stage.guard.armed
        assert stage.robot.position[:3] == pytest.approx(
            [*REGION.centre, REGION.highest_m], abs=0.002
        )


def test_the_quit_key_ends_the_wait_for_a_key():
    stage = Stage()
    with stage.session:
        stage.clock.at(stage.clock() + 1.0, lambda: stage.session.press("q"))
        stage.session.begin()
        assert stage.session.done
        assert not stage.guard.armed


def test_without_keys_a_stopped_entry_ends_the_session():
    stage = Stage(attendance=Attendance.HAND, keys=False)

    def begin():
        with stage.session:
            stage.clock.at(stage.clock() + 0.3, lambda: stage.guard.halt("a fault"))
            stage.session.begin()

    with pytest.raises(NotArmedError, match="a fault"):
        begin()


def test_another_persons_hand_is_no_sign_of_the_operator():
    with begun(attendance=Attendance.HAND) as stage:
        stage.held = ""
        stage.show([0.5, 0.2], Hand(1, is_presented=True), frames=6)
        assert stage.guard.busy
        other = fix_at([0.3, 0.0], stage.clock(), 1e-6 * np.eye(2))
        seen = SimpleNamespace(finger=FINGER)
        heartbeat_s = stage.guard._heartbeat_s
        stage.session.take(SimpleNamespace(fix=other, observations=(seen,), hand=Hand(2)))
        assert stage.guard._heartbeat_s == heartbeat_s
        stage.guard.check()
        assert not stage.guard.busy  # the motion by the first hand's fix is held


def test_an_arm_that_has_lost_its_position_is_homed_at_the_continue_key():
    with begun() as stage:
        stage.session._home = stage.robot.home
        stage.show([0.4, 0.1], Hand(1, is_presented=True), frames=30)
        stage.robot._homed = False  # like an arm without encoders that was stopped in motion
        stage.show([0.45, 0.15], Hand(1, is_presented=True), frames=10)
        assert not stage.guard.armed
        assert "home" in " ".join(stage.said)
        stage.session.press("c")
        stage.show([0.45, 0.15], Hand(1, is_presented=True), frames=150)
        assert stage.guard.armed
        assert stage.robot.position[:2] == pytest.approx([0.45, 0.15], abs=0.005)


def test_turns_run_only_the_newest_waiting_job():
    done = []
    with Turns() as turns:
        turns.offer(lambda: done.append("first"))
        turns.offer(lambda: done.append("second"))
        assert not turns.idle
        assert turns.run()
        assert not turns.run()
    assert done == ["second"]


def test_a_job_may_offer_the_next_one_and_its_error_is_raised_at_the_next_check():
    done = []

    def first():
        turns.offer(second)
        assert not turns.idle
        done.append("first")

    def second():
        raise ValueError("a job's")

    turns = Turns()
    turns.offer(first)
    assert turns.run()
    turns.check()
    assert turns.run()
    with pytest.raises(ValueError, match="a job's"):
        turns.check()
    turns.offer(lambda: done.append("third"))
    assert not turns.run()
    assert done == ["first"]
