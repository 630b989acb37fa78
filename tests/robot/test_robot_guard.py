"""The guard: conditions of motion, causes of stops, command log and watch."""

import math
import os
import signal
import threading
import time
from contextlib import contextmanager

import numpy as np
import pytest
from guard_rig import CENTRE, PATIENT, PLANE, REGION, TIE, fix_at, guard_rig
from hypothesis import given, settings
from hypothesis import strategies as st
from robot_rig import TIME_SCALE, ManualClock, fast_options, patience, scorbot_rig

from fingerpost.errors import InvalidInputError, RecordingError
from fingerpost.pointing import Status
from fingerpost.robot.emulator.acl import AclStyle
from fingerpost.robot.emulator.faults import Fault
from fingerpost.robot.errors import (
    ConnectionLostError,
    NotArmedError,
    NotHomedError,
    NotReadyError,
    OutOfReachError,
    RefusedError,
    RobotFaultError,
    RobotTimeoutError,
    StoppedError,
)
from fingerpost.robot.follow import Follower, FollowOptions
from fingerpost.robot.guard import Guard, GuardOptions, Presence
from fingerpost.robot.plane import RobotPlane
from fingerpost.robot.protocol import TOOL_DOWN_RAD, Limits, RobotState, RobotStatus
from fingerpost.robot.region import SafeRegion
from fingerpost.robot.simulated import SIMULATED_LIMITS, SimulatedOptions, SimulatedRobot
from fingerpost.uncertainty import confidence_ellipse

# Preconditions of motion.


def test_nothing_moves_before_it_is_armed():
    with guard_rig(arm=False) as rig:
        for act in (
            lambda: rig.guard.move(CENTRE, 0.1, fix=rig.fix(), needs=Presence.FIX),
            lambda: rig.guard.gripper("close", fix=rig.fix()),
            rig.guard.enter,
        ):
            with pytest.raises(NotArmedError, match="arm"):
                act()
        assert not rig.is_moving()
        assert rig.robot.opening == 1.0
        assert {record.outcome for record in rig.guard.records} == {"not armed"}


def test_nothing_is_armed_before_homing():
    with guard_rig(home=False) as rig:
        with pytest.raises(NotHomedError):
            rig.guard.arm()
        rig.robot.close()
        with pytest.raises(NotReadyError, match="disconnected"):
            rig.guard.arm()
        assert not rig.guard.armed


def test_nothing_is_armed_without_limits_or_beyond_them():
    with guard_rig(arm=False) as rig:
        rig.robot._limits = None
        with pytest.raises(NotReadyError, match="no limits"):
            rig.guard.arm()
        rig.robot._limits = Limits(
            lower_m=(0.0, -0.3, 0.0),
            upper_m=(0.4, 0.3, 0.5),
            max_speed_m_s=0.1,
            angles=SIMULATED_LIMITS.angles,
        )
        with pytest.raises(OutOfReachError, match=r"corner \(299, 1\): x = 0\.4990"):
            rig.guard.arm()
        assert not rig.guard.armed


def test_an_arm_outside_the_region_must_enter_first():
    with guard_rig(enter=False) as rig:
        rig.robot.move_to(PLANE.pose([-100.0, 200.0], 0.1))
        with pytest.raises(RefusedError, match="enter"):
            rig.guard.move(CENTRE, 0.1, fix=rig.fix(), needs=Presence.FIX)
        rig.guard.enter()
        point, above_m = rig.guard.where()
        np.testing.assert_allclose(point, CENTRE, atol=1.0)
        assert above_m == pytest.approx(0.199, abs=1e-3)
        rig.guard.move(CENTRE, 0.1, fix=rig.fix(), needs=Presence.FIX)


def test_a_region_beyond_the_horizon_is_refused():
    beyond = RobotPlane(np.array([[1e-3, 0, 0.2], [0, 1e-3, -0.2], [-0.01, 0, 1.0]]), 0.02)
    with pytest.raises(InvalidInputError, match="horizon"):
        Guard(SimulatedRobot(), beyond, REGION)


# Acceptable fixes.


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"status": Status.LOST}, "fix is lost"),
        ({"status": Status.ACQUIRING}, "fix is acquiring"),
        ({"status": Status.ILL_CONDITIONED}, "fix is ill_conditioned"),
        ({"age_s": 0.31}, r"fix is 0\.310 s old"),
        ({"age_s": -0.5}, r"fix is -0\.500 s old"),
        ({"covariance": 25.0 * np.eye(2)}, r"95 % ellipse reaches 12\.2 mm; at most 10 mm"),
        ({"covariance": np.diag([1.0, 17.0])}, "ellipse"),
        ({"covariance": -np.eye(2)}, "negative eigenvalue"),
        ({"covariance": np.full((2, 2), np.nan)}, "finite"),
        ({"point": [math.nan, 0.0]}, "finite"),
    ],
)
def test_an_unacceptable_fix_moves_nothing(fields, words):
    with guard_rig() as rig:
        with pytest.raises(RefusedError, match=words):
            rig.guard.move(CENTRE, 0.1, fix=rig.fix(**fields), needs=Presence.FIX)
        assert not rig.is_moving()
        assert rig.guard.records[-1].outcome != "sent"
        assert rig.guard.armed


def test_the_gate_includes_the_uncertainty_of_the_homography():
    with guard_rig() as rig:
        plane = RobotPlane(TIE, 0.02, 2e-5 * np.diag([0, 0, 1.0, 0, 0, 1.0, 0, 0, 0]))
        guard = Guard(rig.robot, plane, REGION, clock=rig.clock)
        sigma_m = math.sqrt(1e-3**2 + 2e-5)
        assert guard.semi_axis_m(rig.fix()) == pytest.approx(
            sigma_m * math.sqrt(-2 * math.log(0.05))
        )
        with pytest.raises(RefusedError, match="ellipse"):
            guard.accept(rig.fix())


# Causes of a stop.


@pytest.mark.parametrize("needs", Presence)
def test_an_absent_operator_stops_all_motion(needs):
    with guard_rig(operator_timeout_s=1.0) as rig:
        rig.guard.heartbeat()
        rig.start_moving(needs)
        rig.clock.sleep(0.9)
        rig.guard.observe(rig.fix())
        rig.guard.check()
        assert rig.is_moving()
        rig.clock.sleep(0.2)
        rig.guard.observe(rig.fix())
        rig.guard.check()
        assert not rig.is_moving()
        assert not rig.guard.armed
        with pytest.raises(NotArmedError):
            rig.guard.move(CENTRE, 0.1, fix=rig.fix(), needs=Presence.FIX)


def test_without_an_operator_no_command_passes_even_without_the_watch():
    with guard_rig(operator_timeout_s=1.0) as rig:
        rig.guard.heartbeat()
        rig.clock.sleep(1.1)
        with pytest.raises(NotArmedError, match="gone"):
            rig.guard.move(CENTRE, 0.1, fix=rig.fix(), needs=Presence.FIX)
        assert not rig.is_moving()


@pytest.mark.parametrize(
    "fields",
    [
        {"status": Status.LOST},
        {"status": Status.ILL_CONDITIONED},
        {"covariance": 100.0 * np.eye(2)},
    ],
)
def test_a_lost_fix_holds_the_motion_that_follows_it(fields):
    with guard_rig() as rig:
        rig.start_moving(Presence.FIX)
        rig.guard.check()
        assert rig.is_moving()
        rig.guard.observe(rig.fix(**fields))
        rig.guard.check()
        assert not rig.is_moving()
        assert rig.guard.armed
        assert rig.guard.records[-1].command == "hold"
        rig.start_moving(Presence.FIX)  # following resumes when the fix is back


def test_a_stale_fix_holds_the_motion_that_follows_it():
    with guard_rig() as rig:
        rig.start_moving(Presence.FIX)
        rig.clock.sleep(0.25)
        rig.guard.check()
        assert rig.is_moving()
        rig.clock.sleep(0.1)
        rig.guard.check()
        assert not rig.is_moving()


def test_motion_to_a_selected_point_continues_without_a_fix():
    with guard_rig() as rig:
        rig.start_moving(Presence.OPERATOR)
        rig.clock.sleep(1.0)
        rig.guard.observe(rig.fix(status=Status.LOST))
        rig.guard.check()
        assert rig.is_moving()


@pytest.mark.parametrize("state", [RobotState.FAULT, RobotState.DISCONNECTED])
def test_a_faulty_robot_is_disarmed(state, monkeypatch):
    with guard_rig() as rig:
        rig.start_moving(Presence.OPERATOR)
        status = RobotStatus(state, False, None, None)
        monkeypatch.setattr(rig.robot, "status", lambda: status)
        rig.guard.check()
        assert not rig.guard.armed


def test_an_exception_stops_the_arm():
    with guard_rig() as rig:

        def fail():
            with rig.guard:
                rig.start_moving(Presence.OPERATOR)
                raise ZeroDivisionError("somewhere else")

        with pytest.raises(ZeroDivisionError):
            fail()
        assert not rig.is_moving()
        assert not rig.guard.armed
        assert rig.guard.records[-1].detail == "ZeroDivisionError: somewhere else"


def test_the_end_of_the_block_stops_the_arm_too():
    with guard_rig() as rig:
        with rig.guard:
            rig.start_moving(Presence.OPERATOR)
        assert not rig.is_moving()
        assert not rig.guard.armed


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_stops_the_arm_and_is_then_handled_as_before(number):
    class Terminated(Exception):  # noqa: N818 - stands for the end of the process
        pass

    def terminate(*_):
        raise Terminated

    previous = signal.signal(number, terminate)
    try:
        with guard_rig() as rig:

            def receive():
                with rig.guard.signals():
                    rig.start_moving(Presence.OPERATOR)
                    os.kill(os.getpid(), number)
                    time.sleep(1.0)

            with pytest.raises(Terminated):
                receive()
            assert not rig.is_moving()
            assert not rig.guard.armed
            halts = [record for record in rig.guard.records if record.command == "halt"]
            assert halts[0].detail == f"signal {number.name}"
            assert signal.getsignal(number) is terminate
    finally:
        signal.signal(number, previous)


def test_a_repeated_signal_stops_the_arm_every_time():
    with guard_rig() as rig, rig.guard.signals(signal.SIGURG):  # ignored by default
        for _ in range(3):
            rig.start_moving(Presence.OPERATOR)
            signal.raise_signal(signal.SIGURG)
            assert not rig.is_moving()
            assert not rig.guard.armed
            rig.guard.arm()
            rig.guard.enter()
        rig.guard.disarm()
    assert signal.getsignal(signal.SIGURG) is signal.SIG_DFL


def test_a_failing_stop_at_the_end_of_the_block_is_raised():
    with scorbot_guard() as (rig, guard):
        with pytest.raises(ConnectionLostError, match="unplugged"), guard:
            rig.emulator.inject(Fault.UNPLUG)
        assert not guard.armed


def test_disarming_is_a_stop():
    with guard_rig() as rig:
        rig.start_moving(Presence.OPERATOR)
        rig.guard.disarm()
        assert not rig.is_moving()
        assert not rig.guard.armed


def move(rig, **fields):
    return rig.guard.move(
        [290, 390], 0.1, fix=rig.fix(), needs=Presence.OPERATOR, speed_m_s=0.02, **fields
    )


def interrupt_before(method, interrupt, rig, monkeypatch):
    """Interrupt the guard when a method of the robot is called, before it takes effect."""
    real = getattr(rig.robot, method)

    def late(*arguments, **fields):
        getattr(rig.guard, interrupt)("just now")
        return real(*arguments, **fields)

    monkeypatch.setattr(rig.robot, method, late)


@pytest.mark.parametrize("interrupt", ["hold", "halt"])
@pytest.mark.parametrize(
    ("method", "command"),
    [
        ("move_to", lambda rig: move(rig, wait=False)),
        ("gripper", lambda rig: rig.guard.gripper("close", fix=rig.fix())),
        ("wait", move),
        ("wait", lambda rig: rig.guard.visit([290, 390], 0.1)),
        ("wait", lambda rig: rig.guard.enter()),
    ],
    ids=["move", "gripper", "wait", "visit", "enter"],
)
def test_a_stop_that_overtakes_a_command_is_repeated_after_it(
    interrupt, method, command, monkeypatch
):
    with guard_rig() as rig:
        interrupt_before(method, interrupt, rig, monkeypatch)
        with pytest.raises(StoppedError):
            command(rig)
        assert not rig.is_moving()
        assert not rig.guard.busy
        assert rig.guard.armed is (interrupt == "hold")


@pytest.mark.parametrize("interrupt", ["hold", "halt"])
def test_an_arm_stopped_while_entering_is_not_inside(interrupt, monkeypatch):
    with guard_rig(enter=False) as rig:
        with monkeypatch.context() as patch:
            interrupt_before("wait", interrupt, rig, patch)
            with pytest.raises(StoppedError):
                rig.guard.enter()
        rig.guard.arm()
        with pytest.raises(RefusedError, match="enter"):
            move(rig)


@pytest.mark.parametrize(
    "command",
    [move, lambda rig: rig.guard.gripper("close", fix=rig.fix())],
    ids=["move", "gripper"],
)
def test_a_command_stopped_before_sending_is_not_sent(command, monkeypatch):
    def stop(record):
        if record.command in ("move", "gripper"):
            rig.guard.halt("just now")

    with guard_rig(on_record=stop) as rig:
        sent = []
        for method in ("move_to", "gripper"):
            monkeypatch.setattr(rig.robot, method, lambda *_, **__: sent.append(1))
        with pytest.raises(StoppedError):
            command(rig)
        assert sent == []


# A failing log.


class FailingLog:
    """A log on a disk that may be full."""

    def __init__(self):
        self.full = False

    def __call__(self, _record):
        if self.full:
            raise RecordingError("commands.csv: cannot be written: No space left on device")


@pytest.fixture
def log():
    return FailingLog()


@pytest.mark.parametrize("stop", ["hold", "halt", "disarm"])
def test_a_failing_log_prevents_no_stop(log, stop):
    with guard_rig(on_record=log) as rig:
        rig.start_moving(Presence.OPERATOR)
        log.full = True
        getattr(rig.guard, stop)(*() if stop == "disarm" else ("enough",))
        assert not rig.is_moving()
        assert rig.guard.records[-1].command == stop
        log.full = False
        with pytest.raises(RecordingError, match="No space left"):  # the stop is not logged
            move(rig)
        assert not rig.guard.armed
        rig.guard.arm()
        move(rig)


def test_a_command_that_cannot_be_logged_is_not_sent(log):
    with guard_rig(on_record=log) as rig:
        log.full = True
        with pytest.raises(RecordingError):
            move(rig)
        assert not rig.is_moving()
        assert not rig.guard.armed
        with pytest.raises(RecordingError):
            rig.guard.arm()
        assert not rig.guard.armed
        rig.robot.move_to(PLANE.pose(CENTRE, 0.1), speed_m_s=0.01, wait=False)
        rig.guard.halt("enough")
        assert not rig.is_moving()


def test_a_guard_whose_arming_cannot_be_logged_is_not_armed(log):
    with guard_rig(arm=False, on_record=log) as rig:
        log.full = True
        with pytest.raises(RecordingError):
            rig.guard.arm()
        assert not rig.guard.armed
        log.full = False
        rig.guard.arm()
        assert rig.guard.armed


def test_an_unlogged_stop_is_reported_at_the_end_of_the_block(log):
    with guard_rig(on_record=log) as rig:

        def end(error=None):
            with rig.guard:
                rig.start_moving(Presence.OPERATOR)
                log.full = True
                if error is not None:
                    raise error

        with pytest.raises(RecordingError):
            end()
        assert not rig.is_moving()
        log.full = False
        rig.guard.arm()
        rig.guard.enter()
        with pytest.raises(ZeroDivisionError):
            end(ZeroDivisionError("somewhere else"))
        assert not rig.is_moving()


def test_the_watch_outlives_a_failing_log(log):
    """In real time, from the watch thread."""

    def until_disarmed():
        end_s = time.monotonic() + 5.0
        while guard.armed and time.monotonic() < end_s:
            time.sleep(0.01)
        assert not guard.armed

    with SimulatedRobot(SimulatedOptions(homing_s=0.0)) as robot:
        robot.home()
        options = GuardOptions(operator_timeout_s=0.2)
        guard = Guard(robot, PLANE, REGION, options, on_record=log)

        def run():
            with guard.watching():
                guard.arm()
                log.full = True
                until_disarmed()
                with pytest.raises(RecordingError):
                    guard.arm()
                log.full = False
                guard.arm()
                log.full = True
                until_disarmed()  # by the watch that has outlived an error

        with pytest.raises(RecordingError):
            run()


def test_the_watch_stops_the_arm_by_itself():
    """In real time, from the watch thread."""
    robot = SimulatedRobot(SimulatedOptions(homing_s=0.0))
    with robot:
        robot.home()
        guard = Guard(robot, PLANE, REGION, GuardOptions(operator_timeout_s=0.2))
        with guard.watching():
            robot.move_to(PLANE.pose(CENTRE, 0.1))
            guard.arm()
            fix = fix_at(CENTRE, time.monotonic())
            guard.move(
                [290, 390], 0.1, fix=fix, needs=Presence.OPERATOR, speed_m_s=0.01, wait=False
            )
            end_s = time.monotonic() + 2.0
            while guard.armed and time.monotonic() < end_s:
                time.sleep(0.01)
            assert not guard.armed
            stopped = robot.pose()
            time.sleep(0.05)
            assert robot.pose() == stopped


def test_an_error_of_the_watch_halts_the_arm(monkeypatch):
    with guard_rig() as rig:
        rig.start_moving(Presence.OPERATOR)
        monkeypatch.setattr(rig.guard, "check", lambda: 1 / 0)
        with rig.guard.watching():
            end_s = time.monotonic() + 2.0
            while rig.guard.armed and time.monotonic() < end_s:
                time.sleep(0.01)
        assert not rig.is_moving()
        assert any("the watch failed" in record.detail for record in rig.guard.records)


def test_every_command_is_logged_with_the_fix_that_caused_it():
    logged = []
    with guard_rig() as rig:
        guard = Guard(
            rig.robot,
            PLANE,
            REGION,
            GuardOptions(**PATIENT),
            clock=rig.clock,
            on_record=logged.append,
        )
        guard.arm()
        fixes = [rig.fix([100 + 10 * k, 200]) for k in range(3)]
        for fix in fixes:
            guard.move(fix.point, 0.1, fix=fix, needs=Presence.OPERATOR)
        guard.gripper("close", fix=fixes[0])
        guard.halt("enough")
    moves = [record for record in logged if record.command == "move"]
    assert [record.fix for record in moves] == fixes
    assert [record.command for record in logged] == ["arm", *["move"] * 3, "gripper", "halt"]
    assert moves[1].pose == PLANE.pose([110, 200], 0.1)
    assert f"[fix of {fixes[0].time_s:.3f} s, ok (100, 200)]" in str(moves[0])
    assert tuple(logged) == guard.records


def test_the_speed_is_limited():
    with guard_rig(max_speed_m_s=0.05) as rig:
        start_s, (start, _) = rig.clock(), rig.guard.where()
        rig.guard.move(
            [290, 200], 0.199, fix=rig.fix(), needs=Presence.OPERATOR, speed_m_s=1.0, wait=True
        )
        way_m = 1e-3 * (290 - start[0])
        assert rig.clock() - start_s >= way_m / 0.05
        with pytest.raises(InvalidInputError, match="speed_m_s"):
            rig.guard.move(CENTRE, 0.1, fix=rig.fix(), needs=Presence.OPERATOR, speed_m_s=0.0)


# No command leaves the safe region or passes the ellipse gate.


class GoalRecorder(SimulatedRobot):
    """A simulated robot that records its goals."""

    def __init__(self, clock):
        super().__init__(SimulatedOptions(homing_s=0.0), clock=clock, sleep=clock.sleep)
        self.goals = []

    def move_to(self, pose, **fields):
        self.goals.append(pose)
        super().move_to(pose, **fields)


coordinates = st.one_of(st.floats(-1e5, 1e5), st.floats(-50, 450), st.sampled_from([0.0, 300.0]))
fixes = st.builds(
    lambda x, y, sigmas, turn, status, age_s: (x, y, sigmas, turn, status, age_s),
    coordinates,
    coordinates,
    st.tuples(st.floats(0.0, 8.0), st.floats(0.0, 8.0)),
    st.floats(0.0, math.pi),
    st.sampled_from([Status.OK] * 5 + [Status.LOST, Status.ILL_CONDITIONED]),
    st.sampled_from([0.0, 0.0, 0.0, 0.1, 0.29, 0.31, 2.0]),
)


@settings(max_examples=60)
@given(
    st.lists(fixes, min_size=1, max_size=25),
    st.floats(0.0, 1.0),
    st.sampled_from([(1e-3, 0.0), (1e-3, 1e-4), (5e-4, -1e-3)]),
)
def test_no_command_leaves_the_safe_region_or_passes_the_gate(drawn, above_m, tie):
    scale, lean = tie
    plane = RobotPlane(np.array([[scale, 0.0, 0.2], [0.0, scale, -0.2], [lean, 0.0, 1.0]]), 0.02)
    clock = ManualClock()
    robot = GoalRecorder(clock)
    robot.connect()
    robot.home()
    guard = Guard(robot, plane, REGION, GuardOptions(**PATIENT), clock=clock)
    guard.arm()
    guard.enter()
    robot.goals.clear()
    follower = Follower(guard, FollowOptions(above_m=above_m))
    for x, y, sigmas, turn, status, age_s in drawn:
        clock.sleep(0.05)
        sent = len(robot.goals)
        axes = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
        covariance = axes @ np.diag(np.square(sigmas)) @ axes.T
        fix = fix_at([x, y], clock() - age_s, (covariance + covariance.T) / 2, status)
        follower.update(fix)
        guard.check()
        if len(robot.goals) > sent:
            assert status is Status.OK
            assert age_s <= 0.3
            robot_covariance = plane.covariance_m2(fix.point, fix.covariance)
            ellipse = confidence_ellipse(plane.position_m(fix.point), robot_covariance, 0.95)
            assert ellipse.semi_axes[0] <= 0.01
    for pose in robot.goals:
        point = plane.point(pose.position_m[:2])
        assert REGION.contains(point, plane.above_m(pose)), (point, plane.above_m(pose))


def test_the_controllers_rounding_moves_no_command_out_of_the_region():
    """On the Scorbot, in its own units of 0.1 mm, including corners."""
    rng = np.random.default_rng(4)
    plane = RobotPlane(np.diag([1e-3, 1e-3, 1.0]), 0.0, pitch_rad=TOOL_DOWN_RAD, roll_rad=0.0)
    region = SafeRegion([[371.234, -99.876], [451.057, -88.421], [440.4, 97.3]], 0.0533, 0.1277)
    style = AclStyle(homing_s=1.0, full_speed_mm_s=1e6, acceleration_mm_s2=1e8)
    with scorbot_rig(style) as rig:
        guard = Guard(rig.robot, plane, region, GuardOptions(**PATIENT), clock=rig.clock)
        guard.arm()
        guard.enter()
        for _ in range(15):
            point = rng.uniform([300, -200], [500, 200])
            fix = fix_at(point, rig.clock())
            guard.move(point, rng.uniform(0.0, 0.2), fix=fix, needs=Presence.OPERATOR)
        for move in rig.controller.moves:
            x, y, z = np.array(move.goal_units[:3]) * 1e-4
            assert region.contains(plane.point([x, y]), z)


# With an emulated controller on a line.


@contextmanager
def scorbot_guard(**options):
    plane = RobotPlane(
        np.array([[1e-3, 0, 0.36], [0, 1e-3, -0.2], [0, 0, 1.0]]),
        0.02,
        pitch_rad=TOOL_DOWN_RAD,
        roll_rad=0.0,
    )
    region = SafeRegion([[0, 0], [120, 0], [120, 400], [0, 400]], 0.01, 0.2)
    with patience(), scorbot_rig(options=fast_options(**options)) as rig:
        guard_options = GuardOptions(operator_timeout_s=1e6, max_fix_age_s=1e6)
        guard = Guard(rig.robot, plane, region, guard_options, clock=rig.clock)
        guard.arm()
        guard.enter()
        yield rig, guard


def test_following_with_an_emulated_controller():
    with scorbot_guard() as (rig, guard):
        follower = Follower(guard, FollowOptions(above_m=0.05, min_cutoff_hz=5.0))
        target = np.array([60.0, 300.0])
        end_s = time.monotonic() + 5.0
        state = None
        while state != "there" and time.monotonic() < end_s:
            state = follower.update(fix_at(target, rig.clock())).state
        assert state == "there"
        rig.robot.wait()
        true = rig.true_pose()
        np.testing.assert_allclose(guard.plane.point(true.position_m[:2]), target, atol=4.0)
        assert guard.plane.above_m(true) == pytest.approx(0.05, abs=0.004)


def test_a_silent_line_stops_the_arm_and_disarms():
    with scorbot_guard() as (rig, guard):
        fix = fix_at([60, 300], rig.clock())
        guard.move([60, 300], 0.05, fix=fix, needs=Presence.OPERATOR, speed_m_s=0.02, wait=False)
        assert rig.is_moving()
        rig.emulator.inject(Fault.SILENT, count=10_000)
        with pytest.raises(RobotTimeoutError):
            Follower(guard).update(fix_at([60, 300], rig.clock()))
        assert not guard.armed
        end_s = time.monotonic() + 1.0
        while rig.is_moving() and time.monotonic() < end_s:
            time.sleep(0.001)
        assert not rig.is_moving()


@pytest.mark.parametrize(
    ("fault", "error"), [(Fault.IMPACT, RobotFaultError), (Fault.UNPLUG, ConnectionLostError)]
)
def test_a_fault_or_a_pulled_cable_disarms(fault, error):
    with scorbot_guard() as (rig, guard):
        fix = fix_at([60, 300], rig.clock())
        guard.move([60, 300], 0.05, fix=fix, needs=Presence.OPERATOR, speed_m_s=0.02, wait=False)
        rig.emulator.inject(fault)
        with pytest.raises(error):
            guard.where()
        assert not guard.armed


def test_a_lost_fix_stops_the_arm_while_the_follower_waits_for_the_line():
    with scorbot_guard() as (rig, guard):
        guard.options = GuardOptions(operator_timeout_s=1e6, max_fix_age_s=0.3 * TIME_SCALE)
        fix = fix_at([60, 300], rig.clock())
        guard.observe(fix)
        guard.move([60, 300], 0.05, fix=fix, needs=Presence.FIX, speed_m_s=0.02, wait=False)
        with guard.watching():
            assert rig.is_moving()
            reader = threading.Thread(target=lambda: [rig.robot.pose() for _ in range(3)])
            reader.start()
            guard.observe(fix_at(None, rig.clock(), status=Status.LOST))
            end_s = time.monotonic() + 1.0
            while rig.is_moving() and time.monotonic() < end_s:
                time.sleep(0.001)
            assert not rig.is_moving()
            assert guard.armed
            reader.join()


def test_in_an_attended_block_the_operator_counts_as_present():
    with guard_rig(operator_timeout_s=1.0) as rig:
        guard = rig.guard
        with guard.attended():
            rig.clock.sleep(3.0)
            guard.check()
            assert guard.armed
        rig.clock.sleep(0.9)
        guard.check()
        assert guard.armed  # the time-out counts from the end of the block
        rig.clock.sleep(0.2)
        guard.check()
        assert not guard.armed
        assert guard.why_stopped == "the operator is gone"
