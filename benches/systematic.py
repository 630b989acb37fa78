"""Systematic error: the mean over noise and over the rounding to 8 bits.

    python benches/systematic.py [--targets 60] [--pairs 32] [--rig uniform]

In a picture without noise, equal levels have equal rounding errors; these alone move a point by
some hundredths of a millimetre. A little noise makes the rounding random, and the mean over many
repetitions of one pose is the systematic error. The repetitions come in pairs with noise of
opposite sign. In the mean of a pair, the error in proportion to the noise cancels, so a pair is as
effective as ten repetitions. Reference points are exact. Each row is a rig: the paper's, and
webcams at 75 cm without a lens and with a known one.

The standard error of the mean falls with the root of the number of pairs, and a few poses have most
of it. Each row therefore gives the upper bound at two standard errors.
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
    "close webcams, k1 = -0.2 known": {"cameras": WEBCAMS(k1=(-0.2,))},
}
# The least noise that makes the rounding errors of neighbours independent.
NOISE_GREY = 0.5
_SHARES = 16


def main() -> None:
    """Print a row for every rig."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--targets", type=int, default=60)
    parser.add_argument("--pairs", type=int, default=32)
    parser.add_argument("--rig", default="", help="only the rigs whose name holds this")
    asked = parser.parse_args()
    if asked.targets < 1 or asked.pairs < 2:
        parser.error("at least 1 target and 2 pairs are needed")
    rigs = {name: rig for name, rig in RIGS.items() if asked.rig in name}
    if not rigs:
        parser.error(f"no rig is named like {asked.rig!r}; there are: {'; '.join(RIGS)}")
    for name, rig in rigs.items():
        options = ExperimentOptions(
            targets=asked.targets, reference_noise_px=0.0, sensor=Sensor(noise=NOISE_GREY), **rig
        )
        squares, variances = squared_bias(options, asked.pairs).T
        if not len(squares):
            print(f"{name}: no target has a point in two pairs")
            continue
        reach = squares.mean() + 2.0 * np.sqrt(variances.sum()) / len(squares)
        rms_mm, reach_mm, median_mm = np.sqrt(
            np.maximum([squares.mean(), reach, np.median(squares)], 0.0)
        )
        percent = 100.0 / Bench(options).plane_size
        print(
            f"{name}: systematic RMS {rms_mm:.4f} mm ({percent * rms_mm:.4f} %), two standard "
            f"errors reach {reach_mm:.4f} mm ({percent * reach_mm:.4f} %), median "
            f"{median_mm:.4f} mm",
            flush=True,
        )


def squared_bias(options: ExperimentOptions, pairs: int) -> np.ndarray:
    """Return the squared systematic error [mm²] of each target with a point, and its variance.

    Returns
    -------
    (N, 2)
        The first column is unbiased, so it can be negative; the second is rather too large.
    """
    shares = [range(k, options.targets, _SHARES) for k in range(_SHARES)]
    with ProcessPoolExecutor() as pool:
        parts = pool.map(partial(_squared_bias, options, pairs), shares)
        return np.array([row for part in parts for row in part]).reshape(-1, 2)


def _squared_bias(
    options: ExperimentOptions, pairs: int, share: Sequence[int]
) -> list[tuple[float, float]]:
    bench = Bench(options)
    rows = []
    for index in share:
        repeats = [_errors_of_pair(bench, index, repeat) for repeat in range(pairs)]
        errors = np.array([np.mean(both, axis=0) for both in repeats if len(both) == 2])
        if len(errors) < 2:
            continue
        mean = errors.mean(axis=0)
        of_the_mean = np.cov(errors.T) / len(errors)
        square = float(mean @ mean - np.trace(of_the_mean))
        # Variance of |m + e|² for a normal e: 4 m'Cm + 2 tr C². The contribution of the noise to
        # m'Cm is subtracted; by chance it may exceed m'Cm.
        noise = float(np.sum(of_the_mean**2))
        variance = 4.0 * max(float(mean @ of_the_mean @ mean) - noise, 0.0) + 2.0 * noise
        rows.append((square, variance))
    return rows


def _errors_of_pair(bench: Bench, index: int, repeat: int) -> list[np.ndarray]:
    trials = [bench.trial(index, repeat, mirrored=mirrored) for mirrored in (False, True)]
    return [t.point - t.target for t in trials if t.point is not None]


if __name__ == "__main__":
    main()
