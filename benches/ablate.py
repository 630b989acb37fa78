"""The value of each mechanism of the tracker: every figure with it switched off.

    python benches/ablate.py [--workers N] [--hard | --tests] [MECHANISM ...]

Builds the core with the feature `ablation`, which is never shipped, and follows the same clips once
for every mechanism, with that one switched off. Mechanisms of the core are those of
`crates/fingerpost-core/src/numeric/ablation.rs`; those of Python are replaced by functions that do
nothing. The clips are simulated ones and those of the golden tracks, if their footage is there;
with `--hard`, the moving cases of `robustness.py`, two sequences each in grey and in colour. With
`--tests`, nothing is followed: the tests of the core's behaviour that fail without each mechanism.

The table is Markdown, for `docs/ablation.md`: availability; root mean square error in parts of
the plane; points inside their 95 % ellipse; points beyond three times their 99 % ellipse; time of
a step. The last two columns are the numbers of clips whose error
grew or shrank by more than 2 %, and the probability of signs as uneven by chance (sign test, Dixon
& Mood 1946).
"""

from __future__ import annotations

import argparse
import json
import math
import os
import pkgutil
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
ABLATION = ROOT / "crates" / "fingerpost-core" / "src" / "numeric" / "ablation.rs"
CHI2_95, CHI2_99 = 5.991, 9.210
MAT_SIGMA = 0.02
"""Standard error of the reference of `mat`, in sides of the mat: see `benches/mat.py`."""

CHANGED = 0.02
SEEDS = range(3)
HARD_SEQUENCES = range(2)
FRAMES = "FINGERPOST_FRAMES"
"""Environment variable with the folder of rendered frames."""


@dataclass(frozen=True)
class Figures:
    """Sums over the frames of a clip whose true point is known."""

    frames: int
    points: int
    square: float
    held: int
    wrong: int
    steps_s: float
    steps: int


def mechanisms() -> list[str]:
    """Names of all mechanisms: the core's, and those of Python."""
    text = ABLATION.read_text().partition("enum Mechanism {")[2].partition("}")[0]
    return [*re.findall(r"^    (\w+),$", text, re.MULTILINE), *PYTHON]


# --- mechanisms of Python -------------------------------------------------------------------------


def _nothing(*_: object, **__: object) -> None:
    """Do nothing."""


def _replaced(place: str, name: str, value: Callable[..., Any] = _nothing) -> Callable[[], None]:
    """Return a function that replaces a name of a module or of one of its classes."""

    def switch() -> None:
        found = pkgutil.resolve_name(f"fingerpost.{place}")
        assert hasattr(found, name), name
        setattr(found, name, value)

    return switch


PYTHON: dict[str, Callable[[], None]] = {
    "compare_widths": _replaced("pipeline", "compare_widths"),
    "compare_lengths": _replaced("pipeline", "compare_lengths"),
    "other_fingers": _replaced("pipeline", "other_fingers", lambda *_, **__: {}),
    "test_flanks": _replaced("finding:HandView", "test_flanks"),
    "test_tip": _replaced("finding:HandView", "test_tip"),
    "is_stripe": _replaced("finding.trial", "is_stripe", lambda *_: False),
    "SearchRest": _replaced(
        "pipeline", "SearchRest", lambda: SimpleNamespace(update=lambda *_: False)
    ),
    "validate": _replaced("finding:HandView", "validate", lambda *_: True),
    "update_from_other_views": _replaced("finding:HandView", "update_from_other_views"),
}

# --- clips ----------------------------------------------------------------------------------------


def clips() -> Iterator[tuple[str, Any, dict[int, np.ndarray], float, float]]:
    """Yield name, clip, true points, size of the plane and standard deviation of the truth."""
    sys.path.insert(0, str(ROOT / "tests" / "golden"))
    import generate_tracks as golden

    from fingerpost.simulate import (
        Background,
        Hand,
        Sensor,
        SimulatedRig,
        figure_eight,
        pointing_session,
    )
    from fingerpost.simulated_rig_file import rig_from_simulation

    for seed in SEEDS:
        for channels in ("grey", "bgr"):
            rig = SimulatedRig(
                golden.SMALL,
                device=Hand(),
                background=Background(texture="wood", clutter=15.0 + 10.0 * seed, seed=seed),
                sensor=Sensor(channels=channels),
            )
            path = figure_eight(rig.workspace, hover_mm=80.0 + 20.0 * seed)[2 * seed : 2 * seed + 8]
            motion = pointing_session(path, entry_mm=golden.COMES_FROM_MM, wait_s=0.3)
            begins_s = golden.COMES_FROM_MM / 600.0 - 0.3
            truth = {}
            for k in range(golden.FRAMES):
                point = rig.truth(motion, time_s=begins_s + k / golden.FPS).indicated_mm
                if point is not None and np.isfinite(point).all():
                    truth[k] = np.asarray(point)
            clip = golden.Clip(rig_from_simulation(rig), golden._rendered(rig, motion))
            yield f"simulated {channels} {seed}", clip, truth, 400.0, 0.0
    data = golden.DATA
    if not data.is_dir():
        return
    for name in ("desk", "device"):
        frames = json.loads((data / name / "truth.json").read_text())["frames"]
        points = [400.0 * np.array(frame["finger"]["geo"]["wp"]) for frame in frames]
        if name == "desk":
            known = dict(enumerate(points))
            for clip in ("desk", "desk-found", "desk-grey-found", "desk-moving"):
                yield clip, golden.FOOTAGE[clip](), known, 400.0, 0.0
        else:
            for clip, pose in (("device", 3), ("device-found", 11)):
                yield (
                    clip,
                    golden.FOOTAGE[clip](),
                    dict.fromkeys(range(25), points[pose]),
                    400.0,
                    0.0,
                )
    import mat

    known = {k: one.point for k, one in mat.read_points(data / "mat").items()}
    for clip in ("mat", "mat-found", "mat-grey"):
        yield clip, golden.FOOTAGE[clip](), known, 1.0, MAT_SIGMA


def measure_hard() -> dict[str, Figures]:
    """Play the hard cases of `robustness.py`; return the figures of each sequence."""
    from robustness import CASES, PLANE_MM, configured, footage, steps_of

    found = {}
    for case, channels, index in product(CASES, ("grey", "bgr"), HARD_SEQUENCES):
        rng = np.random.default_rng([0, index])
        play = CASES[case].play(rng, channels)
        rig = configured(play, rng)
        frames = stored(f"{len(found)}.npz", lambda play=play, rng=rng: footage(play, rng))
        begun_s = time.process_time()
        judged = [j for k, _, j in steps_of(play, rig, frames) if k >= play.judged_from]
        steps_s = time.process_time() - begun_s
        reported = [j for j in judged if math.isfinite(j.error_mm)]
        found[f"{case} {channels} {index}"] = Figures(
            frames=len(judged),
            points=len(reported),
            square=sum((j.error_mm / PLANE_MM) ** 2 for j in reported),
            held=sum(j.mahalanobis2 <= CHI2_95 for j in reported),
            wrong=sum(j.mahalanobis2 > 9.0 * CHI2_99 for j in reported),
            steps_s=steps_s,
            steps=play.frames,
        )
    return found


def stored(name: str, make: Callable[[], Iterable[list[Any]]]) -> list[list[Any]]:
    """Return the frames of a sequence from the folder of all runs; the first run renders them."""
    from fingerpost.capture import Frame

    path = Path(os.environ[FRAMES]) / name
    if not path.exists():
        rendered = list(make())
        images = np.array([[frame.image for frame in together] for together in rendered])
        times_s = np.array([[frame.time_s for frame in together] for together in rendered])
        np.savez(path, images=images, times_s=times_s)
        return rendered
    kept = np.load(path)
    return [
        [Frame(k, float(t), image) for t, image in zip(times_s, images, strict=True)]
        for k, (times_s, images) in enumerate(zip(kept["times_s"], kept["images"], strict=True))
    ]


def measure() -> dict[str, Figures]:
    """Track the hand in every clip; return its figures."""
    from fingerpost.pipeline import Pointer
    from fingerpost.pointing import Status

    found = {}
    for name, clip, truth, size, sigma in clips():
        pointer = Pointer(clip.rig, **clip.options)
        points, square, held, wrong, steps_s, count = 0, 0.0, 0, 0, 0.0, 0
        together = list(clip.frames)
        for k, frames in enumerate([*together, None]):
            begun_s = time.process_time()
            steps = pointer.finish() if frames is None else pointer.update(frames)
            steps_s += time.process_time() - begun_s
            count += k < len(together)
            for step in steps:
                fix = step.fix
                if step.index not in truth or fix.status is not Status.OK:
                    continue
                assert fix.point is not None
                assert fix.covariance is not None
                error = fix.point - truth[step.index]
                covariance = fix.covariance + sigma**2 * np.eye(2)
                chi2 = float(error @ np.linalg.solve(covariance, error))
                points += 1
                square += float(error @ error) / size**2
                held += chi2 <= CHI2_95
                wrong += chi2 > 9.0 * CHI2_99
        wanted = sum(k < len(together) for k in truth)
        found[name] = Figures(wanted, points, square, held, wrong, steps_s, count)
    return found


# --- tests ----------------------------------------------------------------------------------------


def failing_tests(off: str) -> set[str]:
    """Return the tests of the core's behaviour that fail with one mechanism off; "" for none."""
    environment = {
        **os.environ,
        "CARGO_TARGET_DIR": str(ROOT / "target" / "ablation"),
        "FINGERPOST_OFF": off,
    }
    # A mechanism's own tests say nothing.
    tests = ["--package", "fingerpost-core", "--features", "ablation", "--test", "suite"]
    cargo = ["cargo", "test", "--locked", "--quiet", *tests]
    subprocess.run([*cargo, "--no-run"], cwd=ROOT, env=environment, check=True)
    done = subprocess.run(
        cargo, cwd=ROOT, env=environment, check=False, capture_output=True, text=True
    )
    return set(re.findall(r"^([\w:]+) --- FAILED$", done.stdout, re.MULTILINE))


def print_failing_tests(chosen: Iterable[str]) -> None:
    """Print the tests that only fail without each mechanism; those of Python are left out."""
    always = failing_tests("")  # those of allocations: the feature reads the environment
    print("| switched off | tests that fail |\n|---|---|", flush=True)
    for name in chosen:
        fails = sorted(test.partition("::")[2] for test in failing_tests(name) - always)
        print(f"| {name} | {', '.join(f'`{test}`' for test in fails) or 'none'} |", flush=True)


# --- the table ------------------------------------------------------------------------------------


def built(folder: Path) -> Path:
    """Build the core with the feature into a copy of the package; return the copy's folder."""
    target = ROOT / "target" / "ablation"
    environment = {**os.environ, "CARGO_TARGET_DIR": str(target), "PYO3_PYTHON": sys.executable}
    cargo = ["cargo", "build", "--locked", "--quiet", "--release"]
    options = ["--package", "fingerpost-py", "--features", "ablation"]
    subprocess.run([*cargo, *options], cwd=ROOT, env=environment, check=True)
    shutil.copytree(ROOT / "python" / "fingerpost", folder / "fingerpost")
    shutil.copy(target / "release" / "lib_core.so", folder / "fingerpost" / "_core.abi3.so")
    return folder


def run(package: Path, off: str, *options: str) -> dict[str, Figures]:
    """Measure in a process of its own with one mechanism switched off; "" stands for none."""
    command = [sys.executable, __file__, *options, "--measure", off]
    environment = {
        **os.environ,
        "PYTHONPATH": str(package),
        "FINGERPOST_OFF": off,
        FRAMES: str(package / FRAMES),
    }
    done = subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
    return {name: Figures(**row) for name, row in json.loads(done.stdout).items()}


def sign_test(more: int, less: int) -> float:
    """Return the probability of signs at least as uneven by chance."""
    count = more + less
    tail = sum(math.comb(count, k) for k in range(min(more, less) + 1)) / 2**count
    return min(1.0, 2.0 * tail)


def row(name: str, figures: dict[str, Figures], base: dict[str, Figures]) -> str:
    """Return one line of the table."""
    total = {
        key: sum(getattr(one, key) for one in figures.values()) for key in Figures.__annotations__
    }
    rms = {
        clip: [math.sqrt(one.square / one.points) for one in (figures[clip], base[clip])]
        for clip in figures
        if figures[clip].points and base[clip].points
    }
    more = sum(off > (1.0 + CHANGED) * on for off, on in rms.values())
    less = sum(off < (1.0 - CHANGED) * on for off, on in rms.values())
    points = max(total["points"], 1)
    return (
        f"| {name} | {100 * total['points'] / total['frames']:.1f} | "
        f"{100 * math.sqrt(total['square'] / points):.2f} | {100 * total['held'] / points:.1f} | "
        f"{total['wrong']} | {1000 * total['steps_s'] / total['steps']:.1f} | "
        f"{more} + / {less} − | {sign_test(more, less):.2f} |"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("mechanisms", nargs="*", help="those to switch off; all by default")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    kind = parser.add_mutually_exclusive_group()
    kind.add_argument("--hard", action="store_true", help="the hard cases of robustness.py")
    kind.add_argument("--tests", action="store_true", help="the core's tests that fail instead")
    parser.add_argument("--measure", help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.measure is not None:
        if asked.measure in PYTHON:
            PYTHON[asked.measure]()
        found = measure_hard() if asked.hard else measure()
        print(json.dumps({name: asdict(figures) for name, figures in found.items()}))
        return
    chosen = asked.mechanisms or mechanisms()
    if asked.tests:
        print_failing_tests(name for name in chosen if name not in PYTHON)
        return
    options = ["--hard"] if asked.hard else []
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(asked.workers) as pool:
        package = built(Path(folder))
        (package / FRAMES).mkdir()
        base = run(package, "", *options)
        print("| switched off | available % | RMS % | held % | wrong | ms | error by clip | p |")
        print("|---|---|---|---|---|---|---|---|")
        print(row("nothing", base, base), flush=True)
        measured = pool.map(lambda name: run(package, name, *options), chosen)
        for name, figures in zip(chosen, measured, strict=True):
            print(row(name, figures, base), flush=True)


if __name__ == "__main__":
    main()
