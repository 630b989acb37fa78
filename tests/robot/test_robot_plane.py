"""The plane in the robot's frame, and the safe region over it."""

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.optimize import minimize
from scipy.spatial import ConvexHull

from fingerpost.errors import InvalidInputError
from fingerpost.homography import estimate_image_from_plane
from fingerpost.robot.plane import RobotPlane
from fingerpost.robot.protocol import TOOL_DOWN_RAD, Pose
from fingerpost.robot.region import SafeRegion
from fingerpost.uncertainty import homography_covariance

SEED = 1994
DRAWS = 5000
SCATTER = 0.06
"""Three standard deviations of a variance estimated from `DRAWS` samples: 3 √(2 / 5000)."""

# Plane in millimetres, the robot's base behind it and rotated by 30°, with weak perspective, as a
# homography from few, slightly wrong gripper positions may have.
TURN = math.radians(30)
TIE = np.array(
    [
        [1e-3 * math.cos(TURN), -1e-3 * math.sin(TURN), 0.35],
        [1e-3 * math.sin(TURN), 1e-3 * math.cos(TURN), -0.15],
        [2e-5, -1e-5, 1.0],
    ]
)
CORNERS = np.array([[0.0, 0.0], [300.0, 0.0], [300.0, 200.0], [0.0, 200.0]])


def tie_covariance(sigma_m=0.0005):
    """Return nine points and the covariance of a homography from them, with σ 0.5 mm per point."""
    points = np.array([[x, y] for x in (0.0, 150.0, 300.0) for y in (0.0, 100.0, 200.0)])
    return points, homography_covariance(TIE, points, sigma_m**2 * np.eye(2))


def test_points_map_to_the_robot_and_back():
    plane = RobotPlane(TIE, 0.05)
    points = np.random.default_rng(SEED).uniform([0, 0], [300, 200], (50, 2))
    homogeneous = np.column_stack([points, np.ones(50)]) @ TIE.T
    np.testing.assert_allclose(plane.position_m(points), homogeneous[:, :2] / homogeneous[:, 2:])
    np.testing.assert_allclose(plane.point(plane.position_m(points)), points)


def test_a_pose_is_above_its_point_and_follows_the_slope():
    plane = RobotPlane(TIE, 0.05, slope=np.array([0.01, -0.02]), pitch_rad=TOOL_DOWN_RAD)
    pose = plane.pose([100.0, 50.0], 0.03)
    x, y = plane.position_m([100.0, 50.0])
    assert pose == Pose(x, y, 0.05 + 0.01 * x - 0.02 * y + 0.03, pitch_rad=TOOL_DOWN_RAD)
    assert plane.above_m(pose) == pytest.approx(0.03)


def test_coordinates_may_be_the_robots_own():
    plane = RobotPlane.same(0.1, unit_m=0.001)
    assert plane.pose([250.0, -40.0], 0.0) == Pose(0.25, -0.04, 0.1)


def test_the_covariance_of_a_position_matches_monte_carlo():
    rng = np.random.default_rng(SEED)
    points, Σ_tie = tie_covariance()
    plane = RobotPlane(TIE, 0.05, Σ_tie)
    target, Σ = np.array([220.0, 60.0]), np.array([[4.0, 1.5], [1.5, 2.0]])
    visited = plane.position_m(points)
    drawn = []
    for _ in range(DRAWS):
        tie = estimate_image_from_plane(points, visited + 0.0005 * rng.standard_normal((9, 2)))
        drawn.append(RobotPlane(tie, 0.05).position_m(rng.multivariate_normal(target, Σ)))
    predicted = plane.covariance_m2(target, Σ)
    np.testing.assert_allclose(
        np.cov(np.array(drawn).T), predicted, rtol=0.0, atol=SCATTER * np.abs(predicted).max()
    )
    exact = RobotPlane(TIE, 0.05).covariance_m2(target, Σ)
    assert np.linalg.eigvalsh(predicted - exact).min() > 0


@pytest.mark.parametrize(
    "change",
    [
        {"robot_from_plane": np.zeros((3, 3))},
        {"robot_from_plane": np.eye(2)},
        {"robot_from_plane": np.full((3, 3), np.nan)},
        {"height_m": math.nan},
        {"entries_covariance": -np.eye(9)},
        {"slope": [0.0]},
    ],
)
def test_an_invalid_homography_is_refused(change):
    with pytest.raises(InvalidInputError):
        RobotPlane(**{"robot_from_plane": TIE, "height_m": 0.0, **change})


def test_beyond_the_horizon_there_is_no_position():
    plane = RobotPlane(TIE, 0.0)
    with pytest.raises(InvalidInputError, match="horizon"):
        plane.position_m([-60_000.0, 0.0])


# The safe region.


@st.composite
def convex_polygons(draw):
    seed = draw(st.integers(0, 2**32 - 1))
    count = draw(st.integers(3, 9))
    stretch = draw(st.sampled_from([1.0, 0.05, 1e-3]))
    points = np.random.default_rng(seed).normal(size=(count, 2)) * [100.0, 100.0 * stretch]
    hull = ConvexHull(points)
    corners = points[hull.vertices]
    return corners[::-1] if draw(st.booleans()) else corners


coordinates = st.floats(-1e4, 1e4, allow_nan=False)
NEAR_SIDE = 1e-6


@given(convex_polygons(), st.tuples(coordinates, coordinates), st.floats(-10, 10))
def test_a_clamped_point_is_the_nearest_inside(corners, point, above_m):
    region = SafeRegion(corners, 0.0, 0.2)
    clamped, height_m = region.clamp(point, above_m)
    assert region.contains(clamped, height_m, within=NEAR_SIDE)
    assert height_m == min(max(above_m, 0.0), 0.2)
    nothing = np.linalg.norm(clamped - point)
    # No point of any side is nearer; the projection onto a convex set is unique.
    for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        shares = np.linspace(0.0, 1.0, 21)[:, None]
        distances = np.linalg.norm(start + shares * (end - start) - point, axis=1)
        assert nothing <= distances.min() + NEAR_SIDE
    again, _ = region.clamp(clamped, height_m)
    np.testing.assert_allclose(again, clamped, atol=NEAR_SIDE)


@given(convex_polygons(), st.integers(0, 2**32 - 1))
def test_clamping_keeps_a_point_inside(corners, seed):
    weights = np.random.default_rng(seed).dirichlet(np.ones(len(corners)))
    region = SafeRegion(corners, 0.0, 0.2)
    inside = 0.99 * (weights @ corners) + 0.01 * region.centre
    assume(region.contains(inside, 0.1))
    clamped, height_m = region.clamp(inside, 0.1)
    np.testing.assert_array_equal(clamped, inside)
    assert height_m == 0.1


@given(
    convex_polygons(), st.floats(0.0, 5.0), st.tuples(coordinates, coordinates), st.floats(-1, 1)
)
def test_the_inset_region_keeps_its_distance_from_the_border(corners, distance, point, above_m):
    region = SafeRegion(corners, 0.0, 0.2)
    try:
        inner = region.inset(distance, 0.01)
    except InvalidInputError:
        return
    clamped, height_m = inner.clamp(point, above_m)
    sides = np.roll(region.corners, -1, axis=0) - region.corners
    normals = np.column_stack([-sides[:, 1], sides[:, 0]])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    assert (((clamped - region.corners) * normals).sum(axis=1) >= distance - NEAR_SIDE).all()
    assert 0.01 <= height_m <= 0.19


def test_the_clamp_agrees_with_an_optimiser():
    region = SafeRegion([[0, 0], [4, 1], [5, 4], [1, 5]], 0.0, 1.0)
    normals = region._normals()
    for point in np.random.default_rng(SEED).uniform(-3, 8, (20, 2)):
        best = minimize(
            lambda x, point=point: ((x - point) ** 2).sum(),
            region.centre,
            constraints=[
                {"type": "ineq", "fun": lambda x, n=n, c=c: n @ (x - c)}
                for n, c in zip(normals, region.corners, strict=True)
            ],
            tol=1e-12,
        )
        np.testing.assert_allclose(region.clamp(point, 0.5)[0], best.x, atol=1e-5)


@pytest.mark.parametrize(
    ("corners", "words"),
    [
        ([[0, 0], [1, 0]], "at least 3"),
        ([[0, 0], [1, 0], [2, 0]], "convex"),
        ([[0, 0], [1, 0], [1, 0], [0, 1]], "convex"),
        ([[0, 0], [2, 0], [1, 0.5], [2, 2]], "convex"),
        ([[0, 0], [1, 1], [1, 0], [0, 1]], "convex"),
        ([[0, 0], [1, 0], [2, 0], [2, 2], [0, 2]], "convex"),
        (
            [[math.cos(4 * math.pi * k / 5), math.sin(4 * math.pi * k / 5)] for k in range(5)],
            "more than once",
        ),
        ([[0, 0], [1, 0], [0, math.nan]], "finite"),
    ],
)
def test_a_region_that_is_not_convex_is_refused(corners, words):
    with pytest.raises(InvalidInputError, match=words):
        SafeRegion(corners, 0.0, 0.1)


def test_heights_must_be_in_order():
    with pytest.raises(InvalidInputError, match="highest_m"):
        SafeRegion(CORNERS, 0.2, 0.1)
    with pytest.raises(InvalidInputError, match="too small"):
        SafeRegion(CORNERS, 0.1, 0.11).inset(1.0, 0.01)
    with pytest.raises(InvalidInputError, match="too small"):
        SafeRegion(CORNERS, 0.0, 0.2).inset(110.0, 0.0)


@given(convex_polygons(), st.integers(0, 2**32 - 1))
def test_a_straight_path_between_safe_points_is_safe(corners, seed):
    rng = np.random.default_rng(seed)
    region = SafeRegion(corners, 0.0, 0.2)
    plane = RobotPlane(TIE, 0.05)
    ends = [plane.pose(rng.dirichlet(np.ones(len(corners))) @ corners, 0.1) for _ in range(2)]
    for share in np.linspace(0.0, 1.0, 11):
        position = (1 - share) * ends[0].position_m + share * ends[1].position_m
        assert region.contains(plane.point(position[:2]), 0.1, within=NEAR_SIDE)
