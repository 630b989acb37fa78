"""Sources by URL: films and streams are read; pictures, pages and errors are refused by name."""

import http.server
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from itertools import islice
from pathlib import Path

import cv2
import pytest
from films import textured, write_film
from patience import PATIENCE_S, wait_until

from fingerpost.capture import Frame, Loss, SourceKind, open_source, read_views
from fingerpost.capture.url import masked
from fingerpost.errors import CaptureError, InvalidInputError, SourceError

COUNT = 12


class Server(http.server.ThreadingHTTPServer):
    """A web server with a film, a picture, a page, and cameras that stall or die on request."""

    daemon_threads = True

    def __init__(self, film: bytes) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.jpegs = [cv2.imencode(".jpg", p)[1].tobytes() for p in textured(COUNT)]
        self.film = film
        self.silent: set[str] = set()
        self.dead: set[str] = set()
        self.closing = False

    def url(self, path: str, user: str = "") -> str:
        return f"http://{user}127.0.0.1:{self.server_port}{path}"


class Handler(http.server.BaseHTTPRequestHandler):
    server: Server

    def log_message(self, *args: object) -> None:
        pass

    def do_GET(self) -> None:
        path = self.path.partition("?")[0]
        answers = {
            "/film.mp4": ("video/mp4", self.server.film),
            "/film.bin": ("application/octet-stream", self.server.film),
            "/snapshot.jpg": ("image/jpeg", self.server.jpegs[0]),
            "/snapshot": ("application/octet-stream", self.server.jpegs[0]),
            "/page": ("text/html", b"<!doctype html><html></html>"),
            "/nothing.mp4": ("video/mp4", b""),
        }
        if path.startswith("/camera"):
            self._stream(path)
        elif path == "/private" and not self.headers.get("Authorization", "").startswith("Basic"):
            self.send_response(401)
            self.send_header("WWW-Authenticate", 'Basic realm="a"')
            self.end_headers()
        elif path[1:].isdigit():
            self.send_error(int(path[1:]))
        else:
            content, data = answers.get(path, ("video/mp4", self.server.film))
            self.send_response(200)
            self.send_header("Content-Type", content)
            self.send_header("Content-Length", str(len(data)))
            self.end_headers()
            self.wfile.write(data)

    def _stream(self, path: str) -> None:
        if path in self.server.dead:
            self.send_error(503)
            return
        self.send_response(200)
        self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
        self.end_headers()
        number = 0
        while not self.server.closing and path not in self.server.dead:
            time.sleep(0.01)
            if path in self.server.silent:
                continue
            jpeg = self.server.jpegs[number % COUNT]
            head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
            try:
                self.wfile.write(head.encode() + jpeg + b"\r\n")
            except OSError:
                return
            number += 1


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Server]:
    film = write_film(tmp_path / "film.mp4", textured(COUNT), "mp4v").read_bytes()
    server = Server(film)
    thread = threading.Thread(target=server.serve_forever, args=[0.02])
    thread.start()
    yield server
    server.closing = True
    server.shutdown()
    thread.join()
    server.server_close()


@pytest.mark.parametrize("path", ["/film.mp4", "/film.bin", "/private"])
def test_a_film_on_a_server_is_a_recording_and_leaves_no_copy(server, monkeypatch, tmp_path, path):
    copies = tmp_path / "copies"
    copies.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(copies))
    with open_source(server.url(path, "name:secret@"), timeout_s=PATIENCE_S) as source:
        assert source.kind is SourceKind.RECORDED
        assert [frame.time_s for frame in source] == pytest.approx([k / 25 for k in range(COUNT)])
        assert "secret" not in source.name
    assert list(copies.iterdir()) == []


@pytest.mark.parametrize(
    ("path", "said"),
    [
        ("/snapshot.jpg", r"is one picture \(image/jpeg\), no stream"),
        ("/snapshot", r"is one picture \(application/octet-stream\), no stream"),
        ("/page", r"is a page \(text/html\), no stream"),
        ("/nothing.mp4", "the server sends nothing"),
        ("/401", "the server answers 401 Unauthorized; it needs a user and a password"),
        ("/private", "the server answers 401 Unauthorized; it needs a user and a password"),
        ("/403", "the server answers 403 Forbidden; this user may not"),
        ("/404", "the server answers 404 Not Found; there is nothing at this path"),
        ("/500", "the server answers 500 Internal Server Error"),
    ],
)
def test_urls_without_a_stream_are_refused_without_naming_secrets(server, path, said):
    with pytest.raises(SourceError, match=said) as raised:
        open_source(server.url(f"{path}?token=hidden"), timeout_s=PATIENCE_S)
    assert "hidden" not in str(raised.value)
    assert isinstance(raised.value, InvalidInputError)  # so that commands exit with 2


@pytest.mark.parametrize("scheme", ["http", "rtsp", "tcp"])
def test_a_refused_connection_and_an_unknown_host_are_distinguished(scheme):
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    with pytest.raises(SourceError, match="connection refused: nothing listens there"):
        open_source(f"{scheme}://127.0.0.1:{port}/a", timeout_s=PATIENCE_S)
    with pytest.raises(SourceError, match="unknown host"):
        open_source(f"{scheme}://no.such.host.invalid:{port}/a", timeout_s=PATIENCE_S)


def test_an_rtsp_server_without_the_stream_is_reported():
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def answer() -> None:
            line, _ = listener.accept()
            with line:
                line.recv(4096)
                line.sendall(b"RTSP/1.0 404 Stream Not Found\r\nCSeq: 1\r\n\r\n")

        thread = threading.Thread(target=answer)
        thread.start()
        with pytest.raises(SourceError, match="the server answers 404 Stream Not Found"):
            open_source(f"rtsp://127.0.0.1:{listener.getsockname()[1]}/a", timeout_s=PATIENCE_S)
        thread.join()


@pytest.mark.parametrize(
    ("url", "shown"),
    [
        (0, "camera 0"),
        ("left.mp4", "left.mp4"),
        ("rtsp://cam-1:554/Streaming/Channels/101", "rtsp://cam-1:554/Streaming/Channels/101"),
        ("http://u:p@cam/video.mjpg", "http://***@cam/video.mjpg"),
        ("http://u:p/w@cam/a", "http://***@cam/a"),
        ("https://cam/live/8f3a9c0e4b7d/index.m3u8?k=v", "https://cam/live/***/index.m3u8?***"),
        ("https://cam/s3cr3t", "https://cam/***"),
        ("https://cam?token=v", "https://cam?***"),
        ("https://cam/a#token", "https://cam/***"),
    ],
)
def test_names_show_nothing_that_may_be_secret(url, shown):
    assert masked(url) == shown


# --- streams that stall, die and return -----------------------------------------------------------


@pytest.mark.parametrize("how", ["silent", "dead"])
def test_a_view_that_stops_is_lost_while_others_go_on_and_returns(server, caplog, monkeypatch, how):
    monkeypatch.setattr("fingerpost.capture.live._FIRST_PAUSE_S", 0.01)
    with (
        open_source(server.url("/camera/left"), timeout_s=PATIENCE_S) as left,
        open_source(server.url("/camera/right"), timeout_s=PATIENCE_S) as right,
    ):
        steps = read_views([left, right])
        assert any(all(isinstance(entry, Frame) for entry in step) for step in steps)
        right._timeout_s = 0.3  # only from here on: opening may be slow
        getattr(server, how).add("/camera/right")
        lost = next(step for step in steps if isinstance(step[1], Loss))
        assert lost[1].why.startswith("no picture has come for")
        more = list(islice(steps, 5))
        assert any(isinstance(step[0], Frame) for step in more)
        getattr(server, how).clear()
        assert any(isinstance(step[1], Frame) for step in steps)
        assert caplog.text.count("/camera/right: no new frame within 0.3 s: lost until") == 1


@pytest.mark.parametrize("how", ["silent", "dead"])
def test_other_views_do_not_wait_for_an_overdue_one_and_it_returns(server, caplog, how):
    """The time limit of the sources is longer than any test; nothing here waits for it."""
    with ExitStack() as stack:
        views = [
            stack.enter_context(open_source(server.url(f"/camera/{name}"), timeout_s=PATIENCE_S))
            for name in ("left", "middle", "right")
        ]
        steps = read_views(views)
        kinds = ([type(entry) for entry in step] for step in steps)
        assert kinds_come(kinds, [Frame, Frame, Frame])
        getattr(server, how).add("/camera/left")
        assert kinds_come(kinds, [Loss, Frame, Frame])
        getattr(server, how).clear()
        assert kinds_come(kinds, [Frame, Frame, Frame])
    assert "lost until" not in caplog.text


def kinds_come(kinds: Iterator[list[type]], expected: list[type]) -> bool:
    """Wait for a step with these entries: on a busy machine other cameras are late, too."""
    return any(found == expected for found in kinds)


def test_a_view_that_stays_lost_is_given_up_after_a_limit(server):
    with open_source(server.url("/camera/left"), timeout_s=PATIENCE_S) as source:
        steps = read_views([source], give_up_after_s=0.3)
        next(steps)
        server.silent.add("/camera/left")
        with pytest.raises(CaptureError, match=r"/camera/left: no picture for .* given up after"):
            list(steps)
        source._timeout_s = 0.1  # so that its reader ends soon
    with pytest.raises(InvalidInputError, match="give_up_after_s is 0"):
        read_views([source], give_up_after_s=0)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_end_waiting_for_a_pipe_without_a_writer(tmp_path, number):
    os.mkfifo(tmp_path / "pipe")
    program = (
        "import sys\nfrom fingerpost.capture import open_source\nprint('opening', flush=True)\n"
        f"open_source(sys.argv[1], timeout_s={PATIENCE_S})"
    )
    command = [sys.executable, "-c", program, str(tmp_path / "pipe")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as child:
        assert child.stdout is not None
        child.stdout.readline()
        wait_until(lambda: b"capture" in names_of_threads(child.pid) or child.poll() is not None)
        child.send_signal(number)
        assert child.wait(PATIENCE_S) != 0


def names_of_threads(pid: int) -> bytes:
    """Return `b"capture"` if there is a second thread; Python names threads only from 3.14 on."""
    tasks = list(Path(f"/proc/{pid}/task").glob("*"))
    return b"capture" if len(tasks) > 1 else b""


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_a_pipe_without_a_writer_is_given_up(tmp_path, monkeypatch):
    monkeypatch.setattr("fingerpost.capture.live._JOIN_S", 0.05)
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(SourceError, match=r"pipe: (did not open|nothing was .*) within 0"):
        open_source(str(tmp_path / "pipe"), timeout_s=0.2)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_a_pipe_with_a_writer_is_a_live_view(tmp_path):
    film = write_film(tmp_path / "film.ts", textured(90), "mp4v").read_bytes()
    os.mkfifo(tmp_path / "pipe")
    closing = threading.Event()

    def write() -> None:
        with (tmp_path / "pipe").open("wb", buffering=0) as pipe:
            while not closing.wait(0.01):
                pipe.write(film)

    writer = threading.Thread(target=write, daemon=True)
    writer.start()
    with open_source(str(tmp_path / "pipe"), timeout_s=PATIENCE_S) as source:
        assert source.kind is SourceKind.LIVE
        assert all(isinstance(entry, Frame) for entry in islice(source, 3))
        closing.set()
