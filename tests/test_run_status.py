"""Output of a run: its status line and its summary."""

import http.server
import io
import json
import logging
import os
import re
import signal
import sys
import threading
from dataclasses import dataclass

import cv2
import numpy as np
import pytest
from command_line import invoked
from terminals import THE_END, on_a_terminal

from fingerpost.cli.live_status import LiveStatus
from fingerpost.cli.progress import StatusLine, cell_count, status_line
from fingerpost.cli.run_summary import RunSummary
from fingerpost.pipeline import Step
from fingerpost.pointing import FingerLine, Fix, Status
from fingerpost.simulate import DevicePose, SimulatedRig, Trajectory, write_recording

FRAMES = 12
ERASED = re.compile(r"\r *\r")


class Screen(io.StringIO):
    """A terminal of a given width that remembers everything written to it."""

    def __init__(self, columns: int, monkeypatch: pytest.MonkeyPatch) -> None:
        super().__init__()
        monkeypatch.setattr("os.get_terminal_size", lambda _: os.terminal_size((columns, 24)))

    def isatty(self) -> bool:
        return True

    def fileno(self) -> int:
        return 2

    @property
    def lines(self) -> list[str]:
        """The lines as they are displayed now."""
        shown = []
        for written in self.getvalue().split("\n"):
            line = ""
            for words in written.split("\r"):
                line = words + line[len(words) :]
            shown.append(line.rstrip())
        return shown


LINE = FingerLine(np.zeros(2), 0.0, np.eye(2), np.array([30.0, 0.0]), 0.0)


@dataclass
class Seen:
    view: str
    finger: FingerLine | Status
    is_adrift: bool = False


def step(
    *states: FingerLine | Status,
    point: tuple[float, float] | None = None,
    status: Status = Status.LOST,
    reason: str = "",
    names: tuple[str, ...] = ("left", "right", "top", "front"),
) -> Step:
    seen = tuple(Seen(name, state) for name, state in zip(names, states, strict=False))
    fix = Fix(0.0, status, (None,) * len(seen), reason=reason)
    if point is not None:
        covariance = np.array([[1.44, 0.0], [0.0, 6.25]])
        fix = Fix(0.0, Status.OK, (None,) * len(seen), np.array(point), covariance, 0.5)
    return Step(0, seen, fix)


class Shown:
    """A live status on a terminal, given steps at given times."""

    def __init__(self, columns: int, monkeypatch: pytest.MonkeyPatch) -> None:
        self.terminal = Screen(columns, monkeypatch)
        self.now_s = 0.0
        self.status = LiveStatus(
            StatusLine(self.terminal), unit="mm", plane_size=400.0, clock=lambda: self.now_s
        )

    def at(self, now_s: float, given: Step) -> str:
        self.now_s = now_s
        self.status.take(given)
        (line,) = self.terminal.lines
        return line


@pytest.fixture(params=[80, 120])
def shown(request, monkeypatch):
    return Shown(request.param, monkeypatch)


# --- the status line --------------------------------------------------------------------------


def test_the_line_shows_states_point_and_rate(shown):
    shown.at(0.0, step(LINE, Status.ACQUIRING))
    line = shown.at(0.5, step(LINE, LINE, point=(201.52, 99.96)))
    assert line.startswith("left tracking    right tracking    X 201.5 ± 1.2   Y 100.0 ± 2.5 mm")
    assert line.endswith(" 2.0 fps")
    assert len(line) == shown.status._line.columns


def test_after_a_loss_the_last_point_is_shown_with_its_age(shown):
    shown.at(0.0, step(LINE, LINE, point=(201.52, 99.96)))
    line = shown.at(3.0, step(Status.LOST, LINE))
    assert line.startswith(
        "left lost        right tracking    X 201.5 ± 1.2   Y 100.0 ± 2.5 mm, 3 s ago"
    )
    assert "2 min ago" in shown.at(125.0, step(Status.LOST, LINE))


def test_before_the_first_point_none_is_shown(shown):
    assert shown.at(0.0, step(Status.ACQUIRING, LINE)).endswith("right tracking    no point yet")


def test_a_reason_is_shown_where_the_states_do_not_explain_it(monkeypatch):
    shown = Shown(120, monkeypatch)
    why = 'the point lies 12 px behind the finger tip in view "left"'
    refused = step(LINE, LINE, status=Status.ILL_CONDITIONED, reason=why)
    assert f"no point yet: {why}" in shown.at(0.0, refused)
    shown.at(1.0, step(LINE, LINE, point=(201.52, 99.96)))
    assert "mm, 0.4 s ago" in shown.at(1.4, refused)
    assert f"no point for 4 s: {why}" in shown.at(5.0, refused)


def test_a_moved_camera_is_shown_as_a_state(shown):
    seen = step(LINE, Status.ILL_CONDITIONED)
    seen.observations[1].is_adrift = True
    assert shown.at(0.0, seen).startswith("left tracking    right moved")


def test_the_line_changes_at_most_ten_times_a_second(shown):
    for k in range(100):
        shown.at(k / 100, step(LINE, LINE, point=(float(k), 0.0)))
    assert shown.terminal.getvalue().count("\r") == pytest.approx(10, abs=1)


@pytest.mark.parametrize("columns", [20, 44, 80])
def test_states_are_counted_where_the_views_have_no_room(monkeypatch, columns):
    shown = Shown(columns, monkeypatch)
    line = shown.at(0.0, step(LINE, LINE, Status.LOST, LINE, point=(201.52, 99.96)))
    assert line.startswith("3 tracking, 1 lost")
    assert len(line) < columns


def test_wide_characters_count_as_two_columns(monkeypatch):
    shown = Shown(80, monkeypatch)
    seen = step(LINE, LINE, point=(1.0, 2.0), names=("左のカメラ", "右のカメラ"))
    assert cell_count(shown.at(0.0, seen)) < 80
    shown.terminal = Screen(8, monkeypatch)
    StatusLine(shown.terminal).show("左のカメラ")
    assert shown.terminal.lines == ["左のカ…"]


def test_a_shorter_line_erases_the_longer_one(monkeypatch):
    terminal = Screen(80, monkeypatch)
    line = StatusLine(terminal)
    line.show("a long line")
    line.show("short")
    assert terminal.lines == ["short"]
    line.clear()
    assert terminal.lines == [""]


def test_a_terminal_without_a_size_has_eighty_columns():
    stream = io.StringIO()
    StatusLine(stream).show("x" * 200)
    assert stream.getvalue() == "\r" + "x" * 78 + "…"


def test_log_messages_have_lines_of_their_own(monkeypatch):
    terminal = Screen(80, monkeypatch)
    monkeypatch.setattr("sys.stderr", terminal)
    handler = logging.StreamHandler(terminal)
    logging.getLogger().addHandler(handler)
    try:
        with status_line() as line:
            line.show("left tracking")
            logging.getLogger("fingerpost.test").warning("a view has ended")
            line.show("left lost")
        logging.getLogger("fingerpost.test").warning("over")
    finally:
        logging.getLogger().removeHandler(handler)
    assert terminal.lines == ["a view has ended", "over", ""]
    assert handler.filters == []


def test_a_file_gets_no_status_line(monkeypatch):
    monkeypatch.setattr("sys.stderr", io.StringIO())
    with status_line() as line:
        assert line is None


# --- the summary ------------------------------------------------------------------------------


def fixes(count: int, status: Status, reason: str) -> list[Fix]:
    return [Fix(0.0, status, (None, None), reason=reason)] * count


def test_the_summary_counts_statuses_and_reasons():
    summary = RunSummary()
    for fix in [
        *fixes(6, Status.LOST, 'view "left" is lost'),
        *fixes(2, Status.LOST, 'view "cam 2" is lost'),
        *fixes(2, Status.LOST, 'view "cam 3" is lost'),
        *fixes(1, Status.ILL_CONDITIONED, "standard deviation 81.5 along the lines"),
        *fixes(1, Status.ILL_CONDITIONED, "standard deviation 1e+03 along the lines"),
        *fixes(1, Status.ILL_CONDITIONED, "standard deviation 90 along the lines"),
        *fixes(1, Status.LOST, "the first"),
        *fixes(1, Status.LOST, "the second"),
        *fixes(5, Status.OK, ""),
    ]:
        summary.add(fix)
    assert summary.lines(1.25) == [
        "frames   20 in 1.2 s",
        "lost                12   60.0 %",
        "ok                   5   25.0 %",
        "ill_conditioned      3   15.0 %",
        "reasons",
        '    6   view "left" is lost',
        "    3   standard deviation … along the lines",
        '    2   view "cam 2" is lost',
        '    2   view "cam 3" is lost',
        "    1   the first",
        "    1   others",
    ]


def test_a_run_without_a_point_names_the_doctor():
    summary = RunSummary()
    for fix in fixes(3, Status.ACQUIRING, 'view "left" is acquiring'):
        summary.add(fix)
    assert summary.lines(1.0)[-1].startswith("no point at all: `fingerpost doctor`")


def test_a_run_without_reasons_names_none():
    summary = RunSummary()
    summary.add(fixes(1, Status.OK, "")[0])
    assert summary.lines(1.0) == ["frames   1 in 1.0 s", "ok                   1  100.0 %"]


# --- whole runs -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def rig_file(tmp_path_factory):
    pose = DevicePose.pointing_at((200.0, 200.0), azimuth_deg=20.0, slant_deg=50.0, hover_mm=120.0)
    directory = tmp_path_factory.mktemp("recording")
    return write_recording(directory, SimulatedRig(), Trajectory.hold(pose, 1.0), frames=FRAMES)


def test_summary_and_rows_state_reasons(rig_file):
    said = invoked("run", rig_file).stdout.splitlines()
    reasons = said[said.index("reasons") + 1 :]
    assert any('view "left" is acquiring' in line for line in reasons)
    first, *_, last = map(json.loads, invoked("run", rig_file, "--json").stdout.splitlines())
    assert 'view "left" is acquiring' in first["reason"]
    assert last["reason"] == ""


def test_the_noise_of_the_reference_points_is_part_of_the_ellipse(rig_file):
    spread = {}
    for noise in (0.01, 0.5, 5.0):
        done = invoked("run", rig_file, "--json", "--reference-noise", noise)
        last = json.loads(done.stdout.splitlines()[-1])
        spread[noise] = last["cov_xx"] + last["cov_yy"]
    assert spread[0.01] < spread[0.5] < spread[5.0] / 10
    last = json.loads(invoked("run", rig_file, "--json").stdout.splitlines()[-1])
    assert last["cov_xx"] + last["cov_yy"] == spread[0.5]


def with_covariances(text: str, views: int) -> str:
    given = "reference_covariances_px2 = [" + ", ".join(["[0.25, 0.0, 0.25]"] * 4) + "]"
    return re.sub(r"(source = .*)", rf"\1\n{given}", text, count=views)


def test_reference_noise_without_effect_is_refused(rig_file):
    given = rig_file.with_name("given.toml")
    given.write_text(with_covariances(rig_file.read_text(), 2))
    done = invoked("run", given, "--reference-noise", 0.3)
    assert done.exit_code == 2
    assert "--reference-noise would do nothing" in done.stderr
    given.write_text(with_covariances(rig_file.read_text(), 1))
    assert invoked("run", given, "--reference-noise", 0.3).exit_code == 0


@pytest.mark.parametrize("number", ["nan", "-1", "0", "1e9"])
def test_invalid_reference_noise_is_refused(rig_file, number):
    done = invoked("run", rig_file, "--reference-noise", number)
    assert (done.exit_code, done.stdout) == (2, "")
    assert f"reference_sigma_px is {float(number)}; from 1e-06 to 1e+06 is right" in done.stderr


class Pictures(http.server.ThreadingHTTPServer):
    """Motion JPEG on a loopback port: two views of a hand that is held still."""

    daemon_threads = True

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), PictureHandler)
        rig, rng = SimulatedRig(), np.random.default_rng(1)
        pose = DevicePose.pointing_at(
            (200.0, 200.0), azimuth_deg=20.0, slant_deg=50.0, hover_mm=120.0
        )
        motion = Trajectory.hold(pose, 1.0)
        taken = [rig.render(motion, time_s=0.0, rng=rng).images for _ in range(8)]
        self.jpegs = [[cv2.imencode(".jpg", image)[1].tobytes() for image in v] for v in taken]
        self.closing = threading.Event()


class PictureHandler(http.server.BaseHTTPRequestHandler):
    server: Pictures

    def do_GET(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
        self.end_headers()
        number = 0
        while not self.server.closing.wait(0.05):
            number += 1
            jpeg = self.server.jpegs[number % 8]["right" in self.path]
            head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
            try:
                self.wfile.write(head.encode() + jpeg + b"\r\n")
            except OSError:  # the run has ended
                return

    def log_message(self, *args: object) -> None:
        pass


@pytest.fixture
def live_rig(rig_file, tmp_path):
    server = Pictures()
    thread = threading.Thread(target=server.serve_forever, args=[0.02])
    thread.start()
    url = f"http://127.0.0.1:{server.server_port}"
    text = re.sub(r'source = "(\w+)[^"]*"', rf'source = "{url}/\1.mjpg"', rig_file.read_text())
    (tmp_path / "live.toml").write_text(text)
    yield tmp_path / "live.toml"
    server.closing.set()
    server.shutdown()
    thread.join()
    server.server_close()


def test_a_live_run_shows_its_state_and_sums_up_on_ctrl_c(live_rig):
    with on_a_terminal("run", live_rig) as run:
        seen = run.read_until(r"left \w+ +right \w+ .* fps")
        assert " fps" in seen, seen
        assert seen.startswith("\ropening left, right")
        run.process.send_signal(signal.SIGINT)
        rest = run.read_until(THE_END)
        code, summary = run.end()
    assert code == 130
    assert re.fullmatch(r"frames   [1-9]\d* in \d+\.\d s", summary.splitlines()[0])
    assert " fps" not in ERASED.split(rest)[-1]
    assert rest.split()[-2:] == ["fingerpost:", "stopped"]


def test_the_bar_ends_before_the_summary_of_an_interrupted_run(rig_file, monkeypatch):
    order = []

    def bar(frames, *_):
        try:
            yield from frames
        finally:
            order.append("bar")

    def interrupted(summary, fix):
        counted(summary, fix)
        raise KeyboardInterrupt

    counted, lines = RunSummary.add, RunSummary.lines
    monkeypatch.setattr("fingerpost.cli.progress._is_watched", lambda: True)
    monkeypatch.setattr(sys.modules["fingerpost.cli.following"], "watched", bar)
    monkeypatch.setattr(RunSummary, "add", interrupted)
    monkeypatch.setattr(RunSummary, "lines", lambda *given: order.append("sum") or lines(*given))
    done = invoked("run", rig_file)
    assert (done.exit_code, order) == (130, ["bar", "sum"])
    assert done.stdout.startswith("frames   1 in ")


def test_a_recording_has_a_bar_and_json_rows_have_none(rig_file):
    with on_a_terminal("run", rig_file) as run:
        assert "tracking  [" in run.read_until(THE_END)
        code, summary = run.end()
    assert code == 0
    assert summary.startswith("frames")
    with on_a_terminal("run", rig_file, "--json", both=True) as run:
        rows = run.read_until(THE_END).splitlines()
    assert [json.loads(row)["frame"] for row in rows] == list(range(FRAMES))
