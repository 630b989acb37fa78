"""The placement advisor: cameras from homographies, predicted errors, and recommended moves."""

import json
import math

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st

from fingerpost.advise import (
    AdviceOptions,
    Concern,
    Doubt,
    Way,
    advise,
    recover_camera,
    reference_weakness,
)
from fingerpost.advise.camera import FOCAL_PRIOR, _Problem, _State
from fingerpost.advise.forecast import error_radius, predict
from fingerpost.advise.moves import Bearings, try_moves
from fingerpost.advise.poses import Poses, Workspace
from fingerpost.cli import main
from fingerpost.config import LensParameters, Plane, Rig, View
from fingerpost.errors import InvalidInputError
from fingerpost.experiment import ExperimentOptions, run_experiment
from fingerpost.experiment.bound import edge_information, line_bound, point_bound
from fingerpost.lens import Lens
from fingerpost.pointing import DEFAULT_OPTIONS, PlaneView, PointingOptions
from fingerpost.simulate import Placement, PoseLimits, PoseSampler, RodAndProng, SimulatedRig
from fingerpost.simulate.truth import finger_truth

SEED = 1994
SIZE = (640, 480)
BRIEF = {"cells": 2, "samples": 40}
PAPER = Placement()
WIDE = Placement(azimuths_deg=(-45.0, 45.0), elevation_deg=50.0, distance_m=1.0)
LOW = Placement(azimuths_deg=(-5.0, 40.0), elevation_deg=30.0, distance_m=1.4)
SQUARE = np.array([[0.0, 0.0], [400.0, 0.0], [400.0, 400.0], [0.0, 400.0]])


def view_of(camera_points_px, *, plane=SQUARE, sigma_px=0.5, lens=None):
    covariance = sigma_px**2 * np.eye(2)
    return PlaneView.from_reference_points(plane, camera_points_px, covariance, lens)


def recovered(placement, *, sigma_px=0.1):
    rig = SimulatedRig(placement)
    size = (placement.width_px, placement.height_px)
    return rig, [
        recover_camera(view_of(px, sigma_px=sigma_px), px, size, sigma_px=sigma_px)
        for px in rig.reference_points_px
    ]


def rig_of(placement, *, unit="mm", plane=SQUARE, change=lambda points_px: points_px):
    simulated = SimulatedRig(placement)
    views = tuple(
        View(
            name=camera.name,
            source=f"{camera.name}.mp4",
            reference_points_px=tuple(map(tuple, change(px).tolist())),
        )
        for camera, px in zip(simulated.cameras, simulated.reference_points_px, strict=True)
    )
    return Rig(plane=Plane(unit=unit, points=tuple(map(tuple, plane.tolist()))), views=views)


# --- cameras from reference points -----------------------------------------------------------


@pytest.mark.parametrize("placement", [PAPER, WIDE, LOW, Placement.webcams()])
def test_a_camera_is_recovered_from_four_points(placement):
    rig, cameras = recovered(placement)
    for found, true in zip(cameras, rig.cameras, strict=True):
        # The priors bias the estimate by a small part of its uncertainty.
        assert found.focal_px == pytest.approx([true.f_px] * 2, rel=2e-3)
        assert found.centre == pytest.approx(true.centre_mm, rel=2e-3, abs=2.0)
        assert not found.mirrored
        assert found.misfit < 1.0
        in_space = np.array([[150.0, 220.0, 130.0], [300.0, 80.0, 60.0]])
        assert found.project(in_space) == pytest.approx(true.project(in_space), abs=0.2)


@settings(max_examples=40, derandomize=True)
@given(
    elevation=st.floats(20, 80),
    azimuth=st.floats(-170, 170),
    distance_m=st.floats(0.6, 3),
    turn=st.integers(0, 3),
)
def test_the_recovered_camera_reprojects_the_reference_points(elevation, azimuth, distance_m, turn):
    placement = Placement((distance_m), (azimuth,), elevation, f_px=900.0)
    (px,) = SimulatedRig(placement).reference_points_px
    plane, px = np.roll(SQUARE, turn, axis=0), np.roll(px, turn, axis=0)
    camera = recover_camera(view_of(px, plane=plane), px, SIZE, sigma_px=0.5)
    seen = camera.project(np.pad(plane, ((0, 0), (0, 1))))
    assert seen == pytest.approx(px, abs=0.75)
    assert camera.centre[2] > 0.0


def test_the_focal_lengths_standard_deviation_agrees_with_its_scatter():
    rig = SimulatedRig(PAPER)
    rng = np.random.default_rng(SEED)
    px, sigma = rig.reference_points_px[0], 0.5
    logs = []
    for _ in range(150):
        noisy = px + rng.normal(0.0, sigma, px.shape)
        camera = recover_camera(view_of(noisy), noisy, SIZE, sigma_px=sigma)
        logs.append(math.log(camera.focal_px[0]))
    # `focal_sigma` includes the principal point's uncertainty, which is not simulated here.
    exact = recover_camera(view_of(px), px, SIZE, sigma_px=sigma)
    assert 0.4 * exact.focal_sigma < np.std(logs) < 1.1 * exact.focal_sigma


def test_a_view_from_straight_above_has_the_prior_focal_length():
    (px,) = SimulatedRig(Placement(azimuths_deg=(0.0,), elevation_deg=90.0)).reference_points_px
    camera = recover_camera(view_of(px), px, SIZE, sigma_px=0.5)
    assert camera.focal_px[0] == pytest.approx(FOCAL_PRIOR[0] * 640)
    assert camera.focal_sigma == pytest.approx(FOCAL_PRIOR[1], rel=1e-3)
    assert camera.centre[:2] == pytest.approx([200.0, 200.0], abs=1.0)


def test_a_given_lens_is_taken_as_exact():
    placement = Placement(azimuths_deg=(20.0,), f_px=700.0, distance_m=0.9, k1=(-0.2,))
    rig = SimulatedRig(placement)
    (px,), (true,) = rig.reference_points_px, rig.cameras
    lens = Lens(700.0, 700.0, *true.principal_point_px.tolist(), k1=-0.2)
    camera = recover_camera(view_of(px, lens=lens), px, SIZE, sigma_px=0.1)
    assert camera.focal_sigma == 0.0
    assert camera.centre == pytest.approx(true.centre_mm, abs=0.1)
    assert camera.shows(np.array([[320.0, 240.0], [800.0, 240.0]])).tolist() == [True, False]


def test_a_left_handed_plane_has_its_height_on_the_cameras_side():
    rig = SimulatedRig(PAPER)
    mirrored = SQUARE[:, ::-1]  # X and Y swapped: left-handed as seen from above
    px = rig.reference_points_px[0]
    camera = recover_camera(view_of(px, plane=mirrored), px, SIZE, sigma_px=0.1)
    assert camera.mirrored
    x, y, height = rig.cameras[0].centre_mm
    assert camera.centre == pytest.approx([y, x, height], rel=2e-3, abs=2.0)


def test_coordinates_of_unequal_scale_fit_no_camera():
    px = SimulatedRig(WIDE).reference_points_px[0]
    stretched = SQUARE * [1.0, 0.7]
    assert recover_camera(view_of(px), px, SIZE, sigma_px=0.5).misfit < 1.0
    camera = recover_camera(view_of(px, plane=stretched), px, SIZE, sigma_px=0.5)
    assert camera.misfit > 25.0


@pytest.mark.parametrize("lens", [None, Lens(900.0, 910.0, 310.0, 250.0, 0.0)])
def test_the_residual_jacobian_agrees_with_central_differences(lens):
    px = SimulatedRig(WIDE).reference_points_px[0]
    problem = _Problem(SQUARE, px, 0.5, np.array([319.5, 239.5]), 700.0, 12.8, lens)
    start = problem.starts(view_of(px).image_from_plane)[0]
    state = _State(start.log_focal + 0.1, np.array([3.0, -2.0]), start.pose)
    _, jacobian = problem.residuals(state)
    count, h = jacobian.shape[1], 1e-6
    for k in range(count):
        step = h * np.eye(count)[k]
        ahead, _ = problem.residuals(problem.stepped(state, step))
        behind, _ = problem.residuals(problem.stepped(state, -step))
        # Residuals are measured minus modelled; the Jacobian is that of the model.
        slope = -(ahead - behind) / (2 * h)
        assert jacobian[:, k] == pytest.approx(slope, rel=1e-5, abs=1e-4)


# --- poses -----------------------------------------------------------------------------------


@pytest.mark.parametrize("mirrored", [False, True])
def test_azimuth_0_points_towards_the_cameras_and_increases_anticlockwise(mirrored):
    rig = SimulatedRig(PAPER)
    plane = SQUARE[:, ::-1] if mirrored else SQUARE
    cameras = [
        recover_camera(view_of(px, plane=plane), px, SIZE, sigma_px=0.1)
        for px in rig.reference_points_px
    ]
    workspace = Workspace.between(plane, cameras)
    poses = Poses.pointing(
        workspace,
        np.full((2, 2), 200.0),
        np.array([0.0, 90.0]),
        np.full(2, 45.0),
        np.full(2, 100.0),
    )
    level = poses.direction[:, :2][:, ::-1] if mirrored else poses.direction[:, :2]
    half = math.sqrt(0.5)
    # In true coordinates the cameras stand at negative Y; anticlockwise from there is +X.
    assert level == pytest.approx(np.array([[0.0, -half], [half, 0.0]]), abs=1e-3)
    assert poses.tip[:, 2] == pytest.approx([100.0, 100.0])
    along = poses.tip + poses.direction * (100.0 / half)
    assert along == pytest.approx(np.array([[200.0, 200.0, 0.0]] * 2), abs=1e-9)


def test_expected_poses_fill_workspace_and_limits_evenly():
    _, cameras = recovered(PAPER)
    workspace = Workspace.between(SQUARE, cameras)
    limits = PoseLimits()
    poses = Poses.expected(workspace, limits, 1.0, 2000)
    counts, _, _ = np.histogram2d(*poses.target.T, bins=4, range=[[0, 400]] * 2)
    assert counts.min() > 0.9 * counts.mean()
    assert (poses.tip[:, 2] >= 50.0).all()
    assert (poses.tip[:, 2] <= 250.0).all()
    assert poses.azimuth_deg.min() < -98.0
    assert poses.azimuth_deg.max() > 98.0
    assert np.linalg.norm(poses.direction, axis=1) == pytest.approx(np.ones(len(poses)))


def test_a_workspace_may_be_any_quadrilateral():
    triangle_like = np.array([[0.0, 0.0], [400.0, 0.0], [210.0, 400.0], [190.0, 400.0]])
    _, cameras = recovered(PAPER)
    workspace = Workspace.between(triangle_like, cameras)
    assert workspace.contains(np.array([[200.0, 300.0], [20.0, 300.0]])).tolist() == [True, False]
    middles, side = workspace.cells(8)
    assert side == 50.0
    assert 0 < len(middles) < 64
    assert len(Poses.expected(workspace, PoseLimits(), 1.0, 300)) == pytest.approx(300, abs=40)


# --- forecasts -------------------------------------------------------------------------------


@pytest.mark.parametrize("placement", [PAPER, WIDE, LOW], ids=["paper", "wide", "low"])
def test_the_prediction_equals_the_bound_of_the_simulated_rig(placement):
    """The prediction uses homographies only, the bound true cameras and outlines."""
    rod = RodAndProng(prong_length_mm=0)
    rig, cameras = recovered(placement)
    sampler, rng = PoseSampler(rig), np.random.default_rng(SEED)
    drawn = [sampler.draw(rng, device=rod) for _ in range(30)]
    poses = Poses(
        np.array([pose.indicated_mm for pose in drawn]),
        np.zeros(len(drawn)),
        np.array([pose.tip_mm for pose in drawn]),
        np.array([pose.direction for pose in drawn]),
    )
    options = AdviceOptions(efficiency=1.0, reference_sigma_px=0.1, pointing=DEFAULT_OPTIONS)
    forecast = predict(poses, cameras, SQUARE, options, 1.0)
    exact = [view_of(px, sigma_px=0.1) for px in rig.reference_points_px]
    information = edge_information(80, 2, 1)
    compared = 0
    for k, pose in enumerate(drawn):
        if forecast.doubt[k] is not None:
            assert forecast.doubt[k] is Doubt.OUT_OF_VIEW  # with a border for the widest finger
            continue
        bounds = [
            line_bound(camera, rod.body, pose, finger_truth(camera, rod.body, pose), information)
            for camera in rig.cameras
        ]
        bound = point_bound(exact, bounds)
        assert np.trace(forecast.covariance[k]) == pytest.approx(np.trace(bound), rel=0.02)
        compared += 1
    assert compared > 20


def test_the_error_radius_is_the_quantile_of_drawn_errors():
    rng = np.random.default_rng(SEED)
    covariance = np.array([[[4.0, 1.5], [1.5, 1.0]], [[0.1, 0.0], [0.0, 9.0]]])
    errors = [np.hypot(*rng.multivariate_normal([0, 0], each, 200_000).T) for each in covariance]
    drawn = np.concatenate(errors)
    for probability in (0.5, 0.95):
        radius = error_radius(covariance, probability)
        assert radius == pytest.approx(np.quantile(drawn, probability), rel=0.01)
    assert error_radius(np.eye(2)[None], 0.95) == pytest.approx(math.sqrt(5.991), rel=1e-3)
    assert error_radius(np.zeros((1, 2, 2)), 0.95) == 0.0
    assert math.isnan(error_radius(np.empty((0, 2, 2)), 0.95))


@pytest.fixture(scope="module")
def one_pose():
    _, cameras = recovered(PAPER)
    workspace = Workspace.between(SQUARE, cameras)

    def forecast(azimuth, slant, hover=100.0, **options):
        poses = Poses.pointing(
            workspace,
            np.array([[200.0, 200.0]]),
            np.array([azimuth]),
            np.array([slant]),
            np.array([hover]),
        )
        return predict(poses, cameras, SQUARE, AdviceOptions(**options), 1.0)

    return forecast


@pytest.mark.parametrize(
    ("azimuth", "slant", "hover", "options", "doubt"),
    [
        (0.0, 45.0, 100.0, {}, None),
        (0.0, 45.0, 900.0, {}, Doubt.OUT_OF_VIEW),
        (180.0, 42.0, 60.0, {}, Doubt.END_ON),  # away from the cameras, along their rays
        (126.2, 28.7, 60.0, {}, Doubt.COPLANAR),
        (0.0, 45.0, 100.0, {"length_mm": 12.0, "diameter_mm": 4.0}, Doubt.TOO_SHORT),
    ],
)
def test_a_pose_without_a_point_has_a_reason(one_pose, azimuth, slant, hover, options, doubt):
    assert one_pose(azimuth, slant, hover, **options).doubt[0] is doubt


@pytest.mark.parametrize("azimuth", [0.0, 3.0, 180.0, -180.0])
def test_a_single_azimuth_is_judged_by_its_sector(azimuth):
    options = AdviceOptions(poses=PoseLimits(azimuth_deg=(azimuth, azimuth)), **BRIEF)
    advice = advise(rig_of(PAPER), [SIZE] * 2, options)
    assert advice.expected.poses > 0
    expected = [one.azimuth_deg for one in advice.directions if one.expected]
    assert [abs(math.remainder(each - azimuth, 360.0)) <= 5.0 for each in expected] == [True]
    assert "nan" not in "\n".join(advice.table())


@pytest.mark.parametrize("azimuth", [(-60.0, 60.0), (-180.0, 180.0), (20.0, 50.0)])
def test_expected_directions_are_those_in_the_azimuth_range(azimuth):
    low, high = azimuth
    options = AdviceOptions(poses=PoseLimits(azimuth_deg=azimuth), **BRIEF)
    advice = advise(rig_of(PAPER), [SIZE] * 2, options)
    for direction in advice.directions:
        assert direction.expected == (low <= direction.azimuth_deg <= high)


def test_the_predicted_error_increases_with_every_error_source(one_pose):
    def error(**options):
        return one_pose(30.0, 45.0, **options).figures().rms

    assert error(noise=4.0, pointing=DEFAULT_OPTIONS) > error(noise=2.0, pointing=DEFAULT_OPTIONS)
    assert error(reference_sigma_px=1.0) > error(reference_sigma_px=0.1)
    assert error() > error(pointing=DEFAULT_OPTIONS)
    assert error(length_mm=60.0, pointing=DEFAULT_OPTIONS) > error(
        length_mm=100.0, pointing=DEFAULT_OPTIONS
    )


# --- moves and advice ------------------------------------------------------------------------


def test_a_moved_camera_keeps_the_workspace_centred():
    _, cameras = recovered(PAPER)
    workspace = Workspace.between(SQUARE, cameras)
    poses = Poses.expected(workspace, PoseLimits(), 1.0, 8)
    _, moves = try_moves(poses, cameras, workspace, SQUARE, AdviceOptions(), 1.0)
    middle = np.array([200.0, 200.0, 0.0])
    for move in moves:
        before, after = cameras[move.view], move.camera
        assert after.project(middle) == pytest.approx(
            before.project(middle), abs=1e-6 + 0.6 * (move.way is Way.ZOOM)
        )
        rotation = after.camera_from_plane[:, :3]
        assert rotation @ rotation.T == pytest.approx(np.eye(3), abs=1e-9)
        stood, stands = (Bearings.of(camera, workspace) for camera in (before, after))
        turned = math.remainder(stands.azimuth_deg - stood.azimuth_deg, 360.0)
        expected = {
            Way.TURN: (move.amount, 0.0, 1.0),
            Way.RAISE: (0.0, move.amount, 1.0),
            Way.DISTANCE: (0.0, 0.0, move.amount),
            Way.ZOOM: (0.0, 0.0, 1.0),
        }[move.way]
        assert (
            turned,
            stands.elevation_deg - stood.elevation_deg,
            stands.distance / stood.distance,
        ) == pytest.approx(expected, abs=1e-6)


@pytest.fixture(scope="module")
def narrow():
    return advise(
        rig_of(Placement(azimuths_deg=(-5.0, 5.0))), [SIZE] * 2, AdviceOptions(cells=3, samples=100)
    )


def test_cameras_side_by_side_are_advised_to_move_apart(narrow):
    assert {Concern.VERGENCE, Concern.COPLANAR} <= {flag.concern for flag in narrow.flags}
    move = narrow.recommended
    assert move is not None
    assert move.way is Way.TURN
    assert (move.amount > 0.0) == (narrow.views[move.view].name == "right")  # outwards
    assert move.after.percentile_95 < 0.5 * move.before.percentile_95
    assert "constraint lines meet at" in narrow.recommendation


def test_a_recommended_move_gives_the_predicted_improvement(narrow):
    """Advice on the rig after the move predicts the error that was predicted for the move."""
    move = narrow.recommended
    azimuths = [-5.0, 5.0]
    azimuths[move.view] += move.amount
    moved = rig_of(
        Placement(
            azimuths_deg=tuple(azimuths),
            f_px=SimulatedRig(Placement(azimuths_deg=(-5.0, 5.0))).cameras[0].f_px,
        )
    )
    better = advise(moved, [SIZE] * 2, AdviceOptions(cells=3, samples=100))
    assert better.expected.rms == pytest.approx(move.after.rms, rel=0.15)


def test_pointing_away_from_the_cameras_is_hopeless():
    apart = rig_of(Placement(azimuths_deg=(-10.0, 10.0)))
    directions = advise(apart, [SIZE] * 2, AdviceOptions(cells=3, samples=100)).directions
    away = [d for d in directions if abs(d.azimuth_deg) >= 150.0]
    assert len(away) == 7
    assert all(direction.hopeless and not direction.expected for direction in away)
    ahead = next(d for d in directions if d.azimuth_deg == 0.0)
    assert ahead.expected
    assert not ahead.hopeless


def test_coincident_cameras_are_reported_without_an_error_figure():
    advice = advise(rig_of(Placement(azimuths_deg=(-0.3, 0.3))), [SIZE] * 2, AdviceOptions(**BRIEF))
    assert advice.expected.hopeless == 1.0
    assert advice.as_dict()["expected"]["rms"] is None
    assert "below unknown, then" in advice.recommendation
    assert "nan" not in "\n".join(advice.table())


def test_no_move_is_recommended_for_hands_outside_every_image():
    options = AdviceOptions(**BRIEF, poses=PoseLimits(hover_mm=(900.0, 1000.0)))
    advice = advise(rig_of(PAPER), [SIZE] * 2, options)
    assert advice.expected.in_view == 0.0
    assert advice.recommendation.startswith("no move of one camera alone is enough")


def test_error_shares_sum_to_one():
    advice = advise(rig_of(PAPER), [SIZE] * 2, AdviceOptions(**BRIEF))
    assert sum(advice.shares.values()) == pytest.approx(1.0)
    assert advice.shares["bias"] > 0.5  # the default options are those of a bare hand
    rod = advise(
        rig_of(PAPER),
        [SIZE] * 2,
        AdviceOptions(**BRIEF, pointing=DEFAULT_OPTIONS, reference_sigma_px=1.0),
    )
    assert rod.shares["bias"] == 0.0
    assert Concern.REFERENCE_ERROR in {flag.concern for flag in rod.flags}


def test_results_scale_with_the_unit():
    options = AdviceOptions(**BRIEF)
    in_mm = advise(rig_of(PAPER), [SIZE] * 2, options).expected.rms
    in_m = advise(rig_of(PAPER, unit="m", plane=SQUARE / 1000.0), [SIZE] * 2, options).expected.rms
    assert in_m == pytest.approx(in_mm / 1000.0, rel=1e-3)


def test_weak_reference_points_are_distinguished_from_strong_ones():
    px = SimulatedRig(PAPER).reference_points_px[0]
    strong = reference_weakness(view_of(px), 0.5, SQUARE)
    plane = np.array([[0.0, 0.0], [400.0, 0.0], [400.0, 30.0], [190.0, 25.0]])
    T = view_of(px).image_from_plane
    image = cv2.perspectiveTransform(plane[None], T)[0]
    weak = reference_weakness(view_of(image, plane=plane), 0.5, plane)
    assert strong < 1.0
    assert weak > 2.0


@pytest.mark.parametrize(
    ("rig", "sizes", "words"),
    [
        (rig_of(PAPER, unit="mat"), [SIZE] * 2, 'plane.unit is "mat"'),
        (rig_of(PAPER), [SIZE], "1 sizes_px for 2 views"),
        (rig_of(Placement(azimuths_deg=(0.0,))), [SIZE], "needs two or more"),
        (rig_of(WIDE, plane=SQUARE * [1.0, 0.7]), [SIZE] * 2, "to scale in both directions"),
    ],
)
def test_rigs_that_cannot_be_judged_are_refused(rig, sizes, words):
    with pytest.raises(InvalidInputError, match=words):
        advise(rig, sizes)


def test_views_of_opposite_orientation_are_refused():
    simulated = rig_of(PAPER)
    flipped = View(
        name="right",
        source="right.mp4",
        reference_points_px=tuple(simulated.views[1].reference_points_px[k] for k in (0, 3, 2, 1)),
    )
    rig = Rig(plane=simulated.plane, views=(simulated.views[0], flipped))
    with pytest.raises(InvalidInputError, match="left anticlockwise, right clockwise"):
        advise(rig, [SIZE] * 2)


@pytest.mark.parametrize(
    "wrong",
    [
        {"efficiency": 0.0},
        {"contrast": -3.0},
        {"noise": math.nan},
        {"cells": 1},
        {"diameter_mm": 90.0},
        {"unit_mm": 0.0},
        {"unit_mm": math.inf},
        {"noise": math.inf},
        {"contrast": 1e300},
        {"reference_sigma_px": 1e-300},
        {"length_mm": math.inf},
    ],
)
def test_options_out_of_range_are_refused(wrong):
    (name,) = wrong
    with pytest.raises(InvalidInputError, match=name):
        AdviceOptions(**wrong)


def test_the_prediction_agrees_with_the_experiment():
    """Compare the tracker's error on rendered images with the prediction from homographies."""
    advice = advise(
        rig_of(PAPER),
        [SIZE] * 2,
        AdviceOptions(**BRIEF, pointing=PointingOptions(), reference_sigma_px=0.1),
    )
    measured = run_experiment(ExperimentOptions(targets=12, seed=SEED), workers=1).summary.points
    assert 0.6 < advice.expected.median / measured.median < 1.7


# --- command line and picture ----------------------------------------------------------------


def test_the_command_prints_json_and_draws_a_picture(tmp_path):
    rig_file, picture = tmp_path / "rig.toml", tmp_path / "advice.png"
    rig_of(PAPER).save(rig_file)
    arguments = ["advise", str(rig_file), "--size", "640", "480", "--json", "--device", "rod"]
    arguments += ["--azimuth", "-60", "60", "--draw", str(picture)]
    done = CliRunner().invoke(main, arguments)
    assert done.exit_code == 0, done.output
    printed = json.loads(done.stdout)
    assert len(printed["directions"]) == 36
    assert sum(direction["expected"] for direction in printed["directions"]) == 13
    assert printed["moves"][0]["typical_error"] <= printed["moves"][-1]["typical_error"]
    assert [view["name"] for view in printed["views"]] == ["left", "right"]
    image = cv2.imread(str(picture))
    assert image.shape[1] == 1728
    assert len(np.unique(image.reshape(-1, 3), axis=0)) > 50


def test_the_table_lists_the_moves_and_ends_with_the_advice(narrow):
    lines = narrow.table()
    assert sum(line.lstrip().startswith(("+", "-")) for line in lines) >= 35
    assert any("as they stand" in line for line in lines)
    assert lines[-1] == f"advice: {narrow.recommendation}"


def test_a_picture_that_cannot_be_written_is_refused(narrow, tmp_path):
    with pytest.raises(InvalidInputError, match=r"advice\.what"):
        narrow.draw(tmp_path / "advice.what")
    with pytest.raises(InvalidInputError, match="existing folder"):
        narrow.draw(tmp_path / "missing" / "advice.png")


def test_without_a_size_the_sources_are_opened(tmp_path):
    rig_file = tmp_path / "rig.toml"
    rig_of(PAPER).save(rig_file)
    done = CliRunner().invoke(main, ["advise", str(rig_file)])
    assert done.exit_code == 2
    assert "no such file" in done.output


def test_a_lens_is_used(tmp_path):
    placement = Placement(distance_m=0.75, f_px=622.0, k1=(-0.2,))
    simulated = SimulatedRig(placement)
    bare = rig_of(placement)
    cx, cy = simulated.cameras[0].principal_point_px.tolist()
    lens = LensParameters(fx=622.0, fy=622.0, cx=cx, cy=cy, k1=-0.2)
    views = tuple(
        View(
            name=v.name,
            source=v.source,
            reference_points_px=v.reference_points_px,
            lens_parameters=lens,
        )
        for v in bare.views
    )
    advice = advise(Rig(plane=bare.plane, views=views), [SIZE] * 2, AdviceOptions(**BRIEF))
    centre = advice.views[0].camera.centre
    assert centre == pytest.approx(simulated.cameras[0].centre_mm, abs=0.5)
