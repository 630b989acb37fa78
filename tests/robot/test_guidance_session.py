"""Keys, the command log, the worker, and recordings played in real time."""

import contextlib
import os
import pty
import termios
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from guided_process import commands
from test_robot_guard import fix_at

from fingerpost.capture import Frame, at_speed
from fingerpost.errors import InvalidInputError, RecordingError
from fingerpost.guidance import (
    CommandLog,
    Keys,
    SessionReport,
    Worker,
    attended_at_first,
)
from fingerpost.pointing import Status
from fingerpost.robot import CommandRecord, FollowReport, FollowState, Pose


def wait_until(true):
    end_s = time.monotonic() + 5.0
    while not true():
        assert time.monotonic() < end_s
        time.sleep(0.001)


@pytest.fixture
def terminal():
    ours, theirs = pty.openpty()
    yield ours, theirs
    for end in (ours, theirs):
        with contextlib.suppress(OSError):
            os.close(end)


def test_keys_arrive_one_by_one_and_the_terminal_is_restored(terminal):
    ours, theirs = terminal
    before = termios.tcgetattr(theirs)
    pressed = []
    with Keys(pressed.append, lambda: None, descriptor=theirs):
        assert termios.tcgetattr(theirs) != before
        for keys in ("s", "xu", "é"):
            os.write(ours, keys.encode())
        wait_until(lambda: len(pressed) == 4)
    assert pressed == ["s", "x", "u", "é"]
    assert termios.tcgetattr(theirs) == before


def test_a_closed_terminal_is_reported(terminal):
    ours, theirs = terminal
    gone = threading.Event()
    with Keys(lambda _: None, gone.set, descriptor=theirs):
        os.close(ours)
        assert gone.wait(5.0)


def test_an_error_of_one_key_blocks_no_later_stop_key(terminal):
    ours, theirs = terminal
    pressed = []

    def press(key):
        pressed.append(key)
        if key == "c":
            raise RecordingError("a key's")

    def read():
        with Keys(press, lambda: None, descriptor=theirs):
            os.write(ours, b"c")
            wait_until(lambda: pressed)
            os.write(ours, b"x")
            wait_until(lambda: pressed == ["c", "x"])

    before = termios.tcgetattr(theirs)
    with pytest.raises(RecordingError, match="a key's"):
        read()
    assert termios.tcgetattr(theirs) == before


def test_keys_need_a_terminal():
    reading, writing = os.pipe()
    with pytest.raises(InvalidInputError, match="terminal"):
        Keys(lambda _: None, lambda: None, descriptor=reading)
    os.close(reading)
    os.close(writing)


def record(**fields):
    fix = fix_at([0.4, 0.1], 3.25, [[1e-6, 2e-7], [2e-7, 4e-6]])
    pose = Pose(0.4, 0.1, 0.05)
    return CommandRecord(
        **{"time_s": 3.5, "command": "move", "detail": "a, b", "pose": pose, "fix": fix}
        | {"outcome": "sent"}
        | fields
    )


def test_the_log_holds_command_and_cause(tmp_path):
    path = tmp_path / "commands.csv"
    with CommandLog(path) as log:
        log(record())
        assert len(commands(path)) == 1  # written at once, not at the end
        log(record(command="halt", pose=None, fix=None))
        log(record(fix=fix_at(None, 4.0, status=Status.LOST), outcome="fix is lost"))
    moved, halted, refused = commands(path)
    assert moved["detail"] == "a, b"
    assert [float(moved[name]) for name in ("x_m", "y_m", "z_m")] == [0.4, 0.1, 0.05]
    assert [float(moved[f"fix_cov_{k}"]) for k in ("xx", "xy", "yy")] == [1e-6, 2e-7, 4e-6]
    assert float(moved["fix_time_s"]) == 3.25
    assert halted["x_m"] == halted["fix_status"] == ""
    assert (refused["fix_status"], refused["fix_x"]) == ("lost", "")
    assert refused["outcome"] == "fix is lost"


def test_rows_of_many_threads_are_not_interleaved(tmp_path):
    path = tmp_path / "commands.csv"
    with CommandLog(path) as log:
        threads = [
            threading.Thread(target=lambda: [log(record()) for _ in range(50)]) for _ in range(4)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert [row["detail"] for row in commands(path)] == ["a, b"] * 200


def test_an_unwritable_log_is_an_error(tmp_path):
    with pytest.raises(RecordingError, match="no/such"):
        CommandLog(tmp_path / "no" / "such")
    with CommandLog("/dev/null") as log:
        log(record())
    if Path("/dev/full").exists():
        with pytest.raises(RecordingError, match="No space left"):
            CommandLog("/dev/full")


def test_the_worker_runs_the_newest_waiting_job():
    done, go = [], threading.Event()
    with Worker() as worker:
        worker.offer(lambda: (go.wait(5.0), done.append("first")))
        wait_until(lambda: worker._job is None)
        for name in ("second", "third"):
            worker.offer(lambda name=name: done.append(name))
        assert not worker.idle
        go.set()
        wait_until(lambda: worker.idle)
    assert done == ["first", "third"]


def test_the_error_of_a_job_is_raised_at_the_next_check():
    def fail():
        raise ValueError("a job's")

    with Worker() as worker:
        worker.check()
        worker.offer(fail)
        wait_until(lambda: worker._error is not None)
        with pytest.raises(ValueError, match="a job's"):
            worker.check()


class Attended:
    """A guard reduced to its `attended` context."""

    is_attended = False

    @contextlib.contextmanager
    def attended(self):
        self.is_attended = True
        yield
        self.is_attended = False


def test_the_operator_counts_as_present_until_the_first_step_only():
    guard = Attended()

    def steps():
        assert guard.is_attended
        yield "first"
        assert not guard.is_attended
        yield "second"

    assert list(attended_at_first(guard, steps())) == ["first", "second"]


def test_without_steps_the_operator_does_not_stay_present():
    guard = Attended()
    assert list(attended_at_first(guard, iter(()))) == []
    assert not guard.is_attended


class Clock:
    now_s = 100.0

    def __call__(self):
        return self.now_s

    def sleep(self, span_s):
        assert span_s > 0
        self.now_s += span_s


def played(film, *works_s):
    """Return the time and frames of each step for a consumer that takes `works_s` per step."""
    clock, steps = Clock(), []
    given = at_speed(iter(film), stamped=True, clock=clock, sleep=clock.sleep)
    for frames, work_s in zip(given, works_s, strict=True):
        steps.append((clock.now_s, frames))
        clock.now_s += work_s
    return steps


def film(count, *, start_s=5.0, step_s=0.1):
    image = np.zeros((2, 2), np.uint8)
    return [(Frame(k, start_s + step_s * k, image),) * 2 for k in range(count)]


def test_a_recording_plays_in_its_own_time():
    steps = played(film(4), 0.03, 0.09, 0.0, 0.05)
    assert [now_s for now_s, _ in steps] == pytest.approx([100.0, 100.1, 100.2, 100.3])
    assert [frames[1].time_s for _, frames in steps] == pytest.approx([100.0, 100.1, 100.2, 100.3])
    assert [frames[0].index for _, frames in steps] == [0, 1, 2, 3]


def test_a_recording_waits_for_a_slower_consumer():
    steps = played(film(6), 0.03, 0.35, 0.13, 0.0, 0.25, 0.0)
    given_s = [100.0, 100.1, 100.45, 100.58, 100.68, 100.93]
    assert [now_s for now_s, _ in steps] == pytest.approx(given_s)
    assert [frames[0].time_s for _, frames in steps] == pytest.approx(given_s)
    assert [frames[0].index for _, frames in steps] == list(range(6))


def test_views_with_rates_of_their_own_keep_their_times():
    steps = [(left, right if k % 2 == 0 else None) for k, (left, right) in enumerate(film(4))]
    played_steps = played(steps, 0.35, 0.02, 0.0, 0.0)
    given = [[frame and frame.index for frame in frames] for _, frames in played_steps]
    assert given == [[0, 0], [1, None], [2, 2], [3, None]]
    assert [now_s for now_s, _ in played_steps] == pytest.approx([100.0, 100.35, 100.45, 100.55])


def test_frames_of_different_times_get_different_stamps():
    left, right = film(2)[0][0], film(2)[1][0]
    ((now_s, frames),) = played([(left, right)], 0.0)
    assert now_s == 100.0
    assert [frame.time_s for frame in frames] == pytest.approx([99.9, 100.0])


def test_playback_starts_with_the_first_frame():
    steps = played([(None, None), *film(2)], 7.0, 0.0, 0.0)
    assert steps[0] == (100.0, [None, None])
    assert [now_s for now_s, _ in steps[1:]] == pytest.approx([107.0, 107.1])


def test_the_report_states_the_lag_of_the_smoothing():
    report = SessionReport()
    report.fixes.update(["ok"] * 4 + ["lost"])
    for state, lag_s in (("moving", 0.0), ("moving", 0.02), ("there", 0.15), ("there", 0.16)):
        report.add(FollowReport(FollowState(state), target=np.zeros(2), lag_s=lag_s))
    report.add(FollowReport(FollowState.HOLDING, "fix is lost"))
    assert report.lag_ms() == pytest.approx({"least": 20.0, "median": 150.0, "largest": 160.0})
    assert report.lines() == [
        "fixes    4 ok, 1 lost",
        "arm      2 moving, 2 there, 1 holding",
        "lag      smoothing makes the target late by 20 ms for a quick hand, 160 ms for one at "
        "rest (median 150 ms)",
    ]
    assert SessionReport().lag_ms() is None
    assert SessionReport().lines() == ["fixes    none"]
