"""Fixes reach other programs in formats that these decode, and never block the loop."""

import json
import logging
import math
import os
import re
import shutil
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import msgspec
import numpy as np
import pytest
import zenoh
from command_line import invoked
from live_server import RIG, served
from patience import wait_until
from pythonosc.dispatcher import Dispatcher
from pythonosc.osc_server import BlockingOSCUDPServer
from rosbags.typesys import Stores, get_typestore
from scipy.stats import chi2
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from fingerpost.capture import Loss, at_speed
from fingerpost.errors import InvalidInputError
from fingerpost.publishing import SCHEMES, Extent, PublishedFix, Publisher, open_publisher
from fingerpost.publishing.registry import refuse_unknown
from fingerpost.publishing.ros2 import _TYPES
from fingerpost.recording import read_points
from fingerpost.simulate import DevicePose, SimulatedRig, Trajectory, write_recording
from fingerpost.zenoh_link import open_session

PAGE = (Path(__file__).resolve().parents[1] / "docs" / "publishing.md").read_text(encoding="utf-8")
FRAMES = 6
PLANE = Extent((0.0, 100.0), (400.0, 300.0), "mm")
COVARIANCE = np.array([[4.0, 1.5], [1.5, 2.0]])
CHROMIUM = shutil.which("chromium")
LINUX = sys.platform.startswith("linux")


def fix(frame: int, point: tuple[float, float] | None = (100.0, 150.0)) -> PublishedFix:
    """A fix; frames are 40 ms apart."""
    cells = {}
    if point is not None:
        (xx, xy), (_, yy) = COVARIANCE.tolist()
        cells = {"x": point[0], "y": point[1], "cov_xx": xx, "cov_xy": xy, "cov_yy": yy}
    return PublishedFix(
        frame=frame,
        time_s=0.04 * frame,
        unix_time_s=1.7e9 + 0.04 * frame,
        status="lost" if point is None else "ok",
        unit="mm",
        target="cup",
        **cells,
    )


def free_port(kind: int = socket.SOCK_STREAM) -> int:
    with socket.socket(type=kind) as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


def listening(process: int | str = "self") -> set[str]:
    """Addresses, in the kernel's notation, of a process's listening TCP and all UDP sockets."""
    links = Path(f"/proc/{process}/fd").iterdir()
    mine = {str(link.readlink()) for link in links if link.is_symlink()}
    found = set()
    for table, listens in (("tcp", "0A"), ("tcp6", "0A"), ("udp", "07"), ("udp6", "07")):
        for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]:
            row = line.split()
            if row[3] == listens and f"socket:[{row[9]}]" in mine:
                found.add(row[1])
    return found


# --- OSC and TUIO -----------------------------------------------------------------------------


class OscServer:
    """python-osc's server, which records received messages."""

    def __init__(self) -> None:
        self.received: list[tuple[str, tuple]] = []
        dispatcher = Dispatcher()
        dispatcher.set_default_handler(lambda path, *values: self.received.append((path, values)))
        self.server = BlockingOSCUDPServer(("127.0.0.1", 0), dispatcher)
        self.port = self.server.server_address[1]
        self.thread = threading.Thread(target=self.server.serve_forever, args=(0.01,))

    def __enter__(self):
        self.thread.start()
        return self

    def __exit__(self, *_):
        self.server.shutdown()
        self.thread.join()
        self.server.server_close()


def test_osc_is_understood_by_an_osc_server():
    with OscServer() as server:
        with open_publisher(f"osc://127.0.0.1:{server.port}/lab/table", PLANE, waits=True) as one:
            one.put(fix(3))
            one.put(fix(4, None))
        wait_until(lambda: ("/lab/table/status", ("lost",)) in server.received)
    ellipse = [values for path, values in server.received if path == "/lab/table/ellipse"]
    rest = [entry for entry in server.received if entry[0] != "/lab/table/ellipse"]
    assert rest == [
        ("/lab/table/frame", (3, 0.12)),
        ("/lab/table/status", ("ok",)),
        ("/lab/table/point", (100.0, 150.0)),
        ("/lab/table/target", ("cup",)),
        ("/lab/table/frame", (4, 0.16)),
        ("/lab/table/status", ("lost",)),
    ]
    ((major, minor, angle_rad),) = ellipse
    axes = major * np.array([math.cos(angle_rad), math.sin(angle_rad)])
    assert axes @ np.linalg.solve(COVARIANCE, axes) == pytest.approx(chi2.ppf(0.95, 2), rel=1e-5)
    assert (major * minor) ** 2 == pytest.approx(
        chi2.ppf(0.95, 2) ** 2 * np.linalg.det(COVARIANCE), rel=1e-5
    )


def frames_of(received: list[tuple[str, tuple]]) -> list[dict]:
    """Frames of TUIO 1.1: each ends with `fseq`; `set` may only refer to cursors in `alive`."""
    frames, frame = [], {"set": {}}
    for path, (word, *values) in received:
        assert path == "/tuio/2Dcur"
        if word == "set":
            session, *cells = values
            assert len(cells) == 5
            frame["set"][session] = cells
        elif word == "fseq":
            assert set(frame["set"]) <= set(frame["alive"])
            frames.append({**frame, "fseq": values[0]})
            frame = {"set": {}}
        else:
            frame[word] = values
    return frames


def test_tuio_has_a_cursor_while_the_point_is_on_the_plane():
    # By half a side to the right and a quarter up in 40 ms; lost; back at the lower left; outside.
    places = [(100.0, 200.0), (300.0, 250.0), None, (0.0, 100.0), (-1.0, 100.0)]
    with OscServer() as server:
        with open_publisher(f"tuio://127.0.0.1:{server.port}", PLANE, waits=True) as one:
            for k, place in enumerate(places):
                one.put(fix(k, place))
        wait_until(lambda: ("/tuio/2Dcur", ("fseq", len(places))) in server.received)
    frames = frames_of(server.received)
    assert [one["fseq"] for one in frames] == [1, 2, 3, 4, 5]
    assert [one["alive"] for one in frames] == [[1], [1], [], [2], []]
    assert {tuple(one["source"]) for one in frames} == {("fingerpost",)}
    assert frames[0]["set"][1] == pytest.approx([0.25, 0.5, 0.0, 0.0, 0.0])
    speed = math.hypot(12.5, 6.25)
    assert frames[1]["set"][1] == pytest.approx([0.75, 0.25, 12.5, -6.25, speed / 0.04])
    assert frames[3]["set"][2] == pytest.approx([0.0, 1.0, 0.0, 0.0, 0.0])


@pytest.mark.parametrize(
    ("options", "place"),
    [("turn=90", (0.25, 0.25)), ("turn=180", (0.75, 0.25)), ("mirror", (0.75, 0.75))],
)
def test_tuio_can_be_rotated_and_mirrored(options, place):
    with OscServer() as server:
        url = f"tuio://127.0.0.1:{server.port}?{options}"
        with open_publisher(url, PLANE, waits=True) as one:
            one.put(fix(0, (100.0, 150.0)))
        # Closing removes the cursor.
        wait_until(lambda: ("/tuio/2Dcur", ("fseq", 2)) in server.received)
    first, last = frames_of(server.received)
    assert first["set"][1][:2] == pytest.approx(place)
    assert last["alive"] == []


def test_a_missing_receiver_is_reported_in_one_line(caplog):
    port = free_port(socket.SOCK_DGRAM)
    with open_publisher(f"osc://127.0.0.1:{port}", PLANE, waits=True) as one:
        for k in range(200):
            one.put(fix(k))
    (record,) = caplog.records
    assert record.getMessage() == (
        f"osc://127.0.0.1:{port}: nobody listens there; fixes go on, and it is tried again"
    )


# --- WebSocket --------------------------------------------------------------------------------


def test_a_websocket_client_gets_every_fix_as_json():
    with open_publisher("ws://127.0.0.1:0", PLANE, waits=True) as one:
        port = one._transport.port
        if LINUX:
            assert listening() == {f"0100007F:{port:04X}"}
        with connect(f"ws://127.0.0.1:{port}") as client:
            wait_until(lambda: one._transport._server.connections)
            for k in range(5):
                one.put(fix(k, (float(k), 2.0)))
            received = [json.loads(client.recv(timeout=10)) for _ in range(5)]
        with connect(f"ws://127.0.0.1:{port}", origin="http://localhost:8000") as client:
            late = json.loads(client.recv(timeout=10))
        with pytest.raises(InvalidStatus, match="403"):
            connect(f"ws://127.0.0.1:{port}", origin="http://localhost.example.com")
    assert [one["x"] for one in received] == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert received[0]["unix_time_s"] == 1.7e9
    assert received[0]["unit"] == "mm"
    assert late == received[-1]


def test_a_websocket_client_that_reads_nothing_does_not_affect_others():
    long = msgspec.structs.replace(fix(0), reason="x" * 10_000)
    with open_publisher("ws://127.0.0.1:0", PLANE, waits=True) as one:
        port = one._transport.port
        with (
            connect(f"ws://127.0.0.1:{port}", max_queue=1) as idle,
            connect(f"ws://127.0.0.1:{port}", max_queue=None) as reader,
        ):
            wait_until(lambda: len(one._transport._server.connections) == 2)
            for _ in range(2000):  # 20 MB: more than the system's buffers hold
                one.put(long)
            one.put(fix(1))
            while json.loads(reader.recv(timeout=10))["frame"] != 1:
                pass
            connections = one._transport._server.connections
            waiting = sorted(c.transport.get_write_buffer_size() for c in connections)
            idle.socket.shutdown(socket.SHUT_RDWR)
    assert waiting[0] == 0
    assert 1 << 16 <= waiting[1] < 1 << 17


# --- zenoh and ROS 2 --------------------------------------------------------------------------


class Hub:
    """A listening session of eclipse-zenoh, which records received samples."""

    def __init__(self, *keys: str) -> None:
        self.port = free_port()
        self.received: list[zenoh.Sample] = []
        self.session = open_session("127.0.0.1", self.port, listens=True)
        self.subscribers = [
            self.session.declare_subscriber(key, self.received.append) for key in keys
        ]

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.session.close()

    def last(self, key: str) -> zenoh.Sample | None:
        return next((one for one in reversed(self.received) if str(one.key_expr) == key), None)


def repeated(one: Publisher, what: PublishedFix, arrived) -> None:
    """Publish repeatedly until received: samples sent before a link is up are lost."""

    def put() -> bool:
        one.put(what)
        time.sleep(0.02)
        return arrived()

    wait_until(put)


def test_a_zenoh_subscriber_gets_fixes_as_json():
    with Hub("lab/**") as hub:
        url = f"zenoh://127.0.0.1:{hub.port}/lab/table"
        with open_publisher(url, PLANE, waits=True) as one:
            repeated(one, fix(2), lambda: hub.last("lab/table/fix") is not None)
        sample = hub.last("lab/table/fix")
    assert json.loads(sample.payload.to_bytes())["x"] == 100.0
    assert sample.encoding == zenoh.Encoding.APPLICATION_JSON
    assert sample.congestion_control == zenoh.CongestionControl.DROP


@pytest.mark.parametrize(
    ("url", "key"), [("zenoh://{}/lab", "lab/fix"), ("zenoh+ros2://{}/lab", "lab/ellipse")]
)
def test_recorded_fixes_wait_for_a_busy_connection_and_live_ones_do_not(url, key):
    live = fix(2)
    recorded = msgspec.structs.replace(live, unix_time_s=None)
    expected = {recorded: zenoh.CongestionControl.BLOCK, live: zenoh.CongestionControl.DROP}
    with Hub("lab/*") as hub:
        for what, congestion_control in expected.items():
            hub.received.clear()
            with open_publisher(url.format(f"127.0.0.1:{hub.port}"), PLANE, waits=True) as one:
                repeated(one, what, lambda: hub.last(key) is not None)
            assert hub.last(key).congestion_control == congestion_control


@pytest.mark.skipif(not LINUX, reason="needs /proc")
def test_zenoh_listens_only_at_the_given_address():
    port, before = free_port(), listening()
    with open_publisher(f"zenoh://127.0.0.1:{port}?role=listen", PLANE, waits=True):
        assert listening() - before == {f"0100007F:{port:04X}"}


def test_zenoh_without_a_peer_is_one_line_and_publishes_once_it_connects(caplog):
    with Hub() as hub:
        port = hub.port
    with open_publisher(f"zenoh://127.0.0.1:{port}", PLANE, waits=True) as one:
        for k in range(50):
            one.put(fix(k))
        wait_until(lambda: caplog.records)
        session = open_session("127.0.0.1", port, listens=True)
        received = []
        session.declare_subscriber("fingerpost/fix", received.append)
        repeated(one, fix(99), lambda: bool(received))
        session.close()
    (record,) = caplog.records
    assert f"nobody answers at 127.0.0.1:{port}; fixes go on" in record.getMessage()


ROS = get_typestore(Stores.ROS2_JAZZY)


def decoded(sample: zenoh.Sample, kind: str):
    return ROS.deserialize_cdr(sample.payload.to_bytes(), kind)


def test_ros_gets_points_poses_and_ellipses_that_rosbags_decodes():
    kinds = {
        "point": "geometry_msgs/msg/PointStamped",
        "pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
        "ellipse": "visualization_msgs/msg/MarkerArray",
    }
    assert {topic: entry[1] for topic, entry in _TYPES.items()} == {
        topic: ROS.hash_rihs01(kind) for topic, kind in kinds.items()
    }
    with Hub("7/**", "lab/*") as hub:
        tokens = []
        hub.session.liveliness().declare_subscriber("@ros2_lv/7/**", tokens.append)
        url = f"zenoh+ros2://127.0.0.1:{hub.port}/lab?domain=7&frame_id=table"
        with open_publisher(url, PLANE, waits=True) as one:
            repeated(one, fix(2), lambda: hub.last("lab/ellipse") is not None)
            keys = {str(sample.key_expr) for sample in hub.received}
            messages = {topic: decoded(hub.last(f"lab/{topic}"), kinds[topic]) for topic in kinds}
            attached = hub.last("lab/point").attachment.to_bytes()
            repeated(
                one,
                fix(3, None),
                lambda: decoded(hub.last("lab/ellipse"), kinds["ellipse"]).markers[0].action == 2,
            )
            wait_until(lambda: len(tokens) >= 4)
    names = {topic: kind.replace("/msg/", "::msg::dds_::") + "_" for topic, kind in kinds.items()}
    assert keys == {f"lab/{topic}" for topic in kinds} | {
        f"7/lab/{topic}/{names[topic]}/{ROS.hash_rihs01(kind)}" for topic, kind in kinds.items()
    }
    point, pose, (marker,) = messages["point"], messages["pose"], messages["ellipse"].markers
    assert point.header.frame_id == "table"
    assert point.header.stamp.sec == 1_700_000_000
    assert point.header.stamp.nanosec == 80_000_000
    assert (point.point.x, point.point.y, point.point.z) == (0.1, 0.15, 0.0)
    assert (pose.pose.pose.position.x, pose.pose.pose.orientation.w) == (0.1, 1.0)
    covariance = pose.pose.covariance.reshape(6, 6)
    np.testing.assert_allclose(covariance[:2, :2], COVARIANCE * 1e-6, rtol=1e-12)
    turn = 2.0 * math.atan2(marker.pose.orientation.z, marker.pose.orientation.w)
    direction = np.array([math.cos(turn), math.sin(turn)])
    variances, axes = np.linalg.eigh(COVARIANCE)
    assert abs(direction @ axes[:, 1]) == pytest.approx(1.0)
    assert marker.scale.x == pytest.approx(2e-3 * math.sqrt(variances[1] * chi2.ppf(0.95, 2)))
    assert marker.scale.y == pytest.approx(2e-3 * math.sqrt(variances[0] * chi2.ppf(0.95, 2)))
    assert (marker.type, marker.action, marker.lifetime.sec) == (3, 0, 1)
    sequence, time_ns, length, _ = struct.unpack("<qqB16s", attached)
    assert (time_ns, length) == (1_700_000_000_080_000_000, 16)
    assert sequence >= 1
    words = {str(token.key_expr).split("/")[5] for token in tokens}
    assert words == {"NN", "MP"}
    assert any(f"/%lab%point/{names['point']}/RIHS01_" in str(one.key_expr) for one in tokens)


def test_ros_needs_a_unit_of_known_length():
    with pytest.raises(InvalidInputError, match='unit is "cubit", of no known length'):
        open_publisher("zenoh+ros2://", Extent((0, 0), (1, 1), "cubit"), waits=True)


# --- commands ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def rig_file(tmp_path_factory):
    folder = tmp_path_factory.mktemp("published")
    pose = DevicePose.pointing_at((200.0, 200.0), azimuth_deg=20.0, slant_deg=50.0, hover_mm=120.0)
    motion = Trajectory.hold(pose, 1.0)
    return write_recording(folder, SimulatedRig(), motion, frames=FRAMES, picture_format="jpg")


def test_a_run_publishes_the_values_of_its_table(rig_file, tmp_path):
    points = tmp_path / "p.csv"
    with OscServer() as server, Hub("fingerpost/**") as hub:
        zenoh_url = f"zenoh://127.0.0.1:{hub.port}?pictures"
        urls = ["ndjson:", f"osc://127.0.0.1:{server.port}", zenoh_url]
        asked = [part for url in urls for part in ("--publish", url)]
        done = invoked("run", rig_file, "--points", points, *asked)
        assert done.exit_code == 0, done.output
        wait_until(lambda: hub.last("fingerpost/right/image") is not None)
        wait_until(lambda: sum(p == "/fingerpost/frame" for p, _ in server.received) == FRAMES)
    rows = read_points(points)
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    for row, line in zip(rows, lines, strict=True):
        assert (line["frame"], line["time_s"], line["status"]) == (
            row.frame,
            row.time_s,
            row.status,
        )
        assert (line["x"], line["cov_xy"]) == (row.x, row.cov_xy)
        assert (line["unit"], line["unix_time_s"]) == ("mm", None)
    found = [values for path, values in server.received if path == "/fingerpost/point"]
    expected = [(row.x, row.y) for row in rows if row.status == "ok"]
    assert len(expected) >= 1
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    image = hub.last("fingerpost/right/image")
    files = [file.read_bytes() for file in sorted((rig_file.parent / "right").iterdir())]
    assert image.payload.to_bytes() in files


def test_a_reader_that_disconnects_is_one_line_and_loses_no_row(rig_file, tmp_path):
    command = [sys.executable, "-m", "fingerpost", "run", str(rig_file), "--publish", "ndjson:"]
    points = tmp_path / "p.csv"
    running = subprocess.Popen(
        [*command, "--points", str(points)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONWARNINGS": "ignore"},
    )
    running.stdout.close()
    said = running.stderr.read()
    assert running.wait() == 0
    running.stderr.close()
    (line,) = [line for line in said.splitlines() if "Broken pipe" in line]
    assert line == "WARNING: ndjson: Broken pipe; fixes go on, and it is tried again"
    assert "Traceback" not in said
    assert len(read_points(points)) == FRAMES


@pytest.mark.parametrize(
    ("url", "said"),
    [
        ("mqtt://here", "mqtt://here: cannot be published to; ndjson:, osc:"),
        ("osc://127.0.0.1:99999", "is no URL"),
        ("osc://127.0.0.1:0", "port 0; 1 to 65535 is right"),
        ("osc://a.invalid", "unknown host 'a.invalid'"),
        ("tuio://127.0.0.1/x", "a path means nothing here"),
        ("tuio://127.0.0.1?turn=45", "turn is '45'; one of 0, 90, 180, 270 is right"),
        ("tuio://127.0.0.1?spin=1", "unknown option 'spin'; known are turn, mirror"),
        ("ws://203.0.113.9:0", "cannot listen there"),
        ("zenoh://203.0.113.9?role=listen", "an address of this machine is right"),
        ("zenoh://127.0.0.1/a/**", "'a/**' is no single key"),
        ("zenoh+ros2://127.0.0.1?domain=-1", "domain is '-1'; 0 to 232 is right"),
    ],
)
def test_an_invalid_address_is_refused_in_one_line(rig_file, url, said):
    done = invoked("run", rig_file, "--publish", url)
    assert (done.exit_code, done.stdout) == (2, ""), done.output
    (line,) = done.stderr.splitlines()
    assert said in line


def test_every_scheme_is_documented():
    for scheme in SCHEMES:
        assert f"`{scheme}:" in PAGE
        refuse_unknown(f"{scheme}:")


# --- the page's snippets ----------------------------------------------------------------------


def snippet(word: str, language: str = "python") -> str:
    """The only snippet of the page that contains a word."""
    found = re.findall(rf"^```{language}\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)
    (text,) = [text for text in found if word in text]
    return text


@pytest.mark.parametrize(
    ("word", "url", "port", "said"),
    [
        ("/fingerpost/point", "osc://127.0.0.1:{}", 9000, "100 150"),
        ("/tuio/2Dcur", "tuio://127.0.0.1:{}", 3333, "{1: (0.25, 0.75)}"),
        ("import zenoh", "zenoh://127.0.0.1:{}", 7447, "ok 100.0 150.0"),
    ],
)
def test_the_snippets_of_the_page_receive_fixes(word, url, port, said):
    free = free_port(socket.SOCK_STREAM if "zenoh" in word else socket.SOCK_DGRAM)
    text = snippet(word)
    assert str(port) in text
    program = [sys.executable, "-u", "-c", text.replace(str(port), str(free))]
    running = subprocess.Popen(program, stdout=subprocess.PIPE, text=True)
    with open_publisher(url.format(free), PLANE, waits=True) as one:
        repeated(one, fix(0), lambda: running.poll() is not None)
    lines = running.stdout.read().splitlines()
    running.stdout.close()
    assert running.returncode == 0
    assert lines == [said] * 4


class QuietFiles(SimpleHTTPRequestHandler):
    def log_message(self, *_):
        pass


@pytest.mark.skipif(CHROMIUM is None, reason="needs chromium, Debian's package")
def test_the_page_of_a_browser_shows_fixes(tmp_path):
    sync_api = pytest.importorskip("playwright.sync_api")
    with (
        open_publisher("ws://127.0.0.1:0", PLANE, waits=True) as one,
        ThreadingHTTPServer(
            ("127.0.0.1", 0), partial(QuietFiles, directory=str(tmp_path))
        ) as server,
        sync_api.sync_playwright() as driver,
    ):
        port = str(one._transport.port)
        (tmp_path / "index.html").write_text(snippet("WebSocket", "html").replace("8765", port))
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        try:
            page = browser.new_page()
            page.goto(f"http://127.0.0.1:{server.server_address[1]}/")
            one.put(fix(0))
            page.wait_for_function("document.body.textContent.includes('100, 150 mm')")
            one.put(fix(1, None))
            page.wait_for_function("document.body.textContent.includes('lost')")
        finally:
            browser.close()
            server.shutdown()
            thread.join()


# --- no blocking ------------------------------------------------------------------------------


class Stuck:
    """A receiver that blocks until it is released."""

    wants_pictures = False

    def __init__(self) -> None:
        self.going_on = threading.Event()
        self.frames: list[int] = []

    def send(self, fix, _pictures) -> None:
        self.going_on.wait()
        self.frames.append(fix.frame)

    def close(self) -> None:
        pass


def test_live_fixes_never_block_and_the_newest_are_kept():
    stuck = Stuck()
    with Publisher("stuck:", stuck, waits=False) as one:
        for k in range(1000):
            one.put(fix(k))
        stuck.going_on.set()
    assert stuck.frames[-64:] == list(range(936, 1000))
    dropped = 1000 - len(stuck.frames)
    assert one.notes() == [f"stuck:: {dropped} of 1000 fixes were dropped: it was too slow"]


def test_a_blocked_receiver_is_abandoned_on_closing(caplog, monkeypatch):
    monkeypatch.setattr("fingerpost.publishing.publisher._CLOSING_S", 0.01)
    left = []
    monkeypatch.setattr("fingerpost.publishing.publisher.leave_behind", left.append)
    stuck = Stuck()
    with caplog.at_level(logging.WARNING), Publisher("stuck:", stuck, waits=False) as one:
        one.put(fix(0))
    assert "takes nothing" in caplog.text
    (thread,) = left
    stuck.going_on.set()
    thread.join()
    assert stuck.frames == [0]


# --- the pace of recordings -------------------------------------------------------------------


def test_recordings_play_at_the_given_speed():
    slept: list[float] = []
    now_s = [50.0]

    def sleep(duration_s: float) -> None:
        slept.append(duration_s)
        now_s[0] += duration_s

    times_s = (0.0, 0.1, 0.2, 0.3)
    film = [(Loss(k, time_s, ""), None) for k, time_s in enumerate(times_s)]
    seen = []
    for together in at_speed(iter(film), 2.0, clock=lambda: now_s[0], sleep=sleep):
        seen.append(together)
        now_s[0] += 0.2 if len(seen) == 2 else 0.01  # once the caller is slow
    assert seen == film
    # 0.05 s apart, less the caller's work; a slow frame delays those after it.
    assert slept == pytest.approx([0.04, 0.04])
    with pytest.raises(InvalidInputError, match="speed"):
        next(at_speed(iter(film), 0.0))


def test_the_page_publishes_as_well():
    with OscServer() as server:
        address = f"osc://127.0.0.1:{server.port}"
        with served(RIG, "--publish", address) as page:
            wait_until(lambda: ("/fingerpost/status", ("acquiring",)) in server.received)
            page.process.send_signal(signal.SIGINT)
            code, said = page.end()
    assert (code, "Traceback" in said) == (130, False)
