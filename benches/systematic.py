"""What is left of the error when noise and the rounding to 8 bits average out.

    python benches/systematic.py [--targets 60] [--repeats 64]

A picture without noise is rounded alike wherever its levels are alike, and that alone moves a
point by some hundredths of a millimetre. A little noise makes the rounding random: the mean over
many repetitions of one pose tells what is wrong with every one of them. Reference points are
exact. Each row is a rig: the paper's, and webcams at 75 cm without and with a lens that is told.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial

import numpy as np

from fingerpost.experiment import ExperimentOptions
from fingerpost.experiment.bench import Bench
from fingerpost.simulate import Placement, Sensor

WEBCAMS = partial(Placement, distance_m=0.75, f_px=622.0)
RIGS = {
    "the paper's rig, uniform finger": {"taper": 0.0},
    "the paper's rig, taper 10 %": {},
    "close webcams without a lens": {"cameras": WEBCAMS()},
    "close webcams, k1 = -0.2 told": {"cameras": WEBCAMS(k1=(-0.2,))},
}
# As much as makes the rounding of neighbours independent of each other, and no more.
NOISE_GREY = 0.5
_SHARES = 16


def main() -> None:
    """Print a row for every rig."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--targets", type=int, default=60)
    parser.add_argument("--repeats", type=int, default=64)
    asked = parser.parse_args()
    if asked.targets < 1 or asked.repeats < 2:
        parser.error("at least 1 target and 2 repeats are needed")
    for name, rig in RIGS.items():
        options = ExperimentOptions(
            targets=asked.targets, reference_noise_px=0.0, sensor=Sensor(noise=NOISE_GREY), **rig
        )
        squares = squared_bias(options, asked.repeats)
        rms_mm = np.sqrt(max(squares.mean(), 0.0))
        median_mm = np.sqrt(max(np.median(squares), 0.0))
        share = 100.0 * rms_mm / Bench(options).plane_size
        print(f"{name}: systematic RMS {rms_mm:.4f} mm ({share:.4f} %), median {median_mm:.4f} mm")


def squared_bias(options: ExperimentOptions, repeats: int) -> np.ndarray:
    """Return the squared systematic error of each target [mm²], unbiased: some are below zero."""
    shares = [range(k, options.targets, _SHARES) for k in range(_SHARES)]
    with ProcessPoolExecutor() as pool:
        parts = pool.map(partial(_squared_bias, options, repeats), shares)
        return np.array([square for part in parts for square in part])


def _squared_bias(options: ExperimentOptions, repeats: int, share: Sequence[int]) -> list[float]:
    bench = Bench(options)
    squares = []
    for index in share:
        trials = [bench.trial(index, repeat) for repeat in range(repeats)]
        errors = np.array([t.point - t.target for t in trials if t.point is not None])
        if len(errors) < 2:
            continue
        of_the_mean = errors.var(axis=0, ddof=1).sum() / len(errors)
        squares.append(float((errors.mean(axis=0) ** 2).sum() - of_the_mean))
    return squares


if __name__ == "__main__":
    main()
