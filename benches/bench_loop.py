"""Processor time of the whole loop of a pair, frame by frame, without decoding.

    taskset -c 1 python benches/bench_loop.py [RIG.TOML ...] [--frames N]

Every rig is followed from its first frame; without one it is the built-in clip. The first rig is
followed at other sizes as well, with its images and coordinates scaled. Then nobody comes: to an
empty table, and to one over which a box moves, so that the whole image is searched. Each row has
[ms]: the median after the first 20 frames, the 99th percentile and the maximum of all frames; and
the fraction of frames with a point. `benches/peers` times other trackers on the same footage.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
from msgspec.structs import replace

import fingerpost
from fingerpost.capture import Frame, Loss, open_views, read_views
from fingerpost.config import Rig, View
from fingerpost.pipeline import Pointer
from fingerpost.pointing import Status
from fingerpost.simulate import Background, Sensor, SimulatedRig
from fingerpost.simulated_rig_file import rig_from_simulation

CLIP = Path(fingerpost.__file__).parent / "data" / "desk" / "rig.toml"
SETTLED_FRAMES = 20
FPS = 30.0
BOX_PX = 40

Together = Sequence[Frame | Loss | None]


def read(rig: Rig, count: int) -> list[Together]:
    """Decode the first frames of a rig's sources."""
    with ExitStack() as stack:
        sources = stack.enter_context(open_views(rig.sources, rig.readings))
        return list(islice(read_views(sources), count))


def print_row(name: str, rig: Rig, frames: Iterable[Together]) -> None:
    """Follow the frames, and print the times of their steps."""
    pointer, spent_ms, points = Pointer(rig), [], 0
    for together in frames:
        begun_s = time.process_time()
        steps = pointer.update(together)
        spent_ms.append(1e3 * (time.process_time() - begun_s))
        points += sum(step.fix.status is Status.OK for step in steps)
    median = np.median(spent_ms[SETTLED_FRAMES:])
    slow = np.percentile(spent_ms, 99)
    part = points / len(spent_ms)
    print(f"| {name} | {median:.1f} | {slow:.1f} | {max(spent_ms):.1f} | {part:.0%} |", flush=True)


def scaled(rig: Rig, frames: list[Together], factor: float) -> tuple[Rig, list[Together]]:
    """Scale images and image coordinates; pixels are squares whose centres are whole numbers."""

    def place(point: Sequence[float]) -> tuple[float, float]:
        return tuple(factor * (value + 0.5) - 0.5 for value in point)  # type: ignore[return-value]

    def view(given: View) -> View:
        start = given.start
        if start is not None:
            start = replace(start, tip_px=place(start.tip_px), length_px=factor * start.length_px)
        points = tuple(place(point) for point in given.reference_points_px)
        return replace(
            given,
            reference_points_px=points,
            reference_covariances_px2=None,
            size_px=None,
            start=start,
        )

    def frame(given: Frame | Loss | None) -> Frame | Loss | None:
        if not isinstance(given, Frame):
            return given
        image = cv2.resize(given.image, None, fx=factor, fy=factor, interpolation=cv2.INTER_CUBIC)
        return Frame(given.index, given.time_s, np.asarray(image, np.uint8))

    larger = replace(rig, views=tuple(view(one) for one in rig.views))
    return larger, [[frame(one) for one in together] for together in frames]


def nobody(size_px: tuple[int, int], count: int, *, moves: bool) -> tuple[Rig, list[Together]]:
    """Return views of a table at which nobody is; a box may move over it."""
    cell = SimulatedRig(background=Background(texture="wood"), sensor=Sensor(channels="bgr"))
    tables = list(cell.render(None, rng=0).images)
    width = tables[0].shape[1]
    tables = [cv2.resize(table, size_px, interpolation=cv2.INTER_CUBIC) for table in tables]
    rng = np.random.default_rng(0)
    noise = rng.normal(0.0, 2.0, (4, size_px[1], size_px[0], 3)).astype(np.float32)
    box = round(BOX_PX * size_px[0] / width)

    def image(k: int, view: int) -> np.ndarray:
        shown = tables[view] + noise[(3 * k + view) % len(noise)]
        if moves and k >= SETTLED_FRAMES:
            u = box + (2 * box * (k - SETTLED_FRAMES)) // 5 % (size_px[0] - 3 * box)
            shown[size_px[1] // 2 :][:box, u : u + box] = 230.0
        return np.clip(shown, 0, 255).astype(np.uint8)

    rig, _ = scaled(rig_from_simulation(cell), [], size_px[0] / width)
    return rig, [[Frame(k, k / FPS, image(k, view)) for view in range(2)] for k in range(count)]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("rigs", nargs="*", type=Path, default=[CLIP], metavar="RIG.TOML")
    parser.add_argument("--frames", type=int, default=90)
    given = parser.parse_args()
    if given.frames <= SETTLED_FRAMES:
        parser.error(f"--frames is {given.frames}; more than {SETTLED_FRAMES} are right")
    cv2.setNumThreads(1)
    print("| work | median | 99 % | maximum | points |\n|---|---|---|---|---|")
    footage = [(path.parent.name, Rig.load(path)) for path in given.rigs]
    films = [(name, rig, read(rig, given.frames)) for name, rig in footage]
    for name, rig, frames in films:
        print_row(name, rig, frames)
    name, rig, frames = films[0]
    for factor in (1.5, 2.0, 3.0):
        print_row(f"{name} × {factor:g}", *scaled(rig, frames, factor))
    for size_px in ((640, 480), (3840, 2880)):
        count = given.frames if size_px[0] == 640 else SETTLED_FRAMES + 10
        label = f"{size_px[0]} × {size_px[1]}"
        print_row(f"nobody, {label}", *nobody(size_px, count, moves=False))
        print_row(f"a box moves, {label}", *nobody(size_px, count, moves=True))


if __name__ == "__main__":
    main()
