"""The simulated rig, compared with independent geometry and with its documentation."""

import dataclasses
import doctest
import math
import tomllib
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.ndimage import map_coordinates
from scipy.optimize import least_squares
from scipy.special import ndtr
from scipy.stats import kurtosis

import fingerpost.simulate.rig
from fingerpost.errors import InvalidInputError
from fingerpost.simulate import (
    Background,
    Body,
    Camera,
    DevicePose,
    Hand,
    LightChange,
    Lighting,
    Link,
    Material,
    Occluder,
    Placement,
    PoseLimits,
    PoseSampler,
    RodAndProng,
    Sensor,
    SimulatedRig,
    StartError,
    Trajectory,
    Workspace,
    figure_eight,
    pointing_session,
    write_recording,
)
from fingerpost.simulate.coverage import polygon_coverage
from fingerpost.simulate.occlusion import visible_contour
from fingerpost.simulate.outline import ARC_STEPS, NEAR_MM, link_outlines, seen_links

# Tolerated error of an edge in a noise-free picture, and its angle over half a flank of 60 px.
EDGE_TOLERANCE_PX = 0.002
EDGE_TOLERANCE_RAD = EDGE_TOLERANCE_PX / 30

CLEAN = Sensor(noise=0)
ROD = RodAndProng(prong_length_mm=0)
POSE = DevicePose.pointing_at((170.0, 210.0), hover_mm=110, azimuth_deg=35, slant_deg=40)


def seeded(name: str) -> np.random.Generator:
    return np.random.default_rng(list(name.encode()))


# --- cameras -------------------------------------------------------------------------------------


def test_the_papers_rig() -> None:
    workspace = Workspace()
    cameras = Placement().cameras(workspace)
    assert [camera.name for camera in cameras] == ["left", "right"]
    # f follows from a workspace of 400 mm seen over 65 % of 640 px from 2 m.
    assert cameras[0].f_px == pytest.approx(1692, abs=5)
    middle = np.array([200.0, 200.0, 0.0])
    offsets = [camera.centre_mm - middle for camera in cameras]
    for camera, offset in zip(cameras, offsets, strict=True):
        assert np.linalg.norm(offset) == pytest.approx(2000)
        assert math.degrees(math.asin(offset[2] / 2000)) == pytest.approx(42)
        np.testing.assert_allclose(camera.project(middle), [319.5, 239.5], atol=1e-9)
        corners = camera.project(np.pad(workspace.points_mm, ((0, 0), (0, 1))))
        assert np.ptp(corners[:, 0]) == pytest.approx(0.65 * 640)
    level = [offset[:2] / np.linalg.norm(offset[:2]) for offset in offsets]
    assert math.degrees(math.acos(level[0] @ level[1])) == pytest.approx(30)
    assert offsets[0][0] < 0 < offsets[1][0]


def test_webcams_are_close_to_the_plane() -> None:
    camera, _ = Placement.webcams().cameras(Workspace())
    assert camera.f_px == 622
    assert np.linalg.norm(camera.centre_mm - [200, 200, 0]) == pytest.approx(750)


@pytest.mark.parametrize("k1", [-0.3, -0.1, 0.0, 0.2])
def test_projection_through_the_lens_agrees_with_opencv(k1: float) -> None:
    camera = Placement(distance_m=0.75, f_px=622.0, k1=(k1,)).cameras(Workspace())[0]
    rng = seeded(f"lens{k1}")
    points = rng.uniform((-100, -100, 0), (500, 500, 250), (200, 3))
    rotation, _ = cv2.Rodrigues(camera.camera_from_world[:, :3])
    expected, _ = cv2.projectPoints(
        points,
        rotation,
        camera.camera_from_world[:, 3],
        camera.image_from_camera,
        np.array([k1, 0.0, 0.0, 0.0]),
    )
    np.testing.assert_allclose(
        camera.pictured(camera.project(points)), expected.reshape(-1, 2), atol=1e-8
    )


@given(
    k1=st.floats(-0.3, 0.5),
    u=st.floats(-20, 660),
    v=st.floats(-20, 500),
)
def test_ideal_inverts_pictured(k1: float, u: float, v: float) -> None:
    camera = Placement(distance_m=0.75, f_px=622.0, k1=(k1,)).cameras(Workspace())[0]
    np.testing.assert_allclose(camera.pictured(camera.ideal((u, v))), (u, v), atol=1e-9)


def test_a_barrel_lens_does_not_fold_far_points_into_the_image() -> None:
    camera = Placement(distance_m=0.75, f_px=622.0, k1=(-0.3,)).cameras(Workspace())[0]
    far = camera.principal_point_px + np.linspace(0, 5000, 500)[:, None] * (1.0, 0.5)
    radius = np.linalg.norm(camera.pictured_everywhere(far) - camera.principal_point_px, axis=1)
    assert (np.diff(radius) > 0).all()
    np.testing.assert_allclose(camera.ideal_everywhere(camera.pictured_everywhere(far)), far)
    assert np.isnan(camera.pictured(far[-1])).all()


def test_plane_homography_is_the_projection_of_the_plane() -> None:
    rng = seeded("homography")
    for camera in Placement().cameras(Workspace()):
        X = rng.uniform(-100, 500, (20, 2))
        y = np.pad(X, ((0, 0), (0, 1)), constant_values=1) @ camera.image_from_plane.T
        np.testing.assert_allclose(
            y[:, :2] / y[:, 2:], camera.project(np.pad(X, ((0, 0), (0, 1)))), atol=1e-9
        )
        assert camera.image_from_plane[2, 2] == 1


def test_points_behind_the_camera_have_no_pixel() -> None:
    camera = Placement().cameras(Workspace())[0]
    behind = camera.centre_mm + (camera.centre_mm - [200, 200, 0])
    assert np.isnan(camera.project(behind)).all()


@pytest.mark.parametrize("per_side", [2, 3, 5])
def test_workspace_points_start_with_the_corners(per_side: int) -> None:
    points = Workspace(side_mm=300, points_per_side=per_side).points_mm
    assert points[:4].tolist() == [[0, 0], [300, 0], [300, 300], [0, 300]]
    assert len(np.unique(points, axis=0)) == per_side**2


# --- outlines ------------------------------------------------------------------------------------

links = st.tuples(
    st.floats(-400, 400),
    st.floats(-300, 300),
    st.floats(600, 2500),
    st.floats(-150, 150),
    st.floats(-150, 150),
    st.floats(-150, 150),
    st.floats(3, 60),
    st.floats(3, 60),
)


@given(links)
@settings(max_examples=80)
def test_outline_touches_the_swept_sphere_everywhere(link: tuple[float, ...]) -> None:
    x, y, z, dx, dy, dz, r0, r1 = link
    spheres = np.array([[[x, y, z, r0]], [[x + dx, y + dy, z + dz, r1]]])
    points = link_outlines(spheres).points[0]
    rays = points / np.linalg.norm(points, axis=1, keepdims=True)
    # Independent of the construction: the gap between a ray and the nearest sphere of the sweep.
    part = np.linspace(0, 1, 2001)[:, None]
    sweep = spheres[0] + part * (spheres[1] - spheres[0])
    along = rays @ sweep[:, :3].T
    passing = np.sqrt(np.maximum((sweep[:, :3] ** 2).sum(1) - along**2, 0)) - sweep[:, 3]
    gap = passing.min(axis=1)
    # Vertices inside an arc lie outside the sphere by up to radius·(π / ARC_STEPS)²/6.
    assert gap.min() > -1e-4
    assert gap.max() < max(r0, r1) * (2 * np.pi / ARC_STEPS) ** 2 / 6 + 1e-4


@given(links)
@settings(max_examples=80)
def test_the_axis_plane_bisects_the_tangent_planes(link: tuple[float, ...]) -> None:
    x, y, z, dx, dy, dz, r0, r1 = link
    spheres = np.array([[[x, y, z, r0]], [[x + dx, y + dy, z + dz, r1]]])
    outline = link_outlines(spheres)
    centres = spheres[:, 0, :3]
    axis_normal = np.cross(centres[0], centres[1])
    if outline.end_on[0] or np.linalg.norm(axis_normal) < 1e-3 * z:
        return
    axis_normal /= np.linalg.norm(axis_normal)
    normals = np.cross(outline.flanks[0, :, 0], outline.flanks[0, :, 1])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    if lengths.min() < z:  # flanks shorter than a millimetre
        return
    normals /= lengths
    sines = normals @ centres.T
    # Each flank's plane touches both spheres, on opposite sides of the axis …
    np.testing.assert_allclose(np.abs(sines), [[r0, r1]] * 2, atol=1e-6)
    assert (sines[0] * sines[1] < 0).all()
    # … and the axis plane makes the same angle with both.
    cosines = normals @ axis_normal
    assert abs(cosines[0]) == pytest.approx(abs(cosines[1]), abs=1e-9)
    # The apex lies in the axis plane, on the surface of the end sphere's tangent cone.
    apex = outline.apex[0]
    assert abs(apex @ axis_normal) < 1e-9 * np.linalg.norm(apex)


@pytest.mark.parametrize("nearer_end", [0, 1])
def test_seen_end_on_the_outline_is_one_circle(nearer_end: int) -> None:
    spheres = np.array([[[0.0, 0.0, 1000.0, 5.0]], [[0.0, 0.0, 900.0, 8.0]]])
    if nearer_end == 0:
        spheres = spheres[::-1]
    outline = link_outlines(spheres)
    assert outline.end_on[0]
    sine = np.linalg.norm(outline.points[0, :, :2], axis=1) / np.linalg.norm(
        outline.points[0], axis=1
    )
    np.testing.assert_allclose(sine, 8 / 900, rtol=2e-3)


def test_a_link_that_passes_the_camera_is_cut() -> None:
    camera = Placement().cameras(Workspace())[0]
    ahead = camera.centre_mm + 500 * camera.camera_from_world[2, :3]
    behind = camera.centre_mm - 300 * camera.camera_from_world[2, :3]
    links = np.array([[[*ahead, 20.0], [*behind, 9.0]], [[*behind, 40.0], [*behind, 9.0]]])
    seen, kept = seen_links(camera, links)
    assert kept.tolist() == [True, False]
    assert seen[0, 0, 2] == pytest.approx(500)
    assert seen[1, 0, 2] - seen[1, 0, 3] == pytest.approx(NEAR_MM)
    assert 20 < seen[1, 0, 3] < 40


# --- coverage ------------------------------------------------------------------------------------


def clipped_area(polygon: np.ndarray, column: int, row: int) -> float:
    """Area of a polygon inside one cell, by Sutherland and Hodgman's clipping."""
    points = [tuple(p) for p in polygon]
    for axis, bound, sign in ((0, column, 1), (0, column + 1, -1), (1, row, 1), (1, row + 1, -1)):
        clipped = []
        for i, b in enumerate(points):
            a = points[i - 1]
            inside_a, inside_b = (sign * (p[axis] - bound) >= 0 for p in (a, b))
            if inside_a != inside_b:
                t = (bound - a[axis]) / (b[axis] - a[axis])
                clipped.append((a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1])))
            if inside_b:
                clipped.append(b)
        points = clipped
        if not points:
            return 0.0
    x, y = np.array(points).T
    return abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1))) / 2


coordinates = st.one_of(st.floats(-4, 9), st.integers(-4, 9).map(float))


@given(
    st.lists(st.tuples(coordinates, coordinates), min_size=3, max_size=3),
    st.lists(st.tuples(coordinates, coordinates), min_size=3, max_size=3),
)
@example([(0.0, 0.0)] * 3, [(0.0, 0.0), (0.0, 0.0), (1.0, 2.2e-311)])
@settings(max_examples=80)
def test_coverage_is_the_area_in_every_cell(
    one: list[tuple[float, float]], other: list[tuple[float, float]]
) -> None:
    polygons = np.array([one, other])
    for polygon, patch in zip(polygons, polygon_coverage(polygons, 5, 6), strict=True):
        coverage = np.zeros((5, 6))
        if patch is not None:
            coverage[patch.place] = patch.coverage
        expected = [[clipped_area(polygon, j, i) for j in range(6)] for i in range(5)]
        np.testing.assert_allclose(coverage, expected, atol=1e-6)


# --- poses and devices ---------------------------------------------------------------------------


@given(
    st.floats(-180, 180),
    st.floats(-89, 89),
    st.floats(-180, 180),
)
def test_pose_frame_is_a_rotation_with_the_thumb_up(
    azimuth: float, slant: float, roll: float
) -> None:
    pose = DevicePose((1.0, 2.0, 3.0), azimuth, slant, roll)
    R = pose.world_from_device[:, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1)
    np.testing.assert_allclose(R[:, 0], pose.direction)
    assert pose.direction[2] == pytest.approx(-math.sin(math.radians(slant)))
    # At roll 0 the thumb has no sideways part and points up; roll turns it about the finger.
    upright = dataclasses.replace(pose, roll_deg=0.0).world_from_device[:, :3]
    assert upright[2, 2] > 0
    assert upright[2, 1] == pytest.approx(0, abs=1e-12)
    turn = upright.T @ R
    angle, axis = math.radians(roll), np.array([1.0, 0.0, 0.0])
    np.testing.assert_allclose(turn, cv2.Rodrigues(angle * axis)[0], atol=1e-12)


def test_azimuth_0_points_towards_the_cameras_side() -> None:
    np.testing.assert_allclose(DevicePose((0, 0, 0), 0, 0).direction, [0, -1, 0], atol=1e-12)
    np.testing.assert_allclose(DevicePose((0, 0, 0), 90, 0).direction, [1, 0, 0], atol=1e-12)


def test_pointing_at_meets_the_target() -> None:
    pose = DevicePose.pointing_at((31, 57), hover_mm=140, azimuth_deg=70, slant_deg=30, roll_deg=9)
    assert pose.tip_mm[2] == pytest.approx(140)
    np.testing.assert_allclose(pose.indicated_mm, (31, 57))
    along = np.array([31, 57, 0]) - pose.tip_mm
    np.testing.assert_allclose(along / np.linalg.norm(along), pose.direction)
    np.testing.assert_allclose(pose.retreated(200).indicated_mm, (31, 57))
    assert pose.retreated(200).tip_mm[2] > 140


@pytest.mark.parametrize("slant", [0.0, -20.0])
def test_a_finger_that_does_not_point_down_indicates_nothing(slant: float) -> None:
    assert DevicePose((0, 0, 100), 0, slant).indicated_mm is None
    assert SimulatedRig().truth(DevicePose((200, 200, 100), 0, slant)).indicated_mm is None


@pytest.mark.parametrize(
    "device",
    [ROD, RodAndProng(taper=0.3), Hand(), Hand(side="left"), Hand(bend_deg=40, taper=0.1)],
)
def test_devices_have_their_tip_at_the_origin_and_point_along_x(device: RodAndProng | Hand) -> None:
    finger = device.body.links[device.body.finger]
    np.testing.assert_allclose(finger.end_mm, (-finger.end_radius_mm, 0, 0), atol=1e-12)
    np.testing.assert_allclose(finger.start_mm[1:], (0, 0), atol=1e-12)
    assert finger.start_mm[0] < -20


def test_rod_has_the_size_it_is_given() -> None:
    device = RodAndProng(length_mm=75, diameter_mm=16, taper=0.1, prong_angle_deg=70)
    rod, prong = device.body.links
    assert (rod.start_radius_mm, rod.end_radius_mm) == pytest.approx((8.0, 7.2))
    assert rod.start_mm[0] == -75
    along = np.subtract(prong.end_mm, prong.start_mm)
    assert np.linalg.norm(along) + prong.end_radius_mm == pytest.approx(55)
    assert math.degrees(math.atan2(along[2], along[0])) == pytest.approx(70)


def test_a_left_hand_is_the_mirror_image_of_a_right_hand() -> None:
    rig = SimulatedRig(Placement(azimuths_deg=(0.0,)), sensor=CLEAN)
    pose = DevicePose.pointing_at((200, 180), hover_mm=90)
    right, left = (
        rig.render(pose, device=Hand(side=side, sleeve=True), quantise=False).images[0]
        for side in ("right", "left")
    )
    np.testing.assert_allclose(left, right[:, ::-1], atol=2e-3)
    assert np.abs(left - right).max() > 50


def test_bent_finger_points_where_its_last_part_points() -> None:
    straight, bent = Hand().body, Hand(bend_deg=30).body
    assert len(bent.links) == len(straight.links) + 1
    base, middle = bent.links[0], next(link for link in bent.links if link.end_mm[0] < -40)
    assert base.start_mm[1] == pytest.approx(0, abs=1e-12)
    assert middle is not base
    knuckle = np.subtract(base.start_mm, bent.root_mm)
    cosine = knuckle[0] / np.linalg.norm(knuckle)
    assert math.degrees(math.acos(cosine)) == pytest.approx(30)


# --- truth ---------------------------------------------------------------------------------------


def back_projected(camera: Camera, line: np.ndarray) -> np.ndarray:
    """Plane through the camera and an image line, in the world."""
    plane = camera.image_from_world.T @ line
    return plane / np.linalg.norm(plane[:3])


def line_of(point: np.ndarray, angle: float) -> np.ndarray:
    normal = np.array([-math.sin(angle), math.cos(angle)])
    return np.append(normal, -normal @ point)


@pytest.mark.parametrize("k1", [0.0, -0.2])
def test_axis_lines_of_two_views_meet_at_the_indicated_point(k1: float) -> None:
    rig = SimulatedRig(Placement(k1=(k1,)))
    sampler, rng = PoseSampler(rig), seeded("axis lines")
    for _ in range(50):
        truth = rig.truth(sampler.draw(rng))
        planes = [
            back_projected(camera, line_of(view.finger.axis_point_px, view.finger.axis_angle_rad))
            for camera, view in zip(rig.cameras, truth.views, strict=True)
        ]
        # The two planes and the table intersect in one point; poses are not used.
        point = np.linalg.solve(
            np.stack([*[plane[:3] for plane in planes], [0, 0, 1]]),
            [-planes[0][3], -planes[1][3], 0],
        )
        np.testing.assert_allclose(point[:2], truth.indicated_mm, atol=1e-6)
        for camera, view in zip(rig.cameras, truth.views, strict=True):
            expected = cv2.perspectiveTransform(
                truth.indicated_mm.reshape(1, 1, 2), view.image_from_plane
            )
            np.testing.assert_allclose(view.indicated_px, expected.ravel(), atol=1e-9)
            np.testing.assert_allclose(
                view.reference_points_pictured_px, camera.pictured(view.reference_points_px)
            )


def test_axis_is_midway_between_the_flanks() -> None:
    rng = seeded("flanks")
    for taper in (0.0, 0.3):
        rig = SimulatedRig(device=RodAndProng(taper=taper))
        sampler = PoseSampler(rig)
        for _ in range(30):
            for camera, view in zip(rig.cameras, rig.truth(sampler.draw(rng)).views, strict=True):
                finger = view.finger
                normals = []
                for (u0, v0), (u1, v1) in finger.flanks_px:
                    normal = back_projected(camera, np.cross((u0, v0, 1), (u1, v1, 1)))[:3]
                    normals.append(normal)
                # Both flanks run from base to tip, so the bisector is the sum of their normals.
                bisector = normals[0] + normals[1]
                axis = back_projected(camera, line_of(finger.axis_point_px, finger.axis_angle_rad))[
                    :3
                ]
                sine = np.linalg.norm(np.cross(bisector / np.linalg.norm(bisector), axis))
                assert sine < 1e-11
                # In the image of a long lens it is nearly the bisector of the two lines.
                directions = np.diff(finger.flanks_px, axis=1)[:, 0]
                directions /= np.linalg.norm(directions, axis=1, keepdims=True)
                middle = math.atan2(*directions.sum(axis=0)[::-1])
                assert middle == pytest.approx(finger.axis_angle_rad, abs=2e-5)
                left, right = finger.flanks_px
                along = [math.cos(middle), math.sin(middle)]
                across = (right - left) @ [-along[1], along[0]]
                assert (across > 0).all()


@pytest.mark.parametrize("device", [RodAndProng(), Hand(), Hand(side="left")])
def test_thumb_side_is_that_of_the_picture(device: RodAndProng | Hand) -> None:
    rig = SimulatedRig(device=device, sensor=CLEAN)
    if isinstance(device, RodAndProng):
        without = dataclasses.replace(device, prong_length_mm=0)
    else:
        without = dataclasses.replace(device, thumb="folded")
    sampler, rng = PoseSampler(rig, PoseLimits(roll_deg=(-40, 40))), seeded("thumb")
    compared = 0
    for _ in range(6):
        pose = sampler.draw(rng)
        shown = rig.render(pose, quantise=False)
        bare = rig.render(pose, quantise=False, device=without)
        for image, other, view in zip(shown.images, bare.images, shown.truth.views, strict=True):
            v, u = np.nonzero(image - other > 40)
            finger = view.finger
            line = line_of(finger.axis_point_px, finger.axis_angle_rad)
            offset = line[0] * u + line[1] * v + line[2]
            if len(u) < 60 or abs(offset.mean()) < 10:
                continue  # the thumb is in front of or behind something else
            assert finger.thumb == ("right" if offset.mean() > 0 else "left")
            compared += 1
    assert compared >= 4


def test_without_a_thumb_there_is_no_side() -> None:
    rig = SimulatedRig()
    for device in (ROD, Hand(thumb="folded")):
        assert rig.truth(POSE, device=device).views[0].finger.thumb == "none"


def test_apex_and_length_match_the_picture() -> None:
    rig = SimulatedRig(device=ROD, sensor=Sensor(noise=0, blur_px=0))
    frame = rig.render(POSE, quantise=False)
    for image, view in zip(frame.images, frame.truth.views, strict=True):
        finger = view.finger
        v, u = np.nonzero(image - 70 > 40)
        e = np.array([math.cos(finger.axis_angle_rad), math.sin(finger.axis_angle_rad)])
        along = np.stack([u, v], -1) @ e
        assert along.max() == pytest.approx(finger.apex_px @ e, abs=0.6)
        # The rod's base is a sphere, which reaches half its width beyond the finger's start.
        radius_px = np.linalg.norm(finger.flanks_px[1, 0] - finger.flanks_px[0, 0]) / 2
        assert np.ptp(along) == pytest.approx(finger.length_px + radius_px, abs=1.5)


def test_time_skew_shows_each_view_at_its_own_time() -> None:
    rig = SimulatedRig(Placement(time_skews_s=(0.0, 0.02)), sensor=CLEAN, device=ROD)
    ends = [POSE, DevicePose.pointing_at((300, 210), hover_mm=110, azimuth_deg=35, slant_deg=40)]
    path = Trajectory.through(ends, 0.3)
    frame = rig.render(path, time_s=0.2)
    assert [view.time_s for view in frame.truth.views] == pytest.approx([0.2, 0.22])
    np.testing.assert_array_equal(frame.images[1], rig.render(path.pose_at(0.22)).images[1])
    np.testing.assert_array_equal(frame.images[0], rig.render(path.pose_at(0.2)).images[0])
    still = [rig.truth(path.pose_at(time)).views[1].finger.apex_px for time in (0.2, 0.22)]
    np.testing.assert_allclose(frame.truth.views[1].finger.apex_px, still[1])
    assert np.linalg.norm(still[1] - still[0]) > 2
    np.testing.assert_allclose(frame.truth.indicated_mm, path.pose_at(0.2).indicated_mm)


def test_start_pose_is_off_by_exactly_the_error() -> None:
    finger = SimulatedRig().truth(POSE).views[0].finger
    exact = finger.start()
    off = finger.start(StartError(offset_px=20, angle_deg=30, scale=1.4), rng=3)
    assert exact.tip_px == pytest.approx(tuple(finger.apex_pictured_px))
    assert math.dist(exact.tip_px, off.tip_px) == pytest.approx(20)
    assert abs(math.remainder(off.angle_deg - exact.angle_deg, 360)) == pytest.approx(30)
    assert off.length_px == pytest.approx(1.4 * exact.length_px)
    assert off == finger.start(StartError(offset_px=20, angle_deg=30, scale=1.4), rng=3)


# --- pictures ------------------------------------------------------------------------------------


def fitted_edge(
    image: np.ndarray, camera: Camera, flank: np.ndarray, inside: float, outside: float
) -> tuple[float, float, float, float]:
    """Offset [px], angle [rad] and sigma [px] of a blurred step along a flank, and half its length.

    `flank` (2, 2) is ideal; pixels are taken to ideal coordinates first.
    """
    (left, top), (right, bottom) = camera.pictured(flank).min(0), camera.pictured(flank).max(0)
    v, u = np.mgrid[int(top) - 5 : int(bottom) + 6, int(left) - 5 : int(right) + 6]
    image = image[v, u]
    ideal = camera.ideal(np.stack([u, v], -1).astype(float))
    start, end = flank
    length = np.linalg.norm(end - start)
    e = (end - start) / length
    along = (ideal - (start + end) / 2) @ e
    across = (ideal - start) @ [-e[1], e[0]]
    near = (np.abs(along) < length / 2 - 9) & (np.abs(across) < 3.5)
    part = (image[near].astype(float) - outside) / (inside - outside)
    sign = np.sign(np.mean(part[across[near] > 1]) - np.mean(part[across[near] < -1]))

    def residual(q: np.ndarray) -> np.ndarray:
        return ndtr(sign * (across[near] - q[0] - q[1] * along[near]) / q[2]) - part

    offset, slope, sigma = least_squares(residual, [0.0, 0.0, 1.0], x_scale=[1, 0.02, 1]).x
    return offset, slope, sigma, length / 2


EDGE_POSES = [
    POSE,
    DevicePose.pointing_at((240.3, 150.7), hover_mm=80, azimuth_deg=80, slant_deg=30),
    DevicePose.pointing_at((90.1, 260.2), hover_mm=60, azimuth_deg=-60, slant_deg=45),
    # Straight down the image of the left view: its flanks run along the pixel columns.
    DevicePose.pointing_at((200.0, 200.0), hover_mm=90, azimuth_deg=-15, slant_deg=45),
]


@pytest.mark.parametrize("blur", [0.7, 1.0, 1.5])
@pytest.mark.parametrize("k1", [0.0, -0.2])
def test_edges_are_at_the_silhouette(blur: float, k1: float) -> None:
    rig = SimulatedRig(Placement(k1=(k1,)), device=ROD, sensor=Sensor(blur_px=blur, noise=0))
    for pose in EDGE_POSES:
        frame = rig.render(pose, quantise=False)
        for camera, image, view in zip(rig.cameras, frame.images, frame.truth.views, strict=True):
            for flank in view.finger.flanks_px:
                offset, slope, sigma, _ = fitted_edge(image, camera, flank, 150, 70)
                assert abs(offset) < EDGE_TOLERANCE_PX / 4
                assert abs(slope) < EDGE_TOLERANCE_RAD / 2
                assert sigma == pytest.approx(math.hypot(blur, 12**-0.5), rel=0.012)


def test_midline_of_the_flanks_is_the_axis_to_a_tenth_of_the_noise_free_floor() -> None:
    # 0.02 mm on the plane are about 0.001 px of line.
    rig = SimulatedRig(device=RodAndProng(prong_length_mm=0, taper=0.1), sensor=CLEAN)
    offsets, slopes = [], []
    sampler, rng = PoseSampler(rig), seeded("floor")
    for _ in range(6):
        frame = rig.render(sampler.draw(rng), quantise=False)
        for camera, image, view in zip(rig.cameras, frame.images, frame.truth.views, strict=True):
            fits = [fitted_edge(image, camera, f, 150, 70) for f in view.finger.flanks_px]
            offsets.append(np.mean([fit[0] for fit in fits]))
            slopes.append(np.mean([fit[1] for fit in fits]))
    assert np.sqrt(np.mean(np.square(offsets))) < 1e-4
    assert np.sqrt(np.mean(np.square(slopes))) < 5e-6


def test_coarser_cells_keep_the_edge() -> None:
    sensor = Sensor(noise=0, cells_per_sigma=2)
    rig = SimulatedRig(device=ROD, sensor=sensor)
    frame = rig.render(EDGE_POSES[3], quantise=False)
    for flank in frame.truth.views[0].finger.flanks_px:
        offset, *_ = fitted_edge(frame.images[0], rig.cameras[0], flank, 150, 70)
        assert abs(offset) < EDGE_TOLERANCE_PX / 2


def test_unblurred_pictures_are_the_covered_area() -> None:
    rig = SimulatedRig(device=ROD, sensor=Sensor(noise=0, blur_px=0))
    frame = rig.render(POSE, quantise=False)
    body = ROD.body
    for camera, image in zip(rig.cameras, frame.images, strict=True):
        seen, _ = seen_links(camera, body.placed(POSE.world_from_device))
        u, v = camera.project_seen(link_outlines(seen).points[0]).T
        area = abs(u @ np.roll(v, -1) - v @ np.roll(u, -1)) / 2
        assert (image - 70).sum() / 80 == pytest.approx(area, rel=1e-6)


def test_quantised_pictures_are_the_rounded_light() -> None:
    rig = SimulatedRig(device=ROD)
    exact = rig.render(POSE, rng=5, quantise=False).images[0]
    rounded = rig.render(POSE, rng=5).images[0]
    assert rounded.dtype == np.uint8
    np.testing.assert_array_equal(rounded, np.rint(exact).clip(0, 255).astype(np.uint8))


def test_mirrored_noise_has_the_other_sign() -> None:
    rig, quiet = (SimulatedRig(device=ROD, sensor=Sensor(noise=noise)) for noise in (3.0, 0.0))
    bare = quiet.render(POSE, quantise=False)
    plain, mirrored = (rig.render(POSE, rng=5, quantise=False, mirrored=m) for m in (False, True))
    for light, one, other in zip(bare.images, plain.images, mirrored.images, strict=True):
        np.testing.assert_allclose((one + other) / 2, light, atol=1e-4)
        assert (one - other).std() == pytest.approx(6, rel=0.02)


def test_noise_is_white_and_normal_with_the_given_sigma() -> None:
    rig = SimulatedRig(sensor=Sensor(noise=3.0))
    rng = seeded("noise")
    frames = np.stack([rig.render(None, rng=rng, quantise=False).images for _ in range(4)])
    noise = (frames.astype(float) - 70).reshape(8, 480, 640)
    n = noise[0].size
    for image in noise:
        assert abs(image.mean()) < 4 * 3 / math.sqrt(n)
        assert image.std() == pytest.approx(3, rel=4 / math.sqrt(2 * n))
        assert abs(kurtosis(image.ravel())) < 4 * math.sqrt(24 / n)
        for shift in ((0, 1), (1, 0), (1, 1), (0, 4)):
            moved = np.roll(image, shift, axis=(0, 1))
            assert abs((image * moved).mean()) / 9 < 4.5 / math.sqrt(n)
    correlation = np.corrcoef(noise.reshape(8, -1)) - np.eye(8)
    assert np.abs(correlation).max() < 4.5 / math.sqrt(n)


def test_colour_noise_is_independent_in_every_channel() -> None:
    rig = SimulatedRig(sensor=Sensor(noise=3.0, channels="bgr"))
    image = rig.render(None, rng=1, quantise=False).images[0]
    assert image.shape == (480, 640, 3)
    correlation = np.corrcoef(image.reshape(-1, 3).T) - np.eye(3)
    assert np.abs(correlation).max() < 4.5 / math.sqrt(480 * 640)


def test_the_same_seed_gives_the_same_bits() -> None:
    def rig() -> SimulatedRig:
        return SimulatedRig(
            Placement(width_px=320, height_px=240),
            device=Hand(),
            background=Background(clutter=40, texture="wood", seed=3),
        )

    first, second = rig(), rig()
    second.render(EDGE_POSES[1], rng=99)  # earlier renderings have no effect
    for a, b in zip(
        first.render(POSE, rng=7).images, second.render(POSE, rng=7).images, strict=True
    ):
        np.testing.assert_array_equal(a, b)
    assert (first.render(POSE, rng=8).images[0] != first.render(POSE, rng=7).images[0]).any()
    generator = np.random.default_rng(7)
    np.testing.assert_array_equal(
        first.render(POSE, rng=generator).images[0], first.render(POSE, rng=7).images[0]
    )
    assert (
        first.render(POSE, rng=generator).images[0] != first.render(POSE, rng=7).images[0]
    ).any()


def test_colour_pictures_have_the_grey_ones_luma() -> None:
    background = Background(level=90, texture="wood", clutter=30, sheet=40)
    grey, colour = (
        SimulatedRig(
            Placement(width_px=320, height_px=240),
            device=Hand(sleeve=True),
            background=background,
            sensor=Sensor(noise=0, channels=channels),
        )
        .render(POSE, quantise=False)
        .images[0]
        for channels in ("grey", "bgr")
    )
    luma = colour @ np.array([0.114, 0.587, 0.299])
    unclipped = (colour < 254).all(axis=-1)
    assert unclipped.mean() > 0.9
    near_clipped = cv2.erode(unclipped.astype(np.uint8), np.ones((13, 13))).astype(bool)
    np.testing.assert_allclose(luma[near_clipped], grey[near_clipped], atol=0.01)


def test_motion_blur_keeps_the_centroid_and_spreads_it() -> None:
    exposure, speed = 0.03, 0.6
    ends = [
        DevicePose.pointing_at((x, 200), hover_mm=80, azimuth_deg=0, slant_deg=45)
        for x in (50, 350)
    ]
    path = Trajectory.through(ends, speed)
    sharp = SimulatedRig(device=ROD, sensor=CLEAN)
    blurred = SimulatedRig(device=ROD, sensor=Sensor(noise=0, exposure_s=exposure))
    time = 0.3
    v, u = np.mgrid[:480, :640]

    def moments(rig: SimulatedRig) -> tuple[float, np.ndarray, np.ndarray]:
        image = rig.render(path, time_s=time, quantise=False).images[0].astype(float) - 70
        total = image.sum()
        mean = np.array([(image * u).sum(), (image * v).sum()]) / total
        spread = np.array([(image * (u - mean[0]) ** 2).sum(), (image * (v - mean[1]) ** 2).sum()])
        return total, mean, spread / total

    still, moving = moments(sharp), moments(blurred)
    assert moving[0] == pytest.approx(still[0], rel=1e-3)
    np.testing.assert_allclose(moving[1], still[1], atol=0.01)
    points = [path.pose_at(time + side * exposure / 2).tip_mm for side in (-1, 1)]
    run = np.abs(np.diff(sharp.cameras[0].project(points), axis=0)[0])
    assert run[0] > 10
    np.testing.assert_allclose(moving[2] - still[2], run**2 / 12, rtol=0.02, atol=0.02)


def test_side_light_and_limb_darkening_shade_the_contrast() -> None:
    def profile(lighting: Lighting) -> np.ndarray:
        rig = SimulatedRig(
            Placement(width_px=1280, height_px=960),
            device=ROD,
            lighting=lighting,
            sensor=Sensor(noise=0, blur_px=0),
        )
        frame = rig.render(POSE, quantise=False)
        flanks = frame.truth.views[0].finger.flanks_px
        left, right = flanks.mean(axis=1)
        t = np.linspace(-0.85, 0.85, 35)[:, None]
        u, v = ((left + right) / 2 + t * (right - left) / 2).T
        return (map_coordinates(frame.images[0], [v, u], order=1) - 70) / 80

    t = np.linspace(-0.85, 0.85, 35)
    np.testing.assert_allclose(profile(Lighting()), 1, atol=1e-4)
    side = profile(Lighting(side_light=0.3))
    # The light comes from the picture's left, where the finger's right flank is.
    np.testing.assert_allclose(side, 1 + 0.15 * t, atol=0.012)
    limb = profile(Lighting(limb_darkening=0.3))
    np.testing.assert_allclose(limb, 1 - 0.3 * (1 - np.sqrt(1 - t**2)), atol=0.02)


@pytest.mark.parametrize("shading", [0.0, 0.2])
def test_the_nearer_of_two_bars_is_seen_where_they_cross(shading: float) -> None:
    lighting = Lighting(limb_darkening=shading)
    rig = SimulatedRig(Placement(azimuths_deg=(0.0,)), sensor=CLEAN, lighting=lighting)

    def bar(end: tuple[float, float, float], ratio: float) -> Link:
        start = tuple(-x for x in end)
        return Link(start, 6.0, end, 6.0, Material(ratio, (1.0, 1.0, 1.0)))

    # Device x points at the camera's side, so a bar at negative x is the farther one.
    upright, level = bar((0.0, 0.0, 60.0), 1.0), bar((0.0, 60.0, 0.0), -0.5)
    crossing = rig.cameras[0].project((200.0, 200.0, 100.0)).round().astype(int)
    for nearer in (upright, level):
        farther = level if nearer is upright else upright
        moved = [
            Link((x + d, y, z), r, (-x + d, -y, -z), r, link.material)
            for link, d in ((nearer, 10.0), (farther, -10.0))
            for (x, y, z), r in [(link.start_mm, link.start_radius_mm)]
        ]
        for links in (moved, moved[::-1]):
            device = SimpleNamespace(body=Body(tuple(links), 0, None, (-50.0, 0.0, 0.0)))
            pose = DevicePose((200.0, 200.0, 100.0), 0.0, -42.0)
            image = rig.render(pose, device=device, quantise=False).images[0]
            expected = 70 + 80 * nearer.material.contrast_ratio
            assert image[crossing[1], crossing[0]] == pytest.approx(expected, abs=0.5)


# --- table, light, occlusion ---------------------------------------------------------------------


def test_sheet_has_its_corners_at_the_reference_points() -> None:
    rig = SimulatedRig(background=Background(sheet=80), sensor=CLEAN)
    images = rig.render(None, quantise=False).images
    for camera, image, corners in zip(rig.cameras, images, rig.reference_points_px, strict=True):
        for i in range(4):
            side = np.stack([corners[i], corners[(i + 1) % 4]])
            offset, slope, *_ = fitted_edge(image, camera, side, 150, 70)
            assert abs(offset) < EDGE_TOLERANCE_PX / 2
            assert abs(slope) < EDGE_TOLERANCE_RAD


def test_clutter_stays_in_its_range_and_the_views_agree() -> None:
    rig = SimulatedRig(background=Background(level=100, clutter=50, seed=4), sensor=CLEAN)
    images = [image.astype(float) for image in rig.render(None, quantise=False).images]
    assert all(image.min() > 49.9 and image.max() < 150.1 for image in images)
    assert all(image.std() > 15 for image in images)
    points = seeded("clutter").uniform(0, 400, (2000, 2))
    seen = []
    for camera, image in zip(rig.cameras, images, strict=True):
        u, v = camera.project(np.pad(points, ((0, 0), (0, 1)))).T
        seen.append(map_coordinates(image, [v, u], order=1))
    assert np.corrcoef(seen)[0, 1] > 0.95
    other = SimulatedRig(background=Background(level=100, clutter=50, seed=5), sensor=CLEAN)
    assert np.abs(other.render(None, quantise=False).images[0] - images[0]).mean() > 5


def test_clutter_leaves_the_sheets_edges_free() -> None:
    rig = SimulatedRig(background=Background(sheet=80, clutter=60), sensor=CLEAN)
    image, corners = rig.render(None, quantise=False).images[0], rig.reference_points_px[0]
    for i in range(4):
        side = np.stack([corners[i], corners[(i + 1) % 4]])
        offset, *_ = fitted_edge(image, rig.cameras[0], side, 150, 70)
        assert abs(offset) < EDGE_TOLERANCE_PX / 2


def test_wood_reaches_its_amplitude_and_has_a_grain() -> None:
    background = Background(level=100, texture="wood", texture_amplitude=20)
    image = SimulatedRig(background=background, sensor=CLEAN).render(None, quantise=False).images[0]
    assert 80 <= image.min() < 95
    assert 105 < image.max() <= 120
    steps = [np.abs(np.diff(image, axis=axis)).mean() for axis in (0, 1)]
    assert steps[0] > 2 * steps[1]  # the grain runs along X, which is across the picture


@pytest.mark.parametrize("duration", [0.0, 2.0])
def test_light_changes_everything_by_its_gain(duration: float) -> None:
    change = LightChange(start_s=1.0, gain=0.6, duration_s=duration)
    rig = SimulatedRig(lighting=Lighting(change=change), sensor=CLEAN)
    before, after = (rig.render(POSE, time_s=t, quantise=False).images[0] for t in (0.9, 3.1))
    np.testing.assert_allclose(after, 0.6 * before, rtol=1e-5)
    middle = rig.render(POSE, time_s=2.0, quantise=False).images[0]
    np.testing.assert_allclose(middle, (0.8 if duration else 0.6) * before, rtol=1e-5)


def test_shadow_darkens_the_table_and_not_the_device() -> None:
    pose = DevicePose.pointing_at((200, 200), hover_mm=60, azimuth_deg=60)
    plain, shaded = (
        SimulatedRig(lighting=Lighting(shadow=s), sensor=CLEAN, device=Hand())
        .render(pose, quantise=False)
        .images[0]
        for s in (0.0, 0.5)
    )
    np.testing.assert_allclose(shaded[plain > 149.999], 150, atol=0.01)
    table = plain < 70.001
    assert shaded[table].min() < 45
    assert shaded[table].min() > 34.9
    assert (shaded[table] <= 70.01).all()
    assert (shaded[table] > 69.9).mean() > 0.5


@pytest.mark.parametrize("fraction", [0.0, 0.3, 0.7])
def test_occluders_cover_the_fraction_of_the_contour(fraction: float) -> None:
    rig = SimulatedRig(device=Hand(), sensor=CLEAN)
    discs = rig.occluders(POSE, fraction, 6)
    frame = rig.render(POSE, occluders=discs, quantise=False)
    for camera, image, some in zip(rig.cameras, frame.images, discs, strict=True):
        contour, _ = visible_contour(camera, rig.device.body, POSE)
        covered = np.zeros(len(contour), bool)
        for disc in some:
            covered |= np.linalg.norm(contour - disc.centre_px, axis=1) <= disc.radius_px
        assert covered.mean() == pytest.approx(fraction, abs=1.5 / len(contour))
        if some:
            first, (u, v) = some[0], some[0].centre_px
            if first.radius_px > 4:
                assert image[round(v), round(u)] == pytest.approx(first.level, abs=0.1)


def test_visible_contour_lies_on_the_edge_of_the_picture() -> None:
    rig = SimulatedRig(sensor=CLEAN)
    image = rig.render(POSE, quantise=False).images[0]
    contour, width = visible_contour(rig.cameras[0], rig.device.body, POSE)
    levels = map_coordinates(image, contour.T[::-1], order=1)
    # On a straight edge the level is half way; at the tip and in the crotch it deviates.
    assert np.median(levels) == pytest.approx(110, abs=1)
    assert (np.abs(levels - 110) < 12).mean() > 0.9
    assert width == pytest.approx(16 * 0.85, rel=0.15)


def test_another_hand_does_not_change_the_truth() -> None:
    rig = SimulatedRig(sensor=CLEAN)
    other = DevicePose.pointing_at((330, 80), hover_mm=60, azimuth_deg=-70)
    alone, together = rig.render(POSE), rig.render(POSE, others=[(Hand(side="left"), other)])
    np.testing.assert_array_equal(alone.truth.indicated_mm, together.truth.indicated_mm)
    added = together.images[0] != alone.images[0]
    only = rig.render(other, device=Hand(side="left")).images[0]
    np.testing.assert_array_equal(together.images[0][added], only[added])
    assert added.sum() > 2000


# --- sampler -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "placement",
    [Placement(), Placement(azimuths_deg=(20.0, 70.0, 120.0)), Placement.webcams()],
)
def test_drawn_poses_respect_every_limit(placement: Placement) -> None:
    rig = SimulatedRig(placement)
    limits = PoseLimits(roll_deg=(-10, 10))
    sampler, rng = PoseSampler(rig, limits), seeded("limits")
    middle = math.radians(np.mean(placement.azimuths_deg))
    poses = [sampler.draw(rng) for _ in range(80)]
    for pose in poses:
        assert 50 <= pose.tip_mm[2] <= 250
        assert (pose.indicated_mm >= 0).all()
        assert (pose.indicated_mm <= 400).all()
        d = pose.direction
        assert 25 <= math.degrees(math.asin(-d[2])) <= 65
        towards = np.array([math.sin(middle), -math.cos(middle)])
        cosine = d[:2] @ towards / np.linalg.norm(d[:2])
        assert cosine >= math.cos(math.radians(100)) - 1e-9
        assert abs(pose.roll_deg) <= 10
        for camera, view in zip(rig.cameras, rig.truth(pose).views, strict=True):
            ray = np.array(pose.tip_mm) - camera.centre_mm
            angle = math.degrees(math.acos(min(abs(ray @ d) / np.linalg.norm(ray), 1)))
            assert angle >= 25 - 1e-9
            assert view.finger.in_view
            contour, _ = visible_contour(camera, rig.device.body, pose)
            assert camera.contains(contour, limits.border_px - 1).all()
    targets = np.array([pose.indicated_mm for pose in poses])
    assert (np.ptp(targets, axis=0) > 300).all()
    assert np.ptp([pose.azimuth_deg for pose in poses]) > 120


def test_equal_ends_fix_a_value() -> None:
    limits = PoseLimits(hover_mm=(150, 150), slant_deg=(45, 45), azimuth_deg=(20, 20))
    pose = PoseSampler(SimulatedRig(), limits).draw(2)
    assert pose.tip_mm[2] == pytest.approx(150)
    assert (pose.slant_deg, pose.azimuth_deg) == pytest.approx((45, 20))


@pytest.mark.parametrize("slant", [42.0, -42.0])
def test_a_finger_seen_end_on_is_refused_from_either_end(slant: float) -> None:
    rig = SimulatedRig(Placement(azimuths_deg=(0.0,)))
    azimuth = 180.0 if slant > 0 else 0.0  # along the view ray, away from the camera or towards it
    oblique = DevicePose((200.0, 200.0, 60.0), 60.0, slant)
    end_on = DevicePose((200.0, 200.0, 60.0), azimuth, slant)
    assert PoseSampler(rig).accepts(oblique)
    assert not PoseSampler(rig).accepts(end_on)
    assert PoseSampler(rig, PoseLimits(view_ray_deg=0)).accepts(end_on)


def test_poses_outside_the_pictures_are_refused() -> None:
    sampler = PoseSampler(SimulatedRig(), PoseLimits(border_px=400))
    with pytest.raises(InvalidInputError, match="none of 5000 poses"):
        sampler.draw(1)


# --- motion --------------------------------------------------------------------------------------


def test_trajectory_passes_through_its_poses_at_its_speed() -> None:
    poses = figure_eight(Workspace(), points=12)
    path = Trajectory.through(poses, 0.35, ease_s=0.1)
    times = np.arange(0, path.duration_s, 1e-3)
    tips = np.array([path.pose_at(t).tip_mm for t in times])
    speed = np.linalg.norm(np.diff(tips, axis=0), axis=1)  # mm per ms is m/s
    is_cruising = (times[:-1] > 0.101) & (times[:-1] < path.duration_s - 0.102)
    np.testing.assert_allclose(speed[is_cruising], 0.35, rtol=2e-3)
    assert speed[0] < 0.01
    for pose in poses:
        assert np.linalg.norm(tips - pose.tip_mm, axis=1).min() < 0.3
    np.testing.assert_allclose(path.pose_at(-5).tip_mm, poses[0].tip_mm)
    np.testing.assert_allclose(path.pose_at(1e4).tip_mm, poses[-1].tip_mm)
    turn = np.diff(tips, 2, axis=0)[is_cruising[1:]]
    assert np.abs(turn).max() < 0.02  # no corner anywhere: under 20 m/s²


def test_azimuth_takes_the_short_way_round() -> None:
    ends = [DevicePose((0, 0, 100), 170, 40), DevicePose((100, 0, 100), -170, 40)]
    azimuths = [
        Trajectory.through(ends, 0.2).pose_at(t).azimuth_deg for t in np.linspace(0, 0.6, 30)
    ]
    assert all(abs(azimuth) > 169 for azimuth in azimuths)


def test_a_short_path_never_reaches_its_speed() -> None:
    ends = [DevicePose((0, 0, 100), 0, 40), DevicePose((10, 0, 100), 0, 40)]
    path = Trajectory.through(ends, 1.0, ease_s=0.5)
    assert path.duration_s == pytest.approx(0.02)
    assert path.pose_at(0.01).tip_mm[0] == pytest.approx(5, abs=1e-6)


def test_session_enters_waits_points_leaves_and_returns() -> None:
    rig = SimulatedRig(device=Hand(), sensor=CLEAN)
    poses = figure_eight(rig.workspace)
    session = pointing_session(poses, away_s=0.6)
    states = []
    for time in np.arange(0, session.duration_s, 0.05):
        views = rig.truth(session, time_s=float(time)).views
        states.append(all(view.finger.in_view for view in views))
    changes = [states[0], *(b for a, b in pairwise(states) if a != b)]
    assert changes == [False, True, False, True]
    empty = rig.render(None).images
    for a, b in zip(rig.render(session, time_s=0.0).images, empty, strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_allclose(session.pose_at(1e3).tip_mm, poses[-1].tip_mm)


def test_joined_trajectories_must_meet() -> None:
    hold = Trajectory.hold(POSE, 1.0)
    with pytest.raises(InvalidInputError, match="must start where"):
        hold.then(Trajectory.hold(POSE.retreated(10), 1.0))
    assert hold.then(hold).duration_s == 2.0


def test_the_motion_between_two_poses_is_straight_and_uniform() -> None:
    first = DevicePose((10.0, 20.0, 30.0), -170.0, 25.0, 5.0)
    last = DevicePose((50.0, 20.0, 110.0), 170.0, 65.0, -5.0)
    way = Trajectory.between(first, last, 2.0)
    for time_s, pose in [(-1.0, first), (0.0, first), (2.0, last), (9.0, last)]:
        np.testing.assert_allclose(way.pose_at(time_s).tip_mm, pose.tip_mm)
        assert way.pose_at(time_s).azimuth_deg == pytest.approx(pose.azimuth_deg)
    there = way.pose_at(0.5)
    np.testing.assert_allclose(there.tip_mm, (20.0, 20.0, 50.0))
    assert (there.azimuth_deg, there.slant_deg, there.roll_deg) == pytest.approx((-85.0, 35.0, 2.5))


# --- recordings ----------------------------------------------------------------------------------


def test_recording_holds_what_was_rendered(tmp_path: Path) -> None:
    rig = SimulatedRig(Placement(k1=(-0.2,)), device=Hand())
    path = Trajectory.through(figure_eight(rig.workspace), 0.3)
    rig_file = write_recording(tmp_path / "take", rig, path, frames=3, fps=25, rng=4)
    described = tomllib.loads(rig_file.read_text(encoding="utf-8"))
    assert described["plane"] == {"unit": "mm", "points": rig.plane_points.tolist()}
    rng = np.random.default_rng(4)
    rng.normal(0, 0, (2, 4, 2))
    for i, view in enumerate(described["view"]):
        camera, truth = rig.cameras[i], rig.truth(path).views[i]
        assert view["name"] == camera.name
        np.testing.assert_allclose(
            view["reference_points_px"], rig.reference_points_px[i], atol=1e-6
        )
        assert view["lens"]["k1"] == -0.2
        assert view["lens"]["fx"] == pytest.approx(camera.f_px)
        assert set(view["start"]) == {"tip_px", "angle_deg", "length_px", "thumb"}
        np.testing.assert_allclose(
            view["start"]["tip_px"], truth.finger.apex_pictured_px, atol=1e-3
        )
    files = sorted(rig_file.parent.glob(described["view"][0]["source"]))
    assert [file.name for file in files] == ["00000.png", "00001.png", "00002.png"]
    rows = (rig_file.parent / "truth.csv").read_text(encoding="utf-8").splitlines()
    assert rows[0] == "frame,time_s,x,y"
    for index, file in enumerate(files):
        frame = rig.render(path, time_s=index / 25, rng=rng)
        stored = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(stored, frame.images[0])
        number, time, x, y = rows[index + 1].split(",")
        assert (int(number), float(time)) == (index, pytest.approx(index / 25))
        np.testing.assert_allclose((float(x), float(y)), frame.truth.indicated_mm, atol=1e-6)


def test_recording_of_an_entering_hand(tmp_path: Path) -> None:
    rig = SimulatedRig(device=Hand(), sensor=Sensor(channels="bgr"))
    session = pointing_session(figure_eight(rig.workspace))
    with pytest.raises(InvalidInputError, match="start_time_s"):
        write_recording(tmp_path, rig, session, frames=1)
    rig_file = write_recording(
        tmp_path,
        rig,
        session,
        frames=2,
        fps=0.5,
        picture_format="mp4",
        start_time_s=2.0,
        start_error=StartError(offset_px=5),
        reference_noise_px=0.5,
    )
    described = tomllib.loads(rig_file.read_text(encoding="utf-8"))
    noise = np.array(
        [
            np.array(view["reference_points_px"]) - rig.reference_points_px[i]
            for i, view in enumerate(described["view"])
        ]
    )
    assert 0.15 < noise.std() < 1.0
    truth = rig.truth(session, time_s=2.0).views[1].finger
    tip = described["view"][1]["start"]["tip_px"]
    assert math.dist(tip, truth.apex_pictured_px) == pytest.approx(5, abs=2e-3)
    rows = (tmp_path / "truth.csv").read_text(encoding="utf-8").splitlines()
    assert rows[1] == "0,0.000000,,"
    assert rows[2].count(",") == 3
    assert not rows[2].endswith(",")
    video = cv2.VideoCapture(str(tmp_path / described["view"][0]["source"]))
    read, image = video.read()
    assert read
    assert image.shape == (480, 640, 3)
    assert video.read()[0]
    assert not video.read()[0]


# --- bad input -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Placement(distance_m=math.nan), "distance_m is nan"),
        (lambda: Placement(azimuths_deg=()), "azimuths_deg"),
        (lambda: Placement(azimuths_deg=(0.0, 400.0)), r"azimuths_deg\[1\] is 400"),
        (lambda: Placement(k1=(0.1, 0.1, 0.1)), "k1"),
        (lambda: Placement(width_px=640.5).cameras(Workspace()), "width_px"),
        (lambda: Placement(f_px=100.0, k1=(-0.5,)).cameras(Workspace()), "folds over"),
        (lambda: Placement(distance_m=0.15, elevation_deg=20).cameras(Workspace()), "too close"),
        (lambda: Workspace(side_mm=-1), "side_mm is -1"),
        (lambda: Workspace(points_per_side=1), "points_per_side is 1"),
        (lambda: Camera("a b", 640, 480, 600.0, np.eye(3, 4)), "camera name"),
        (lambda: Camera("a", 640, 480, 600.0, np.ones((3, 4))), "not a rotation"),
        (lambda: Camera("a", 640, 480, 600.0, np.full((3, 4), np.nan)), r"\[0, 0\] is nan"),
        (lambda: RodAndProng(length_mm=10), "length_mm is 10"),
        (lambda: RodAndProng(length_mm=30, diameter_mm=40), "longer than wide"),
        (lambda: RodAndProng(taper=True), "taper is True"),
        (lambda: Hand(side="both"), "side is 'both'; it must be one of right, left"),
        (lambda: Hand(bend_deg=90), "bend_deg is 90"),
        (lambda: DevicePose((0, 0), 0, 40), r"tip_mm: shape \(2,\) found; \(3\) is needed"),
        (lambda: DevicePose((0, 0, math.inf), 0, 40), r"tip_mm\[2\] is inf"),
        (lambda: DevicePose((0, 0, 0), 0, 90), "slant_deg is 90"),
        (lambda: DevicePose.pointing_at((0, 0), hover_mm=10, slant_deg=0), "slant_deg is 0"),
        (lambda: DevicePose.pointing_at("ab", hover_mm=10), "target_mm: <U2 found; real numbers"),
        (lambda: Background(clutter=200), "clutter is 200"),
        (lambda: Background(clutter=90), "level − clutter is -20"),
        (lambda: SimulatedRig(background=Background(level=200)), "contrast is 280"),
        (lambda: Background(texture="marble"), "texture is 'marble'"),
        (lambda: Lighting(contrast=0.2), "contrast is 0.2"),
        (lambda: Lighting(change=0.5), "change is 0.5"),
        (lambda: LightChange(0, -1), "gain is -1"),
        (lambda: Sensor(blur_px=9), "blur_px is 9"),
        (lambda: Sensor(channels="rgb"), "channels is 'rgb'"),
        (lambda: Sensor(cells_per_sigma=0), "cells_per_sigma is 0"),
        (lambda: Occluder((0.0, math.nan), 3.0, 10.0), r"centre_px\[1\] is nan"),
        (lambda: Occluder((0.0, 0.0), 0.0, 10.0), "radius_px is 0"),
        (lambda: PoseLimits(hover_mm=(200, 100)), "the smaller first"),
        (lambda: PoseLimits(slant_deg=45), "slant_deg is 45"),
        (lambda: SimulatedRig([]), "cameras is empty"),
        (lambda: SimulatedRig(Placement().cameras(Workspace())[:1] * 2), "must be unique"),
        (lambda: SimulatedRig(Placement(distance_m=0.15, f_px=300.0)), "reference point"),
        (lambda: SimulatedRig("left"), "cameras is 'left'"),
        (lambda: SimulatedRig(device="hand"), "device is 'hand'"),
        (lambda: SimulatedRig(sensor=Lighting()), "sensor is"),
        (lambda: Trajectory.through([POSE], 0.3), "poses has 1"),
        (lambda: Trajectory.through([POSE, POSE], 0.3), r"poses\[0\] and poses\[1\]"),
        (lambda: Trajectory(np.array([0.0, 0.0]), np.zeros((2, 6))), "ascending"),
        (lambda: Trajectory.hold(POSE, 0), "duration_s is 0"),
        (lambda: StartError(scale=0), "scale is 0"),
        (lambda: Sensor(noise=1e-300), "noise is 1e-300; it must be 0 or"),
        (lambda: Sensor(blur_px=1e-320), "blur_px is 1e-320; it must be 0 or"),
        (lambda: Sensor(noise=math.nan), "noise is nan"),
    ],
)
def test_bad_options_are_refused_by_name(make, message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        make()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"motion": POSE}, "rng is None"),
        ({"motion": POSE, "rng": -1}, "rng is -1"),
        ({"motion": "still", "rng": 0}, "motion is 'still'"),
        ({"motion": POSE, "rng": 0, "time_s": math.nan}, "time_s is nan"),
        ({"motion": POSE, "rng": 0, "occluders": [()]}, "occluders has 1"),
        ({"motion": POSE, "rng": 0, "device": 3}, "device is 3"),
    ],
)
def test_bad_arguments_to_render_are_refused(arguments: dict, message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        SimulatedRig().render(**arguments)


def test_bad_occlusion_is_refused() -> None:
    rig = SimulatedRig()
    with pytest.raises(InvalidInputError, match=r"fraction is 1"):
        rig.occluders(POSE, 1, 0)
    with pytest.raises(InvalidInputError, match="outside the image"):
        rig.occluders(POSE.retreated(2000), 0.3, 0)


def test_a_start_needs_a_finger_in_front_of_the_camera() -> None:
    rig = SimulatedRig()
    behind = DevicePose(tuple(rig.cameras[0].centre_mm * 2), 0, 40)
    with pytest.raises(InvalidInputError, match="not in front"):
        rig.truth(behind).views[0].finger.start()


def test_bad_recordings_are_refused(tmp_path: Path) -> None:
    rig = SimulatedRig()
    with pytest.raises(InvalidInputError, match="picture_format"):
        write_recording(tmp_path, rig, POSE, frames=1, picture_format="gif")
    with pytest.raises(InvalidInputError, match="frames is 0"):
        write_recording(tmp_path, rig, POSE, frames=0)
    blocked = tmp_path / "file"
    blocked.write_text("")
    with pytest.raises(OSError, match="file"):
        write_recording(blocked, rig, POSE, frames=1)


def test_the_documented_example_runs() -> None:
    result = doctest.testmod(fingerpost.simulate.rig)
    assert result.attempted >= 4
    assert result.failed == 0
