"""Accuracy on footage of a real hand, with and without a start pose, and on altered versions of it.

    python benches/mat.py FOLDER [VERSION ...] [--workers 1]

FOLDER holds the first 120 frames of the two demo videos of github.com/TemugeB/handpose3d (MIT), a
`rig.toml`, and a reference from silhouettes: `pointing_reference.csv` (the indicated point: the
fingertip while it touches the mat, else the intersection of two medial lines) and `cam0_axis.csv`,
`cam1_axis.csv` (the medial lines). Each row is the footage, unaltered or in another version, with
the start pose of the rig file or without one. Points are in sides of the mat. A point is *wrong* if
its error exceeds three times its 99 % ellipse, widened by the error of the reference.
"""

from __future__ import annotations

import argparse
import csv
import math
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from fingerpost.capture import Frame, open_views, read_views
from fingerpost.config import Rig, Start, View
from fingerpost.experiment.trial import squared_in_sigmas
from fingerpost.pipeline import Observation, Pointer, Step, steps
from fingerpost.pointing import FingerLine, Status
from fingerpost.workers import sharing, worker_count

Image = NDArray[np.uint8]
Points = NDArray[np.float64]

CHI2_99 = 9.210
# Distance between two references of one frame: its spread (contact) and its median (hover).
CONTACT_SIGMA, HOVER_SIGMA = 0.016, 0.022
# A medial line is usable if it fits its sections and agrees with that of a learned hand model.
MOST_RMS_PX, MOST_TURN_DEG = 1.2, 6.0


@dataclass(frozen=True)
class Version:
    """An altered version of the footage: the change of images and of pixels; every n-th frame."""

    shown: Callable[[Image, np.random.Generator], Image] = lambda image, _: image
    scale: float = 1.0
    mirrored: bool = False
    every: int = 1

    def carried(self, px: Points, width_px: int) -> Points:
        """Map pixels of the footage, (..., 2), to this version."""
        u, v = px[..., 0], px[..., 1]
        placed = np.stack([width_px - 1.0 - u if self.mirrored else u, v], axis=-1)
        return self.scale * (placed + 0.5) - 0.5

    def turned(self, angle_rad: float) -> float:
        """Map a direction of the footage to this version."""
        return math.pi - angle_rad if self.mirrored else angle_rad


def grey(image: Image, _: np.random.Generator) -> Image:
    """Remove the colours."""
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))


def scaled(image: Image, _: np.random.Generator, *, scale: float) -> Image:
    """Reduce the resolution."""
    return np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA))


def levels(image: Image, _: np.random.Generator, *, gain: float, offset: float = 0.0) -> Image:
    """Change brightness and contrast."""
    return np.asarray(cv2.convertScaleAbs(image, None, gain, offset))


def noisy(image: Image, rng: np.random.Generator, *, sigma: float) -> Image:
    """Add noise of a standard deviation of `sigma` grey levels."""
    return np.clip(np.rint(image + rng.normal(0, sigma, image.shape)), 0, 255).astype(np.uint8)


def blurred(image: Image, _: np.random.Generator, *, sigma_px: float) -> Image:
    """Blur the image."""
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma_px))


def compressed(image: Image, _: np.random.Generator, *, quality: int) -> Image:
    """Compress as JPEG does."""
    code = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return np.asarray(cv2.imdecode(code, cv2.IMREAD_COLOR))


def mirrored(image: Image, _: np.random.Generator) -> Image:
    """Mirror the image: the hand becomes the other one."""
    return np.ascontiguousarray(image[:, ::-1])


VERSIONS = {
    "as it is": Version(),
    "grey": Version(grey),
    "mirrored": Version(mirrored, mirrored=True),
    "two thirds the size": Version(partial(scaled, scale=2 / 3), scale=2 / 3),
    "half as bright": Version(partial(levels, gain=0.5)),
    "brighter, clipped": Version(partial(levels, gain=1.4)),
    "half the contrast": Version(partial(levels, gain=0.5, offset=64.0)),
    "noise of 8 levels": Version(partial(noisy, sigma=8.0)),
    "blurred by 1.5 px": Version(partial(blurred, sigma_px=1.5)),
    "JPEG at quality 30": Version(partial(compressed, quality=30)),
    "15 frames a second": Version(every=2),
}


@dataclass(frozen=True)
class Reference:
    """The indicated point of a frame, and its standard deviation."""

    phase: str
    point: Points
    sigma: float


@dataclass
class Result:
    """The errors of one version against the reference."""

    contact: list[float] = field(default_factory=list)
    hover: list[float] = field(default_factory=list)
    angle_deg: list[float] = field(default_factory=list)
    apex_px: list[float] = field(default_factory=list)
    wanted: dict[str, int] = field(default_factory=lambda: {"contact": 0, "hover": 0, "lines": 0})
    wrong: int = 0
    first: dict[str, int] = field(default_factory=dict)
    first_point: int | None = None

    def row(self) -> str:
        """Return the figures in one line."""
        rms = math.sqrt(np.mean(np.square(self.contact))) if self.contact else math.nan
        tail = np.percentile(self.angle_deg, 95) if self.angle_deg else math.nan
        middle = [
            float(np.median(v)) if v else math.nan
            for v in (self.hover, self.angle_deg, self.apex_px)
        ]
        followed = ", ".join(f"{name} {frame}" for name, frame in self.first.items())
        return (
            f"contact {len(self.contact):2d} of {self.wanted['contact']:2d}  RMS {rms:.4f}   "
            f"hover {len(self.hover):2d} of {self.wanted['hover']:2d}  median {middle[0]:.3f}   "
            f"wrong {self.wrong}   lines {len(self.angle_deg):3d} of {self.wanted['lines']:3d}  "
            f"angle median {middle[1]:.1f}  95 % {tail:.1f} deg  apex {middle[2]:.1f} px   "
            f"first lines {followed or 'none'}  first point {self.first_point}"
        )


def read_points(folder: Path) -> dict[int, Reference]:
    """Read the indicated point of every frame that has a reference."""
    points = {}
    with (folder / "pointing_reference.csv").open() as rows:
        for row in csv.DictReader(rows):
            name, sigma = {
                "contact": ("contact_ref", CONTACT_SIGMA),
                "hover": ("indicated_edge", HOVER_SIGMA),
            }.get(row["phase"], ("", 0.0))
            if name and row[f"{name}_x"]:
                point = np.array([float(row[f"{name}_x"]), float(row[f"{name}_y"])])
                points[int(row["frame"])] = Reference(row["phase"], point, sigma)
    return points


def read_lines(folder: Path, view: str) -> dict[int, tuple[float, Points]]:
    """Read angle [rad] and apex [px] of every usable medial line of a view."""
    lines = {}
    with (folder / f"{view}_axis.csv").open() as rows:
        for row in csv.DictReader(rows):
            if row["edge_found"] != "1" or float(row["rms_px"]) >= MOST_RMS_PX:
                continue
            turn = row["mp_minus_edge_deg"]
            if turn and abs(float(turn)) < MOST_TURN_DEG:
                apex = np.array([float(row["apex_x"]), float(row["apex_y"])])
                lines[int(row["frame"])] = math.radians(float(row["angle_deg"])), apex
    return lines


def carried(rig: Rig, version: Version, width_px: int, *, with_start: bool) -> Rig:
    """Return the rig of a version of the footage, with or without its start poses."""

    def view_of(view: View) -> View:
        points_px = version.carried(np.array(view.reference_points_px), width_px)
        start = None
        if with_start and view.start is not None:
            start = Start(
                tip_px=tuple(version.carried(np.array(view.start.tip_px), width_px).tolist()),
                angle_deg=math.degrees(version.turned(math.radians(view.start.angle_deg))),
                length_px=version.scale * view.start.length_px,
                thumb=view.start.thumb,  # folded in, so mirroring does not change it
            )
        return msgspec.structs.replace(
            view, reference_points_px=tuple(map(tuple, points_px.tolist())), start=start
        )

    return msgspec.structs.replace(rig, views=tuple(map(view_of, rig.views)))


def shown(rig: Rig, version: Version) -> Iterator[list[Frame | None]]:
    """Yield the frames of a version of the footage."""
    rng = np.random.default_rng(0)
    with ExitStack() as stack:
        sources = stack.enter_context(open_views(rig.sources, rig.readings))
        for index, frames in enumerate(read_views(sources)):
            if index % version.every == 0:
                yield [f and replace(f, image=version.shown(f.image, rng)) for f in frames]


def measured(folder: Path, case: tuple[str, bool]) -> Result:
    """Track the hand in a version of the footage, with or without its start poses."""
    name, with_start = case
    version = VERSIONS[name]
    rig = Rig.load(folder / "rig.toml")
    points = read_points(folder)
    lines = [read_lines(folder, view.name) for view in rig.views]
    with open_views(rig.sources, rig.readings) as sources:
        first = next(iter(read_views(sources)))[0]
    assert first is not None
    width_px = first.image.shape[1]
    result = Result()
    pointer = Pointer(carried(rig, version, width_px, with_start=with_start))
    for step in steps(pointer, shown(rig, version)):
        _judge_point(result, step, points.get(step.index))
        for seen, axes in zip(step.observations, lines, strict=True):
            _judge_line(result, seen, axes, version, width_px)
    return result


def _judge_point(result: Result, step: Step, reference: Reference | None) -> None:
    fix = step.fix
    if fix.status is Status.OK and result.first_point is None:
        result.first_point = step.index
    if reference is None:
        return
    result.wanted[reference.phase] += 1
    if fix.status is not Status.OK or fix.point is None or fix.covariance is None:
        return
    error = fix.point - reference.point
    errors = result.contact if reference.phase == "contact" else result.hover
    errors.append(math.hypot(*error))
    covariance = fix.covariance + reference.sigma**2 * np.eye(2)
    result.wrong += squared_in_sigmas(error, covariance) > 9.0 * CHI2_99


def _judge_line(
    result: Result,
    seen: Observation,
    axes: dict[int, tuple[float, Points]],
    version: Version,
    width_px: int,
) -> None:
    if seen.frame is None:
        return
    index, line = seen.frame.index, seen.finger
    result.wanted["lines"] += index in axes
    if not isinstance(line, FingerLine):
        return
    result.first.setdefault(seen.view, index)
    if index not in axes:
        return
    angle_rad, apex_px = axes[index]
    turn_rad = math.remainder(line.angle_rad - version.turned(angle_rad), math.tau)
    off_px = (line.tip_px - version.carried(apex_px, width_px)) / version.scale
    result.angle_deg.append(abs(math.degrees(turn_rad)))
    result.apex_px.append(math.hypot(*off_px))


def main() -> None:
    """Print two rows for every version."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("versions", nargs="*", metavar="VERSION", help="; ".join(VERSIONS))
    parser.add_argument("--workers", type=int, default=1, help="0: one for each core")
    given = parser.parse_args()
    if not (given.folder / "pointing_reference.csv").is_file():
        parser.error(f"{given.folder} has no pointing_reference.csv; the footage's folder is right")
    unknown = set(given.versions) - set(VERSIONS)
    if unknown:
        parser.error(f"no version {'; '.join(sorted(unknown))}; there are: {'; '.join(VERSIONS)}")
    if given.workers < 0:
        parser.error(f"--workers is {given.workers}; 0 or more is right")
    cases = [(name, start) for name in given.versions or VERSIONS for start in (True, False)]
    points = wrong = 0
    with sharing(worker_count(given.workers or None)) as pool:
        results = pool.map(partial(measured, given.folder), cases)
        for case, result in zip(cases, results, strict=True):
            name, with_start = case
            print(f"{name:20} {'started' if with_start else 'found':7}  {result.row()}", flush=True)
            points += len(result.contact) + len(result.hover)
            wrong += result.wrong
    print(f"{points} points beside a reference, {wrong} wrong")


if __name__ == "__main__":
    main()
