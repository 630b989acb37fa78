"""STOP reaches the wire within 20 ms at any moment, and no waiting command moves the arm after it.

The time runs from the call to the moment the controller's port has read the abort.
"""

import itertools
import signal
import threading
import time

import pytest
from robot_rig import (
    TIME_SCALE,
    assert_in_time,
    best_of_three,
    fast_options,
    over_table,
    scorbot_rig,
)

from fingerpost.robot.acl import ABORT
from fingerpost.robot.emulator.acl import AclStyle
from fingerpost.robot.emulator.faults import Fault
from fingerpost.robot.errors import RobotError, StoppedError
from fingerpost.robot.protocol import RobotState
from fingerpost.robot.serial_line import Flow

SLOW_M_S = 0.02
"""At this speed a move across the table lasts 20 s of arm time, 0.4 s of real time."""

FAR, NEAR = over_table(0.4, 0.2), over_table(0.4, -0.2)


def stop_in_time(rig):
    """Stop, and assert from the emulator's log that the abort arrived in time."""
    seen = len(rig.emulator.wire)
    called_s = time.monotonic()
    rig.robot.stop()
    arrived_s = None
    while arrived_s is None:
        assert time.monotonic() < called_s + 1.0, "the stop never arrived"
        time.sleep(0.0005)  # yield to the emulator's thread
        arrived_s = next(
            (
                event.time_s
                for event in itertools.islice(rig.emulator.wire, seen, None)
                if not event.sent and ABORT[:1] in event.data
            ),
            None,
        )
    assert_in_time(called_s, arrived_s)
    assert not rig.is_moving()


class Threads:
    """Calls in threads, and their errors."""

    def __init__(self, *calls):
        self.errors = []
        self._threads = [threading.Thread(target=self._run, args=(call,)) for call in calls]
        for thread in self._threads:
            thread.start()

    def _run(self, call):
        try:
            call()
        except RobotError as error:
            self.errors.append(error)

    def join(self):
        for thread in self._threads:
            thread.join(5.0)
            assert not thread.is_alive()


def wait_until(true):
    end_s = time.monotonic() + 5.0
    while not true():
        assert time.monotonic() < end_s
        time.sleep(0.001)


def assert_nothing_moves(rig, moves):
    time.sleep(0.1)
    assert not rig.is_moving()
    assert len(rig.controller.moves) == moves


@best_of_three
def test_at_rest():
    with scorbot_rig() as rig:
        for _ in range(20):
            stop_in_time(rig)


@best_of_three
def test_while_a_move_runs_and_is_waited_for():
    with scorbot_rig() as rig:
        for goal in (FAR, NEAR, FAR):
            waiting = Threads(lambda goal=goal: rig.robot.move_to(goal, speed_m_s=SLOW_M_S))
            wait_until(rig.is_moving)
            stop_in_time(rig)
            waiting.join()
            assert [type(error) for error in waiting.errors] == [StoppedError]
            assert rig.robot.status().state is RobotState.IDLE
            rig.robot.pose()


@pytest.mark.parametrize("delay_s", [0.0, 0.001, 0.002, 0.003, 0.005, 0.008])
@best_of_three
def test_while_a_move_is_being_commanded(delay_s):
    with scorbot_rig() as rig:
        waiting = Threads(lambda: rig.robot.move_to(FAR, speed_m_s=SLOW_M_S))
        time.sleep(delay_s)
        stop_in_time(rig)
        waiting.join()
        assert [type(error) for error in waiting.errors] == [StoppedError]
        assert_nothing_moves(rig, len(rig.controller.moves))


@best_of_three
def test_during_homing():
    with scorbot_rig(AclStyle(homing_s=1e5), home=False) as rig:
        waiting = Threads(lambda: rig.robot.home(timeout_s=1e6))
        wait_until(rig.is_moving)
        stop_in_time(rig)
        waiting.join()
        assert [type(error) for error in waiting.errors] == [StoppedError]
        assert rig.robot.status().state is RobotState.NOT_HOMED


@best_of_three
def test_while_another_thread_waits_for_a_missing_answer():
    with scorbot_rig(options=fast_options(reply_s=2.0 * TIME_SCALE)) as rig:
        rig.robot.move_to(FAR, speed_m_s=SLOW_M_S, wait=False)
        rig.emulator.inject(Fault.SILENT, count=1000)
        waiting = Threads(rig.robot.wait)
        time.sleep(0.05)
        stop_in_time(rig)
        waiting.join()
        assert [type(error) for error in waiting.errors] == [StoppedError]


@best_of_three
def test_while_50_moves_wait_in_threads():
    with scorbot_rig() as rig:
        waiting = Threads(
            *(
                lambda goal=goal: rig.robot.move_to(goal, speed_m_s=SLOW_M_S)
                for goal in (FAR, NEAR) * 25
            )
        )
        wait_until(rig.is_moving)
        stop_in_time(rig)
        waiting.join()
        assert [type(error) for error in waiting.errors] == [StoppedError] * 50
        assert_nothing_moves(rig, 1)


@best_of_three
def test_while_50_moves_are_queued_in_the_controller():
    with scorbot_rig() as rig:
        goals = itertools.cycle((FAR, NEAR))
        for _ in range(50):
            rig.robot.move_to(next(goals), speed_m_s=SLOW_M_S, wait=False)
        stop_in_time(rig)
        assert_nothing_moves(rig, 50)


@best_of_three
def test_while_a_write_is_held_by_flow_control():
    with scorbot_rig(options=fast_options(flow=Flow.XON_XOFF)) as rig:
        rig.robot.move_to(FAR, speed_m_s=SLOW_M_S, wait=False)
        rig.emulator.inject(Fault.XOFF)
        waiting = Threads(rig.robot.wait)
        time.sleep(0.05)
        stop_in_time(rig)
        waiting.join()


@best_of_three
def test_while_another_thread_is_in_the_middle_of_its_own_write():
    with scorbot_rig() as rig, rig.robot._line._write_lock:
        stop_in_time(rig)


@best_of_three
def test_while_another_thread_is_issuing_a_motion():
    with scorbot_rig() as rig, rig.robot._issue_lock:
        stop_in_time(rig)


def test_a_stop_that_overtakes_a_motion_is_repeated_after_it():
    """The worst moment: the stop comes between the last check of the stop count and the write."""
    with scorbot_rig() as rig:
        send = rig.robot._line.send

        def send_late(data):
            if not data.upper().startswith(b"MOVEL"):
                send(data)
                return
            rig.robot.stop()
            send(data)
            wait_until(rig.is_moving)  # the motion did start

        rig.robot._line.send = send_late
        with pytest.raises(StoppedError):
            rig.robot.move_to(FAR, speed_m_s=SLOW_M_S)
        wait_until(lambda: not rig.is_moving())
        assert rig.true_pose().distance_m(FAR) > 0.1


def test_from_a_signal_handler_that_interrupts_any_line():
    with scorbot_rig() as rig:
        previous = signal.signal(signal.SIGALRM, lambda *_: rig.robot.stop())
        try:
            for delay_s in (0.002, 0.004, 0.006, 0.01, 0.02):
                signal.setitimer(signal.ITIMER_REAL, delay_s)
                with pytest.raises(StoppedError):
                    rig.robot.move_to(FAR, speed_m_s=SLOW_M_S)
                signal.setitimer(signal.ITIMER_REAL, 0.0)
                wait_until(lambda: not rig.is_moving())
        finally:
            signal.signal(signal.SIGALRM, previous)


@best_of_three
def test_the_arm_can_be_used_again():
    with scorbot_rig() as rig:
        rig.robot.move_to(FAR, speed_m_s=SLOW_M_S, wait=False)
        stop_in_time(rig)
        rig.robot.move_to(NEAR)
        assert rig.true_pose().distance_m(NEAR) < 1.2e-3
