"""Registration of the plane after camera motions: known motions, occlusion and distractors."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fingerpost.homography import estimate_image_from_plane, transfer_to_image
from fingerpost.lens import Lens
from fingerpost.pointing import PlaneView
from fingerpost.references import PlaneMotion, PlaneRegistration
from fingerpost.uncertainty import homography_covariance

REFERENCES_PX = np.array([(130.0, 110.0), (500.0, 120.0), (520.0, 380.0), (110.0, 360.0)])
PLANE = np.array([(0.0, 0.0), (400.0, 0.0), (400.0, 400.0), (0.0, 400.0)])
SEED = 0x706C616E
NOISE_LEVELS = 2.0


def table(width_px: int = 640, height_px: int = 480) -> np.ndarray:
    """Random rectangles on a plain table: edges with uniform areas between them."""
    rng = np.random.default_rng(SEED)
    picture = np.full((height_px, width_px), 90.0, np.float32)
    for _ in range(60):
        corner = rng.uniform((0, 0), (width_px, height_px))
        sides = rng.uniform(10, 60, (2,)) * [[1, 0], [0, 1]]
        turn = cv2.getRotationMatrix2D((0, 0), rng.uniform(0, 90), 1.0)[:, :2]
        outline = corner + np.array([(0, 0), (1, 0), (1, 1), (0, 1)]) @ sides @ turn.T
        cv2.fillConvexPoly(
            picture, (16 * outline).astype(int), rng.uniform(40, 200), cv2.LINE_AA, 4
        )
    return cv2.GaussianBlur(picture, (0, 0), 0.9)


def taken(picture: np.ndarray, seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(0, NOISE_LEVELS, picture.shape)
    return np.clip(picture + noise, 0, 255).round().astype(np.uint8)


def motion_of(corners_px: np.ndarray) -> np.ndarray:
    """The homography that moves the reference points by `corners_px`."""
    return estimate_image_from_plane(REFERENCES_PX, REFERENCES_PX + corners_px)


def shown(picture: np.ndarray, now_from_first: np.ndarray) -> np.ndarray:
    size = picture.shape[::-1]
    return cv2.warpPerspective(
        picture, now_from_first, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
    )


def off_px(motion: PlaneMotion, truth: np.ndarray) -> np.ndarray:
    """Errors of the reference points under an estimated motion."""
    found = transfer_to_image(motion.now_from_first, REFERENCES_PX)
    return found - transfer_to_image(truth, REFERENCES_PX)


MOTIONS = {
    "still": np.zeros((4, 2)),
    "a shift": np.tile([2.3, -1.6], (4, 1)),
    "a turn": 0.02 * (REFERENCES_PX - [320, 240]) @ [[0, 1], [-1, 0]],
    "a tilt": np.array([(3.0, 0.0), (-2.0, 1.0), (2.5, -3.0), (-1.0, 2.0)]),
}


@pytest.mark.parametrize("name", MOTIONS)
def test_a_known_motion_is_recovered_from_the_picture_alone(name):
    truth, picture = motion_of(MOTIONS[name]), table()
    registration = PlaneRegistration(taken(picture, 1), REFERENCES_PX)
    motion = registration.align(taken(shown(picture, truth), 2), np.eye(3))
    assert np.abs(off_px(motion, truth)).max() < 0.1


def test_a_large_motion_is_recovered_from_a_guess():
    moved_px = 0.15 * (REFERENCES_PX - [320, 240]) @ [[0, 1], [-1, 0]] + [40.0, -25.0]
    truth, picture = motion_of(moved_px), table()
    registration = PlaneRegistration(taken(picture, 1), REFERENCES_PX)
    guess = motion_of(moved_px + np.array([(2, 1), (-2, 1), (1, -2), (-1, -1)]))
    motion = registration.align(taken(shown(picture, truth), 2), guess)
    assert np.abs(off_px(motion, truth)).max() < 0.15


def test_soft_shadows_and_other_light_are_no_motion():
    picture = table()
    v, u = np.mgrid[:480, :640]
    shadow = 1.0 - 0.5 * np.exp(-((u - 200.0) ** 2 + (v - 250.0) ** 2) / (2 * 60.0**2))
    registration = PlaneRegistration(taken(picture, 1), REFERENCES_PX)
    motion = registration.align(taken(0.8 * picture * shadow, 2), np.eye(3))
    assert np.abs(off_px(motion, np.eye(3))).max() < 0.1


def test_a_motion_is_recovered_with_a_third_of_the_plane_covered():
    truth, picture = motion_of(MOTIONS["a shift"]), table()
    now = shown(picture, truth)
    now[150:330, 200:400] = table(200, 180)[:, ::-1]
    registration = PlaneRegistration(taken(picture, 1), REFERENCES_PX)
    motion = registration.align(taken(now, 2), np.eye(3))
    assert np.abs(off_px(motion, truth)).max() < 0.15


def test_a_known_hand_is_excluded():
    # The hand has all the edges except those of a large sheet, and moves by two pixels.
    first = np.full((480, 640), 90.0, np.float32)
    cv2.rectangle(first, (150, 130), (480, 340), 120.0, -1)
    now = first.copy()
    for picture, by_px in ((first, 0), (now, 2)):
        for k in range(8):
            cv2.line(picture, (250 + by_px, 160 + 20 * k), (360 + by_px, 170 + 20 * k), 220.0, 9)
    first, now = (cv2.GaussianBlur(picture, (0, 0), 0.9) for picture in (first, now))
    hand = (np.array([305.0, 150.0]), np.array([305.0, 310.0]), 75.0)
    registration = PlaneRegistration(taken(first, 1), REFERENCES_PX)
    registration.forget(hand)
    motion = registration.align(taken(now, 2), np.eye(3), hand)
    assert np.abs(off_px(motion, np.eye(3))).max() < 0.6


def test_a_distorted_picture_is_registered_in_undistorted_pixels():
    lens = Lens(fx=600.0, fy=600.0, cx=320.0, cy=240.0, k1=-0.25)
    truth, picture = motion_of(MOTIONS["a tilt"] + [6.0, 4.0]), table()
    v, u = np.mgrid[:480, :640].astype(float)
    ideal_px = lens.undistort(np.stack([u, v], axis=-1).reshape(-1, 2))

    def through_lens(first_from_now: np.ndarray) -> np.ndarray:
        x, y = transfer_to_image(first_from_now, ideal_px).astype(np.float32).T
        maps = (values.reshape(480, 640) for values in (x, y))
        return cv2.remap(picture, *maps, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)

    first, now = through_lens(np.eye(3)), through_lens(np.linalg.inv(truth))
    registration = PlaneRegistration(taken(first, 1), lens.distort(REFERENCES_PX), lens)
    motion = registration.align(taken(now, 2), motion_of(np.tile([5.0, 4.0], (4, 1))))
    assert np.abs(off_px(motion, truth)).max() < 0.1


def test_the_covariance_is_that_of_repeated_pictures():
    picture, truth = table(), motion_of(MOTIONS["a tilt"])
    now = shown(picture, truth)
    errors, claimed = [], []
    for k in range(40):
        registration = PlaneRegistration(taken(picture, 2 * k), REFERENCES_PX)
        motion = registration.align(taken(now, 2 * k + 1), truth)
        errors.append(off_px(motion, truth))
        view = PlaneView(REFERENCES_PX, np.eye(3), np.zeros((9, 9)), None)
        view = view.moved(motion.now_from_first, motion.covariance)
        claimed.append(corner_covariances(view))
    found = np.array(errors)
    spread = np.einsum("kni,knj->nij", found, found) / len(found)
    ratio = np.trace(spread, axis1=1, axis2=2) / np.trace(np.mean(claimed, 0), axis1=1, axis2=2)
    # Interpolation errors at edges are counted as noise, although they are the same every time.
    assert (ratio > 0.2).all(), ratio
    assert (ratio < 1.5).all(), ratio


def corner_covariances(view: PlaneView) -> np.ndarray:
    """Covariances of a view's projected reference points [px²], by central differences."""
    T, step = view.image_from_plane, 1e-6
    jacobian = np.empty((len(REFERENCES_PX), 2, 9))
    for k in range(9):
        by = np.zeros(9)
        by[k] = step
        after, before = (
            transfer_to_image(T + sign * by.reshape(3, 3), view.plane_points) for sign in (1, -1)
        )
        jacobian[:, :, k] = (after - before) / (2 * step)
    return jacobian @ view.entries_covariance @ np.swapaxes(jacobian, 1, 2)


@pytest.mark.parametrize("level", [0, 90, 255])
@pytest.mark.parametrize("shape", [(1, 1), (6, 8), (48, 64), (480, 640), (30, 2000)])
def test_a_plain_table_gives_no_motion(level, shape):
    picture = np.full(shape, level, np.uint8)
    registration = PlaneRegistration(picture, REFERENCES_PX)
    assert registration.align(picture, np.eye(3)) is None
    assert registration.apparent_motion_px(picture) == 0.0


def test_uniform_areas_do_not_affect_the_apparent_motion():
    picture = np.full((480, 640), 90, np.uint8)
    picture[200:206, 200:206] = 200  # most of the square around it is uniform
    registration = PlaneRegistration(picture, REFERENCES_PX)
    assert registration.apparent_motion_px(picture) == 0.0
    flickering = picture.copy()
    flickering[::2] += 3
    assert np.isfinite(registration.apparent_motion_px(flickering))


def test_another_scene_is_not_registered():
    registration = PlaneRegistration(taken(table(), 1), REFERENCES_PX)
    assert registration.align(taken(table()[::-1, ::-1], 2), np.eye(3)) is None
    assert registration.apparent_motion_px(taken(table()[::-1, ::-1], 2)) > 1.0


@settings(max_examples=25)
@given(st.lists(st.floats(-1e3, 1e3), min_size=8, max_size=8))
def test_any_guess_gives_a_motion_or_none(entries):
    registration = PlaneRegistration(taken(table(), 1), REFERENCES_PX)
    guess = np.append(entries, 1.0).reshape(3, 3)
    motion = registration.align(taken(table(), 2), guess)
    assert motion is None or np.isfinite(motion.covariance).all()


def test_a_moved_view_is_the_view_of_moved_reference_points():
    covariances = 0.3**2 * np.eye(2)
    view = PlaneView.from_reference_points(PLANE, REFERENCES_PX, covariances)
    truth = motion_of(MOTIONS["a turn"] + MOTIONS["a shift"])
    moved = view.moved(truth, np.zeros((9, 9)))
    anew = estimate_image_from_plane(PLANE, transfer_to_image(truth, REFERENCES_PX))
    assert moved.image_from_plane == pytest.approx(anew, rel=1e-9, abs=1e-12)
    before = homography_covariance(view.image_from_plane, PLANE, covariances)
    jacobian = by_point(truth, REFERENCES_PX)
    expected = jacobian @ covariances @ np.swapaxes(jacobian, 1, 2)
    assert before == pytest.approx(view.entries_covariance)
    assert entries_to_points(moved) == pytest.approx(expected, rel=1e-4, abs=1e-8)


def by_point(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    step = 1e-5
    columns = [
        (transfer_to_image(matrix, points + by) - transfer_to_image(matrix, points - by)) / step / 2
        for by in ((step, 0.0), (0.0, step))
    ]
    return np.stack(columns, axis=-1)


def entries_to_points(view: PlaneView) -> np.ndarray:
    """Covariances of the reference points implied by the covariance of the entries."""
    T = view.image_from_plane
    jacobian = np.empty((len(view.plane_points), 2, 9))
    for k in range(9):
        by = np.zeros(9)
        by[k] = 1e-6 * max(abs(T.ravel()[k]), 1e-6)
        after, before = (
            transfer_to_image(T + sign * by.reshape(3, 3), view.plane_points) for sign in (1, -1)
        )
        jacobian[:, :, k] = (after - before) / (2 * by[k])
    return jacobian @ view.entries_covariance @ np.swapaxes(jacobian, 1, 2)


def test_interpolation_between_two_views_is_linear():
    view = PlaneView.from_reference_points(PLANE, REFERENCES_PX, 0.3**2 * np.eye(2))
    later = view.moved(motion_of(np.tile([4.0, -2.0], (4, 1))), np.zeros((9, 9)))
    assert view.between(view, 0.3) is view
    halfway_px = view.between(later, 0.5).project(PLANE)
    assert halfway_px == pytest.approx(REFERENCES_PX + np.array([2.0, -1.0]), abs=1e-6)


def test_an_arm_with_all_strong_corners_is_no_camera_motion():
    plain = np.full((480, 640), 90.0, np.float32)
    for k in range(1, 16):
        cv2.line(plain, (40 * k, 0), (40 * k, 479), 108.0, 1)
        cv2.line(plain, (0, 40 * k), (639, 40 * k), 108.0, 1)
    arm = table(220, 300)

    def at(v: int) -> np.ndarray:
        picture = plain.copy()
        picture[v : v + 300, 330:550] = arm
        return cv2.GaussianBlur(picture, (0, 0), 0.9)

    shift = motion_of(np.tile([0.0, 6.0], (4, 1)))
    registration = PlaneRegistration(taken(at(40), 1), REFERENCES_PX)
    assert registration.is_static(taken(at(46), 2), shift)
    assert not registration.is_static(taken(shown(at(40), shift), 3), shift)


def test_a_table_in_other_light_is_static():
    registration = PlaneRegistration(taken(table(), 1), REFERENCES_PX)
    shift = motion_of(np.tile([3.0, 1.0], (4, 1)))
    assert registration.is_static(taken(0.7 * table() + 10, 2), shift)
    assert not registration.is_static(taken(0.7 * shown(table(), shift) + 10, 3), shift)
