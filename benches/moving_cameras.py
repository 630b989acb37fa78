"""Time and accuracy of a stereo pair while its cameras swing and shake.

    taskset -c 1 python benches/moving_cameras.py [fixed rectangle] [--seeds 3] [--frames 240]

A simulated hand in colour, 640 x 480, over a wooden table with a sheet on it, is held still, then
moves at 0.35 m/s. Each camera turns by +- 3 degrees about each of its axes and moves to and fro by
15 mm at 0.3 to 0.5 Hz, and shakes by +- 5 px at 3 to 7 Hz. The same film is rendered with static
cameras. References are given pixels of the first frame (`fixed`), or the sheet (`rectangle`). Each
row has: median and 99th percentile of the main loop's processor time for a pair, without decoding
[ms]; RMS error of the point while the hand moves, and while it is held [mm]; RMS deviation of the
held point from its mean [mm]; the fraction of frames with a point; and the fraction of points in
their 95 % ellipse.
"""

from __future__ import annotations

import argparse
import cProfile
import dataclasses
import pstats
import time
from collections.abc import Iterator
from dataclasses import dataclass, field

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from fingerpost.capture import Frame
from fingerpost.config import RectangleReference, Rig
from fingerpost.pipeline import Pointer
from fingerpost.simulate import (
    Background,
    Camera,
    Hand,
    Lighting,
    Placement,
    Sensor,
    SimulatedRig,
    Trajectory,
    figure_eight,
)
from fingerpost.simulated_rig_file import rig_from_simulation

FPS = 30.0
EMPTY_S, WAIT_S, HELD_S, SPEED_M_S, ENTRY_M_S, ENTRY_MM = 0.7, 0.8, 2.0, 0.35, 0.9, 900.0
HELD_FROM_S = EMPTY_S + ENTRY_MM / 1000 / ENTRY_M_S + WAIT_S
SWING_DEG, SWING_HZ, SWAY_MM, SHAKE_PX, SHAKE_HZ = 3.0, (0.3, 0.5), 15.0, 5.0, (3.0, 7.0)
CHI2_95 = 5.991

Image = NDArray[np.uint8]


@dataclass
class Shaken:
    """A camera on an unstable stand, with the frequencies of its swing, sway and shake."""

    camera: Camera
    swings_hz: NDArray[np.float64]
    sways_hz: NDArray[np.float64]
    shakes_hz: NDArray[np.float64]

    @classmethod
    def drawn(cls, camera: Camera, rng: np.random.Generator) -> Shaken:
        """Draw the frequencies of its motion along and about each of its axes."""
        return cls(camera, *(rng.uniform(*hz, 3) for hz in (SWING_HZ, SWING_HZ, SHAKE_HZ)))

    def at(self, time_s: float) -> Camera:
        """Return the camera at a time; at 0 it has its measured pose."""
        swing, sway, shake = (
            np.sin(2 * np.pi * hz * time_s)
            for hz in (self.swings_hz, self.sways_hz, self.shakes_hz)
        )
        turned_rad = np.radians(SWING_DEG) * swing
        turned_rad += SHAKE_PX / self.camera.f_px * shake * (1.0, 1.0, 0.0)
        pose = cv2.Rodrigues(turned_rad)[0] @ self.camera.camera_from_world
        pose[:, 3] += SWAY_MM * sway
        return dataclasses.replace(self.camera, camera_from_world=pose)


def scene(seed: int) -> tuple[SimulatedRig, Trajectory]:
    """Return the rig with its table, and the motion of the hand."""
    rig = SimulatedRig(
        Placement.webcams(),
        device=Hand(),
        background=Background(texture="wood", sheet=60.0, clutter=0.0, seed=seed),
        lighting=Lighting(side_light=0.2, limb_darkening=0.2, shadow=0.4),
        sensor=Sensor(channels="bgr", cells_per_sigma=2),
    )
    path = figure_eight(rig.workspace)
    outside = path[0].retreated(ENTRY_MM)
    return rig, (
        Trajectory.hold(outside, EMPTY_S)
        .then(Trajectory.through([outside, path[0]], ENTRY_M_S))
        .then(Trajectory.hold(path[0], WAIT_S + HELD_S))
        .then(Trajectory.through(path, SPEED_M_S))
    )


@dataclass
class Film:
    """Frames of a pair, and the indicated point of each [mm]."""

    rig: SimulatedRig
    images: list[tuple[Image, ...]] = field(default_factory=list)
    truth_mm: list[NDArray[np.float64]] = field(default_factory=list)

    @classmethod
    def rendered(cls, seed: int, frames: int, *, moves: bool) -> Film:
        """Render a film with static cameras, or with cameras that move from the second frame on."""
        rig, motion = scene(seed)
        rng = np.random.default_rng(seed)
        shaken = [Shaken.drawn(camera, rng) for camera in rig.cameras]
        film = cls(rig)
        for k in range(frames):
            seen = rig.seen_by([one.at(k / FPS) for one in shaken]) if moves else rig
            frame = seen.render(motion, time_s=k / FPS, rng=1000 * seed + k)
            film.images.append(frame.images)
            film.truth_mm.append(frame.truth.indicated_mm)
        return film

    def described(self, kind: str) -> Rig:
        """Return the rig with references from the first frame alone, or with the sheet."""
        given = rig_from_simulation(self.rig)
        if kind == "fixed":
            return given
        side = self.rig.workspace.side_mm
        views = [
            msgspec.structs.replace(
                view,
                reference_points_px=(),
                reference=RectangleReference(
                    size=(side, side), corners_px=view.reference_points_px
                ),
            )
            for view in given.views
        ]
        return msgspec.structs.replace(given, views=tuple(views))


@dataclass
class Result:
    """Times and errors of a kind of references."""

    times_ms: list[float] = field(default_factory=list)
    held_mm: list[NDArray[np.float64]] = field(default_factory=list)
    moving_mm: list[NDArray[np.float64]] = field(default_factory=list)
    held: list[NDArray[np.float64]] = field(default_factory=list)
    inside: list[bool] = field(default_factory=list)
    asked: int = 0


def pairs(film: Film) -> Iterator[list[Frame]]:
    """Yield the pairs of frames of a film."""
    for k, images in enumerate(film.images):
        yield [Frame(k, k / FPS, image) for image in images]


def followed(film: Film, kind: str, result: Result, profile: cProfile.Profile | None) -> None:
    """Track the hand in a film; add times and errors to the result."""
    pointer = Pointer(film.described(kind))
    for k, frames in enumerate(pairs(film)):
        began = time.process_time()
        if profile is not None:
            profile.enable()
        steps = pointer.update(frames)
        if profile is not None:
            profile.disable()
        taken_ms = 1e3 * (time.process_time() - began)
        if k / FPS < HELD_FROM_S:
            continue
        result.times_ms.append(taken_ms)
        result.asked += 1
        fix = steps[0].fix if steps else None
        if fix is None or fix.point is None:
            continue
        off_mm = fix.point - film.truth_mm[k]
        is_held = k / FPS < HELD_FROM_S + HELD_S
        (result.held_mm if is_held else result.moving_mm).append(off_mm)
        result.inside.append(bool(off_mm @ np.linalg.solve(fix.covariance, off_mm) < CHI2_95))
        if is_held:
            result.held.append(fix.point)


def rms(errors: list[NDArray[np.float64]]) -> float:
    """Return the root mean square length of errors."""
    return float(np.sqrt(np.mean(np.sum(np.square(errors), axis=1)))) if errors else float("nan")


def main() -> None:
    """Print a row for every kind of references, with static and with moving cameras."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("kinds", nargs="*", default=["fixed", "rectangle"])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--frames", type=int, default=240)
    parser.add_argument("--profile", action="store_true", help="where moving frames' time goes")
    given = parser.parse_args()
    cv2.setNumThreads(1)
    profile = cProfile.Profile() if given.profile else None
    print(
        f"{'references':<12}{'cameras':<8}{'median':>8}{'p99':>8}{'moving':>8}{'held':>8}"
        f"{'moved':>8}{'points':>8}{'inside':>8}"
    )
    results: dict[tuple[str, bool], Result] = {}
    for seed in range(given.seeds):
        for moves in (False, True):
            film = Film.rendered(seed, given.frames, moves=moves)
            for kind in given.kinds:
                result = results.setdefault((kind, moves), Result())
                about = [len(result.held)]
                followed(film, kind, result, profile if moves else None)
                held = np.array(result.held[about[0] :])
                result.held[about[0] :] = list(held - held.mean(axis=0)) if len(held) else []
    for (kind, moves), r in results.items():
        print(
            f"{kind:<12}{'moving' if moves else 'still':<8}{np.median(r.times_ms):8.1f}"
            f"{np.percentile(r.times_ms, 99):8.1f}{rms(r.moving_mm):8.2f}{rms(r.held_mm):8.2f}"
            f"{rms(r.held):8.2f}{len(r.inside) / r.asked:8.0%}{np.mean(r.inside):8.0%}"
        )
    if profile is not None:
        pstats.Stats(profile).sort_stats("tottime").print_stats(45)


if __name__ == "__main__":
    main()
