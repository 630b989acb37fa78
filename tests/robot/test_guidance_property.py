"""No command leaves the safe region or is sent on a confidence ellipse larger than the tolerance.

This holds for following, moving, visiting, selecting, picking and placing in any order, over any
region and any homography between plane and robot. Once inside, the arm itself stays inside as well.
"""

import contextlib
import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from robot_rig import ManualClock
from scipy.spatial import ConvexHull
from test_robot_guard import GoalRecorder, fix_at

from fingerpost.errors import FingerpostError, InvalidInputError
from fingerpost.pointing import Status
from fingerpost.robot import (
    DwellSelector,
    Follower,
    FollowOptions,
    Guard,
    GuardOptions,
    OutOfReachError,
    PickPlace,
    PickPlaceOptions,
    Presence,
    RobotPlane,
    SafeRegion,
    Selection,
)
from fingerpost.uncertainty import confidence_ellipse

TOLERANCE_M = 0.01
PATH_M = 1e-6
"""Rounding in the interpolation of a straight path."""

scenes = st.fixed_dictionaries(
    {
        "seed": st.integers(0, 2**32 - 1),
        "corners": st.integers(3, 8),
        "stretch": st.sampled_from([1.0, 0.3]),
        "lean": st.sampled_from([0.0, 2e-4, -3e-4]),
        "slope": st.sampled_from([0.0, 0.05, -0.1]),
        "turn": st.floats(0, 2 * math.pi),
    }
)

ACTIONS = ("follow", "move", "visit", "select", "carry", "hold", "enter")
SHARES = (0.4, 0.15, 0.1, 0.15, 0.1, 0.05, 0.05)


def draw_actions(rng, count):
    """Draw actions, most of them on good fixes, the others on fixes of all kinds."""
    for _ in range(count):
        yield (
            str(rng.choice(ACTIONS, p=SHARES)),
            rng.normal(size=2) * rng.choice([30.0, 30.0, 150.0, 1e4]),
            float(rng.choice([rng.uniform(0.012, 0.1), rng.uniform(-1.0, 1.0)])),
            (*np.abs(rng.normal(size=2)) * rng.choice([1.0, 1.0, 1.0, 8.0]), rng.uniform(0, 3.2)),
            Status(rng.choice([*["ok"] * 6, "lost", "acquiring"])),
            float(rng.choice([0.0, 0.0, 0.0, 0.1, 0.31, 5.0])),
            float(rng.uniform(0.01, 0.6)),
        )


def scene(fields):
    """Return a plane in millimetres, with perspective and slope, and a region on it."""
    rng = np.random.default_rng(fields["seed"])
    scatter = rng.normal(size=(fields["corners"] + 2, 2)) * [60.0, 60.0 * fields["stretch"]]
    corners = scatter[ConvexHull(scatter).vertices]
    c, s = math.cos(fields["turn"]), math.sin(fields["turn"])
    tie = np.array([[1e-3 * c, -1e-3 * s, 0.4], [1e-3 * s, 1e-3 * c, 0.0], [0, fields["lean"], 1]])
    plane = RobotPlane(tie, 0.1, slope=np.array([fields["slope"], 0.02]))
    return plane, SafeRegion(corners, 0.01, 0.11)


class PathRecorder(GoalRecorder):
    """Also records its positions during the pauses of a motion."""

    def __init__(self, clock):
        super().__init__(clock)
        self.been = []
        sleep = clock.sleep

        def recording_sleep(span_s):
            end_s = clock() + span_s
            for part in (4, 3, 2, 1):
                sleep((end_s - clock()) / part)
                self.been.append(np.array(self.position[:3]))

        clock.sleep = recording_sleep
        self._sleep_for = recording_sleep


def good_enough(plane, fix, now_s):
    """Return whether a fix may move the arm, computed independently of the guard."""
    if fix.status is not Status.OK or now_s - fix.time_s > 0.3:
        return False
    ellipse = confidence_ellipse(
        plane.position_m(fix.point), plane.covariance_m2(fix.point, fix.covariance), 0.95
    )
    return bool(ellipse.semi_axes[0] <= TOLERANCE_M)


@settings(max_examples=100)
@given(scenes, st.sampled_from([1, 10, 40]))
def test_no_command_leaves_the_region_or_passes_the_gate(fields, count):
    drawn = list(draw_actions(np.random.default_rng(fields["seed"]), count))
    plane, region = scene(fields)
    clock = ManualClock()
    robot = PathRecorder(clock)
    robot.connect()
    robot.home()
    options = GuardOptions(operator_timeout_s=1e6, tolerance_m=TOLERANCE_M, max_speed_m_s=1.0)
    try:
        guard = Guard(robot, plane, region, options, clock=clock)
    except InvalidInputError:
        assume(False)  # smaller than its margin, or beyond the horizon
    guard.arm()
    guard.enter()
    robot.goals.clear()
    robot.been.clear()
    follower = Follower(guard, FollowOptions(above_m=max(0.0, drawn[0][2]), speed_m_s=0.5))
    selector = DwellSelector(guard)
    selections = []
    for action, point, above_m, (a, b, turn), status, age_s, pause_s in drawn:
        clock.sleep(pause_s)
        axes = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
        Σ = axes @ np.diag([a * a, b * b]) @ axes.T
        fix = fix_at(point, clock() - age_s, (Σ + Σ.T) / 2, status)
        sent, now_s = len(robot.goals), clock()
        with contextlib.suppress(FingerpostError):
            if action == "follow":
                follower.update(fix)
            elif action == "move":
                guard.move(point, above_m, fix=fix, needs=Presence.FIX, wait=False)
            elif action == "visit":
                guard.visit(point, above_m)
            elif action == "select":
                selections.append(selector.select(fix))
                assert good_enough(plane, fix, now_s)
            elif action == "carry" and selections:
                PickPlace(guard, selections[-1], selections[0], _heights(above_m)).run()
            elif action == "hold":
                guard.hold("drawn")
            elif action == "enter":
                guard.enter()
        if action in ("follow", "move") and len(robot.goals) > sent:
            assert good_enough(plane, fix, now_s)
        guard.check()
    for pose in robot.goals:
        assert region.contains(plane.point(pose.position_m[:2]), plane.above_m(pose)), pose
    for x, y, z in robot.been:
        above_m = z - (plane.height_m + float(plane.slope @ [x, y]))
        place = plane.point([x, y])
        assert region.contains(place, above_m, within=1e3 * PATH_M, within_m=PATH_M), (x, y, z)


def _heights(above_m):
    low_m = float(np.clip(above_m, 0.012, 0.1))
    return PickPlaceOptions(travel_m=0.105, grip_m=low_m, release_m=low_m)


def armed(fields):
    """Return a guarded robot inside the region of a scene, armed."""
    plane, region = scene(fields)
    clock = ManualClock()
    robot = GoalRecorder(clock)
    robot.connect()
    robot.home()
    guard = Guard(robot, plane, region, GuardOptions(operator_timeout_s=1e6), clock=clock)
    guard.arm()
    guard.enter()
    robot.goals.clear()
    return guard, robot, clock


PLAIN = {"seed": 1, "corners": 6, "stretch": 1.0, "lean": 0.0, "slope": 0.0, "turn": 0.0}


def test_a_guard_without_clamping_leaves_the_region():
    """Checks that the property test can fail."""
    guard, robot, clock = armed(PLAIN)
    guard.clamp = lambda point, above_m: (np.asarray(point), above_m)
    guard.move([250.0, 0.0], 0.05, fix=fix_at([250.0, 0.0], clock()), needs=Presence.FIX)
    (pose,) = robot.goals
    plane = guard.plane
    assert not guard.region.contains(plane.point(pose.position_m[:2]), plane.above_m(pose))


def test_visits_and_picking_outside_the_region_are_refused():
    guard, robot, clock = armed(PLAIN)
    centre = guard.region.centre
    for point, above_m in (([900.0, 0.0], 0.05), (centre, 0.5), (centre, 0.005)):
        with pytest.raises(OutOfReachError, match="will do"):
            guard.visit(point, above_m)
    outside = Selection(np.array([900.0, 0.0]), fix_at([900.0, 0.0], clock()))
    with pytest.raises(InvalidInputError, match="outside the safe region"):
        PickPlace(guard, outside, outside)
    assert robot.goals == []
