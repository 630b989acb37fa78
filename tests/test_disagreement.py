"""Disagreement of two views, whose two lines always intersect: it is in the ellipse."""

import numpy as np
import pytest
from geometry_rig import CORNERS, finger_line, plane_view, seen_rod, stereo

from fingerpost.consistency import Disagreement
from fingerpost.finding import Viewpoint, rays_of_tips
from fingerpost.pointing import BARE_HAND, PlaneView, Status, indicated_point

LINE_COVARIANCE = np.diag([0.2**2, 0.003**2])


def points_px(camera):
    return camera.project(np.column_stack([CORNERS, np.zeros(4)]))


def displacements_of(disagreement, viewpoints, lines):
    """Displacements by the disagreement of lines [plane units]."""
    distances = {pair: tips.distance for pair, tips in rays_of_tips(viewpoints, lines).items()}
    size = viewpoints[0].plane_view.plane_size
    return {k: size * sigma for k, sigma in disagreement.update(distances).items()}


def share_outside(shift_px, *, widens, count=40):
    """Share of fixes whose 95 % ellipse excludes the true point if one view's points are shifted.

    Refused fixes exclude nothing.
    """
    rng, cameras = np.random.default_rng(int(shift_px)), stereo(20.0)
    outside = 0
    for _ in range(count):
        turn_rad = rng.uniform(0.0, 2.0 * np.pi)
        shift = shift_px * np.array([np.cos(turn_rad), np.sin(turn_rad)])
        views = [
            PlaneView.from_reference_points(CORNERS, points_px(camera) + off, 0.25 * np.eye(2))
            for camera, off in zip(cameras, (np.zeros(2), shift), strict=True)
        ]
        viewpoints = [Viewpoint.of(view, (640, 480)) for view in views]
        pose = seen_rod(rng, cameras)
        lines = [finger_line(camera, pose, LINE_COVARIANCE) for camera in cameras]
        displacements = displacements_of(Disagreement(), viewpoints, lines) if widens else {}
        fix = indicated_point(
            lines, views, time_s=0.0, options=BARE_HAND, displacements=displacements
        )
        if fix.status is Status.OK:
            off = fix.point - pose.target
            outside += off @ np.linalg.solve(fix.covariance, off) > 5.99
    return outside / count


@pytest.mark.parametrize("shift_px", [20.0, 45.0])
def test_few_ellipses_exclude_the_true_point_although_the_points_of_one_view_are_off(shift_px):
    # A shift along the line between the cameras does not separate the rays of the tips.
    without = share_outside(shift_px, widens=False)
    assert without > 0.5
    assert share_outside(shift_px, widens=True) < 0.4 * without


def test_views_that_agree_have_no_displacement():
    rng, cameras = np.random.default_rng(1), stereo()
    views = [plane_view(camera, 0.25 * np.eye(2)) for camera in cameras]
    viewpoints = [Viewpoint.of(view, (640, 480)) for view in views]
    disagreement = Disagreement()
    for _ in range(30):
        pose = seen_rod(rng, cameras)
        noise = rng.normal(0.0, (0.5, 0.01), (2, 2))
        lines = [
            finger_line(camera, pose, noise=one) for camera, one in zip(cameras, noise, strict=True)
        ]
        assert displacements_of(disagreement, viewpoints, lines) == {}
