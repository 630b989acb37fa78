"""Estimation of the plane by the robot: visits, finders, refusals; rendered and emulated."""

import math
from contextlib import contextmanager

import cv2
import numpy as np
import pytest
from guidance_scene import (
    HEIGHT_M,
    MARKER_SIDE_M,
    NAMES,
    REGION_M,
    TILT_RAD,
    TURN_RAD,
    DrawnViews,
    LockstepClock,
    cameras,
    draw_gripper,
    draw_marker,
    pixel,
    table,
)
from robot_rig import ManualClock, scorbot_rig

from fingerpost import StartPose, Template
from fingerpost.capture import Frame
from fingerpost.config import Rig
from fingerpost.errors import CaptureError, InvalidInputError, RigError
from fingerpost.guidance import (
    ContourFinder,
    GivenFinder,
    GripperNotFoundError,
    InconsistentPlaneError,
    MarkerFinder,
    MotionFinder,
    PlaneOptions,
    PoorPlaneError,
    define_plane,
    guard_of,
    held_down,
    load_outline,
    load_pixels,
    plane_of,
    region_of,
    robot_of,
)
from fingerpost.pointing import PlaneView
from fingerpost.robot import (
    GuardOptions,
    NotArmedError,
    OutOfReachError,
    Pose,
    SimulatedRobot,
    StoppedError,
)
from fingerpost.robot.simulated import SimulatedOptions

BLANK = np.zeros((480, 640), np.uint8)
QUICK = {"settle_s": 0.1, "frames": 2, "speed_m_s": 1.0}
PATIENT = {"operator_timeout_s": 1e6, "max_speed_m_s": 1.0}


class Rigged:
    """A simulated robot and blank views; finders are given the gripper's position."""

    def __init__(self, *, arm=True, clock=None, **changes):
        self.clock = clock or ManualClock()
        self.table = table(**changes)
        self.robot = SimulatedRobot(
            SimulatedOptions(homing_s=0.0), clock=self.clock, sleep=self.clock.sleep
        )
        self.robot.connect()
        self.robot.home()
        self.guard = guard_of(self.robot, self.table, GuardOptions(**PATIENT), clock=self.clock)
        if arm:
            self.guard.arm()
        self.views = DrawnViews(self.robot, self.clock, lambda *_, **__: [BLANK, BLANK])
        self.stood = []

    def here(self):
        return np.array(self.robot.position[:3])

    def given(self, *, seed=0, sigma_px=0.3, wrong=lambda *_: None):
        """Return finders that know the gripper's position up to noise and the errors `wrong`."""
        rng = np.random.default_rng(seed)
        calls = [0, 0]

        def finder(view):
            def ask(place, _frame):
                calls[view] += 1
                if view == 0:
                    self.stood.append((place, self.here()))
                true = pixel(view, self.here())
                other = wrong((place, calls[view]), view)
                if other is not None:
                    return None if np.isnan(other).any() else true + other
                return true + rng.normal(0, sigma_px, 2)

            return GivenFinder(ask, sigma_px=sigma_px)

        return [finder(0), finder(1)]

    def define(self, finders, **options):
        options = PlaneOptions(**{**QUICK, **options})
        return define_plane(self.guard, cameras(), self.views, finders, options)


def errors_m(found, points, z_m=HEIGHT_M):
    """Return the errors of each view's plane at points of the robot's plane [m]."""
    points = np.asarray(points, dtype=float)
    world = np.column_stack([points, np.full(len(points), z_m)])
    return np.array(
        [
            np.linalg.norm(tie.plane_view.back_project(pixel(k, world)) - points, axis=1)
            for k, tie in enumerate(found.ties)
        ]
    )


# Visits.


def test_the_estimated_plane_is_accurate():
    rigged = Rigged()
    found = rigged.define(rigged.given())
    assert found.left_out == {}
    assert found.height_m == pytest.approx(HEIGHT_M, abs=1e-9)
    assert errors_m(found, REGION_M).max() < 4 * found.sigma_m.max()
    assert found.sigma_m.max() < 0.0012
    assert len(found.positions_m) == 9
    assert found.lines()[0] == "plane at Z = 0.0200 m by 9 of 9 places"


def test_a_plane_50_mm_higher_is_as_accurate():
    rigged = Rigged(height_m=HEIGHT_M + 0.05)
    found = rigged.define(rigged.given())
    assert found.height_m == pytest.approx(HEIGHT_M + 0.05)
    assert errors_m(found, REGION_M, HEIGHT_M + 0.05).max() < 4 * found.sigma_m.max()


def test_places_are_approached_and_left_vertically():
    rigged = Rigged()
    rigged.define(rigged.given(), lift_m=0.04)
    goals = [r.pose for r in rigged.guard.records if r.command == "visit"]
    for above, at, away in zip(goals[0::3], goals[1::3], goals[2::3], strict=True):
        assert above.z_m == away.z_m == pytest.approx(HEIGHT_M + 0.04)
        assert at == above.at_height(at.z_m)
        assert at.z_m == pytest.approx(HEIGHT_M)
    assert len(goals) == 27
    assert all(rigged.guard.region.contains((g.x_m, g.y_m), g.z_m - HEIGHT_M) for g in goals)


def test_only_frames_of_an_arm_at_rest_count():
    rigged = Rigged()
    seen = []

    class Looking(GivenFinder):
        def find(self, place, frames, elsewhere):
            seen.append((frames[0].time_s, len(frames), len(elsewhere)))
            return super().find(place, frames, elsewhere)

    finders = [Looking(lambda *_, k=k: pixel(k, rigged.here())) for k in range(2)]
    arrived = []
    wait = rigged.robot.wait
    rigged.robot.wait = lambda **f: (wait(**f), arrived.append(rigged.clock()))
    rigged.define(finders, settle_s=0.5, frames=3, points=5)
    for first_s, count, _ in seen:
        stood_s = max(time_s for time_s in arrived if time_s < first_s)
        assert first_s >= stood_s + 0.5
        assert count == 3
    assert [others for _, _, others in seen[::2]] == [1, 2, 3, 4, 5]


def test_the_same_seed_gives_the_same_bits():
    dumps = [
        rigged.define(rigged.given(seed=5)).rig(cameras(), rigged.table).dumps()
        for rigged in (Rigged(), Rigged())
    ]
    assert dumps[0] == dumps[1]


def test_a_second_run_agrees_within_the_covariance_of_both():
    """The squared distance of two runs' homographies, at four points, is a χ² with 8 degrees."""
    distances = []
    for seed in range(12):
        first, second = (
            rigged.define(rigged.given(seed=100 * seed + k), points=6, arm_sigma_m=0.0)
            for k, rigged in enumerate((Rigged(), Rigged()))
        )
        for a, b in zip(first.ties, second.ties, strict=True):
            # The pixels of four points determine a homography.
            apart = (a.plane_view.project(REGION_M) - b.plane_view.project(REGION_M)).ravel()
            Σ = _pixels_covariance(a) + _pixels_covariance(b)
            distances.append(float(apart @ np.linalg.solve(Σ, apart)))
    # The mean of 24 such values is 8 ± 0.8.
    assert 8 - 4 * 0.82 < np.mean(distances) < 8 + 4 * 0.82


def _pixels_covariance(tie):
    from fingerpost.homography import transfer_jacobian_by_entries

    J = transfer_jacobian_by_entries(tie.plane_view.image_from_plane, np.array(REGION_M))
    J = J.reshape(8, 9)
    return J @ tie.plane_view.entries_covariance @ J.T


# Wrong places.


def test_a_place_with_a_wrong_detection_is_visited_again():
    rigged = Rigged()
    wrong = rigged.given(wrong=lambda visit, view: [30, 5] if visit == (3, 4) and view else None)
    found = rigged.define(wrong)
    assert found.left_out == {}
    assert found.revisited == {3}
    assert [place for place, _ in rigged.stood] == [*range(9), 3]
    assert errors_m(found, REGION_M).max() < 4 * found.sigma_m.max()


def test_a_repeatedly_wrong_place_is_left_out_and_named():
    rigged = Rigged()
    found = rigged.define(
        rigged.given(wrong=lambda visit, view: [30, 5] if visit[0] == 3 and not view else None)
    )
    assert set(found.left_out) == {3}
    assert "place 4 left out: what was found there does not agree" in "\n".join(found.lines())
    assert len(found.positions_m) == 8
    assert errors_m(found, REGION_M).max() < 4 * found.sigma_m.max()
    rig = found.rig(cameras(), rigged.table)
    assert len(rig.plane.points) == len(rig.views[1].reference_points_px) == 8


def test_a_place_without_a_detection_is_left_out_and_named():
    rigged = Rigged()
    found = rigged.define(
        rigged.given(wrong=lambda visit, view: [np.nan] * 2 if visit[0] == 6 and view else None)
    )
    assert found.left_out == {6: "not found in view right: no pixel is given"}
    assert found.as_dict()["left_out"] == {"7": "not found in view right: no pixel is given"}


def test_a_gripper_that_is_seldom_found_is_an_error():
    rigged = Rigged()
    unseen = rigged.given(wrong=lambda visit, _: [np.nan] * 2 if visit[0] > 2 else None)
    with pytest.raises(GripperNotFoundError, match=r"found at 3 of 9 places.* at 6: not found"):
        rigged.define(unseen)


def test_inconsistent_places_are_an_error():
    rigged = Rigged()
    rng = np.random.default_rng(1)
    confused = rigged.given(wrong=lambda *_: rng.normal(0, 4, 2))
    with pytest.raises(InconsistentPlaneError):
        rigged.define(confused, revisits=0)


def test_an_uncertain_plane_is_refused():
    rigged = Rigged()
    with pytest.raises(PoorPlaneError, match=r"at most 0\.3 mm will do"):
        rigged.define(rigged.given(), max_sigma_m=0.0003)


# Refused motions.


def test_nothing_is_visited_without_arming():
    rigged = Rigged(arm=False)
    before = rigged.here()
    with pytest.raises(NotArmedError):
        rigged.define(rigged.given())
    np.testing.assert_array_equal(rigged.here(), before)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"lift_m": 0.5}, "the way over them would have the gripper at Z = 0.5200 m"),
        ({"offset_m": (0.0, 0.0, 0.04)}, "the places would have the gripper at Z = -0.0200 m"),
    ],
)
def test_heights_outside_the_region_are_refused_before_anything_moves(options, words):
    rigged = Rigged()
    with pytest.raises(OutOfReachError, match=words):
        rigged.define(rigged.given(), **options)
    assert not [r for r in rigged.guard.records if r.pose is not None]


def test_a_stop_ends_the_visits():
    rigged = Rigged()
    rigged.clock.at(rigged.clock() + 2.0, lambda: rigged.guard.halt("enough"))
    with pytest.raises((StoppedError, NotArmedError)):
        rigged.define(rigged.given(), speed_m_s=0.1)
    assert not rigged.guard.armed


def test_lagging_views_are_an_error():
    rigged = Rigged()

    def lagging():
        rigged.clock.sleep(0.5)
        return [Frame(0, 0.0, BLANK)] * 2

    rigged.views = lagging
    with pytest.raises(CaptureError, match="no frames from after"):
        rigged.define(rigged.given())


def test_every_view_needs_a_finder():
    rigged = Rigged()
    with pytest.raises(InvalidInputError, match="1 finders for 2 views"):
        rigged.define(rigged.given()[:1])


# The resulting rig.


def test_the_rig_file_round_trips(tmp_path):
    rigged = Rigged()
    found = rigged.define(rigged.given())
    rig = found.rig(cameras(), rigged.table)
    rig.save(tmp_path / "plane.toml")
    loaded = Rig.load(tmp_path / "plane.toml")
    assert loaded == rig
    assert robot_of(loaded) == rigged.table
    for tie, view in zip(found.ties, loaded.views, strict=True):
        plane_view = PlaneView.from_reference_points(
            loaded.plane.points, view.reference_points_px, view.reference_covariances(99.0)
        )
        for name in ("image_from_plane", "entries_covariance"):
            expected = getattr(tie.plane_view, name)
            np.testing.assert_allclose(
                getattr(plane_view, name), expected, rtol=0, atol=1e-9 * np.abs(expected).max()
            )


def test_a_rig_without_robot_or_in_other_units_is_refused():
    rig = cameras()
    with pytest.raises(RigError, match=r"no \[robot\] table"):
        robot_of(rig)
    import msgspec

    with pytest.raises(RigError, match="metres"):
        robot_of(msgspec.structs.replace(rig, robot=table()))


def test_the_robot_table_defines_plane_region_and_guard():
    fields = table(pitch_deg=-90.0, roll_deg=10.0)
    plane = plane_of(fields)
    assert plane.pose([0.4, 0.1], 0.05) == Pose(
        0.4, 0.1, HEIGHT_M + 0.05, -math.pi / 2, math.radians(10.0)
    )
    region = region_of(fields)
    assert region.lowest_m == pytest.approx(0.005 - HEIGHT_M)
    assert region.highest_m == pytest.approx(0.25 - HEIGHT_M)


def test_the_gripper_points_down_as_far_as_the_arm_allows():
    robot = SimulatedRobot(SimulatedOptions(homing_s=0.0))
    pose = Pose(0.3, 0.0, 0.3, pitch_rad=-1.0, roll_rad=math.radians(30.0))
    assert held_down(robot, pose) == pytest.approx({"pitch_deg": -90.0, "roll_deg": 30.0})


# Finders.


def test_a_marker_at_the_tip():
    rigged = Rigged()
    rigged.views.draw = lambda at, **_: draw_marker(at)
    found = rigged.define([MarkerFinder(3, sigma_px=0.15) for _ in NAMES])
    assert max(tie.rms_px for tie in found.ties) < 0.15
    assert errors_m(found, REGION_M).max() < 0.0006


def test_a_tip_in_the_markers_plane_below_it():
    """The marker is tilted; the tip lies in its plane, on the extension of its vertical axis."""
    below = 1.2  # sides of the marker, below its centre
    down = np.array([*(_turned(0.0, -math.sin(TILT_RAD))), -math.cos(TILT_RAD)])
    rigged = Rigged()
    rigged.views.draw = lambda at, **_: draw_marker(at, centre_m=-below * MARKER_SIDE_M * down)
    found = rigged.define([MarkerFinder(3, tip=(0.0, below), sigma_px=0.15) for _ in NAMES])
    assert errors_m(found, REGION_M).max() < 0.002
    assert errors_m(found, REGION_M).max() < 4 * found.sigma_m.max()
    far = found.visits[0].sightings[0].covariance_px2
    assert np.sqrt(np.linalg.eigvalsh(far)[-1]) > 0.2  # extrapolation magnifies the corners' errors


def _turned(x, y):
    c, s = math.cos(-TURN_RAD), math.sin(-TURN_RAD)
    return c * x - s * y, s * x + c * y


def test_a_marker_at_a_known_offset():
    """The marker's centre visits the plane, with the tip at an offset."""
    offset = (0.012, -0.02, 0.03)
    rigged = Rigged(height_m=0.06)
    rigged.views.draw = lambda at, **_: draw_marker(at, centre_m=offset)
    found = rigged.define(
        [MarkerFinder(3, sigma_px=0.15) for _ in NAMES], offset_m=offset, lift_m=0.02
    )
    assert found.height_m == pytest.approx(0.06)
    assert errors_m(found, REGION_M, 0.06).max() < 0.0006


def test_no_marker_and_two_markers_are_errors():
    finder = MarkerFinder(3)
    left = draw_marker([0.43, 0.1, HEIGHT_M])[0]
    finder.find(0, [Frame(0, 0.0, left)], [])
    for image in (BLANK, np.vstack([left, left])):
        with pytest.raises(GripperNotFoundError, match="no marker 3"):
            finder.find(0, [Frame(0, 0.0, image)], [])
    with pytest.raises(GripperNotFoundError):
        MarkerFinder(4).find(0, [Frame(0, 0.0, left)], [])


def test_a_markers_covariance_matches_monte_carlo():
    finder = MarkerFinder(3, tip=(0.3, 1.5), sigma_px=0.2)
    frame = Frame(0, 0.0, draw_marker([0.43, 0.1, HEIGHT_M])[0])
    corners = finder._corners(frame)
    rng = np.random.default_rng(4)
    drawn = [finder._tip_px(corners + rng.normal(0, 0.2, (4, 2))) for _ in range(4000)]
    expected = finder.find(0, [frame], []).covariance_px2
    np.testing.assert_allclose(np.cov(np.transpose(drawn)), expected, atol=0.08 * expected.max())


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"dictionary": "9X9"}, "4X4_50"),
        ({"marker_id": 50}, "0 to 49"),
        ({"tip": (math.nan, 0.0)}, "tip"),
        ({"sigma_px": 0.0}, "sigma_px"),
    ],
)
def test_invalid_markers_are_refused(fields, words):
    with pytest.raises(InvalidInputError, match=words):
        MarkerFinder(**fields)


def test_motion_finds_the_gripper():
    rng = np.random.default_rng(6)
    rigged = Rigged()
    rigged.views.draw, rigged.views.rng = draw_gripper, rng
    found = rigged.define([MotionFinder() for _ in NAMES])
    assert found.left_out == {}
    assert max(tie.rms_px for tie in found.ties) < 0.6
    # The outline ends one radius, 4 mm or 0.7 px, beyond the rod's axis.
    assert errors_m(found, REGION_M).max() < 0.003


@pytest.mark.parametrize("towards_deg", [0.0, 90.0, 180.0, 270.0])
def test_motion_finds_the_end_in_the_given_direction(towards_deg):
    image = BLANK.copy()
    cv2.ellipse(image, (300, 200), (60, 30), 0.0, 0, 360, 200, -1)
    frames = [Frame(0, 0.0, image)]
    found = MotionFinder(towards_deg=towards_deg).find(0, frames, [BLANK]).pixel_px
    expected = {0.0: (360, 200), 90.0: (300, 230), 180.0: (240, 200), 270.0: (300, 170)}
    np.testing.assert_allclose(found, expected[towards_deg], atol=1.6)


def test_static_objects_do_not_count_as_motion():
    image, before = BLANK.copy(), BLANK.copy()
    for one in (image, before):
        cv2.rectangle(one, (100, 300), (160, 400), 255, -1)
    cv2.rectangle(image, (300, 0), (310, 150), 180, -1)
    arm_there = before.copy()
    cv2.rectangle(arm_there, (300, 0), (310, 90), 180, -1)  # the arm of another visit
    for elsewhere in (
        [before],
        [before, arm_there, before],
        [before, arm_there, arm_there, before],
    ):
        sighting = MotionFinder().find(0, [Frame(0, 0.0, image)], elsewhere)
        assert sighting.pixel_px[1] == pytest.approx(150, abs=1.6)


def test_missing_motion_and_motion_beyond_the_image_are_errors():
    finder = MotionFinder()
    for image, elsewhere, words in (
        (BLANK, [], "elsewhere"),
        (BLANK, [BLANK], "nothing as large"),
        (
            np.where(np.arange(480)[:, None] > 300, np.uint8(200), BLANK),
            [BLANK],
            "out of the image",
        ),
    ):
        with pytest.raises(GripperNotFoundError, match=words):
            finder.find(0, [Frame(0, 0.0, image)], elsewhere)


def _standing_start(guard, view, z_m):
    """Return a view's start pose of the gripper above the middle of the region."""
    at = np.array([*guard.allowed.centre, z_m])
    tip, above = pixel(view, at), pixel(view, at + np.array([0, 0, 0.08]))
    along = tip - above
    return tip, above, math.atan2(along[1], along[0]), float(np.hypot(*along))


@pytest.mark.parametrize("traced", [False, True])
def test_the_tracker_follows_the_gripper(traced, tmp_path):
    rng = np.random.default_rng(7)
    rigged = Rigged(clock=LockstepClock(), z_m=(0.005, 0.12))
    rigged.views.draw, rigged.views.rng = draw_gripper, rng
    finders = []
    for view in range(2):
        tip, above, angle_rad, length_px = _standing_start(rigged.guard, view, 0.119)
        template = Template.pistol("none")
        if traced:
            path = tmp_path / f"{view}.csv"
            np.savetxt(path, _traced_rod(tip, above), delimiter=",")
            template = load_outline(path)
        finders.append(
            ContourFinder(template, StartPose(tip, angle_rad, length_px), polarity="bright")
        )
    found = rigged.define(finders, points=5, speed_m_s=0.2, frames=3, lift_m=0.01)
    assert found.left_out == {}
    assert max(tie.rms_px for tie in found.ties) < 0.3
    assert errors_m(found, REGION_M).max() < 0.003


def _traced_rod(tip, above, half_width_px=2.9):
    """Return axis and outline of a rod, right flank first, as a person would click them."""
    e = (tip - above) / np.linalg.norm(tip - above)
    n = np.array([-e[1], e[0]])
    start = above + 0.1 * (tip - above)
    end = tip - half_width_px * e
    turn = np.linspace(0, math.pi, 9)[:, None]
    cap = end + half_width_px * (np.cos(turn) * -n + np.sin(turn) * e)
    right = start - half_width_px * n + np.linspace(0, 1, 12)[:, None] * (end - start)
    left = (start + half_width_px * n + np.linspace(0, 1, 12)[:, None] * (end - start))[::-1]
    return np.vstack([above, tip, right, cap[1:-1], left])


def test_a_tracker_without_a_gripper_reports_its_state():
    finder = ContourFinder(Template.pistol("none"), StartPose((320, 240), 1.5, 60))
    with pytest.raises(GripperNotFoundError, match="tracker: acquiring"):
        finder.find(0, [Frame(0, 0.0, BLANK)], [])


@pytest.mark.parametrize("pixel_px", [(-1.0, 5.0), (640.0, 5.0), (5.0, 480.0), (math.nan, 1.0)])
def test_a_given_pixel_is_in_the_image(pixel_px):
    finder = GivenFinder(lambda *_: pixel_px)
    with pytest.raises(InvalidInputError, match="pixel of place 3"):
        finder.find(2, [Frame(0, 0.0, BLANK)], [])


# Files.


def test_pixels_from_a_file(tmp_path):
    path = tmp_path / "pixels.csv"
    path.write_text("view,place,u,v,note\nleft,1,10,20.5,a\nright,1,3,4,\nleft,2,5,6,\n")
    assert load_pixels(path) == {"left": {0: (10, 20.5), 1: (5, 6)}, "right": {0: (3, 4)}}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("place,view,u\n1,left,2\n", "no column v"),
        ("place,view,u,v\n0,left,2,3\n", "line 2: a place from 1"),
        ("place,view,u,v\n1,left,2,nan\n", "line 2"),
        ("place,view,u,v\n1,left,2\n", "line 2"),
        ("place,view,u,v\n1,left,2,3\n1,left,2,3\n", "line 3: place 1 of view left is given twice"),
        ("", "no column"),
    ],
)
def test_invalid_pixel_files_are_refused(tmp_path, text, words):
    path = tmp_path / "pixels.csv"
    path.write_text(text)
    with pytest.raises(InvalidInputError, match=words):
        load_pixels(path)
    with pytest.raises(InvalidInputError, match="No such file"):
        load_pixels(tmp_path / "none.csv")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("1,2\n3,4\n5,6\n", "3 lines"),
        ("a,b\n", "one point u,v per line"),
        ("1,2\n1,2\n" * 4, "outline.csv"),
    ],
)
def test_invalid_outline_files_are_refused(tmp_path, text, words):
    path = tmp_path / "outline.csv"
    path.write_text(text)
    with pytest.raises(InvalidInputError, match=words):
        load_outline(path)


# With the paper's robot, a Scorbot.


@contextmanager
def scorbot_plane(**options):
    with scorbot_rig(time_scale=10.0) as rig:
        guard = guard_of(
            rig.robot,
            table(pitch_deg=-90.0, roll_deg=0.0),
            GuardOptions(operator_timeout_s=1e6, max_speed_m_s=0.3),
            clock=rig.clock,
        )
        guard.arm()
        yield rig, guard


def test_an_emulated_scorbot_defines_a_plane():
    with scorbot_plane() as (rig, guard):

        def frames():
            rig.clock.sleep(0.1)
            return [Frame(0, rig.clock(), BLANK)] * 2

        finders = [
            GivenFinder(lambda *_, k=k: pixel(k, rig.true_pose().position_m), sigma_px=0.2)
            for k in range(2)
        ]
        options = PlaneOptions(settle_s=0.1, frames=1, points=6, speed_m_s=0.3)
        found = define_plane(guard, cameras(), frames, finders, options)
        # The only error is the arm's rounding to 0.1 mm.
        assert errors_m(found, REGION_M, HEIGHT_M).max() < 0.0006
        assert found.height_m == pytest.approx(HEIGHT_M, abs=2e-4)
