"""`fingerpost robot ...` in a subprocess, with an emulated Scorbot and a recorded hand."""

from __future__ import annotations

import contextlib
import csv
import http.server
import os
import pty
import signal
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import cv2
import msgspec
import numpy as np
from robot_rig import pose_of

from fingerpost.config import Plane, Rig, RobotTable
from fingerpost.robot.emulator.acl import AclController, AclStyle
from fingerpost.robot.emulator.ports import ArmTime, Emulator, PtyPort
from fingerpost.simulate import DevicePose, SimulatedRig, Trajectory, write_recording

TIME_SCALE = 3.0
"""Seconds of the emulated arm per second of the process that drives it."""

FPS = 30
EMPTY_FRAMES = 30
"""Frames before the hand enters, enough to learn the background."""

FIRST_MM, SECOND_MM = (130.0, 90.0), (130.0, 320.0)
HOLD_FRAMES = 90
"""Duration of the pointing at the first place; the arm enters the region meanwhile."""
HEIGHT_M = 0.02

SPEED = ("--speed", "0.1")
"""At this speed the arm enters the region soon and takes more than a second to reach the hand."""

STOPPED_S = 0.3
"""Limit from the cause of a stop to the standstill; the stop command itself takes 20 ms."""

PATIENT = ("--max-age", "3", "--operator-timeout", "5")
"""Generous limits: on a loaded machine delayed frames would themselves stop the arm."""

BY_HAND = ("--attendance", "hand")
"""Without a terminal, the recorded hand proves the operator's presence."""

PATIENCE_S = 120.0
"""Time-out of what a loaded machine may delay: a process start or a whole recording."""

ORIGIN_M = np.array([0.28, -0.2])
"""Origin of the recording's plane (in millimetres) in the robot's frame."""


def robot_xy(point_mm) -> np.ndarray:
    """Transform a point of the recording's plane to the robot's frame [m]."""
    return ORIGIN_M + np.asarray(point_mm) / 1000.0


@dataclass(frozen=True)
class Coming:
    """A hand that enters after `away_s`."""

    motion: Trajectory
    away_s: float

    def pose_at(self, time_s: float) -> DevicePose | None:
        """Return the pose, or None while the hand is away."""
        return None if time_s < self.away_s else self.motion.pose_at(time_s - self.away_s)


def write_hand(
    folder: Path,
    seconds: float,
    targets=(FIRST_MM, SECOND_MM),
    *,
    hover_mm=120,
    azimuth_deg=255.0,
    slant_deg=50.0,
) -> None:
    """Record a hand that enters and points at two places in turn, never occluded by the arm."""
    first, second = (
        DevicePose.pointing_at(
            target, azimuth_deg=azimuth_deg, slant_deg=slant_deg, hover_mm=hover_mm
        )
        for target in targets
    )
    motion = Trajectory.hold(first, HOLD_FRAMES / FPS).then(
        Trajectory.through([first, second], 0.4)
    )
    write_recording(
        folder,
        SimulatedRig(),
        Coming(motion, EMPTY_FRAMES / FPS),
        frames=EMPTY_FRAMES + round(seconds * FPS),
        fps=FPS,
        picture_format="jpg",
        start_time_s=EMPTY_FRAMES / FPS,
    )


def cut_film(folder: Path, film: Path, frames) -> list[str]:
    """Write a recording of selected frames after the hand's entry; return the views' sources."""
    frames = [*range(EMPTY_FRAMES), *(EMPTY_FRAMES + frame for frame in frames)]
    sources = []
    for view in ("left", "right"):
        (folder / view).mkdir(parents=True)
        for place, frame in enumerate(frames):
            path = folder / view / f"{place:05d}.jpg"
            path.hardlink_to(film / view / f"{frame:05d}.jpg")
        sources.append(str(folder / view / "*.jpg"))
    return sources


def still_film(folder: Path, film: Path) -> list[str]:
    """Write a recording of a hand that points at one place for six seconds."""
    return cut_film(folder, film, [*range(HOLD_FRAMES), *([HOLD_FRAMES - 1] * 90)])


def show_instead(folder: Path, image) -> None:
    """Replace every frame of a recording that is still to be read with one image."""
    shown = jpeg(image)
    for path in folder.glob("*/*.jpg"):
        new = path.with_suffix(".new")
        new.write_bytes(shown)
        new.replace(path)


def write_rig(folder: Path, recording: Path, sources=None, **changes) -> Path:
    """Write the rig file of a recording in the robot's own coordinates."""
    rig = Rig.load(recording / "rig.toml")
    points = tuple(tuple(map(float, robot_xy(point))) for point in rig.plane.points)
    table = RobotTable(
        url="acl://nowhere",
        height_m=HEIGHT_M,
        region_m=((0.37, -0.18), (0.45, -0.18), (0.45, 0.18), (0.37, 0.18)),
        z_m=(0.03, 0.25),
        pitch_deg=-90.0,
        roll_deg=0.0,
    )
    rig = msgspec.structs.replace(
        rig, plane=Plane(unit="m", points=points), robot=msgspec.structs.replace(table, **changes)
    )
    if sources is not None:
        views = zip(rig.views, sources, strict=True)
        rig = msgspec.structs.replace(
            rig, views=tuple(msgspec.structs.replace(v, source=str(s)) for v, s in views)
        )
    path = folder / "rig.toml"
    rig.save(path)
    return path


class EmulatedArm:
    """A Scorbot's controller on a pseudo-terminal, with access to its true state."""

    def __init__(self, time_scale=TIME_SCALE, *, homing_s=0.5) -> None:
        self.clock = ArmTime(time_scale)
        self.controller = AclController(AclStyle(homing_s=homing_s))
        self.emulator = Emulator(self.controller, PtyPort(), clock=self.clock)

    def __enter__(self):
        self.emulator.__enter__()
        return self

    def __exit__(self, *error):
        self.emulator.__exit__(*error)

    @property
    def url(self) -> str:
        """The URL that the driver opens."""
        return f"acl://{self.emulator.address}?poll_s=0.01&max_speed_m_s=1.0"

    def is_moving(self) -> bool:
        """Return whether the arm moves now."""
        return self.controller.is_moving(self.clock())

    def pose(self):
        """Return the arm's true pose."""
        return pose_of(self.controller.units(self.clock()))

    def travels(self) -> bool:
        """Return whether the arm executes a command above the table, in the safe region."""
        return self.is_moving() and self.pose().z_m < 0.255 and len(self.controller.moves) > 1

    def assert_stopped(self, aborts: int, within_s: float) -> None:
        """Assert that the arm stops within a time and stays stopped."""
        end_s = time.monotonic() + within_s
        while self.controller.aborts == aborts or self.is_moving():
            assert time.monotonic() < end_s, "the arm was not stopped"
            time.sleep(0.002)
        moves, aborts = len(self.controller.moves), self.controller.aborts
        time.sleep(0.4)
        assert not self.is_moving()
        # A command that was already being sent when the stop came is followed by another stop.
        assert len(self.controller.moves) == moves or self.controller.aborts > aborts


class Guided:
    """A running `fingerpost robot` command."""

    def __init__(self, *arguments, terminal=False, cwd=None) -> None:
        self.errors: list[str] = []
        self.terminal, stdin = pty.openpty() if terminal else (None, subprocess.DEVNULL)
        self.process = subprocess.Popen(
            [sys.executable, "-m", "fingerpost", "robot", *map(str, arguments)],
            stdin=stdin,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            cwd=cwd,
        )
        if terminal:
            os.close(stdin)
        self._out: list[str] = []
        self._readers = [
            threading.Thread(target=self._read, args=ends, daemon=True)
            for ends in (
                (self.process.stdout, self._out),
                (self.process.stderr, self.errors),
            )
        ]
        for reader in self._readers:
            reader.start()

    def _read(self, stream, lines) -> None:
        with contextlib.suppress(ValueError):
            lines.extend(iter(lambda: stream.read(1), ""))

    def __enter__(self):
        return self

    def __exit__(self, *error):
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        for reader in self._readers:
            reader.join()
        self.process.stdout.close()
        self.process.stderr.close()
        if self.terminal is not None:
            os.close(self.terminal)

    def press(self, keys: str) -> None:
        """Type keys on the command's terminal."""
        os.write(self.terminal, keys.encode())

    def hang_up(self) -> None:
        """Close the command's terminal."""
        os.close(self.terminal)
        self.terminal = None

    def until(self, true, what="") -> None:
        """Wait for a condition while the command runs."""
        end_s = time.monotonic() + PATIENCE_S
        while not true():
            assert self.process.poll() is None, f"ended early: {self.said()}"
            assert time.monotonic() < end_s, f"not {what or 'yet'}: {self.said()}"
            time.sleep(0.002)

    def until_said(self, words: str) -> None:
        """Wait for a text on stderr."""
        self.until(lambda: words in self.said(), words)

    def said(self) -> str:
        """Return the text on stderr up to now."""
        return "".join(self.errors)

    def end(self, within_s=PATIENCE_S) -> int:
        """Wait for the end of the command; return its exit code."""
        try:
            code = self.process.wait(within_s)
        except subprocess.TimeoutExpired:
            raise AssertionError(f"still running: {self.said()}") from None
        for reader in self._readers:
            reader.join()
        return code

    @property
    def out(self) -> str:
        """The standard output, complete after the end."""
        return "".join(self._out)

    def signal(self, number: signal.Signals) -> None:
        """Send a signal to the command."""
        self.process.send_signal(number)


def commands(path: Path) -> list[dict[str, str]]:
    """Read the rows of a command log."""
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


class Travelling:
    """A running command with a moving arm; given options override the defaults."""

    def __init__(self, rig, folder, *options, command="follow", terminal=False):
        self.log = folder / "commands.csv"
        self.arm = EmulatedArm()
        self._arguments = (rig, *options)
        self._command, self._terminal = command, terminal

    def __enter__(self):
        self.arm.__enter__()
        self.guided = Guided(
            self._command,
            *("--url", self.arm.url + "&reply_s=0.3&resync_s=0.5", "--arm", "--log", self.log),
            *SPEED,
            *PATIENT,
            *BY_HAND,
            *self._arguments,
            terminal=self._terminal,
        )
        return self

    def __exit__(self, *error):
        self.guided.__exit__(*error)
        self.arm.__exit__(*error)

    def travel(self):
        """Wait until the arm follows; return the number of stops received by the controller."""
        self.guided.until(lambda: self.log.exists() and self._moves(), "following")
        self.guided.until(self.arm.travels, "moving")
        return self.arm.controller.aborts

    def _moves(self):
        return [row for row in commands(self.log) if row["command"] == "move"]

    def reasons(self):
        """Return the reasons of all stops."""
        return [row["detail"] for row in commands(self.log) if row["command"] in ("hold", "halt")]


class JpegStreams(http.server.ThreadingHTTPServer):
    """Recordings as motion JPEG on a loopback port, in real time, until `stalled` is set.

    Parameters
    ----------
    films
        For every view, its pictures as JPEG bytes, or a callable that returns the next one.
    fps
        Pictures per second.
    """

    daemon_threads = True

    def __init__(self, films, fps=FPS) -> None:
        super().__init__(("127.0.0.1", 0), _JpegHandler)
        self.films = films
        self.fps = fps
        self.stalled = False
        self.closing = False

    def __enter__(self):
        self._thread = threading.Thread(target=self.serve_forever, args=[0.02])
        self._thread.start()
        return self

    def __exit__(self, *error):
        self.closing = True
        self.shutdown()
        self._thread.join()
        self.server_close()

    @property
    def urls(self) -> list[str]:
        """The URL of every view."""
        return [
            f"http://127.0.0.1:{self.server_port}/{k}/stream.mjpg" for k in range(len(self.films))
        ]


class _JpegHandler(http.server.BaseHTTPRequestHandler):
    server: JpegStreams

    def do_GET(self) -> None:
        film = self.server.films[int(self.path.split("/")[1])]
        self.send_response(200)
        self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
        self.end_headers()
        begin_s, number = time.monotonic(), 0
        with contextlib.suppress(OSError):
            while not self.server.closing:
                due_s = begin_s + number / self.server.fps
                if self.server.stalled or (early_s := due_s - time.monotonic()) > 0:
                    time.sleep(0.005 if self.server.stalled else early_s)
                    continue
                jpeg = film() if callable(film) else film[number % len(film)]
                head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
                self.wfile.write(head.encode() + jpeg + b"\r\n")
                number += 1

    def log_message(self, *args: object) -> None:
        pass


def jpeg(image) -> bytes:
    """Encode an image as JPEG."""
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()
