"""Rigs that contradict their pictures: mistakes are put into a correct rig and identified."""

import itertools
from itertools import product

import numpy as np
import pytest
from msgspec import structs

from fingerpost.capture import Frame
from fingerpost.config import Rig
from fingerpost.consistency import Scenery
from fingerpost.consistency.straightness import BENT_PX
from fingerpost.doctor import examine
from fingerpost.errors import InvalidInputError
from fingerpost.pipeline import Pointer, steps
from fingerpost.pointing import Status
from fingerpost.simulate import (
    Background,
    DevicePose,
    Hand,
    Placement,
    PoseSampler,
    Sensor,
    SimulatedRig,
    Workspace,
)
from fingerpost.simulated_rig_file import rig_from_simulation

SHEET_ON_WOOD = Background(texture="wood", clutter=20.0, sheet=90.0)
PRINTED = Background(clutter=50.0)
SIZE = np.array([640, 480])


def pictured(background=SHEET_ON_WOOD, *, seed=3, **placement):
    """Return a correct rig, and a picture of each view."""
    # Asymmetric: otherwise a mirrored picture would equal the other view's.
    simulated = SimulatedRig(
        Placement(**{"azimuths_deg": (-22.0, 10.0), **placement}), background=background
    )
    return rig_from_simulation(simulated), simulated.render(None, rng=seed).images


def with_points(rig, points_px):
    """Return the rig with other reference points in some views."""
    views = list(rig.views)
    for k, points in points_px.items():
        pixels = tuple((float(u), float(v)) for u, v in points)
        views[k] = structs.replace(views[k], reference_points_px=pixels)
    return structs.replace(rig, views=tuple(views))


def given(rig):
    return [np.array(view.reference_points_px) for view in rig.views]


@pytest.fixture(scope="module", params=[SHEET_ON_WOOD, PRINTED], ids=["sheet", "print"])
def right(request):
    return pictured(request.param)


MISTAKES = {
    "rows and columns": lambda px: px[:, ::-1],
    "upwards": lambda px: px * [1, -1] + [0, SIZE[1] - 1],
    "parts of the image": lambda px: (px + 0.5) / SIZE,
    "0.5 times as large": lambda px: px / 2,
    "2 times as large": lambda px: px * 2,
    "the order": lambda px: np.roll(px, 1, axis=0),
}
MADE = [
    (words, views)
    for words, views in product(MISTAKES, [(1,), (0, 1)])
    # An order changed in the first view equals one changed in the other; in both, other axes.
    if words != "the order" or views == (1,)
]


@pytest.mark.parametrize(("words", "views"), MADE)
def test_a_mistake_is_identified_with_the_corrected_points(right, words, views):
    rig, pictures = right
    wrong = with_points(rig, {k: MISTAKES[words](given(rig)[k]) for k in views})
    mistake = Scenery(wrong, pictures).mistake()
    assert words in mistake.what
    assert mistake.is_certain
    corrected = with_points(wrong, mistake.points_px)
    np.testing.assert_allclose(given(corrected), given(rig), atol=1.0)


def test_swapped_points_of_two_views_are_identified(right):
    rig, pictures = right
    first, other = given(rig)
    mistake = Scenery(with_points(rig, {0: other, 1: first}), pictures).mistake()
    assert "swapped" in mistake.what


@pytest.mark.parametrize("crop_px", [(60.0, 40.0), (-25.0, 110.0), (20.0, 5.0)])
@pytest.mark.parametrize("views", [(0,), (0, 1)])
def test_points_measured_in_a_crop_are_corrected(crop_px, views):
    rig, pictures = pictured()
    wrong = with_points(rig, {k: given(rig)[k] - crop_px for k in views})
    mistake = Scenery(wrong, pictures).mistake()
    assert f"off by ({-crop_px[0]:g}, {-crop_px[1]:g}) px".replace("-0", "0") in (
        mistake.what.replace("-0,", "0,").replace("-0)", "0)")
    )
    corrected = with_points(wrong, mistake.points_px)
    np.testing.assert_allclose(given(corrected), given(rig), atol=1.5)


@pytest.mark.parametrize("seed", range(5))
def test_points_with_individual_errors_are_corrected(seed):
    rig, pictures = pictured()
    turn = np.random.default_rng(seed).uniform(0, 2 * np.pi, 4)
    off_px = 25.0 * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    wrong = with_points(rig, {1: given(rig)[1] + off_px})
    mistake = Scenery(wrong, pictures).mistake()
    corrected = with_points(wrong, mistake.points_px)
    np.testing.assert_allclose(given(corrected)[1], given(rig)[1], atol=4.0)


@pytest.mark.parametrize("background", [SHEET_ON_WOOD, PRINTED], ids=["corners", "none"])
def test_points_that_are_mirrored_in_both_views_are_not_called_swapped(background):
    rig, pictures = pictured(background)
    mirrored = {k: points * [-1, 1] + [SIZE[0] - 1, 0] for k, points in enumerate(given(rig))}
    mistake = Scenery(with_points(rig, mirrored), pictures).mistake()
    assert "the image was mirrored in all views" in mistake.what
    assert mistake.is_certain
    if "swapped" in mistake.what:  # the texture fits both, and there are no corners
        assert background is PRINTED
        assert mistake.points_px == {}
        return
    corrected = with_points(rig, mistake.points_px)
    np.testing.assert_allclose(given(corrected), given(rig), atol=1.0)


@pytest.mark.parametrize("words", ["rows and columns", "upwards"])
def test_the_doctor_names_a_mistake_in_one_view_that_turns_the_plane_over(words):
    rig, pictures = pictured()
    wrong = with_points(rig, {1: MISTAKES[words](given(rig)[1])})
    findings = examine(wrong, [[Frame(0, 0.0, picture)] for picture in pictures]).findings
    (error,) = [finding for finding in findings if finding.severity == "error"]
    assert words in error.what
    assert "would be right" in error.right
    assert error.view == "right"


@pytest.mark.parametrize("seed", range(3))
def test_no_corrected_line_is_given_for_a_wrong_corner(seed):
    """Another object's corner is nearer to a point than its own."""
    rig, pictures = pictured(seed=seed)
    pictures = [picture.copy() for picture in pictures]
    turn = np.random.default_rng(seed).uniform(0, 2 * np.pi, 4)
    wrong = given(rig)[1] + 30.0 * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    u, v = (int(c) for c in np.round(wrong[seed]))
    pictures[1][v : v + 12, u : u + 12] = 255
    mistake = Scenery(with_points(rig, {1: wrong}), pictures).mistake()
    if mistake.points_px:
        assert np.linalg.norm(mistake.points_px[1] - given(rig)[1], axis=1).max() < 4.0


@pytest.mark.parametrize("turn_rad", [0.0, 0.6])
def test_points_around_another_part_of_the_table_are_reported_without_a_correction(right, turn_rad):
    rig, pictures = right
    middle = given(rig)[1].mean(axis=0)
    turn = np.array([[np.cos(turn_rad), np.sin(turn_rad)], [-np.sin(turn_rad), np.cos(turn_rad)]])
    shrunk = middle + (0.6 if turn_rad == 0.0 else 1.0) * (given(rig)[1] - middle) @ turn
    wrong = with_points(rig, {1: shrunk})
    mistake = Scenery(wrong, pictures).mistake()
    assert "do not show the same table" in mistake.what
    assert not mistake.is_certain
    assert mistake.advice(wrong).startswith("compare every point")


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    "background", [SHEET_ON_WOOD, PRINTED, Background(), Background(sheet=80.0)]
)
def test_a_correct_rig_has_no_findings(background, seed):
    rng = np.random.default_rng(seed)
    rig, pictures = pictured(
        background,
        seed=seed,
        azimuths_deg=(-float(rng.uniform(5, 40)), float(rng.uniform(5, 40))),
        elevation_deg=float(rng.uniform(30, 70)),
    )
    order = rng.permutation(4)
    plane = structs.replace(rig.plane, points=tuple(rig.plane.points[k] for k in order))
    views = [
        structs.replace(view, reference_points_px=tuple(map(tuple, points[order].tolist())))
        for view, points in zip(rig.views, given(rig), strict=True)
    ]
    rig = Rig(plane=plane, views=tuple(views))
    scenery = Scenery(rig, pictures)
    assert scenery.mistake() is None
    assert scenery.bends() == {}
    assert scenery.same_pictures() is None
    frames = [
        [Frame(k, k / 30, np.clip(p + rng.normal(0, 2, p.shape), 0, 255).astype(np.uint8))]
        for k in range(4)
        for p in pictures
    ]
    frames = [[*itertools.chain(*frames[k::2])] for k in (0, 1)]
    findings = examine(rig, frames).findings
    assert [f for f in findings if f.check == "references" and "off the corner" not in f.what] == []
    assert [f for f in findings if f.check in ("lens", "timing")] == []


@pytest.mark.parametrize("background", [SHEET_ON_WOOD, Background(texture="wood"), Background()])
@pytest.mark.parametrize("seed", range(3))
def test_a_visible_hand_is_no_mistake_of_a_correct_rig(background, seed):
    rng = np.random.default_rng(seed)
    simulated = SimulatedRig(background=background)  # symmetric cameras
    pose = DevicePose.pointing_at(
        tuple(rng.uniform(120, 280, 2)), azimuth_deg=35.0, slant_deg=45.0, hover_mm=80.0
    )
    pictures = simulated.render(pose, rng=seed).images
    assert Scenery(rig_from_simulation(simulated), pictures).mistake() is None


@pytest.mark.parametrize("seed", [2, 3, 8])
def test_points_beside_the_corners_of_a_noisy_wooden_table_are_no_mistake(seed):
    """Wood has 150 corners in a picture; one is near every point, wherever the points are."""
    background, sensor = Background(texture="wood", seed=seed), Sensor(noise=4.0)
    simulated = SimulatedRig(device=Hand(), background=background, sensor=sensor)
    rng = np.random.default_rng(seed)
    pictures = simulated.render(PoseSampler(simulated).draw(rng), rng=rng).images
    scenery = Scenery(rig_from_simulation(simulated), pictures)
    assert scenery.mistake() is None
    assert scenery.agreement() < 0.8  # or the texture would leave nothing to decide


@pytest.mark.parametrize("words", ["upwards", "2 times as large"])
def test_a_faint_sheet_shows_a_mistake_by_its_corners_alone(words):
    rig, pictures = pictured(Background(sheet=13.0), seed=0)
    wrong = with_points(rig, {k: MISTAKES[words](given(rig)[k]) for k in (0, 1)})
    mistake = Scenery(wrong, pictures).mistake()
    assert words in mistake.what
    assert not mistake.is_certain


@pytest.mark.parametrize("height_mm", [-25.0, 25.0])
def test_a_plane_above_or_below_the_table_is_no_mistake(height_mm):
    """As defined by a robot: its points are not in the plane of the table's texture."""
    simulated = SimulatedRig(background=SHEET_ON_WOOD)
    rig, pictures = rig_from_simulation(simulated), simulated.render(None, rng=1).images
    points = np.column_stack([rig.plane.points, np.full(len(rig.plane.points), height_mm)])
    seen = {k: camera.project(points) for k, camera in enumerate(simulated.cameras)}
    raised = with_points(rig, seen)
    assert Scenery(raised, pictures).agreement() < 0.7
    assert Scenery(raised, pictures).mistake() is None


def test_more_than_four_points_and_inner_ones_are_no_mistake():
    simulated = SimulatedRig(
        workspace=Workspace(points_per_side=3), background=Background(texture="wood", clutter=30.0)
    )
    rig, pictures = rig_from_simulation(simulated), simulated.render(None, rng=0).images
    assert len(rig.plane.points) == 9
    assert Scenery(rig, pictures).mistake() is None
    inner = [0, 1, 2, 3, 8]
    some = structs.replace(rig.plane, points=tuple(rig.plane.points[k] for k in inner))
    views = [
        structs.replace(view, reference_points_px=tuple(map(tuple, points[inner].tolist())))
        for view, points in zip(rig.views, given(rig), strict=True)
    ]
    rig = Rig(plane=some, views=tuple(views))
    frames = [[Frame(0, 0.0, picture)] for picture in pictures]
    found = [f.what for f in examine(rig, frames).findings if f.check == "references"]
    assert [what for what in found if "off the corner" not in what] == []


def test_two_views_of_the_same_picture_are_refused():
    rig, pictures = pictured()
    both = [pictures[0], pictures[0]]
    assert "show the same picture" in Scenery(rig, both).same_pictures().what
    with pytest.raises(InvalidInputError, match="show the same picture"):
        run(rig, both)


def test_empty_pictures_and_single_views_are_reported():
    rig, pictures = pictured()
    grey = np.full((480, 640), 128, np.uint8)
    frames = [[Frame(0, 0.0, picture)] for picture in (pictures[0], grey)]
    found = examine(rig, frames).findings
    assert any(f.view == "right" and "nothing in its pictures" in f.what for f in found)
    alone = Rig(plane=rig.plane, views=rig.views[:1])
    assert any("two or more" in f.right for f in examine(alone, frames[:1]).findings)


def run(rig, pictures, frames=1):
    pointer = Pointer(rig)
    together = ([Frame(k, k / 30, p) for p in pictures] for k in range(frames))
    return list(steps(pointer, together))


def test_a_run_refuses_a_certain_mistake_and_gives_the_corrected_line():
    rig, pictures = pictured()
    wrong = with_points(rig, {k: points[:, ::-1] for k, points in enumerate(given(rig))})
    with pytest.raises(InvalidInputError, match="rows and columns") as refused:
        run(wrong, pictures)
    first = "[[" + ", ".join(f"{c:.1f}" for c in given(rig)[1][0]) + "]"
    assert f'view "right": reference_points_px = {first}' in str(refused.value)


def test_points_measured_in_pictures_of_another_size_are_refused():
    rig, pictures = pictured()
    resized = structs.replace(rig.views[0], size_px=(1280, 960))
    rig = structs.replace(rig, views=(resized, rig.views[1]))
    with pytest.raises(InvalidInputError, match=r"640 × 480 px, and size_px = \[1280, 960\]"):
        run(rig, pictures)


@pytest.mark.parametrize("k1", [-0.3, -0.25, 0.3])
def test_lens_distortion_is_estimated_from_straight_sides(k1):
    simulated = SimulatedRig(
        Placement(distance_m=0.75, f_px=640.0, k1=(k1,)), background=SHEET_ON_WOOD
    )
    rig, pictures = rig_from_simulation(simulated), simulated.render(None, rng=0).images
    bends = Scenery(rig, pictures).bends()
    assert set(bends) == {0, 1}
    for bend in bends.values():
        # The focal length is assumed, and k1 is proportional to its square.
        assert bend.lens.k1 * (640.0 / bend.lens.fx) ** 2 == pytest.approx(k1, abs=0.08)


def test_a_lens_that_bends_one_image_is_expected_in_the_other():
    placement = Placement(distance_m=0.75, f_px=640.0, k1=(-0.25, -0.12))
    simulated = SimulatedRig(placement, background=SHEET_ON_WOOD)
    rig, pictures = rig_from_simulation(simulated), simulated.render(None, rng=0).images
    bends = Scenery(rig, pictures).bends()
    assert bends[1].bent_px < BENT_PX < bends[0].bent_px
    for bend, k1 in zip(bends.values(), (-0.25, -0.12), strict=True):
        assert bend.lens.k1 * (640.0 / bend.lens.fx) ** 2 == pytest.approx(k1, abs=0.08)


def test_ellipses_hold_with_an_uncorrected_lens():
    simulated = SimulatedRig(
        Placement(distance_m=0.75, f_px=640.0, k1=(-0.25,)), background=SHEET_ON_WOOD
    )
    rng = np.random.default_rng(5)
    held = []
    for _ in range(4):
        target = rng.uniform(120, 280, 2)
        pose = DevicePose.pointing_at(target, slant_deg=50.0, hover_mm=60.0)
        starts = [view.finger.start() for view in simulated.truth(pose).views]
        rig = rig_from_simulation(simulated, starts=starts)
        pointer = Pointer(rig)
        frames = (
            [Frame(k, k / 30, i) for i in simulated.render(pose, rng=rng).images] for k in range(8)
        )
        *_, last = steps(pointer, frames)
        if last.fix.status is Status.OK:
            off = last.fix.point - target
            held.append(off @ np.linalg.solve(last.fix.covariance, off) <= 5.99)
    assert len(held) >= 3
    assert np.mean(held) >= 0.75


@pytest.mark.parametrize(("off_px", "seed"), [(20.0, 2), (45.0, 0), (45.0, 2)])
def test_ellipses_hold_where_points_may_be_off(off_px, seed):
    """Points of one view, each off on its own, on a table without corners: no correction fits."""
    simulated = SimulatedRig(
        Placement(azimuths_deg=(-22.0, 10.0)), device=Hand(), background=PRINTED
    )
    rng = np.random.default_rng(seed)
    turn = rng.uniform(0, 2 * np.pi, 4)
    off = off_px * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    target = rng.uniform(140, 260, 2)
    pose = DevicePose.pointing_at(target, slant_deg=50.0, hover_mm=80.0)
    starts = [view.finger.start() for view in simulated.truth(pose).views]
    rig = rig_from_simulation(simulated, starts=starts)
    assert run(rig, simulated.render(pose, rng=rng).images, 8)[-1].fix.status is Status.OK
    wrong = with_points(rig, {1: given(rig)[1] + off})
    fix = run(wrong, simulated.render(pose, rng=rng).images, 8)[-1].fix
    if fix.status is Status.OK:
        error = fix.point - target
        assert error @ np.linalg.solve(fix.covariance, error) <= 5.99
    else:
        assert fix.status is Status.ILL_CONDITIONED
