import cv2
import numpy as np
import pytest
from geometry_rig import (
    CORNERS,
    camera,
    central_differences,
    covariance_of,
    seen_rod,
)
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from fingerpost.errors import InvalidInputError
from fingerpost.homography import estimate_image_from_plane
from fingerpost.lens import Lens
from fingerpost.lines import constraint_line, distance, intersection, line_at_angle

# A close webcam: 0.75 m away, 640 × 480, the image corners at r = 0.64.
WEBCAM = Lens(fx=622.0, fy=618.0, cx=319.5, cy=239.5, k1=-0.2)
PINCUSHION = Lens(fx=622.0, fy=618.0, cx=300.0, cy=250.0, k1=0.3, k2=0.1)
MOUSTACHE = Lens(fx=500.0, fy=500.0, cx=320.0, cy=240.0, k1=-0.25, k2=0.08)
LENSES = [WEBCAM, PINCUSHION, MOUSTACHE]


def image_points(seed, count=200):
    return np.random.default_rng(seed).uniform([0, 0], [640, 480], (count, 2))


def opencv(lens):
    K = np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1.0]])
    return K, np.array([lens.k1, lens.k2, 0.0, 0.0])


@pytest.mark.parametrize("lens", LENSES)
def test_distortion_equals_opencvs(lens):
    K, coefficients = opencv(lens)
    pinhole = image_points(31)
    directions = (pinhole - K[:2, 2]) / np.diag(K)[:2]
    rays = np.column_stack([directions, np.ones(len(directions))])
    expected, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), K, coefficients)
    assert np.allclose(lens.distort(pinhole), expected[:, 0], rtol=0, atol=1e-9)


@pytest.mark.parametrize("lens", LENSES)
def test_undistortion_equals_opencvs(lens):
    K, coefficients = opencv(lens)
    shown = image_points(32)
    many = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-14)
    if hasattr(cv2, "undistortPointsIter"):  # OpenCV 4
        expected = cv2.undistortPointsIter(shown[:, None], K, coefficients, None, K, many)
    else:
        expected = cv2.undistortPoints(shown[:, None], K, coefficients, P=K, criteria=many)
    assert np.allclose(lens.undistort(shown), expected[:, 0], rtol=0, atol=1e-7)


@settings(max_examples=300, derandomize=True)
@given(
    st.floats(-0.6, 0.6),
    st.floats(-0.3, 0.3),
    st.floats(0.0, 0.999999) | st.sampled_from([0.0, 1e-12, 1 - 1e-9]),
    st.floats(0, 2 * np.pi),
)
def test_undistortion_inverts_distortion_up_to_the_fold(k1, k2, share, direction):
    lens = Lens(600.0, 600.0, 0.0, 0.0, k1, k2)
    radii = np.linspace(0, 3, 300001)
    slope = 1 + 3 * k1 * radii**2 + 5 * k2 * radii**4
    fold = radii[np.argmax(slope <= 0)] if (slope <= 0).any() else 2.5
    r = share * (fold - 1e-5)
    pinhole = 600 * r * np.array([np.cos(direction), np.sin(direction)])
    # Near the fold the slope of the map vanishes, which amplifies rounding of the image.
    flat = 1 + 3 * k1 * r**2 + 5 * k2 * r**4
    assume(flat > 1e-6)
    back = lens.undistort(lens.distort(pinhole))
    assert np.allclose(back, pinhole, rtol=0, atol=1e-10 / flat)


def test_the_principal_point_is_fixed():
    centre = [WEBCAM.cx, WEBCAM.cy]
    assert np.array_equal(WEBCAM.distort(centre), centre)
    assert np.array_equal(WEBCAM.undistort(centre), centre)


def test_points_beyond_the_fold_and_only_those_are_nan():
    # k1 = −0.2: the fold is at r = √(5/3), distorted to two thirds of that.
    fold = np.sqrt(5 / 3)
    inside, outside = 0.999 * fold, 1.001 * fold
    centre = np.array([WEBCAM.cx, WEBCAM.cy])
    distorted = WEBCAM.distort(centre + np.outer([inside, outside], [WEBCAM.fx, 0]))
    assert np.isfinite(distorted[0]).all()
    assert np.isnan(distorted[1]).all()
    undistorted = WEBCAM.undistort(centre + np.outer([inside, outside], [WEBCAM.fx * 2 / 3, 0]))
    assert np.isfinite(undistorted[0]).all()
    assert np.isnan(undistorted[1]).all()
    assert np.isnan(WEBCAM.undistort_jacobian(np.add(centre, [WEBCAM.fx, 0]))).all()
    assert np.isnan(WEBCAM.distort_jacobian(np.add(centre, [2 * WEBCAM.fx, 0]))).all()


def test_pincushion_distortion_has_no_fold():
    shown = np.array([[1e5, -2e5]])
    assert np.allclose(PINCUSHION.distort(PINCUSHION.undistort(shown)), shown, rtol=1e-12)


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("way", ["distort", "undistort"])
def test_jacobians_agree_with_central_differences(lens, way):
    shown = image_points(33, 20)
    for point, analytic in zip(shown, getattr(lens, f"{way}_jacobian")(shown), strict=True):
        numeric = central_differences(getattr(lens, way), point, [600.0, 600.0])
        assert np.allclose(analytic, numeric, rtol=1e-7, atol=1e-7)


def shown_finger(lens, first, last, count=41):
    """Fit a line to the distorted image of a straight finger, as a contour tracker does."""
    samples = lens.distort(np.linspace(first, last, count))
    anchor = samples.mean(axis=0)
    tangent = np.linalg.svd(samples - anchor)[2][0]
    tangent *= np.sign(tangent @ (np.asarray(last) - first))
    half_length = np.abs((samples - anchor) @ tangent).max()
    return anchor, float(np.arctan2(tangent[1], tangent[0])), half_length


@pytest.mark.parametrize("lens", LENSES)
def test_the_line_of_a_straight_finger_is_recovered(lens):
    rng = np.random.default_rng(34)
    for _ in range(50):
        first = rng.uniform([60, 60], [580, 420])
        turn = rng.uniform(0, 2 * np.pi)
        last = first + 70 * np.array([np.cos(turn), np.sin(turn)])
        anchor, angle, half_length = shown_finger(lens, first, last)
        straight, straight_angle, _ = lens.undistort_line(anchor, angle, np.eye(2), half_length)
        line = line_at_angle(straight, straight_angle)
        assert np.abs(distance(line, [first, last])).max() < 0.01
        assert np.cos(straight_angle - turn) > 0
        # Undistorting two points of the line is essential: the anchor alone leaves an offset.
        through_anchor = line_at_angle(lens.undistort(anchor), straight_angle)
        if abs(distance(through_anchor, first)) > 0.05:
            assert np.abs(distance(line, first)) < abs(distance(through_anchor, first)) / 4


def test_the_result_does_not_depend_on_the_anchor():
    covariance, angle, half_length = np.array([[0.04, 2e-4], [2e-4, 4e-6]]), 0.6, 40.0
    middle = np.array([560.0, 90.0])
    expected = WEBCAM.undistort_line(middle, angle, covariance, half_length)
    for ahead in (-55.0, 12.0):
        anchor = middle - ahead * np.array([np.cos(angle), np.sin(angle)])
        back = np.array([[1.0, -ahead], [0.0, 1.0]])
        moved = back @ covariance @ back.T
        same = WEBCAM.undistort_line(anchor, angle, moved, half_length, ahead)
        for one, other in zip(same, expected, strict=True):
            assert np.allclose(one, other, rtol=1e-9, atol=1e-12)


def test_a_lens_without_distortion_keeps_the_line():
    lens = Lens(600.0, 610.0, 320.0, 240.0, 0.0)
    covariance = np.array([[0.01, 1e-5], [1e-5, 1e-6]])
    anchor, angle, after = lens.undistort_line([200, 100], 3.0, covariance, 40.0)
    assert np.allclose(anchor, [200, 100])
    assert angle == pytest.approx(3.0)
    assert np.allclose(after, covariance, rtol=1e-12)


def test_the_covariance_of_the_line_agrees_with_monte_carlo():
    rng = np.random.default_rng(35)
    lens = Lens(622.0, 400.0, 319.5, 239.5, -0.3)
    covariance = np.array([[0.04, 2e-4], [2e-4, 4e-6]])
    anchor, angle, half_length = np.array([560.0, 90.0]), 0.6, 40.0
    mean, mean_angle, analytic = lens.undistort_line(anchor, angle, covariance, half_length)
    noise = rng.multivariate_normal([0, 0], covariance, 8000)
    normal = np.array([-np.sin(angle), np.cos(angle)])
    new_normal = np.array([-np.sin(mean_angle), np.cos(mean_angle)])
    sampled = []
    for offset, turn in noise:
        moved, moved_angle, _ = lens.undistort_line(
            anchor + offset * normal, angle + turn, covariance, half_length
        )
        # Offset of the moved line where it passes the unmoved anchor.
        line = line_at_angle(moved, moved_angle)
        sampled.append([-distance(line, mean) / (line[:2] @ new_normal), moved_angle - mean_angle])
    assert np.allclose(covariance_of(sampled), analytic, rtol=0.05)


def test_a_line_outside_the_domain_is_nan():
    anchor, angle, covariance = WEBCAM.undistort_line([1500, 240], 0.0, np.eye(2), 30.0)
    assert np.isnan(anchor).all()
    assert np.isnan(angle)
    assert np.isnan(covariance).all()


def lens_errors_mm(correct_references, correct_lines):
    """Return errors of the indicated point for random rods before close webcams, k1 = −0.2."""
    rng = np.random.default_rng(36)
    cameras = [camera(a, distance_mm=750.0, focal_px=622.0) for a in (-15.0, 15.0)]
    lens = Lens(622.0, 622.0, 319.5, 239.5, -0.2)
    homographies = []
    for view in cameras:
        references = lens.distort(view.project(np.column_stack([CORNERS, np.zeros(4)])))
        if correct_references:
            references = lens.undistort(references)
        homographies.append(estimate_image_from_plane(CORNERS, references))
    errors = []
    while len(errors) < 300:
        pointing = seen_rod(rng, cameras)
        ends = [view.project(np.stack([pointing.base, pointing.tip])) for view in cameras]
        shown = lens.distort(np.concatenate(ends))
        if np.any(shown < 0) or np.any(shown > [639, 479]):
            continue
        lines = []
        for (base, tip), T in zip(ends, homographies, strict=True):
            anchor, angle, half = shown_finger(lens, base, tip)
            if correct_lines:
                anchor, angle, _ = lens.undistort_line(anchor, angle, np.eye(2), half)
            lines.append(constraint_line(T, line_at_angle(anchor, angle)))
        errors.append(np.hypot(*(intersection(*lines) - pointing.target)))
    return np.array(errors)


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


def test_references_and_lines_must_both_be_corrected_for_the_lens():
    assert rms(lens_errors_mm(True, True)) <= 0.02
    ignored = rms(lens_errors_mm(False, False))
    assert ignored > 3.0
    assert rms(lens_errors_mm(False, True)) > ignored / 2
    assert rms(lens_errors_mm(True, False)) > ignored / 2


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"fx": 0.0}, "lens fx is 0"),
        ({"fy": -600.0}, "lens fy is -600"),
        ({"k1": np.nan}, "lens k1 is nan"),
        ({"k2": 1e9}, "lens k2"),
        ({"cx": np.inf}, "lens cx is inf"),
        ({"cy": "240"}, "a real number is needed"),
    ],
)
def test_bad_lenses_are_refused(values, words):
    with pytest.raises(InvalidInputError, match=words):
        Lens(**{"fx": 600.0, "fy": 600.0, "cx": 320.0, "cy": 240.0, "k1": 0.0} | values)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (([1, 2, 3], 0.0, np.eye(2), 10.0), r"anchor_px: shape \(3,\)"),
        (([1, 2], np.nan, np.eye(2), 10.0), "angle_rad is nan"),
        (([1, 2], 0.0, -np.eye(2), 10.0), "negative eigenvalue"),
        (([1, 2], 0.0, np.eye(2), 0.0), "half_length_px is 0"),
        (([1, 2], 0.0, np.eye(2), 10.0, np.inf), "middle_px is inf"),
    ],
)
def test_bad_lines_are_refused(arguments, words):
    with pytest.raises(InvalidInputError, match=words):
        WEBCAM.undistort_line(*arguments)


def test_nan_points_are_refused():
    with pytest.raises(InvalidInputError, match=r"points_px\[1, 0\] is nan"):
        WEBCAM.undistort([[1, 2], [np.nan, 3]])
