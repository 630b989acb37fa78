"""Images of bodies above the plane, compared with the simulated camera's own matrix."""

import math

import numpy as np
import pytest

from fingerpost.finding import Viewpoint
from fingerpost.lens import Lens
from fingerpost.pointing import PlaneView
from fingerpost.silhouette import Capsule, Silhouette, image_from_space
from fingerpost.simulate import SimulatedRig

CAMERA = SimulatedRig().cameras[0]
PLANE = np.array([[0.0, 0.0], [400.0, 0.0], [400.0, 400.0], [0.0, 400.0]])


def viewpoint() -> Viewpoint:
    on_table = np.pad(PLANE, ((0, 0), (0, 1)))
    view = PlaneView.from_reference_points(PLANE, CAMERA.project(on_table), None)
    return Viewpoint.of(view, (CAMERA.width_px, CAMERA.height_px))


def test_the_camera_matrix_projects_as_the_camera_does():
    one = viewpoint()
    matrix = image_from_space(one.plane_view.image_from_plane, one.centre)
    points = np.random.default_rng(1).uniform([0, 0, 0], [400, 400, 300], (50, 3))
    image = np.pad(points, ((0, 0), (0, 1)), constant_values=1.0) @ matrix.T
    assert image[:, 2].min() > 0
    np.testing.assert_allclose(image[:, :2] / image[:, 2:], CAMERA.project(points), atol=1e-6)


def test_a_lens_of_two_focal_lengths_gives_the_camera_centre():
    """Pixels that are not square: every row is stretched by a quarter."""
    lens = Lens(CAMERA.f_px, 1.25 * CAMERA.f_px, *CAMERA.principal_point_px, 0.0)
    stretched = CAMERA.project(np.pad(PLANE, ((0, 0), (0, 1))))
    stretched[:, 1] = lens.cy + 1.25 * (stretched[:, 1] - lens.cy)
    view = PlaneView.from_reference_points(PLANE, stretched, None, lens)
    centre = Viewpoint.of(view, (CAMERA.width_px, CAMERA.height_px)).centre
    np.testing.assert_allclose(centre, CAMERA.centre_mm, atol=1e-6)


def test_a_capsule_covers_its_inside_and_nothing_outside():
    one = viewpoint()
    capsule = Capsule((100.0, 150.0, 20.0), (250.0, 200.0, 180.0), 30.0)
    silhouette = one.silhouette([capsule])
    rng = np.random.default_rng(2)
    start, end = np.array(capsule.start), np.array(capsule.end)
    directions = rng.normal(size=(2000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    axis = start + rng.uniform(size=(2000, 1)) * (end - start)
    inside = axis + 0.95 * capsule.radius * rng.uniform(size=(2000, 1)) * directions
    assert silhouette.covers(CAMERA.project(inside)).all()
    # Pixels whose rays pass the axis at more than the radius are not covered.
    pixels = rng.uniform([0, 0], [CAMERA.width_px, CAMERA.height_px], (2000, 2))
    rays = one.plane_view.back_project(pixels)
    feet = np.pad(rays, ((0, 0), (0, 1)))
    away = np.array([_gap(one.centre, foot, start, end) for foot in feet])
    covered = silhouette.covers(pixels)
    assert covered[away < 0.95 * capsule.radius].all()
    assert not covered[away > 1.05 * capsule.radius].any()


def _gap(p: np.ndarray, foot: np.ndarray, start: np.ndarray, end: np.ndarray) -> float:
    """Least distance of a ray from a segment, by brute force over the segment."""
    direction = (foot - p) / np.linalg.norm(foot - p)
    points = start + np.linspace(0.0, 1.0, 400)[:, None] * (end - start)
    along = np.maximum((points - p) @ direction, 0.0)[:, None]
    return float(np.linalg.norm(points - p - along * direction, axis=1).min())


def test_bodies_behind_the_camera_have_no_image():
    one = viewpoint()
    behind = one.centre + (one.centre - [200.0, 200.0, 0.0])
    point = tuple(behind.tolist())
    assert len(one.silhouette([Capsule(point, point, 10.0)]).radii_px) == 0


def test_an_unknown_camera_covers_nothing():
    matrix = np.full((3, 4), np.nan)
    capsule = Capsule((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 1.0)
    silhouette = Silhouette.of([capsule], matrix, np.full(3, np.nan))
    assert not silhouette.covers([[0.0, 0.0]]).any()


@pytest.mark.parametrize(
    ("point", "distance"),
    [((0.5, 2.0, 0.0), 2.0), ((-3.0, 4.0, 0.0), 5.0), ((4.0, 0.0, 4.0), 5.0)],
)
def test_the_distance_from_a_segment(point, distance):
    capsule = Capsule((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 1.0)
    assert capsule.distance(np.array(point)) == pytest.approx(distance)


def test_a_capsule_may_be_a_sphere():
    capsule = Capsule((1.0, 2.0, 3.0), (1.0, 2.0, 3.0), 2.0)
    assert capsule.spheres().tolist() == [[1.0, 2.0, 3.0, 2.0]]
    assert capsule.distance(np.array([1.0, 2.0, 7.0])) == pytest.approx(4.0)
    assert math.isfinite(capsule.radius)
