"""`fingerpost._core` from Python: conversion, errors, memory and threads.

The stages have tests of their own in Rust. Here each is compared once with an oracle in Python
(SciPy, NumPy, OpenCV), so that no argument or column is swapped in the bindings.
"""

import functools
import random
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from geometry_rig import central_differences
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import integrate, interpolate

from fingerpost import _core
from fingerpost._core import (
    Background,
    BSpline,
    ContourTracker,
    EdgeSearch,
    Fitter,
    HandFinder,
    RoundFinger,
    ShapeSpace,
    StartPose,
    Template,
    sample_contour,
    update_views,
)
from fingerpost.errors import FingerpostError, InvalidInputError

# Greatest relative difference between two correct implementations of the same arithmetic.
ROUNDING = 1e-10

PISTOL = Template.pistol("left")
WAITING = StartPose((320, 240), 0.6, 90)
# A valid affine map of a hand: rotated, sheared along the finger, not mirrored.
CENTRE_PX = np.array([311.0, 207.0])
LINEAR_PX = np.array([[61.0, -9.0], [34.0, 72.0]])


def grey(height: int = 480, width: int = 640) -> np.ndarray:
    """An image with structure everywhere, so that no two places are equal."""
    rng = np.random.default_rng(1994)
    return rng.integers(0, 256, (height, width), dtype=np.uint8)


def search(image: np.ndarray, **more: object) -> _core.SearchLines:
    """Search along lines all over an image of any size."""
    rng = np.random.default_rng(3)
    angle = rng.uniform(-np.pi, np.pi, 50)
    normal = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    position = rng.uniform(0, 1, (50, 2)) * (np.array(image.shape[1::-1]) - 1)
    return EdgeSearch().search(image, position, normal, 15.0, "unknown", **more)


def found(lines: _core.SearchLines) -> bytes:
    """Return all results of a search, for comparison bit by bit."""
    columns = [lines.offset_px, lines.contrast_grey, lines.variance_px2, lines.separation]
    return np.stack(columns).tobytes() + lines.miss.tobytes()


# --- B-splines against SciPy -----------------------------------------------------------------


@st.composite
def splines(draw: st.DrawFn) -> tuple[BSpline, np.ndarray, np.ndarray]:
    """An open B-spline with repeated knots, its control points and parameters on its domain."""
    degree = draw(st.sampled_from([2, 3]))
    spans = draw(st.lists(st.sampled_from([0.0, 0.25, 1.0, 3.0]), min_size=1, max_size=8))
    breaks = [0.0, 0.5]
    for span in spans:
        repeated = len(breaks) >= degree and breaks[-degree] == breaks[-1]
        breaks.append(breaks[-1] + (span if span or not repeated else 0.5))
    breaks.append(breaks[-1] + 0.5)
    spline = BSpline.open_clamped(degree, breaks)
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    control_points = rng.normal(0, 100, (spline.control_point_count, 2))
    inside = rng.uniform(*spline.domain, 20)
    return spline, control_points, np.concatenate([inside, breaks])


def scipy_spline(spline: BSpline, control_points: np.ndarray) -> interpolate.BSpline:
    if not spline.is_closed:
        return interpolate.BSpline(spline.knots, control_points, spline.degree)
    k, knots = spline.degree, spline.knots
    period = knots[-1] - knots[0]
    before, after = knots[-1 - k : -1] - period, knots[1 : 1 + k] + period
    wrapped = np.concatenate([control_points, control_points[:k]])
    return interpolate.BSpline(np.concatenate([before, knots, after]), wrapped, k)


@given(splines())
def test_open_curves_and_their_derivatives_equal_scipys(drawn):
    spline, control_points, parameters = drawn
    oracle = scipy_spline(spline, control_points)
    curve = spline.evaluate(control_points, parameters)
    inner = parameters < spline.domain[1]  # at the end SciPy differentiates an empty span
    for order, ours in enumerate([curve.position, curve.first_derivative, curve.second_derivative]):
        theirs = oracle(parameters, nu=order)
        size = abs(theirs).max() + 1.0
        assert ours[inner] == pytest.approx(theirs[inner], abs=ROUNDING * size)
    assert curve.position == pytest.approx(oracle(parameters), abs=ROUNDING * 1e3)


@given(splines())
def test_basis_rows_equal_scipys_design_matrix(drawn):
    spline, _, parameters = drawn
    rows = spline.basis(parameters)
    dense = np.zeros((len(parameters), spline.control_point_count))
    np.put_along_axis(dense, rows.indices, rows.values, axis=1)
    theirs = interpolate.BSpline.design_matrix(parameters, spline.knots, spline.degree)
    assert dense == pytest.approx(theirs.toarray(), abs=ROUNDING)
    assert rows.first_derivatives.sum(axis=1) == pytest.approx(0, abs=1e-9)
    assert rows.second_derivatives.shape == rows.values.shape


@pytest.mark.parametrize("degree", [2, 3])
def test_closed_curves_equal_scipys_on_wrapped_control_points(degree):
    rng = np.random.default_rng(degree)
    spline = BSpline.closed(degree, [0, 1, 1.5, 3, 3, 4, 6])
    control_points = rng.normal(0, 50, (spline.control_point_count, 2))
    parameters = rng.uniform(0, 6, 50)
    theirs = scipy_spline(spline, control_points)(parameters)
    assert spline.evaluate(control_points, parameters).position == pytest.approx(theirs)
    again = spline.evaluate(control_points, parameters + 12.0)
    assert again.position == pytest.approx(theirs, abs=1e-9)


@pytest.mark.parametrize("degree", [2, 3])
def test_a_spline_fit_equals_numpys_least_squares(degree):
    rng = np.random.default_rng(10 + degree)
    spline = BSpline.open_uniform(degree, 9)
    parameters = np.sort(rng.uniform(*spline.domain, 60))
    outline = rng.normal(0, 30, (60, 2))
    fit = spline.fit(outline, parameters)
    design = interpolate.BSpline.design_matrix(parameters, spline.knots, degree).toarray()
    theirs, _, rank, singular = np.linalg.lstsq(design, outline)
    assert rank == spline.control_point_count
    assert fit.control_points == pytest.approx(theirs, rel=1e-9)
    assert fit.condition == pytest.approx(singular[0] / singular[-1])
    distances = np.linalg.norm(design @ theirs - outline, axis=1)
    assert fit.max_residual == pytest.approx(distances.max())
    assert fit.rms_residual == pytest.approx(np.sqrt(np.mean(distances**2)))
    assert np.array_equal(fit.parameters, parameters)


@pytest.mark.parametrize(("word", "power"), [("chord-length", 1.0), ("centripetal", 0.5)])
def test_computed_parameters_follow_the_polygon(word, power):
    outline = np.array([[0, 0], [1, 0], [1, 4], [10, 4], [10, 4.5], [12, 9], [0, 9]])
    sides = np.linalg.norm(np.diff(outline, axis=0), axis=1) ** power
    stations = np.concatenate([[0.0], np.cumsum(sides)]) / sides.sum()
    spline = BSpline.open_uniform(2, 5)
    fit = spline.fit(outline, word)
    assert fit.parameters == pytest.approx(stations * spline.domain[1])


def test_arc_lengths_equal_scipys_integrals():
    rng = np.random.default_rng(8)
    spline = BSpline.open_uniform(3, 7)
    control_points = rng.normal(0, 20, (7, 2))
    velocity = scipy_spline(spline, control_points).derivative()

    def length(to: float) -> float:
        speed = lambda t: np.hypot(*velocity(t))  # noqa: E731
        knots = [0, *np.arange(1, np.ceil(to)), to]
        return sum(integrate.quad(speed, a, b, epsabs=1e-12)[0] for a, b in pairwise(knots))

    arc_length = spline.arc_length(control_points)
    assert arc_length.total == pytest.approx(length(spline.domain[1]), rel=1e-9)
    parameters = arc_length.equally_spaced(6)
    assert [length(t) for t in parameters] == pytest.approx(
        np.linspace(0, arc_length.total, 6), abs=1e-8
    )
    lengths = np.linspace(0, arc_length.total, 6)
    assert arc_length.parameter_at(lengths) == pytest.approx(parameters)


def test_samples_of_a_contour_lie_in_the_middle_of_equal_arcs():
    spline = BSpline.closed_uniform(3, 12)
    angle = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    circle = 50 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    control_points = spline.fit(circle, "chord-length").control_points
    # Angles increase from +u towards +v, clockwise in the image: the inside is on the right.
    samples = sample_contour(spline, control_points, 40, "right")
    total = spline.arc_length(control_points).total
    assert samples.arc_length == pytest.approx((np.arange(40) + 0.5) / 40 * total)
    curve = spline.evaluate(control_points, samples.parameter)
    assert samples.position == pytest.approx(curve.position)
    outward = samples.position / np.linalg.norm(samples.position, axis=1, keepdims=True)
    assert samples.normal == pytest.approx(outward, abs=0.01)
    assert np.einsum("ij,ij->i", samples.tangent, samples.normal) == pytest.approx(0, abs=1e-12)
    inward = sample_contour(spline, control_points, 40, "left")
    assert np.array_equal(inward.normal, -samples.normal)


# --- templates -------------------------------------------------------------------------------


def test_a_template_reports_its_thumb_hand_and_outline():
    assert (PISTOL.thumb, PISTOL.hand) == ("left", "left")
    assert Template.pistol("right").outline(80) * [1, -1] == pytest.approx(PISTOL.outline(80))
    ends = PISTOL.spline.evaluate(PISTOL.control_points, PISTOL.spline.domain).position
    assert ends[0] == pytest.approx([PISTOL.proportions["flank_start"], 0.115], abs=2e-3)
    assert len(PISTOL.outline()) == ContourTracker(PISTOL, WAITING).options["samples"]


def test_given_proportions_replace_the_defaults():
    wide = Template.pistol("left", proportions={"half_width": 0.2, "thumb": {"length": 1.2}})
    usual = PISTOL.proportions
    assert wide.proportions == {
        **usual,
        "half_width": 0.2,
        "thumb": {**usual["thumb"], "length": 1.2},
    }
    assert Template.pistol("left", proportions=usual) == PISTOL
    assert wide != PISTOL
    alone = Template.pistol("none")
    assert alone.proportions["thumb"] is None
    assert Template.pistol("none", proportions=alone.proportions) == alone


def test_a_traced_template_has_its_outline_in_finger_lengths():
    axis = np.array([[100.0, 200.0], [160.0, 280.0]])  # 100 long, along (0.6, 0.8)
    pq = Template.pistol("none").outline(300)
    along, middle = np.array([0.6, 0.8]), axis.mean(axis=0)
    across = np.array([-along[1], along[0]])
    image = middle + 100 * (pq[:, :1] * along + pq[:, 1:] * across)
    traced = Template.from_outline(
        image, knuckle=axis[0], tip=axis[1], hand="right", control_points=40
    )
    assert (traced.thumb, traced.hand, traced.proportions) == ("none", "right", None)
    distance = np.linalg.norm(traced.outline(200)[:, None] - pq[None], axis=2).min(axis=1)
    assert distance.max() < 0.01  # half a step between the points of pq
    assert Template.from_outline(image, knuckle=axis[0], tip=axis[1], hand="right") is not None


# --- shape spaces ----------------------------------------------------------------------------

PLANAR = ["translation", "rigid", "rigid_shear", "similarity", "similarity_shear", "affine"]
SPACES = [*PLANAR, 2, 3, 4, 5, 9]


def shape_space(kind: str | int) -> tuple[ShapeSpace, np.ndarray]:
    if isinstance(kind, int):
        return ShapeSpace.ribbon(PISTOL, CENTRE_PX, LINEAR_PX, kind)
    return getattr(ShapeSpace, kind)(CENTRE_PX, LINEAR_PX)


@pytest.mark.parametrize("kind", PLANAR)
def test_every_planar_space_contains_the_map_it_was_made_from(kind):
    space, x = shape_space(kind)
    assert (space.kind, space.dof, len(space.names)) == (kind, len(x), len(x))
    placed = space.place(x, PISTOL, 60)
    assert placed.position_px == pytest.approx(CENTRE_PX + PISTOL.outline(60) @ LINEAR_PX.T)
    assert np.linalg.norm(placed.normal, axis=1) == pytest.approx(1)
    assert not placed.hidden.any()
    axis = space.axis(x)
    assert axis.anchor_px == pytest.approx(CENTRE_PX)
    assert axis.tip_px == pytest.approx(CENTRE_PX + LINEAR_PX[:, 0] / 2)
    assert axis.angle_rad == pytest.approx(np.arctan2(LINEAR_PX[1, 0], LINEAR_PX[0, 0]))


def test_the_band_model_at_rest_is_the_template():
    space, x = ShapeSpace.ribbon(PISTOL, WAITING.centre_px, WAITING.linear_px, 9)
    placed = space.place(x, PISTOL, 60)
    at_rest = WAITING.centre_px + PISTOL.outline(60) @ WAITING.linear_px.T
    # The spline of the planar template follows its bands to 0.002 finger lengths.
    assert placed.position_px == pytest.approx(at_rest, abs=0.002 * WAITING.length_px)
    assert space.axis(x).tip_px == pytest.approx(WAITING.tip_px)


def test_a_thumb_along_the_finger_is_partly_hidden():
    space, x = ShapeSpace.ribbon(PISTOL, WAITING.centre_px, WAITING.linear_px, 9)
    x = x.copy()
    x[6:8] = 40 * np.array([np.cos(WAITING.angle_rad), np.sin(WAITING.angle_rad)])
    x[8] = x[3] / 2
    assert space.place(x, PISTOL, 100).hidden.any()


@pytest.mark.parametrize("kind", SPACES)
def test_jacobians_agree_with_central_differences(kind):
    space, x = shape_space(kind)
    rng = np.random.default_rng(17)
    x = x * (1 + 0.05 * rng.normal(size=x.shape)) + 0.01
    normal = space.place(x, PISTOL, 50).normal
    steps = np.maximum(abs(x), 1.0)
    numeric = central_differences(
        lambda y: np.einsum("ij,ij->i", space.place(y, PISTOL, 50).position_px, normal), x, steps
    )
    rows = space.normal_rows(x, PISTOL, 50)
    assert rows == pytest.approx(numeric, rel=1e-6, abs=1e-6)
    across = np.stack([-normal[:, 1], normal[:, 0]], axis=1)
    other = space.normal_rows(x, PISTOL, 50, normal=across)
    assert other.shape == rows.shape
    if kind in PLANAR:  # rows of a band are valid along the contour's own normals only
        numeric = central_differences(
            lambda y: np.einsum("ij,ij->i", space.place(y, PISTOL, 50).position_px, across),
            x,
            steps,
        )
        assert other == pytest.approx(numeric, rel=1e-6, abs=1e-6)

    axis = space.axis(x)
    n = np.array([-np.sin(axis.angle_rad), np.cos(axis.angle_rad)])

    def offset_and_angle(y: np.ndarray) -> np.ndarray:
        moved = space.axis(y)
        return np.array([np.array(moved.anchor_px) @ n, moved.angle_rad])

    numeric = central_differences(offset_and_angle, x, steps)
    assert space.axis_jacobian(x) == pytest.approx(numeric, rel=1e-6, abs=1e-6)


@pytest.mark.parametrize(
    ("vector", "complaint"),
    [
        ([1, 2, 3], "3 components of the shape vector; exactly 6"),
        ([0, 0, np.nan, 0, 0, 1], "component of the shape vector 2 has NaN"),
        ([0, 0, 1, 0, 0, -1], "β .* is -1; it must be positive"),
        ([0, 0, 0, 0, 0, 1], "α .* is 0; it must be positive"),
        ([[0, 0, 1, 0, 0, 1]], r"shape_vector has the shape \(1, 6\); it must be \(N,\)"),
    ],
)
def test_invalid_shape_vectors_are_refused(vector, complaint):
    space, _ = shape_space("affine")
    for use in [space.axis, space.axis_jacobian, lambda x: space.place(x, PISTOL)]:
        with pytest.raises(InvalidInputError, match=complaint):
            use(vector)


def test_the_band_model_refuses_templates_and_shapes_without_bands():
    space, x = shape_space(9)
    traced = Template.from_outline(
        PISTOL.outline(100), knuckle=(-0.5, 0), tip=(0.5, 0), hand="left"
    )
    with pytest.raises(InvalidInputError, match="only a pistol has bands"):
        ShapeSpace.ribbon(traced, CENTRE_PX, LINEAR_PX, 5)
    for other in [traced, Template.pistol("right"), Template.pistol("none")]:
        with pytest.raises(InvalidInputError, match='is of a pistol with thumb="left"'):
            space.place(x, other)
    for dof in [0, 1, 6, 10, 2**63]:
        with pytest.raises(InvalidInputError, match=f"dof is {dof}; it must be 2, 3, 4, 5"):
            ShapeSpace.ribbon(PISTOL, CENTRE_PX, LINEAR_PX, dof)
    with pytest.raises(InvalidInputError, match="dof is 9"):
        ShapeSpace.ribbon(Template.pistol("none"), CENTRE_PX, LINEAR_PX, 9)
    without_thumb = x.copy()
    without_thumb[6:8] = 0.0
    with pytest.raises(InvalidInputError, match="normal of the placed contour is 0"):
        space.place(without_thumb, PISTOL)
    inside_out = x.copy()
    inside_out[3] = -1.0
    with pytest.raises(InvalidInputError, match=r"half_width \[px\] is -1"):
        space.axis(inside_out)


@pytest.mark.parametrize(
    ("linear", "complaint"),
    [
        ([[1, 0], [0, -1]], "must be positive"),
        ([[1, 2], [2, 4]], "must be positive"),
        ([[np.inf, 0], [0, 1]], "must be finite"),
        ([1, 0, 0, 1], r"linear_px has the shape \(4,\); it must be \(2, 2\)"),
    ],
)
def test_invalid_maps_are_refused(linear, complaint):
    for kind in PLANAR:
        with pytest.raises(InvalidInputError, match=complaint):
            getattr(ShapeSpace, kind)(CENTRE_PX, linear)
    with pytest.raises(InvalidInputError, match="centre_px is NaN"):
        ShapeSpace.affine([np.nan, 0], LINEAR_PX)


# --- edge search -----------------------------------------------------------------------------

DISC_CENTRE, DISC_RADIUS = np.array([101.3, 87.6]), 50.4


def disc(inside: int, outside: int, blur_px: float) -> np.ndarray:
    """A disc drawn by OpenCV at 16 times the resolution, area-sampled and blurred."""
    factor, shift = 16, 4
    large = np.full((180 * factor, 210 * factor), outside, np.uint8)
    centre = np.round(((DISC_CENTRE + 0.5) * factor - 0.5) * 2**shift).astype(int)
    radius = round(DISC_RADIUS * factor * 2**shift)
    cv2.circle(large, centre.tolist(), radius, inside, cv2.FILLED, cv2.LINE_8, shift)
    small = cv2.resize(large, (210, 180), interpolation=cv2.INTER_AREA)
    return cv2.GaussianBlur(small, (0, 0), blur_px)


def lines_across(count: int, displaced_px: float) -> tuple[np.ndarray, np.ndarray]:
    """Return positions displaced outwards from the disc's edge, and outward normals."""
    angle = 2 * np.pi * np.arange(count) / count
    normal = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return DISC_CENTRE + (DISC_RADIUS + displaced_px) * normal, normal


@pytest.mark.parametrize("displaced_px", [-6.25, 0.0, 3.5])
@pytest.mark.parametrize(("inside", "outside"), [(170, 90), (60, 140)])
def test_edges_of_a_drawn_disc_are_found_where_they_were_drawn(displaced_px, inside, outside):
    image = disc(inside, outside, blur_px=1.0)
    position, normal = lines_across(72, displaced_px)
    polarity = "bright" if inside > outside else "dark"
    lines = EdgeSearch().search(image, position, normal, 12.0, polarity)
    assert (lines.miss == "").all()
    # Blur moves a curved edge inwards by (σ_b² + s²) / 2r = 0.04 px; the grey levels are rounded,
    # and so is the disc's outline, to a 16th of a pixel.
    assert lines.offset_px == pytest.approx(-displaced_px, abs=0.08)
    assert lines.offset_px.mean() == pytest.approx(-displaced_px, abs=0.05)
    assert lines.contrast_grey == pytest.approx(inside - outside, rel=0.06)
    assert np.isnan(lines.separation).all()
    assert np.array_equal(lines.position_px, position)
    assert np.array_equal(lines.normal, normal)
    assert (lines.half_length_px == 12.0).all()
    wrong = EdgeSearch().search(
        image, position, normal, 12.0, "dark" if polarity == "bright" else "bright"
    )
    assert (wrong.miss == "no-contrast").all()


def test_the_variance_agrees_with_the_scatter_under_noise():
    clean = disc(160, 80, blur_px=1.0).astype(float)
    position, normal = lines_across(90, 0.0)
    rng = np.random.default_rng(404)
    search = EdgeSearch({"noise_grey": 4.0, "blur_px": 1.0})
    offsets, claimed = [], []
    for _ in range(60):
        noisy = np.clip(np.round(clean + rng.normal(0, 4.0, clean.shape)), 0, 255)
        lines = search.search(noisy.astype(np.uint8), position, normal, 8.0, "bright")
        offsets.append(lines.offset_px)
        claimed.append(lines.variance_px2)
    ratio = np.var(offsets, axis=0, ddof=1).mean() / np.mean(claimed)
    # The variance assumes white noise along the line; bilinear sampling averages neighbours, which
    # leaves about two thirds of it.
    assert 0.5 < ratio < 0.8


def test_misses_have_a_reason_and_nan_values():
    image = np.full((100, 100), 90, np.uint8)
    image[:, 60:] = 170
    position = [(30, 50), (-5, 50), (55, 50), (45.5, 50), (59.5, 50)]
    normal = np.tile([1.0, 0.0], (5, 1))
    half_length_px = [10.0, 10.0, 10.0, 12.0, 10.0]
    lines = EdgeSearch().search(image, position, normal, half_length_px, "dark")
    reasons = ["no-contrast", "out-of-image", "", "beyond-end", ""]
    assert lines.miss.tolist() == reasons
    missed = lines.miss != ""
    for column in [lines.offset_px, lines.contrast_grey, lines.variance_px2]:
        assert np.array_equal(np.isnan(column), missed)
    assert lines.offset_px[[2, 4]] == pytest.approx([4.5, 0.0], abs=1e-3)
    assert len(lines) == 5
    assert len(EdgeSearch().search(image, np.empty((0, 2)), np.empty((0, 2)), 5.0, "dark")) == 0


@pytest.mark.parametrize(
    ("changed", "complaint"),
    [
        ({"normal": [[1, 0], [1, 1]]}, r"normal 1 is \(1, 1\); its length must be 1"),
        ({"normal": [[1, 0], [np.nan, 0]]}, "normal 1 is"),
        ({"normal": [[1.0, 0.0]]}, "normal has 1 entries; one for each of the 2 positions"),
        ({"position_px": [[1, 2], [np.inf, 3]]}, "search position .* is inf"),
        ({"position_px": [[1, 2, 3], [4, 5, 6]]}, r"position_px has the shape \(2, 3\)"),
        ({"half_length_px": 0.0}, "half-length .* is 0; it must be positive and at most 128"),
        ({"half_length_px": 129}, "half-length .* is 129"),
        ({"half_length_px": [5.0]}, "half_length_px has 1 entries"),
        ({"half_length_px": "far"}, "half_length_px has the dtype <U3"),
        ({"half_length_px": None}, "half_length_px is None; it must be a real number"),
        ({"polarity": "grey"}, 'is \'grey\'; it must be "bright", "dark" or "unknown"'),
        ({"polarity": 3}, "polarity is 3"),
        ({"scale": "huge"}, 'scale is \'huge\'; it must be "fine" or "coarse"'),
    ],
)
def test_invalid_search_lines_are_refused(changed, complaint):
    arguments = {
        "image": grey(),
        "position_px": [[100, 100], [200, 200]],
        "normal": [[1.0, 0.0], [0.0, 1.0]],
        "half_length_px": 10.0,
        "polarity": "unknown",
    }
    EdgeSearch().search(**arguments)
    with pytest.raises(InvalidInputError, match=complaint):
        EdgeSearch().search(**{**arguments, **changed})


def test_a_coarse_kernel_finds_a_blurred_edge_that_a_fine_one_misses():
    step = np.full((40, 200), 20, np.uint8)
    step[:, 100:] = 180
    image = cv2.GaussianBlur(step, (0, 0), 12.0)
    line = {"position_px": [[95.0, 20.0]], "normal": [[1.0, 0.0]], "half_length_px": 30.0}
    # The response of a kernel s to a step of contrast A and blur b is A s / √(s² + b²): 21 and 51.
    search = EdgeSearch({"min_contrast_grey": 35.0, "blur_px": 0.0, "scale_px": 1.6})
    assert search.search(image, **line, polarity="dark").miss[0] == "no-contrast"
    coarse = search.search(image, **line, polarity="dark", scale="coarse")
    # The top of an edge this wide changes by less than a grey level per pixel.
    assert coarse.offset_px == pytest.approx([4.5], abs=0.2)
    assert coarse.contrast_grey == pytest.approx([-51], rel=0.05)


# --- fit -------------------------------------------------------------------------------------


@pytest.mark.parametrize("unknowns", range(1, 10))
def test_plain_least_squares_equal_numpys(unknowns):
    rng = np.random.default_rng(100 + unknowns)
    rows, offsets = rng.normal(size=(60, unknowns)), rng.normal(size=60)
    variances = rng.uniform(0.5, 2.0, 60)
    report = Fitter({"loss": "none", "min_scale_px": 0}).solve(rows, offsets, variances)
    weighted = rows / np.sqrt(variances)[:, None]
    theirs, *_ = np.linalg.lstsq(weighted, offsets / np.sqrt(variances))
    assert report.outcome == "determined"
    assert report.step == pytest.approx(theirs, rel=1e-9)
    assert report.information == pytest.approx(weighted.T @ weighted)
    residuals = offsets - rows @ theirs
    assert report.residual_px == pytest.approx(residuals)
    excess = max(1.0, np.sum(residuals**2 / variances) / (60 - unknowns))
    assert report.covariance == pytest.approx(np.linalg.inv(weighted.T @ weighted) * excess)
    assert report.residual_rms_px == pytest.approx(np.sqrt(np.mean(residuals**2)))
    assert (report.rank, report.equations, report.inliers) == (unknowns, 60, 60)
    assert (report.weight == 1).all()


def test_gross_errors_get_no_weight():
    rng = np.random.default_rng(77)
    rows, truth = rng.normal(size=(80, 4)), np.array([3.0, -2.0, 0.5, 1.0])
    offsets = rows @ truth + rng.normal(0, 0.1, 80)
    offsets[:15] += 20.0
    variances = np.full(80, 0.01)
    robust = Fitter().solve(rows, offsets, variances)
    assert robust.step == pytest.approx(truth, abs=0.06)
    assert (robust.weight[:15] == 0).all()
    assert robust.inliers <= 65
    assert np.allclose(robust.residual_px, offsets - rows @ robust.step)
    plain = Fitter({"loss": "none"}).solve(rows, offsets, variances)
    assert abs(plain.step - truth).max() > 0.5


def test_a_prior_is_weighted_by_its_information():
    rng = np.random.default_rng(5)
    rows, offsets, variances = rng.normal(size=(30, 3)), rng.normal(size=30), np.ones(30)
    half = rng.normal(size=(3, 3))
    mean, information = rng.normal(size=3), half @ half.T
    fitter = Fitter({"loss": "none", "min_scale_px": 0})
    report = fitter.solve(rows, offsets, variances, prior=(mean, information))
    normal, right = rows.T @ rows + information, rows.T @ offsets + information @ mean
    assert report.step == pytest.approx(np.linalg.solve(normal, right))
    alone = fitter.solve(np.empty((0, 3)), [], [], prior=(mean, np.eye(3)))
    assert alone.step == pytest.approx(mean)


def test_the_two_stage_solve_fits_the_translation_first():
    rng = np.random.default_rng(9)
    rows, offsets, variances = rng.normal(size=(40, 4)), rng.normal(size=40), np.ones(40)
    fitter = Fitter({"loss": "none", "solve": "two-stage"})
    report = fitter.solve(rows, offsets, variances)
    translation, *_ = np.linalg.lstsq(rows[:, :2], offsets)
    rest, *_ = np.linalg.lstsq(rows[:, 2:], offsets - rows[:, :2] @ translation)
    assert report.step == pytest.approx([*translation, *rest])


def test_undetermined_directions_are_reported():
    rows = np.tile([[1.0, 2.0, 0.0]], (10, 1))
    report = Fitter().solve(rows, np.ones(10), np.ones(10))
    assert (report.outcome, report.rank) == ("undetermined", 1)
    assert report.step is None
    assert report.covariance is None
    few = Fitter().solve(np.eye(3)[:2], [1, 1], [1, 1])
    assert (few.outcome, few.step) == ("too-few-equations", None)


@pytest.mark.parametrize(
    ("changed", "complaint"),
    [
        ({"rows": np.ones((4, 0))}, "rows has 0 columns, .* 1 to 9"),
        ({"rows": np.ones((4, 10))}, "rows has 10 columns"),
        ({"rows": np.ones(4)}, r"rows has the shape \(4,\); it must be \(N, D\)"),
        ({"offset_px": [1, 2, 3]}, "offset_px has 3 entries; one for each of the 4 rows"),
        ({"variance_px2": [1]}, "variance_px2 has 1 entries"),
        ({"offset_px": [1, 2, np.nan, 4]}, "offset .* is NaN"),
        ({"variance_px2": [1, 0, 1, 1]}, "variance .* is 0; it must be positive"),
        ({"prior": 3}, "prior is 3; it must be a tuple"),
        ({"prior": ([0], np.eye(2))}, r"prior mean has the shape \(1,\); it must be \(2,\)"),
        ({"prior": ([0, 0], np.eye(3))}, r"prior information has the shape \(3, 3\)"),
        ({"prior": ([0, np.inf], np.eye(2))}, "prior is inf"),
        ({"prior": ([0, 0], [[1, 1], [0, 1]])}, "asymmetric by 1"),
        ({"prior": ([0, 0], [[1, 0], [0, -1]])}, "least eigenvalue is -1"),
    ],
)
def test_invalid_equations_are_refused(changed, complaint):
    arguments = {"rows": np.eye(2)[[0, 1, 0, 1]], "offset_px": np.ones(4), "variance_px2": [1] * 4}
    Fitter().solve(**arguments)
    with pytest.raises(InvalidInputError, match=complaint):
        Fitter().solve(**{**arguments, **changed})


# --- options ---------------------------------------------------------------------------------

STAGES: list[Callable[..., object]] = [
    EdgeSearch,
    Fitter,
    lambda options=None: ContourTracker(PISTOL, WAITING, options),
]


@pytest.mark.parametrize("stage", STAGES)
def test_reported_options_make_the_same_stage_again(stage):
    options = stage().options
    assert stage(options).options == options
    assert stage({}).options == options


def test_an_option_replaces_its_own_default_only():
    usual = ContourTracker(PISTOL, WAITING).options
    changed = ContourTracker(
        PISTOL,
        WAITING,
        {
            "model": "paper",
            "samples": np.int64(64),
            "fit": {"loss": "none"},
            "track": {"accept": {"min_inliers": np.float32(0.25)}},
        },
    ).options
    assert changed["model"] == "paper"
    assert changed["samples"] == 64
    assert changed["fit"] == {**usual["fit"], "loss": "none"}
    accept = {**usual["track"]["accept"], "min_inliers": 0.25}
    assert changed["track"] == {**usual["track"], "accept": accept}
    assert changed["acquire"] == usual["acquire"]


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        ({"sample": 5}, 'options has no option "sample"; it has model, samples'),
        ({"search": {"scale": 2}}, 'options.search has no option "scale"; it has scale_px'),
        ({"track": {"accept": {"rms": 1}}}, 'options.track.accept has no option "rms"'),
        ({"search": 3}, "options.search is 3; it must be a dictionary"),
        ({"search": {"scale_px": "2"}}, "options.search.scale_px is '2'; it must be a real"),
        ({"search": {"scale_px": True}}, "options.search.scale_px is True"),
        ({"search": {"scale_px": 9.0}}, "search scale .* is 9; it must be 0.5 to 8"),
        ({"search": {"scale_px": np.nan}}, "search scale .* is NaN; it must be finite"),
        ({"samples": 50.5}, "options.samples is 50.5; it must be a whole number"),
        ({"samples": -1}, "options.samples is -1; it must be a whole number"),
        ({"samples": 2**64}, "options.samples is 18446744073709551616"),
        ({"samples": 2**64 - 1}, "contour samples is 1844.*; it must be 8 to 2000"),
        ({"samples": True}, "options.samples is True"),
        ({"model": "snake"}, 'options.model is \'snake\'; it must be "ribbon" or "paper"'),
        ({"fit": {"loss": "huber"}}, "options.fit.loss is 'huber'; it must be \"none\" or"),
        ({"fit": {"loss": 0.5}}, "Tukey cutoff .* is 0.5; it must be above 1"),
        ({"fit": {"solve": None}}, "options.fit.solve is None"),
        ({3: 4}, "a key of options is 3; it must be a string"),
        ([], "options is .*; it must be a dictionary"),
    ],
)
def test_invalid_options_are_refused_with_their_path(options, complaint):
    with pytest.raises(InvalidInputError, match=complaint):
        ContourTracker(PISTOL, WAITING, options)


@pytest.mark.parametrize(
    ("proportions", "complaint"),
    [
        ({"width": 0.1}, 'proportions has no option "width"'),
        ({"thumb": {"side": "left"}}, 'proportions.thumb has no option "side"'),
        ({"half_width": 0.5}, "finger half-width is 0.5; it must be 0.03 to 0.4"),
        ({"thumb": None}, "proportions.thumb is None; it must be a dictionary"),
    ],
)
def test_invalid_proportions_are_refused(proportions, complaint):
    with pytest.raises(InvalidInputError, match=complaint):
        Template.pistol("left", proportions=proportions)
    with pytest.raises(InvalidInputError, match=r"proportions\.thumb is given"):
        Template.pistol("none", proportions={"thumb": {"length": 1.0}})


# --- arrays in and out -----------------------------------------------------------------------


@pytest.mark.parametrize(
    "converted",
    [
        lambda knots: knots.tolist(),
        lambda knots: tuple(knots),
        lambda knots: knots.astype(np.float32),
        lambda knots: knots.astype(np.int16),
        lambda knots: knots.astype(">f8"),
        lambda knots: np.repeat(knots, 2)[::2],
        lambda knots: knots[::-1].copy()[::-1],
        # A column of records: unaligned, with a stride of 12 bytes, no multiple of 8.
        lambda knots: np.rec.fromarrays([np.ones(len(knots), "f4"), knots])["f1"],
        lambda knots: np.ma.array(knots),
    ],
)
def test_anything_that_numpy_reads_as_real_numbers_is_accepted(converted):
    knots = np.array([0, 0, 0, 0, 1, 2, 2, 3, 3, 3, 3.0])
    assert BSpline.open(3, converted(knots)) == BSpline.open(3, knots)


@pytest.mark.parametrize(
    ("knots", "complaint"),
    [
        ("0 1 2", "knots has the dtype <U5; it must be an array of real numbers"),
        (["0", "1"], "knots has the dtype <U1"),
        ([0, 1j], "knots has the dtype complex128"),
        ([True, False], "knots has the dtype bool"),
        (None, "knots has the dtype object"),
        ([[0], [1, 2]], "knots is of <class 'list'>, which NumPy cannot read"),
        (3.0, r"knots has the shape \(\); it must be \(N,\)"),
        (np.zeros((2, 3)), r"knots has the shape \(2, 3\); it must be \(N,\)"),
        ([0, 0, 0, np.nan, 1, 1], "knot 3 has NaN; it must be finite"),
    ],
)
def test_arrays_without_real_numbers_are_refused(knots, complaint):
    with pytest.raises(InvalidInputError, match=complaint):
        BSpline.open(2, knots)


def test_results_are_read_only_and_objects_frozen():
    space, x = shape_space("affine")
    placed = space.place(x, PISTOL)
    for array in [x, placed.position_px, placed.hidden, PISTOL.control_points, PISTOL.outline()]:
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0
    assert placed.normal is placed.normal
    for thing, name in [(placed, "normal"), (PISTOL, "thumb"), (WAITING, "tip_px")]:
        with pytest.raises(AttributeError):
            setattr(thing, name, 1)
    with pytest.raises(TypeError):
        hash(WAITING)


HUGE = [2**20 + 1, 2**31, 2**62, 2**63, 2**64 - 1]


@pytest.mark.parametrize("count", [*HUGE, 2**64, 10**30, -1, 2.5, "9", None, True])
def test_invalid_and_excessive_counts_are_refused_before_allocation(count):
    spline = BSpline.open_uniform(3, 4)
    control_points = np.arange(8.0).reshape(4, 2) ** 2
    space, x = shape_space(9)
    makers = {
        "control_points": [
            lambda: BSpline.open_uniform(3, count),
            lambda: BSpline.closed_uniform(2, count),
            lambda: Template.from_outline(
                np.eye(2), knuckle=(0, 0), tip=(1, 0), hand="left", control_points=count
            ),
        ],
        "samples": [
            lambda: spline.arc_length(control_points).equally_spaced(count),
            lambda: sample_contour(spline, control_points, count, "left"),
            lambda: PISTOL.outline(count),
            lambda: space.place(x, PISTOL, count),
            lambda: space.normal_rows(x, PISTOL, count),
        ],
    }
    for name, calls in makers.items():
        for call in calls:
            if count is None and name == "samples" and call not in calls[:2]:
                continue  # None is the default there
            if count is None and call is makers["control_points"][2]:
                continue
            with pytest.raises(InvalidInputError, match=f"^{name} is "):
                call()


def test_a_fit_that_exceeds_memory_is_refused():
    outline = np.random.default_rng(0).normal(size=(20000, 2))
    with pytest.raises(InvalidInputError, match="20000 outline points for 10000 control points"):
        BSpline.open_uniform(3, 10000).fit(outline, "chord-length")
    with pytest.raises(InvalidInputError, match="may not exceed"):
        Template.from_outline(
            outline, knuckle=(0, 0), tip=(1, 0), hand="left", control_points=10000
        )


@pytest.mark.parametrize("degree", [0, 1, 4, 2**40])
def test_other_degrees_are_refused(degree):
    with pytest.raises(InvalidInputError, match=f"degree {degree} is not supported"):
        BSpline.open_uniform(degree, 8)


@pytest.mark.parametrize(
    ("pose", "complaint"),
    [
        (((np.nan, 1), 0, 50), "tip u .* is NaN; it must be finite"),
        (((1, 2, 3), 0, 50), r"tip_px has the shape \(3,\); it must be \(2,\)"),
        ((3, 0, 50), r"tip_px has the shape \(\)"),
        (((1, 2), np.inf, 50), "angle .* is inf"),
        (((1, 2), "0", 50), "angle_rad is '0'; it must be a real number"),
        (((1, 2), 0, 0), "finger length .* is 0; it must be positive"),
        (((1, 2), 0, -5), "finger length .* is -5"),
        (((1, 2), 0, None), "length_px is None"),
    ],
)
def test_invalid_start_poses_are_refused(pose, complaint):
    with pytest.raises(InvalidInputError, match=complaint):
        StartPose(*pose)


def test_a_start_pose_gives_the_map_of_its_template():
    start = StartPose(np.array([100, 50]), np.pi / 2, 40)
    assert start == StartPose((100, 50), np.pi / 2, 40.0)
    assert start.centre_px == pytest.approx([100, 30])
    assert start.linear_px == pytest.approx(np.array([[0, -40], [40, 0]]))


def test_every_object_has_a_repr():
    space, x = shape_space("rigid_shear")
    tracker = ContourTracker(PISTOL, WAITING)
    spline = BSpline.open_uniform(3, 4)
    square = [[0, 0], [1, 0], [1, 1], [0, 1]]
    shown = {
        "StartPose(tip_px=(320, 240), angle_rad=0.6, length_px=90)": WAITING,
        "Template(pistol, thumb='left', 46 control points)": PISTOL,
        "ContourTracker(model='ribbon', thumb='left', samples=100)": tracker,
        "Track(time_s=0.5, status='acquiring', finger_line=None)": tracker.update(grey(), 0.5),
        "ShapeSpace.rigid_shear(c_u [px], c_v [px], theta [rad], kappa [px])": space,
        "PlacedContour(7 samples)": space.place(x, PISTOL, 7),
        "BSpline(degree=3, open, control_point_count=4, domain=(0, 1))": spline,
        "BasisRows(2 parameters, 4 weights each)": spline.basis([0, 1]),
        "CurvePoints(1 points)": spline.evaluate(square, [0.5]),
        "ContourSamples(5 samples)": sample_contour(spline, square, 5, "left"),
        "FitReport(outcome='too-few-equations', rank=0, inliers=0 of 0, residual_rms_px=0.0000, "
        "iterations=0)": Fitter().solve(np.empty((0, 2)), [], []),
    }
    assert {repr(thing) for thing in shown.values()} == set(shown)
    for thing, start in [
        (tracker.search_lines(), "SearchLines("),
        (space.axis(x), "Axis(anchor_px=(311.000, 207.000), tip_px=("),
        (spline.arc_length(square), "ArcLength(total="),
        (spline.fit(square, "centripetal"), "SplineFit(4 control points, rms_residual="),
        (EdgeSearch(), "EdgeSearch({'scale_px': "),
        (Fitter(), "Fitter({'loss': "),
        (tracker.update(grey(), 0.5).diagnostics, "Diagnostics(accepted="),
    ]:
        assert repr(thing).startswith(start)


# --- images without a copy -------------------------------------------------------------------


@pytest.mark.parametrize(
    "lay",
    [
        lambda image: np.pad(image, ((3, 5), (7, 9)), constant_values=255)[3:-5, 7:-9],
        lambda image: np.repeat(image, 2, axis=0)[::2],
        lambda image: np.stack([image, 255 - image], axis=1)[:, 0],
        lambda image: np.concatenate([image, image[::-1]], axis=1)[:, : image.shape[1]],
        lambda image: np.frombuffer(image.tobytes(), np.uint8).reshape(image.shape),
        lambda image: image.view(np.recarray),
    ],
)
def test_strided_views_are_read_as_their_contiguous_copies(lay):
    image = grey()
    view = lay(image)
    view.flags.writeable = False
    assert found(search(view)) == found(search(image))


@pytest.mark.parametrize(
    "lay",
    [
        lambda image: np.pad(image, ((1, 2), (3, 4), (0, 0)))[1:-2, 3:-4],
        lambda image: np.repeat(image, 2, axis=0)[::2],
    ],
)
def test_strided_colours_are_read_as_their_contiguous_copies(lay):
    image = grey(80, 100)
    colour = np.random.default_rng(55).integers(0, 256, (80, 100, 3), dtype=np.uint8)
    colour[30:50] //= 4  # a band
    likeness = HandFinder.likeness(image, (60.0, 40.0), 0.3, 6.0, colour=colour)
    assert likeness is not None
    assert HandFinder.likeness(image, (60.0, 40.0), 0.3, 6.0, colour=lay(colour)) == likeness


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((1, 1), np.uint8),
        grey(1, 50),
        grey(50, 1),
        np.asfortranarray(grey(50, 1)),
        grey(50, 50)[10:11, ::-1][:, ::-1],
        grey(50, 50)[:, 7:8],  # one column of a larger image
        grey(50, 50)[::-3][:1],  # one row, whose stride leads backwards
        np.broadcast_to(grey(1, 50), (1, 50)),
        np.broadcast_to(np.uint8(7), (1, 1)),
        np.lib.stride_tricks.as_strided(grey(1, 9), (1, 9), (2**62, 1)),
    ],
)
def test_axes_of_one_entry_may_have_any_stride(image):
    assert found(search(image)) == found(search(np.array(image)))


@pytest.mark.parametrize(
    ("image", "given"),
    [
        (grey().astype(np.float32), "dtype float32"),
        (grey().view(np.int8), "dtype int8"),
        (grey() > 7, "dtype bool"),
        (grey().astype(np.uint16), "dtype uint16"),
        (np.stack([grey()] * 4, axis=2), r"shape \(480, 640, 4\)"),
        (grey()[0], r"shape \(640,\)"),
        (np.uint8(3), "of <class 'numpy.uint8'>"),
        (np.array(3, np.uint8), r"shape \(\)"),
        (grey().tolist(), "of <class 'list'>"),
        (grey().tobytes(), "of <class 'bytes'>"),
        (memoryview(grey()), "of <class 'memoryview'>"),
        (None, "of <class 'NoneType'>"),
    ],
)
def test_arrays_that_are_no_grey_image_are_refused(image, given):
    needed = r"it must be a uint8 array \(height, width\), or \(height, width, 3\) in colour$"
    with pytest.raises(InvalidInputError, match=f"^image is .*{given}.*; {needed}"):
        ContourTracker(PISTOL, WAITING).update(image, 0.0)


@pytest.mark.parametrize(
    "image",
    [
        grey()[::-1],
        grey()[:, ::-1],
        grey()[:, ::2],
        grey().T,
        np.asfortranarray(grey()),
        np.stack([grey()] * 3, axis=2)[:, :, 1],
        np.broadcast_to(grey(1, 50), (50, 50)),
        np.broadcast_to(np.uint8(9), (50, 50)),
        np.broadcast_to(grey(50, 1), (50, 50)),
        # Rows that overlap by a pixel.
        np.lib.stride_tricks.sliding_window_view(grey(1, 100)[0], 50),
        np.lib.stride_tricks.as_strided(grey(1, 100), (5, 11), (10, 1)),
    ],
)
def test_non_contiguous_rows_are_refused(image):
    complaint = r"^image is .* strides \(.*rows are contiguous.*numpy.ascontiguousarray"
    with pytest.raises(InvalidInputError, match=complaint):
        search(image)
    search(np.ascontiguousarray(image))


@pytest.mark.parametrize("shape", [(0, 0), (0, 640), (480, 0)])
def test_images_without_pixels_are_refused(shape):
    given = f"the image is {shape[1]} × {shape[0]} px; both sides must be at least 1 px"
    tracker = ContourTracker(PISTOL, WAITING)
    for image in [np.empty(shape, np.uint8), grey()[: shape[0], : shape[1]]]:
        with pytest.raises(InvalidInputError, match=given):
            tracker.update(image, 0.0)
    assert tracker.update(grey(), 0.0).status == "acquiring"


@pytest.mark.parametrize(
    ("colour", "complaint"),
    [
        (grey(), r"colour is .* shape \(480, 640\).* it must be a 3-D uint8 array"),
        (np.zeros((480, 640, 4), np.uint8), r"it must be a 3-D uint8 array \(height, width, 3\)"),
        (np.zeros((480, 640, 3)), "dtype float64"),
        (np.zeros((480, 640, 3), np.uint8)[:, :, ::-1], r"strides \(1920, 3, -1\)"),
        (np.zeros((480, 640, 4), np.uint8)[:, :, :3], r"strides \(2560, 4, 1\)"),
        (np.zeros((3, 480, 640), np.uint8).transpose(1, 2, 0), "rows are contiguous"),
        (np.zeros((480, 639, 3), np.uint8), "639 × 480 px and the grey image 640 × 480 px"),
        (np.zeros((0, 640, 3), np.uint8), "0 px"),
    ],
)
def test_colours_that_do_not_match_the_frame_are_refused(colour, complaint):
    with pytest.raises(InvalidInputError, match=complaint):
        ContourTracker(PISTOL, WAITING).update(grey(), 0.0, colour)


@pytest.mark.parametrize("shape", [(1, 2**15), (2**15, 1)])
def test_frames_beyond_the_fixed_point_range_are_refused(shape):
    tracker = ContourTracker(PISTOL, WAITING)
    with pytest.raises(InvalidInputError, match="32767 px"):
        tracker.update(np.zeros(shape, np.uint8), 1.0)
    assert tracker.update(grey(), 0.0).status == "acquiring"


@pytest.mark.skipif(sys.platform != "linux", reason="needs /proc and RLIMIT_AS")
def test_images_are_not_copied(tmp_path: Path) -> None:
    # Sparse files of 2 GiB and 3 GiB as images, and hardly any memory left: a copy of one, or of
    # one row in sixty, would fail.
    program = f"""
        import re, resource
        from pathlib import Path
        import numpy as np
        from fingerpost._core import ContourTracker, StartPose, Template, update_views

        path = {str(tmp_path / "sparse")!r}
        image = np.memmap(path, np.uint8, "w+", shape=(2**15 - 1, 2**16))[:, : 2**15 - 1]
        image[4096:4196, 16384:16484] = 200
        colour = np.memmap(path + "3", np.uint8, "w+", shape=(2**15 - 1, 2**15 - 1, 3))
        tracker = ContourTracker(Template.pistol("left"), StartPose((16440, 4150), 0.5, 80))
        used = re.search(r"VmSize:\\s+(\\d+) kB", Path("/proc/self/status").read_text())
        limit = int(used.group(1)) * 1024 + 2**24
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
        try:
            np.empty(2**25, np.uint8)
        except MemoryError:
            pass
        else:
            raise SystemExit("there is memory for a copy")
        print(tracker.update(image, 0.0).status, tracker.update(image, 0.1, colour).status)
        other = ContourTracker(Template.pistol("left"), StartPose((16440, 4150), 0.5, 80))
        for schedule in ("in-turn", "side-by-side"):
            views = [(tracker, image, 0.2, colour, None), (other, image, 0.2, None, None)]
            print(*(track.status for track in update_views(views, schedule=schedule)))
    """
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(program)], capture_output=True, text=True
    )
    assert (done.stdout, done.stderr) == (3 * "acquiring acquiring\n", "")


# --- bands, round fingers and the background -------------------------------------------------


def test_a_band_may_be_given_by_any_numeric_types():
    image = grey(80, 100)
    score = HandFinder.likeness(image, (60.0, 40.0), 0.3, 6.0)
    assert score is not None
    for tip in [[60, 40], np.array([60, 40]), np.array([60.0, 40.0], np.float32)]:
        assert HandFinder.likeness(image, tip, np.float64(0.3), 6) == score


@pytest.mark.parametrize(
    ("band", "complaint"),
    [
        (((60, 40, 1), 0.3, 6), r"^tip_px has the shape \(3,\); it must be \(2,\)"),
        ((None, 0.3, 6), "^tip_px has the dtype object"),
        (("ab", 0.3, 6), "^tip_px has the dtype <U2"),
        (((60, np.nan), 0.3, 6), "must be finite"),
        (((60, 40), "0.3", 6), "^angle_rad is '0.3'; it must be a real number"),
        (((60, 40), 0.3, None), "^half_width_px is None; it must be a real number"),
        (((60, 40), 0.3, True), "^half_width_px is True"),
        (((60, 40), 0.3, -1), "is -1; it must be"),
    ],
)
def test_invalid_bands_are_refused(band, complaint):
    with pytest.raises(InvalidInputError, match=complaint):
        HandFinder.likeness(grey(80, 100), *band)


def test_a_round_finger_may_be_given_by_any_numeric_types():
    image = grey(160, 200)
    finger = RoundFinger.fit(image, (110.0, 80.0), (140.0, 80.0), 8.0)
    assert finger is not None
    fitted = finger.offset_px, finger.turn_rad, finger.half_width_px, finger.misfit
    assert np.isfinite(fitted).all()
    assert finger.misfit <= finger.misfit_about_given
    assert repr(finger).startswith(f"RoundFinger(offset_px={finger.offset_px:.2f}, turn_rad=")
    same = RoundFinger.fit(image, [110, 80], np.array([140, 80]), np.float64(8))
    assert (same.offset_px, same.misfit) == (finger.offset_px, finger.misfit)
    # Three equal channels add the same residuals three times.
    colour = np.repeat(image[..., None], 3, axis=2)
    assert RoundFinger.fit(image, (110, 80), (140, 80), 8, colour).misfit > finger.misfit
    assert RoundFinger.fit(image, (20, 80), (50, 80), 8) is None


@pytest.mark.parametrize(
    ("finger", "complaint"),
    [
        (((60, 40, 1), (90, 40), 6), r"^anchor_px has the shape \(3,\); it must be \(2,\)"),
        (((60, 40), None, 6), "^tip_px has the dtype object"),
        (((60, np.nan), (90, 40), 6), "must be finite"),
        (((60, 40), (60, 40), 6), "is 0; it must be"),
        (((60, 40), (90, 40), "6"), "^half_width_px is '6'; it must be a real number"),
        (((60, 40), (90, 40), True), "^half_width_px is True"),
        (((60, 40), (90, 40), -1), "is -1; it must be"),
    ],
)
def test_invalid_round_fingers_are_refused(finger, complaint):
    with pytest.raises(InvalidInputError, match=complaint):
        RoundFinger.fit(grey(80, 100), *finger)


@pytest.mark.parametrize(
    ("part", "complaint"),
    [
        (3, "{what} is 3; it must be two ends"),
        ("abc", r"{what}\[0\] has the dtype <U1"),
        (((1, 2), (3, 4)), r"{what} is \(\(1, 2\), \(3, 4\)\); it must be two ends"),
        (((1, 2), (3, 4), 5, 6), "{what} is .*; it must be two ends"),
        (((1, 2), None, 5), r"{what}\[1\] has the dtype object"),
        (((1, 2), (3, 4), "5"), r"{what}\[2\] is '5'; it must be a real number"),
    ],
)
def test_invalid_image_parts_are_refused(part, complaint):
    background, image = Background(), grey(48, 64)
    for what, call in [
        (r"keep_out\[0\]", lambda: background.observe(image, keep_out=[part])),
        (r"keep_out\[0\]", lambda: background.learn(image, keep_out=[part])),
        ("part", lambda: background.forget(part)),
    ]:
        with pytest.raises(InvalidInputError, match="^" + complaint.format(what=what)):
            call()
    background.observe(image, keep_out=[[np.array([1, 2]), [3, 4], 5], ((1, 2), (1, 2), 3)])
    with pytest.raises(InvalidInputError, match="keep_out is 3; it must be a sequence of regions"):
        background.learn(image, keep_out=3)


# --- several views ---------------------------------------------------------------------------

SCHEDULES = ["by-need", "in-turn", "side-by-side", None]


def learned(image: np.ndarray) -> Background:
    """Return a background model learned from one image."""
    background = Background()
    for _ in range(40):
        background.observe(image)
    return background


def fingers(frames: int) -> Iterator[list[np.ndarray]]:
    """Yield three views of a finger that moves away from the start; it leaves the last view."""
    rng = np.random.default_rng(50)
    for k in range(frames):
        images = []
        for view in range(3):
            image = np.full((480, 640), 60, np.uint8)
            tip = np.array([320.0 + 2 * k, 240.0 + view])
            away = tip - 200 * np.array([np.cos(0.6), np.sin(0.6)])
            if view < 2 or k < 12:
                ends = [tuple(np.rint(16 * p).astype(int).tolist()) for p in (away, tip)]
                cv2.line(image, *ends, 170, 20, cv2.LINE_AA, shift=4)
            image = cv2.GaussianBlur(image, (0, 0), 1.0)
            images.append(np.clip(image + rng.normal(0, 2, image.shape), 0, 255).astype(np.uint8))
        yield images


def finger_trackers() -> list[ContourTracker]:
    template, start = Template.pistol("none"), StartPose((327, 245), 0.6, 85)
    return [ContourTracker(template, start) for _ in range(3)]


def contents(track: _core.Track | FingerpostError) -> tuple[object, ...]:
    """Return a track's contents, for comparison bit by bit."""
    assert isinstance(track, _core.Track)
    line, shape = track.finger_line, track.shape_vector
    return (
        repr(track),
        repr(track.diagnostics),
        shape if shape is None else shape.tobytes(),
        line and (line.anchor_px, line.angle_rad, line.covariance.tobytes(), line.source),
    )


@pytest.mark.parametrize("schedule", SCHEDULES)
def test_views_updated_in_one_call_equal_those_updated_alone(schedule):
    together, alone = finger_trackers(), finger_trackers()
    background, seen = learned(np.full((480, 640), 60, np.uint8)), set()
    for k, images in enumerate(fingers(24)):
        colours = [np.stack([images[0]] * 3, axis=-1), None, None]
        background.look(images[1])
        behind = [None, background, None]
        views = list(zip(together, images, [k / 30] * 3, colours, behind, strict=True))
        tracks = update_views(views, schedule=schedule)
        for (_, *frame, known), tracker, track in zip(views, alone, tracks, strict=True):
            assert contents(track) == contents(tracker.update(*frame, background=known))
        seen.update(track.status for track in tracks)
    assert seen == {"acquiring", "tracking", "lost"}


@pytest.mark.parametrize("schedule", SCHEDULES)
@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ({"image": np.zeros((480, 640))}, "^image is an array of dtype float64"),
        ({"image": np.zeros((0, 640), np.uint8)}, "480|empty|0"),
        ({"time_s": "now"}, "^time_s is 'now'"),
        ({"time_s": np.nan}, "time"),
        ({"colour": np.zeros((480, 641, 3), np.uint8)}, "641"),
        ({"background": learned(np.zeros((48, 64), np.uint8))}, "64 × 48 px and the frame 640"),
    ],
)
def test_an_error_in_one_view_leaves_the_other_tracks(entry, words, schedule):
    images = next(fingers(1))
    trackers, alone = finger_trackers(), finger_trackers()
    views = [(t, i, 0.0, None, None) for t, i in zip(trackers, images, strict=True)]
    bad = {"image": images[1], "time_s": 0.0, "colour": None, "background": None} | entry
    views[1] = (trackers[1], bad["image"], bad["time_s"], bad["colour"], bad["background"])
    first, refused, last = update_views(views, schedule=schedule)
    assert contents(first) == contents(alone[0].update(images[0], 0.0))
    assert contents(last) == contents(alone[2].update(images[2], 0.0))
    with pytest.raises(InvalidInputError, match=words):
        raise refused
    # The tracker is as it was before.
    assert contents(trackers[1].update(images[1], 0.0)) == contents(alone[1].update(images[1], 0.0))


def test_a_tracker_given_twice_is_updated_once():
    tracker, image = ContourTracker(PISTOL, WAITING), grey()
    first, second = update_views([(tracker, image, 0.0, None, None)] * 2)
    assert first.status == "acquiring"
    assert isinstance(second, FingerpostError)
    assert "in use" in str(second)
    assert tracker.update(image, 0.0).status == "acquiring"


def test_an_update_of_no_views_returns_no_tracks():
    assert update_views([]) == []


def test_an_unknown_schedule_is_refused():
    with pytest.raises(InvalidInputError, match=r'^schedule is .often.; it must be "by-need", '):
        update_views([], schedule="often")


def test_malformed_views_are_refused_before_any_update():
    tracker, image = ContourTracker(PISTOL, WAITING), grey()
    good = (tracker, image, 1.0, None, None)
    with pytest.raises(InvalidInputError, match=r"^views\[1\] has 3 entries"):
        update_views([good, (tracker, image, 0.0)])
    with pytest.raises(TypeError, match="ContourTracker"):
        update_views([good, (image, tracker, 0.0, None, None)])
    assert tracker.update(image, 0.0).time_s == 0.0


# --- threads ---------------------------------------------------------------------------------


@contextmanager
def no_forced_switches() -> Iterator[None]:
    """Make threads keep the GIL until they release it themselves."""
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1000.0)
    try:
        yield
    finally:
        sys.setswitchinterval(interval)


def overlap(calls: list[Callable[[], object]], rounds: int = 2000) -> bool:
    """Return whether two threads are ever inside their calls at once.

    No thread loses the GIL unless it releases it, so they overlap only if a call releases it:
    otherwise never; if it does, within a few rounds under any load. The pauses are random: equal
    ones could keep two threads in step without overlap.
    """
    inside: list[int] = []
    met: list[bool] = []
    together = threading.Barrier(len(calls))

    def work(call: Callable[[], object]) -> None:
        together.wait()
        for _ in range(rounds):
            if met:
                return
            time.sleep(random.uniform(0.0, 0.001))  # outside the call, let other threads run
            if inside:
                met.append(True)
            inside.append(1)
            try:
                call()
            finally:
                inside.pop()

    with no_forced_switches():
        threads = [threading.Thread(target=work, args=(call,)) for call in calls]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    return bool(met)


def test_threads_that_keep_the_gil_never_overlap():
    def keep() -> None:
        sum(range(2000))

    assert not overlap([keep, keep], rounds=200)


def heavy_calls() -> dict[str, Callable[[], object]]:
    rng = np.random.default_rng(2)
    spline = BSpline.open_uniform(3, 100)
    control_points, parameters = rng.normal(size=(100, 2)), rng.uniform(0, 97, 20000)
    outline = rng.normal(size=(1000, 2))
    arc_length = spline.arc_length(control_points)
    space, x = shape_space(9)
    image, (position, normal) = (
        grey(),
        (rng.uniform(50, 400, (4000, 2)), np.tile([1.0, 0], (4000, 1))),
    )
    rows, offsets, variances = rng.normal(size=(4000, 6)), rng.normal(size=4000), np.ones(4000)
    search, fitter = EdgeSearch(), Fitter()
    return {
        "BSpline.basis": lambda: spline.basis(parameters),
        "BSpline.evaluate": lambda: spline.evaluate(control_points, parameters),
        "BSpline.fit": lambda: spline.fit(outline, "chord-length"),
        "BSpline.arc_length": lambda: spline.arc_length(control_points),
        "ArcLength.parameter_at": lambda: arc_length.parameter_at(parameters),
        "ArcLength.equally_spaced": lambda: arc_length.equally_spaced(5000),
        "sample_contour": lambda: sample_contour(spline, control_points, 2000, "left"),
        "Template.pistol": lambda: Template.pistol("left"),
        "Template.outline": lambda: PISTOL.outline(5000),
        "Template.from_outline": lambda: Template.from_outline(
            outline, knuckle=(0, 0), tip=(1, 0), hand="left", control_points=60
        ),
        "ShapeSpace.place": lambda: space.place(x, PISTOL, 5000),
        "ShapeSpace.normal_rows": lambda: space.normal_rows(x, PISTOL, 5000),
        "EdgeSearch.search": lambda: search.search(image, position, normal, 40.0, "unknown"),
        "Fitter.solve": lambda: fitter.solve(rows, offsets, variances),
        "ContourTracker": lambda: ContourTracker(PISTOL, WAITING, {"samples": 2000}),
    }


@pytest.mark.parametrize("name", heavy_calls())
def test_heavy_calls_release_the_gil(name):
    call = heavy_calls()[name]
    assert overlap([call, call])


def test_two_trackers_run_in_parallel_threads():
    image = grey()
    first, second = ContourTracker(PISTOL, WAITING), ContourTracker(PISTOL, WAITING)
    assert overlap([lambda: first.update(image, 0.0), lambda: second.update(image, 0.0)], rounds=40)


@pytest.mark.parametrize("schedule", SCHEDULES)
def test_two_rigs_run_in_parallel_threads(schedule):
    image = grey()
    rigs = [
        [(ContourTracker(PISTOL, WAITING), image, 0.0, None, None) for _ in "lr"] for _ in range(2)
    ]
    calls = [functools.partial(update_views, rig, schedule=schedule) for rig in rigs]
    assert overlap(calls, rounds=40)


@pytest.mark.parametrize(
    "use",
    [
        lambda tracker: tracker.update(grey(), 0.0),
        lambda tracker: tracker.contour(),
        lambda tracker: tracker.search_lines(),
        lambda tracker: tracker.options,
        lambda tracker: tracker.template,
        repr,
    ],
)
def test_concurrent_use_of_one_tracker_is_refused_and_leaves_it_usable(use):
    tracker, image = ContourTracker(PISTOL, WAITING), grey()
    complaints: list[str] = []

    def update() -> None:
        try:
            tracker.update(image, 0.0)
        except FingerpostError as error:
            complaints.append(str(error))

    def disturb() -> None:
        try:
            use(tracker)
        except FingerpostError as error:
            complaints.append(str(error))

    # A thread that is entering or leaving its call does not use the tracker, so an overlap may go
    # without a complaint.
    for _ in range(200):
        assert overlap([update, disturb], rounds=40)
        if complaints:
            break
    assert set(complaints) == {
        "this ContourTracker is in use in another thread; each thread needs one of its own, or a "
        "lock"
    }
    assert tracker.update(image, 1.0).status == "acquiring"


# --- arbitrary input -------------------------------------------------------------------------

numbers = st.floats() | st.integers() | st.sampled_from([0.0, -0.0, 1e-320, 1e308, 2**63, -(2**70)])


@settings(max_examples=200)
@given(
    st.sampled_from([BSpline.open, BSpline.open_clamped, BSpline.closed]),
    st.integers(-1, 5),
    st.lists(numbers, max_size=12),
)
def test_any_knots_give_a_spline_or_an_error(make, degree, knots):
    try:
        spline = make(degree, knots)
    except InvalidInputError:
        return
    middle = np.mean(spline.domain) if np.isfinite(np.sum(spline.domain)) else spline.domain[0]
    assert spline.basis([middle]).values.sum() == pytest.approx(1)


@settings(max_examples=200)
@given(st.lists(numbers, min_size=6, max_size=6), st.sampled_from(SPACES))
def test_any_map_gives_a_finite_contour_or_an_error(values, kind):
    centre, linear = values[:2], np.array(values[2:], dtype=object).reshape(2, 2).tolist()
    try:
        if isinstance(kind, int):
            space, x = ShapeSpace.ribbon(PISTOL, centre, linear, kind)
        else:
            space, x = getattr(ShapeSpace, kind)(centre, linear)
        placed = space.place(x, PISTOL, 20)
    except InvalidInputError:
        return
    assert np.linalg.norm(placed.normal, axis=1) == pytest.approx(1)
    assert np.isfinite(placed.position_px).all()


def test_an_interruption_is_no_error_of_an_array():
    class Interrupted:
        def __array__(self, *_, **__):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Background().expected(Interrupted())
