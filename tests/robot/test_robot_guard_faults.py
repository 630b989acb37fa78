"""The guard survives every error of a driver and every invalid fix.

The simulated robot continues to move when its stop fails, like an arm behind a dead line.
"""

import math
import os
import signal
import threading
import time
from contextlib import contextmanager

import numpy as np
import pytest
import serial
from guard_rig import CENTRE, PATIENT, PLANE, REGION, fix_at, guard_rig
from robot_rig import ManualClock

from fingerpost.errors import RecordingError
from fingerpost.pointing import Status
from fingerpost.robot.errors import (
    CommandRefusedError,
    ConnectionLostError,
    NotReadyError,
    RefusedError,
    RobotTimeoutError,
    StopFailedError,
    StoppedError,
)
from fingerpost.robot.guard import Guard, GuardOptions, Presence
from fingerpost.robot.protocol import RobotState, RobotStatus
from fingerpost.robot.signals import stopping_on
from fingerpost.robot.simulated import SimulatedOptions, SimulatedRobot
from fingerpost.robot.stopping import STOP_ATTEMPTS

WAIT_S = 5.0
"""Time-out for a thread to be scheduled on a loaded machine."""


class FailingRobot(SimulatedRobot):
    """A robot whose stop raises a given number of times; its other methods raise on demand."""

    def __init__(self, *arguments, **fields):
        super().__init__(*arguments, **fields)
        self.attempts = 0
        self.failures = 0
        self.error = RuntimeError("the library is upset")
        self.failing = {}

    def fail_stops(self, failures, error=None):
        self.attempts, self.failures = 0, failures
        self.error = error or self.error

    def stop(self):
        self.attempts += 1
        if self.failures > 0:
            self.failures -= 1
            raise self.error
        super().stop()

    def _may_fail(self, method):
        if method in self.failing:
            raise self.failing[method]

    def status(self):
        self._may_fail("status")
        return super().status()

    def pose(self):
        self._may_fail("pose")
        return super().pose()

    def move_to(self, pose, **fields):
        self._may_fail("move_to")
        super().move_to(pose, **fields)

    def gripper(self, target):
        self._may_fail("gripper")
        super().gripper(target)


def failing_rig(**fields):
    return guard_rig(robot_type=FailingRobot, **fields)


def wait_until(true):
    end_s = time.monotonic() + WAIT_S
    while not true():
        assert time.monotonic() < end_s
        time.sleep(0.001)


ERRORS = [
    OSError(5, "Input/output error"),
    serial.SerialException("write failed"),
    RuntimeError("the library is upset"),
    TypeError("an integer is required"),
    AssertionError(),
    RobotTimeoutError("no answer"),
    CommandRefusedError("stopL was refused"),
]


# All causes of a stop.


def lose_fix(rig):
    rig.guard.observe(rig.fix(status=Status.LOST))
    rig.guard.check()


def lose_operator(rig):
    rig.clock.sleep(2e6)
    rig.guard.check()


def fault(rig):
    status = rig.robot.status
    rig.robot.status = lambda: RobotStatus(RobotState.FAULT, False, None, "impact")
    rig.guard.check()
    rig.robot.status = status


def no_status(rig):
    rig.robot.failing["status"] = ValueError("not a state")
    rig.guard.check()
    del rig.robot.failing["status"]


def fail_command(method, command):
    def fail(rig):
        rig.robot.failing[method] = ZeroDivisionError("a bug")
        with pytest.raises(ZeroDivisionError):
            command(rig)
        del rig.robot.failing[method]

    return fail


def another_move(rig):
    rig.guard.move(CENTRE, 0.1, fix=rig.fix(), needs=Presence.OPERATOR, wait=False)


def interrupt_command(rig):
    """Overtake a command by a stop; the stop repeated after the command fails, not the first."""
    move_to, failures = rig.robot.move_to, rig.robot.failures
    rig.robot.failures = 0

    def late(pose, **fields):
        rig.guard.halt("just now")
        rig.robot.failures = failures
        move_to(pose, **fields)

    rig.robot.move_to = late
    with pytest.raises(StoppedError):
        another_move(rig)
    del rig.robot.move_to


def leave_block(rig):
    with rig.guard:
        pass


def leave_block_by_an_error(rig):
    with pytest.raises(ZeroDivisionError, match="somewhere else"), rig.guard:
        raise ZeroDivisionError("somewhere else")


def receive_signal(rig):
    with rig.guard.signals(signal.SIGURG):  # ignored by default
        signal.raise_signal(signal.SIGURG)


WAYS = {
    "hold": lambda rig: rig.guard.hold("enough"),
    "halt": lambda rig: rig.guard.halt("enough"),
    "disarm": lambda rig: rig.guard.disarm(),
    "lost fix": lose_fix,
    "operator": lose_operator,
    "fault": fault,
    "status": no_status,
    "move fails": fail_command("move_to", another_move),
    "gripper fails": fail_command("gripper", lambda rig: rig.guard.gripper("close", fix=rig.fix())),
    "pose fails": fail_command("pose", lambda rig: rig.guard.where()),
    "overtaken command": interrupt_command,
    "block": leave_block,
    "block by an error": leave_block_by_an_error,
    "signal": receive_signal,
}


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("failures", [1, STOP_ATTEMPTS, STOP_ATTEMPTS + 4])
def test_a_failing_stop_is_repeated_until_it_succeeds(way, failures):
    with failing_rig() as rig:
        rig.start_moving(Presence.FIX)
        rig.robot.fail_stops(failures)
        WAYS[way](rig)
        for _ in range(failures):
            rig.guard.check()
        assert rig.robot.failures == 0
        assert not rig.is_moving()
        attempts = rig.robot.attempts
        rig.guard.check()
        assert rig.robot.attempts == attempts  # no superfluous attempt
        said = [record.outcome for record in rig.guard.records]
        assert any("RuntimeError: the library is upset" in outcome for outcome in said), said
        assert "the library is upset" in rig.guard.why_stopped
        rig.guard.arm()
        rig.guard.enter()


def test_the_reason_is_set_before_the_guard_is_disarmed(monkeypatch):
    with failing_rig() as rig:
        rig.start_moving(Presence.FIX)
        seen, stop = [], rig.robot.stop

        def observing_stop():
            seen.append((rig.guard.armed, rig.guard.why_stopped))
            stop()

        monkeypatch.setattr(rig.robot, "stop", observing_stop)
        rig.guard.halt("enough")
        assert seen == [(False, "enough")]


@pytest.mark.parametrize("error", ERRORS, ids=lambda error: type(error).__name__)
def test_a_stop_may_raise_anything(error):
    with failing_rig() as rig:
        rig.start_moving(Presence.FIX)
        rig.robot.fail_stops(STOP_ATTEMPTS, error)
        rig.guard.hold("enough")
        assert rig.is_moving()
        assert not rig.guard.armed
        assert "the stop failed, so the arm may still move" in rig.guard.why_stopped
        assert (str(error) or type(error).__name__) in rig.guard.why_stopped
        rig.guard.check()
        assert not rig.is_moving()
        assert [record.command for record in rig.guard.records[-2:]] == ["hold"] * 2
        assert "sent at attempt 4" in rig.guard.records[-1].outcome


def test_a_stop_that_succeeds_is_sent_once():
    with failing_rig() as rig:
        rig.start_moving(Presence.FIX)
        rig.robot.fail_stops(0)
        rig.guard.hold("enough")
        rig.guard.check()
        assert rig.robot.attempts == 1
        assert rig.guard.armed
        assert rig.guard.why_stopped == "enough"
        assert rig.guard.records[-1].outcome == "sent"


@contextmanager
def watched(**options):
    """A guard with a real-time watch, and its robot."""
    robot = FailingRobot(SimulatedOptions(homing_s=0.0))
    with robot:
        robot.home()
        guard = Guard(robot, PLANE, REGION, GuardOptions(**{**PATIENT, **options}))
        with guard.watching():
            guard.arm()
            guard.enter()
            yield robot, guard


def start_moving(guard):
    fix = fix_at([290, 390], guard.time_s)
    guard.move([290, 390], 0.1, fix=fix, needs=Presence.OPERATOR, speed_m_s=0.01, wait=False)


def is_moving(robot):
    return robot._motion.is_moving(time.monotonic())


def test_the_watch_repeats_a_stop_until_it_succeeds():
    with watched() as (robot, guard):
        for _ in range(2):  # by the same watch thread
            start_moving(guard)
            robot.fail_stops(STOP_ATTEMPTS + 5, OSError(5, "Input/output error"))
            guard.halt("enough")
            wait_until(lambda: not is_moving(robot))
            assert robot.failures == 0
            wait_until(lambda: "sent at attempt 9" in guard.records[-1].outcome)
            guard.arm()


@pytest.mark.parametrize("error", [OSError("gone"), SystemExit(3), KeyboardInterrupt()])
def test_the_watch_outlives_every_error_of_the_driver(error):
    with watched() as (robot, guard):
        start_moving(guard)
        robot.error = error
        robot.failures = 1
        robot.failing["status"] = error
        wait_until(lambda: not is_moving(robot))
        wait_until(lambda: not guard.armed)
        del robot.failing["status"]
        wait_until(lambda: robot.failures == 0)
        guard.arm()
        guard.enter()
        start_moving(guard)
        robot.failing["status"] = error
        wait_until(lambda: not is_moving(robot))
        del robot.failing["status"]


def test_an_interrupted_stop_is_repeated_too():
    with failing_rig() as rig:
        rig.start_moving(Presence.FIX)
        rig.robot.fail_stops(1, KeyboardInterrupt())
        with pytest.raises(KeyboardInterrupt):
            rig.guard.hold("enough")
        assert not rig.guard.armed
        rig.guard.check()
        assert not rig.is_moving()


# Dead lines.


def test_a_dead_line_is_not_tried_again():
    with failing_rig() as rig:
        rig.start_moving(Presence.FIX)
        rig.robot.fail_stops(math.inf, ConnectionLostError("unplugged"))
        rig.guard.halt("enough")
        attempts = rig.robot.attempts
        for _ in range(100):
            rig.guard.check()
        assert rig.robot.attempts == attempts
        with pytest.raises(NotReadyError, match=r"not gone through.*unplugged"):
            rig.guard.arm()
        rig.robot.fail_stops(0)  # plugged in again
        rig.robot.connect()
        rig.robot.home()
        rig.guard.arm()
        rig.guard.enter()
        rig.guard.halt("enough")
        assert rig.guard.records[-1].outcome == "sent"


def test_a_line_that_was_lost_once_is_tried_again():
    with failing_rig() as rig:
        rig.start_moving(Presence.FIX)
        rig.robot.fail_stops(1, ConnectionLostError("write failed"))
        rig.guard.halt("enough")
        assert not rig.is_moving()


def test_a_disconnected_robot_is_not_tried_again():
    with failing_rig() as rig:
        rig.start_moving(Presence.FIX)
        rig.robot.fail_stops(math.inf)
        rig.robot._state = RobotState.DISCONNECTED
        rig.guard.check()
        attempts = rig.robot.attempts
        rig.guard.check()
        assert rig.robot.attempts == attempts


# The end of a block.


def test_the_end_of_a_block_waits_for_its_stop():
    with failing_rig() as rig:
        with rig.guard:
            rig.start_moving(Presence.FIX)
            rig.robot.fail_stops(STOP_ATTEMPTS + 5)
        assert not rig.is_moving()


def end_moving(rig, *errors):
    """End a block in which the arm moves and its stop never goes through."""
    with rig.guard:
        rig.start_moving(Presence.FIX)
        rig.robot.fail_stops(math.inf, *errors)


def test_a_block_whose_stop_never_succeeds_raises_a_package_error():
    with failing_rig() as rig:
        words = r"may still move: RuntimeError: the library is upset; press its emergency stop"
        with pytest.raises(StopFailedError, match=words) as caught:
            end_moving(rig)
        assert caught.value.__cause__ is rig.robot.error
        assert not rig.guard.armed


def test_a_stop_that_failed_before_the_end_is_raised_at_the_end():
    def end(rig):
        with rig.guard:
            rig.robot.fail_stops(math.inf, ConnectionLostError("unplugged"))
            rig.guard.halt("enough")
            assert not rig.guard.armed

    with failing_rig() as rig, pytest.raises(ConnectionLostError, match="unplugged"):
        end(rig)


def test_a_block_that_ends_by_an_error_keeps_it_and_adds_a_note_on_the_stop():
    def end(rig):
        with rig.guard:
            rig.robot.fail_stops(math.inf)
            raise ZeroDivisionError("somewhere else")

    with failing_rig() as rig:
        with pytest.raises(ZeroDivisionError) as caught:
            end(rig)
        assert "the arm may still move" in caught.value.__notes__[0]


def test_a_failing_stop_does_not_suppress_a_signal():
    robot = FailingRobot()
    robot.fail_stops(math.inf, OSError("gone"))
    arrived = []
    before = signal.signal(signal.SIGURG, lambda *_: arrived.append(1))
    try:
        with stopping_on(lambda _name: robot.stop(), signal.SIGURG):
            os.kill(os.getpid(), signal.SIGURG)
            wait_until(lambda: arrived)
    finally:
        signal.signal(signal.SIGURG, before)


def test_simultaneous_failures_of_log_and_stop_are_survived():
    full = []

    def log(_record):
        if full:
            raise RecordingError("No space left on device")

    with failing_rig(on_record=log) as rig:
        rig.start_moving(Presence.FIX)
        full.append(1)
        rig.robot.fail_stops(STOP_ATTEMPTS)
        rig.guard.halt("enough")
        rig.guard.check()
        assert not rig.is_moving()
        full.clear()
        with pytest.raises(RecordingError):
            rig.guard.arm()
        rig.guard.arm()


# Arming during a pending stop.


def test_the_guard_cannot_be_armed_while_a_stop_fails():
    with failing_rig() as rig:
        rig.start_moving(Presence.FIX)
        rig.robot.fail_stops(math.inf)
        rig.guard.halt("enough")
        with pytest.raises(NotReadyError, match=r"not gone through.*RuntimeError: the library"):
            rig.guard.arm()
        assert not rig.guard.armed
        rig.robot.fail_stops(0)
        rig.guard.arm()  # arming makes one more attempt to stop
        assert not rig.is_moving()
        assert rig.robot.attempts == 1


def test_the_guard_cannot_be_armed_during_a_stop_in_another_thread():
    """Otherwise it would arrive after arming and cancel the first command."""
    reached, let_go = threading.Event(), threading.Event()
    with failing_rig() as rig:
        stop = rig.robot.stop

        def slow_stop():
            reached.set()
            let_go.wait(WAIT_S)
            stop()

        rig.robot.fail_stops(STOP_ATTEMPTS)
        rig.guard.halt("enough")
        rig.robot.stop = slow_stop
        repeating = threading.Thread(target=rig.guard.check)
        repeating.start()
        assert reached.wait(WAIT_S)
        with pytest.raises(NotReadyError, match="not gone through"):
            rig.guard.arm()
        let_go.set()
        repeating.join(WAIT_S)
        rig.guard.arm()
        rig.guard.enter()


def test_a_halt_while_the_guard_is_being_armed_wins():
    with failing_rig(arm=False) as rig:
        status = rig.robot.status

        def halt_meanwhile():
            rig.guard.halt("just now")
            return status()

        rig.robot.status = halt_meanwhile
        with pytest.raises(StoppedError, match="just now"):
            rig.guard.arm()
        assert not rig.guard.armed


def test_a_robot_whose_status_fails_is_not_armed():
    with failing_rig(arm=False) as rig:
        rig.robot.failing["status"] = OSError("gone")
        with pytest.raises(NotReadyError, match="OSError: gone"):
            rig.guard.arm()


# Invalid fixes.


@pytest.mark.parametrize(
    "fault",
    [
        {"age_s": -3600.0},
        {"age_s": math.nan},
        {"age_s": math.inf},
        {"age_s": -math.inf},
        {"age_s": -3600.0, "status": Status.LOST},
        {"age_s": math.nan, "status": Status.LOST},
        {"point": [math.nan, 200.0]},
        {"point": [math.inf, 200.0]},
        {"covariance": np.full((2, 2), math.nan)},
    ],
)
@pytest.mark.parametrize("first", [True, False])
def test_an_invalid_fix_is_dropped_and_blocks_no_later_one(fault, first):
    with failing_rig() as rig:
        before = None if first else rig.fix()
        if before is not None:
            rig.guard.observe(before)
        rig.guard.observe(rig.fix(**fault))
        assert rig.guard.newest_fix is before
        rig.clock.sleep(0.1)
        later = rig.fix()
        rig.guard.observe(later)
        assert rig.guard.newest_fix is later


def test_invalid_fixes_do_not_interrupt_following():
    with failing_rig() as rig:
        rig.start_moving(Presence.FIX)
        for _ in range(20):
            rig.clock.sleep(0.1)
            rig.guard.observe(rig.fix(age_s=-60.0))
            rig.guard.observe(rig.fix())
            rig.guard.check()
            assert rig.is_moving()
        for _ in range(4):  # invalid fixes alone do not sustain the motion
            rig.clock.sleep(0.1)
            rig.guard.observe(rig.fix(age_s=-60.0))
            rig.guard.check()
        assert not rig.is_moving()


def test_a_move_on_an_invalid_fix_is_refused_without_effect():
    with failing_rig() as rig:
        with pytest.raises(RefusedError, match=r"fix is -60\.000 s old"):
            rig.guard.move(CENTRE, 0.1, fix=rig.fix(age_s=-60.0), needs=Presence.FIX)
        rig.guard.move(CENTRE, 0.1, fix=rig.fix(), needs=Presence.FIX)


def test_an_ill_conditioned_fix_with_infinite_covariance_holds_the_arm():
    """Its covariance is legitimately infinite; the arm must hold."""
    with failing_rig() as rig:
        rig.start_moving(Presence.FIX)
        rig.clock.sleep(0.01)
        refused = rig.fix(status=Status.ILL_CONDITIONED)
        object.__setattr__(refused, "covariance", np.diag([math.inf, 1.0]))
        rig.guard.observe(refused)
        rig.guard.check()
        assert not rig.is_moving()


def test_a_clock_set_back_blocks_no_later_fix():
    with failing_rig() as rig:
        rig.guard.observe(rig.fix())
        rig.clock.now_s -= 100.0
        later = rig.fix()
        rig.guard.observe(later)
        assert rig.guard.newest_fix is later


# Invalid clocks.


@pytest.mark.parametrize("time_s", [math.nan, -math.inf, math.inf, 0.0])
def test_an_invalid_clock_does_not_keep_the_operator_present(time_s):
    with failing_rig() as rig:
        rig.start_moving(Presence.OPERATOR)
        rig.guard.heartbeat()
        now_s, rig.clock.now_s = rig.clock.now_s, time_s
        rig.guard.check()
        rig.clock.now_s = now_s
        assert not rig.guard.armed
        assert not rig.is_moving()


@pytest.mark.parametrize("time_s", [math.nan, math.inf, 1e9])
def test_a_heartbeat_at_an_invalid_time_does_not_keep_the_operator_present(time_s):
    with failing_rig() as rig:
        rig.start_moving(Presence.OPERATOR)
        now_s, rig.clock.now_s = rig.clock.now_s, time_s
        rig.guard.heartbeat()
        rig.clock.now_s = now_s
        rig.guard.check()
        assert not rig.guard.armed


def test_a_clock_that_raises_stops_the_arm():
    class Clock(ManualClock):
        broken = False

        def __call__(self):
            if self.broken:
                raise OSError("no clock")
            return super().__call__()

    clock = Clock()
    robot = SimulatedRobot(SimulatedOptions(homing_s=0.0))
    with robot:
        robot.home()
        guard = Guard(robot, PLANE, REGION, GuardOptions(**PATIENT), clock=clock)
        guard.arm()
        guard.enter()
        start_moving(guard)
        clock.broken = True
        with pytest.raises(OSError, match="no clock"):
            guard.check()
        assert not is_moving(robot)
        assert not guard.armed
