"""Following over a simulated line of 9600 baud, and moving the arm out of the way.

At that rate, one reading of a moving arm takes as long as the maximum age of a fix. In a `SlowCell`
time passes only while the driver waits for bytes, so nothing depends on the machine.
"""

import threading
import time
from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import pytest
from guard_rig import SURE, fix_at
from robot_rig import TIME_SCALE, pose_of
from test_robot_guard import scorbot_guard

from fingerpost.closed_loop.line import LineToScorbot
from fingerpost.finding import Hand
from fingerpost.guidance import Attendance, Session
from fingerpost.pointing import FingerLine, Status
from fingerpost.robot import (
    TOOL_DOWN_RAD,
    ConnectionLostError,
    DwellSelector,
    Follower,
    FollowState,
    Guard,
    GuardOptions,
    PickPlaceOptions,
    RobotFaultError,
    RobotPlane,
    SafeRegion,
)
from fingerpost.robot.emulator.acl import AclController, AclStyle
from fingerpost.robot.emulator.faults import Fault
from fingerpost.robot.guard import WATCH_S
from fingerpost.robot.scorbot import ScorbotOptions

FRAME_S = 1 / 30
START, GOAL = (60.0, 200.0), (60.0, 350.0)
STOPPED_S = 0.05
"""Limit from the guard's decision to the standstill; the line accepts ABORT at once."""


class SlowCell:
    """A Scorbot at 9600 baud, its guard and watch, and a hand that is visible in every frame."""

    def __init__(self, **options):
        self.now_s = 0.0
        self.target, self.status, self.looking = START, Status.OK, True
        self.guard = None
        self._frame_s = self._watch_s = 0.0
        self.controller = AclController(AclStyle(homing_s=1.0))
        self.line = LineToScorbot(self.controller, lambda: self.now_s, self._pass, ScorbotOptions())
        self._options = GuardOptions(operator_timeout_s=1e6, **options)

    @property
    def fix(self):
        return fix_at(self.target, self.now_s, status=self.status)

    @property
    def point(self):
        pose = pose_of(self.controller.units(self.now_s))
        return self.guard.plane.point(pose.position_m[:2])

    @property
    def moving(self):
        return self.controller.is_moving(self.now_s)

    def _pass(self, span_s):
        end_s = self.now_s + span_s
        while self.guard is not None and min(self._frame_s, self._watch_s) <= end_s:
            self.now_s = max(self.now_s, min(self._frame_s, self._watch_s))
            if self._frame_s <= self.now_s:
                self._frame_s += FRAME_S
                if self.looking:
                    self.guard.observe(self.fix)
            if self._watch_s <= self.now_s:
                self._watch_s += WATCH_S
                self.guard.check()
        self.now_s = max(self.now_s, end_s)

    def wait(self, span_s):
        self.line._plugged.serve()
        self._pass(span_s)
        self.line._plugged.serve()

    def follow(self, follower, span_s):
        end_s, reports = self.now_s + span_s, []
        while self.now_s < end_s:
            self.wait(FRAME_S)
            reports.append(follower.update(self.fix))
        return reports

    @contextmanager
    def ready(self):
        tie = np.array([[1e-3, 0, 0.36], [0, 1e-3, -0.2], [0, 0, 1.0]])
        plane = RobotPlane(tie, 0.02, pitch_rad=TOOL_DOWN_RAD, roll_rad=0.0)
        region = SafeRegion([[0, 0], [120, 0], [120, 400], [0, 400]], 0.01, 0.2)
        with self.line:
            guard = Guard(self.line.robot, plane, region, self._options, clock=lambda: self.now_s)
            guard.arm()
            guard.enter()
            self.guard, self._frame_s, self._watch_s = guard, self.now_s, self.now_s
            yield self


def states(reports):
    return {report.state for report in reports}


def test_the_defaults_follow_at_9600_baud_without_a_hold():
    with SlowCell().ready() as cell:
        follower = Follower(cell.guard)
        cell.follow(follower, 4.0)
        cell.target = GOAL
        reports = cell.follow(follower, 6.0)
        assert reports[-1].state is FollowState.THERE
        assert FollowState.HOLDING not in states(reports)
        np.testing.assert_allclose(cell.point, GOAL, atol=3.5)
        # The dialogue is as slow as a real one: reading a moving arm takes three exchanges.
        cell.target = START
        begin_s = cell.now_s
        cell.follow(follower, 1e-3)
        cell.guard.where()
        assert cell.now_s - begin_s > 0.5


def test_a_fix_that_expires_during_a_reading_is_a_hold_with_its_reason():
    with SlowCell(max_fix_age_s=0.2).ready() as cell:
        follower = Follower(cell.guard)
        cell.follow(follower, 4.0)
        cell.target = GOAL
        cell.follow(follower, 0.5)
        assert cell.moving
        cell.looking = False  # from now on, fixes reach the follower only
        reports = cell.follow(follower, 2.0)
        held = [report for report in reports if report.state is FollowState.HOLDING]
        assert held
        assert all("old; at most 0.2 s" in report.reason for report in held)
        assert cell.guard.armed
        cell.looking = True
        assert cell.follow(follower, 8.0)[-1].state is FollowState.THERE


@pytest.mark.parametrize("gone", ["lost", "no more frames"])
def test_a_loss_during_an_exchange_stops_the_arm_in_time(gone):
    with SlowCell().ready() as cell:
        follower = Follower(cell.guard)
        cell.follow(follower, 4.0)
        cell.target = GOAL
        while not cell.moving:
            cell.follow(follower, 1e-3)
        aborts, gone_s = cell.controller.aborts, cell.now_s
        limit_s = FRAME_S
        if gone == "lost":
            cell.status = Status.LOST
        else:
            cell.looking = False
            limit_s = cell.guard.options.max_fix_age_s
        while cell.controller.aborts == aborts:
            cell.wait(0.005)
            assert cell.now_s - gone_s <= limit_s + WATCH_S + STOPPED_S
        cell.wait(STOPPED_S)
        assert not cell.moving
        assert cell.guard.armed
        cell.status, cell.looking = Status.LOST, True
        (report,) = cell.follow(follower, 1e-3)
        assert (report.state, report.reason) == (FollowState.HOLDING, "fix is lost")


def test_the_arm_moves_out_of_the_way_upwards_then_towards_its_base():
    with SlowCell().ready() as cell:
        cell.follow(Follower(cell.guard), 4.0)
        moves = len(cell.controller.moves)
        low = cell.point
        cell.guard.make_way()
        up, away = (np.array(move.goal_units[:3]) * 1e-4 for move in cell.controller.moves[moves:])
        np.testing.assert_allclose(cell.guard.plane.point(up[:2]), low, atol=0.2)
        assert up[2] == pytest.approx(away[2]) == pytest.approx(0.22, abs=0.0015)
        # The region spans X 0.36 … 0.48 and Y -0.2 … 0.2; nearest to X = Y = 0, less the rim:
        np.testing.assert_allclose(away[:2], [0.361, 0.0], atol=2e-4)


# In a session with threads.


FINGER = FingerLine([20.0, 20.0], 0.0, np.diag([1e-2, 1e-4]), [50.0, 20.0], 0.0)


def step(fix):
    """Return a step with one view, which shows a finger if the fix is good."""
    finger = FINGER if fix.status is Status.OK else fix.status
    return SimpleNamespace(fix=fix, observations=(SimpleNamespace(finger=finger),), hand=HAND)


HAND = Hand(number=1, is_presented=True)


@contextmanager
def hidden_hand(*, dwell_s=None, attendance=Attendance.HAND, **fields):
    """Start a session in which the lowered arm hides the hand; also yield its messages."""
    with scorbot_guard() as (rig, guard):
        selector = None if dwell_s is None else DwellSelector(guard, dwell_s=dwell_s)
        fix = fix_at([100, 60], rig.clock())
        guard.move([100, 60], 0.05, fix=fix, needs="operator")
        guard.options = GuardOptions(operator_timeout_s=25.0, max_fix_age_s=15.0)
        said = []
        with (
            guard.watching(),
            Session(
                guard,
                Follower(guard),
                attendance=attendance,
                selector=selector,
                keys=True,
                say=said.append,
                **fields,
            ) as session,
        ):
            yield rig, guard, session, said


def lost(rig):
    return fix_at(None, rig.clock(), status=Status.LOST)


def vague(rig):
    """A fix whose ellipse is too large for a robot, as when the arm hides a part of the finger."""
    return fix_at([100, 60], rig.clock(), covariance=1e4 * SURE)


def takes(rig, session, until, *, seen=lost, press="", within_s=5.0):
    """Feed frames without a usable fix, and repeated keys, until a condition holds."""
    end_s = time.monotonic() + within_s
    while not until():
        assert time.monotonic() < end_s
        for key in press:
            session.press(key)
        session.take(step(seen(rig)))
        time.sleep(0.005)


def above_m(rig, guard):
    return guard.plane.above_m(rig.true_pose())


@pytest.mark.parametrize("seen", [lost, vague])
def test_the_arm_does_not_make_way_by_itself_but_the_operator_is_advised(seen):
    with hidden_hand() as (rig, guard, session, said):
        session.take(step(fix_at([100, 60], rig.clock())))
        moves = len(rig.controller.moves)
        takes(rig, session, lambda: any("hold w" in line for line in said), seen=seen)
        end_s = time.monotonic() + 0.3
        takes(rig, session, lambda: time.monotonic() > end_s, seen=seen)
        assert sum("hold w" in line for line in said) == 1
        assert above_m(rig, guard) == pytest.approx(0.05, abs=0.004)
        assert len(rig.controller.moves) - moves <= 1  # of the first fix


@pytest.mark.parametrize("attendance", list(Attendance))
def test_the_arm_makes_way_while_the_key_is_held(attendance):
    with hidden_hand(attendance=attendance) as (rig, guard, session, said):
        moves = len(rig.controller.moves)
        takes(rig, session, lambda: "out of the way" in said, press="w")
        assert guard.armed
        assert above_m(rig, guard) == pytest.approx(0.199, abs=0.001)
        end_s = time.monotonic() + 0.2
        takes(rig, session, lambda: time.monotonic() > end_s, press="w")
        assert len(rig.controller.moves) - moves == 2  # a key still held does not move it again


def test_releasing_the_key_stops_the_arm():
    with hidden_hand() as (rig, guard, session, said):
        timeout_s = 10.0  # of about 30 s for the path at this speed
        guard.options = GuardOptions(operator_timeout_s=timeout_s, max_speed_m_s=0.01)
        takes(rig, session, rig.is_moving, press="w")
        session.press("w")
        let_go_s = rig.clock()
        takes(rig, session, lambda: not guard.armed)
        assert rig.clock() - let_go_s < timeout_s + 0.2 * TIME_SCALE
        takes(rig, session, lambda: not rig.is_moving())
        assert "out of the way" not in said
        takes(rig, session, lambda: "stopped: the operator is gone" in " ".join(said))


def test_the_stop_key_stops_the_arm_at_once():
    with hidden_hand() as (rig, guard, session, _):
        takes(rig, session, rig.is_moving, press="w")
        stopper = threading.Thread(target=lambda: session.press("x"))
        stopper.start()
        stopper.join()
        assert not guard.armed
        takes(rig, session, lambda: not rig.is_moving())


@pytest.mark.parametrize(
    ("stop", "why"),
    [
        (lambda _guard, session: session.press("x"), "stopped by key"),
        (lambda guard, _session: guard.hold("fix is lost"), "fix is lost"),
    ],
)
def test_a_failed_stop_is_reported_as_failed(stop, why):
    def stop_unplugged():
        with hidden_hand() as (rig, guard, session, said):
            rig.emulator.inject(Fault.UNPLUG)
            stop(guard, session)
            assert not guard.armed
            session.take(step(fix_at(None, rig.clock(), status=Status.LOST)))
            (line,) = [line for line in said if line.startswith("stopped: ")]
            assert f"stopped: {why}; the stop failed, so the arm may still move" in line

    with pytest.raises(ConnectionLostError):  # the session ends with an error, too
        stop_unplugged()


def test_a_later_failure_of_a_stop_is_reported_as_well():
    def pull_the_plug_on_a_stop():
        with hidden_hand() as (rig, guard, session, said):
            stop, seen, failed = rig.robot.stop, threading.Event(), False

            def stop_unplugged():
                nonlocal failed
                if not failed:
                    failed = True
                    assert seen.wait(5.0)
                    rig.emulator.inject(Fault.UNPLUG)
                stop()

            rig.robot.stop = stop_unplugged
            stopper = threading.Thread(target=lambda: session.press("x"))
            stopper.start()
            takes(rig, session, lambda: "stopped: stopped by key" in " ".join(said))
            seen.set()
            stopper.join()
            assert not guard.armed
            takes(rig, session, lambda: "the arm may still move" in " ".join(said))

    with pytest.raises(ConnectionLostError):
        pull_the_plug_on_a_stop()


def test_a_fault_after_the_last_frame_is_raised():
    def end_with_a_fault():
        with hidden_hand() as (rig, _, session, _said):
            rig.emulator.inject(Fault.IMPACT)
            session.take(step(fix_at([60, 350], rig.clock())))
            end_s = time.monotonic() + 5.0
            while not session._worker.idle:
                assert time.monotonic() < end_s
                time.sleep(0.005)

    with pytest.raises(RobotFaultError, match="IMPACT"):
        end_with_a_fault()


def test_a_session_selects_when_the_arm_stands_where_the_hand_points():
    dwell_s = 10.0  # 0.2 s of real time
    with hidden_hand(dwell_s=dwell_s, carry=PickPlaceOptions()) as (rig, guard, session, said):
        place = np.array([60.0, 350.0])
        end_s = time.monotonic() + 10.0
        while not any("block at" in line for line in said):
            assert time.monotonic() < end_s
            away = np.linalg.norm(guard.plane.point(rig.true_pose().position_m[:2]) - place)
            session.take(step(fix_at(place, rig.clock())))
            if away > 10.0:
                assert session._dwell.progress == 0.0
            time.sleep(0.005)
        assert away < 4.0
        assert not rig.is_moving()
