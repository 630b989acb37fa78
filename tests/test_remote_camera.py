"""Cameras on another machine: pictures as sent, with times on this machine's clock."""

import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
import zenoh
from click.testing import CliRunner
from films import textured
from patience import PATIENCE_S, wait_until
from test_publishing import LINUX, free_port, listening
from test_remote import Server, server  # noqa: F401 - a fixture

from fingerpost.capture import Frame, Loss, SourceKind, open_source
from fingerpost.capture.over_zenoh import ClockOffset
from fingerpost.cli import main
from fingerpost.errors import CaptureError, InvalidInputError
from fingerpost.zenoh_link import clock_key, image_key, open_session, stamp

JPEGS = [cv2.imencode(".jpg", picture)[1].tobytes() for picture in textured(4)]


class Sender:
    """Another machine, whose clock is ahead of this machine's."""

    def __init__(self, port: int, ahead_ns: int = 0) -> None:
        self.ahead_ns = ahead_ns
        self.session = open_session("127.0.0.1", port, listens=True)
        self.clock = self.session.declare_queryable(clock_key("lab"), self._answer)

    def _answer(self, query: zenoh.Query) -> None:
        with query:
            query.reply(query.key_expr, str(time.monotonic_ns() + self.ahead_ns))

    def send(self, index: int, attachment: bytes | None = None) -> int:
        """Send a picture; return when it was captured, by this machine's clock [ns]."""
        now_ns = time.monotonic_ns()
        if attachment is None:
            attachment = stamp(index, now_ns + self.ahead_ns)
        jpeg = JPEGS[index % len(JPEGS)]
        self.session.put(image_key("lab", "left"), jpeg, attachment=attachment)
        return now_ns

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.session.close()


class Repeating:
    """Sends pictures repeatedly until a source has opened."""

    def __init__(self, sender: Sender) -> None:
        self.sender = sender
        self.sent: list[int] = []

    def open(self, port: int, timeout_s: float = PATIENCE_S):
        opened = threading.Event()

        def send() -> None:
            while not opened.wait(0.01):
                self.sent.append(self.sender.send(len(self.sent) % 2))

        thread = threading.Thread(target=send)
        thread.start()
        try:
            return open_source(f"zenoh://127.0.0.1:{port}/lab/left", timeout_s=timeout_s)
        finally:
            opened.set()
            thread.join()


@pytest.mark.parametrize("ahead_ns", [0, 5_000_000_000, -3_000_000_000])
def test_pictures_arrive_as_sent_with_times_on_this_machine_s_clock(ahead_ns):
    port = free_port()
    with Sender(port, ahead_ns) as sender:
        repeating = Repeating(sender)
        with repeating.open(port) as source:
            assert source.kind is SourceKind.LIVE
            assert isinstance(next(source), Frame)
            captured_ns = sender.send(2)
            while (frame := next(source)).encoded != JPEGS[2]:
                pass
            note = next(note for note in source.notes if "clock" in note)
            offset_ns, error_ns = source._stamping._offset.best
    assert frame.encoded == JPEGS[2]
    decoded = cv2.imdecode(np.frombuffer(JPEGS[2], np.uint8), cv2.IMREAD_COLOR)
    np.testing.assert_array_equal(frame.image, decoded)
    assert abs(offset_ns - ahead_ns) <= error_ns + 1
    assert abs(frame.time_s * 1e9 - captured_ns) <= error_ns + 1000  # and rounding of floats
    way = "behind" if offset_ns < 0 else "ahead of"
    assert f"its clock is {abs(offset_ns) / 1e6:.1f} ms {way} this machine's, to within" in note


def test_the_fastest_answer_gives_the_offset():
    offset = ClockOffset(time.monotonic_ns)
    assert not offset.is_known
    # The other clock is 1000 ahead; the second answer is delayed, on its way back only.
    offset.add(0, 10, 1005)
    offset.add(100, 500, 1105)
    assert offset.best == (1000, 5)
    assert offset.here(3000) == 2000
    for k in range(8):  # old answers are dropped: clocks drift
        offset.add(1000 * k, 1000 * k + 20, 1000 * k + 1210)
    assert offset.best == (1200, 10)


def test_a_camera_that_disconnects_is_lost_and_returns():
    port = free_port()
    with Sender(port) as sender, Repeating(sender).open(port, timeout_s=1.0) as source:
        assert isinstance(next(source), Frame)
        sender.session.close()
        while isinstance(next(source), Frame):
            pass
        assert isinstance(next(source), Loss)
        with Sender(port) as again:
            seen: list[Frame | Loss] = []

            def is_back() -> bool:
                again.send(1)
                source.linger(0.02)
                seen.append(next(source))
                return isinstance(seen[-1], Frame)

            wait_until(is_back)


def test_missing_cameras_are_reported():
    port = free_port()
    url = f"zenoh://127.0.0.1:{port}"
    with pytest.raises(CaptureError, match=f"nobody answers at 127.0.0.1:{port}"):
        open_source(f"{url}/lab/left", timeout_s=PATIENCE_S)
    with pytest.raises(InvalidInputError, match="names no camera; zenoh://HOST:PORT/KEY/NAME"):
        open_source(f"{url}/left")
    session = open_session("127.0.0.1", port, listens=True)
    with pytest.raises(CaptureError, match="nobody publishes pictures under 'lab' there"):
        open_source(f"{url}/lab/left", timeout_s=3.0)
    session.close()


@pytest.fixture
def camera(server: Server) -> Iterator[tuple[subprocess.Popen, int]]:  # noqa: F811
    """`fingerpost cameras --publish` of a stream, and its port."""
    port = free_port()
    program = [sys.executable, "-m", "fingerpost", "cameras", f"left={server.url('/camera')}"]
    program += ["--publish", f"zenoh://127.0.0.1:{port}/lab"]
    running = subprocess.Popen(program, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    yield running, port
    running.kill()
    running.communicate()


def test_pictures_of_cameras_are_published_unchanged(camera, server):  # noqa: F811
    running, port = camera
    line = running.stdout.readline()
    assert line == f'source = "zenoh://127.0.0.1:{port}/lab/left"\n'
    with open_source(line.split('"')[1], timeout_s=PATIENCE_S) as source:
        frame = next(source)
    assert frame.encoded in server.jpegs
    if LINUX:
        assert listening(running.pid) == {f"0100007F:{port:04X}"}
    running.send_signal(signal.SIGINT)
    _, said = running.communicate()
    assert running.returncode == 130, said
    count = int(said.split("left: ")[1].split()[0])
    assert count >= 1
    assert "Traceback" not in said


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--publish", "osc://127.0.0.1", "0"], "zenoh://ADDRESS:PORT/KEY is right for cameras"),
        (["--publish", "zenoh://", "0", "0"], "there is a camera 'camera-0' already"),
        (["0"], "0: is for --publish, which is not given"),
        (
            ["--publish", "zenoh://", "0", "--set", "widht=3"],
            "unknown key 'widht'; known are width",
        ),
        (["--publish", "zenoh://", "0", "--set", "fps=0"], "fps"),
        (["--publish", "zenoh://", "0", "--set", "fps"], "KEY=VALUE as in TOML is right"),
    ],
)
def test_wrong_arguments_are_refused_in_one_line(arguments, said):
    done = CliRunner().invoke(main, ["cameras", *arguments])
    assert done.exit_code == 2
    (line,) = done.stderr.splitlines()
    assert said in line


def test_a_film_is_not_published(tmp_path: Path):
    film = tmp_path / "a.png"
    cv2.imwrite(str(film), textured(1)[0])
    done = CliRunner().invoke(main, ["cameras", f"a={film}", "--publish", "zenoh://"])
    assert done.exit_code == 2
    assert "is a recording; a camera is right" in done.stderr
