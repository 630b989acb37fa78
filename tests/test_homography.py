import cv2
import numpy as np
import pytest
from geometry_rig import CORNERS, camera, central_differences, random_warp
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares

from fingerpost.errors import DegenerateReferencePointsError, InvalidInputError
from fingerpost.homography import (
    entries_from_reference_points,
    estimate_image_from_plane,
    normalising_similarity,
    transfer_jacobian_by_entries,
    transfer_jacobian_by_point,
    transfer_to_image,
    transfer_to_plane,
)

# Central differences with a step of 1e-5 of the value leave about 1e-8 of truncation and rounding.
DERIVATIVE_TOLERANCE = 1e-7

GRID = np.array([[x, y] for x in (0.0, 200.0, 400.0) for y in (0.0, 200.0, 400.0)])


def on_plane(points):
    return np.column_stack([points, np.zeros(len(points))])


def same_up_to_scale(first, second):
    return np.allclose(first / first[2, 2], second / second[2, 2], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("points", [CORNERS, GRID], ids=["four", "nine"])
@pytest.mark.parametrize("azimuth", [-60.0, 0.0, 15.0])
def test_exact_points_give_the_cameras_own_homography(points, azimuth):
    view = camera(azimuth)
    image = view.project(on_plane(points))
    T = estimate_image_from_plane(points, image)
    assert same_up_to_scale(T, view.image_from_plane)
    assert np.allclose(transfer_to_image(T, points), image, rtol=0, atol=1e-10)
    assert np.allclose(transfer_to_plane(T, image), points, rtol=0, atol=1e-10)


def test_transfers_undo_each_other_anywhere_in_view():
    T = estimate_image_from_plane(CORNERS, camera(20.0).project(on_plane(CORNERS)))
    points = np.random.default_rng(11).uniform(-500, 900, (5, 40, 2))
    assert np.allclose(transfer_to_plane(T, transfer_to_image(T, points)), points, atol=1e-8)


def test_more_than_four_points_agree_with_opencv():
    rng = np.random.default_rng(12)
    image = camera(15.0).project(on_plane(GRID)) + rng.normal(0, 0.5, (9, 2))
    T = estimate_image_from_plane(GRID, image)
    oracle, _ = cv2.findHomography(GRID, image, 0)
    # OpenCV stops its own minimisation a little earlier.
    assert np.allclose(transfer_to_image(T, CORNERS), transfer_to_image(oracle, CORNERS), atol=1e-4)


@pytest.mark.parametrize("weighted", [False, True])
def test_more_than_four_points_reach_the_minimum_of_the_image_error(weighted):
    rng = np.random.default_rng(13)
    covariances = None
    whitening = np.broadcast_to(np.eye(2), (9, 2, 2))
    if weighted:
        roots = rng.normal(0, 1, (9, 2, 2)) + 2 * np.eye(2)
        covariances = roots @ roots.transpose(0, 2, 1)
        whitening = np.linalg.inv(np.linalg.cholesky(covariances))
    image = camera(15.0).project(on_plane(GRID)) + rng.normal(0, 2.0, (9, 2))

    def residuals(h):
        error = transfer_to_image(np.append(h, 1.0).reshape(3, 3), GRID) - image
        return (whitening @ error[..., None]).ravel()

    T = estimate_image_from_plane(GRID, image, covariances)
    ours = (T / T[2, 2]).ravel()[:8]
    oracle = least_squares(residuals, ours, x_scale=np.abs(ours), xtol=1e-15, ftol=1e-15)
    assert (residuals(ours) ** 2).sum() <= 2 * oracle.cost * (1 + 1e-9)


def test_a_common_covariance_stands_for_one_per_point():
    image = camera(15.0).project(on_plane(GRID)) + np.random.default_rng(14).normal(0, 1, (9, 2))
    common = np.array([[2.0, 0.5], [0.5, 1.0]])
    each = np.broadcast_to(common, (9, 2, 2))
    assert np.array_equal(
        estimate_image_from_plane(GRID, image, common),
        estimate_image_from_plane(GRID, image, each),
    )


def test_scale_and_sign_make_w_one_at_the_centroid():
    T = estimate_image_from_plane(CORNERS, camera().project(on_plane(CORNERS)))
    assert T[2] @ (*CORNERS.mean(axis=0), 1.0) == pytest.approx(1.0, abs=1e-12)
    assert np.all(T[2] @ np.column_stack([CORNERS, np.ones(4)]).T > 0)


@pytest.mark.parametrize("beyond", [0.0, 500.0], ids=["on the horizon", "behind the camera"])
def test_the_planes_origin_may_lie_where_the_view_cannot_see_it(beyond):
    view = camera()
    w = view.image_from_plane[2]
    # Shift the plane's coordinates so that their origin has W = 0, or W < 0.
    normal = w[:2] / np.hypot(*w[:2])
    shift = (w[2] / np.hypot(*w[:2]) + beyond) * normal
    points = CORNERS + shift
    image = view.project(on_plane(CORNERS))
    T = estimate_image_from_plane(points, image)
    assert T[2, 2] == pytest.approx(0.0, abs=1e-12) if beyond == 0 else T[2, 2] < 0
    assert np.allclose(transfer_to_image(T, points), image, atol=1e-9)
    assert np.isnan(transfer_to_image(T, -1e-9 * normal)).all()


def test_points_the_view_cannot_see_are_nan_and_only_they():
    view = camera()
    T = estimate_image_from_plane(CORNERS, view.project(on_plane(CORNERS)))
    behind = view.position[:2] + 4.0 * (view.position[:2] - CORNERS.mean(axis=0))
    images = transfer_to_image(T, [CORNERS[0], behind, CORNERS[2]])
    assert np.isnan(images).tolist() == [[False] * 2, [True] * 2, [False] * 2]
    above_horizon = [[319.5, 239.5], [319.5, -1e5]]
    assert np.isnan(transfer_to_plane(T, above_horizon)).tolist() == [[False] * 2, [True] * 2]


@pytest.mark.parametrize("derivative", ["by_entries", "by_point"])
def test_transfer_jacobians_meet_central_differences(derivative):
    rng = np.random.default_rng(15)
    T = estimate_image_from_plane(CORNERS, camera(25.0).project(on_plane(CORNERS)))
    for X in rng.uniform(0, 400, (20, 2)):
        if derivative == "by_entries":
            analytic = transfer_jacobian_by_entries(T, X)
            numeric = central_differences(
                lambda h, X=X: transfer_to_image(h.reshape(3, 3), X), T.ravel(), np.abs(T).ravel()
            )
        else:
            analytic = transfer_jacobian_by_point(T, X)
            numeric = central_differences(lambda X: transfer_to_image(T, X), X, np.full(2, 400.0))
        assert np.allclose(analytic, numeric, rtol=DERIVATIVE_TOLERANCE, atol=1e-6)


@pytest.mark.parametrize(("points", "weighted"), [(CORNERS, False), (GRID, False), (GRID, True)])
def test_derivative_by_reference_points_meets_central_differences(points, weighted):
    rng = np.random.default_rng(16)
    image = camera(25.0).project(on_plane(points))
    covariances = None
    if weighted:
        roots = rng.normal(0, 1, (len(points), 2, 2)) + 2 * np.eye(2)
        covariances = roots @ roots.transpose(0, 2, 1)
    T = estimate_image_from_plane(points, image, covariances)
    analytic = entries_from_reference_points(T, points, covariances)
    # Entries have a free scale; their effect on the image of a point has none.
    X = np.array([123.0, 321.0])
    by_points = transfer_jacobian_by_entries(T, X) @ analytic

    def moved(pixels):
        estimate = estimate_image_from_plane(points, pixels.reshape(-1, 2), covariances)
        return transfer_to_image(estimate, X)

    numeric = central_differences(moved, image.ravel(), np.full(image.size, 100.0))
    assert np.allclose(by_points, numeric, rtol=DERIVATIVE_TOLERANCE, atol=1e-8)


def test_normalising_similarity_is_hartleys():
    points = np.random.default_rng(17).normal([300, -50], [40, 7], (12, 2))
    S = normalising_similarity(points)
    normalised = points @ S[:2, :2].T + S[:2, 2]
    assert np.allclose(normalised.mean(axis=0), 0, atol=1e-12)
    assert np.hypot(*normalised.T).mean() == pytest.approx(np.sqrt(2))


IMAGE = camera(15.0).project(on_plane(CORNERS))


def replaced(points, index, value):
    changed = np.array(points, dtype=float)
    changed[index] = value
    return changed


@pytest.mark.parametrize(
    ("plane", "image", "words"),
    [
        (replaced(CORNERS, 1, [200, 200]), IMAGE, r"plane_points \[0, 1, 2\] lie on one line"),
        (replaced(CORNERS, 0, [400, 200]), IMAGE, r"plane_points \[0, 1, 2\].*\(400, 200\)"),
        (CORNERS, replaced(IMAGE, 3, (IMAGE[0] + IMAGE[1]) / 2), r"image_points_px \[0, 1, 3\]"),
        (CORNERS * [1, 0], IMAGE, r"plane_points\[0\] and plane_points\[3\] are the same"),
        (CORNERS @ [[1, 1], [2, 2]], IMAGE, r"plane_points \[0, 1, 2, 3\] lie on one line"),
        (CORNERS, replaced(IMAGE, 2, IMAGE[1]), r"image_points_px\[1\] and image_points_px\[2\]"),
        (CORNERS, IMAGE[[0, 2, 1, 3]], "not in the order"),
        (CORNERS, IMAGE[[1, 0, 2, 3]], "not in the order"),
    ],
)
def test_degenerate_reference_points_are_named(plane, image, words):
    with pytest.raises(DegenerateReferencePointsError, match=words):
        estimate_image_from_plane(plane, image)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("origin", [0.0, 100.0])
def test_degeneracy_does_not_depend_on_unit_or_origin(scale, origin):
    def plane(height):
        return scale * (replaced(CORNERS / 400, 1, [0.5, 0.5 - height]) + origin)

    with pytest.raises(DegenerateReferencePointsError):
        estimate_image_from_plane(plane(0.0), IMAGE)
    # Three points that miss a line by a hundredth are no pleasure, but they do fix a homography.
    quadrilateral = np.array([[0, 0], [2, 1.97], [4, 4], [0, 4]]) * 100
    T = estimate_image_from_plane(plane(0.01), quadrilateral)
    assert np.allclose(transfer_to_image(T, plane(0.01)), quadrilateral, atol=1e-6)


def test_all_but_one_of_many_points_on_a_line_is_refused():
    plane = np.array([[0, 0], [1, 1], [5, 2], [2, 2], [3, 3], [4, 4]])
    with pytest.raises(DegenerateReferencePointsError, match=r"\[0, 1, 3, 4, 5\] lie on one line"):
        estimate_image_from_plane(plane, np.random.default_rng(18).uniform(0, 640, (6, 2)))


def test_two_swapped_points_of_nine_fit_no_homography():
    image = camera(15.0).project(on_plane(GRID))
    with pytest.raises(DegenerateReferencePointsError, match="no homography fits"):
        estimate_image_from_plane(GRID, image[[0, 1, 2, 4, 3, 5, 6, 7, 8]])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((CORNERS[:3], IMAGE[:3]), "3 reference points"),
        ((CORNERS, IMAGE[:3]), "4 plane_points but 3 image_points_px"),
        (([], IMAGE), r"plane_points: shape \(0,\) found; \(N, 2\) is needed"),
        ((replaced(CORNERS, (2, 1), np.nan), IMAGE), r"plane_points\[2, 1\] is nan"),
        ((CORNERS, replaced(IMAGE, (0, 0), np.inf)), r"image_points_px\[0, 0\] is inf"),
        ((CORNERS.T, IMAGE), r"shape \(2, 4\)"),
        (([[0, 0], [1]], IMAGE), "plane_points"),
        ((CORNERS, [["a", "b"]] * 4), "real numbers"),
        ((CORNERS, IMAGE, np.zeros((2, 2))), "singular"),
        ((CORNERS, IMAGE, [[1, 0], [0, -1]]), "negative eigenvalue"),
        ((CORNERS, IMAGE, [[1, 2], [0, 1]]), "symmetric"),
        ((CORNERS, IMAGE, np.zeros((3, 2, 2)) + np.eye(2)), r"\(4, 2, 2\) is needed"),
    ],
)
def test_bad_input_is_refused_in_words(arguments, words):
    with pytest.raises(InvalidInputError, match=words):
        estimate_image_from_plane(*arguments)


def test_a_singular_homography_cannot_be_inverted():
    with pytest.raises(InvalidInputError, match="singular"):
        transfer_to_plane(np.zeros((3, 3)), [1.0, 2.0])


# Coordinates on a coarse lattice coincide and align often; the small shifts bring near misses.
coordinate = st.integers(0, 3).map(float) | st.builds(
    lambda k, e: k + e, st.integers(0, 3), st.sampled_from([1e-9, 1e-7, 1e-5, 1e-3])
)
quadrilaterals = st.lists(st.tuples(coordinate, coordinate), min_size=4, max_size=6)


@settings(max_examples=400, derandomize=True)
@given(quadrilaterals, st.integers(0, 2**32 - 1))
def test_near_degenerate_points_are_refused_or_fitted(plane, seed):
    warp = random_warp(np.random.default_rng(seed), extent=4.0)
    plane = np.array(plane)
    image = transfer_to_image(warp, plane)
    try:
        T = estimate_image_from_plane(plane, image)
    except DegenerateReferencePointsError:
        return
    extent = np.ptp(image, axis=0).max()
    assert np.allclose(transfer_to_image(T, plane), image, atol=1e-9 * extent)
