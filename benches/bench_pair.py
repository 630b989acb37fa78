"""Time of a frame of a stereo pair from end to end, and of several views in one call.

    python benches/bench_pair.py

A simulated hand over a wooden table is written as two MJPEG files, the format of webcams, then
decoded, tracked and drawn, on one core. The figures are medians over the frames in which both views
track the hand, for both views together. "Loop" is the work of `fingerpost.Pointer` for a pair of
frames; its stages are timed where it calls them. The time of refinement is the difference from a
loop without it. The live view is a JPEG of each view. The last table is of several views in one
call, on all cores.
"""

import os

# Decoding on one thread, like everything else: OpenCV reads this variable when it is imported.
os.environ["OPENCV_FFMPEG_CAPTURE_OPTIONS"] = "threads;1"

import statistics
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import ParamSpec, TypeVar

import cv2
import numpy as np

from fingerpost import pipeline
from fingerpost._core import ContourTracker, StartPose, Template, update_views
from fingerpost.capture import Frame, open_source, read_views
from fingerpost.config import Rig
from fingerpost.finding import HandSearch, PairTests
from fingerpost.pipeline import Observation, Pointer, Step
from fingerpost.pointing import FingerLine
from fingerpost.recording.picture import draw_view
from fingerpost.simulate import (
    Background,
    Hand,
    Lighting,
    Placement,
    Sensor,
    SimulatedRig,
    Trajectory,
    figure_eight,
)
from fingerpost.simulated_rig_file import rig_from_simulation

FRAMES = 180
FPS = 30.0
# The table is seen without a hand first; then the hand comes, waits to be acquired, and moves.
EMPTY_S, WAIT_S, SPEED_M_S, ENTRY_M_S, ENTRY_MM = 0.7, 0.8, 0.35, 0.9, 900.0
ARRIVES_S = EMPTY_S + ENTRY_MM / 1000 / ENTRY_M_S
VIEWS = (1, 2, 4, 8)
SCHEDULES = ("in-turn", "side-by-side")
CORE = 1
TARGET = 0.03
"""Tracking, refinement and geometry, as a share of decoding the pair and encoding its live view."""


P, R = ParamSpec("P"), TypeVar("R")


class Stopwatch:
    """Times of named pieces of work, frame by frame; pieces of one name add up."""

    def __init__(self) -> None:
        self.scope = ""
        """Prefix of the names of all pieces."""
        self._times_us: dict[str, list[float]] = {}
        self._frame_us: dict[str, float] = {}

    @contextmanager
    def time(self, name: str) -> Iterator[None]:
        """Time the body of a `with` statement."""
        began = time.perf_counter()
        yield
        name = self.scope + name
        taken_us = 1e6 * (time.perf_counter() - began)
        self._frame_us[name] = self._frame_us.get(name, 0.0) + taken_us

    def timed(self, name: str, function: Callable[P, R]) -> Callable[P, R]:
        """Return a function that is timed whenever it is called."""

        def call(*args: P.args, **more: P.kwargs) -> R:
            with self.time(name):
                return function(*args, **more)

        return call

    def end_frame(self, *, counts: bool) -> None:
        """Keep the times of a frame if it counts, else discard them."""
        for name, time_us in self._frame_us.items():
            if counts:
                self._times_us.setdefault(name, []).append(time_us)
        self._frame_us.clear()

    def median_us(self, *names: str) -> float:
        """Return the sum of the median times of pieces of work."""
        return sum(statistics.median(self._times_us[name]) for name in names)


def time_stages(clock: Stopwatch) -> None:
    """Replace the stages of the main loop by timed ones, where it calls them."""
    pipeline.update_views = clock.timed("track", pipeline.update_views)
    pipeline.indicated_point = clock.timed("fix", pipeline.indicated_point)
    PairTests.can_be_one = clock.timed("agree", PairTests.can_be_one)
    PairTests.are_one = clock.timed("agree", PairTests.are_one)
    PairTests.are_two = clock.timed("agree", PairTests.are_two)
    HandSearch.update_background = clock.timed("learn", HandSearch.update_background)
    HandSearch.learn = clock.timed("learn", HandSearch.learn)
    finger = Observation.__dict__["finger"]
    finger.func = clock.timed("finger lines", finger.func)


def simulated(cameras: int) -> tuple[SimulatedRig, Trajectory]:
    """Return a rig with a hand over a wooden table, and the motion of the hand."""
    azimuths = (0.0,) if cameras == 1 else tuple(np.linspace(-30, 30, cameras).tolist())
    rig = SimulatedRig(
        Placement(azimuths_deg=(-15.0, 15.0) if cameras == 2 else azimuths),
        device=Hand(),
        background=Background(texture="wood", sheet=60.0),
        lighting=Lighting(side_light=0.2, limb_darkening=0.2, shadow=0.4),
        sensor=Sensor(channels="bgr", cells_per_sigma=2),
    )
    path = figure_eight(rig.workspace)
    outside = path[0].retreated(ENTRY_MM)
    return rig, (
        Trajectory.hold(outside, EMPTY_S)
        .then(Trajectory.through([outside, path[0]], ENTRY_M_S))
        .then(Trajectory.hold(path[0], WAIT_S))
        .then(Trajectory.through(path, SPEED_M_S))
    )


def waiting_rig(rig: SimulatedRig, motion: Trajectory, sources: Sequence[str | int]) -> Rig:
    """Return the rig with the start poses of the arriving hand."""
    fingers = [view.finger for view in rig.truth(motion, time_s=ARRIVES_S).views]
    return rig_from_simulation(rig, starts=[finger.start() for finger in fingers], sources=sources)


def written(folder: Path, rig: SimulatedRig, motion: Trajectory) -> list[str]:
    """Write one MJPEG file per view."""
    files = [str(folder / f"{camera.name}.avi") for camera in rig.cameras]
    size_px = rig.cameras[0].width_px, rig.cameras[0].height_px
    codec = cv2.VideoWriter_fourcc(*"MJPG")
    videos = [cv2.VideoWriter(file, codec, FPS, size_px) for file in files]
    for index in range(FRAMES):
        frame = rig.render(motion, time_s=index / FPS, rng=index)
        for video, image in zip(videos, frame.images, strict=True):
            video.write(image)
    for video in videos:
        video.release()
    return files


def trackers(rig: Rig) -> list[ContourTracker]:
    """Make one tracker per view."""
    return [
        ContourTracker(
            Template.pistol(view.start.thumb),
            StartPose(view.start.tip_px, np.radians(view.start.angle_deg), view.start.length_px),
        )
        for view in rig.views
    ]


def follow(pointer: Pointer, frames: Sequence[Frame]) -> tuple[Step, bool]:
    """Update a pointer by a pair; return its step, and whether both views track the hand."""
    (step,) = pointer.update(frames)
    return step, all(isinstance(seen.finger, FingerLine) for seen in step.observations)


def end_to_end(folder: Path) -> Stopwatch:
    """Time every stage of a pair's frames, from decoding to the encoded live view."""
    scene, motion = simulated(2)
    rig = waiting_rig(scene, motion, written(folder, scene, motion))
    clock = Stopwatch()
    time_stages(clock)
    pointer, unrefined = Pointer(rig), Pointer(rig, tracker_options={"refine": False})
    sources = [open_source(view.source) for view in rig.views]
    pairs = read_views(sources)
    for _ in range(FRAMES):
        with clock.time("decode"):
            frames = next(pairs)
        with clock.time("grey"):
            for frame in frames:
                frame.grey()
        with clock.time("loop"):
            step, follows = follow(pointer, frames)
        with clock.time("draw"):
            drawn = [
                draw_view(o, pointer.plane_views, k, step.fix, size_px=o.frame.image.shape[1::-1])
                for k, o in enumerate(step.observations)
            ]
        with clock.time("encode"):
            for image in drawn:
                cv2.imencode(".jpg", image)
        clock.scope = "unrefined "
        _, follows_too = follow(unrefined, frames)
        clock.scope = ""
        clock.end_frame(counts=follows and follows_too)
    for source in sources:
        source.close()
    return clock


def print_end_to_end(clock: Stopwatch) -> None:
    """Print one line per stage, then the ratios."""
    us = clock.median_us
    pointing = us("track", "finger lines", "fix")
    rows = [
        ("decode both from MJPEG", us("decode")),
        ("grey", us("grey")),
        ("track", us("unrefined track")),
        ("refine", us("track") - us("unrefined track")),
        ("geometry: two finger lines and a fix", us("finger lines", "fix")),
        ("whether the views follow one finger", us("agree")),
        ("learn what is behind the hand", us("learn")),
        ("the rest of the loop", us("loop") - pointing - us("agree", "learn")),
        ("draw the live view", us("draw")),
        ("encode the live view as JPEG", us("encode")),
    ]
    whole = sum(time_us for _, time_us in rows)
    print(f"{'a stereo pair, 640 x 480, colour':<52} {'us':>8} {'share':>8}")
    for name, time_us in rows:
        print(f"{name:<52} {time_us:8.0f} {100 * time_us / whole:6.1f} %")
    print(f"{'all':<52} {whole:8.0f} {1e6 / whole:4.0f} fps")
    video = us("decode", "encode")
    print(f"\n{'as a share of decoding and encoding':<52} {'':8} {'':8} to reach")
    print(f"{'track, refine, geometry':<61} {100 * pointing / video:6.1f} % {100 * TARGET:6.0f} %")
    print(f"{'the whole loop':<61} {100 * us('loop') / video:6.1f} %")


def print_views() -> None:
    """Print the time of several views in one call."""
    print(f"\n{'views in one call [us]':<40} {'looking for a hand':>20} {'following it':>20}")
    for cameras in VIEWS:
        scene, motion = simulated(cameras)
        rig = waiting_rig(scene, motion, range(cameras))
        together = [
            [
                Frame(k, k / FPS, image)
                for image in scene.render(motion, time_s=k / FPS, rng=k).images
            ]
            for k in range(FRAMES // 3)
        ]
        for frames in together:
            for frame in frames:
                frame.grey()
        for schedule in SCHEDULES:
            times_us: dict[bool, list[float]] = {False: [], True: []}
            following = trackers(rig)
            for frames in together:
                views = [
                    (tracker, frame.grey(), frame.time_s, frame.image, None)
                    for tracker, frame in zip(following, frames, strict=True)
                ]
                began = time.perf_counter()
                tracks = update_views(views, schedule=schedule)
                taken_us = 1e6 * (time.perf_counter() - began)
                times_us[all(track.status == "tracking" for track in tracks)].append(taken_us)
            looking, follows = (statistics.median(times_us[key]) for key in (False, True))
            print(f"{f'{cameras} {schedule}':<40} {looking:20.0f} {follows:20.0f}")


def main() -> None:
    """Print the tables."""
    cv2.setNumThreads(1)
    cores = os.sched_getaffinity(0) if hasattr(os, "sched_setaffinity") else set()
    if CORE in cores:
        os.sched_setaffinity(0, {CORE})
    with tempfile.TemporaryDirectory() as folder:
        print_end_to_end(end_to_end(Path(folder)))
    if cores:
        os.sched_setaffinity(0, cores)
    print_views()


if __name__ == "__main__":
    main()
