"""Pictures of any size: large ones are tracked at a reduced size and reported in full pixels."""

import math

import numpy as np
import pytest

from fingerpost.admission import reduced_view
from fingerpost.capture import Frame
from fingerpost.config import LensParameters, Rig, Start, View
from fingerpost.homography import transfer_to_image
from fingerpost.lens import Lens
from fingerpost.pipeline import LARGEST_PX, Pointer, steps
from fingerpost.pointing import Status
from fingerpost.references import PlaneMotion, Reduction
from fingerpost.simulate import Background, DevicePose, Placement, SimulatedRig
from fingerpost.simulated_rig_file import rig_from_simulation

TIMES_AS_LARGE = 9
SMALL = Placement(width_px=320, height_px=240)


def enlarged(view: View) -> View:
    """Return the view of pictures enlarged by `TIMES_AS_LARGE`."""

    def whole(px):
        return tuple(TIMES_AS_LARGE * (c + 0.5) - 0.5 for c in px)

    start = view.start
    return View(
        name=view.name,
        source=view.source,
        reference_points_px=tuple(map(whole, view.reference_points_px)),
        start=Start(
            tip_px=whole(start.tip_px),
            angle_deg=start.angle_deg,
            length_px=TIMES_AS_LARGE * start.length_px,
            thumb=start.thumb,
        ),
    )


@pytest.fixture(scope="module")
def large_steps():
    rig = SimulatedRig(SMALL, background=Background(texture="wood", clutter=20.0))
    pose = DevicePose.pointing_at((190.0, 210.0), slant_deg=50.0, hover_mm=100.0)
    starts = [view.finger.start() for view in rig.truth(pose).views]
    small = rig_from_simulation(rig, starts=starts)
    pointer = Pointer(Rig(plane=small.plane, views=tuple(map(enlarged, small.views))))
    rng = np.random.default_rng(3)

    def frames():
        square = np.ones((TIMES_AS_LARGE, TIMES_AS_LARGE), np.uint8)
        for k in range(10):
            images = rig.render(pose, rng=rng).images
            yield [Frame(k, k / 30.0, np.kron(image, square)) for image in images]

    return pose, rig, list(steps(pointer, frames()))


def test_large_pictures_give_the_indicated_point(large_steps):
    pose, _, results = large_steps
    assert results[-1].fix.status is Status.OK
    assert math.dist(results[-1].fix.point, pose.indicated_mm) < 5.0


def test_tables_contain_pixels_of_the_source(large_steps):
    pose, rig, results = large_steps
    assert max(results[-1].observations[0].frame.image.shape) <= LARGEST_PX
    for seen, truth in zip(results[-1].observations, rig.truth(pose).views, strict=True):
        tip_px = TIMES_AS_LARGE * (truth.finger.apex_pictured_px + 0.5) - 0.5
        row = seen.track_row()
        assert math.dist((row.tip_u, row.tip_v), tip_px) < 2.0 * TIMES_AS_LARGE
        assert row.sigma_offset_px > seen.finger.covariance[0, 0] ** 0.5


def test_a_picture_within_the_limit_is_not_copied():
    picture = np.zeros((30, 40), np.uint8)
    reduction = Reduction.of(picture.shape, 40)
    assert reduction.factor == 1
    assert reduction.picture(picture) is picture
    assert Reduction.of((30, 41), 40).factor == 2


def test_pixels_of_a_reduced_picture_are_means_at_the_centre_of_their_blocks():
    picture = np.arange(7 * 11, dtype=np.uint8).reshape(7, 11)
    reduced = Reduction(3).picture(picture)
    assert reduced.shape == (2, 3)
    assert reduced[1, 2] == round(picture[3:6, 6:9].mean())
    assert Reduction(3).whole((2, 1)).tolist() == [7.0, 4.0]  # centre of those nine pixels
    assert Reduction(3).points((7.0, 4.0)).tolist() == [2.0, 1.0]
    assert transfer_to_image(Reduction(3).whole_from_reduced, [[2.0, 1.0]]).tolist() == [[7, 4]]


def test_a_reduced_lens_has_the_same_distortion():
    lens = Lens(fx=900.0, fy=880.0, cx=640.0, cy=350.0, k1=-0.2, k2=0.03)
    points_px = np.array([[100.0, 80.0], [1200.0, 500.0]])
    reduction = Reduction(4)
    bent = reduction.lens(lens).distort(reduction.points(points_px))
    np.testing.assert_allclose(reduction.whole(bent), lens.distort(points_px), atol=1e-9)


def test_a_plane_motion_is_scaled_with_its_covariance():
    rng = np.random.default_rng(0)
    now_from_first = np.eye(3) + rng.normal(0, [[1e-3] * 3] * 2 + [[1e-6, 1e-6, 0]], (3, 3))
    spread = rng.normal(size=(9, 9))
    motion = PlaneMotion(now_from_first, 1e-12 * spread @ spread.T)
    scaled = motion.scaled(Reduction(3).whole_from_reduced)
    points_px = rng.uniform(0, 500, (5, 2))
    np.testing.assert_allclose(
        transfer_to_image(scaled.now_from_first, Reduction(3).whole(points_px)),
        Reduction(3).whole(transfer_to_image(motion.now_from_first, points_px)),
    )
    drawn = rng.multivariate_normal(np.zeros(9), motion.covariance, 20000)
    whole = Reduction(3).whole_from_reduced
    entries = [(whole @ d.reshape(3, 3) @ np.linalg.inv(whole)).ravel() for d in drawn]
    np.testing.assert_allclose(
        np.cov(np.array(entries).T), scaled.covariance, atol=0.05 * np.abs(scaled.covariance).max()
    )


def test_all_pixel_values_of_a_view_are_reduced():
    view = View(
        name="left",
        source=0,
        reference_points_px=((10.0, 20.0), (300.0, 20.0), (300.0, 200.0), (10.0, 200.0)),
        reference_covariances_px2=((4.0, 1.0, 9.0),) * 4,
        lens_parameters=LensParameters(fx=400.0, fy=400.0, cx=160.0, cy=120.0, k1=-0.1),
        start=Start(tip_px=(100.0, 90.0), angle_deg=30.0, length_px=60.0, thumb="left"),
    )
    reduced = reduced_view(view, Reduction(2))
    assert reduced.reference_points_px[0] == (4.75, 9.75)
    assert reduced.reference_covariances_px2[0] == (1.0, 0.25, 2.25)
    assert reduced.start == Start(
        tip_px=(49.75, 44.75), angle_deg=30.0, length_px=30.0, thumb="left"
    )
    assert reduced.lens == Reduction(2).lens(view.lens)
