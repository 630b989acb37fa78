"""Rectangles: detection in pictures, measurement of corners, tracking after camera motions."""

import math

import cv2
import numpy as np
import pytest
from sheets import SIZE, corners_of_view, covered, inside, noisy

from fingerpost._core import edges_along, fit_line
from fingerpost.errors import InvalidInputError
from fingerpost.lens import Lens
from fingerpost.locating import ReferenceSearch
from fingerpost.references import (
    Measured,
    RectangleMeter,
    ReferenceFollower,
    find_rectangles,
    fit_sides,
)
from fingerpost.references.sides import refined
from fingerpost.setting_up import reference_of, rig_of
from fingerpost.uncertainty import blocks_of

A4 = (210.0, 297.0)
PLANE = np.array([[0, 0], [210, 0], [210, 297], [0, 297]], float)
CHI2_95 = -2.0 * math.log(0.05)


def measured(count, paper, table, noise, cover=0.0):
    """Errors of corners in `count` pictures [px], and their squared Mahalanobis distances."""
    errors, squares = [], []
    for seed in range(count):
        rng = np.random.default_rng(seed)
        corners = corners_of_view(rng)
        levels = table + (paper - table) * inside(corners)
        if cover:
            levels = covered(levels, corners, rng, cover)
        sides = refined(noisy(levels, rng, noise), corners + rng.uniform(-2, 2, (4, 2)), reach_px=5)
        off = sides.corners_px - corners
        errors.append(off)
        weights = np.linalg.inv(blocks_of(sides.covariance))
        squares.append(np.einsum("ki,kij,kj->k", off, weights, off))
    return np.array(errors), np.array(squares)


def rms(errors):
    return float(np.sqrt(np.mean(errors**2)))


def test_corners_of_clean_pictures_are_exact():
    errors, _ = measured(12, 220, 80, 0.0)
    assert rms(errors) < 0.005
    errors, _ = measured(12, 60, 200, 1.0)
    assert rms(errors) < 0.02


def test_corners_are_exact_with_a_quarter_of_the_outline_covered():
    errors, _ = measured(30, 220, 80, 4.0, cover=0.25)
    assert rms(errors) < 0.05
    assert np.abs(errors.mean(axis=(0, 1))).max() < 0.01


def test_covariances_contain_the_errors():
    _, squares = measured(60, 220, 80, 3.0)
    # 240 corners with pairwise correlated errors: 95 ± 3 % at two standard deviations.
    assert 0.92 <= np.mean(squares < CHI2_95) <= 0.985


def wooden(rng, shape):
    """Grey levels of a table with wood grain in one direction."""
    grain = rng.normal(size=(shape[0], 24)) * 40
    grain = cv2.resize(grain, shape[::-1], interpolation=cv2.INTER_CUBIC)
    return 110 + cv2.GaussianBlur(grain, (0, 0), 1.5)


def best_off_px(picture, corners, **options):
    """Largest error of the best rectangle's corners [px], in any cyclic order."""
    found = find_rectangles(picture, A4, **options)
    assert found
    got = found[0].sides.corners_px
    distances = np.linalg.norm(got[:, None] - corners[None], axis=2)
    assert sorted(distances.argmin(axis=1)) == [0, 1, 2, 3]
    return float(distances.min(axis=1).max())


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("scene", ["wood", "white desk", "dark mat", "half covered", "colour"])
def test_finds_a_sheet(scene, seed):
    rng = np.random.default_rng(100 + seed)
    corners = corners_of_view(rng)
    part = inside(corners)
    if scene == "colour":
        # The table's lightness, but blue on green.
        colours = [np.array([200.0, 110, 90]), np.array([90.0, 150, 76])]
        levels = colours[1] + (colours[0] - colours[1]) * part[..., None]
        picture = noisy(levels, rng, 2)
        assert best_off_px(picture, corners) < 0.3
        return
    table = {"white desk": 205.0, "dark mat": 200.0}.get(scene, wooden(rng, part.shape))
    paper = {"white desk": 225.0, "dark mat": 40.0}.get(scene, 215.0)
    levels = table + (paper - table) * part
    if scene == "half covered":
        levels = covered(levels, corners, rng, 0.4)
    # The grain has edges, too, some of which run into those of the sheet.
    assert best_off_px(noisy(levels, rng, 2), corners) < 0.8


def test_a_corner_may_be_outside_of_the_picture():
    rng = np.random.default_rng(5)
    corners = corners_of_view(rng)
    corners += [0.0, SIZE[1] + 25.0 - corners[:, 1].max()]
    assert not ((corners >= 0) & (corners < SIZE)).all()
    picture = noisy(80 + 140 * inside(corners), rng, 2)
    assert best_off_px(picture, corners) < 0.2


def test_a_click_or_corners_select_one_of_two_sheets():
    picture = np.full(SIZE[::-1], 90.0)
    sheets = [
        np.array([[x, 80], [x + 190, 84], [x + 180, 380], [x + 4, 370]], float) for x in (60, 360)
    ]
    for corners in sheets:
        picture += 130 * inside(corners)
    picture = noisy(picture, np.random.default_rng(1), 2)
    for corners in sheets:
        assert best_off_px(picture, corners, near_px=corners.mean(axis=0)) < 0.1
        assert best_off_px(picture, corners, near_px=corners[::-1] + 6.0) < 0.1


def test_a_rectangle_of_another_shape_is_none():
    corners = np.array([[100.0, 200.0], [540.0, 200.0], [540.0, 290.0], [100.0, 290.0]])
    picture = noisy(80 + 140 * inside(corners), np.random.default_rng(0), 2.0)
    assert find_rectangles(picture, A4) == []
    assert find_rectangles(picture, (440.0, 90.0)) != []


def test_the_best_of_several_pictures_counts_until_a_sheet_shows_throughout():
    """In the first pictures a part of each sheet is covered, and another edge takes its place."""
    sheets = [corners_of_view(np.random.default_rng(seed)) for seed in (1, 2)]
    rng = np.random.default_rng(0)
    whole = [noisy(80 + 140 * inside(corners), rng, 2.0) for corners in sheets]
    shown = []
    for picture, corners in zip(whole, sheets, strict=True):
        # A cloth like the table, over the sheet's half beyond the middle and on either side of it.
        cloth = 0.5 * (corners[[0, 1, 2, 3]] + corners[[3, 2, 2, 3]])
        cloth = cloth.mean(axis=0) + 1.4 * (cloth - cloth.mean(axis=0))
        shown.append(cv2.fillConvexPoly(picture.copy(), cloth.round().astype(np.int32), 80))
    search = ReferenceSearch(rig_of(["a.mp4", "b.mp4"], reference_of("A4")))
    assert search.look(dict(enumerate(shown))) is None
    found = search.look(dict(enumerate(whole)))
    for view, corners in zip(found.views, sheets, strict=True):
        points = np.array(view.reference_points_px)
        off_px = np.linalg.norm(points[:, None] - corners, axis=-1).min(axis=1)
        assert off_px.max() < 0.3


def test_nothing_is_found_in_plain_pictures():
    assert find_rectangles(np.full((120, 160), 90, np.uint8), A4) == []
    assert find_rectangles(np.zeros((40, 60, 3), np.uint8), A4) == []


def test_sides_are_straight_through_a_known_lens():
    lens = Lens(fx=600.0, fy=600.0, cx=320.0, cy=240.0, k1=-0.25)
    ideal = np.array([[120.0, 90], [540, 110], [500, 400], [90, 380]])
    v, u = np.indices(SIZE[::-1]).astype(float)
    straight = lens.undistort(np.stack([u, v], axis=-1).reshape(-1, 2)).astype(np.float32)
    big = 60 + 150 * inside(ideal * 4 + 1.5, (2560, 1920), sigma_px=3.0)
    shown = cv2.remap(
        big.astype(np.float32),
        (straight[:, 0] * 4 + 1.5).reshape(v.shape),
        (straight[:, 1] * 4 + 1.5).reshape(v.shape),
        cv2.INTER_LINEAR,
    )
    picture, corners = np.round(shown).astype(np.uint8), lens.distort(ideal)
    with_lens = fit_sides(picture, corners + 1.0, lens, reach_px=4)
    assert np.abs(with_lens.corners_px - corners).max() < 0.05
    without = fit_sides(picture, corners + 1.0, None, reach_px=4)
    assert without is None or without.rms_px.max() > 3 * with_lens.rms_px.max()


class Camera:
    """A static scene seen by a camera that can be displaced."""

    def __init__(self, seed=3, noise=3.0):
        self.rng = np.random.default_rng(seed)
        self.corners = corners_of_view(self.rng)
        self.noise = noise
        self.levels = 70 + 150 * inside(self.corners)

    def knock(self, by_px):
        self.corners = self.corners + by_px
        self.levels = 70 + 150 * inside(self.corners)

    def frame(self):
        return noisy(self.levels, self.rng, self.noise)


def follower_of(camera):
    first = Measured(camera.corners + 0.2, np.eye(8) * 0.5)
    return ReferenceFollower(PLANE, RectangleMeter(A4), first)


def off_px(follower, camera):
    view = follower.plane_view(None)
    return float(np.abs(view.project(PLANE) - camera.corners).max())


def test_a_still_camera_averages_its_references():
    camera = Camera(noise=8.0)
    follower = follower_of(camera)
    offs, traces = [], []
    for _ in range(40):
        follower.look(camera.frame())
        offs.append(off_px(follower, camera))
        traces.append(np.trace(follower.covariance))
    assert np.mean(offs[-5:]) < 0.5 * np.mean(offs[:2])
    assert traces[-1] < 0.3 * traces[1]
    assert follower.moved_px == 0.0


@pytest.mark.parametrize("by_px", [1.0, 6.0, 70.0])
def test_references_of_a_displaced_camera_recover_within_3_frames(by_px):
    camera = Camera()
    follower = follower_of(camera)
    for _ in range(30):
        follower.look(camera.frame())
    camera.knock(np.array([0.8, -0.6]) * by_px)
    for _ in range(3):
        follower.look(camera.frame())
    assert follower.moved_px == pytest.approx(by_px, rel=0.1)
    assert off_px(follower, camera) < 0.1
    for _ in range(10):
        follower.look(camera.frame())
    assert follower.moved_px == 0.0


def test_covering_a_side_is_not_a_motion():
    camera = Camera()
    follower = follower_of(camera)
    for _ in range(10):
        follower.look(camera.frame())
    # A ruler along a side, reaching 4 px inside the sheet.
    a, b = camera.corners[:2]
    inward = camera.corners.mean(axis=0) - (a + b) / 2
    shift = 4 * inward / np.linalg.norm(inward)
    ruler = np.stack([a - 8 * shift, b - 8 * shift, b + shift, a + shift])
    camera.levels = camera.levels * (1 - inside(ruler)) + 200 * inside(ruler)
    for _ in range(6):
        follower.look(camera.frame())
        assert off_px(follower, camera) < 0.2
    assert follower.moved_px == 0.0


def test_a_view_without_references_is_adrift():
    camera = Camera()
    follower = follower_of(camera)
    for _ in range(3):
        follower.look(camera.frame())
    for _ in range(3):
        follower.look(np.full(SIZE[::-1], 90, np.uint8))
    assert follower.is_adrift
    assert follower.plane_view(None) is None


def test_edges_and_lines_refuse_invalid_input():
    picture = np.zeros((20, 20), np.uint8)
    with pytest.raises(InvalidInputError, match="reach_px is 0"):
        edges_along(picture, [[1, 2], [9, 2]], 0, 0, 3)
    with pytest.raises(InvalidInputError, match="polarity is 2; it must be -1, 0 or 1"):
        edges_along(picture, [[1, 2], [9, 2]], 2, 2, 3)
    with pytest.raises(InvalidInputError, match="sigmas_px"):
        fit_line([[0, 0], [1, 1]], [1.0])
