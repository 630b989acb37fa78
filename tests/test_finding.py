"""Detection of the hand in footage with known truth, and rejection of objects that are no hand."""

import csv
import dataclasses
import math
from contextlib import ExitStack
from itertools import chain, islice, pairwise, repeat
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import scipy.stats
from msgspec.structs import replace

import fingerpost as fp
from fingerpost._core import Background as LearnedBackground
from fingerpost._core import HandFinder, StartPose
from fingerpost.capture import Frame, open_source, read_views
from fingerpost.config import Rig, Start, View
from fingerpost.errors import InvalidInputError
from fingerpost.finding import (
    FingerDetection,
    HandSearch,
    HandView,
    PairTests,
    Viewpoint,
    are_one,
    are_two,
    can_be_one,
    compare_lengths,
    compare_widths,
    first_hand,
    flatness,
    measured_line,
    other_fingers,
    pair_scores,
    rays_of_tips,
    width_ratio,
)
from fingerpost.finding.body import Body
from fingerpost.finding.finger import (
    HALF_WIDTH,
    AxisCorrection,
    LastSeen,
    followed,
    sigma_from_width_ratio,
)
from fingerpost.finding.first_hand import FirstHand
from fingerpost.finding.flanks import Flanks, ShadingFit, sigma_from_blur_asymmetry
from fingerpost.finding.foreground import any_foreground
from fingerpost.finding.length import TemplateExtension
from fingerpost.finding.pairs import TIP_POWER, foreshortenings, reaches_farther, same_tip
from fingerpost.finding.pixel_tests import blur_asymmetry, widening
from fingerpost.finding.trial import STRIPE_FRAMES, Trial, pair_rank
from fingerpost.finding.views import (
    TriedPair,
    is_behind,
    movers,
    ranked_pairs,
    stand_beside_mover,
)
from fingerpost.pipeline import Pointer
from fingerpost.pointing import FingerLine, PlaneView, Status
from fingerpost.silhouette import Capsule, Silhouette
from fingerpost.simulate import (
    Background,
    Camera,
    DevicePose,
    Hand,
    LightChange,
    Lighting,
    Placement,
    PoseSampler,
    RodAndProng,
    Sensor,
    SimulatedRig,
    Trajectory,
    write_recording,
)
from fingerpost.simulated_rig_file import rig_from_simulation

FPS = 20.0
SEED = 11
# Greatest median error of a found hand; the tracker itself is tested elsewhere.
ACCURACY_MM = 6.0
# Frames in which a template grows to its finger's length: two lengths, each tried for one frame.
GROWN_WITHIN = 4
# Frames after which a view whose finger is static while the hand moves is rejected.
LET_GO_WITHIN = 11
# Greatest number of frames from the hand's full entry, or its return, to the first point.
FOUND_WITHIN = 10

OVER_THE_TABLE = DevicePose.pointing_at(
    (170.0, 190.0), azimuth_deg=20.0, slant_deg=50.0, hover_mm=120.0
)
NEXT_TO_IT = DevicePose.pointing_at(
    (260.0, 230.0), azimuth_deg=35.0, slant_deg=45.0, hover_mm=100.0
)
AWAY = OVER_THE_TABLE.retreated(700.0)


def visit() -> Trajectory:
    """Empty table; a hand enters, moves, leaves, and returns at another place."""
    back = NEXT_TO_IT.retreated(700.0)
    return (
        Trajectory.hold(AWAY, 0.4)
        .then(Trajectory.through([AWAY, OVER_THE_TABLE], 1.2))
        .then(Trajectory.hold(OVER_THE_TABLE, 0.4))
        .then(Trajectory.through([OVER_THE_TABLE, NEXT_TO_IT], 0.3))
        .then(Trajectory.through([NEXT_TO_IT, back], 1.2))
        .then(Trajectory.hold(back, 0.3))
        .then(Trajectory.through([back, NEXT_TO_IT], 1.2))
        .then(Trajectory.hold(NEXT_TO_IT, 0.5))
    )


def played(
    rig: SimulatedRig, motion: Trajectory, frames: int, start: Start | None = None
) -> tuple[list, list]:
    """Return a pointer's steps and the ground truth; `start` is the start pose of all views."""
    without = rig_from_simulation(rig)
    views = tuple(replace(view, start=start) for view in without.views)
    pointer, rng = Pointer(replace(without, views=views)), np.random.default_rng(SEED)
    steps, truth = [], []
    for k in range(frames):
        shot = rig.render(motion, time_s=k / FPS, rng=rng)
        steps += pointer.update([Frame(k, k / FPS, image) for image in shot.images])
        truth.append(shot.truth)
    return steps, truth


def entries(truth: list) -> list[int]:
    """Frames at which the whole finger enters, in all views."""
    seen = [all(v.finger is not None and v.finger.in_view for v in t.views) for t in truth]
    return [k for k in range(1, len(seen)) if seen[k] and not seen[k - 1]]


SCENES = {
    "plain": SimulatedRig(sensor=Sensor(cells_per_sigma=2)),
    "wood and a sheet, in colour": SimulatedRig(
        background=Background(texture="wood", sheet=70.0),
        lighting=Lighting(shadow=0.4),
        sensor=Sensor(channels="bgr", cells_per_sigma=2),
    ),
    "a dark finger": SimulatedRig(
        background=Background(level=150.0),
        lighting=Lighting(contrast=-80.0),
        sensor=Sensor(cells_per_sigma=2),
    ),
    "a hand of a few pixels": SimulatedRig(
        Placement(width_px=320, height_px=240),
        device=Hand(),
        background=Background(clutter=20.0),
        sensor=Sensor(cells_per_sigma=2),
    ),
    "the light drops while it is away": SimulatedRig(
        background=Background(texture="wood"),
        lighting=Lighting(change=LightChange(start_s=2.1, gain=0.6)),
        sensor=Sensor(cells_per_sigma=2),
    ),
}


@pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES.keys())
def test_a_hand_is_found_when_it_enters_and_when_it_returns(scene):
    motion = visit()
    steps, truth = played(scene, motion, int(motion.duration_s * FPS))
    came = entries(truth)
    assert len(came) == 2
    # A point without a hand would be a false detection.
    quiet = [s for s in steps[: came[0] - 4] if s.fix.status is not Status.ACQUIRING]
    assert quiet == []
    for first in came:
        found = [s.index for s in steps[first:] if s.fix.point is not None]
        assert found, f"the hand that came in frame {first} is not found"
        assert found[0] - first <= FOUND_WITHIN
    errors_mm = [
        np.hypot(*(step.fix.point - t.indicated_mm))
        for step, t in zip(steps, truth, strict=True)
        if step.fix.point is not None
    ]
    assert np.median(errors_mm) < ACCURACY_MM
    # Between its visits the status is lost, not acquiring.
    gone = next(s for s in steps[came[0] : came[1]][::-1] if s.fix.point is None)
    assert gone.fix.status is Status.LOST


@pytest.mark.parametrize("tip_px", [(80.0, 120.0), (560.0, 420.0)])
def test_a_hand_that_enters_away_from_the_initial_template_is_found(tip_px):
    motion = visit()
    start = Start(tip_px=tip_px, angle_deg=90.0, length_px=60.0, thumb="left")
    scene = SCENES["wood and a sheet, in colour"]
    steps, truth = played(scene, motion, int(motion.duration_s * FPS), start)
    came = entries(truth)
    assert all(s.fix.status is Status.ACQUIRING for s in steps[: came[0] - 4])
    found = [s for s in steps[came[0] :] if s.fix.point is not None]
    assert found[0].index - came[0] <= FOUND_WITHIN
    errors_mm = [np.hypot(*(s.fix.point - truth[s.index].indicated_mm)) for s in found]
    assert np.median(errors_mm) < ACCURACY_MM


def test_a_static_finger_is_rejected_while_the_hand_moves_in_the_other_view():
    far = DevicePose.pointing_at((330.0, 300.0), azimuth_deg=35.0, slant_deg=45.0, hover_mm=100.0)
    motion = (
        Trajectory.hold(AWAY, 0.4)
        .then(Trajectory.through([AWAY, OVER_THE_TABLE], 1.2))
        .then(Trajectory.hold(OVER_THE_TABLE, 0.8))
        .then(Trajectory.through([OVER_THE_TABLE, far], 0.25))
    )
    rig, rng = SCENES["wood and a sheet, in colour"], np.random.default_rng(SEED)
    pointer, stuck, points = Pointer(rig_from_simulation(rig)), None, []
    stuck_from, frames = 40, int(motion.duration_s * FPS)
    for k in range(frames):
        left, right = rig.render(motion, time_s=k / FPS, rng=rng).images
        if k >= stuck_from:
            stuck = right = right if stuck is None else stuck
        fed = [Frame(k, k / FPS, image) for image in (left, right)]
        points += [step.fix.point is not None for step in pointer.update(fed)]
    assert frames > stuck_from + LET_GO_WITHIN + 3
    assert all(points[stuck_from - 5 : stuck_from])
    assert not any(points[stuck_from + LET_GO_WITHIN :])


@pytest.mark.parametrize("scene", ["plain", "a hand of a few pixels"])
def test_a_hand_may_have_come_while_the_background_is_unknown_or_covered(scene):
    rig, rng = SCENES[scene], np.random.default_rng(SEED)
    behind = LearnedBackground()
    for k in range(30):
        table = Frame(k, k / FPS, rig.render(AWAY, rng=rng).images[0])
        behind.look(table.grey(), table.colour())
        assert any_foreground(behind, table, Body.none()) is not behind.is_known
        behind.learn(table.grey(), table.colour())
    assert behind.is_known
    hand = Frame(30, 30 / FPS, rig.render(OVER_THE_TABLE, rng=rng).images[0])
    behind.look(hand.grey(), hand.colour())
    assert any_foreground(behind, hand, Body.none())
    everywhere = Silhouette(np.array([[320.0, 240.0]]), np.array([500.0]))
    assert not any_foreground(behind, hand, Body(everywhere))  # it may be the arm


@pytest.mark.parametrize("view", [0, 1])
def test_a_finger_that_moves_along_a_viewing_ray_is_not_rejected(view):
    rig = SCENES["plain"]
    camera, other = rig.cameras[view], rig.cameras[1 - view]
    tip_mm = np.array(OVER_THE_TABLE.tip_mm)
    towards_mm = camera.centre_mm - tip_mm
    near_mm = tip_mm + 80.0 * towards_mm / np.linalg.norm(towards_mm)
    near = dataclasses.replace(OVER_THE_TABLE, tip_mm=tuple(near_mm.tolist()))
    motion = (
        Trajectory.through([AWAY, OVER_THE_TABLE], 1.2)
        .then(Trajectory.hold(OVER_THE_TABLE, 0.8))
        .then(Trajectory.through([OVER_THE_TABLE, near], 0.4))
        .then(Trajectory.hold(near, 0.3))
    )
    steps, _ = played(rig, motion, int(motion.duration_s * FPS))
    ends_mm = np.array([tip_mm, near_mm])
    moved_px = [np.linalg.norm(np.ptp(seen.project(ends_mm), axis=0)) for seen in (camera, other)]
    assert moved_px[0] < 1.0 < 25.0 < moved_px[1]
    moves_from = int(1.9 * FPS)
    assert [s.index for s in steps[moves_from:] if s.fix.point is None] == []


@pytest.mark.parametrize(("towards_camera", "comes"), [(0.0, 0), (0.5, 22)])
def test_a_hand_that_rests_where_an_arm_may_hide_it_is_found_once_the_arm_has_left(
    towards_camera, comes
):
    # The arm's silhouette covers the hand in both views from the first frame on; or, soon after the
    # hand has come, in one view, and in the other one it is in plain sight. In either case for
    # longer than an object that is put down takes to become background.
    rig, rng = SCENES["plain"], np.random.default_rng(SEED)
    table, rest = (
        [rig.render(pose, rng=rng).images for _ in range(4)] for pose in (AWAY, OVER_THE_TABLE)
    )
    tip_mm = np.array(OVER_THE_TABLE.tip_mm)
    before_mm = tip_mm + towards_camera * (rig.cameras[1].centre_mm - tip_mm)
    above_mm = before_mm + np.array([0.0, 0.0, 200.0])
    arm = [Capsule(tuple(before_mm), tuple(above_mm), 150.0)]
    known, left = 20, 20 + LearnedBackground().options["absorb_frames"] + 40
    moving = chain(repeat([], comes), repeat(arm, left - comes), repeat([]))
    pointer = Pointer(rig_from_simulation(rig), moving=lambda: next(moving))
    found = []
    for k in range(left + FOUND_WITHIN):
        images = (table if k < known else rest)[k % 4]
        for step in pointer.update([Frame(k, k / FPS, image) for image in images]):
            found += [k] if step.fix.status is Status.OK else []
    assert left <= min(found)


def test_a_hand_that_the_search_has_found_is_a_newcomer():
    # So it confirms the finger that the initial template follows in another view.
    view = FirstHand(LearnedBackground(), None, lambda: None)
    view.accept_from_search()
    assert view.is_proven
    assert view.is_newcomer


def test_a_newcomer_at_the_template_does_not_replace_a_moving_finger(monkeypatch):
    # It may be the thumb of a hand that has moved past its template.
    for question, answer in (
        ("template_is_foreground", True),
        ("whole_finger_is_foreground", True),
        ("stands_out", False),
    ):
        monkeypatch.setattr(first_hand, question, lambda *_, answer=answer: answer)

    def line(u_px: float, angle_rad: float = 0.0) -> SimpleNamespace:
        return SimpleNamespace(
            tip_px=(u_px, 100.0), anchor_px=(u_px - 30.0, 100.0), angle_rad=angle_rad
        )

    comer = SimpleNamespace(update=lambda *_, **__: SimpleNamespace(finger_line=line(500.0, 1.0)))
    view = FirstHand(LearnedBackground(), None, lambda: comer)
    frame = Frame(0, 0.0, np.zeros((240, 640), np.uint8))

    def seen(u_px: float):
        view.prove(frame, line(u_px))
        return view.confirm(frame, line(u_px), is_supported=False)

    view.prove(frame, line(300.0))
    assert seen(300.0) is None  # a second template waits from here on
    assert [seen(300.0 + 8.0 * k) for k in range(1, 6)] == [None] * 5
    assert comer in [seen(340.0) for _ in range(5)]


@pytest.mark.parametrize(
    ("gone_px", "turned_rad", "is_proven"),
    [
        ((0.0, 40.0), 0.0, True),
        ((0.0, -40.0), 0.0, True),
        ((0.0, 0.0), 0.8, True),
        ((40.0, 0.0), 0.0, False),
        ((-40.0, 5.0), 0.05, False),
        ((0.0, 0.0), 0.0, False),
    ],
)
def test_motion_along_its_own_axis_does_not_prove_a_hand(
    monkeypatch, gone_px, turned_rad, is_proven
):
    # A template at an edge of the table slides along it when a hand covers a part of the edge.
    for question, answer in (("template_is_foreground", False), ("stands_out", True)):
        monkeypatch.setattr(first_hand, question, lambda *_, answer=answer: answer)
    view = FirstHand(LearnedBackground(), None, lambda: None)
    frame = Frame(0, 0.0, np.zeros((240, 640), np.uint8))

    def line(tip_px: tuple[float, float], angle_rad: float) -> SimpleNamespace:
        behind = 30.0 * np.array([np.cos(angle_rad), np.sin(angle_rad)])
        anchor_px = tuple((np.array(tip_px) - behind).tolist())
        return SimpleNamespace(tip_px=tip_px, anchor_px=anchor_px, angle_rad=angle_rad)

    view.prove(frame, line((300.0, 100.0), 0.0))
    assert not view.is_proven
    view.prove(frame, line((300.0 + gone_px[0], 100.0 + gone_px[1]), turned_rad))
    assert view.is_proven is view.has_moved is is_proven


def test_a_hand_present_in_the_first_frame_is_found():
    motion = Trajectory.hold(OVER_THE_TABLE, 0.8).then(
        Trajectory.through([OVER_THE_TABLE, NEXT_TO_IT], 0.2)
    )
    steps, _ = played(SCENES["wood and a sheet, in colour"], motion, 30)
    found = [s.index for s in steps if s.fix.point is not None]
    assert found
    assert found[0] < 25


def test_of_two_hands_the_moving_one_is_followed():
    still_s = 0.8
    first, last, lying = (
        DevicePose.pointing_at(place, azimuth_deg=azimuth, slant_deg=50.0, hover_mm=hover_mm)
        for place, azimuth, hover_mm in (
            ((250.0, 250.0), 20.0, 110.0),
            ((320.0, 180.0), 30.0, 110.0),
            ((110.0, 120.0), 15.0, 60.0),
        )
    )
    motion = Trajectory.hold(first, still_s).then(Trajectory.through([first, last], 0.1))
    motion = motion.then(Trajectory.hold(last, 0.4))
    scene = SimulatedRig(
        device=Hand(),
        background=Background(texture="wood"),
        sensor=Sensor(channels="bgr", cells_per_sigma=2),
    )
    pointer, rng = Pointer(rig_from_simulation(scene)), np.random.default_rng(SEED)
    misses_mm = {}
    for k in range(int(motion.duration_s * FPS)):
        shot = scene.render(motion, time_s=k / FPS, rng=rng, others=[(Hand(), lying)])
        for step in pointer.update([Frame(k, k / FPS, image) for image in shot.images]):
            if step.fix.point is not None:
                misses_mm[k] = np.hypot(*(step.fix.point - shot.truth.indicated_mm))
    # While both are static, either may be the pointing hand.
    assert any(miss > 100.0 for k, miss in misses_mm.items() if k < still_s * FPS)
    decided_by = int((still_s + 0.5) * FPS)
    settled_mm = [miss for k, miss in misses_mm.items() if k >= decided_by]
    assert len(settled_mm) >= 8
    assert max(settled_mm) < 20.0


def test_nothing_is_acquired_on_an_empty_cluttered_table():
    scene = SimulatedRig(
        background=Background(clutter=40.0, texture="wood"), sensor=Sensor(cells_per_sigma=2)
    )
    steps, _ = played(scene, Trajectory.hold(AWAY, 2.0), 30)
    assert {step.fix.status for step in steps} == {Status.ACQUIRING}
    rows = [o.track_row() for step in steps for o in step.observations]
    assert {row.status for row in rows} == {"acquiring"}


def test_a_resting_search_resumes_when_a_hand_enters(monkeypatch):
    monkeypatch.setattr("fingerpost.finding.rest.REST_FRAMES", 20)
    scene, rng = SCENES["a hand of a few pixels"], np.random.default_rng(SEED)
    comes = (
        Trajectory.hold(AWAY, 2.4)
        .then(Trajectory.through([AWAY, OVER_THE_TABLE], 1.2))
        .then(Trajectory.hold(OVER_THE_TABLE, 0.6))
    )
    pointer, candidates, points, truth = Pointer(rig_from_simulation(scene)), [], [], []
    for k in range(int(comes.duration_s * FPS)):
        shot = scene.render(comes, time_s=k / FPS, rng=rng)
        (step,) = pointer.update([Frame(k, k / FPS, image) for image in shot.images])
        candidates.append([view.search.candidates for view in pointer.views])
        points.append(step.fix.point)
        truth.append(shot.truth)
    (came,) = entries(truth)
    for view in range(2):
        is_searched = [now[view] is not before[view] for before, now in pairwise(candidates)]
        assert all(is_searched[:19])
        assert not any(is_searched[38:46])
        assert all(is_searched[came - 1 : came + 2])
    found = next(k for k, point in enumerate(points) if point is not None)
    assert found - came <= FOUND_WITHIN


def test_static_rods_on_the_table_are_not_acquired():
    # Rods without a hand that point at the plane as a finger would.
    rod, rng = RodAndProng(prong_length_mm=0.0), np.random.default_rng(SEED)
    poses = [
        DevicePose.pointing_at(place, azimuth_deg=azimuth, slant_deg=60.0, hover_mm=30.0)
        for place, azimuth in (((120.0, 130.0), 40.0), ((280.0, 240.0), -70.0))
    ]
    scene = SCENES["plain"]
    pointer = Pointer(rig_from_simulation(scene))
    for k in range(25):
        shot = scene.render(None, rng=rng, others=[(rod, pose) for pose in poses])
        frames = [Frame(k, k / FPS, image) for image in shot.images]
        assert [s.fix.status for s in pointer.update(frames)] == [Status.ACQUIRING]


def test_the_same_frames_give_the_same_bits_twice(tmp_path: Path):
    motion = Trajectory.through([AWAY, OVER_THE_TABLE], 1.2).then(
        Trajectory.hold(OVER_THE_TABLE, 0.3)
    )
    frames = int(motion.duration_s * FPS)
    rig_file = write_recording(
        tmp_path, SCENES["plain"], motion, frames=frames, fps=FPS, rng=SEED, start_time_s=None
    )
    rig = Rig.load(rig_file)
    assert all(view.start is None for view in rig.views)
    once, again = (
        [(fix.status, None if fix.point is None else fix.point.tobytes()) for fix in fp.track(rig)]
        for _ in range(2)
    )
    assert once == again
    with (tmp_path / "truth.csv").open(newline="") as file:
        truth = [
            [float(row[c]) for c in "xy"] if row["x"] else None for row in csv.DictReader(file)
        ]
    last = list(fp.track(rig))[-1]
    assert np.hypot(*np.subtract(last.point, truth[-1])) < ACCURACY_MM


# --- fingers of two views that may be the same -----------------------------------------------


def viewpoints(rig: SimulatedRig) -> tuple[Viewpoint, Viewpoint]:
    made = [
        Viewpoint.of(
            PlaneView.from_reference_points(rig.plane_points, points, None),
            (camera.width_px, camera.height_px),
        )
        for camera, points in zip(rig.cameras, rig.reference_points_px, strict=True)
    ]
    return made[0], made[1]


def detections(rig: SimulatedRig, pose: DevicePose) -> list[FingerDetection]:
    """Return each view's detection of the finger at a pose."""
    seen = []
    for view in rig.truth(pose, time_s=0.0).views:
        start = view.finger.start()
        seen.append(FingerDetection(tuple(start.tip_px), np.radians(start.angle_deg), 7.0))
    return seen


def score(rig: SimulatedRig, first: FingerDetection, second: FingerDetection) -> float:
    return float(pair_scores(viewpoints(rig), ([first], [second]))[0, 0])


def test_coincident_cameras_are_scored_without_a_warning():
    # Parallel rays, and rays that meet in the camera centre.
    here, _ = viewpoints(SimulatedRig())
    rng = np.random.default_rng(0)
    tips = rng.uniform((20, 20), (620, 460), (60, 2))
    first, second = (
        [
            FingerDetection((u + off, v), 0.1 * k, 6.0, length=9.0)
            for k, (u, v) in enumerate(tips.tolist())
        ]
        for off in (0.0, 1e-7)
    )
    scores = pair_scores((here, here), (first, second))
    assert ((scores >= 0.0) & (scores <= 1.0)).all()
    assert (np.diag(scores) == 0.0).all()


def test_the_camera_centre_follows_from_the_homography():
    rig = SimulatedRig()
    for viewpoint, camera in zip(viewpoints(rig), rig.cameras, strict=True):
        # Exact, because the principal point is the image centre.
        np.testing.assert_allclose(viewpoint.centre, camera.centre_mm, rtol=1e-3, atol=1.0)


def test_pairs_of_one_finger_score_high_and_others_seldom():
    rig = SimulatedRig()
    sampler, rng = PoseSampler(rig), np.random.default_rng(SEED)
    fingers = [detections(rig, sampler.draw(rng)) for _ in range(30)]
    left, right = ([views[k] for views in fingers] for k in (0, 1))
    scores = pair_scores(viewpoints(rig), (left, right))
    same = np.eye(len(fingers), dtype=bool)
    assert np.mean(scores[same] > 0.5) > 0.9
    # Tips near one epipolar plane cannot be distinguished by two views.
    assert np.mean(scores[~same] > 0.5) < 0.4


def test_different_tips_score_zero():
    rig = SimulatedRig()
    one, other = detections(rig, OVER_THE_TABLE)
    # The tip moves along its line, so the lines alone still give a point.
    back_px = 110.0 * np.array([np.cos(other.angle_rad), np.sin(other.angle_rad)])
    slid = other._replace(tip_px=tuple(np.subtract(other.tip_px, back_px)))
    assert score(rig, one, other) > 0.5
    assert score(rig, one, slid) == 0.0


def test_the_score_falls_as_the_tips_disagree():
    rig = SimulatedRig()
    one, other = detections(rig, OVER_THE_TABLE)
    ahead = np.array([np.cos(other.angle_rad), np.sin(other.angle_rad)])
    scores = []
    for back_px in (0.0, 5.0, 20.0, 30.0, 40.0):
        # The tip moves along its line, so the indicated point stays.
        slid = other._replace(tip_px=tuple(np.subtract(other.tip_px, back_px * ahead)))
        tip = same_tip(viewpoints(rig), (one, slid))
        scores.append((tip, score(rig, one, slid) / score(rig, one, other)))
    assert scores == sorted(scores, reverse=True)
    # Near-certain agreement is hardly penalised, a marginal one strongly.
    assert scores[1][0] > 0.99
    assert scores[1][1] > 0.9
    assert scores[3][0] > 0.9
    assert scores[3][1] < 0.4


@pytest.mark.parametrize("azimuth_deg", [15.0, 45.0])
@pytest.mark.parametrize("k1", [0.0, -0.3])
def test_inaccurate_reference_points_and_lens_reduce_the_tip_score_little(k1, azimuth_deg):
    """Reference points with 3 px of noise, and a close webcam with an uncorrected lens."""
    rig = SimulatedRig(
        Placement(0.75, azimuths_deg=(-azimuth_deg, azimuth_deg), f_px=622.0, k1=(k1,))
    )
    sampler, rng = PoseSampler(rig), np.random.default_rng(SEED)
    factors = []
    for _ in range(40):
        views = tuple(
            Viewpoint.of(
                PlaneView.from_reference_points(
                    rig.plane_points, points + rng.normal(0.0, 3.0, (4, 2)), None
                ),
                (camera.width_px, camera.height_px),
            )
            for camera, points in zip(rig.cameras, rig.reference_points_px, strict=True)
        )
        fingers = [detections(rig, sampler.draw(rng)) for _ in range(5)]
        factors += [same_tip(views, tuple(finger)) ** TIP_POWER for finger in fingers]
    assert np.quantile(factors, 0.05) > 0.75
    assert np.median(factors) > 0.9


def test_a_change_of_direction_becomes_likelier_with_the_time_since_the_loss():
    lost = LastSeen(3.0, time_s=2.0)
    assert lost.direction_likelihood(3.0, 2.0) == 1.0
    # Across the discontinuity at ±π.
    assert lost.direction_likelihood(3.5 - 2.0 * math.pi, 2.0) == pytest.approx(math.exp(-0.5))
    assert lost.direction_likelihood(3.0 + 2.0, 2.1) < 0.02
    assert lost.direction_likelihood(3.0 + 2.0, 3.0) > 0.6


def test_a_stick_flat_on_the_table_scores_zero():
    rig = SimulatedRig()
    ends = np.array([[100.0, 120.0], [180.0, 150.0]])
    seen = []
    for viewpoint in viewpoints(rig):
        back, tip = viewpoint.plane_view.project(ends)
        angle = float(np.arctan2(*(tip - back)[::-1]))
        seen.append(FingerDetection(tuple(tip), angle, 7.0))
    # Its constraint lines coincide, or differ by the measurement error only.
    assert score(rig, *seen) == 0.0
    turned = seen[1]._replace(angle_rad=seen[1].angle_rad + 0.03)
    assert score(rig, seen[0], turned) == 0.0


def test_the_table_pattern_is_flat_and_a_finger_is_not():
    rig = SimulatedRig(
        background=Background(clutter=50.0), sensor=Sensor(noise=3.0, cells_per_sigma=2)
    )
    greys = tuple(rig.render(OVER_THE_TABLE, time_s=0.0, rng=SEED).images)
    views = tuple(viewpoint.plane_view for viewpoint in viewpoints(rig))
    table = rig.render(AWAY, time_s=0.0, rng=SEED).images
    shapes = [
        FingerDetection(c.start.tip_px, c.start.angle_rad, c.half_width_px)
        for c in HandFinder().find(table[0])
    ]
    assert len(shapes) > 5
    hand = detections(rig, OVER_THE_TABLE)
    assert np.mean(flatness(views, tuple(table), shapes) > 0.5) > 0.6
    assert flatness(views, greys, hand[:1])[0] < 0.2
    assert flatness(views[::-1], greys[::-1], hand[1:])[0] < 0.2
    outside = [FingerDetection((-500.0, -500.0), 0.0, 7.0)]
    assert flatness(views, greys, outside).tolist() == [0.0]


def test_a_finger_that_points_away_from_the_plane_scores_zero():
    rig = SimulatedRig()
    one, other = (
        finger._replace(angle_rad=finger.angle_rad + np.pi)
        for finger in detections(rig, OVER_THE_TABLE)
    )
    assert score(rig, one, other) == 0.0


def test_fingers_of_different_width_colour_or_foreground_score_less():
    rig = SimulatedRig()
    one, other = detections(rig, OVER_THE_TABLE)
    usual = score(rig, one, other)
    assert score(rig, one._replace(half_width_px=14.0), other) < 0.6 * usual
    assert score(rig, one._replace(score=0.5), other) == pytest.approx(0.5 * usual)
    came, stood = one._replace(foreground=1.0), other._replace(foreground=0.0)
    assert score(rig, came, stood) < 0.5 * usual
    assert score(rig, came, other) == pytest.approx(usual)
    red, blue = (30.0, 30.0, 200.0), (200.0, 30.0, 30.0)
    assert score(rig, one._replace(colour=red), other._replace(colour=red)) == pytest.approx(usual)
    assert score(rig, one._replace(colour=red), other._replace(colour=blue)) < 0.3 * usual


def test_a_view_without_fingers_gives_no_pairs():
    rig = SimulatedRig()
    assert pair_scores(viewpoints(rig), ([], detections(rig, OVER_THE_TABLE))).shape == (0, 2)


def tried_out(rig: SimulatedRig, known_length: float | None = None) -> tuple:
    """Return a search, the trial of its best candidate, and the first view's image.

    `known_length` is the length of the template that followed the finger before its loss, if any.
    """
    motion = Trajectory.hold(OVER_THE_TABLE, 0.1)
    image = rig.render(motion, time_s=0.0, rng=np.random.default_rng(SEED)).images[0]
    search, frame = HandSearch(), Frame(0, 0.0, image)
    if known_length is not None:
        search.remember_length(known_length)
    search.update(frame)
    search.score_trials(frame, np.zeros(len(search.candidates)), np.zeros(0))
    assert search.start_trial(search.candidates[0], frame)
    (trial,) = search.trials
    return search, trial, image


def follow_with_short_template(trial, image: np.ndarray, half_widths: float) -> None:
    """Replace the trial's template by a short one on the same finger."""
    line = trial.track.finger_line
    short = fp.StartPose(line.tip_px, line.angle_rad, half_widths * trial.half_width_px)
    trial.tracker = fp.ContourTracker.at_hand(
        fp.Template.pistol("none"), short, {"acquire": {"settle_frames": 1}}
    )
    trial.track = trial.tracker.update(image, 0.0)


def covered_behind_the_tip(trial, image: np.ndarray, half_widths: float) -> Frame:
    """The image with the trial's finger occluded from `half_widths` behind its tip on."""
    line = trial.track.finger_line
    ahead = np.array([np.cos(line.angle_rad), np.sin(line.angle_rad)])
    v, u = np.indices(image.shape)
    behind_px = np.stack([line.tip_px[0] - u, line.tip_px[1] - v], axis=-1) @ ahead
    is_hidden = behind_px > half_widths * trial.half_width_px
    return Frame(0, 0.0, np.where(is_hidden, np.median(image), image).astype(np.uint8))


def test_a_template_is_extended_once_a_frame_shows_the_whole_finger():
    rig = SCENES["plain"]
    search, trial, image = tried_out(rig)
    follow_with_short_template(trial, image, 5.0)
    line = trial.track.finger_line
    ahead = np.array([np.cos(line.angle_rad), np.sin(line.angle_rad)])
    short_px = np.ptp(trial.tracker.contour() @ ahead)
    trial.extend(covered_behind_the_tip(trial, image, 3.5))
    assert not trial.extension.is_long
    assert np.ptp(trial.tracker.contour() @ ahead) == short_px
    # The second attempt comes two frames after the failed first one.
    for k in (1, 2):
        trial.update(Frame(k, k / FPS, image), search.background)
        trial.extend(Frame(k, k / FPS, image))
    assert trial.extension.is_long
    assert np.ptp(trial.tracker.contour() @ ahead) > 1.2 * short_px


@pytest.mark.parametrize(
    ("known_length", "is_long"), [(None, False), (7.0, False), (5.0, True), (3.0, True)]
)
def test_a_reacquired_finger_may_be_as_short_as_before_its_loss(known_length, is_long):
    _, trial, image = tried_out(SCENES["plain"], known_length)
    follow_with_short_template(trial, image, 5.0)
    trial.extend(covered_behind_the_tip(trial, image, 3.5))
    assert trial.extension.is_long is is_long


def test_a_rejected_fit_halves_the_frame_count_of_a_trial():
    search, trial, image = tried_out(SCENES["plain"])
    empty = np.full_like(image, int(np.median(image)))
    shown = [image] * 7 + [empty] + [image] * 2 + [empty] * 2
    frames, over = [], []
    for k, picture in enumerate(shown, 1):
        trial.update(Frame(k, k / FPS, picture), search.background)
        frames.append(trial.frames)
        over.append(trial.is_over)
    assert frames == [2, 3, 4, 5, 6, 7, 8, 4, 5, 6, 3, 1]
    assert over == [False] * 11 + [True]


def test_the_extended_length_follows_the_width_of_the_whole_finger():
    # A short template measures the width near the tip only, where a tapered finger is slim.
    rig = SimulatedRig(
        device=RodAndProng(length_mm=200.0, diameter_mm=36.0, taper=0.6, prong_length_mm=0.0)
    )
    search, trial, image = tried_out(rig)
    line = trial.track.finger_line
    follow_with_short_template(trial, image, 4.0)
    slim_px = trial.half_width_px
    for k in range(GROWN_WITHIN):
        trial.extend(Frame(k, k / FPS, image))
        trial.update(Frame(k + 1, (k + 1) / FPS, image), search.background)
    ahead = np.array([np.cos(line.angle_rad), np.sin(line.angle_rad)])
    length_px = np.ptp(trial.tracker.contour() @ ahead)
    assert trial.half_width_px > 1.1 * slim_px
    # Outline of a template of nine half-widths; from the width near the tip it would be below 7.7.
    assert length_px > 8.0 * trial.half_width_px


class SearchedLines:
    """Search lines of both flanks; all edges agree with the fit."""

    def __init__(self, length_px: float) -> None:
        u = np.tile(np.linspace(100.0 - length_px, 100.0, 20), 2)
        self.position_px = np.column_stack([u, np.full(40, 50.0)])
        self.normal = np.repeat([[0.0, -1.0], [0.0, 1.0]], 20, axis=0)
        self.agrees = np.ones(40, np.bool_)

    def __len__(self) -> int:
        return 40


class Fitted:
    """A tracker stub that reports the same fit, of a finger pointing right, for every frame."""

    def __init__(self, length_px: float, half_width_px: float, variance: float = 1.0) -> None:
        self.length_px = length_px
        self.track = SimpleNamespace(
            finger_line=SimpleNamespace(
                tip_px=(100.0, 50.0), angle_rad=0.0, covariance=np.diag([0.1, 1e-4 * variance])
            ),
            shape_vector=[half_width_px],
            shape_names=("half_width [px]",),
        )

    def update(self, *_: object, **__: object) -> SimpleNamespace:
        return self.track

    def contour(self) -> np.ndarray:
        return np.array([[100.0 - 0.85 * self.length_px, 50.0], [100.0, 50.0]])

    def search_lines(self) -> SearchedLines:
        return SearchedLines(self.length_px)


@pytest.mark.parametrize(
    ("part", "is_same"),
    [(1.0, True), (0.85, True), (1.4, True), (0.75, False), (0.5, False), (1.8, False)],
)
def test_a_longer_template_of_another_width_is_rejected(part, is_same):
    def longer(start: StartPose, half_width_px: float) -> Fitted:
        return Fitted(start.length_px, part * half_width_px)

    stub = Fitted(40.0, 8.0)
    frame = Frame(0, 0.0, np.zeros((8, 8), np.uint8))
    extension = TemplateExtension(longer, 8.0)
    tracker, track = extension.update(stub, stub.track, frame)
    assert (tracker is not stub) is is_same
    assert extension.is_long is is_same
    assert track is tracker.track


@pytest.mark.parametrize(("variance", "at_once"), [(0.4, True), (0.6, False), (1.5, False)])
def test_a_longer_template_of_half_the_variance_is_accepted_at_once(variance, at_once):
    seen = []

    def longer(start: StartPose, half_width_px: float) -> Fitted:
        seen.append(Fitted(start.length_px, half_width_px, variance))
        return seen[-1]

    enough = Fitted(60.0, 8.0)
    extension = TemplateExtension(longer, 8.0)
    extension.is_long = True
    frames = [Frame(k, k / FPS, np.zeros((8, 8), np.uint8)) for k in range(2)]
    first, _ = extension.update(enough, enough.track, frames[0])
    assert first is (seen[0] if at_once else enough)
    # Otherwise it is accepted after one more frame.
    assert extension.update(first, first.track, frames[1]) == (seen[0], seen[0].track)


def is_long_by_frame(half_widths: float, frames: int, **how: bool) -> list[bool]:
    """Whether a finger whose longer templates all fail is accepted as long, frame by frame."""

    def of_another_finger(start: StartPose, half_width_px: float) -> Fitted:
        return Fitted(start.length_px, 2.0 * half_width_px)

    stub = Fitted(8.0 * half_widths, 8.0)
    extension = TemplateExtension(of_another_finger, 8.0)
    seen = []
    for k in range(frames):
        frame = Frame(k, k / FPS, np.zeros((8, 8), np.uint8))
        extension.update(stub, stub.track, frame, **how)
        seen.append(extension.is_long)
    return seen


@pytest.mark.parametrize(
    ("half_widths", "is_likely", "is_long"),
    [(6.0, True, True), (6.0, False, False), (5.0, True, False), (7.5, False, True)],
)
def test_a_likely_finger_may_be_short_if_no_frame_shows_more(half_widths, is_likely, is_long):
    seen = is_long_by_frame(half_widths, 40, is_likely=is_likely)
    assert seen[-1] is is_long
    # The first frames do not suffice.
    assert seen[3] is (half_widths >= 7.0)


@pytest.mark.parametrize(
    ("half_widths", "is_followed", "is_short"),
    [(6.0, True, True), (6.0, False, False), (5.0, True, False)],
)
def test_a_finger_followed_by_another_view_is_accepted_as_short_sooner(
    half_widths, is_followed, is_short
):
    seen = is_long_by_frame(half_widths, 4, is_followed=is_followed)
    # An occluder in a single frame may look like the end of a finger.
    assert seen[:2] == [False, False]
    assert seen[3] is is_short


@pytest.mark.parametrize(
    ("moved_px", "changes", "is_static", "is_moving"),
    [
        (0.0, {}, True, False),
        (3.0, {}, True, False),
        (6.0, {}, False, False),
        (30.0, {}, False, True),
        (30.0, {"frames": 5}, False, False),
        (30.0, {"score": 0.3}, False, False),
        (30.0, {"widening": 0.2}, False, False),
        (0.0, {"foreground": 1.0}, False, False),
    ],
)
def test_static_and_moving_trials_are_distinguished(moved_px, changes, is_static, is_moving):
    """A finger 16 px wide, by the distance of its tip from that of the first fit."""

    def line(u_px: float) -> SimpleNamespace:
        return SimpleNamespace(tip_px=(u_px, 80.0), angle_rad=0.0)

    # The start pose is irrelevant: the fit converges from as far away as the finger's width.
    candidate = SimpleNamespace(start=StartPose((60.0, 80.0), 0.0, 70.0), half_width_px=8.0)
    known = {"score": 0.9, "foreground": 0.0, "widening": 1.0, "frames": 6, "is_late": False}
    trial = Trial(
        candidate,
        None,
        None,
        first_line=line(90.0),
        line=line(90.0 + moved_px),
        extension=None,
        **(known | changes),
    )
    assert trial.is_static == is_static
    assert trial.is_moving == is_moving


def test_a_static_pair_is_rejected_beside_a_mover_in_either_view():
    standing = SimpleNamespace(tip_px=(200.0, 80.0))
    elsewhere = SimpleNamespace(tip_px=(100.0, 300.0))

    def view(*moving: bool, at: SimpleNamespace = elsewhere) -> SimpleNamespace:
        trials = [
            SimpleNamespace(
                is_static=not moves,
                is_moving=moves,
                line=at if moves else standing,
                half_width_px=8.0,
            )
            for moves in moving
        ]
        return SimpleNamespace(search=SimpleNamespace(trials=trials))

    def is_left(views: list, *pair: int) -> bool:
        chosen = zip(views, pair, strict=True)
        trials = {k: view.search.trials[i] for k, (view, i) in enumerate(chosen)}
        return stand_beside_mover(trials, movers(views))

    both = [view(False, True), view(False, True)]
    assert is_left(both, 0, 0)
    assert not is_left(both, 1, 1)
    assert not is_left(both, 0, 1)
    assert is_left([view(False), view(False, True)], 0, 0)
    assert not is_left([view(False, False), view(False)], 0, 0)
    # A fit that oscillates on the fist behind the finger is no other hand; a farther one may be.
    for u_px, is_other in [(120.0, False), (45.0, False), (35.0, True), (365.0, True)]:
        there = view(False, True, at=SimpleNamespace(tip_px=(u_px, 80.0)))
        assert is_left([there, there], 0, 0) is is_other


@pytest.mark.parametrize("is_late", [False, True])
@pytest.mark.parametrize("has_moved", [False, True])
@pytest.mark.parametrize("is_supported", [False, True])
def test_a_late_background_trial_is_accepted_if_it_moves_and_another_view_supports_it(
    is_late: bool, has_moved: bool, is_supported: bool
):
    trial = SimpleNamespace(
        is_foreground=False, is_late=is_late, has_moved=has_moved, frames=30, stripe_frames=0
    )
    rank, has_held = pair_rank(0.8, [trial], False, least_widening=1.0, is_supported=is_supported)
    assert has_held
    assert (rank > 0.0) == (not is_late or (has_moved and is_supported))


@pytest.mark.parametrize("is_late", [False, True])
@pytest.mark.parametrize("has_moved", [False, True])
def test_beside_a_hand_that_has_come_only_a_moving_trial_may_be_background(
    is_late: bool, has_moved: bool
):
    # In one view it has come; in the other one its place may have been learned with it.
    came, there = (
        SimpleNamespace(
            is_foreground=is_foreground,
            is_late=is_foreground or is_late,
            has_moved=not is_foreground and has_moved,
            frames=30,
            stripe_frames=0,
        )
        for is_foreground in (True, False)
    )
    rank, has_held = pair_rank(0.8, [came, there], False, least_widening=1.0, is_supported=False)
    assert has_held
    assert (rank > 0.0) == (has_moved and not is_late)


def test_a_pair_that_shows_a_stripe_is_rejected_unless_it_is_followed():
    trial = SimpleNamespace(
        is_foreground=True, is_late=False, has_moved=True, frames=30, stripe_frames=1
    )
    for is_current in (False, True):
        rank, _ = pair_rank(1.0, [trial], is_current, least_widening=1.0, is_supported=False)
        assert (rank > 0.0) is is_current


def test_a_newcomer_without_a_hand_ranks_below_one_with_a_hand():
    def newcomer(score: float, hand: float) -> tuple[float, bool]:
        trial = SimpleNamespace(
            is_foreground=True, is_late=False, has_moved=True, frames=30, stripe_frames=0
        )
        return pair_rank(score, [trial], False, least_widening=hand, is_supported=False)

    stick, finger = newcomer(0.8, 0.0), newcomer(0.6, 0.3)
    assert stick[1]
    assert 0.0 < stick[0] < finger[0] == 0.6
    assert newcomer(0.8, 0.0)[0] < newcomer(0.8, 0.1)[0] < newcomer(0.8, 0.2)[0] == 0.8
    # A pair of low score is accepted only with a hand behind it.
    assert newcomer(0.4, 0.0) == (0.0, True)
    assert newcomer(0.4, 0.3)[0] == 0.4


@pytest.mark.parametrize("is_foreground", [False, True])
@pytest.mark.parametrize("is_supported", [False, True])
def test_a_pair_of_higher_score_needs_fewer_frames(is_foreground, is_supported):
    def frames_needed(score: float) -> int:
        for frames in range(1, 30):
            trial = SimpleNamespace(
                is_foreground=is_foreground,
                is_late=False,
                has_moved=True,
                frames=frames,
                stripe_frames=0,
            )
            if pair_rank(score, [trial], False, least_widening=1.0, is_supported=is_supported)[1]:
                return frames
        raise AssertionError

    assert 2 <= frames_needed(1.0) < frames_needed(0.4)


def test_options_of_the_search_are_checked():
    with pytest.raises(InvalidInputError, match="rates"):
        LearnedBackground({"rates": 1.0})
    with pytest.raises(InvalidInputError, match="least half-width"):
        HandFinder({"min_half_width": 0.0})
    with pytest.raises(InvalidInputError, match="keep-out radius"):
        LearnedBackground().observe(np.zeros((8, 8), np.uint8), keep_out=[((0, 0), (1, 1), -1.0)])
    with pytest.raises(InvalidInputError, match="image is"):
        HandFinder().find(np.zeros((8, 8)))


# --- rendered footage of a hand ----------------------------------------------------------------

DESK = Path(fp.__file__).with_name("data") / "desk"
# The hand is static for 14 frames, among a pen, a cube and a book, and then begins to point.
DESK_FOUND_BY = 25
DESK_FRAMES = 40
# Limit of a gross error; accuracy with a bent finger is tested elsewhere.
DESK_GROSS_MM = 150.0
# Greatest root-mean-square difference of directions between images that differ in size only.
SAME_PICTURE_DEG = 0.25


def left_handed(rig: Rig, frame: Frame, view: int) -> tuple[Frame, tuple[tuple[float, float], ...]]:
    """Return a frame mirrored left to right, and its reference points."""
    width = frame.image.shape[1]
    points = tuple((width - 1 - u, v) for u, v in rig.views[view].reference_points_px)
    image = np.ascontiguousarray(frame.image[:, ::-1])
    return Frame(frame.index, frame.time_s, image), points


@pytest.mark.parametrize("is_mirrored", [False, True])
def test_a_hand_is_found_on_a_desk(is_mirrored: bool):
    rig = Rig.load(DESK / "rig.toml")
    rig = replace(rig, views=tuple(replace(view, start=None) for view in rig.views))
    with ExitStack() as stack:
        sources = [stack.enter_context(open_source(view.source)) for view in rig.views]
        frames = list(islice(read_views(sources), DESK_FRAMES))
    if is_mirrored:
        seen = [[left_handed(rig, f, k) for k, f in enumerate(pair)] for pair in frames]
        frames = [[frame for frame, _ in pair] for pair in seen]
        views = zip(rig.views, seen[0], strict=True)
        rig = replace(rig, views=tuple(replace(v, reference_points_px=p) for v, (_, p) in views))
    pointer = Pointer(rig)
    fixes = [step.fix for pair in frames for step in pointer.update(pair)]
    found = [k for k, fix in enumerate(fixes) if fix.point is not None]
    assert found
    assert found[0] <= DESK_FOUND_BY
    with (DESK / "truth.csv").open(newline="") as file:
        truth = [(float(row["x"]), float(row["y"])) for row in csv.DictReader(file)]
    errors_mm = [np.hypot(*np.subtract(fixes[k].point, truth[k])) for k in found]
    assert max(errors_mm) < DESK_GROSS_MM


def monochrome(has_start: bool) -> tuple[Rig, list[list[Frame]], np.ndarray]:
    """Return the desk's rig, its frames in grey, and the true indicated points."""
    rig = Rig.load(DESK / "rig.toml")
    if not has_start:
        rig = replace(rig, views=tuple(replace(view, start=None) for view in rig.views))
    with ExitStack() as stack:
        sources = [stack.enter_context(open_source(view.source)) for view in rig.views]
        frames = list(islice(read_views(sources), DESK_FRAMES))
    with (DESK / "truth.csv").open(newline="") as file:
        truth = [(float(row["x"]), float(row["y"])) for row in csv.DictReader(file)]
    grey = [[Frame(f.index, f.time_s, f.grey()) for f in pair] for pair in frames]
    return rig, grey, np.array(truth[:DESK_FRAMES])


@pytest.mark.parametrize("has_start", [True, False])
def test_a_hand_is_found_and_followed_without_colours(has_start: bool):
    rig, frames, truth = monochrome(has_start)
    pointer = Pointer(rig)
    fixes = [step.fix for pair in frames for step in pointer.update(pair)]
    found = [k for k, fix in enumerate(fixes) if fix.point is not None]
    # The hand is static at first: it is proven within half a second, and never lost again.
    assert found[0] <= (1 if has_start else 12)
    assert len(found) >= DESK_FRAMES - found[0] - 1
    errors = [np.array(fixes[k].point) - truth[k] for k in found]
    squared = [
        e @ np.linalg.solve(fixes[k].covariance, e) for k, e in zip(found, errors, strict=True)
    ]
    assert np.mean(np.array(squared) < scipy.stats.chi2.ppf(0.95, 2)) >= 0.9


@pytest.mark.parametrize("has_start", [True, False])
def test_three_equal_channels_are_processed_as_grey(has_start: bool):
    rig, frames, _ = monochrome(has_start)
    tripled = [
        [Frame(f.index, f.time_s, np.repeat(f.image[..., None], 3, axis=2)) for f in pair]
        for pair in frames
    ]
    pointers = Pointer(rig), Pointer(rig)
    for one, three in zip(frames, tripled, strict=True):
        (a,), (b,) = (p.update(pair) for p, pair in zip(pointers, (one, three), strict=True))
        assert a.fix.status is b.fix.status
        np.testing.assert_array_equal(a.fix.covariance, b.fix.covariance)


def test_the_widening_is_the_same_in_three_equal_channels():
    # The hand is darker by two standard deviations of the noise, so the levels overlap in part.
    rng = np.random.default_rng(5)
    picture = np.full((240, 320), 60.0)
    picture[110:130, 60:260], picture[110:180, 60:170] = 150.0, 138.0
    grey = np.clip(picture + rng.normal(0, 6, picture.shape), 0, 255).round().astype(np.uint8)
    line = SimpleNamespace(tip_px=(258.0, 120.0), angle_rad=0.0)
    one, three = Frame(0, 0.0, grey), Frame(0, 0.0, np.repeat(grey[..., None], 3, axis=2))
    assert 0.2 < widening(one, line, 10.0) < 0.95
    assert widening(three, line, 10.0) == widening(one, line, 10.0)


@pytest.mark.parametrize("gain", [0.6, 1.5])
def test_a_hand_is_followed_when_the_light_changes(gain: float):
    rig = Rig.load(DESK / "rig.toml")
    with ExitStack() as stack:
        sources = [stack.enter_context(open_source(view.source)) for view in rig.views]
        frames = list(islice(read_views(sources), DESK_FRAMES))
    pointer, changes_at, seen = Pointer(rig), DESK_FRAMES // 2, []
    for k, pair in enumerate(frames):
        light = gain if k >= changes_at else 1.0
        lit = [np.clip(light * f.image, 0, 255).round().astype(np.uint8) for f in pair]
        frame = [Frame(k, f.time_s, i) for f, i in zip(pair, lit, strict=True)]
        seen += [step.observations for step in pointer.update(frame)]
    after = [view.finger for views in seen[changes_at:] for view in views]
    assert len(after) >= DESK_FRAMES
    assert not [finger for finger in after if isinstance(finger, Status)]


def directions(rig: Rig, frames: list) -> np.ndarray:
    """Direction of the finger in each view of every frame [rad]; NaN without a finger line."""
    pointer = Pointer(rig)
    observed = [step.observations for pair in frames for step in pointer.update(pair)]
    fingers = [[view.finger for view in views] for views in observed]
    return np.array(
        [[np.nan if isinstance(f, Status) else f.angle_rad for f in pair] for pair in fingers]
    )


def test_images_of_twice_the_size_give_the_same_directions():
    rig = Rig.load(DESK / "rig.toml")
    with ExitStack() as stack:
        sources = [stack.enter_context(open_source(view.source)) for view in rig.views]
        frames = list(islice(read_views(sources), DESK_FRAMES))
    doubled = [
        [Frame(f.index, f.time_s, cv2.resize(f.image, None, fx=2, fy=2)) for f in pair]
        for pair in frames
    ]

    def place(px: tuple[float, float]) -> tuple[float, float]:
        return 2.0 * px[0] + 0.5, 2.0 * px[1] + 0.5

    views = tuple(
        replace(
            view,
            reference_points_px=tuple(place(px) for px in view.reference_points_px),
            start=replace(
                view.start, tip_px=place(view.start.tip_px), length_px=2.0 * view.start.length_px
            ),
        )
        for view in rig.views
    )
    turned = directions(replace(rig, views=views), doubled) - directions(rig, frames)
    # They are interpolated, so they hold no further detail.
    assert np.degrees(np.sqrt(np.nanmean(turned[10:] ** 2))) < SAME_PICTURE_DEG


# --- views that follow different fingers -------------------------------------------------------


TIP_MM = (200.0, 150.0, 120.0)
TARGET_MM = (200.0, 260.0, 0.0)
ANOTHER_MM = (200.0, 150.0, 200.0)  # off the epipolar lines of TIP_MM, so distinguishable from it


class Following:
    """A view stub that follows a finger from `tip_mm` towards `TARGET_MM`."""

    def __init__(
        self,
        camera: Camera,
        rig: SimulatedRig,
        tip_mm: tuple | None,
        turn: float = 0.0,
        half_width_px: float | None = None,
    ) -> None:
        self.viewpoint = Viewpoint.of(
            PlaneView.from_reference_points(
                rig.plane_points, camera.project(on_table(rig.plane_points)), 0.01 * np.eye(2)
            ),
            (640, 480),
        )
        self.search = HandSearch()
        self.is_searching = False
        self.log_width_ratio = None
        self.foreshortening = None
        self.track = None
        if tip_mm is not None:
            tip, aim = camera.project(np.array([tip_mm, TARGET_MM]))
            angle_rad = float(np.arctan2(*(aim - tip)[::-1])) + turn
            back = 30.0 * np.array([np.cos(angle_rad), np.sin(angle_rad)])
            line = SimpleNamespace(
                anchor_px=tuple(tip - back),
                tip_px=tuple(tip),
                angle_rad=angle_rad,
                covariance=np.diag([1e-4, 1e-7]),
                half_length_px=30.0,
                stretch_px=(-30.0, 30.0),
            )
            names = () if half_width_px is None else ("half_width [px]",)
            self.track = SimpleNamespace(
                finger_line=line, shape_vector=[half_width_px], shape_names=names
            )

    @property
    def axis_correction(self) -> AxisCorrection:
        return AxisCorrection(sigma=sigma_from_width_ratio(self.log_width_ratio or 0.0))


def on_table(points: np.ndarray) -> np.ndarray:
    return np.column_stack([points, np.zeros(len(points))])


@pytest.mark.parametrize(
    ("other_tip_mm", "turn", "one_finger", "two_fingers"),
    [
        (TIP_MM, 0.0, True, False),
        (TIP_MM, np.pi, False, False),  # one finger that points nowhere
        (ANOTHER_MM, 0.0, False, False),  # both point at one place
        (ANOTHER_MM, np.pi, False, True),
        (None, 0.0, False, False),
    ],
)
def test_views_of_one_finger_and_of_two_are_distinguished(
    other_tip_mm, turn, one_finger, two_fingers
):
    rig = SimulatedRig()
    one = Following(rig.cameras[0], rig, TIP_MM, 0.0)
    other = Following(rig.cameras[1], rig, other_tip_mm, turn)
    for views in ((one, other), (other, one)):
        assert are_one(views) is one_finger
        assert are_two(views) is two_fingers


def line_to(tip_mm: tuple, camera: Camera) -> FingerLine:
    """Return the finger line from a tip above the table towards `TARGET_MM`."""
    tip, aim = camera.project(np.array([tip_mm, TARGET_MM]))
    angle_rad = float(np.arctan2(*(aim - tip)[::-1]))
    anchor = tip - 30.0 * np.array([np.cos(angle_rad), np.sin(angle_rad)])
    return FingerLine(anchor, angle_rad, np.diag([1e-4, 1e-7]), tip, 0.0, 30.0, 7.0)


@pytest.mark.parametrize(
    ("tips_mm", "others"),
    [
        ((TIP_MM, TIP_MM, TIP_MM), []),
        ((TIP_MM, ANOTHER_MM, TIP_MM), [1]),
        ((ANOTHER_MM, None, TIP_MM), [0, 2]),
        ((TIP_MM, None, TIP_MM), []),
        ((None, None, TIP_MM), []),
        ((None, None, None), []),
    ],
)
def test_a_view_whose_fingertip_agrees_with_no_other_view_is_returned(tips_mm, others):
    rig = SimulatedRig(Placement(azimuths_deg=(-20.0, 10.0, 40.0)))
    views = [viewpoint_of(camera, rig) for camera in rig.cameras]
    lines = [
        Status.LOST if tip_mm is None else line_to(tip_mm, camera)
        for tip_mm, camera in zip(tips_mm, rig.cameras, strict=True)
    ]
    assert other_fingers(rays_of_tips(views, lines)) == others
    # Without camera centres, tips cannot be compared.
    nowhere = [dataclasses.replace(view, centre=np.full(3, np.nan)) for view in views]
    assert other_fingers(rays_of_tips(nowhere, lines)) == []


def test_the_average_half_width_is_that_of_the_standard_template():
    assert fp.Template.pistol("none").proportions["half_width"] == HALF_WIDTH


def test_the_half_width_is_that_of_the_fit_or_of_an_average_finger():
    rig = SimulatedRig()
    (fitted,) = followed(Following(rig.cameras[0], rig, TIP_MM, half_width_px=4.5).track)
    assert fitted.half_width_px == 4.5
    (usual,) = followed(Following(rig.cameras[0], rig, TIP_MM).track)
    assert usual.half_width_px == pytest.approx(HALF_WIDTH * 60.0)  # twice from anchor to tip
    assert followed(None) == []


# --- index finger and thumb --------------------------------------------------------------------

AIM_MM = np.array([200.0, 40.0, 0.0])
INDEX_MM = 95.0
THUMB_MM = 60.0
HALF_WIDTH_MM = 8.0
HAND_COLOUR = (110.0, 140.0, 190.0)


def thumb_mm(spread_deg: float, roll_deg: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the tip of a thumb beside the finger at `TIP_MM`, and its target on the table.

    `spread_deg` is its angle to the finger, `roll_deg` its rotation about the finger: 0 sideways.
    """
    spread, roll = np.radians([spread_deg, roll_deg])
    ahead = (AIM_MM - TIP_MM) / np.linalg.norm(AIM_MM - TIP_MM)
    lateral = np.cross(ahead, (0.0, 0.0, 1.0))
    lateral /= np.linalg.norm(lateral)
    off = np.cos(roll) * lateral + np.sin(roll) * np.cross(ahead, lateral)
    along = np.cos(spread) * ahead + np.sin(spread) * off
    tip_mm = TIP_MM - INDEX_MM * ahead + 2.0 * HALF_WIDTH_MM * off + THUMB_MM * along
    return tip_mm, tip_mm - along * tip_mm[2] / along[2]


def digit(
    camera: Camera, tip_mm: np.ndarray, aim_mm: np.ndarray, colour=HAND_COLOUR
) -> FingerDetection:
    tip, aim = camera.project(np.array([tip_mm, aim_mm]))
    angle_rad = float(np.arctan2(*(aim - tip)[::-1]))
    half_width_px = round_tip(camera, tip_mm, HALF_WIDTH_MM, 0.0).half_width_px
    return FingerDetection(tuple(tip), angle_rad, half_width_px, 0.9, np.nan, colour)


def digits(rig: SimulatedRig, tip_mm: np.ndarray, aim_mm: np.ndarray, colour=HAND_COLOUR) -> tuple:
    return tuple(digit(camera, tip_mm, aim_mm, colour) for camera in rig.cameras)


@pytest.mark.parametrize(
    ("length", "least", "most"),
    [(8.0, 0.95, 1.0), (12.0, 0.95, 1.0), (24.0, 0.0, 0.6), (40.0, 0.0, 0.02)],
)
@pytest.mark.parametrize("aim_mm", [(200.0, 40.0, 0.0), (330.0, 160.0, 0.0), (120.0, 260.0, 0.0)])
def test_rods_longer_than_a_finger_score_less(length, least, most, aim_mm):
    """The length in space [half-widths] counts, not the foreshortened one in either view."""
    rig = SimulatedRig()
    back = np.subtract(TIP_MM, aim_mm) / math.dist(TIP_MM, aim_mm)
    end_mm = TIP_MM + length * HALF_WIDTH_MM * back
    fingers = []
    for camera, finger in zip(rig.cameras, digits(rig, TIP_MM, aim_mm), strict=True):
        shown_px = math.dist(finger.tip_px, camera.project(end_mm))
        fingers.append(finger._replace(length=shown_px / finger.half_width_px))
    unknown = [finger._replace(length=np.nan) for finger in fingers]
    assert score(rig, *unknown) > 0.0
    assert least <= score(rig, *fingers) / score(rig, *unknown) <= most


@pytest.mark.parametrize("spread_deg", [10.0, 40.0, 70.0])
@pytest.mark.parametrize("roll_deg", [0.0, 30.0, 90.0, 180.0])
def test_an_index_finger_reaches_farther_than_a_thumb(spread_deg, roll_deg):
    rig = SimulatedRig()
    views = tuple(viewpoint_of(camera, rig) for camera in rig.cameras)
    index = digits(rig, TIP_MM, AIM_MM)
    thumb = digits(rig, *thumb_mm(spread_deg, roll_deg))
    assert reaches_farther(views, thumb, index)
    assert not reaches_farther(views, index, thumb)
    assert not reaches_farther(views, index, index)


def test_only_digits_of_one_hand_are_compared_by_reach():
    rig = SimulatedRig()
    views = tuple(viewpoint_of(camera, rig) for camera in rig.cameras)
    index, thumb = digits(rig, TIP_MM, AIM_MM), thumb_mm(40.0, 0.0)
    assert reaches_farther(views, digits(rig, *thumb), index)
    shadow = tuple(0.2 * level for level in HAND_COLOUR)
    assert not reaches_farther(views, digits(rig, *thumb, shadow), index)
    away_mm = TIP_MM - 2.0 * (AIM_MM - TIP_MM)
    assert not reaches_farther(views, digits(rig, away_mm, AIM_MM), index)
    nowhere = dataclasses.replace(views[1], centre=np.full(3, np.nan))
    assert not reaches_farther((views[0], nowhere), digits(rig, *thumb), index)
    unknown = (np.nan,) * 3
    assert reaches_farther(views, digits(rig, *thumb, unknown), index)


def tried_digit(
    seen: FingerDetection, hand: float, *, is_foreground: bool = True
) -> SimpleNamespace:
    return SimpleNamespace(
        seen=seen,
        widening=hand,
        is_foreground=is_foreground,
        stripe_frames=0,
        frames=30,
        is_late=False,
        has_moved=True,
        is_static=False,
        is_moving=False,
    )


def trying(viewpoint: Viewpoint, *trials: SimpleNamespace) -> SimpleNamespace:
    """Return a view stub with trials, which follows no finger."""
    search = SimpleNamespace(
        trials=list(trials), found=None, trial_detections=lambda: [trial.seen for trial in trials]
    )
    return SimpleNamespace(
        viewpoint=viewpoint,
        search=search,
        track=None,
        is_searching=True,
        is_validated=True,
        may_follow=lambda _trial: True,
    )


@pytest.mark.parametrize("is_foreground", [False, True])
@pytest.mark.parametrize("thumb_in", [(0, 1), (0,), (1,)])
def test_the_index_finger_precedes_the_thumb(thumb_in, is_foreground):
    """Although the thumb scores more, in one view or both, and hides the widening of the index."""
    rig = SimulatedRig()
    index = digits(rig, TIP_MM, AIM_MM)
    # Below the finger: one view's thumb may also match the other view's index finger.
    thumb = digits(rig, *thumb_mm(20.0, 90.0))
    views = []
    for k, camera in enumerate(rig.cameras):
        hand = 0.2 if k in thumb_in else 1.0
        trials = [tried_digit(index[k]._replace(score=0.75), hand, is_foreground=is_foreground)]
        if k in thumb_in:
            trials.append(
                tried_digit(thumb[k]._replace(score=0.9), 1.0, is_foreground=is_foreground)
            )
        views.append(trying(viewpoint_of(camera, rig), *trials))
    first, *_ = ranked_pairs(views)
    pair, has_held = first
    assert has_held
    assert [pair.trials[k] for k in (0, 1)] == [view.search.trials[0] for view in views]


def test_a_trial_beside_another_views_finger_is_scored_by_its_last_direction():
    rig = SimulatedRig()
    followed_finger = digit(rig.cameras[1], TIP_MM, AIM_MM)
    line = SimpleNamespace(tip_px=followed_finger.tip_px, angle_rad=followed_finger.angle_rad)
    other = SimpleNamespace(
        viewpoint=viewpoint_of(rig.cameras[1], rig),
        search=SimpleNamespace(found=None, trials=[]),
        track=SimpleNamespace(
            finger_line=line,
            shape_vector=[followed_finger.half_width_px],
            shape_names=("half_width [px]",),
        ),
        is_searching=False,
        is_validated=True,
    )
    seen = digit(rig.cameras[0], TIP_MM, AIM_MM)
    lost = LastSeen(seen.angle_rad, time_s=0.0)

    def scores(turn_rad: float) -> list[float]:
        trial = tried_digit(seen, 1.0)
        trial.line = SimpleNamespace(angle_rad=seen.angle_rad + turn_rad)
        trial.track = SimpleNamespace(time_s=0.1)
        view = trying(viewpoint_of(rig.cameras[0], rig), trial)
        view.direction_likelihood = lost.direction_likelihood
        return [pair.score for pair, _ in ranked_pairs([view, other])]

    straight_on, turned = *scores(0.0), *scores(0.7)
    assert straight_on > 0.7
    assert turned == pytest.approx(straight_on * math.exp(-0.5))
    assert scores(2.0) == []


def test_a_pair_is_behind_one_of_farther_reach_with_comparable_score_and_foreground():
    rig = SimulatedRig()
    index = tried_digit(digit(rig.cameras[0], TIP_MM, AIM_MM), 1.0)
    thumb = tried_digit(digit(rig.cameras[0], *thumb_mm(20.0, 90.0)), 1.0)
    other = digit(rig.cameras[1], TIP_MM, AIM_MM)

    def pair(trial: SimpleNamespace, score: float, view: int = 0) -> TriedPair:
        return TriedPair((view, 2), (trial.seen, other), {view: trial}, score, is_current=False)

    assert is_behind([], pair(thumb, 0.9), pair(index, 0.5))
    assert not is_behind([], pair(index, 0.9), pair(thumb, 0.9))
    assert not is_behind([], pair(thumb, 0.9), pair(thumb, 0.9))
    assert not is_behind([], pair(thumb, 0.9), pair(index, 0.4))
    assert not is_behind([], pair(thumb, 0.9), pair(index, 0.9, view=1))
    index.is_foreground = False
    assert not is_behind([], pair(thumb, 0.9), pair(index, 0.9))
    thumb.is_foreground = False
    assert is_behind([], pair(thumb, 0.9), pair(index, 0.9))


def test_a_moving_trial_is_not_background_although_it_was_learned():
    search, rng = HandSearch(), np.random.default_rng(SEED)
    for k in range(12):
        frame = Frame(k, k / FPS, rng.integers(90, 110, (48, 64), dtype=np.uint8))
        search.update_background(frame)
        search.learn(frame, None)
    shown = {"pose": ((30.0, 20.0), 0.0, 5.0), "length": 8.0, "score": 0.9, "foreground": 0.1}
    candidate = SimpleNamespace(colour=HAND_COLOUR)
    search.trials = [
        SimpleNamespace(**shown, candidate=candidate, is_moving=is_moving)
        for is_moving in (False, True)
    ]
    is_static, moves = search.trial_detections()
    assert is_static.foreground == 0.1
    assert np.isnan(moves.foreground)
    assert is_static.length == moves.length == 8.0


MISSED = ("tracking", "agreement")
BENT = ("tracking", "misfit")
WAITS = ("acquiring", "no-fit")


@pytest.mark.parametrize(
    ("frames", "is_searching"),
    [
        ([], False),
        ([MISSED], False),
        ([MISSED, MISSED], True),
        ([MISSED, None, MISSED], False),
        ([BENT] * 5, False),
        ([WAITS] * 2, False),
        ([WAITS] * 3, True),
        ([BENT] * 3 + [("lost", "misfit")] * 2, True),
    ],
)
def test_a_missed_finger_is_soon_searched_in_the_whole_image(frames, is_searching):
    """None is a frame with a finger line; other entries are the tracker's (status, refusal)."""
    rig = SimulatedRig()
    view = waiting(rig, rig.cameras[0])
    view.view_frame(Frame(0, 0.0, BLACK))
    for k, missed in enumerate([None, *frames]):
        track = followed_track(rig, rig.cameras[0])
        if missed is not None:
            status, refusal = missed
            track = SimpleNamespace(
                finger_line=None,
                status=status,
                diagnostics=SimpleNamespace(refusal=refusal),
                shape_vector=None,
            )
        view.follow(Frame(k, k / FPS, BLACK), track)
    assert view.is_searching is is_searching


def test_evidence_against_a_rejected_finger_is_none_against_the_next(monkeypatch):
    """A template that has followed a stripe waits again, and has as many frames as before."""
    monkeypatch.setattr("fingerpost.finding.trial.is_stripe", lambda *_: True)
    rig = SimulatedRig()
    view = waiting(rig, rig.cameras[0])
    shown = []
    for k in range(4 * 2 * STRIPE_FRAMES):
        frame = Frame(k, k / FPS, BLACK)
        view.view_frame(frame)
        view.follow(frame, followed_track(rig, rig.cameras[0]))
        shown.append(view.shows_finger)
        view.observe(frame)
    # Tested in every fourth frame until one is a stripe's, and in each from then on.
    rejected = np.flatnonzero(np.logical_not(shown))
    assert len(rejected) >= 3
    assert np.diff(rejected).min() >= STRIPE_FRAMES


BLACK = np.zeros((480, 640), np.uint8)


def waiting(rig: SimulatedRig, camera: Camera) -> HandView:
    """Return a view whose initial template waits for the hand."""
    start = Start(tip_px=(320.0, 240.0), angle_deg=90.0, length_px=70.0, thumb="none")
    points_px = tuple(map(tuple, camera.project(on_table(rig.plane_points)).tolist()))
    configured = View(name="cam", source="cam.mkv", reference_points_px=points_px, start=start)
    return HandView(configured, rig.plane_points, None, 0.5)


def followed_track(rig: SimulatedRig, camera: Camera, turn: float = 0.0) -> SimpleNamespace:
    """Return the tracker's result for a frame with the finger."""
    track = Following(camera, rig, TIP_MM, turn, half_width_px=7.0).track
    track.status, track.diagnostics = "tracking", SimpleNamespace(refusal=None)
    return track


NO_POINT_FOR = 10


@pytest.mark.parametrize(
    ("points", "is_searching"),
    [
        ([False] * (NO_POINT_FOR - 1), False),
        ([False] * NO_POINT_FOR, True),
        ([False] * (NO_POINT_FOR - 1) + [True, False], False),
        ([False] * NO_POINT_FOR + [True], False),
        ([True] * NO_POINT_FOR, False),
        ([False] * (NO_POINT_FOR - 1) + [None] * 3, False),
        ([False, None] * NO_POINT_FOR, True),
    ],
)
def test_views_that_give_no_point_search_beside_their_fingers(points, is_searching):
    """Frames whose fingers give a point (True) or none (False); None if one finger is missed."""
    rig = SimulatedRig()
    views = [waiting(rig, camera) for camera in rig.cameras]
    for k, gives in enumerate(points):
        frame = Frame(k, k / FPS, BLACK)
        for view, camera, is_other in zip(views, rig.cameras, (False, True), strict=True):
            track = followed_track(rig, camera, np.pi if is_other and not gives else 0.0)
            if is_other and gives is None:
                track.finger_line, track.diagnostics.refusal = None, "misfit"
            view.view_frame(frame)
            view.follow(frame, track)
        shared = PairTests()
        for view, other in (views, views[::-1]):
            assert view.validate([other], shared)
    one, other = (view.is_searching for view in views)
    assert one is is_searching
    assert other is is_searching


# --- finger widths and lengths in two views ------------------------------------------------------


def nearer(camera: Camera, part: float) -> Camera:
    """Return the camera moved to `part` of its distance from the world's origin."""
    pose = camera.camera_from_world.copy()
    pose[:, 3] = -pose[:, :3] @ (part * camera.centre_mm)
    return dataclasses.replace(camera, camera_from_world=pose)


def viewpoint_of(camera: Camera, rig: SimulatedRig) -> Viewpoint:
    shown = camera.project(on_table(rig.plane_points))
    view = PlaneView.from_reference_points(rig.plane_points, shown, 0.01 * np.eye(2))
    return Viewpoint.of(view, (camera.width_px, camera.height_px))


def round_tip(camera: Camera, tip_mm: tuple, radius_mm: float, turn: float) -> FingerDetection:
    """Return the tip of a round finger: as wide across the camera's ray in any direction `turn`."""
    one = np.cross(tip_mm - camera.centre_mm, (0.0, 0.0, 1.0))
    other = np.cross(tip_mm - camera.centre_mm, one)
    one, other = one / np.linalg.norm(one), other / np.linalg.norm(other)
    across_mm = radius_mm * (np.cos(turn) * one + np.sin(turn) * other)
    tip, left, right = camera.project(np.array([tip_mm, tip_mm - across_mm, tip_mm + across_mm]))
    along_px = right - left
    half_width_px = 0.5 * float(np.hypot(*along_px))
    return FingerDetection(tuple(tip), float(np.arctan2(-along_px[0], along_px[1])), half_width_px)


@pytest.mark.parametrize("tip_mm", [(200.0, 150.0, 20.0), (120.0, 260.0, 180.0)])
@pytest.mark.parametrize(("first_mm", "second_mm"), [(8.0, 8.0), (4.0, 8.0), (12.0, 7.0)])
def test_the_width_ratio_is_corrected_for_distance(tip_mm, first_mm, second_mm):
    rig = SimulatedRig()
    cameras = rig.cameras[0], nearer(rig.cameras[1], 0.6)
    views = tuple(viewpoint_of(camera, rig) for camera in cameras)
    fingers = tuple(
        round_tip(camera, tip_mm, radius_mm, turn)
        for camera, radius_mm, turn in zip(cameras, (first_mm, second_mm), (0.4, 1.0), strict=True)
    )
    assert fingers[1].half_width_px / second_mm > 1.3 * fingers[0].half_width_px / first_mm
    ratio = width_ratio(views, fingers)
    assert ratio == pytest.approx(np.log(first_mm / second_mm), abs=0.02)
    assert width_ratio(views[::-1], fingers[::-1]) == pytest.approx(-ratio)


def test_widths_are_not_compared_without_camera_centres():
    rig = SimulatedRig()
    view = viewpoint_of(rig.cameras[0], rig)
    finger = round_tip(rig.cameras[0], TIP_MM, 8.0, 0.4)
    nowhere = dataclasses.replace(view, centre=np.full(3, np.nan))
    assert np.isnan(width_ratio((view, nowhere), (finger, finger)))
    assert np.isnan(width_ratio((view, view), (finger, finger)))  # coincident cameras
    assert np.isnan(width_ratio((view, view), (finger, finger._replace(half_width_px=0.0))))


def test_fingers_of_one_tip_but_different_width_are_two():
    rig = SimulatedRig()
    for half_width_px, is_one in ((7.0, True), (8.5, True), (14.0, False), (3.0, False)):
        one = Following(rig.cameras[0], rig, TIP_MM, half_width_px=7.0)
        other = Following(rig.cameras[1], rig, TIP_MM, half_width_px=half_width_px)
        compare_widths((one, other))
        assert one.log_width_ratio == pytest.approx(-other.log_width_ratio)
        assert np.sign(other.log_width_ratio) == np.sign(half_width_px - 7.0) or is_one
        assert (can_be_one((one, other)), are_two((one, other))) == (is_one, not is_one)


@pytest.mark.parametrize("tip_mm", [(200.0, 150.0, 60.0), (120.0, 220.0, 180.0), ANOTHER_MM])
def test_foreshortening_follows_from_two_views(tip_mm):
    rig = SimulatedRig()
    views = [Following(camera, rig, tip_mm, half_width_px=7.0) for camera in rig.cameras]
    compare_lengths(views, PairTests())
    finger = np.array(TARGET_MM) - tip_mm
    for view, camera in zip(views, rig.cameras, strict=True):
        ray = camera.centre_mm - tip_mm
        sine = np.linalg.norm(np.cross(ray, finger))
        expected = sine / (np.linalg.norm(ray) * np.linalg.norm(finger))
        assert view.foreshortening == pytest.approx(expected, abs=0.005)


def test_foreshortening_is_a_running_mean():
    rig = SimulatedRig()
    now = [Following(camera, rig, TIP_MM, half_width_px=7.0) for camera in rig.cameras]
    compare_lengths(now, PairTests())
    for view in now:
        exact = view.foreshortening
        view.foreshortening = 0.5 * exact
        compare_lengths(now, PairTests())
        assert 0.5 * exact < view.foreshortening < 0.6 * exact
        for _ in range(60):
            compare_lengths(now, PairTests())
        assert view.foreshortening == pytest.approx(exact, abs=0.01)


def test_foreshortening_is_unknown_without_a_second_view_of_the_finger():
    rig = SimulatedRig()
    one = Following(rig.cameras[0], rig, TIP_MM, half_width_px=7.0)
    for tip_mm, turn in ((None, 0.0), (ANOTHER_MM, np.pi)):
        other = Following(rig.cameras[1], rig, tip_mm, turn, half_width_px=7.0)
        compare_lengths((one, other), PairTests())
        assert one.foreshortening is None
    # In one plane with both camera centres, or with an unknown centre.
    compare_lengths((one, Following(rig.cameras[0], rig, TIP_MM, half_width_px=7.0)), PairTests())
    assert one.foreshortening is None
    one.viewpoint = dataclasses.replace(one.viewpoint, centre=np.full(3, np.nan))
    compare_lengths((one, Following(rig.cameras[1], rig, TIP_MM, half_width_px=7.0)), PairTests())
    assert one.foreshortening is None


@pytest.mark.parametrize(("turned_deg", "is_known"), [(0.0, False), (0.3, False), (15.0, True)])
def test_foreshortening_is_unknown_for_a_finger_in_one_plane_with_both_cameras(
    turned_deg, is_known
):
    rig, tip_mm = SimulatedRig(), np.array(TIP_MM)
    from_between = tip_mm - np.mean([camera.centre_mm for camera in rig.cameras], axis=0)
    upright = np.cross(from_between, rig.cameras[1].centre_mm - rig.cameras[0].centre_mm)
    offset = np.tan(np.radians(turned_deg)) * np.linalg.norm(from_between)
    ahead = from_between + offset * upright / np.linalg.norm(upright)
    seen = []
    for camera in rig.cameras:
        tip, further = camera.project(np.array([tip_mm, tip_mm + 0.1 * ahead]))
        seen.append(FingerDetection(tuple(tip), float(np.arctan2(*(further - tip)[::-1])), 7.0))
    ratios = foreshortenings(viewpoints(rig), (seen[0], seen[1]))
    assert list(np.isfinite(ratios)) == [is_known] * 2


def test_the_tracker_receives_the_foreshortening():
    rig = SCENES["plain"]
    view = waiting(rig, rig.cameras[0])
    assert view.foreshortening is None
    assert view.tracker.foreshortening == 1.0
    view.foreshortening = 0.8
    assert view.tracker.foreshortening == view.foreshortening == 0.8


def test_foreshortening_is_forgotten_with_a_rejected_finger():
    rig = SCENES["plain"]
    points_px = tuple(map(tuple, rig.reference_points_px[0].tolist()))
    configured = View(name="cam", source="cam.mkv", reference_points_px=points_px)
    view = HandView(configured, rig.plane_points, None, 0.5)
    view.foreshortening = 0.8
    for _ in range(LET_GO_WITHIN):
        view.reject_if_flat(1.0)
    assert view.foreshortening is None


def test_of_three_views_the_one_of_another_width_is_identified():
    rig = SimulatedRig()
    cameras = (*rig.cameras, nearer(rig.cameras[1], 0.6))
    widths = [round_tip(camera, TIP_MM, 8.0, 0.4).half_width_px for camera in cameras]
    views = [
        Following(camera, rig, TIP_MM, half_width_px=half_width_px)
        for camera, half_width_px in zip(
            cameras, (widths[0], 1.8 * widths[1], widths[2]), strict=True
        )
    ]
    compare_widths(views)
    assert max(abs(views[0].log_width_ratio), abs(views[2].log_width_ratio)) < 0.1
    assert views[1].log_width_ratio == pytest.approx(np.log(1.8), abs=0.1)


def test_the_width_ratio_is_a_running_mean_and_unknown_without_a_finger():
    rig = SimulatedRig()
    views = [Following(camera, rig, TIP_MM, half_width_px=7.0) for camera in rig.cameras]
    compare_widths(views)
    like = views[1].log_width_ratio
    blurred = Following(rig.cameras[1], rig, TIP_MM, half_width_px=11.0)
    blurred.log_width_ratio = like
    compare_widths((views[0], blurred))
    assert like < blurred.log_width_ratio < like + 0.3 * np.log(11.0 / 7.0)
    for _ in range(20):
        compare_widths((views[0], blurred))
    assert blurred.log_width_ratio == pytest.approx(like + np.log(11.0 / 7.0), abs=0.02)
    views[0].track = None
    compare_widths((views[0], blurred))
    assert views[0].log_width_ratio is blurred.log_width_ratio is None


@pytest.mark.parametrize("log_width_ratio", [0.0, 0.2, -0.2, 0.6, -0.6, 1.5])
def test_the_line_covariance_grows_with_the_width_ratio(log_width_ratio):
    rig = SimulatedRig()
    track = Following(rig.cameras[0], rig, TIP_MM, half_width_px=7.0).track
    known = measured_line(track, 0.0)
    doubted = measured_line(
        track, 0.0, AxisCorrection(sigma=sigma_from_width_ratio(log_width_ratio))
    )
    # One flank as wide as in the other view, the other as in this one.
    off_px = abs(
        7.0 - 7.0 * np.exp(-np.sign(log_width_ratio) * max(abs(log_width_ratio) - 0.25, 0.0))
    )
    more = doubted.covariance - known.covariance
    expected = np.diag([off_px**2, (off_px / 30.0) ** 2])
    np.testing.assert_allclose(more, expected, rtol=1e-9, atol=1e-15)
    assert (doubted.angle_rad, doubted.half_width_px) == (known.angle_rad, 7.0)


# --- invisible flanks ----------------------------------------------------------------------------

FLAT_FINGER = SimpleNamespace(tip_px=(258.0, 120.0), angle_rad=0.0)


def painted(sigmas_px: tuple[float, float], levels: tuple, blur_px: float = 0.0) -> Frame:
    """A finger along u, 20 px wide; its upper and lower flanks are steps blurred by `sigmas_px`."""
    v = np.arange(240.0)
    upper = scipy.stats.norm.cdf((v - 110.0) / sigmas_px[0])
    lower = scipy.stats.norm.sf((v - 130.0) / sigmas_px[1])
    part = np.repeat((upper * lower)[:, None], 320, axis=1)
    part[:, 259:] = 0.0
    if blur_px > 0.0:
        part = cv2.GaussianBlur(part, (0, 0), blur_px)
    finger, table = (np.array(level, dtype=float) for level in levels)
    picture = part[..., None] * finger + (1.0 - part[..., None]) * table
    noise = np.random.default_rng(3).normal(0.0, 1.0, picture.shape)
    return Frame(0, 0.0, np.clip(picture + noise, 0, 255).round().astype(np.uint8).squeeze())


@pytest.mark.parametrize(("finger", "table"), [(150.0, 60.0), (40.0, 90.0)])
@pytest.mark.parametrize("sigmas_px", [(1.0, 1.0), (1.0, 2.0), (2.0, 1.0)])
def test_the_blur_asymmetry_identifies_the_softer_flank(finger, table, sigmas_px):
    asymmetry = blur_asymmetry(painted(sigmas_px, ([finger], [table])), FLAT_FINGER, 10.0)
    # The normal of a finger along u points to larger v.
    expected = (sigmas_px[1] ** 2 - sigmas_px[0] ** 2) / 10.0**2
    assert asymmetry == pytest.approx(expected, abs=0.015)


def test_the_blur_asymmetry_increases_with_the_blur_of_one_flank():
    asymmetries = [
        blur_asymmetry(painted((1.0, sigma_px), ([60.0], [150.0])), FLAT_FINGER, 10.0)
        for sigma_px in (1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 9.0)
    ]
    assert asymmetries == sorted(asymmetries)
    assert asymmetries[-1] > 0.3**2


def test_image_blur_leaves_the_asymmetry_unchanged():
    sharp, blurred = (
        blur_asymmetry(painted((1.0, 2.0), ([150.0], [60.0]), blur_px), FLAT_FINGER, 10.0)
        for blur_px in (0.0, 1.5)
    )
    assert blurred == pytest.approx(sharp, abs=0.015)


def test_the_blur_asymmetry_is_measured_in_colour_without_grey_contrast():
    # Red in front of green of the same grey level.
    frame = painted((1.0, 2.0), ([60.0, 40.0, 128.0], [60.0, 85.0, 40.0]))
    grey = Frame(0, 0.0, frame.grey())
    assert blur_asymmetry(frame, FLAT_FINGER, 10.0) == pytest.approx(0.03, abs=0.015)
    assert np.isnan(blur_asymmetry(grey, FLAT_FINGER, 10.0))


def test_the_blur_asymmetry_is_unknown_outside_the_image():
    frame = painted((1.0, 2.0), ([150.0], [60.0]))
    outside = SimpleNamespace(tip_px=(20.0, 120.0), angle_rad=0.0)
    assert np.isnan(blur_asymmetry(frame, outside, 10.0))


def test_blur_asymmetry_implies_an_axis_sigma_of_up_to_one_half_width():
    assert sigma_from_blur_asymmetry(0.0) == sigma_from_blur_asymmetry(0.28**2) == 0.0
    doubts = [
        sigma_from_blur_asymmetry(sign * s**2) for s in (0.3, 0.32, 0.34, 0.6) for sign in (1, -1)
    ]
    assert doubts[::2] == doubts[1::2] == sorted(doubts[::2])
    assert 0.0 < doubts[0] < doubts[-1] == 1.0


def test_a_finger_with_both_flanks_visible_is_not_corrected():
    rig = Rig.load(DESK / "rig.toml")
    with ExitStack() as stack:
        sources = [stack.enter_context(open_source(view.source)) for view in rig.views]
        pointer = Pointer(rig)
        seen = [
            o
            for pair in islice(read_views(sources), DESK_FRAMES)
            for step in pointer.update(pair)
            for o in step.observations
        ]
    assert sum(o.track.finger_line is not None for o in seen) > DESK_FRAMES
    assert [o.axis_correction for o in seen] == [AxisCorrection()] * len(seen)


def test_an_invisible_flank_appears_in_reasons_and_track_rows():
    rig = Rig.load(DESK / "rig.toml")
    with ExitStack() as stack:
        sources = [stack.enter_context(open_source(view.source)) for view in rig.views]
        pointer = Pointer(rig)
        *_, last = (s for p in islice(read_views(sources), 20) for s in pointer.update(p))
    sure = last.observations[0]
    unsure = dataclasses.replace(sure, axis_correction=AxisCorrection(sigma=0.5))
    assert "up to 0.5 half-widths off" in unsure.reasons[-1]
    assert "half-widths" not in sure.reasons[-1]
    corrected = dataclasses.replace(sure, axis_correction=AxisCorrection(offset=-0.4, sigma=0.1))
    assert "a flank does not show: axis 0.4 half-widths aside" in corrected.reasons[-1]
    rows = sure.track_row(), unsure.track_row()
    assert rows[0].tip_u == rows[1].tip_u
    off_px = 0.5 * unsure.finger.half_width_px
    assert rows[1].sigma_offset_px == pytest.approx(np.hypot(rows[0].sigma_offset_px, off_px))
    assert rows[1].sigma_angle_rad > rows[0].sigma_angle_rad


def lit_finger(light_rad: float, table: float = 70.0) -> Frame:
    """A round finger along u about v = 120, 16 px wide at u = 228, lit from one side.

    `light_rad` is the angle of the light to the line of sight, positive from larger v.
    """
    v, u = np.mgrid[0:960, 0:1280] / 4.0 - 0.375
    y = (v - 120.0) / (8.0 - 0.05 * (u - 228.0))
    z = np.sqrt(np.maximum(1.0 - y**2, 0.0))
    light = np.maximum(y * np.sin(light_rad) + z * np.cos(light_rad), 0.0)
    fine = np.where((np.abs(y) < 1.0) & (u < 258.0), 70.0 + 100.0 * light, table)
    picture = fine.reshape(240, 4, 320, 4).mean(axis=(1, 3))
    noise = np.random.default_rng(3).normal(0.0, 1.0, picture.shape)
    return Frame(0, 0.0, np.clip(picture + noise, 0, 255).round().astype(np.uint8))


def between_edges(v: float, half_width_px: float) -> SimpleNamespace:
    """Return a tracker's result for edges along u, `half_width_px` on either side of v."""
    line = SimpleNamespace(
        anchor_px=(228.0, v),
        tip_px=(258.0, v),
        angle_rad=0.0,
        covariance=np.diag([1e-4, 1e-6]),
        half_length_px=25.0,
        stretch_px=(-25.0, 25.0),
    )
    return SimpleNamespace(
        finger_line=line, shape_vector=[half_width_px], shape_names=("half_width [px]",)
    )


@pytest.mark.parametrize("light_rad", [1.1, -1.1])
def test_shading_gives_the_axis_of_a_half_visible_finger(light_rad):
    # In front of a table as dark as its dark side, the finger is visible up to cos φ half-widths.
    hidden_px = 8.0 * (1.0 - np.cos(light_rad))
    track = between_edges(120.0 + 0.5 * hidden_px * np.sign(light_rad), 8.0 - 0.5 * hidden_px)
    flanks = Flanks()
    for _ in range(9):
        flanks.update(lit_finger(light_rad), track)
    line = measured_line(track, 0.0, flanks.axis_correction)
    assert line.anchor_px[1] == pytest.approx(120.0, abs=0.7)
    assert line.tip_px[1] == pytest.approx(120.0, abs=0.7)
    assert line.half_width_px == pytest.approx(8.0, abs=0.8)
    # The covariance allows for the correction's error: tenths of a px, and a degree or two.
    off_px, off_rad = np.sqrt(np.diag(line.covariance))
    assert 0.2 < off_px < 1.0
    assert np.radians(0.5) < off_rad < np.radians(3.0)
    assert Flanks().axis_correction == AxisCorrection()


@pytest.mark.parametrize(("light_rad", "table"), [(0.0, 20.0), (0.5, 220.0), (-0.9, 220.0)])
def test_no_shading_correction_where_both_flanks_are_visible(light_rad, table):
    flanks = Flanks()
    for _ in range(9):
        flanks.update(lit_finger(light_rad, table), between_edges(120.0, 8.0))
    assert (
        flanks.axis_correction.offset
        == flanks.axis_correction.turn_rad
        == flanks.axis_correction.log_width_ratio
        == 0.0
    )


def test_the_shading_correction_vanishes_when_both_flanks_become_visible():
    shaded = ShadingFit(offset_px=2.0, turn_rad=0.05, half_width_px=8.0, shown_px=6.0)
    whole = shaded.correction_from_edges(6.0)
    assert whole == pytest.approx((2.0 / 6.0, 0.05, np.log(8.0 / 6.0), 0.0))
    half = shaded.correction_from_edges(7.0)
    assert half == pytest.approx((1.0 / 7.0, 0.025, np.log(8.0 / 7.0), 0.0))
    assert (
        shaded.correction_from_edges(8.0) == shaded.correction_from_edges(9.5) == AxisCorrection()
    )
    # Edges much closer together do not enlarge the correction further.
    assert shaded.correction_from_edges(2.0).offset * 2.0 == pytest.approx(3.0)


def test_the_majority_of_shading_fits_decides_and_visible_flanks_are_fitted_rarely(monkeypatch):
    shaded = ShadingFit(offset_px=2.0, turn_rad=0.05, half_width_px=8.0, shown_px=6.0)
    answers = iter([shaded, None, shaded, None, shaded, *[None] * 100])
    taken = []

    def fit(*args):
        taken.append(k)
        return next(answers)

    monkeypatch.setattr(ShadingFit, "of", fit)
    flanks, track, frame = Flanks(), between_edges(120.0, 6.0), lit_finger(0.0, 20.0)
    offsets = []
    for k in range(1, 120):  # noqa: B007, `fit` notes the number
        flanks.update(frame, track)
        offsets.append(flanks.axis_correction.offset)
    assert taken[:7] == [1, 4, 8, 12, 16, 20, 24]
    # Three of five fits find an invisible flank, then two, and in the end none.
    assert [offsets[k - 1] > 0.0 for k in taken[:6]] == [True, False, True, False, True, False]
    assert set(np.diff(taken[9:])) == {12}


def test_views_compare_the_width_given_by_shading():
    rig = SimulatedRig()
    slim, whole = (
        Following(camera, rig, TIP_MM, half_width_px=w)
        for camera, w in zip(rig.cameras, (4.0, 7.0), strict=False)
    )
    compare_widths((slim, whole))
    log_width_ratio = slim.log_width_ratio
    shaded = Following(rig.cameras[0], rig, TIP_MM, half_width_px=4.0)
    correction = AxisCorrection(log_width_ratio=np.log(7.0 / 4.0))
    shaded.__class__ = type("Shaded", (Following,), {"axis_correction": correction})
    whole.log_width_ratio = None
    compare_widths((shaded, whole))
    assert shaded.log_width_ratio == pytest.approx(log_width_ratio + np.log(7.0 / 4.0), abs=1e-9)
    assert abs(shaded.log_width_ratio) < 0.1


def test_a_flank_that_fades_into_the_table_is_corrected_or_doubted():
    # The lower half of the finger fades into the table, and the upper half is visible. The line
    # between its edges gets a greater covariance, or is moved towards the invisible flank.
    view = HandView(
        SimpleNamespace(
            name="one",
            reference_points_px=((40, 30), (280, 30), (280, 210), (40, 210)),
            reference_covariances=lambda sigma_px: sigma_px**2 * np.eye(2),
            lens=None,
            start=None,
        ),
        ((0, 0), (100, 0), (100, 100), (0, 100)),
        None,
        0.5,
    )
    line = SimpleNamespace(**vars(FLAT_FINGER), anchor_px=(228.0, 120.0))
    found = SimpleNamespace(
        track=SimpleNamespace(
            finger_line=line, shape_vector=[10.0], shape_names=("half_width [px]",)
        )
    )
    for sigma_px, least, most in ((1.0, 0.0, 0.0), (9.0, 0.2, 1.0)):
        view.search.found, view._followed.flanks = found, Flanks()
        view.test_flanks(painted((1.0, sigma_px), ([60.0], [150.0])))
        assert least <= np.hypot(view.axis_correction.offset, view.axis_correction.sigma) <= most
        assert view.axis_correction.offset >= 0.0
