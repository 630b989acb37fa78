"""Consistency of visited places: χ² tables, Monte Carlo, and simulated wrong detections."""

import itertools
import math

import numpy as np
import pytest
from guidance_scene import HEIGHT_M, REGION_M, pixel
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2, kstest

from fingerpost.errors import InvalidInputError
from fingerpost.guidance import (
    InconsistentPlaneError,
    PoorPlaneError,
    Sightings,
    agree,
    need_certainty,
    spread_places,
)
from fingerpost.guidance.agreement import chi2_limit, tie_view
from fingerpost.lens import Lens
from fingerpost.robot import SafeRegion

SIGMA_PX = 0.4
REGION = SafeRegion(np.array(REGION_M), 0.0, 0.2)
NINE = spread_places(REGION, 9)
NAMES = ("left", "right")


def seen(positions, rng, *, sigma_px=SIGMA_PX, arm=None, claimed_px=None, wrong=None):
    """Simulate both views' sightings of places, with noise of the finder and of the arm."""
    stand = positions if arm is None else positions + arm
    views = []
    for k, name in enumerate(NAMES):
        px = pixel(k, np.column_stack([stand, np.full(len(stand), HEIGHT_M)]))
        px = px + rng.normal(0, sigma_px, px.shape)
        for place, (view, shift) in (wrong or {}).items():
            if view == k:
                px[place] += shift
        Σ = np.tile((claimed_px or sigma_px) ** 2 * np.eye(2), (len(px), 1, 1))
        views.append(Sightings(name, px, Σ))
    return views


@pytest.mark.parametrize("freedom", [2, 4, 10, 34, 92])
@pytest.mark.parametrize("tail", [0.5, 0.05, 1e-3, 1e-6])
def test_the_limit_matches_chi_square_tables(freedom, tail):
    assert chi2_limit(freedom, tail) == pytest.approx(chi2.isf(tail, freedom), rel=1e-9)


@pytest.mark.parametrize(("freedom", "tail"), [(3, 0.1), (0, 0.1), (2, 0.0), (2, 1.0)])
def test_invalid_arguments_of_the_limit_are_refused(freedom, tail):
    with pytest.raises(InvalidInputError):
        chi2_limit(freedom, tail)


def test_residuals_and_leave_one_out_distances_follow_chi_square():
    """The arm's own error counts too; the homography propagates it into the image."""
    rng = np.random.default_rng(11)
    arm_sigma_m = 0.0005
    sums, squares = [], []
    for _ in range(150):
        arm = rng.normal(0, arm_sigma_m, (9, 2))
        tie = tie_view(NINE, seen(NINE, rng, arm=arm)[0], arm_sigma_m)
        sums.append(tie.chi2)
        squares.append(tie.distances[4] ** 2)
    assert tie.freedom == 10
    assert kstest(sums, chi2(10).cdf).pvalue > 0.01
    assert kstest(squares, chi2(2).cdf).pvalue > 0.01


def test_the_reported_standard_deviation_matches_the_scatter():
    rng = np.random.default_rng(12)
    arm_sigma_m = 0.0005
    corner = np.array(REGION_M[2])
    there = []
    for _ in range(250):
        tie = tie_view(
            NINE, seen(NINE, rng, arm=rng.normal(0, arm_sigma_m, (9, 2)))[1], arm_sigma_m
        )
        there.append(tie.plane_view.back_project(pixel(1, [*corner, HEIGHT_M])))
    scatter = np.sqrt(np.linalg.eigvalsh(np.cov(np.transpose(there)))[-1])
    assert tie.sigma_m(corner) == pytest.approx(scatter, rel=0.15)


def test_good_places_are_rejected_about_once_in_a_thousand():
    rng = np.random.default_rng(13)
    alarms = sum(bool(agree(NINE, seen(NINE, rng)).wrong) for _ in range(80))
    assert alarms <= 2


@settings(max_examples=25)
@given(
    st.sets(st.integers(0, 8), min_size=1, max_size=2),
    st.integers(0, 1),
    st.floats(30.0 * SIGMA_PX, 300.0),  # by less, one of two may be consistent with the rest
    st.floats(0.0, 2 * math.pi),
    st.integers(0, 2**32 - 1),
)
def test_wrong_detections_are_named(places, view, shift_px, turn, seed):
    rng = np.random.default_rng(seed)
    shift = shift_px * np.array([math.cos(turn), math.sin(turn)])
    wrong = {place: (view, shift * (1 + k)) for k, place in enumerate(sorted(places))}
    try:
        agreement = agree(NINE, seen(NINE, rng, wrong=wrong))
    except InconsistentPlaneError:
        assert len(places) == 2  # one is always identified; with two, the set may be ambiguous
        return
    # A good place may occasionally be rejected with the wrong ones, but no wrong one is kept.
    assert places <= set(agreement.wrong)
    assert set(agreement.kept) | set(agreement.wrong) == set(range(9))
    assert np.linalg.norm(agreement.ties[view].residuals_px, axis=1).max() < 5 * SIGMA_PX


def test_two_interchanged_detections_are_named():
    rng = np.random.default_rng(14)
    views = seen(NINE, rng)
    px = views[0].pixels_px.copy()
    px[[2, 6]] = px[[6, 2]]
    views[0] = Sightings("left", px, views[0].covariances_px2)
    assert agree(NINE, views).wrong == (2, 6)


def test_five_places_show_that_one_is_wrong_but_not_which():
    rng = np.random.default_rng(15)
    five = spread_places(REGION, 5)
    with pytest.raises(InconsistentPlaneError):
        agree(five, seen(five, rng, wrong={1: (0, [20.0, 0.0])}))


def test_two_equally_good_explanations_are_an_error():
    rng = np.random.default_rng(16)
    six = spread_places(REGION, 6)
    wrong = {4: (0, [4.5 * SIGMA_PX, 0.0])}
    views = seen(six, rng, sigma_px=0.01, claimed_px=SIGMA_PX / 4, wrong=wrong)
    with pytest.raises(InconsistentPlaneError, match=r"one of the places .* is wrong"):
        agree(six, views, numbers=range(11, 17))


def test_many_wrong_detections_are_an_error_with_advice():
    rng = np.random.default_rng(17)
    wrong = {place: (0, rng.normal(0, 4, 2)) for place in range(9)}
    with pytest.raises(InconsistentPlaneError, match=r"view left: .* px is expected"):
        agree(NINE, seen(NINE, rng, wrong=wrong))
    everywhere = [
        Sightings(name, rng.uniform(0, 400, (9, 2)), np.tile(np.eye(2), (9, 1, 1)))
        for name in NAMES
    ]
    with pytest.raises(InconsistentPlaneError, match="no homography fits"):
        agree(NINE, everywhere)


def test_an_unconfigured_lens_is_detected_and_a_configured_one_is_corrected():
    rng = np.random.default_rng(18)
    lens = Lens(fx=900.0, fy=900.0, cx=319.5, cy=239.5, k1=-0.35, k2=0.0)
    straight = seen(NINE, rng, sigma_px=0.02)
    bent = [
        Sightings(view.name, lens.distort(view.pixels_px), view.covariances_px2, None)
        for view in straight
    ]
    with pytest.raises(InconsistentPlaneError, match="lens"):
        agree(NINE, bent)
    corrected = [Sightings(v.name, v.pixels_px, v.covariances_px2, lens) for v in bent]
    agreement = agree(NINE, corrected, arm_sigma_m=1e-5)
    assert agreement.wrong == ()
    for tie, view in zip(agreement.ties, straight, strict=True):
        ideal = tie_view(NINE, view, 1e-5)
        np.testing.assert_allclose(
            tie.plane_view.image_from_plane, ideal.plane_view.image_from_plane, atol=0.5
        )
        np.testing.assert_allclose(tie.distances, ideal.distances, atol=0.2)


def test_four_places_are_reported_as_unchecked():
    rng = np.random.default_rng(19)
    four = spread_places(REGION, 4)
    agreement = agree(four, seen(four, rng, wrong={0: (0, [9.0, 9.0])}))
    assert not agreement.checked
    assert np.isnan(agreement.ties[0].distances).all()
    assert agree(NINE, seen(NINE, rng)).checked


# Poor sets of places.


def test_too_few_places_are_refused():
    with pytest.raises(PoorPlaneError, match=r"3 places found; .* at least 4"):
        agree(NINE[:3], seen(NINE[:3], np.random.default_rng(0)))


@pytest.mark.parametrize(
    ("positions", "words"),
    [
        (np.column_stack([np.linspace(0.36, 0.5, 9), np.full(9, 0.1)]), "on one line"),
        (
            np.column_stack([np.linspace(0.36, 0.5, 9), 0.1 + 0.002 * (np.arange(9) % 3)]),
            "nearly on one line",
        ),
        (NINE.mean(axis=0) + 0.02 * (NINE - NINE.mean(axis=0)), "px in the image"),
        (NINE.mean(axis=0) + 0.25 * (NINE - NINE.mean(axis=0)), "cover little of the region"),
    ],
)
def test_poor_sets_of_places_are_refused_with_advice(positions, words):
    rng = np.random.default_rng(20)
    with pytest.raises(PoorPlaneError, match=words):
        need_certainty(agree(positions, seen(positions, rng)), np.array(REGION_M), 0.003)


def test_noisy_detections_make_a_poor_plane():
    rng = np.random.default_rng(21)
    agreement = agree(NINE, seen(NINE, rng, sigma_px=4.0))
    with pytest.raises(PoorPlaneError, match=r"view (left|right): .* mm will do; .* find the"):
        need_certainty(agreement, np.array(REGION_M), 0.003)
    assert need_certainty(agreement, np.array(REGION_M), 0.03).shape == (2, 4)


def test_invalid_sightings_are_refused():
    with pytest.raises(InvalidInputError, match="pixels_px"):
        Sightings("left", np.zeros((3, 3)), np.zeros((3, 2, 2)))
    with pytest.raises(InvalidInputError, match="2 pixels_px but 3 covariances_px2"):
        Sightings("left", np.zeros((2, 2)), np.tile(np.eye(2), (3, 1, 1)))


# Places to visit.


@pytest.mark.parametrize("count", [4, 5, 6, 9, 16, 25, 50])
def test_places_are_inside_the_region_and_well_spread(count):
    places = spread_places(REGION, count)
    assert places.shape == (count, 2)
    assert all(REGION.contains(place, 0.1, within=1e-12) for place in places)
    apart = [math.dist(a, b) for a, b in itertools.combinations(places, 2)]
    assert min(apart) > 0.6 * math.sqrt(0.18 * 0.22 / count)
    for corner in REGION_M:
        assert np.linalg.norm(places - corner, axis=1).min() < 1e-9


def test_places_of_a_rectangle_are_its_corners_middle_and_sides():
    square = SafeRegion([[0, 0], [1, 0], [1, 1], [0, 1]], 0.0, 0.1)
    places = {tuple(map(float, place)) for place in spread_places(square, 9)}
    assert places == set(itertools.product((0.0, 0.5, 1.0), repeat=2))


def test_the_path_is_short_and_deterministic():
    places = spread_places(REGION, 9)
    way_m = np.linalg.norm(np.diff(places, axis=0), axis=1).sum()
    assert way_m < 1.2 * 8 * 0.11
    np.testing.assert_array_equal(places, spread_places(REGION, 9))


def test_a_polygon_with_more_corners_than_places():
    ring = [[math.cos(a), math.sin(a)] for a in np.linspace(0, 2 * math.pi, 13)[:-1]]
    places = spread_places(SafeRegion(ring, 0.0, 0.1), 4)
    assert np.linalg.norm(places, axis=1) == pytest.approx(1.0)
    assert np.linalg.svd(places - places.mean(axis=0), compute_uv=False)[1] > 1.0
