"""Accuracy and availability of the pointer in hard cases, in simulation, with goals.

    python benches/robustness.py [CASE ...] [--sequences 40] [--seed 0] [--workers 1] [--colour]

Each case is played `--sequences` times with different poses, paths and noise; `--workers 0` uses
all cores. *Available* is the fraction of frames in full view, or of targets, with a point. A
*gross* error is beyond 5 % of the plane; RMS excludes gross errors. A point is *wrong* if its error
exceeds three times its 99 % ellipse. If several hands point, a point is compared with the hand that
is followed: the first, until it is out of full view. A sequence is *lost* if its last frames have
no point, or only gross errors. A hand is *back* if a point without a gross error is reported within
0.3 s of the first frame that shows its whole finger in every view, after one that did not.

With `--colour` the cameras are colour cameras, like most webcams.

In the first cases a device is static, with ten targets for each sequence: before clutter, as in
`fingerpost experiment --clutter 50 --reference-noise 0.05`, without and with `--background-frames
40`, and before a clean table with displaced start poses. In the others the start pose of each view
lies where the hand comes.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Literal

import numpy as np

from fingerpost.capture import Frame
from fingerpost.config import Rig
from fingerpost.experiment import ExperimentOptions, run_experiment
from fingerpost.experiment.trial import squared_in_sigmas
from fingerpost.pipeline import Pointer, Step
from fingerpost.pointing import BARE_HAND, Fix, PointingOptions, Status
from fingerpost.simulate import (
    Background,
    DevicePose,
    Hand,
    LightChange,
    Lighting,
    PointingDevice,
    PoseLimits,
    PoseSampler,
    RodAndProng,
    Sensor,
    SimulatedRig,
    StartError,
    Trajectory,
    pointing_session,
)
from fingerpost.simulate.motion import Motion
from fingerpost.simulated_rig_file import rig_from_simulation
from fingerpost.workers import sharing, worker_count

FPS = 30.0
PLANE_MM = 400.0
GROSS_MM = 0.05 * PLANE_MM
BACK_WITHIN_S = 0.3
LATE_FRAMES = 5
# Targets of a static device for every sequence of a moving one.
TARGETS = 10
CHI2_99 = 9.210
REFERENCE_NOISE_PX = 0.05
CLUTTER = Background(clutter=50)
WOOD = Background(texture="wood", clutter=15)

Channels = Literal["grey", "bgr"]


@dataclass(frozen=True)
class Play:
    """One sequence: the rig, the motions of the hand and of others, and the frames that count."""

    rig: SimulatedRig
    motion: Motion
    frames: int
    options: PointingOptions
    others: tuple[tuple[PointingDevice, Motion], ...] = ()
    # Fraction of the contour that discs cover from the first judged frame on.
    covered: float = 0.0
    judged_from: int = 0


@dataclass(frozen=True)
class Judged:
    """The point of one frame compared with the truth; NaN without a point.

    `in_view` is whether the whole finger of a hand is in every view.
    """

    error_mm: float
    mahalanobis2: float
    in_view: bool


@dataclass
class Result:
    """The judged frames of one sequence, and for each return of a hand whether it was in time."""

    judged: list[Judged] = field(default_factory=list)
    returns: list[bool] = field(default_factory=list)


@dataclass(frozen=True)
class Case:
    """A hard case, and its goal in words."""

    goal: str
    play: Callable[[np.random.Generator, Channels], Play]


def drawn(
    rng: np.random.Generator, rig: SimulatedRig, travel_mm: float, turn_deg: float = 15.0
) -> list[DevicePose]:
    """Draw two poses at a distance of `travel_mm` on the plane, in good view of every camera."""
    sampler = PoseSampler(rig, PoseLimits(azimuth_deg=(-60.0, 60.0), hover_mm=(60.0, 180.0)))
    while True:
        first = sampler.draw(rng)
        heading = rng.uniform(0, math.tau)
        assert first.indicated_mm is not None
        last = DevicePose.pointing_at(
            first.indicated_mm + travel_mm * np.array([math.cos(heading), math.sin(heading)]),
            hover_mm=first.tip_mm[2],
            azimuth_deg=first.azimuth_deg + rng.uniform(-turn_deg, turn_deg),
            slant_deg=first.slant_deg,
        )
        if sampler.accepts(last):
            return [first, last]


def fast(rng: np.random.Generator, channels: Channels) -> Play:
    """Move the device to and fro at 0.8 m/s over clutter without a learned background."""
    clutter = replace(CLUTTER, seed=int(rng.integers(1 << 31)))
    rig = SimulatedRig(background=clutter, sensor=Sensor(channels=channels))
    first, last = drawn(rng, rig, 160.0)
    path = Trajectory.hold(first, 0.4).then(
        Trajectory.through([first, last], 0.8).then(Trajectory.through([last, first], 0.8))
    )
    path = path.then(Trajectory.hold(first, 0.2))
    return Play(rig, path, math.ceil(path.duration_s * FPS), PointingOptions())


def occluded(rng: np.random.Generator, channels: Channels, *, background: Background) -> Play:
    """Cover 30 % of the contour of a device nearly at rest by discs, suddenly and to the end."""
    rig = SimulatedRig(background=background, sensor=Sensor(channels=channels))
    poses = drawn(rng, rig, 20.0)
    path = Trajectory.hold(poses[0], 0.4).then(Trajectory.through(poses, 0.02))
    return Play(rig, path, 27, PointingOptions(), covered=0.3, judged_from=12)


def bar(rng: np.random.Generator, channels: Channels) -> Play:
    """Move a bar across the pointing finger; it covers about 30 % of the contour."""
    across = RodAndProng(length_mm=140.0, diameter_mm=26.0, prong_length_mm=0.0)
    return drawn_over(rng, channels, across)


def pen(rng: np.random.Generator, channels: Channels) -> Play:
    """Move a pen across the pointing finger."""
    across = RodAndProng(length_mm=140.0, diameter_mm=8.0, prong_length_mm=0.0)
    return drawn_over(rng, channels, across)


def drawn_over(rng: np.random.Generator, channels: Channels, device: RodAndProng) -> Play:
    """Move an object as bright as the finger across it."""
    rig = SimulatedRig(background=WOOD, device=Hand(), sensor=Sensor(channels=channels))
    first, last = drawn(rng, rig, 40.0)
    crossing = np.array(first.tip_mm) - 40.0 * first.direction + np.array([0, 0, 30.0])
    lateral = np.array([-first.direction[1], first.direction[0], 0.0]) * rng.choice([-1.0, 1.0])
    over = [
        DevicePose(tuple(crossing + lateral * s), first.azimuth_deg + 60.0, 20.0)
        for s in (-160.0, 160.0)
    ]
    away = DevicePose((0.0, 5000.0, 100.0), 0.0, 20.0)
    pen_path = Delayed(Trajectory.through(over, 0.2), 0.4, away)
    path = Trajectory.hold(first, 0.4).then(Trajectory.through([first, last], 0.05))
    return Play(rig, path, 60, BARE_HAND, others=((device, pen_path),), judged_from=12)


@dataclass(frozen=True)
class Delayed:
    """A motion that begins at `start_s`; before and after it, the device is at `elsewhere`."""

    motion: Trajectory
    start_s: float
    elsewhere: DevicePose

    def pose_at(self, time_s: float) -> DevicePose:
        """Return the pose at a time [s]."""
        if self.start_s <= time_s <= self.start_s + self.motion.duration_s:
            return self.motion.pose_at(time_s - self.start_s)
        return self.elsewhere


def session(
    rng: np.random.Generator,
    channels: Channels,
    *,
    device: Hand | None = None,
    change: LightChange | None = None,
    second: bool = False,
) -> Play:
    """Let a hand come, point, leave and return, over a table that is empty at first."""
    rig = SimulatedRig(
        background=replace(WOOD, seed=int(rng.integers(1 << 31))),
        lighting=Lighting(shadow=0.3, side_light=0.2, limb_darkening=0.2, change=change),
        sensor=Sensor(channels=channels, cells_per_sigma=2),
        device=device or Hand(),
    )
    poses = drawn(rng, rig, 60.0)
    path = Trajectory.hold(poses[0].retreated(700.0), 0.5).then(
        pointing_session(
            poses, entry_speed_m_s=1.0, wait_s=0.4, away_s=0.3, entry_mm=700.0, speed_m_s=0.3
        )
    )
    others: tuple[tuple[PointingDevice, Motion], ...] = ()
    if second:
        other = drawn(rng, rig, 80.0)
        while np.hypot(*(np.array(other[0].tip_mm) - poses[0].tip_mm)[:2]) < 150.0:
            other = drawn(rng, rig, 80.0)
        others = ((Hand(side="left"), Delayed(pointing_session(other, away_s=0.2), 1.6, gone())),)
    return Play(rig, path, math.ceil(path.duration_s * FPS), BARE_HAND, others)


def gone() -> DevicePose:
    """Return a pose far behind the cameras."""
    return DevicePose((0.0, -9000.0, 300.0), 0.0, 20.0)


CASES: dict[str, Case] = {
    "0.8 m/s, clutter": Case("≤ 2 % lost", fast),
    "30 % occluded": Case("gross ≤ 1 %, RMS ≤ 2 mm", partial(occluded, background=Background())),
    "30 % occluded, clutter": Case(
        "gross ≤ 1 %, RMS ≤ 2 mm", partial(occluded, background=CLUTTER)
    ),
    "a bar over the finger": Case("gross ≤ 1 %, RMS ≤ 2 mm", bar),
    "a pen over the finger": Case("gross ≤ 1 %, RMS ≤ 2 mm", pen),
    "leaves and returns": Case("back ≥ 95 %, wrong ≤ 0.5 %", session),
    "light − 40 %, at once": Case(
        "back ≥ 95 %, wrong ≤ 0.5 %", partial(session, change=LightChange(1.9, 0.6))
    ),
    "light − 40 %, in 1 s": Case(
        "back ≥ 95 %, wrong ≤ 0.5 %", partial(session, change=LightChange(1.4, 0.6, 1.0))
    ),
    "sleeve": Case("back ≥ 95 %, wrong ≤ 0.5 %", partial(session, device=Hand(sleeve=True))),
    "second hand": Case("back ≥ 95 %, wrong ≤ 0.5 %", partial(session, second=True)),
}


@dataclass(frozen=True)
class Still:
    """A static device: its goal in words, and the options that differ from the defaults."""

    goal: str
    options: dict[str, Any]


def started(
    offset_px: float = 0.0, angle_deg: float = 0.0, scale: float = 1.0
) -> dict[str, tuple[float, float]]:
    """Return the options of start poses with exactly this error."""
    return {
        "start_offset_px": (offset_px, offset_px),
        "start_angle_deg": (angle_deg, angle_deg),
        "start_scale": (scale, scale),
    }


STILL: dict[str, Still] = {
    "clutter, not known": Still(
        "RMS ≤ 0.5 %, coverage ≥ 90 %, gross ≤ 1 %", {"background": CLUTTER}
    ),
    "clutter, learned": Still(
        "RMS ≤ 0.20 %, coverage ≥ 93 %, gross ≤ 0.5 %",
        {"background": CLUTTER, "background_frames": 40},
    ),
    "start 20 px off": Still("available ≥ 95 %", started(offset_px=20.0)),
    "start 30° off": Still("available ≥ 95 %", started(angle_deg=30.0)),
    "start 0.6 as long": Still("available ≥ 95 %", started(scale=0.6)),
    "start 1.4 as long": Still("available ≥ 95 %", started(scale=1.4)),
}


def configured(play: Play, rng: np.random.Generator) -> Rig:
    """Return the rig with small measuring errors, and start poses where the hand comes."""
    # Nine frames later, so that the finger is well in view.
    truths = (play.rig.truth(play.motion, time_s=(k + 9) / FPS) for k in range(play.frames))
    shown = next(
        t for t in truths if all(v.finger is not None and v.finger.in_view for v in t.views)
    )
    points_px, starts = [], []
    for view, exact_px in zip(shown.views, play.rig.reference_points_px, strict=True):
        assert view.finger is not None
        starts.append(view.finger.start(StartError(offset_px=5.0, angle_deg=5.0), rng))
        points_px.append(exact_px + rng.normal(0, REFERENCE_NOISE_PX, exact_px.shape))
    return rig_from_simulation(play.rig, reference_points_px=points_px, starts=starts)


class Hands:
    """The hands of a sequence, and the one that is followed."""

    def __init__(self, play: Play) -> None:
        self._play = play
        others = [(d, motion) for d, motion in play.others if isinstance(d, Hand)]
        self._pointing: list[tuple[PointingDevice | None, Motion]] = [(None, play.motion), *others]
        self._followed = 0

    def judge(self, fix: Fix, time_s: float) -> Judged:
        """Compare a fix with the hand that is followed.

        Once this hand has left the full view of any camera, another one may be followed, even
        before that one is in full view.
        """
        truths = [
            self._play.rig.truth(motion, time_s=time_s, device=device)
            for device, motion in self._pointing
        ]
        in_view = [
            all(v.finger is not None and v.finger.in_view for v in truth.views) for truth in truths
        ]
        allowed = [] if in_view[self._followed] else range(len(truths))
        nearest = Judged(math.nan, math.nan, any(in_view))
        for i in (self._followed, *allowed):
            target = truths[i].indicated_mm
            if fix.status is not Status.OK or fix.point is None or target is None:
                continue
            assert fix.covariance is not None
            error = fix.point - target
            error_mm = float(np.hypot(*error))
            if not nearest.error_mm <= error_mm:
                nearest = replace(
                    nearest,
                    error_mm=error_mm,
                    mahalanobis2=squared_in_sigmas(error, fix.covariance),
                )
                if error_mm <= GROSS_MM:
                    self._followed = i
        return nearest


def footage(play: Play, rng: np.random.Generator) -> Iterator[list[Frame]]:
    """Render the frames of a sequence."""
    covers = None
    for k in range(play.frames):
        time_s = k / FPS
        if play.covered and k == play.judged_from:
            pose = play.motion.pose_at(time_s)
            assert pose is not None
            covers = play.rig.occluders(pose, play.covered, rng)
        shot = play.rig.render(
            play.motion, time_s=time_s, rng=rng, others=play.others, occluders=covers
        )
        yield [
            Frame(k, view.time_s, image)
            for view, image in zip(shot.truth.views, shot.images, strict=True)
        ]


def steps_of(
    play: Play, rig: Rig, frames: Iterable[list[Frame]]
) -> Iterator[tuple[int, Step, Judged]]:
    """Play a sequence; yield each step of the pointer, compared with the truth."""
    pointer = Pointer(rig, pointing_options=play.options, reference_sigma_px=REFERENCE_NOISE_PX)
    hands = Hands(play)
    for k, together in enumerate(frames):
        for step in pointer.update(together):
            yield k, step, hands.judge(step.fix, k / FPS)


def played(case: str, seed: int, channels: Channels, index: int) -> Result:
    """Play one sequence of a case."""
    rng = np.random.default_rng([seed, index])
    play = CASES[case].play(rng, channels)
    result = Result()
    before, since = True, None
    rig = configured(play, rng)
    for k, _, judged in steps_of(play, rig, footage(play, rng)):
        if k >= play.judged_from:
            result.judged.append(judged)
        # A return starts with full view and is counted once: when the hand is back, or too late.
        if judged.in_view and not before:
            since = k
        if since is not None and judged.error_mm <= GROSS_MM:
            result.returns.append(True)
            since = None
        elif since is not None and (k - since) / FPS >= BACK_WITHIN_S:
            result.returns.append(False)
            since = None
        before = judged.in_view
    return result


def summary(results: Sequence[Result]) -> str:
    """Return the figures of a case in one line."""
    judged = [j for r in results for j in r.judged]
    error = np.array([j.error_mm for j in judged])
    m2 = np.array([j.mahalanobis2 for j in judged])
    in_view = np.array([j.in_view for j in judged])
    there = np.isfinite(error)
    gross = there & (error > GROSS_MM)
    fine = there & ~gross
    lost = sum(not any(j.error_mm <= GROSS_MM for j in r.judged[-LATE_FRAMES:]) for r in results)
    returns = [r for result in results for r in result.returns]
    rms = math.sqrt(np.mean(error[fine] ** 2)) if fine.any() else math.nan
    cells = [
        f"lost {lost:3d} of {len(results)}",
        f"available {100 * there[in_view].mean():5.1f} %",
        f"gross {100 * gross.sum() / max(there.sum(), 1):5.2f} %",
        f"RMS {rms:5.2f} mm",
        f"95 % holds {100 * np.mean(m2[there] <= 5.991):5.1f} %",
        f"wrong {100 * np.mean(there & (m2 > 9 * CHI2_99)):5.2f} %",
    ]
    if returns:
        cells.append(f"back {100 * np.mean(returns):5.1f} % of {len(returns)}")
    return "  ".join(cells)


def still_row(name: str, targets: int, seed: int, channels: Channels, workers: int | None) -> str:
    """Measure a static device, and return the figures in one line."""
    still = STILL[name]
    options = ExperimentOptions(
        targets=targets,
        seed=seed,
        sensor=Sensor(channels=channels),
        reference_noise_px=REFERENCE_NOISE_PX,
        **still.options,
    )
    trials = run_experiment(options, workers=workers).trials
    error = np.array([t.error for t in trials])
    m2 = np.array([t.mahalanobis2 for t in trials])
    there = np.isfinite(error)
    fine = there & (error <= GROSS_MM)
    rms = 100 * math.sqrt(np.mean(error[fine] ** 2)) / PLANE_MM if fine.any() else math.nan
    return (
        f"available {100 * there.mean():5.1f} %  "
        f"gross {100 * (there & ~fine).sum() / max(there.sum(), 1):5.2f} %  "
        f"RMS {rms:5.3f} % of the plane  "
        f"95 % holds {100 * np.mean(m2[there] <= 5.991):5.1f} %  [{still.goal}]"
    )


def main() -> None:
    """Print one line per case."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument(
        "cases",
        nargs="*",
        metavar="CASE",
        help="; ".join([*STILL, *CASES]).replace("%", "%%"),
    )
    parser.add_argument("--sequences", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=1, help="0: one for each core")
    parser.add_argument("--colour", action="store_true", help="cameras that show colours")
    given = parser.parse_args()
    channels: Channels = "bgr" if given.colour else "grey"
    for name, least in (("sequences", 1), ("seed", 0), ("workers", 0)):
        if getattr(given, name) < least:
            parser.error(f"--{name} is {getattr(given, name)}; {least} or more is right")
    workers = worker_count(given.workers or None)
    known = [*STILL, *CASES]
    unknown = set(given.cases) - set(known)
    if unknown:
        parser.error(f"no case {'; '.join(sorted(unknown))}; there are: {'; '.join(known)}")
    wanted = given.cases or known
    for name in filter(STILL.__contains__, wanted):
        row = still_row(name, TARGETS * given.sequences, given.seed, channels, workers)
        print(f"{name:24} {row}", flush=True)
    with sharing(workers) as pool:
        for name in filter(CASES.__contains__, wanted):
            play = partial(played, name, given.seed, channels)
            results = list(pool.map(play, range(given.sequences)))
            print(f"{name:24} {summary(results)}  [{CASES[name].goal}]", flush=True)


if __name__ == "__main__":
    main()
