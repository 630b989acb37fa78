"""Thousands of moves with random faults; `python tests/robot/soak.py 10000 --jobs 3` reports.

The arm is a Scorbot, or with `--arm uarm` (marlin, dexarm) another emulated arm.

Every call must end with a correct result or a typed error within its time-out, and a stop must
reach the controller's port within 20 ms at any moment. On a loaded machine a thread may wait longer
than that for a processor; run it there at real-time priority (`chrt -f 10`).
"""

import argparse
import itertools
import json
import multiprocessing
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from typing import TypeAlias

import gcode_rig
import numpy as np
from robot_rig import REPLY_S, STOP_S, TIME_SCALE, Rig, fast_options, scorbot_rig

from fingerpost.robot.emulator.acl import AclStyle
from fingerpost.robot.emulator.faults import Fault
from fingerpost.robot.errors import ConnectionLostError, RobotError, StoppedError
from fingerpost.robot.protocol import Pose, RobotState

FAULT_SHARE = 0.3
"""Fraction of moves with a fault."""

STOP_SHARE = 0.05
"""Fraction of moves that are stopped."""

WITHIN_S = 0.02
"""Longest delay of a fault or stop after the start of a move, which lasts about 15 ms."""

STOP_SEEN_S = 1.0
"""After an error, the controller must receive a stop within this time; on a loaded machine its
reading thread may have to wait."""

AnyRig: TypeAlias = Rig | gcode_rig.Rig

LIMIT_S = 3.0
"""Limit of every call; the longest time-out, that of resynchronising to the prompt, is 0.6 s."""

NEAR_M = 1.2e-3
"""The arrival tolerance of 1 mm, and rounding."""

READING_M = 2.5e-4
"""Rounding of a reading: 0.1 mm in each coordinate, and the encoders'."""

GAP_S = 0.003
"""A sleep of 1 ms that takes longer than this had to wait for a processor."""

SLOW_S = 1.5
"""Delay of a slow answer, in units of the answer time-out."""

ARMS = ("acl", *gcode_rig.ARMS)

FAULTS = (
    [Fault.GARBAGE] * 4
    + [Fault.CUT] * 3
    + [Fault.SILENT] * 2
    + [Fault.GARBLED_INPUT] * 3
    + [
        Fault.SLOW,
        Fault.XOFF,
        Fault.OUT_OF_RANGE,
        Fault.IMPACT,
        Fault.OVERLOAD,
        Fault.ECHO_OFF,
        Fault.PAGING,
        Fault.STICK,
        Fault.UNPLUG,
        Fault.HOME_FAILURE,
    ]
)


@dataclass
class LateStop:
    """A stop that took too long, with the delays of two reference sleepers at that time.

    A thread and a process that only sleep, 1 ms at a time, identify the cause. If the process was
    late as well, the machine had no free processor. If only the thread was late, another thread of
    this process held the interpreter.
    """

    called_s: float
    returned_s: float
    arrived_s: float
    thread_late_ms: float = 0.0
    process_late_ms: float = 0.0

    def as_dict(self) -> dict[str, float]:
        """Return the delays in milliseconds."""
        return {
            "took_ms": 1000 * (self.arrived_s - self.called_s),
            "call_ms": 1000 * (self.returned_s - self.called_s),
            "thread_late_ms": self.thread_late_ms,
            "process_late_ms": self.process_late_ms,
        }


class Sleeper:
    """Sleeps 1 ms at a time and records the sleeps that took much longer."""

    def __init__(self) -> None:
        self.gaps: list[tuple[float, float]] = []

    def run(self, done: Callable[[], bool]) -> None:
        """Sleep until done."""
        before_s = time.monotonic()
        while not done():
            time.sleep(0.001)
            now_s = time.monotonic()
            if now_s - before_s > GAP_S:
                self.gaps.append((before_s, now_s))
            before_s = now_s

    def late_ms(self, stop: LateStop) -> float:
        """Return how long the sleeper was held up during a stop."""
        within = (
            min(end_s, stop.arrived_s) - max(begin_s, stop.called_s) for begin_s, end_s in self.gaps
        )
        return 1000 * max(0.0, sum(span_s for span_s in within if span_s > 0))


def _sleep_in_process(ends: Connection) -> None:
    sleeper = Sleeper()
    ends.send("ready")
    sleeper.run(ends.poll)
    ends.send(sleeper.gaps)


@contextmanager
def reference_sleepers(report: "SoakReport") -> Iterator[None]:
    """Measure the delays of a sleeping thread and a sleeping process during late stops."""
    thread, process, done = Sleeper(), Sleeper(), threading.Event()
    ours, theirs = multiprocessing.Pipe()
    sleeping_process = multiprocessing.get_context("spawn").Process(
        target=_sleep_in_process, args=(theirs,), daemon=True
    )
    sleeping_process.start()
    ours.recv()  # its imports would delay the first moves
    sleeping_thread = threading.Thread(target=thread.run, args=(done.is_set,))
    sleeping_thread.start()
    try:
        yield
    finally:
        done.set()
        sleeping_thread.join()
        ours.send(None)
        process.gaps = ours.recv()
        sleeping_process.join()
    for stop in report.late_stops:
        stop.thread_late_ms, stop.process_late_ms = thread.late_ms(stop), process.late_ms(stop)


@dataclass
class SoakReport:
    """Counts and durations of a run."""

    moves: int = 0
    arrived: int = 0
    readings: int = 0
    faults: Counter[str] = field(default_factory=Counter)
    errors: Counter[str] = field(default_factory=Counter)
    wrong_positions: list[str] = field(default_factory=list)
    not_stopped: list[str] = field(default_factory=list)
    stops: int = 0
    late_stops: list["LateStop"] = field(default_factory=list)
    late_calls: int = 0
    slowest_stop_ms: float = 0.0
    slowest_stop_call_ms: float = 0.0
    slowest_call_s: float = 0.0
    homings: int = 0
    reconnects: int = 0

    def add(self, other: "SoakReport") -> None:
        """Add another report."""
        for name, value in vars(other).items():
            if name.startswith("slowest"):
                setattr(self, name, max(getattr(self, name), value))
            else:
                setattr(self, name, getattr(self, name) + value)


@contextmanager
def _scorbot(seed: int) -> Iterator[Rig]:
    style, options = AclStyle(homing_s=2.0), fast_options(max_speed_m_s=1.0)
    slow_s = SLOW_S * REPLY_S * TIME_SCALE
    with scorbot_rig(style, options=options, slow_s=slow_s, seed=seed) as rig:
        yield rig


def _plugged_in(arm: str, seed: int) -> AbstractContextManager[AnyRig]:
    if arm == "acl":
        return _scorbot(seed)
    reply_s = gcode_rig.BRIEF_REPLY_S * TIME_SCALE
    return gcode_rig.gcode_rig(arm, seed=seed, slow_s=SLOW_S * reply_s, reply_s=reply_s)


def soak(moves: int, seed: int, arm: str = "acl") -> SoakReport:
    """Make `moves` moves under random faults."""
    rng = np.random.default_rng(seed)
    report = SoakReport()
    with reference_sleepers(report), _plugged_in(arm, seed) as rig:
        for _ in range(moves):
            # With a growing log, the garbage collector would hold up all threads, by up to 0.1 s.
            rig.emulator.wire.clear()
            rig.tape.transfers.clear()
            _recover(rig, report)
            _move(rig, rng, report)
    return report


def _move(rig: AnyRig, rng: np.random.Generator, report: SoakReport) -> None:
    goal = rig.random_goal(rng)
    report.moves += 1
    meddlers = []
    if rng.random() < FAULT_SHARE:
        fault = FAULTS[rng.integers(len(FAULTS))]
        report.faults[fault] += 1
        count = int(rng.integers(1, 4))
        meddlers.append(_later(rng, lambda: rig.emulator.inject(fault, count=count)))
    if rng.random() < STOP_SHARE:
        meddlers.append(_later(rng, lambda: _stop(rig, report)))
    aborts = rig.stops
    start_s = time.monotonic()
    try:
        if rng.random() < 0.7:
            rig.robot.move_to(goal, timeout_s=2.0 * TIME_SCALE)
            _compare(goal, rig.true_pose(), NEAR_M, "arrived", report)
            report.arrived += 1
        else:
            rig.robot.move_to(goal, wait=False, timeout_s=2.0 * TIME_SCALE)
            _read_on_the_way(rig, report)
    except ConnectionLostError:
        report.errors["ConnectionLostError"] += 1
    except RobotError as error:
        report.errors[type(error).__name__] += 1
        if not _within(STOP_SEEN_S, lambda: _stop_received(rig, aborts)):
            report.not_stopped.append(str(error))
    report.slowest_call_s = max(report.slowest_call_s, time.monotonic() - start_s)
    for meddler in meddlers:
        meddler.join()


def _stop_received(rig: AnyRig, aborts: int) -> bool:
    return rig.stops > aborts or not rig.plugged


def _later(rng: np.random.Generator, act: Callable[[], None]) -> threading.Thread:
    delay_s = float(rng.uniform(0.0, WITHIN_S))

    def run() -> None:
        time.sleep(delay_s)
        act()

    thread = threading.Thread(target=run)
    thread.start()
    return thread


def _stop(rig: AnyRig, report: SoakReport) -> None:
    """Stop, and read from the controller's log when the stop arrived."""
    seen = len(rig.emulator.wire)
    called_s = time.monotonic()
    try:
        rig.robot.stop()
    except ConnectionLostError:
        return  # the cable is unplugged
    returned_s = time.monotonic()
    arrived_s = _abort_seen(rig, seen, called_s)
    if arrived_s is None:
        return  # unplugged meanwhile
    report.stops += 1
    took_ms = 1000 * (arrived_s - called_s)
    report.slowest_stop_ms = max(report.slowest_stop_ms, took_ms)
    report.slowest_stop_call_ms = max(report.slowest_stop_call_ms, 1000 * (returned_s - called_s))
    # When the call returns, the operating system has the bytes; the emulator's thread may read them
    # later.
    report.late_calls += returned_s - called_s > STOP_S
    if took_ms > 1000 * STOP_S:
        report.late_stops.append(LateStop(called_s, returned_s, arrived_s))


def _within(span_s: float, true: Callable[[], bool]) -> bool:
    end_s = time.monotonic() + span_s
    while not true():
        if time.monotonic() > end_s:
            return False
        time.sleep(0.001)
    return True


def _abort_seen(rig: AnyRig, seen: int, called_s: float) -> float | None:
    """Return when the controller's port read the first abort since `called_s`; wait up to 0.5 s."""
    end_s = time.monotonic() + 0.5
    while time.monotonic() < end_s:
        for event in itertools.islice(rig.emulator.wire, seen, None):
            if not event.sent and event.time_s >= called_s and rig.stop_bytes in event.data:
                return event.time_s
        time.sleep(0.001)
    return None


def _read_on_the_way(rig: AnyRig, report: SoakReport) -> None:
    """Read the pose of a moving arm; it must lie between the true poses before and after."""
    before = rig.true_pose()
    try:
        pose = rig.robot.pose()
    except RobotError:
        rig.robot.stop()  # a failed reading does not stop the arm
        raise
    after = rig.true_pose()
    report.readings += 1
    low = np.minimum(before.position_m, after.position_m) - READING_M
    high = np.maximum(before.position_m, after.position_m) + READING_M
    if not ((low <= pose.position_m) & (pose.position_m <= high)).all():
        report.wrong_positions.append(f"read {pose} between {before} and {after}")


def _compare(believed: Pose, true: Pose, within_m: float, what: str, report: SoakReport) -> None:
    if believed.distance_m(true) > within_m:
        report.wrong_positions.append(f"{what}: believed {believed}, true {true}")


def _recover(rig: AnyRig, report: SoakReport) -> None:
    """Recover from an error as an operator would, while line faults continue."""
    while True:
        state = rig.robot.status().state
        start_s = time.monotonic()
        try:
            if state is RobotState.DISCONNECTED:
                rig.emulator.inject(Fault.PLUG)
                report.reconnects += 1
                rig.robot.reconnect(timeout_s=2.0 * TIME_SCALE)
            elif state in (RobotState.FAULT, RobotState.NOT_HOMED):
                report.homings += 1
                rig.robot.home(timeout_s=0.5 * TIME_SCALE)
            else:
                rig.robot.wait(timeout_s=1.0 * TIME_SCALE)
                return
        except StoppedError:
            pass
        except RobotError as error:
            report.errors[f"recovering: {type(error).__name__}"] += 1
        report.slowest_call_s = max(report.slowest_call_s, time.monotonic() - start_s)


def main() -> None:
    """Run from a shell and print the report as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("moves", type=int, nargs="?", default=10_000)
    parser.add_argument("--jobs", type=int, default=1, help="rigs side by side")
    parser.add_argument("--arm", choices=ARMS, default="acl")
    parser.add_argument("--seed", type=int, default=0, help="of the first rig")
    given = parser.parse_args()
    start_s = time.monotonic()
    report = SoakReport()
    shares = [given.moves // given.jobs] * given.jobs
    shares[0] += given.moves - sum(shares)
    with ProcessPoolExecutor(given.jobs) as pool:
        seeds = range(given.seed, given.seed + given.jobs)
        for part in pool.map(soak, shares, seeds, [given.arm] * given.jobs):
            report.add(part)
    late = [stop.as_dict() for stop in report.late_stops]
    print(
        json.dumps(
            {**vars(report), "late_stops": late, "duration_s": time.monotonic() - start_s}, indent=1
        )
    )


if __name__ == "__main__":
    main()
