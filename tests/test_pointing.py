import dataclasses

import numpy as np
import pytest
from geometry_rig import (
    CORNERS,
    SIDE,
    camera,
    central_differences,
    covariance_of,
    finger_line,
    plane_view,
    random_warp,
    rod,
    seen_rod,
    stereo,
    view_ray_angle_deg,
)
from hypothesis import example, given, settings
from hypothesis import strategies as st

from fingerpost.errors import DegenerateReferencePointsError, InvalidInputError
from fingerpost.homography import transfer_to_image
from fingerpost.lens import Lens
from fingerpost.lines import distance
from fingerpost.pointing import (
    DEFAULT_OPTIONS,
    AlignmentState,
    FingerLine,
    PlaneView,
    PointingOptions,
    Status,
    align,
    indicated_point,
)
from fingerpost.uncertainty import UNBOUNDED, homography_covariance, intersect

EXACT = 1e-9 * SIDE

# A tracker near the physical limit at 640 × 480, and one with 10 times its σ.
FINE = np.diag([0.005**2, np.radians(0.016) ** 2])
COARSE = 100 * FINE

REFERENCES = 0.1**2 * np.eye(2)


def references_of(view):
    return view.project(np.column_stack([CORNERS, np.zeros(4)]))


def noisy_fingers(rng, cameras, pointing, covariance):
    noise = rng.standard_normal((len(cameras), 2)) * np.sqrt(np.diag(covariance))
    return [
        finger_line(view, pointing, covariance, noise=each)
        for view, each in zip(cameras, noise, strict=True)
    ]


def fix_of(cameras, pointing, covariance=None, references=None, half_width_px=0.0, **options):
    fingers = [finger_line(view, pointing, covariance) for view in cameras]
    return indicated_point(
        [dataclasses.replace(finger, half_width_px=half_width_px) for finger in fingers],
        [plane_view(view, references) for view in cameras],
        time_s=0.0,
        options=PointingOptions(**options),
    )


# --- the point ---------------------------------------------------------------------------------


def test_a_thousand_random_rigs_are_exact():
    rng = np.random.default_rng(51)
    worst = 0.0
    for _ in range(1000):
        azimuth, apart = rng.uniform(-180, 180), rng.uniform(20, 100)
        cameras = [
            camera(a, rng.uniform(25, 65), rng.uniform(1000, 3000), rng.uniform(600, 3000))
            for a in (azimuth, azimuth + apart)
        ]
        fix = None
        while fix is None or fix.crossing_angle_rad < np.radians(5):
            pointing = seen_rod(rng, cameras, azimuth_deg=(-180, 180))
            fix = fix_of(cameras, pointing)
        assert fix.status is Status.OK, fix.reason
        worst = max(worst, np.hypot(*(fix.point - pointing.target)))
    assert worst <= EXACT


@pytest.mark.parametrize("count", [2, 3, 5])
def test_lines_of_any_number_of_views_intersect_in_the_point(count):
    cameras = [camera(a) for a in np.linspace(-40, 40, count)]
    fix = fix_of(cameras, rod([120, 260], 20.0, 45.0, 150.0))
    assert np.hypot(*(fix.point - [120, 260])) <= EXACT
    assert len(fix.constraint_lines) == count


def test_any_plane_coordinates_are_accepted():
    """Robot coordinates: metres, rotated, with an origin out of the cameras' view."""
    cameras, pointing = stereo(), rod([120, 260], 20.0, 45.0, 150.0)
    turn = np.radians(130)
    similarity = 1e-3 * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    origin = np.array([4.0, -7.0])
    views = [
        PlaneView.from_reference_points(
            CORNERS @ similarity.T + origin,
            references_of(view),
            REFERENCES,
        )
        for view in cameras
    ]
    fix = indicated_point([finger_line(view, pointing, FINE) for view in cameras], views, time_s=0)
    plain = fix_of(cameras, pointing, FINE, REFERENCES)
    assert np.allclose(fix.point, similarity @ pointing.target + origin, rtol=0, atol=1e-11)
    assert np.allclose(fix.covariance, similarity @ plain.covariance @ similarity.T, rtol=1e-7)


def warped(finger, warp):
    """The finger line after a homography of the image, with its covariance to first order."""

    def line_of(perturbation):
        normal = np.array([-np.sin(finger.angle_rad), np.cos(finger.angle_rad)])
        anchor = finger.anchor_px + perturbation[0] * normal
        angle = finger.angle_rad + perturbation[1]
        ends = anchor + np.outer([0, 50], [np.cos(angle), np.sin(angle)])
        return transfer_to_image(warp, ends)

    anchor, ahead = line_of(np.zeros(2))
    along = ahead - anchor
    angle = np.arctan2(along[1], along[0])
    tangent = np.array([np.cos(angle), np.sin(angle)])
    normal = np.array([-tangent[1], tangent[0]])

    def offset_and_turn(perturbation):
        moved, moved_ahead = line_of(perturbation)
        t = moved_ahead - moved
        at_anchor = moved + t * ((anchor - moved) @ tangent) / (t @ tangent)
        return np.array([(at_anchor - anchor) @ normal, np.arctan2(t @ normal, t @ tangent)])

    J = central_differences(offset_and_turn, np.zeros(2), [1.0, 0.01])
    return FingerLine(
        anchor_px=anchor,
        angle_rad=angle,
        covariance=J @ finger.covariance @ J.T,
        tip_px=transfer_to_image(warp, finger.tip_px),
        time_s=finger.time_s,
    )


@pytest.mark.parametrize("azimuths", [(-15, 15), (-25, 5, 30)], ids=["two views", "three views"])
def test_the_result_is_invariant_to_homographies_of_the_images(azimuths):
    """Section 2 of the paper: working plane coordinates do not depend on the cameras."""
    rng = np.random.default_rng(52)
    cameras = [camera(a) for a in azimuths]
    compared = 0
    while compared < 200:
        pointing = seen_rod(rng, cameras)
        fingers = [finger_line(view, pointing, COARSE) for view in cameras]
        references = [references_of(view) for view in cameras]
        plain = indicated_point(
            fingers,
            [PlaneView.from_reference_points(CORNERS, px, None) for px in references],
            time_s=0.0,
        )
        warps = [random_warp(rng, extent=640.0) for _ in cameras]
        shown = [
            np.vstack([px, f.anchor_px, f.tip_px])
            for px, f in zip(references, fingers, strict=True)
        ]
        if plain.status is not Status.OK or any(
            np.isnan(transfer_to_image(warp, px)).any()
            for warp, px in zip(warps, shown, strict=True)
        ):
            continue
        fix = indicated_point(
            [warped(finger, warp) for finger, warp in zip(fingers, warps, strict=True)],
            [
                PlaneView.from_reference_points(CORNERS, transfer_to_image(warp, px), None)
                for warp, px in zip(warps, references, strict=True)
            ],
            time_s=0.0,
        )
        assert fix.status is Status.OK
        assert np.hypot(*(fix.point - plain.point)) <= 1e-8 * SIDE
        slack = 1e-5 * np.diag(plain.covariance).min()
        assert np.allclose(fix.covariance, plain.covariance, rtol=1e-5, atol=slack)
        compared += 1


def test_the_covariance_covers_the_errors_over_random_poses():
    rng = np.random.default_rng(53)
    cameras = stereo()
    inside = []
    for _ in range(1500):
        noise = 0.1 * rng.standard_normal((2, 4, 2))
        views = [plane_view(v, REFERENCES, noise_px=n) for v, n in zip(cameras, noise, strict=True)]
        pointing = seen_rod(rng, cameras)
        fingers = noisy_fingers(rng, cameras, pointing, FINE)
        fix = indicated_point(fingers, views, time_s=0.0)
        assert fix.status is Status.OK
        inside.append(fix.ellipse(0.95).contains(pointing.target))
    assert np.mean(inside) == pytest.approx(0.95, abs=0.02)


def test_the_bias_allowance_is_added_at_the_anchor():
    cameras, pointing = stereo(), rod([120, 260], 20.0, 45.0, 150.0)
    allowed = fix_of(cameras, pointing, FINE, bias_offset_px=0.1, bias_angle_rad=0.004)
    stated = fix_of(cameras, pointing, FINE + np.diag([0.1**2, 0.004**2]))
    assert np.allclose(allowed.covariance, stated.covariance, rtol=1e-12)
    assert np.all(
        np.linalg.eigvalsh(allowed.covariance - fix_of(cameras, pointing, FINE).covariance) > 0
    )


@pytest.mark.parametrize(("half_width_px", "wider"), [(0.0, 1.0), (6.0, 1.0), (20.0, 2.5)])
def test_the_offset_allowance_grows_with_the_finger_s_width(half_width_px, wider):
    cameras, pointing = stereo(), rod([120, 260], 20.0, 45.0, 150.0)
    allowances = {"bias_offset_px": 0.1, "bias_angle_rad": 0.004}
    allowed = fix_of(cameras, pointing, FINE, half_width_px=half_width_px, **allowances)
    stated = fix_of(cameras, pointing, FINE + np.diag([(0.1 * wider) ** 2, 0.004**2]))
    assert np.allclose(allowed.covariance, stated.covariance, rtol=1e-12)


def test_constraint_lines_and_their_bands_are_kept_for_drawing():
    cameras, pointing = stereo(), rod([120, 260], 20.0, 45.0, 150.0)
    fix = fix_of(cameras, pointing, FINE, REFERENCES)
    for constraint in fix.constraint_lines:
        assert distance(constraint.line, pointing.target) == pytest.approx(0, abs=1e-9)
        tangent = np.array([constraint.line[1], -constraint.line[0]])
        band = constraint.sigma_at(pointing.target + np.outer([-300.0, 0.0, 300.0], tangent))
        assert band.shape == (3,)
        assert np.all(band > 0)
    first, second = (constraint.line[:2] for constraint in fix.constraint_lines)
    assert np.cos(fix.crossing_angle_rad) == pytest.approx(abs(first @ second))


def test_the_same_input_gives_the_same_bits_and_is_not_modified():
    cameras, pointing = stereo(), rod([120, 260], 20.0, 45.0, 150.0)
    fingers = [finger_line(view, pointing, FINE) for view in cameras]
    before = [(f.anchor_px.copy(), f.covariance.copy(), f.tip_px.copy()) for f in fingers]
    views = [plane_view(view, REFERENCES) for view in cameras]
    fixes = [indicated_point(fingers, views, time_s=0.0) for _ in range(2)]
    assert fixes[0].point.tobytes() == fixes[1].point.tobytes()
    assert fixes[0].covariance.tobytes() == fixes[1].covariance.tobytes()
    for finger, (anchor, covariance, tip) in zip(fingers, before, strict=True):
        assert np.array_equal(finger.anchor_px, anchor)
        assert np.array_equal(finger.covariance, covariance)
        assert np.array_equal(finger.tip_px, tip)


# --- refusals ---------------------------------------------------------------------------------


def assert_refused(fix, words):
    assert fix.status is Status.ILL_CONDITIONED
    assert fix.point is None
    assert fix.ellipse() is None
    assert words in fix.reason
    assert fix.covariance is not None


def largest_sigma(covariance):
    if np.isinf(covariance).any():
        return np.inf
    return np.sqrt(np.linalg.eigvalsh(covariance)[-1])


def test_fixes_of_rods_pointing_away_are_refused_or_covered():
    """With a limit of 2 %, errors above 5 % are refused, or covered by the 99 % ellipse."""
    rng = np.random.default_rng(54)
    cameras = stereo()
    views = [plane_view(view, REFERENCES) for view in cameras]
    refused = far = 0
    for _ in range(1000):
        pointing = seen_rod(rng, cameras, azimuth_deg=(120, 180))
        fingers = noisy_fingers(rng, cameras, pointing, COARSE)
        fix = indicated_point(fingers, views, time_s=0.0, options=PointingOptions(max_sigma=0.02))
        if fix.status is not Status.OK:
            refused += 1
            continue
        error = np.hypot(*(fix.point - pointing.target))
        far += error > 20
        assert error <= 20 or fix.ellipse(0.99).contains(pointing.target)
    assert 50 < refused < 700
    assert far < 5


def test_large_ellipses_cover_as_often_as_small_ones():
    """Fixes with default options of rods that point away, seen by lines with σ of 0.3°."""
    rng = np.random.default_rng(57)
    cameras = stereo()
    views = [plane_view(view, REFERENCES) for view in cameras]
    outside, sigmas = [], []
    for _ in range(1500):
        pointing = seen_rod(rng, cameras, azimuth_deg=(120, 180))
        fingers = noisy_fingers(rng, cameras, pointing, 4 * COARSE)
        fix = indicated_point(fingers, views, time_s=0.0)
        if fix.status is Status.OK:
            outside.append(
                [not fix.ellipse(share).contains(pointing.target) for share in (0.95, 0.99)]
            )
            sigmas.append(largest_sigma(fix.covariance) / SIDE)
    # Most are accepted, up to a 95 % ellipse as long as the plane.
    assert len(sigmas) > 1000
    assert 0.12 < max(sigmas) <= DEFAULT_OPTIONS.max_sigma
    assert np.sqrt(-2.0 * np.log(0.05)) * DEFAULT_OPTIONS.max_sigma == pytest.approx(0.5, rel=0.03)
    # By chance 55 ± 7 and 11 ± 3 of 1,100.
    large = np.array(sigmas) > 0.05
    share = np.mean(outside, axis=0)
    assert share[0] < 0.055
    assert share[1] < 0.015
    assert np.mean(np.array(outside)[large, 1]) < 0.03


def test_the_covariance_accounts_for_the_lines_at_the_ends_of_the_ellipse():
    """First order for certain lines; for uncertain ones the covariance grows to cover the ends."""
    rng = np.random.default_rng(58)
    cameras = stereo()
    views = [plane_view(view, REFERENCES) for view in cameras]
    grown = []
    for scale in (1e-4, 16.0):
        pointing = seen_rod(rng, cameras, azimuth_deg=(-60, 60))
        fingers = noisy_fingers(rng, cameras, pointing, scale * COARSE)
        fix = indicated_point(fingers, views, time_s=0.0)
        lines = [line.line for line in fix.constraint_lines]
        found = intersect(lines, [line.covariance for line in fix.constraint_lines])
        assert np.array_equal(fix.point, found.point)
        assert np.linalg.eigvalsh(fix.covariance - found.covariance)[0] >= -1e-9 * SIDE**2
        grown.append(largest_sigma(fix.covariance) / largest_sigma(found.covariance) - 1.0)
    assert grown[0] < 0.01
    assert 0.01 < grown[1] < 0.5


def coplanar_rod(rng, cameras):
    """A rod in one plane with both camera centres: both constraint lines are the same line."""
    while True:
        target = rng.uniform(0.05, 0.95, 2) * SIDE
        towards = [view.position - [*target, 0.0] for view in cameras]
        share = rng.uniform(-1.5, 2.5)
        direction = -(share * towards[0] + (1 - share) * towards[1])
        azimuth = np.degrees(np.arctan2(direction[0], -direction[1]))
        slant = np.degrees(np.arcsin(-direction[2] / np.linalg.norm(direction)))
        pointing = rod(target, azimuth, slant, rng.uniform(20, 250))
        if slant > 10 and min(view_ray_angle_deg(v, pointing) for v in cameras) > 15:
            return pointing


@pytest.mark.parametrize(
    "covariance", [FINE, COARSE, 16 * COARSE], ids=["fine", "coarse", "a degree off"]
)
def test_a_finger_coplanar_with_the_cameras_is_always_refused(covariance):
    rng = np.random.default_rng(55)
    cameras = stereo()
    views = [plane_view(view, REFERENCES) for view in cameras]
    for _ in range(500):
        pointing = coplanar_rod(rng, cameras)
        fingers = noisy_fingers(rng, cameras, pointing, covariance)
        fix = indicated_point(fingers, views, time_s=0.0)
        assert_refused(fix, "along the constraint lines")
        assert largest_sigma(fix.covariance) > DEFAULT_OPTIONS.max_sigma * SIDE


def test_exactly_parallel_constraint_lines_are_refused():
    cameras, pointing = stereo(), coplanar_rod(np.random.default_rng(56), stereo())
    views = [plane_view(view) for view in cameras]
    # The second view's finger line is the image of the first one's constraint line.
    first = finger_line(cameras[0], pointing, FINE)
    ends = transfer_to_image(
        views[1].image_from_plane,
        views[0].back_project(np.stack([first.anchor_px, first.tip_px])),
    )
    along = ends[1] - ends[0]
    second = FingerLine(ends[0], np.arctan2(along[1], along[0]), FINE, ends[1], 0.0)
    fix = indicated_point([first, second], views, time_s=0.0)
    assert_refused(fix, "constraint lines")
    assert largest_sigma(fix.covariance) > 1e3 * SIDE
    assert fix.crossing_angle_rad < 1e-6


@pytest.mark.parametrize("slant", [0.0, 0.2, 2.0], ids=["parallel", "nearly", "slightly down"])
def test_a_finger_parallel_to_the_plane_is_refused(slant):
    cameras = stereo()
    pointing = rod([200, 200], 60.0, 30.0, 100.0)
    down = np.radians(slant)
    direction = np.array([np.sin(1.0) * np.cos(down), -np.cos(1.0) * np.cos(down), -np.sin(down)])
    level = dataclasses.replace(pointing, base=pointing.tip - 80 * direction)
    fix = fix_of(cameras, level, FINE, REFERENCES)
    assert_refused(fix, "along the constraint lines")
    assert largest_sigma(fix.covariance) > DEFAULT_OPTIONS.max_sigma * SIDE


def test_the_horizon_as_a_finger_line_is_refused():
    fingers = [finger_line(view, rod([120, 260], 20.0, 45.0, 150.0)) for view in stereo()]
    # v = Y / (1 + Y/4): the plane's image stays below the line v = 4 for any Y.
    T = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0.25, 1]])
    level = PlaneView(CORNERS, T, np.zeros((9, 9)), None)
    horizon = FingerLine([0.0, 4.0], 0.0, FINE, [5.0, 4.0], 0.0)
    fix = indicated_point([fingers[0], horizon], [plane_view(stereo()[0]), level], time_s=0.0)
    assert_refused(fix, "horizon")
    assert np.array_equal(fix.covariance, UNBOUNDED)
    assert fix.constraint_lines[1] is None
    assert fix.constraint_lines[0] is not None


def pointing_up():
    down = rod([120, 260], 20.0, 45.0, 150.0)
    return dataclasses.replace(down, base=down.tip, tip=down.base)


def test_a_target_behind_the_finger_tip_is_refused():
    fix = fix_of(stereo(), pointing_up(), FINE, REFERENCES)
    assert_refused(fix, "behind the finger tip in view")
    # The covariance is small; only the direction is wrong.
    assert largest_sigma(fix.covariance) < 0.01 * SIDE


@pytest.mark.parametrize(
    ("short_px", "half_width_px", "accepted"),
    [
        (0.0, 0.0, True),
        (14.0, 8.0, True),
        (20.0, 8.0, False),
        (30.0, 16.0, True),
        (35.0, 16.0, False),
    ],
)
def test_a_touching_finger_may_reach_beyond_its_target(short_px, half_width_px, accepted):
    """The target may lie 4 σ of 4 px behind the tip; σ grows with half widths above 8 px."""
    cameras, touching = stereo(), rod([120, 260], 20.0, 45.0, 1e-9)
    fingers = [finger_line(view, touching, FINE) for view in cameras]
    fingers = [
        dataclasses.replace(
            finger,
            tip_px=finger.tip_px
            + short_px * np.array([np.cos(finger.angle_rad), np.sin(finger.angle_rad)]),
            half_width_px=half_width_px,
        )
        for finger in fingers
    ]
    fix = indicated_point(fingers, [plane_view(view) for view in cameras], time_s=0.0)
    assert (fix.status is Status.OK) == accepted


def test_a_point_behind_a_camera_is_refused():
    """The lines intersect well on the plane, but one view cannot see the point."""
    cameras = [camera(-15.0), camera(80.0)]
    views = [plane_view(view) for view in cameras]
    behind = cameras[0].position[:2] * 2.5 - CORNERS.mean(axis=0) * 1.5
    fingers = []
    for view, a in zip(cameras, (0.3, 1.5), strict=True):
        y = view.image_from_plane @ [*behind, 1.0]
        anchor = y[:2] / y[2]
        tip = anchor + 50 * np.array([np.cos(a), np.sin(a)])
        fingers.append(FingerLine(anchor, a, np.zeros((2, 2)), tip, 0.0))
    fix = indicated_point(fingers, views, time_s=0.0, options=PointingOptions(max_sigma=10.0))
    assert_refused(fix, "beyond the horizon of view 0")
    options = PointingOptions(max_sigma=10.0)
    fix = indicated_point(fingers, views, time_s=0.0, options=options, names=["left", "right"])
    assert_refused(fix, "beyond the horizon of left")


def test_a_finger_seen_end_on_is_refused_by_its_own_covariance():
    """End-on, the visible length is too short to measure the angle; the covariance shows it."""
    cameras, pointing = stereo(), rod([120, 260], 20.0, 45.0, 150.0)
    views = [plane_view(view, REFERENCES) for view in cameras]
    short = np.diag([0.1**2, np.radians(8.0) ** 2])
    fingers = [finger_line(cameras[0], pointing, FINE), finger_line(cameras[1], pointing, short)]
    assert_refused(indicated_point(fingers, views, time_s=0.0), "standard deviation")


def test_nearly_collinear_references_are_refused_by_their_covariance():
    cameras, pointing = stereo(), rod([120, 300], 20.0, 45.0, 150.0)
    fingers = [finger_line(view, pointing, FINE) for view in cameras]
    for height, status in ((400.0, Status.OK), (4.0, Status.ILL_CONDITIONED)):
        plane = CORNERS * [1.0, height / SIDE]
        views = [plane_view(view, REFERENCES, plane) for view in cameras]
        fix = indicated_point(fingers, views, time_s=0.0)
        assert fix.status is status
    assert_refused(fix, "standard deviation")


def test_views_that_contradict_each_other_are_refused():
    cameras, pointing = [camera(a) for a in (-25, 5, 30)], rod([120, 260], 20.0, 45.0, 150.0)
    views = [plane_view(view, REFERENCES) for view in cameras]
    fingers = [finger_line(view, pointing, FINE) for view in cameras]
    assert indicated_point(fingers, views, time_s=0.0).status is Status.OK
    fingers[1] = finger_line(cameras[1], pointing, FINE, noise=(20.0, 0.0))
    assert_refused(indicated_point(fingers, views, time_s=0.0), "contradict")


@pytest.mark.parametrize("freedom", [1, 2, 4])
def test_correct_covariances_rarely_contradict(freedom):
    """4 σ is exceeded once in 30,000; of 1,500 noisy fixes a 2 σ gate refuses a few."""
    rng = np.random.default_rng(57)
    cameras = [camera(a) for a in np.linspace(-30, 30, freedom + 2)]
    views = [plane_view(view) for view in cameras]
    pointing = rod([120, 260], 20.0, 45.0, 150.0)
    refused = {2.0: 0, 4.0: 0}
    for _ in range(500):
        fingers = noisy_fingers(rng, cameras, pointing, FINE)
        for nsigma in refused:
            options = PointingOptions(nsigma=nsigma)
            fix = indicated_point(fingers, views, time_s=0.0, options=options)
            refused[nsigma] += fix.status is not Status.OK
    assert refused[4.0] <= 1
    assert 3 <= refused[2.0] <= 25  # 2.3 % one-sided: 11 ± 3


@pytest.mark.parametrize("max_sigma", [0.001, 0.05])
def test_the_limit_is_a_share_of_the_planes_size(max_sigma):
    cameras, pointing = stereo(), rod([120, 260], 20.0, 45.0, 150.0)
    fix = fix_of(cameras, pointing, FINE, REFERENCES, max_sigma=max_sigma)
    sigma = largest_sigma(fix.covariance)
    assert 0.001 * SIDE < sigma < 0.05 * SIDE
    assert fix.status is (Status.OK if max_sigma == 0.05 else Status.ILL_CONDITIONED)


# --- views without a finger line ---------------------------------------------------------------


@pytest.mark.parametrize(
    ("entries", "status", "reason"),
    [
        ("fl", Status.LOST, "view 1 is lost"),
        ("al", Status.LOST, "view 0 is acquiring, view 1 is lost"),
        ("fa", Status.ACQUIRING, "view 1 is acquiring"),
        ("ll", Status.LOST, "view 0 is lost, view 1 is lost"),
        ("fi", Status.ILL_CONDITIONED, "view 1 is ill_conditioned"),
        ("ia", Status.ACQUIRING, "view 0 is ill_conditioned, view 1 is acquiring"),
        ("ffl", Status.OK, "view 2 is lost"),
        ("aff", Status.OK, "view 0 is acquiring"),
        ("fal", Status.LOST, "view 1 is acquiring, view 2 is lost"),
        ("fff", Status.OK, ""),
    ],
)
def test_two_finger_lines_make_a_fix_and_fewer_report_the_worst_view(entries, status, reason):
    cameras, pointing = [camera(a) for a in (-15, 15, 40)], rod([120, 260], 20.0, 45.0, 150.0)
    words = {"a": Status.ACQUIRING, "l": Status.LOST, "i": Status.ILL_CONDITIONED}
    fingers = [
        words.get(letter) or finger_line(view, pointing, FINE, time_s=3.5)
        for letter, view in zip(entries, cameras, strict=False)
    ]
    views = [plane_view(view, REFERENCES) for view in cameras[: len(entries)]]
    fix = indicated_point(fingers, views, time_s=3.5)
    assert (fix.status, fix.reason, fix.time_s) == (status, reason, 3.5)
    assert (fix.point is not None) == (entries.count("f") >= 2)
    assert [line is not None for line in fix.constraint_lines] == [c == "f" for c in entries]
    if fix.point is not None:
        assert np.allclose(fix.point, pointing.target, atol=1e-6)


def test_reasons_name_views_and_why_they_have_no_line():
    cameras, pointing = [camera(a) for a in (-15, 15, 40)], rod([120, 260], 20.0, 45.0, 150.0)
    views = [plane_view(view, REFERENCES) for view in cameras]
    fingers = [finger_line(cameras[0], pointing, FINE), Status.LOST, Status.ACQUIRING]
    names, absences = ["left", "top", "right"], {1: "out of order", 0: "it has a line"}
    fix = indicated_point(fingers, views, time_s=0.0, names=names, absences=absences)
    assert fix.reason == "top: out of order, right is acquiring"
    with pytest.raises(InvalidInputError, match="2 names for 3 plane_views"):
        indicated_point(fingers, views, time_s=0.0, names=names[:2])


# --- time --------------------------------------------------------------------------------------


def moving_finger(view, velocity_mm_s, time_s, covariance=FINE, turn_rad_s=0.0):
    pointing = rod([120, 260], 20.0 + np.degrees(turn_rad_s * time_s), 45.0, 150.0)
    shift = np.array([*velocity_mm_s, 0.0]) * time_s
    moved = dataclasses.replace(pointing, tip=pointing.tip + shift, base=pointing.base + shift)
    return finger_line(view, moved, covariance, time_s)


def test_alignment_compensates_the_skew_between_views():
    """20 ms at 0.5 m/s cost 17 mm; interpolation leaves the curvature of the image path."""
    cameras, velocity, time_s = stereo(), (350.0, 350.0), 0.050
    views = [plane_view(view, REFERENCES) for view in cameras]
    target = np.array([120, 260]) + np.array(velocity) * time_s
    first = moving_finger(cameras[0], velocity, time_s)
    history = [moving_finger(cameras[1], velocity, t) for t in (0.004, 0.0373, 0.0706)]
    aligned = align(history, time_s)
    assert aligned.state is AlignmentState.ALIGNED
    assert aligned.line.time_s == time_s
    fix = indicated_point([first, aligned.line], views, time_s=time_s)
    assert np.hypot(*(fix.point - target)) < 0.2
    skewed = dataclasses.replace(history[1], time_s=time_s)
    unaligned = indicated_point([first, skewed], views, time_s=time_s)
    assert np.hypot(*(unaligned.point - target)) > 5.0


def circling_finger(view, time_s):
    """A finger of constant direction on a circle of radius 80 mm at 0.5 m/s, and its target."""
    pointing, angle = rod([120, 260], 20.0, 45.0, 150.0), 0.5 / 0.08 * time_s
    shift = 80.0 * np.array([np.cos(angle), np.sin(angle), 0.0])
    moved = dataclasses.replace(pointing, tip=pointing.tip + shift, base=pointing.base + shift)
    return finger_line(view, moved, FINE, time_s), np.array([120, 260]) + shift[:2]


@pytest.mark.parametrize("skew_s", [0.004, 0.0167, 0.029])
def test_a_curved_motion_is_interpolated_to_less_than_a_millimetre(skew_s):
    """Mean over the circle: linear interpolation would err by 1.3 mm half way between frames."""
    cameras, errors = stereo(), []
    views = [plane_view(view, REFERENCES) for view in cameras]
    for time_s in np.linspace(0.0, 1.0, 16):
        first, target = circling_finger(cameras[0], time_s)
        times_s = time_s + skew_s + np.array([-2, -1, 0]) / 30
        history = [circling_finger(cameras[1], t)[0] for t in times_s]
        fix = indicated_point([first, align(history, time_s).line], views, time_s=time_s)
        errors.append(np.hypot(*(fix.point - target)))
    assert np.mean(errors) < 0.3


def test_interpolation_is_linear_in_anchor_and_angle_and_carries_the_tip():
    before = FingerLine([100, 100], 0.2, FINE, [140, 110], 1.0, 30.0, 10.0, (-30.0, 30.0))
    after = FingerLine([120, 90], 0.6, FINE, [155, 115], 1.04, 30.0, 14.0, (-26.0, 34.0))
    line = align([before, after], 1.01).line
    assert np.allclose(line.anchor_px, [105, 97.5])
    assert line.half_width_px == pytest.approx(11.0)
    assert line.stretch_px == pytest.approx((-29.0, 31.0))
    assert line.angle_rad == pytest.approx(0.3)
    # A linear motion of the tip itself differs only to second order in the turn.
    assert np.allclose(line.tip_px, [143.75, 111.25], atol=1.0)
    assert np.hypot(*(line.tip_px - line.anchor_px)) == pytest.approx(
        0.75 * np.hypot(40, 10) + 0.25 * np.hypot(35, 25), rel=0.01
    )


def test_interpolation_with_an_earlier_line_reproduces_a_parabola():
    def line(t):
        anchor, angle = np.array([100 + 300 * t, 50 + 2000 * t**2]), 3.0 + 4 * t + 30 * t**2
        angle -= 2 * np.pi * (angle > np.pi)
        return FingerLine(anchor, angle, FINE, anchor + 30 * np.r_[np.cos(angle), np.sin(angle)], t)

    found, expected = align([line(0.0), line(0.03), line(0.07)], 0.05).line, line(0.05)
    assert np.allclose(found.anchor_px, expected.anchor_px)
    assert np.cos(found.angle_rad - expected.angle_rad) == pytest.approx(1.0)
    assert np.allclose(found.tip_px, expected.tip_px)


@pytest.mark.parametrize(
    ("earlier_s", "is_used"), [(0.0, True), (0.025, False), (-0.08, False), (None, False)]
)
def test_an_earlier_line_too_close_or_too_old_is_not_used(earlier_s, is_used):
    pair = [
        FingerLine([0, 0], 0.0, FINE, [30, 0], 0.03),
        FingerLine([6, 0], 0, FINE, [36, 0], 0.06),
    ]
    history = (
        pair if earlier_s is None else [FingerLine([9, 0], 0, FINE, [39, 0], earlier_s), *pair]
    )
    found = align(history, 0.045).line
    assert (found.anchor_px[0] != pytest.approx(3.0)) == is_used
    assert np.all(np.diag(found.covariance) <= np.diag(FINE))


@pytest.mark.parametrize(("first", "second"), [(3.1, -3.1), (-3.1, 3.1), (3.1, 2 * np.pi - 3.1)])
def test_angles_are_interpolated_the_shorter_way_round(first, second):
    lines = [
        FingerLine([0, 0], angle, FINE, [30 * np.cos(angle), 30 * np.sin(angle)], t)
        for angle, t in ((first, 0.0), (second, 0.04))
    ]
    halfway = align(lines, 0.02).line.angle_rad
    assert np.cos(halfway) == pytest.approx(-1.0)


def test_a_line_of_exactly_the_wanted_time_is_returned_unchanged():
    history = [moving_finger(camera(), (100, 0), t) for t in (0.0, 0.04)]
    assert align(history, 0.04).line is history[1]
    assert align(history, 0.0).line is history[0]


@pytest.mark.parametrize(("weight", "count"), [(0.1, 2), (0.5, 3), (0.8, 3)])
def test_the_interpolated_covariance_meets_monte_carlo(weight, count):
    rng = np.random.default_rng(58)
    covariances = np.array([[[0.04, 3e-4], [3e-4, 9e-6]], [[0.01, -1e-4], [-1e-4, 4e-6]]])
    covariances = np.concatenate([covariances[1:] * 2, covariances])[-count:]
    pose = [([90.0, 110.0], 0.0), ([100.0, 100.0], 0.2), ([130.0, 80.0], 0.9)][-count:]

    def lines(noise):
        for (anchor, angle), covariance, (offset, turn), t in zip(
            pose, covariances, noise, (-0.04, 0.0, 0.04)[-count:], strict=True
        ):
            normal = np.array([-np.sin(angle), np.cos(angle)])
            tip = anchor + 40 * np.array([np.cos(angle), np.sin(angle)])
            yield FingerLine(anchor + offset * normal, angle + turn, covariance, tip, t)

    mean = align(list(lines(np.zeros((count, 2)))), 0.04 * weight).line
    normal = np.array([-np.sin(mean.angle_rad), np.cos(mean.angle_rad)])
    noise = np.stack([rng.multivariate_normal([0, 0], c, 6000) for c in covariances], axis=1)
    sampled = []
    for each in noise:
        line = align(list(lines(each)), 0.04 * weight).line
        sampled.append(
            [(line.anchor_px - mean.anchor_px) @ normal, line.angle_rad - mean.angle_rad]
        )
    sigma = np.sqrt(np.diag(mean.covariance))
    assert np.all(np.abs(covariance_of(sampled) - mean.covariance) <= 0.05 * np.outer(sigma, sigma))


def history_at(*times):
    return [moving_finger(camera(), (100, 0), t) for t in times]


@pytest.mark.parametrize(
    ("times", "time_s", "state", "words"),
    [
        ((), 1.0, AlignmentState.WAIT, "no finger line yet"),
        ((0.96,), 1.0, AlignmentState.WAIT, "0.04 s old"),
        ((0.9, 0.96), 1.0, AlignmentState.WAIT, "0.04 s old"),
        ((0.7,), 1.0, AlignmentState.LATE, "0.3 s old"),
        ((1.02, 1.04), 1.0, AlignmentState.GAP, "0.02 s later"),
        ((0.9, 1.06), 1.0, AlignmentState.GAP, "no finger line for 0.16 s"),
    ],
)
def test_failed_alignment_states_the_reason(times, time_s, state, words):
    aligned = align(history_at(*times), time_s)
    assert aligned.state is state
    assert aligned.line is None
    assert words in aligned.reason


def test_the_limits_of_alignment_are_options():
    wide = PointingOptions(max_gap_s=0.2, max_wait_s=0.4)
    assert align(history_at(0.9, 1.06), 1.0, wide).state is AlignmentState.ALIGNED
    assert align(history_at(0.7), 1.0, wide).state is AlignmentState.WAIT


def test_a_finger_that_turns_round_between_two_frames_is_not_interpolated():
    turned = FingerLine([0, 0], 2.5, FINE, 30 * np.array([np.cos(2.5), np.sin(2.5)]), 0.04)
    aligned = align([FingerLine([0, 0], 0.0, FINE, [30, 0], 0.0), turned], 0.02)
    assert aligned.state is AlignmentState.GAP
    assert "turns by 2.5 rad" in aligned.reason


@pytest.mark.parametrize("times", [(0.0, 0.0), (0.1, 0.0)])
def test_times_that_do_not_increase_are_refused(times):
    with pytest.raises(InvalidInputError, match="times are to increase"):
        align(history_at(*times), 0.0)


# --- the view and its lens ---------------------------------------------------------------------

BARREL = Lens(622.0, 622.0, 319.5, 239.5, -0.2)


def webcam_view(view, lens, covariances_px2=None, known_lens=None):
    references = lens.distort(references_of(view))
    return PlaneView.from_reference_points(CORNERS, references, covariances_px2, known_lens)


def webcam_finger(view, lens, pointing):
    ends = view.project(np.stack([pointing.base, pointing.tip]))
    samples = lens.distort(np.linspace(*ends, 41))
    anchor = samples.mean(axis=0)
    tangent = np.linalg.svd(samples - anchor)[2][0]
    tangent *= np.sign(tangent @ (samples[-1] - samples[0]))
    angle = np.arctan2(tangent[1], tangent[0])
    return FingerLine(anchor, angle, FINE, samples[-1], 0.0, half_width_px=9.0)


def test_undistortion_keeps_the_other_fields_of_a_finger_line():
    view = camera(15.0, distance_mm=750.0, focal_px=622.0)
    finger = webcam_finger(view, BARREL, rod([120, 260], 20.0, 45.0, 150.0))
    seen = webcam_view(view, BARREL, None, BARREL).through_pinhole(finger)
    assert (seen.time_s, seen.half_length_px) == (finger.time_s, finger.half_length_px)
    assert seen.half_width_px == 9.0
    assert abs(seen.angle_rad - finger.angle_rad) > 1e-4


def test_a_line_is_undistorted_over_its_own_stretch():
    view = camera(15.0, distance_mm=750.0, focal_px=622.0)
    finger = webcam_finger(view, BARREL, rod([120, 260], 20.0, 45.0, 150.0))
    through = webcam_view(view, BARREL, None, BARREL).through_pinhole
    # Anchored 10 px farther back, it is the same line over the same stretch.
    back = finger.anchor_px - 10.0 * np.array([np.cos(finger.angle_rad), np.sin(finger.angle_rad)])
    half_px = finger.half_length_px
    farther_back = dataclasses.replace(
        finger, anchor_px=back, stretch_px=(10.0 - half_px, 10.0 + half_px)
    )
    expected, same = through(finger), through(farther_back)
    assert same.angle_rad == pytest.approx(expected.angle_rad, abs=1e-12)
    assert np.allclose(same.anchor_px, expected.anchor_px, atol=1e-9)
    # Without its stretch, another part of the distorted curve would be undistorted.
    astray = through(dataclasses.replace(farther_back, stretch_px=(0.0, 0.0)))
    assert abs(astray.angle_rad - expected.angle_rad) > 1e-4


def test_a_known_lens_is_corrected_in_references_and_finger_lines():
    rng = np.random.default_rng(59)
    cameras = [camera(a, distance_mm=750.0, focal_px=622.0) for a in (-15.0, 15.0)]
    corrected = [webcam_view(view, BARREL, None, BARREL) for view in cameras]
    ignored = [webcam_view(view, BARREL) for view in cameras]
    errors = []
    while len(errors) < 100:
        pointing = seen_rod(rng, cameras)
        ends = np.concatenate(
            [view.project(np.stack([pointing.base, pointing.tip])) for view in cameras]
        )
        if np.any(ends < 0) or np.any(ends > [639, 479]):
            continue
        fingers = [webcam_finger(view, BARREL, pointing) for view in cameras]
        fixes = [indicated_point(fingers, views, time_s=0.0) for views in (corrected, ignored)]
        errors.append([np.hypot(*(fix.point - pointing.target)) for fix in fixes])
    rms = np.sqrt(np.mean(np.square(errors), axis=0))
    assert rms[0] <= 0.02
    assert rms[1] >= 2.0


def test_undistortion_transforms_reference_covariances():
    view = webcam_view(camera(focal_px=622.0, distance_mm=750.0), BARREL, REFERENCES, BARREL)
    shown = BARREL.distort(transfer_to_image(view.image_from_plane, CORNERS))
    turned = []
    for point in shown:
        J = central_differences(BARREL.undistort, point, [600.0, 600.0])
        turned.append(J @ REFERENCES @ J.T)
    expected = homography_covariance(view.image_from_plane, CORNERS, turned)
    assert np.allclose(view.entries_covariance, expected, rtol=1e-5)


@pytest.mark.parametrize("lens", [None, BARREL], ids=["pinhole", "lens"])
def test_projection_and_back_projection_are_inverse(lens):
    image = references_of(camera())
    shown = image if lens is None else lens.distort(image)
    view = PlaneView.from_reference_points(CORNERS, shown, REFERENCES, lens)
    assert np.allclose(view.project(CORNERS), shown, atol=1e-9)
    assert np.allclose(view.back_project(shown), CORNERS, atol=1e-8)
    assert view.project(np.zeros((5, 3, 2))).shape == (5, 3, 2)
    assert np.isnan(view.project([200.0, -1e5])).all()
    above = [[319.5, -1e4], [319.5, 239.5]]
    assert np.isnan(view.back_project(above)).tolist() == [[True, True], [False, False]]


def test_references_where_the_lens_folds_back_are_named():
    shown = np.array([[100, 100], [500, 100], [500, 400], [2000.0, 400]])
    with pytest.raises(DegenerateReferencePointsError, match=r"image_points_px\[3\].*folds back"):
        PlaneView.from_reference_points(CORNERS, shown, None, BARREL)


def test_a_finger_line_where_the_lens_folds_back_is_ill_conditioned():
    cameras, pointing = stereo(), rod([120, 260], 20.0, 45.0, 150.0)
    views = [plane_view(cameras[0]), webcam_view(cameras[1], BARREL, None, BARREL)]
    astray = FingerLine([2000, 100], 0.0, FINE, [2040, 100], 0.0)
    fix = indicated_point([finger_line(cameras[0], pointing), astray], views, time_s=0.0)
    assert (fix.status, fix.reason) == (Status.ILL_CONDITIONED, "view 1 is ill_conditioned")


@pytest.mark.parametrize(
    ("points", "size"),
    [
        (CORNERS, 400.0),
        (np.array([[x, y] for x in (0, 200, 400) for y in (0, 200, 400)]), 400.0),
        (CORNERS * [0.6, 0.8] * np.sqrt(2), 400.0),
    ],
)
def test_the_planes_size_is_the_side_of_a_square_with_its_diameter(points, size):
    assert plane_view(camera(), None, points).plane_size == pytest.approx(size)


# --- bad input ---------------------------------------------------------------------------------

GOOD = {
    "anchor_px": [100.0, 100.0],
    "angle_rad": 0.5,
    "covariance": FINE,
    "tip_px": [130.0, 115.0],
    "time_s": 0.0,
}


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"anchor_px": [1.0]}, r"anchor_px: shape \(1,\)"),
        ({"anchor_px": [1.0, np.nan]}, r"anchor_px\[1\] is nan"),
        ({"angle_rad": np.inf}, "angle_rad is inf"),
        ({"angle_rad": None}, "angle_rad: None"),
        ({"covariance": np.eye(3)}, r"covariance: shape \(3, 3\)"),
        ({"covariance": [[1, 2], [2, 1]]}, "negative eigenvalue"),
        ({"tip_px": [70.0, 80.0]}, "behind anchor_px"),
        ({"tip_px": [100.0, 100.0]}, "behind anchor_px"),
        ({"time_s": np.nan}, "time_s is nan"),
        ({"half_length_px": -1.0}, "half_length_px is -1"),
        ({"half_width_px": -1.0}, "half_width_px is -1"),
        ({"stretch_px": (5.0, -5.0)}, "stretch_px begins at 5 px and ends at -5 px"),
        ({"stretch_px": (1.0, np.nan)}, r"stretch_px\[1\] is nan"),
        ({"stretch_px": 5.0}, r"stretch_px: shape \(\)"),
    ],
)
def test_bad_finger_lines_are_refused(values, words):
    with pytest.raises(InvalidInputError, match=words):
        FingerLine(**GOOD | values)


def test_a_finger_line_accepts_lists_and_stores_arrays():
    finger = FingerLine(**GOOD)
    assert finger.anchor_px.dtype == np.float64
    assert finger.half_length_px == pytest.approx(30 * np.cos(0.5) + 15 * np.sin(0.5))
    assert finger.stretch_px == (-finger.half_length_px, finger.half_length_px)
    with pytest.raises(dataclasses.FrozenInstanceError):
        finger.time_s = 1.0


@pytest.mark.parametrize(
    "values",
    [
        {"max_sigma": 0.0},
        {"max_sigma": np.nan},
        {"nsigma": -1.0},
        {"bias_offset_px": -0.1},
        {"bias_angle_rad": np.nan},
        {"tip_sigma_px": -1.0},
        {"max_skew_s": -1e-3},
        {"max_gap_s": 0.0},
        {"max_wait_s": "1"},
    ],
)
def test_bad_options_are_refused_by_name(values):
    with pytest.raises(InvalidInputError, match=next(iter(values))):
        PointingOptions(**values)


FINGER = FingerLine(**GOOD)
VIEW = plane_view(camera())


@pytest.mark.parametrize(
    ("fingers", "views", "words"),
    [
        ([FINGER], [VIEW], "1 plane_views; pointing needs two or more"),
        ([], [], "0 plane_views"),
        ([FINGER], [VIEW, VIEW], "1 finger_lines for 2 plane_views"),
        ([FINGER, None], [VIEW, VIEW], r"finger_lines\[1\] is None"),
        ([FINGER, Status.OK], [VIEW, VIEW], r"finger_lines\[1\] is <Status.OK"),
        ([FINGER, "lost"], [VIEW, VIEW], r"finger_lines\[1\] is 'lost'"),
        (
            [FINGER, dataclasses.replace(FINGER, time_s=0.02)],
            [VIEW, VIEW],
            r"finger_lines\[1\] is \+0.02 s off the fix",
        ),
    ],
)
def test_unmatched_input_is_refused(fingers, views, words):
    with pytest.raises(InvalidInputError, match=words):
        indicated_point(fingers, views, time_s=0.0)


@pytest.mark.parametrize(
    "covariances", [np.zeros((2, 2)), -np.eye(2), np.eye(3), [[np.nan] * 2] * 2]
)
def test_bad_reference_covariances_are_refused(covariances):
    image = references_of(camera())
    with pytest.raises(InvalidInputError, match="covariances_px2"):
        PlaneView.from_reference_points(CORNERS, image, covariances)


pixels = st.floats(-1e3, 2e3)


@settings(max_examples=400, derandomize=True)
@given(
    st.lists(
        st.tuples(pixels, pixels, st.floats(-4, 4), st.floats(0.1, 200), st.floats(-12, 4)),
        min_size=2,
        max_size=4,
    ),
    st.booleans(),
)
@example([(0, 1061, 0.0625, 1, -3), (0, 0, 0, 1, 0), (0, 1104, 0, 1, -2)], False)
def test_any_finger_lines_give_a_fix_or_a_reason(entries, bent):
    """Any tracker output, however absurd: no exception, no warning, no NaN as a point."""
    lens = Lens(1692.0, 1692.0, 319.5, 239.5, -0.3)
    fingers = [
        FingerLine(
            [u, v],
            angle,
            10.0**magnitude * np.eye(2),
            [u + length * np.cos(angle), v + length * np.sin(angle)],
            0.0,
        )
        for u, v, angle, length, magnitude in entries
    ]
    views = [
        webcam_view(camera(15.0 * k), lens, REFERENCES, lens)
        if bent
        else plane_view(camera(15.0 * k), REFERENCES)
        for k in range(len(entries))
    ]
    fix = indicated_point(fingers, views, time_s=0.0)
    if fix.status is Status.OK:
        assert np.isfinite(fix.point).all()
        assert largest_sigma(fix.covariance) <= DEFAULT_OPTIONS.max_sigma * SIDE
        assert fix.ellipse().contains(fix.point)
    else:
        assert fix.status is Status.ILL_CONDITIONED
        assert fix.point is None
        assert fix.reason
        assert fix.covariance is None or not np.isnan(fix.covariance).any()
