"""Golden data for the B-splines of fingerpost-core, from SciPy.

    python tests/golden/generate_bspline.py     # writes bspline.json beside itself

Inputs are rounded, results are not. Of every curve: the design matrix, positions and two
derivatives at parameters that include every knot (derivatives from the right) and, if the curve is
closed, some outside the domain; its length and the parameters at equal arc length. Of every fit:
the control points, by QR of the whole design matrix (open), by FITPACK's `clocur` (closed, simple
knots) and by the singular value decomposition of the folded design matrix (closed, repeated knots).
"""

import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import quad
from scipy.interpolate import BSpline, make_lsq_spline, splprep
from scipy.optimize import brentq

Array = NDArray[np.float64]

SEED = 1994
EQUAL_ARC_SAMPLES = 9

# Open: the whole knot vector. Closed: the knots of one period.
KNOTS: dict[str, tuple[int, bool, list[float]]] = {
    "open quadratic uniform": (2, False, [0, 0, 0, 1, 2, 3, 4, 4, 4]),
    "open cubic uniform": (3, False, [0, 0, 0, 0, 1, 2, 3, 4, 5, 5, 5, 5]),
    "open quadratic corner": (2, False, [-1, -1, -1, 0.25, 0.5, 0.5, 2, 3.5, 3.5, 3.5]),
    "open cubic corner": (3, False, [0, 0, 0, 0, 0.3, 1, 1, 1, 1.7, 2.1, 2.1, 4, 4, 4, 4]),
    "open cubic one span": (3, False, [2, 2, 2, 2, 3, 3, 3, 3]),
    "open cubic not clamped": (3, False, [0, 1, 1.5, 2, 3, 5, 6, 7.25, 8, 9]),
    "closed quadratic uniform": (2, True, [0, 1, 2, 3, 4, 5, 6]),
    "closed cubic uniform": (3, True, [0, 1, 2, 3, 4, 5, 6, 7]),
    "closed cubic uneven": (3, True, [-0.5, 0, 0.8, 1, 2.5, 3, 4.5, 5]),
    "closed quadratic corner": (2, True, [0, 0.5, 1, 1, 2, 3, 3.5]),
    "closed cubic corner at the seam": (3, True, [0, 0, 1, 2, 2.5, 4, 5, 5]),
    "closed cubic fewest": (3, True, [0, 1, 2.5, 3, 4]),
}


def curve(degree: int, closed: bool, knots: Array, control_points: Array) -> BSpline:
    """The SciPy spline; a closed one on periodically continued knots and control points."""
    if not closed:
        return BSpline(knots, control_points, degree)
    period = knots[-1] - knots[0]
    knots = np.r_[knots[-degree - 1 : -1] - period, knots, knots[1 : degree + 1] + period]
    control_points = np.r_[control_points, control_points[:degree]]
    return BSpline(knots, control_points, degree, extrapolate="periodic")


def domain(spline: BSpline) -> tuple[float, float]:
    return float(spline.t[spline.k]), float(spline.t[-spline.k - 1])


def design_matrix(spline: BSpline, parameters: Array, count: int) -> Array:
    """One column per control point: those that continue a closed curve are folded back."""
    start, end = domain(spline)
    if spline.extrapolate == "periodic":
        parameters = start + (parameters - start) % (end - start)
    whole = BSpline.design_matrix(parameters, spline.t, spline.k).toarray()
    folded = whole[:, :count].copy()
    folded[:, : whole.shape[1] - count] += whole[:, count:]
    return folded


def arc_length(spline: BSpline, end: float) -> float:
    """The length from the start of the domain, integrated span by span."""
    velocity = spline.derivative()
    start = domain(spline)[0]
    breaks = np.unique(np.clip(spline.t, start, end))
    lengths = (
        quad(lambda t: np.hypot(*velocity(t)), a, b, epsabs=1e-14, epsrel=1e-13, limit=400)[0]
        for a, b in pairwise(breaks)
    )
    return float(sum(lengths))


def golden_curve(
    rng: np.random.Generator, name: str, degree: int, closed: bool, knots: Array
) -> dict[str, Any]:
    count = len(knots) - 1 if closed else len(knots) - degree - 1
    control_points = rng.uniform(-1, 1, (count, 2)).round(6)
    spline = curve(degree, closed, knots, control_points)
    start, end = domain(spline)

    inner_knots = np.unique(knots[(knots >= start) & (knots < end)])
    parameters = np.r_[inner_knots, rng.uniform(start, end, 8).round(6)]
    around = start + (end - start) * np.array([-1.37, 1.0, 1.81, 5.03])
    parameters = np.r_[parameters, around.round(6) if closed else end]

    total = arc_length(spline, end)
    steps = EQUAL_ARC_SAMPLES if closed else EQUAL_ARC_SAMPLES - 1
    inner_lengths = [total * i / steps for i in range(1, min(steps, EQUAL_ARC_SAMPLES))]
    equal_arc = [
        brentq(lambda t, s=s: arc_length(spline, t) - s, start, end, xtol=1e-13)
        for s in inner_lengths
    ]
    return {
        "name": name,
        "degree": degree,
        "closed": closed,
        "knots": knots.tolist(),
        "control_points": control_points.tolist(),
        "parameters": parameters.tolist(),
        "basis": design_matrix(spline, parameters, count).tolist(),
        "positions": spline(parameters).tolist(),
        "first_derivatives": spline(parameters, 1).tolist(),
        "second_derivatives": spline(parameters, 2).tolist(),
        "length": total,
        "equal_arc": [start, *equal_arc] if closed else [start, *equal_arc, end],
    }


def golden_fit(
    rng: np.random.Generator, name: str, degree: int, closed: bool, knots: Array
) -> dict[str, Any]:
    count = len(knots) - 1 if closed else len(knots) - degree - 1
    spline = curve(degree, closed, knots, np.zeros((count, 2)))
    start, end = domain(spline)
    parameters = np.linspace(start, end, 6 * count, endpoint=not closed).round(6)
    angles = 2 * np.pi * (parameters - start) / (end - start)
    outline = np.c_[np.cos(angles), np.sin(angles) + 0.3 * np.cos(3 * angles)]
    outline = (outline + rng.normal(0, 0.05, outline.shape)).round(6)

    if not closed:
        fitted = make_lsq_spline(parameters, outline, spline.t, degree, method="qr").c
    elif np.all(np.diff(knots) > 0):
        x, y = np.r_[outline, outline[:1]].T  # FITPACK wants the first point again at the end
        (_, coefficients, _), _ = splprep(
            [x, y], u=np.r_[parameters, end], k=degree, task=-1, t=spline.t, per=1
        )
        fitted = np.transpose(coefficients)[:count]
    else:
        fitted = np.linalg.lstsq(design_matrix(spline, parameters, count), outline)[0]
    return {
        "name": name,
        "degree": degree,
        "closed": closed,
        "knots": knots.tolist(),
        "parameters": parameters.tolist(),
        "outline": outline.tolist(),
        "control_points": fitted.tolist(),
    }


def main() -> None:
    rng = np.random.default_rng(SEED)
    cases = [(name, k, c, np.array(t, float)) for name, (k, c, t) in KNOTS.items()]
    golden = {
        "curves": [golden_curve(rng, *case) for case in cases],
        "fits": [golden_fit(rng, *case) for case in cases],
    }
    target = Path(__file__).with_name("bspline.json")
    lists = {key: [json.dumps(entry) for entry in entries] for key, entries in golden.items()}
    body = ",\n".join(f'"{key}": [\n' + ",\n".join(rows) + "\n]" for key, rows in lists.items())
    target.write_text("{\n" + body + "\n}\n", encoding="utf-8")


if __name__ == "__main__":
    main()
