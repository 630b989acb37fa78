"""Covariances against Monte Carlo: 5 % of a variance is 3 standard errors of 8,000 samples."""

import numpy as np
import pytest
from geometry_rig import CORNERS, camera, covariance_of, finger_line, rod
from scipy.optimize import minimize
from scipy.stats import chi2

from fingerpost.errors import InvalidInputError
from fingerpost.homography import (
    estimate_image_from_plane,
    transfer_jacobian_by_entries,
    transfer_to_image,
)
from fingerpost.lines import (
    distance,
    intersection,
    line_at_angle,
    line_through,
)
from fingerpost.uncertainty import (
    UNBOUNDED,
    Intersection,
    confidence_ellipse,
    constraint,
    constraint_components,
    constraint_lines,
    entries_form,
    homography_covariance,
    intersect,
    line_and_covariance,
    nsigma_ellipse,
    widened_covariance,
)

SAMPLES = 8000
GRID = np.array([[x, y] for x in (0.0, 200.0, 400.0) for y in (0.0, 200.0, 400.0)])


def close_to_sampled(sampled, analytic, tolerance=0.05):
    """Return whether every entry is within `tolerance` of the product of its two sigmas."""
    sigma = np.sqrt(np.diag(analytic))
    return np.all(np.abs(sampled - analytic) <= tolerance * np.outer(sigma, sigma))


def images_of(view, points):
    return view.project(np.column_stack([points, np.zeros(len(points))]))


def homographies_through(plane, images):
    """Exact homographies through four points, image sets (..., 4, 2): plain 8 × 8 systems."""
    X = np.column_stack([plane, np.ones(4)])
    A = np.zeros((*images.shape[:-2], 8, 8))
    A[..., 0:4, 0:3] = X
    A[..., 4:8, 3:6] = X
    A[..., 0:4, 6:8] = -images[..., 0, None] * plane
    A[..., 4:8, 6:8] = -images[..., 1, None] * plane
    b = np.concatenate([images[..., 0], images[..., 1]], axis=-1)
    h = np.linalg.solve(A, b[..., None])[..., 0]
    return np.concatenate([h, np.ones_like(h[..., :1])], axis=-1).reshape(*h.shape[:-1], 3, 3)


@pytest.mark.parametrize("points", [CORNERS, GRID], ids=["four", "nine"])
def test_homography_covariance_meets_monte_carlo(points):
    rng = np.random.default_rng(41)
    roots = 0.2 * (rng.normal(0, 1, (len(points), 2, 2)) + 2 * np.eye(2))
    covariances = roots @ roots.transpose(0, 2, 1)
    image = images_of(camera(15.0), points)
    T = estimate_image_from_plane(points, image, covariances)
    H = homography_covariance(T, points, covariances)
    # Entries have a free scale; images of points have none.
    probes = np.array([[130.0, 260.0], [-150.0, 500.0], [650.0, 380.0]])
    jacobian = transfer_jacobian_by_entries(T, probes).reshape(-1, 9)
    count = SAMPLES if len(points) == 4 else SAMPLES // 2
    noisy = image + np.einsum("nij,snj->sni", roots, rng.normal(0, 1, (count, *image.shape)))
    if len(points) == 4:
        sampled = transfer_to_image(homographies_through(points, noisy)[:, None], probes)
    else:
        sampled = [
            transfer_to_image(estimate_image_from_plane(points, pixels, covariances), probes)
            for pixels in noisy
        ]
    sampled = covariance_of(np.reshape(sampled, (count, -1)))
    assert close_to_sampled(sampled, jacobian @ H @ jacobian.T, 0.05 if count == SAMPLES else 0.07)


def test_homography_covariance_has_rank_eight_and_a_gauge():
    T = estimate_image_from_plane(CORNERS, images_of(camera(15.0), CORNERS))
    H = homography_covariance(T, CORNERS, np.eye(2))
    assert H.shape == (9, 9)
    scale = np.abs(T.ravel())
    eigenvalues = np.linalg.eigvalsh(H / np.outer(scale, scale))
    assert abs(eigenvalues[0]) < 1e-12 * eigenvalues[1]


def test_homography_covariance_stays_exact_far_from_the_planes_origin():
    """A robot's base may be far away: the covariance of a point's image must not change."""
    image = images_of(camera(15.0), CORNERS)
    variances = []
    for shift in ([0.0, 0.0], [4e5, -3e5]):
        plane = CORNERS + shift
        T = estimate_image_from_plane(plane, image)
        J = transfer_jacobian_by_entries(T, np.array([300.0, 100.0]) + shift)
        variances.append(J @ homography_covariance(T, plane, 0.01 * np.eye(2)) @ J.T)
    assert np.allclose(variances[0], variances[1], rtol=1e-5)


def test_nearly_collinear_references_are_uncertain_across_their_line():
    sigmas = []
    for height in (400.0, 40.0, 4.0):
        plane = CORNERS * [1.0, height / 400.0]
        T = estimate_image_from_plane(plane, images_of(camera(15.0), plane))
        J = transfer_jacobian_by_entries(T, np.array([200.0, 600.0]))
        H = homography_covariance(T, plane, 0.01 * np.eye(2))
        sigmas.append(np.sqrt(np.trace(J @ H @ J.T)))
    assert sigmas[2] > 5 * sigmas[1] > 25 * sigmas[0]


def image_lines(anchor, angle, covariance):
    """Lines and their covariances, with the image as the plane."""
    return constraint_lines(np.eye(3), np.zeros((9, 9)), anchor, angle, covariance)


def test_the_covariance_of_a_line_is_that_of_a_shift_and_a_turn():
    anchor, angle = np.array([300.0, 200.0]), 0.8
    covariance = np.array([[0.04, 3e-4], [3e-4, 9e-6]])
    line, spread = image_lines(anchor, angle, covariance)
    assert np.allclose(line, line_at_angle(anchor, angle), rtol=1e-15)
    for lever in (-50.0, 0.0, 200.0):
        x = np.array([*(anchor + lever * np.array([np.cos(angle), np.sin(angle)])), 1.0])
        expected = np.array([1, lever]) @ covariance @ [1, lever]
        assert x @ spread @ x == pytest.approx(expected, rel=1e-9)


def chained(T, H, anchor, angle, covariance):
    """Constraint line by matrices: finger line, eq. 2, and both Jacobians."""
    s, c = np.sin(angle), np.cos(angle)
    line = np.array([-s, c, s * anchor[0] - c * anchor[1]])
    by_finger = np.array([[0.0, -c], [0.0, -s], [-1.0, c * anchor[0] + s * anchor[1]]])
    by_entries = np.hstack([entry * np.eye(3) for entry in line])
    m = T.T @ line
    spread = T.T @ by_finger @ covariance @ by_finger.T @ T + by_entries @ H @ by_entries.T
    length = np.hypot(m[0], m[1])
    return m / length, spread / length**2


def test_constraint_lines_of_arrays_and_of_floats_equal_the_matrix_formula():
    rng = np.random.default_rng(47)
    for _ in range(200):
        T = rng.normal(size=(3, 3)) * 10.0 ** rng.integers(-3, 3, (3, 1))
        factors, finger = (
            rng.normal(size=(9, 9)) * 10.0 ** rng.integers(-4, 2),
            rng.normal(size=(2, 2)),
        )
        H, covariance = factors @ factors.T, finger @ finger.T
        anchor, angle = rng.uniform(-500, 500, 2), rng.uniform(-4, 4)
        line, spread = chained(T, H, anchor, angle, covariance)
        lines, spreads = constraint_lines(
            np.stack([T, T]), np.stack([H, 0.0 * H]), [anchor] * 2, [angle] * 2, [covariance] * 2
        )
        sizes = np.sqrt(np.outer(np.diag(spread), np.diag(spread)))
        assert np.allclose(lines, line, rtol=0, atol=1e-12 * abs(line).max())
        assert (abs(spreads[0] - spread) <= 1e-11 * sizes).all()
        assert np.allclose(spreads[1], chained(T, 0.0 * H, anchor, angle, covariance)[1], rtol=1e-7)
        m, entries = constraint_components(
            T.tolist(),
            entries_form(H).tolist(),
            tuple(anchor.tolist()),
            (np.cos(angle), np.sin(angle)),
            (covariance[0, 0], covariance[0, 1], covariance[1, 1]),
        )
        in_floats, their_spread = line_and_covariance(constraint(m, entries))
        assert np.allclose(in_floats, line, rtol=0, atol=1e-12 * abs(line).max())
        assert (abs(their_spread - spread) <= 1e-11 * sizes).all()


def test_the_horizon_gives_no_constraint_line():
    level = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 4.0], [0.0, 0.0, 1.0]])
    line, spread = constraint_lines(level, np.zeros((9, 9)), [0.0, 4.0], 0.0, np.eye(2))
    assert np.isnan(line).all()
    assert np.isnan(spread).all()
    assert constraint([0.0, 0.0, -4.0], [0.0] * 6) is None


def scene(azimuths):
    """Cameras, the target, and exact finger lines of one rod."""
    cameras = [camera(a) for a in azimuths]
    pointing = rod([170.0, 230.0], azimuth_deg=30.0, slant_deg=45.0, tip_height_mm=150.0)
    fingers = [finger_line(view, pointing) for view in cameras]
    anchor = np.stack([finger.anchor_px for finger in fingers])
    angle = np.array([finger.angle_rad for finger in fingers])
    return cameras, pointing.target, anchor, angle


LINE_COVARIANCE = np.array([[0.02**2, 2e-6], [2e-6, np.radians(0.05) ** 2]])
REFERENCE_COVARIANCE = np.array([[0.15**2, 0.005], [0.005, 0.1**2]])


def sampled_constraints(azimuths, seed, samples=SAMPLES, line_covariance=LINE_COVARIANCE):
    """Noisy constraint lines (S, N, 3), their covariances, the exact ones, and the target."""
    rng = np.random.default_rng(seed)
    cameras, target, anchor, angle = scene(azimuths)
    images = np.stack([images_of(view, CORNERS) for view in cameras])
    T = np.stack([estimate_image_from_plane(CORNERS, image) for image in images])
    H = np.stack([homography_covariance(t, CORNERS, REFERENCE_COVARIANCE) for t in T])

    def constraints(T, anchor, angle):
        return constraint_lines(T, H, anchor, angle, line_covariance)

    noise = rng.multivariate_normal([0, 0], line_covariance, (samples, len(cameras)))
    normal = np.stack([-np.sin(angle), np.cos(angle)], axis=-1)
    pixels = images + rng.multivariate_normal(
        [0, 0], REFERENCE_COVARIANCE, (samples, len(cameras), 4)
    )
    noisy = constraints(
        homographies_through(CORNERS, pixels),
        anchor + noise[..., :1] * normal,
        angle + noise[..., 1],
    )
    return noisy, constraints(T, anchor, angle), target


def test_constraint_line_covariance_meets_monte_carlo():
    (lines, _), (exact, covariance), _ = sampled_constraints([-15.0, 15.0], 42)
    for k in range(2):
        tangent = np.array([exact[k, 1], -exact[k, 0]])
        foot = -exact[k, 2] * exact[k, :2]
        for along in (-300.0, 0.0, 500.0):
            X = foot + along * tangent
            homogeneous = np.array([*X, 1.0])
            # The sign of a line is arbitrary, but equal for lines near the exact one.
            sampled = np.var(distance(lines[:, k], X))
            assert sampled == pytest.approx(homogeneous @ covariance[k] @ homogeneous, rel=0.05)


@pytest.mark.parametrize(
    "azimuths", [(-15.0, 15.0), (-25.0, 5.0, 30.0)], ids=["two cameras", "three cameras"]
)
def test_the_indicated_points_covariance_and_coverage_meet_monte_carlo(azimuths):
    (lines, covariances), (exact, covariance), target = sampled_constraints(azimuths, 43)
    analytic = intersect(exact, covariance)
    assert np.allclose(analytic.point, target, atol=1e-8)
    found = [intersect(line, spread) for line, spread in zip(lines, covariances, strict=True)]
    points = np.array([each.point for each in found])
    assert close_to_sampled(covariance_of(points), analytic.covariance)
    for confidence, slack in ((0.5, 0.02), (0.95, 0.01), (0.99, 0.005)):
        inside = [
            confidence_ellipse(each.point, each.covariance, confidence).contains(target)
            for each in found
        ]
        assert np.mean(inside) == pytest.approx(confidence, abs=slack)
    if len(azimuths) == 3:
        # One degree of freedom is redundant.
        excess = np.array([each.chi2 for each in found])
        assert np.mean(excess) == pytest.approx(1.0, abs=0.06)
        assert np.mean(excess < chi2(1).ppf(0.95)) == pytest.approx(0.95, abs=0.01)
    else:
        assert max(each.chi2 for each in found) < 1e-9


def test_a_covariance_without_the_references_is_too_small():
    surer = LINE_COVARIANCE / 16
    (lines, _), _, target = sampled_constraints((-15.0, 15.0), 44, 2000, surer)
    cameras, _, anchor, angle = scene((-15.0, 15.0))
    T = np.stack([view.image_from_plane for view in cameras])
    _, alone = constraint_lines(T, np.zeros((2, 9, 9)), anchor, angle, surer)
    inside = [
        confidence_ellipse(each.point, each.covariance).contains(target)
        for each in (intersect(line, alone) for line in lines)
    ]
    assert np.mean(inside) < 0.7


def test_two_lines_meet_in_their_intersection_whatever_their_weights():
    first, second = line_through([0, 0], [10, 3]), line_through([4, 9], [5, -6])
    covariances = np.stack([np.diag([1e-8, 1e-8, 1e-2]), np.diag([1e-4, 1e-4, 1e2])])
    for spread in (covariances, np.zeros((2, 3, 3)), covariances * [[[0.0]], [[1.0]]]):
        found = intersect([first, second], spread)
        assert np.allclose(found.point, intersection(first, second), rtol=0, atol=1e-11)
        assert found.chi2 < 1e-6


def test_three_lines_meet_where_the_likelihood_is_largest():
    (lines, covariances), _, _ = sampled_constraints((-25.0, 5.0, 30.0), 45, samples=20)
    for line, spread in zip(lines, covariances, strict=True):
        found = intersect(line, spread)

        def cost(X, line=line, spread=spread):
            homogeneous = np.array([*X, 1.0])
            return np.sum((line @ homogeneous) ** 2 / (spread @ homogeneous @ homogeneous))

        oracle = minimize(cost, found.point + 0.1, method="Nelder-Mead", tol=1e-12)
        # Variances that grow with the lever pull the minimum of the plain sum away from the root
        # of the weighted equations by far less than a standard deviation.
        sigma = np.sqrt(np.linalg.eigvalsh(found.covariance)[0])
        assert np.hypot(*(oracle.x - found.point)) < 0.05 * sigma
        assert found.chi2 == pytest.approx(oracle.fun, rel=1e-3, abs=1e-3)


def test_many_exact_lines_through_a_point_meet_in_it():
    point = np.array([0.3, 0.7])
    lines = line_at_angle(point, np.linspace(0, 3, 7))
    found = intersect(lines, np.zeros((7, 3, 3)))
    assert np.allclose(found.point, point, rtol=0, atol=1e-14)
    assert np.isfinite(found.covariance).all()


@pytest.mark.parametrize("crossing", [0.0, 1e-12])
def test_parallel_lines_have_no_point_and_no_bound(crossing):
    lines = line_at_angle([[0, 0], [0, 5]], [0.3, 0.3 + crossing])
    found = intersect(lines, np.broadcast_to(1e-4 * np.eye(3), (2, 3, 3)))
    assert np.isnan(found.point).all()
    assert np.array_equal(found.covariance, UNBOUNDED)
    widened = widened_covariance(lines, np.zeros((2, 3, 3)), found, 1.0)
    assert np.array_equal(widened, UNBOUNDED)


def crossing_lines(crossing, sigma_offset, sigma_angle, lever):
    """Two lines that cross at the origin, most accurate at distance `lever` from it."""
    angle = np.array([-crossing / 2, crossing / 2])
    anchor = lever * np.column_stack([np.cos(angle), np.sin(angle)])
    spread = np.broadcast_to(np.diag([sigma_offset**2, sigma_angle**2]), (2, 2, 2))
    return image_lines(anchor, angle, spread)


def test_a_well_crossed_point_is_not_widened():
    lines, covariances = crossing_lines(1.0, 0.01, 1e-5, 3.0)
    found = intersect(lines, covariances)
    widened = widened_covariance(lines, covariances, found, 1.0)
    assert np.allclose(widened, found.covariance, rtol=1e-4)


@pytest.mark.parametrize("lever", [-2.0, 0.0, 2.0])
def test_widening_is_fiellers_interval(lever):
    """At ±D on the bisector χ² is (φD)² / 2σ², σ that of a line there; the variance is D² / χ²."""
    crossing, sigma_offset, sigma_angle, D = 0.02, 0.001, 0.004, 5.0
    lines, covariances = crossing_lines(crossing, sigma_offset, sigma_angle, lever)
    found = intersect(lines, covariances)
    widened = widened_covariance(lines, covariances, found, D)
    expected = max(
        D**2 * 2 * (sigma_offset**2 + sigma_angle**2 * (x - lever) ** 2) / (crossing * D) ** 2
        for x in (D, -D)
    )
    assert widened[0, 0] == pytest.approx(expected, rel=1e-3)
    assert widened[1, 1] == pytest.approx(found.covariance[1, 1], rel=1e-6)
    assert widened[0, 0] > found.covariance[0, 0]


def test_widening_of_contradictory_lines_counts_only_the_increase_with_distance():
    """Three nearly parallel lines, one far off: the minimum of χ² is subtracted."""
    angle, sigma_offset, sigma_angle, D = np.array([-0.01, 0.0, 0.01]), 0.001, 0.002, 5.0
    anchor = np.array([[2.0, -0.02], [2.0, 0.02], [2.0, 0.02]])
    spread = np.broadcast_to(np.diag([sigma_offset**2, sigma_angle**2]), (3, 2, 2))
    lines, covariances = image_lines(anchor, angle, spread)
    found = intersect(lines, covariances)
    assert found.chi2 > 10
    along = np.linalg.eigh(found.covariance)[1][:, 1]
    across = np.array([-along[1], along[0]])
    expected = []
    for X in (found.point + D * along, found.point - D * along):
        homogeneous = np.array([*X, 1.0])
        variances = covariances @ homogeneous @ homogeneous
        costs = [
            np.sum(distance(lines, X + q * across) ** 2 / variances)
            for q in np.linspace(-0.2, 0.2, 40001)
        ]
        expected.append(D**2 / (min(costs) - found.chi2))
    widened = widened_covariance(lines, covariances, found, D)
    assert along @ widened @ along == pytest.approx(max(expected), rel=1e-3)
    assert max(expected) > 2 * np.linalg.eigvalsh(found.covariance)[1]


def test_a_crossing_that_noise_explains_is_widened_beyond_the_limit():
    """Coincident lines: noise makes them cross, and the first-order covariance may be small."""
    rng = np.random.default_rng(46)
    lever, sigma_offset, sigma_angle = 100.0, 0.05, 0.002
    underestimated = 0
    for turns, shifts in zip(
        rng.normal(0, sigma_angle, (2000, 2)), rng.normal(0, sigma_offset, (2000, 2)), strict=True
    ):
        anchor = np.column_stack([[lever, 1.2 * lever], shifts])
        spread = np.broadcast_to(np.diag([sigma_offset**2, sigma_angle**2]), (2, 2, 2))
        lines, covariances = image_lines(anchor, turns, spread)
        found = intersect(lines, covariances)
        limit = 20.0
        underestimated += bool(np.sqrt(np.linalg.eigvalsh(found.covariance)[-1]) < limit)
        widened = widened_covariance(lines, covariances, found, 4 * limit)
        assert np.isinf(widened).any() or np.sqrt(np.linalg.eigvalsh(widened)[-1]) > limit
    assert underestimated > 200  # accepted by the first-order covariance


def test_confidence_ellipse_is_the_chi2_of_two_dimensions():
    covariance = np.array([[4.0, 1.5], [1.5, 2.0]])
    for confidence in (0.0, 0.5, 0.865, 0.95, 0.99):
        ellipse = confidence_ellipse([1.0, -2.0], covariance, confidence)
        expected = np.sqrt(chi2(2).ppf(confidence) * np.linalg.eigvalsh(covariance)[::-1])
        assert np.allclose(ellipse.semi_axes, expected)
        offsets = ellipse.polygon(12) - [1.0, -2.0]
        mahalanobis2 = np.einsum("ni,ij,nj->n", offsets, np.linalg.inv(covariance), offsets)
        assert np.allclose(mahalanobis2, chi2(2).ppf(confidence))
    assert chi2(2).ppf(0.95) == pytest.approx(5.991, abs=5e-4)


@pytest.mark.parametrize("turn", [0.0, 0.4, np.pi / 2, 3.0])
def test_an_ellipse_has_the_axes_of_its_covariance(turn):
    major = np.array([np.cos(turn), np.sin(turn)])
    minor = np.array([-major[1], major[0]])
    covariance = 9.0 * np.outer(major, major) + 1.0 * np.outer(minor, minor)
    ellipse = confidence_ellipse([5.0, 6.0], covariance, 0.95)
    assert np.cos(ellipse.angle_rad - turn) ** 2 == pytest.approx(1.0)
    assert 0.0 <= ellipse.angle_rad <= np.pi
    assert ellipse.area == pytest.approx(np.pi * 5.991 * 3.0, rel=1e-3)
    reach = 3.0 * np.sqrt(5.9914645)
    assert ellipse.contains([5.0, 6.0] + 0.999 * reach * major)
    assert not ellipse.contains([5.0, 6.0] + 1.001 * reach * major)
    assert not ellipse.contains([5.0, 6.0] + 0.5 * reach * minor)
    assert ellipse.polygon(100).shape == (100, 2)


def test_the_papers_ellipse_is_first_order_for_small_noise():
    """For small noise, displacements by ±2σ give twice the first-order standard deviations."""
    cameras, target, anchor, angle = scene((-15.0, 15.0))
    T = np.stack([view.image_from_plane for view in cameras])
    spread = np.broadcast_to(np.diag(np.diag(LINE_COVARIANCE)), (2, 2, 2)) * 1e-4
    ellipse = nsigma_ellipse(T, anchor, angle, spread, nsigma=2.0)
    met = intersect(*constraint_lines(T, np.zeros((2, 9, 9)), anchor, angle, spread))
    first_order = met.covariance
    assert np.allclose(ellipse.centre, target, atol=1e-8)
    assert np.allclose(
        ellipse.semi_axes, 2.0 * np.sqrt(np.linalg.eigvalsh(first_order)[::-1]), rtol=1e-4
    )


def test_the_papers_ellipse_holds_86_percent_and_not_95():
    rng = np.random.default_rng(47)
    cameras, target, anchor, angle = scene((-15.0, 15.0))
    T = np.stack([view.image_from_plane for view in cameras])
    spread = np.broadcast_to(np.diag(np.diag(LINE_COVARIANCE)), (2, 2, 2))
    normal = np.stack([-np.sin(angle), np.cos(angle)], axis=-1)
    inside = []
    for noise in rng.normal(0, 1, (1200, 2, 2)) * np.sqrt(np.diag(LINE_COVARIANCE)):
        ellipse = nsigma_ellipse(T, anchor + noise[:, :1] * normal, angle + noise[:, 1], spread)
        inside.append(ellipse.contains(target))
    assert np.mean(inside) == pytest.approx(1 - np.exp(-2), abs=0.025)


def test_the_papers_ellipse_of_three_views():
    cameras, target, anchor, angle = scene((-25.0, 5.0, 30.0))
    T = np.stack([view.image_from_plane for view in cameras])
    spread = np.broadcast_to(np.diag(np.diag(LINE_COVARIANCE)), (3, 2, 2))
    three = nsigma_ellipse(T, anchor, angle, spread)
    two = nsigma_ellipse(T[:2], anchor[:2], angle[:2], spread[:2])
    assert np.allclose(three.centre, target, atol=1e-8)
    assert three.area < two.area


EYES = np.broadcast_to(np.eye(3), (2, 3, 3))
LINES = np.array([[1.0, 0, 0], [0, 1.0, 0]])
FOUND = Intersection(np.zeros(2), np.eye(2), 0.0)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: intersect(LINES[:1], EYES[:1]), "1 constraint line"),
        (lambda: intersect(LINES, EYES[:1]), r"covariances: shape \(1, 3, 3\)"),
        (lambda: intersect(LINES * np.nan, EYES), r"lines\[0, 0\] is nan"),
        (lambda: widened_covariance(LINES, EYES, FOUND, 0.0), "distance is 0"),
        (lambda: confidence_ellipse([0, 0], np.eye(2), 1.0), "confidence is 1.0"),
        (lambda: confidence_ellipse([0, 0], np.eye(2), np.nan), "confidence is nan"),
        (lambda: confidence_ellipse([0, 0], UNBOUNDED), r"covariance\[0, 0\] is inf"),
        (lambda: confidence_ellipse([0, 0], -np.eye(2)), "negative eigenvalue"),
        (lambda: confidence_ellipse([0, 0], np.eye(2)).polygon(2), "polygon of 2 points"),
        (lambda: homography_covariance(np.eye(3), CORNERS, np.zeros((2, 2))), "singular"),
        (
            lambda: nsigma_ellipse(EYES, [[0, 0], [0, 1]], [0.5, 0.5], [np.eye(2)] * 2),
            "parallel",
        ),
        (
            lambda: nsigma_ellipse(EYES[:1], [[0, 0]], [0.5], [np.eye(2)]),
            "1 constraint line",
        ),
    ],
)
def test_bad_input_is_refused_in_words(call, words):
    with pytest.raises(InvalidInputError, match=words):
        call()
