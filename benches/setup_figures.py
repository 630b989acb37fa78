"""Figures for the set-up of cameras, each measured in simulation or on loopback.

    python benches/setup_figures.py skew [--speed 0.5] [--passes 4]
    python benches/setup_figures.py views [--targets 60] [--counts 2 3 4 5 6]
    python benches/setup_figures.py unplug [--view 0]
    python benches/setup_figures.py age [--work-ms 0 50]

`skew`: two webcams take their pictures up to one frame apart while a rod moves at constant speed.
The indicated points are compared with those of the same tracker for simultaneous pictures; the
difference is the error due to the skew. Pictures have no noise, so noise does not contribute to it.
*Ignored* treats both pictures as simultaneous. *Synchronised* is not given the offset and estimates
it from the motion of the tip, as `fingerpost sync` does.

`views`: the experiment of `fingerpost experiment` with 2 to 6 cameras; each set of cameras includes
the smaller ones. *Stated* is the root of the mean trace of the fixes' covariances, *bound* the
Cramér–Rao bound of the same poses.

`unplug`: three motion JPEG servers on loopback, each a process, send pictures of a moving rod from
three webcams; one is killed and restarted. A point is *wrong* if its error exceeds 5 % of the
plane's side. A pause is the time between the arrivals of two points.

`age`: the latency from sending a picture to fetching it, for a consumer with a constant processing
time; and the mean over time of the age of the picture behind its newest result.
"""

from __future__ import annotations

import argparse
import http.server
import math
import socket
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from fingerpost.capture import Frame, Loss, open_source, read_views
from fingerpost.config import Rig
from fingerpost.experiment import ExperimentOptions, run_experiment
from fingerpost.experiment.summary import summarise
from fingerpost.pipeline import Pointer, steps, track
from fingerpost.pointing import PointingOptions
from fingerpost.simulate import (
    Placement,
    PoseLimits,
    Sensor,
    SimulatedRig,
    StartError,
    Trajectory,
    figure_eight,
)
from fingerpost.simulated_rig_file import rig_from_simulation
from fingerpost.sync import synchronise

Array = NDArray[np.float64]

FPS = 30.0
SKEWS_MS = (0.0, 4.0, 8.0, 16.0, 24.0, 33.0)
SETTLE_S = 0.5
"""Time that the device is at rest before it moves, for the trackers to settle."""

AZIMUTHS_DEG = (-15.0, 15.0, -45.0, 45.0, -75.0, 75.0)
"""Cameras, in the order in which they are added."""


# --- skew -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Film:
    """A motion filmed by two cameras, the second one later by its skews.

    Attributes
    ----------
    rig
        The set-up, with the start poses of the first pictures.
    frames
        Pictures of both views with their true times, for every frame.
    truth_mm : (frames, 2)
        Indicated point at the first view's times.
    """

    rig: Rig
    frames: list[tuple[Frame, Frame]]
    truth_mm: Array

    def taken_at_once(self) -> list[tuple[Frame, Frame]]:
        """Return the pictures as if both views had been taken at the first one's times."""
        return [
            (first, Frame(second.index, first.time_s, second.image))
            for first, second in self.frames
        ]


def filmed(speed_m_s: float, passes: int, skews_s: Array | float) -> Film:
    """Render a rod that points along a figure eight."""
    rig = SimulatedRig(Placement.webcams(), sensor=Sensor(noise=0.0))
    path = figure_eight(rig.workspace) * passes
    still = Trajectory.hold(path[0], SETTLE_S)
    motion = still.then(Trajectory.through(path, speed_m_s))
    left, right = (rig.seen_by([camera]) for camera in rig.cameras)
    count = int(motion.duration_s * FPS)
    late_s = np.broadcast_to(skews_s, (count,))
    frames, truth_mm = [], []
    for k in range(count):
        time_s = k / FPS
        pictures = [
            Frame(k, moment_s, one.render(motion, time_s=moment_s).images[0])
            for one, moment_s in ((left, time_s), (right, time_s + float(late_s[k])))
        ]
        frames.append((pictures[0], pictures[1]))
        truth_mm.append(motion.pose_at(time_s).indicated_mm)
    begin = rig.truth(motion, time_s=0.0)
    fingers = [view.finger for view in begin.views if view.finger is not None]
    starts = [finger.start(StartError(), np.random.default_rng(0)) for finger in fingers]
    return Film(rig_from_simulation(rig, starts=starts), frames, np.array(truth_mm))


def points_mm(rig: Rig, frames: Sequence[tuple[Frame, Frame]]) -> Array:
    """Return the indicated point of every frame of the first view; NaN without one."""
    pointer = Pointer(rig, pointing_options=PointingOptions())
    found = np.full((len(frames), 2), np.nan)
    for step in steps(pointer, frames):
        if step.fix.point is not None:
            found[step.index] = step.fix.point
    return found


def shifted(frames: Sequence[tuple[Frame, Frame]], rig: Rig) -> Iterator[tuple[Frame, Frame]]:
    """Yield pictures with the offsets of a rig added to their times."""
    for pair in frames:
        first, second = (
            Frame(frame.index, frame.time_s + view.offset_s, frame.image)
            for frame, view in zip(pair, rig.views, strict=True)
        )
        yield first, second


def measure_skew(speed_m_s: float, passes: int) -> None:
    """Print a row for every skew."""
    still = int(SETTLE_S * FPS)
    at_once = filmed(speed_m_s, passes, 0.0)
    expected = points_mm(at_once.rig, at_once.frames)
    print("skew [ms]  by stamps: median, 95 % [mm]  ignored [mm]  synchronised [mm], offset [ms]")
    rng = np.random.default_rng(0)
    varying = rng.uniform(0.0, SKEWS_MS[-1] / 1e3, len(at_once.frames))
    for skew in (*SKEWS_MS[1:], varying):
        is_constant = isinstance(skew, float)
        film = filmed(speed_m_s, passes, skew / 1e3 if is_constant else skew)

        def caused(rig: Rig, frames: Sequence[tuple[Frame, Frame]]) -> str:
            off = np.linalg.norm(points_mm(rig, frames) - expected, axis=1)[still:]
            off = off[np.isfinite(off)]
            if not len(off):
                return "no point         "
            return f"{np.median(off):6.2f} {np.percentile(off, 95):6.2f} ({len(off)})"

        name = f"{skew:9.0f}" if is_constant else " 0 to 33 "
        row = [caused(film.rig, film.frames), caused(film.rig, film.taken_at_once())]
        if is_constant:
            at_once_frames = film.taken_at_once()
            synced = synchronise(film.rig, partial(shifted, at_once_frames)).rig
            row.append(caused(synced, list(shifted(at_once_frames, synced))))
            row.append(f"{1e3 * synced.views[1].offset_s:6.2f}")
        print(name, "  ", "   ".join(row), flush=True)
    off = np.linalg.norm(expected - at_once.truth_mm, axis=1)[still:]
    print(f"taken at once, median error against the truth: {np.nanmedian(off):.2f} mm")


# --- views ----------------------------------------------------------------------------------------


def measure_views(counts: Sequence[int], targets: int, seed: int) -> None:
    """Print a row for every number of cameras."""
    print("views  points  RMS [mm]  stated [mm]  bound [mm]  efficiency  NEES  held by 95 %")
    for count in counts:
        options = ExperimentOptions(
            targets=targets,
            seed=seed,
            cameras=Placement(azimuths_deg=AZIMUTHS_DEG[:count]),
            limits=PoseLimits(azimuth_deg=(-60.0, 60.0)),
        )
        result = run_experiment(options, workers=1)
        summary = summarise(result.trials, result.plane_size)
        points, bound = summary.points, summary.bound
        assert points is not None
        assert points.nees is not None
        assert bound is not None
        traces = [np.trace(t.covariance) for t in result.trials if t.covariance is not None]
        stated = math.sqrt(np.mean(traces))
        held = next(one.held for one in points.coverages if one.nominal == 0.95)
        print(
            f"{count:5}  {summary.available:6}  {points.rms:8.3f}  {stated:11.3f}"
            f"  {bound.rms:10.3f}  {bound.efficiency:10.2f}  {points.nees.mean:4.2f}  {held:.2f}",
            flush=True,
        )


# --- cameras on loopback --------------------------------------------------------------------------

START_WITHIN_S = 30.0
LOOP_SPEED_M_S = 0.2
GROSS_SHARE = 0.05
SETTLED_S, KILLED_S, RESTARTED_S, ENDED_S = 1.0, 5.0, 11.0, 20.0
ABOUT_S = 0.7
"""Time before and after the loss or return of a camera that counts as the transition."""
_STAMP = struct.Struct(">QI")
"""Time of sending a picture [ns] and its number, in a comment of its JPEG."""


class CameraServer(http.server.ThreadingHTTPServer):
    """A camera that sends the pictures of a folder at a constant rate."""

    daemon_threads = True

    def __init__(self, port: int, folder: Path) -> None:
        self.pictures = [path.read_bytes() for path in sorted(folder.glob("*.jpg"))]
        super().__init__(("127.0.0.1", port), _CameraHandler)


class _CameraHandler(http.server.BaseHTTPRequestHandler):
    server: CameraServer

    def log_message(self, *args: object) -> None:
        pass

    def do_GET(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
        self.end_headers()
        tick = int(time.monotonic() * FPS)
        try:
            while True:
                tick += 1
                time.sleep(max(0.0, tick / FPS - time.monotonic()))
                number = tick % len(self.server.pictures)
                self.wfile.write(_part(self.server.pictures[number], number))
        except OSError:
            return


def _part(jpeg: bytes, number: int) -> bytes:
    """Return a picture as a part of the stream, stamped now."""
    comment = b"\xff\xfe" + struct.pack(">H", _STAMP.size + 2)
    data = jpeg[:2] + comment + _STAMP.pack(time.monotonic_ns(), number) + jpeg[2:]
    head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n\r\n"
    return head.encode() + data + b"\r\n"


def stamp_of(frame: Frame) -> tuple[float, int]:
    """Return the time of sending [s] and the number of a picture, from the stamp in its JPEG."""
    time_ns, number = _STAMP.unpack_from(frame.encoded, 6)
    return time_ns / 1e9, number


def free_port() -> int:
    """Return a free port."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return int(listener.getsockname()[1])


def started(port: int, folder: Path) -> subprocess.Popen[bytes]:
    """Start a camera in a process of its own, and wait until it answers."""
    camera = subprocess.Popen([sys.executable, __file__, "serve", str(port), str(folder)])
    end_s = time.monotonic() + START_WITHIN_S
    while time.monotonic() < end_s:
        try:
            socket.create_connection(("127.0.0.1", port), 1.0).close()
        except OSError:
            time.sleep(0.05)
        else:
            return camera
    raise TimeoutError(f"no camera at port {port} within {START_WITHIN_S:g} s")


@contextmanager
def running(port: int, folder: Path) -> Iterator[list[subprocess.Popen[bytes]]]:
    """Run a camera; a caller that starts another in its place appends it to the list."""
    cameras = [started(port, folder)]
    try:
        yield cameras
    finally:
        for camera in cameras:
            camera.kill()
            camera.wait()


def looped() -> tuple[SimulatedRig, Trajectory]:
    """Return a rig of three webcams, and the endless motion of a rod round a figure."""
    placement = replace(Placement.webcams(), azimuths_deg=(-25.0, 0.0, 25.0))
    rig = SimulatedRig(placement)
    path = figure_eight(rig.workspace)
    return rig, Trajectory.through([*path, path[0]], LOOP_SPEED_M_S, ease_s=0.0)


def write_pictures(rig: SimulatedRig, motion: Trajectory, folder: Path) -> int:
    """Write the pictures of each camera for one round; return their number per camera."""
    count = int(motion.duration_s * FPS)
    rng = np.random.default_rng(0)
    for k in range(count):
        pictures = rig.render(motion, time_s=k / FPS, rng=rng).images
        for camera, picture in zip(rig.cameras, pictures, strict=True):
            (folder / camera.name).mkdir(exist_ok=True)
            cv2.imwrite(str(folder / camera.name / f"{k:05}.jpg"), picture)
    return count


@dataclass(frozen=True)
class Estimate:
    """A point: time of arrival [s since the beginning], error [mm], and number of views."""

    came_s: float
    error_mm: float
    views: int


def estimates(
    rig: Rig,
    motion: Trajectory,
    count: int,
    cameras: list[list[subprocess.Popen[bytes]]],
    view: int,
    restart: Sequence[object],
) -> Iterator[Estimate]:
    """Track from the cameras, kill one and restart it; yield the points as they arrive."""
    begin_s, todo = math.inf, [(KILLED_S, "kill"), (RESTARTED_S, "restart")]
    for fix, frames in track(rig, frames=True):
        now_s = time.monotonic()
        if fix.point is None:
            continue
        begin_s = min(begin_s, now_s)
        while todo and now_s - begin_s > todo[0][0]:
            if todo.pop(0)[1] == "kill":
                cameras[view][-1].kill()
            else:
                command = [sys.executable, __file__, "serve", *map(str, restart)]
                cameras[view].append(subprocess.Popen(command))
        # A fix refers to the first view's picture, or to its expected time if it is missing.
        first = frames[0]
        place = stamp_of(first)[1] if isinstance(first, Frame) else (fix.time_s * FPS) % count
        true_mm = motion.pose_at(place / FPS).indicated_mm
        assert true_mm is not None
        error_mm = float(np.linalg.norm(fix.point - true_mm))
        used = sum(line is not None for line in fix.constraint_lines)
        yield Estimate(now_s - begin_s, error_mm, used)
        if now_s - begin_s > ENDED_S:
            return


def measure_unplugged(view: int) -> None:
    """Print pauses and errors before, during and after the absence of a camera."""
    simulated, motion = looped()
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder = Path(name)
        count = write_pictures(simulated, motion, folder)
        places = [(free_port(), folder / camera.name) for camera in simulated.cameras]
        cameras = [stack.enter_context(running(*place)) for place in places]
        sources = [f"http://127.0.0.1:{port}/stream.mjpg" for port, _ in places]
        rig = rig_from_simulation(simulated, sources=sources)
        points = list(estimates(rig, motion, count, cameras, view, places[view]))
    came_s = np.array([one.came_s for one in points])
    used = np.array([one.views for one in points])
    (back,) = np.nonzero((came_s > RESTARTED_S) & (used == len(cameras)))
    back_s = float(came_s[back[0]]) if len(back) else math.nan
    print(f"view {view}: used again {back_s - RESTARTED_S:.1f} s after its start")
    print("                 points  wrong  median error [mm]  longest pause [s]")
    parts = {
        "all plugged in": (SETTLED_S, KILLED_S),
        "as it goes": (KILLED_S - ABOUT_S, KILLED_S + ABOUT_S),
        "without it": (KILLED_S + ABOUT_S, RESTARTED_S),
        "as it returns": (back_s - ABOUT_S, back_s + ABOUT_S),
        "all again": (back_s + ABOUT_S, ENDED_S),
    }
    for part, (from_s, to_s) in parts.items():
        there = (from_s <= came_s) & (came_s < to_s)
        errors_mm = np.array([one.error_mm for one in points])[there]
        gross_mm = GROSS_SHARE * simulated.workspace.side_mm
        print(
            f"{part:15}  {there.sum():6}  {(errors_mm > gross_mm).sum():5}"
            f"  {np.median(errors_mm):17.2f}  {max(np.diff(came_s[there])):17.3f}"
        )


def measure_age(works_ms: Sequence[float], span_s: float = 6.0) -> None:
    """Print the age of a camera's pictures when they are fetched."""
    simulated, motion = looped()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_pictures(simulated, motion, folder)
        port, place = free_port(), folder / simulated.cameras[0].name
        print("work [ms]  a second  age [ms]: p50, p95  of the newest result: mean")
        with running(port, place):
            for work_ms in works_ms:
                fetched = np.array([*fetched_s(port, work_ms / 1e3, span_s)][10:])
                sent_s, ages_ms = fetched[:, 0], 1e3 * (fetched[:, 1] - fetched[:, 0])
                print(
                    f"{work_ms:9.0f}  {len(ages_ms) / span_s:8.1f}"
                    f"  {np.median(ages_ms):13.1f} {np.percentile(ages_ms, 95):5.1f}"
                    f"  {1e3 * mean_age_s(sent_s, fetched[:, 1] + work_ms / 1e3):24.1f}"
                )


def fetched_s(port: int, work_s: float, span_s: float) -> Iterator[tuple[float, float]]:
    """Fetch pictures; yield the times of sending and of fetching each [s]."""
    with open_source(f"http://127.0.0.1:{port}/stream.mjpg") as source:
        end_s = time.monotonic() + span_s
        for (frame,) in read_views([source]):
            now_s = time.monotonic()
            if isinstance(frame, Loss) or frame is None:
                continue
            yield stamp_of(frame)[0], now_s
            time.sleep(work_s)
            if time.monotonic() > end_s:
                return


def mean_age_s(sent_s: Array, done_s: Array) -> float:
    """Return the mean over time of the age of the newest result, from sending to done."""
    from_s, to_s = done_s[:-1] - sent_s[:-1], done_s[1:] - sent_s[:-1]
    return float(np.sum(to_s**2 - from_s**2) / 2.0 / np.sum(to_s - from_s))


def main() -> None:
    """Run the measurement that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    figures = parser.add_subparsers(dest="figure", required=True)
    skew = figures.add_parser("skew")
    skew.add_argument("--speed", type=float, default=0.5, help="of the tip [m/s]")
    skew.add_argument("--passes", type=int, default=2, help="times that the figure is drawn")
    views = figures.add_parser("views")
    views.add_argument("--targets", type=int, default=60)
    views.add_argument("--seed", type=int, default=0)
    most = len(AZIMUTHS_DEG)
    views.add_argument("--counts", type=int, nargs="+", default=[*range(2, most + 1)])
    unplug = figures.add_parser("unplug")
    unplug.add_argument("--view", type=int, default=0, choices=range(3), help="that is killed")
    age = figures.add_parser("age")
    age.add_argument("--work-ms", type=float, nargs="+", default=[0.0, 50.0])
    serve = figures.add_parser("serve", help="be a camera, as the others start it")
    serve.add_argument("port", type=int)
    serve.add_argument("folder", type=Path)
    asked = parser.parse_args()
    if asked.figure == "skew":
        measure_skew(asked.speed, asked.passes)
    elif asked.figure == "views":
        measure_views(asked.counts, asked.targets, asked.seed)
    elif asked.figure == "unplug":
        measure_unplugged(asked.view)
    elif asked.figure == "age":
        measure_age(asked.work_ms)
    else:
        CameraServer(asked.port, asked.folder).serve_forever()


if __name__ == "__main__":
    main()
