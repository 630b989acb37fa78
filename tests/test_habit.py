"""A person's pointing habit: models, their selection, and the corrected point's covariance."""

import math

import numpy as np
import pytest
from scipy import stats
from scipy.spatial import ConvexHull

from fingerpost.errors import InvalidInputError
from fingerpost.habit import Habit, HabitModel, _nearest, _widening

FIVE = np.array([[60, 60], [340, 60], [340, 340], [60, 340], [200, 200]], np.float64)
TWELVE = np.array([[x, y] for x in (60, 150, 250, 340) for y in (60, 200, 340)], np.float64)
CENTRE = np.array([200.0, 200.0])

HABIT, SCATTER = 30.0, 10.0
"""Offset and scatter of the simulated people [mm]; the scatter is the RMS distance."""

BY_CHANCE = 0.03
"""Greatest deviation of a proportion of `PEOPLE` from its nominal value."""

PEOPLE = 500


def offset(point):
    return np.broadcast_to([24.0, -18.0], point.shape)


def affine(point):
    return offset(point) + (point - CENTRE) @ [[0.10, 0.04], [-0.06, 0.08]]


def quadratic(point):
    x, y = (point - CENTRE).T / 140
    return affine(point) + np.stack([8 * x * x - 5 * x * y, 9 * y * y + 4 * x * y], axis=-1)


def grid():
    return np.stack(np.meshgrid(*2 * [np.linspace(90.0, 310.0, 6)]), axis=-1).reshape(-1, 2)


@pytest.mark.parametrize(
    ("habit", "model"),
    [
        (offset, HabitModel.OFFSET),
        (affine, HabitModel.AFFINE),
        (quadratic, HabitModel.QUADRATIC),
    ],
)
def test_a_habit_without_scatter_is_estimated_and_corrected_exactly(habit, model):
    points = TWELVE + offset(TWELVE)
    found = Habit.of(points - habit(points), points)
    assert found.model is model
    assert found.error(grid()) == pytest.approx(habit(grid()), abs=1e-9)
    for point in grid():
        meant = found.meant(point, np.zeros((2, 2)))
        assert meant.point == pytest.approx(point - habit(point[None])[0], abs=1e-9)
        assert meant.covariance == pytest.approx(np.zeros((2, 2)), abs=1e-9)


def test_a_richer_model_needs_enough_targets_for_cross_validation():
    points = FIVE + offset(FIVE)
    assert set(Habit.of(FIVE, points).left_out) == {HabitModel.OFFSET, HabitModel.AFFINE}
    twice = Habit.of(np.tile(FIVE, (2, 1)), np.tile(points, (2, 1)))
    assert set(twice.left_out) == {HabitModel.OFFSET, HabitModel.AFFINE}  # the same targets
    points = TWELVE + offset(TWELVE)
    assert set(Habit.of(TWELVE, points).left_out) == set(HabitModel)


def test_cross_validation_leaves_out_targets_not_visits():
    rng = np.random.default_rng(5)
    targets = np.repeat(FIVE, 3, axis=0)
    points = targets + offset(targets) + rng.normal(0, 5, targets.shape)
    errors = (points - targets).reshape(5, 3, 2)
    squares = [
        np.sum((errors[k] - np.delete(errors, k, axis=0).mean(axis=(0, 1))) ** 2, axis=1).mean()
        for k in range(5)
    ]
    found = Habit.of(targets, points).left_out[HabitModel.OFFSET]
    assert found == pytest.approx(math.sqrt(np.mean(squares)))


@pytest.mark.parametrize("habit", [offset, affine, quadratic])
def test_the_covariance_of_a_fix_is_propagated_through_the_correction(habit):
    points = TWELVE + offset(TWELVE)
    found = Habit.of(points - habit(points), points)
    covariance = np.array([[9.0, 4.0], [4.0, 16.0]])
    for point in (np.array([190.0, 230.0]), np.array([500.0, 210.0])):  # inside, beyond a side
        step = 1e-4 * np.eye(2)
        J = np.column_stack(
            [
                (
                    found.meant(point + d, covariance).point
                    - found.meant(point - d, covariance).point
                )
                / 2e-4
                for d in step
            ]
        )
        meant, exact = found.meant(point, covariance), found.meant(point, np.zeros((2, 2)))
        expected = J @ covariance @ J.T
        assert meant.covariance - exact.covariance == pytest.approx(expected, abs=1e-4)


def test_the_covariance_of_an_offset_is_that_of_a_mean():
    """An offset has a closed form: Student's interval in two dimensions."""
    rng = np.random.default_rng(2)
    points = FIVE + offset(FIVE) + rng.normal(0, 1, FIVE.shape)
    found = Habit.of(FIVE, points)
    assert found.model is HabitModel.OFFSET
    errors = points - FIVE
    assert found.scatter == pytest.approx(math.sqrt(errors.var(axis=0, ddof=1).mean()))
    widening = 2 * stats.f.ppf(0.95, 2, 8) / stats.chi2.ppf(0.95, 2)
    expected = widening * found.scatter**2 * (1 + 1 / 5)
    covariance = found.meant([200, 200], np.zeros((2, 2))).covariance
    assert covariance == pytest.approx(expected * np.eye(2))


@pytest.mark.parametrize("freedom", [2, 4, 8, 18, 1000])
def test_an_estimated_variance_is_widened_by_the_ratio_of_f_and_chi_square(freedom):
    expected = 2 * stats.f.ppf(0.95, 2, freedom) / stats.chi2.ppf(0.95, 2)
    assert _widening(freedom) == pytest.approx(expected)


# --- many people ------------------------------------------------------------------------------


def people(targets, *, grows=0.0, unlike=1.0, seed):
    """Yield calibrations of people with a habit of 3 cm in any direction and 1 cm of scatter."""
    rng = np.random.default_rng(seed)
    scatter = SCATTER * np.array([unlike, 1.0]) / math.hypot(unlike, 1.0)
    for _ in range(PEOPLE):
        angle = rng.uniform(0, 2 * np.pi)
        first = HABIT * np.array([np.cos(angle), np.sin(angle)])
        gain = rng.normal(0, grows, (2, 2))

        def habit(target, first=first, gain=gain):
            return first + (target - CENTRE) @ gain

        def pointing(target, habit=habit):
            return target + habit(target) + rng.normal(0, 1, target.shape) * scatter

        yield Habit.of(targets, pointing(targets)), habit, pointing, rng


def test_five_targets_remove_four_fifths_of_the_bias():
    left = []
    for found, habit, _, _ in people(FIVE, seed=7):
        bias = habit(grid())
        rest = bias - found.error(grid() + bias)
        left.append(np.linalg.norm(rest, axis=1).mean() / HABIT)
    assert 1 - np.mean(left) >= 0.8


@pytest.mark.parametrize(
    ("targets", "grows", "unlike"),
    [(FIVE, 0.0, 1.0), (FIVE, 0.1, 1.0), (TWELVE, 0.1, 1.0), (FIVE, 0.0, 2.0)],
)
def test_ellipses_of_many_people_have_nominal_coverage(targets, grows, unlike):
    held = []
    for found, _, pointing, rng in people(targets, grows=grows, unlike=unlike, seed=8):
        target = rng.uniform(80, 320, (1, 2))
        meant = found.meant(pointing(target)[0], np.zeros((2, 2)))
        off = meant.point - target[0]
        held.append(off @ np.linalg.solve(meant.covariance, off) <= stats.chi2.ppf(0.95, 2))
    assert np.mean(held) == pytest.approx(0.95, abs=BY_CHANCE)


# --- beyond the targets -----------------------------------------------------------------------


def test_beyond_the_targets_the_correction_is_constant_and_the_ellipse_grows():
    points = TWELVE + affine(TWELVE)
    found = Habit.of(TWELVE, points)
    inside = found.meant([200, 200], np.eye(2))
    assert inside.beyond == 0.0
    corner = points[np.argmax(points.sum(axis=1))]
    sigmas, corrections = [], []
    for away in (0.0, 50.0, 100.0, 1000.0):
        point = corner + away * np.array([0.6, 0.8])
        meant = found.meant(point, np.eye(2))
        sigmas.append(math.sqrt(np.linalg.eigvalsh(meant.covariance)[1]))
        corrections.append(point - meant.point)
        assert meant.beyond == pytest.approx(away)
    assert np.all(np.diff(sigmas) > 0)
    assert np.linalg.norm(np.diff(corrections, axis=0), axis=1) == pytest.approx(0, abs=1e-9)
    # Far away from the targets, the habit may be a different one of the same size.
    assert sigmas[3] > 3 * HABIT


@pytest.mark.parametrize("seed", range(4))
def test_the_nearest_point_of_the_hull(seed):
    rng = np.random.default_rng(seed)
    corners = rng.uniform(0, 100, (9, 2))
    found = Habit.of(corners, corners)._hull
    expected = corners[ConvexHull(corners).vertices]
    assert {tuple(p) for p in found.tolist()} == {tuple(p) for p in expected.tolist()}
    share = rng.dirichlet(np.full(len(found), 0.3), 4000)
    for point in rng.uniform(-80, 180, (20, 2)):
        nearest, by_point = _nearest(found, point)
        drawn = np.linalg.norm(share @ found - point, axis=1).min()
        assert math.dist(nearest, point) <= drawn + 1e-9
        step = [
            (_nearest(found, point + d)[0] - _nearest(found, point - d)[0]) / 2e-6
            for d in 1e-6 * np.eye(2)
        ]
        assert by_point == pytest.approx(np.column_stack(step), abs=1e-6)


# --- invalid calibrations ---------------------------------------------------------------------


@pytest.mark.parametrize(
    ("targets", "points", "words"),
    [
        (FIVE[:4], FIVE[:4], "4 different targets; a habit is estimated from 5 or more"),
        (np.tile(FIVE[:4], (2, 1)), np.tile(FIVE[:4], (2, 1)), "4 different targets"),
        (FIVE, FIVE[:4], "4 points of 5 targets; one each is right"),
        (FIVE, FIVE[::-1], "the points do not go with the targets"),
        (FIVE, np.tile(CENTRE, (5, 1)), "the points do not go with the targets"),
        (FIVE * [1, 0.001], FIVE * [1, 0.001], "the targets lie on a line"),
        (FIVE, FIVE * np.nan, "points[0, 0] is nan"),
        (FIVE, FIVE[:, 0], "points: shape (5,) found"),
    ],
)
def test_insufficient_calibrations_are_refused(targets, points, words):
    with pytest.raises(InvalidInputError) as raised:
        Habit.of(targets, points)
    assert words in str(raised.value)
