"""Golden tracks: the tracks of every view and the fixes of some clips, to the last bit.

    python tests/golden/generate_tracks.py            # compare with tracks.json in its folder
    python tests/golden/generate_tracks.py --record   # write it, after an intended change

A change that must not alter results keeps every hash. A hash covers all numbers of every step with
17 digits: fixes, finger lines, shape vectors, contours, diagnostics, camera motion; messages are
left out. Bits are reproducible only by one build on one kind of processor with the same NumPy and
OpenCV, whose kernels round differently; so the points are stored too, for comparison where one of
these differs. A processor with AVX-512 gives the recorded bits if its libraries do without:

    OPENCV_CPU_DISABLE=AVX512-SKX OPENBLAS_CORETYPE=Haswell python tests/golden/generate_tracks.py
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import json
import math
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from fingerpost._core import ContourTracker, StartPose, Template, Track
from fingerpost.capture import Frame, open_views, read_views
from fingerpost.config import Rig
from fingerpost.pipeline import Observation, Pointer, Step, at_most, steps
from fingerpost.pointing import FingerLine
from fingerpost.simulate import (
    Background,
    Hand,
    Motion,
    Placement,
    Sensor,
    SimulatedRig,
    figure_eight,
    pointing_session,
)
from fingerpost.simulated_rig_file import rig_from_simulation

GOLDEN = Path(__file__).with_name("tracks.json")
DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
FRAMES = 60
"""Of every clip: enough to find a hand, follow it and lose it."""

SEED = 1994
FPS = 30.0
COMES_FROM_MM = 500.0
"""Distance from which the hand enters, out of every view."""

Image = NDArray[np.uint8]
Channels = Literal["grey", "bgr"]
Together = tuple[Frame | None, ...]


@dataclass(frozen=True)
class Clip:
    """A rig, its frames, and the options of the pointer."""

    rig: Rig
    frames: Iterable[Together]
    options: Mapping[str, Any] = field(default_factory=dict)


@dataclass
class Golden:
    """Results of a clip: a hash of all numbers, and the points."""

    sha256: str
    points: list[list[float] | None]


# --- clips ----------------------------------------------------------------------------------------


def footage(
    rig_file: Path,
    *,
    with_start: bool = True,
    shown: Callable[[Image, int], Image] = lambda image, _: image,
    frames: int = FRAMES,
    **options: Any,
) -> Clip:
    """Return a recording, with or without its start, its images changed by `shown`."""
    rig = Rig.load(rig_file)
    if not with_start:
        found = tuple(structs.replace(view, start=None) for view in rig.views)
        rig = structs.replace(rig, views=found)
    return Clip(rig, _read(rig, shown, frames), options)


def _read(rig: Rig, shown: Callable[[Image, int], Image], count: int) -> Iterator[Together]:
    with ExitStack() as stack:
        sources = stack.enter_context(open_views(rig.sources, rig.readings))
        for together in at_most(read_views(sources), count):
            yield tuple(
                frame and replace(frame, image=shown(frame.image, frame.index))
                for frame in together
            )


def grey(image: Image, _: int) -> Image:
    """Return the grey levels of a colour image."""
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))


def moved(image: Image, index: int) -> Image:
    """Return an image as of a camera that moves and turns a little from frame to frame."""
    height, width = image.shape[:2]
    turn = cv2.getRotationMatrix2D((width / 2, height / 2), 2.0 * math.sin(index / 9), 1.0)
    turn[:, 2] += (12.0 * math.sin(index / 7), 8.0 * math.sin(index / 11))
    return np.asarray(cv2.warpAffine(image, turn, (width, height), borderMode=cv2.BORDER_REPLICATE))


def simulated(placement: Placement, channels: Channels, *, with_start: bool) -> Clip:
    """Return a hand that enters, points along half a figure of eight and rests, over wood."""
    rig = SimulatedRig(
        placement,
        device=Hand(),
        background=Background(texture="wood", clutter=15),
        sensor=Sensor(channels=channels),
    )
    path = figure_eight(rig.workspace, hover_mm=100.0)[:8]
    motion = pointing_session(path, entry_mm=COMES_FROM_MM, wait_s=0.3)
    starts = None
    if with_start:
        views = rig.truth(motion, time_s=COMES_FROM_MM / 600.0 + 0.2).views
        starts = [view.finger.start() for view in views if view.finger is not None]
    return Clip(rig_from_simulation(rig, starts=starts), _rendered(rig, motion))


def _rendered(rig: SimulatedRig, motion: Motion) -> Iterator[Together]:
    rng = np.random.default_rng(SEED)
    for index in range(FRAMES):
        time_s = COMES_FROM_MM / 600.0 - 0.3 + index / FPS
        images = rig.render(motion, time_s=time_s, rng=rng).images
        yield tuple(Frame(index, index / FPS, np.asarray(image)) for image in images)


SMALL = Placement(width_px=320, height_px=240)
THREE = replace(SMALL, azimuths_deg=(-25.0, 0.0, 25.0))
DESK, MAT = DATA / "desk" / "rig.toml", DATA / "mat" / "rig.toml"

SIMULATED: dict[str, Callable[[], Clip]] = {
    "simulated-grey": lambda: simulated(SMALL, "grey", with_start=True),
    "simulated-colour": lambda: simulated(SMALL, "bgr", with_start=False),
    "simulated-three-views": lambda: simulated(THREE, "grey", with_start=False),
}
FOOTAGE: dict[str, Callable[[], Clip]] = {
    "desk": lambda: footage(DESK),
    "desk-found": lambda: footage(DESK, with_start=False),
    "desk-grey-found": lambda: footage(DESK, with_start=False, shown=grey),
    "desk-paper": lambda: footage(DESK, tracker_options={"model": "paper"}),
    "desk-moving": lambda: footage(DESK, shown=moved),
    "mat": lambda: footage(MAT, frames=120),
    "mat-found": lambda: footage(MAT, with_start=False),
    "mat-grey": lambda: footage(MAT, shown=grey),
    "device": lambda: footage(DATA / "device" / "pose_03.toml", frames=25),
    "device-found": lambda: footage(DATA / "device" / "pose_11.toml", with_start=False, frames=25),
}
PHOTOGRAPHS = "ti1k"


# --- results --------------------------------------------------------------------------------------


def golden(clip: Clip) -> Golden:
    """Track a clip; return its results."""
    digest, points = hashlib.sha256(), []
    for step in steps(Pointer(clip.rig, **clip.options), clip.frames):
        _add(digest, of_step(step))
        points.append(None if step.fix.point is None else step.fix.point.tolist())
    return Golden(digest.hexdigest(), points)


def golden_photographs() -> Golden:
    """Track the finger of the photographs, which bends at the end, in one view; keep its tips."""
    folder = DATA / "ti1k"
    with (folder / "axis.csv").open() as file:
        axes = {int(row["frame"][-8:-4]): row for row in csv.DictReader(file)}
    first, width_px = axes[553], float(axes[553]["width_px"])
    start = StartPose(
        (float(first["apex_x"]), float(first["apex_y"])),
        math.radians(float(first["angle_deg"])),
        3.25 * width_px,
    )
    tracker = ContourTracker(Template.pistol("none"), start)
    digest, tips = hashlib.sha256(), []
    for index, number in enumerate([553] * 8 + list(range(554, 569))):
        image = cv2.imread(str(folder / f"TI1K_IMAGE_{number:04d}.jpg"))
        track = tracker.update(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), 0.1 * index, image)
        _add(digest, _of_track(track))
        tips.append(None if track.finger_line is None else list(track.finger_line.tip_px))
    return Golden(digest.hexdigest(), tips)


def made(name: str) -> Golden:
    """Compute the golden data of one clip."""
    if name == PHOTOGRAPHS:
        return golden_photographs()
    return golden((SIMULATED | FOOTAGE)[name]())


def names() -> list[str]:
    """Return the clips that are available here: footage may be absent."""
    return [*SIMULATED, *([*FOOTAGE, PHOTOGRAPHS] if DATA.is_dir() else [])]


def _add(digest: Any, values: Iterable[Any]) -> None:
    digest.update(("\n".join(map(written, values)) + "\n\n").encode())


def written(value: Any) -> str:
    """Format a value with all its digits."""
    if value is None or isinstance(value, str | bool | int):
        return str(value)
    return " ".join(f"{number:.17g}" for number in np.asarray(value, dtype=np.float64).ravel())


def of_step(step: Step) -> Iterator[Any]:
    """Yield all numbers of a step."""
    fix = step.fix
    yield from (step.index, fix.time_s, fix.status.value, fix.point, fix.covariance)
    yield from (fix.crossing_angle_rad, step.hand.number, step.hand.is_presented)
    for seen in step.observations:
        yield from _of_observation(seen)


def _of_observation(seen: Observation) -> Iterator[Any]:
    finger = seen.finger
    yield from (seen.view, seen.contour_px, seen.moved_px, seen.is_adrift, seen.is_body)
    if isinstance(finger, FingerLine):
        yield from (finger.tip_px, finger.angle_rad, finger.covariance)
    else:
        yield finger.value
    yield from (seen.axis_correction.offset, seen.axis_correction.sigma)
    if seen.plane_view is not None:
        yield from (seen.plane_view.image_from_plane, seen.plane_view.entries_covariance)
    if seen.searched is not None:
        yield seen.searched.offset_px
    if seen.track is not None:
        yield from _of_track(seen.track)


def _of_track(track: Track) -> Iterator[Any]:
    why = track.diagnostics
    yield from (track.time_s, track.status, track.shape_vector, track.shape_covariance)
    yield from (why.visible, why.hits, why.inliers, why.agreement, why.min_agreement)
    yield from (why.residual_rms_px, why.max_residual_px, why.rank, why.iterations)
    yield from (why.accepted, why.refusal, why.innovation, why.bend_rad)
    line = track.finger_line
    if line is not None:
        yield from (line.anchor_px, line.tip_px, line.angle_rad, line.half_length_px)
        yield from (line.stretch_px, line.covariance, line.source)


# --- the file -------------------------------------------------------------------------------------


def environment() -> dict[str, str]:
    """Return what the bits depend on besides fingerpost itself."""
    return {
        "numpy": np.__version__,
        "opencv": cv2.__version__,
        "processor": cv2.getCPUFeaturesLine(),
    }


def recorded() -> dict[str, Any]:
    """Read the file."""
    data: dict[str, Any] = json.loads(GOLDEN.read_text(encoding="utf-8"))
    return data


def record() -> None:
    """Write the file from all clips."""
    if not DATA.is_dir():
        sys.exit(f"{DATA} is needed to record: the footage")
    clips = {}
    for name in names():
        new = made(name)
        short = [p and [float(f"{x:.7g}") for x in p] for p in new.points]
        clips[name] = {"sha256": new.sha256, "points": short}
        print(name, new.sha256[:12], sum(p is not None for p in new.points), len(new.points))
    lines = [f"  {json.dumps(name)}: {json.dumps(clip)}" for name, clip in clips.items()]
    text = ",\n".join(lines)
    GOLDEN.write_text(
        f'{{"made_with": {json.dumps(environment())},\n"clips": {{\n{text}\n}}}}\n',
        encoding="utf-8",
    )


def main() -> None:
    """Compare with the file, or write it."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", maxsplit=1)[0])
    parser.add_argument("clips", nargs="*", metavar="CLIP", help="default: all")
    parser.add_argument("--record", action="store_true", help="write tracks.json anew")
    arguments = parser.parse_args()
    if arguments.record:
        record()
        return
    kept, differ = recorded()["clips"], 0
    for name in arguments.clips or names():
        same = made(name).sha256 == kept[name]["sha256"]
        differ += not same
        print(f"{name:24} {'same' if same else 'DIFFERENT'}", flush=True)
    sys.exit(bool(differ))


if __name__ == "__main__":
    main()
