"""Smoothing, following, selecting, picking and placing."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from robot_rig import ManualClock
from scipy.signal import lfilter
from test_robot_guard import CENTRE, PLANE, REGION, fix_at, guard_rig

from fingerpost.errors import InvalidInputError
from fingerpost.pointing import Status
from fingerpost.robot.errors import (
    GripperError,
    NotArmedError,
    NotArrivedError,
    NotReadyError,
    RefusedError,
    StoppedError,
)
from fingerpost.robot.follow import (
    DwellSelector,
    Follower,
    FollowOptions,
    FollowReport,
    FollowState,
    Selection,
)
from fingerpost.robot.guard import Presence
from fingerpost.robot.pick_place import STEPS, PickPlace, PickPlaceOptions, Step
from fingerpost.robot.protocol import GripperKind
from fingerpost.robot.simulated import SIMULATED_LIMITS
from fingerpost.robot.smoothing import OneEuroFilter

STEP_S = 1 / 30


# The One-Euro filter.


def run_filter(one_euro, points):
    return np.array([one_euro(point, k * STEP_S) for k, point in enumerate(points)])


def test_without_slope_it_is_a_first_order_low_pass():
    points = np.random.default_rng(5).normal(size=(200, 2))
    share = 1 / (1 + 1 / (2 * math.pi * 1.5 * STEP_S))
    expected = [
        lfilter([share], [1, share - 1], column, zi=[(1 - share) * column[0]])[0]
        for column in points.T
    ]
    smooth = run_filter(OneEuroFilter(1.5), points)
    np.testing.assert_allclose(smooth, np.transpose(expected), atol=1e-12)


@pytest.mark.parametrize("speed", [0.01, 0.1, 1.0])
@pytest.mark.parametrize("slope", [0.0, 20.0])
def test_the_reported_lag_is_correct(speed, slope):
    one_euro = OneEuroFilter(1.0, slope, 1.0)
    ramp = speed * STEP_S * np.arange(600)[:, None] * [0.6, 0.8]
    behind = np.linalg.norm(ramp[-1] - run_filter(one_euro, ramp)[-1])
    assert behind / speed == pytest.approx(one_euro.lag_s, rel=1e-3)


def test_the_lag_falls_with_speed_from_that_of_the_lowest_cutoff():
    lags = []
    for speed in (0.0, 0.05, 0.2, 1.0):
        one_euro = OneEuroFilter(1.0, 20.0)
        run_filter(one_euro, speed * STEP_S * np.arange(300)[:, None] * [1.0, 0.0])
        lags.append(one_euro.lag_s)
    assert lags == sorted(lags, reverse=True)
    # (1 − α) / α steps are 1 / (2π f), for any step.
    assert lags[0] == pytest.approx(1 / (2 * math.pi * 1.0))


@given(st.floats(0, 2 * math.pi))
def test_the_filter_is_invariant_to_rotation(turn):
    R = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    points = np.cumsum(np.random.default_rng(6).normal(size=(50, 2)), axis=0)
    turned = run_filter(OneEuroFilter(1.0, 0.5), points @ R.T)
    np.testing.assert_allclose(turned, run_filter(OneEuroFilter(1.0, 0.5), points) @ R.T, atol=1e-9)


def test_it_smooths_a_hand_at_rest():
    noise = np.random.default_rng(7).normal(size=(2000, 2))
    smooth = run_filter(OneEuroFilter(0.5), noise)[200:]
    assert smooth.std() < 0.3 * noise.std()


def test_a_reset_clears_the_state():
    one_euro = OneEuroFilter(1.0)
    run_filter(one_euro, np.zeros((10, 2)))
    one_euro.reset()
    np.testing.assert_array_equal(one_euro([5.0, 5.0], 0.0), [5.0, 5.0])
    assert one_euro.lag_s == 0.0


def test_invalid_input_of_the_filter_is_refused():
    one_euro = OneEuroFilter()
    one_euro([0.0, 0.0], 1.0)
    for time_s in (1.0, 0.5, math.nan):
        with pytest.raises(InvalidInputError, match="time_s"):
            one_euro([0.0, 0.0], time_s)
    with pytest.raises(InvalidInputError):
        one_euro([math.nan, 0.0], 2.0)
    for options in ({"min_cutoff_hz": 0.0}, {"slope_hz_s": -1.0}, {"speed_cutoff_hz": math.nan}):
        with pytest.raises(InvalidInputError):
            OneEuroFilter(**options)


# Following.


def follow(rig, follower, target, span_s, **fields):
    """Point at a target for a while; return the reports."""
    reports = []
    for _ in range(round(span_s / STEP_S)):
        rig.clock.sleep(STEP_S)
        reports.append(follower.update(rig.fix(target, **fields)))
        rig.guard.check()
    return reports


def test_the_arm_goes_where_the_hand_points():
    with guard_rig() as rig:
        follower = Follower(rig.guard, FollowOptions(above_m=0.05, speed_m_s=0.1))
        reports = follow(rig, follower, [250.0, 350.0], 6.0)
        assert reports[-1].state is FollowState.THERE
        point, above_m = rig.guard.where()
        np.testing.assert_allclose(point, [250.0, 350.0], atol=3.1)
        assert above_m == pytest.approx(0.05, abs=0.0031)
        assert 0.0 < reports[-1].lag_s <= 1 / (2 * math.pi * 1.0) + 1e-9
        np.testing.assert_allclose(reports[-1].target, [250.0, 350.0], atol=0.5)


def test_stride_length_and_speed_are_limited():
    with guard_rig() as rig:
        options = FollowOptions(speed_m_s=0.05, stride_s=0.2)
        follower = Follower(rig.guard, options)
        positions, goals = [], []
        for k in range(150):
            rig.clock.sleep(STEP_S)
            target = [250.0, 350.0] if k % 60 < 30 else [20.0, 20.0]  # an unsteady hand
            report = follower.update(rig.fix(target))
            positions.append(rig.robot.pose().position_m)
            if report.goal is not None:
                goals.append(report.goal.position_m)
        strides = np.linalg.norm(np.diff(goals, axis=0), axis=1)
        assert strides.max() <= 0.05 * 0.2 + 1e-9
        speeds = np.linalg.norm(np.diff(positions, axis=0), axis=1) / STEP_S
        assert speeds.max() <= 0.05 * (1 + 1e-6)


def test_a_lost_hand_holds_the_arm_within_a_stride():
    with guard_rig() as rig:
        follower = Follower(rig.guard)
        follow(rig, follower, [290.0, 390.0], 1.0)
        assert rig.is_moving()
        rig.clock.sleep(STEP_S)
        report = follower.update(rig.fix(status=Status.LOST))
        assert report.state is FollowState.HOLDING
        assert report.reason == "fix is lost"
        assert not rig.is_moving()
        held = rig.robot.pose()
        follow(rig, follower, CENTRE, 1.0, status=Status.LOST)
        assert rig.robot.pose() == held
        assert follow(rig, follower, [290.0, 390.0], 8.0)[-1].state is FollowState.THERE


def test_the_follower_recovers_from_a_hold_by_the_watch():
    with guard_rig() as rig:
        follower = Follower(rig.guard)
        follow(rig, follower, [290.0, 390.0], 1.0)
        rig.guard.observe(rig.fix(status=Status.LOST))  # the follower does not receive this fix
        rig.guard.check()
        assert not rig.is_moving()
        assert follow(rig, follower, [290.0, 390.0], 8.0)[-1].state is FollowState.THERE


def test_an_arm_that_does_not_move_is_halted(monkeypatch):
    with guard_rig() as rig:
        monkeypatch.setattr(rig.robot, "_start_move", lambda *_: None)
        follower = Follower(rig.guard)
        with pytest.raises(NotArrivedError, match="after it was sent"):
            follow(rig, follower, [290.0, 390.0], 4.0)
        assert not rig.guard.armed


def test_the_time_to_send_a_stride_does_not_count_for_the_arm(monkeypatch):
    with guard_rig(max_fix_age_s=10.0) as rig:
        start = rig.robot._start_move

        def start_late(*arguments):
            rig.clock.sleep(4.0)
            start(*arguments)

        monkeypatch.setattr(rig.robot, "_start_move", start_late)
        follower = Follower(rig.guard)
        reports = follow(rig, follower, [290.0, 390.0], 0.5)
        assert FollowState.UNDER_WAY in {report.state for report in reports}
        assert rig.guard.armed


def test_a_slow_reading_does_not_count_for_the_arm(monkeypatch):
    with guard_rig(max_fix_age_s=10.0) as rig:
        follower = Follower(rig.guard)
        follow(rig, follower, [290.0, 390.0], 0.5)
        pose = rig.robot.pose

        def outdated_pose():
            seen = pose()
            rig.clock.sleep(4.0)
            return seen

        with monkeypatch.context() as held_up:
            held_up.setattr(rig.robot, "pose", outdated_pose)
            rig.clock.sleep(STEP_S)
            assert follower.update(rig.fix([290.0, 390.0])).state is FollowState.UNDER_WAY
        assert follow(rig, follower, [290.0, 390.0], 8.0)[-1].state is FollowState.THERE


def test_a_point_outside_the_region_leads_to_its_border():
    with guard_rig() as rig:
        follower = Follower(rig.guard, FollowOptions(above_m=0.0))
        follow(rig, follower, [5000.0, 200.0], 6.0)
        point, above_m = rig.guard.where()
        np.testing.assert_allclose(point, [299.0, 200.0], atol=3.1)
        assert above_m == pytest.approx(0.011, abs=0.0031)


def test_tremor_within_the_dead_band_moves_nothing():
    with guard_rig() as rig:
        follower = Follower(rig.guard)
        follow(rig, follower, CENTRE, 6.0)
        rng = np.random.default_rng(8)
        for _ in range(60):
            rig.clock.sleep(STEP_S)
            report = follower.update(rig.fix(np.array(CENTRE) + rng.normal(size=2)))
            assert report.state is FollowState.THERE


def test_duplicate_and_late_fixes_are_not_filtered_again():
    with guard_rig() as rig:
        follower = Follower(rig.guard)
        rig.clock.sleep(1.0)
        first, late = rig.fix([100.0, 100.0]), rig.fix([290.0, 390.0], age_s=0.1)
        targets = [follower.update(fix).target for fix in (first, first, late)]
        np.testing.assert_allclose(targets, [[100.0, 100.0]] * 3)


def test_following_needs_arming():
    with guard_rig(arm=False) as rig, pytest.raises(NotArmedError):
        Follower(rig.guard).update(rig.fix())


# Selecting.


def standing(target):
    """Return the follower's report on an arm that stands at a target."""
    return FollowReport(FollowState.THERE, target=np.array(target, dtype=float))


def dwell(rig, selector, target, span_s, *, arm=None, **fields):
    """Point at a target for a while, with the arm there or as reported; return the selections."""
    selected = []
    for _ in range(round(span_s / STEP_S)):
        rig.clock.sleep(STEP_S)
        if selection := selector.update(rig.fix(target, **fields), arm or standing(target)):
            selected.append(selection)
    return selected


def test_a_dwelling_hand_selects_once():
    with guard_rig() as rig:
        selector = DwellSelector(rig.guard, dwell_s=1.0, radius_m=0.01)
        assert dwell(rig, selector, [100.0, 100.0], 0.8) == []
        assert 0.7 < selector.progress < 1.0
        (selection,) = dwell(rig, selector, [100.0, 100.0], 3.0)
        np.testing.assert_allclose(selection.point, [100.0, 100.0])
        assert selector.progress == 0.0
        (again,) = dwell(rig, selector, [130.0, 100.0], 2.0)
        np.testing.assert_allclose(again.point, [130.0, 100.0])


def test_the_selected_point_is_the_mean_of_the_dwell():
    with guard_rig() as rig:
        selector = DwellSelector(rig.guard, dwell_s=2.0, radius_m=0.01)
        rng = np.random.default_rng(9)
        selection = None
        while selection is None:
            rig.clock.sleep(STEP_S)
            selection = selector.update(
                rig.fix(np.array([100.0, 100.0]) + rng.normal(size=2)), standing([100.0, 100.0])
            )
        assert np.linalg.norm(selection.point - [100.0, 100.0]) < 0.5


def test_a_moving_hand_selects_nothing():
    with guard_rig() as rig:
        selector = DwellSelector(rig.guard, dwell_s=0.5, radius_m=0.01)
        for k in range(90):
            rig.clock.sleep(STEP_S)
            at = [100.0 + k, 100.0]
            assert selector.update(rig.fix(at), standing(at)) is None


def test_a_lost_hand_restarts_the_dwell():
    with guard_rig() as rig:
        selector = DwellSelector(rig.guard, dwell_s=1.0, radius_m=0.01)
        dwell(rig, selector, [100.0, 100.0], 0.9)
        dwell(rig, selector, [100.0, 100.0], 0.1, status=Status.LOST)
        assert selector.progress == 0.0
        assert dwell(rig, selector, [100.0, 100.0], 0.9) == []


def test_a_gap_without_frames_restarts_the_dwell():
    with guard_rig(max_fix_age_s=0.3) as rig:
        selector = DwellSelector(rig.guard, dwell_s=1.0, radius_m=0.01)
        dwell(rig, selector, [100.0, 100.0], 0.5)
        rig.clock.sleep(5.0)  # no frames: the hand may have moved
        assert dwell(rig, selector, [100.0, 100.0], 0.9) == []
        assert len(dwell(rig, selector, [100.0, 100.0], 0.2)) == 1


@pytest.mark.parametrize(
    "arm",
    [
        FollowReport(FollowState.MOVING, target=np.array([100.0, 100.0])),
        FollowReport(FollowState.UNDER_WAY, target=np.array([100.0, 100.0])),
        FollowReport(FollowState.HOLDING),
        standing([111.0, 100.0]),  # the previous target
    ],
)
def test_a_dwell_counts_from_the_arms_standstill_at_the_indicated_point(arm):
    with guard_rig() as rig:
        selector = DwellSelector(rig.guard, dwell_s=1.0, radius_m=0.01)
        assert dwell(rig, selector, [100.0, 100.0], 3.0, arm=arm) == []
        assert selector.progress == 0.0
        assert dwell(rig, selector, [100.0, 100.0], 0.9) == []
        assert len(dwell(rig, selector, [100.0, 100.0], 0.2)) == 1


def test_the_state_there_means_that_the_arm_stands():
    with guard_rig() as rig:
        follower = Follower(rig.guard)
        for k in range(390):
            target = [250.0, 350.0] if k < 180 else [60.0, 60.0]
            rig.clock.sleep(STEP_S)
            report = follower.update(rig.fix(target))
            if report.state is FollowState.THERE:
                at, _ = rig.guard.where()
                assert np.linalg.norm(at - report.target) <= 6.0 + 1e-6  # two dead bands
                assert not rig.is_moving() or np.linalg.norm(at - target) <= 6.0
        assert report.state is FollowState.THERE


def test_a_key_selects_at_once_if_the_fix_is_acceptable():
    with guard_rig() as rig:
        selector = DwellSelector(rig.guard)
        fix = rig.fix([100.0, 100.0])
        assert selector.select(fix).fix is fix
        with pytest.raises(RefusedError, match="lost"):
            selector.select(rig.fix(status=Status.LOST))


def test_invalid_dwell_options_are_refused():
    with guard_rig() as rig:
        for options in ({"dwell_s": 0.0}, {"radius_m": -0.01}):
            with pytest.raises(InvalidInputError):
                DwellSelector(rig.guard, **options)


# Picking and placing.

PICK, PLACE = np.array([80.0, 120.0]), np.array([220.0, 320.0])
OPTIONS = PickPlaceOptions(travel_m=0.1, grip_m=0.015, release_m=0.017)

# State after each step: point, height [m], opening of the gripper.
AFTER = {
    Step.APPROACH: (PICK, 0.1, 1.0),
    Step.DESCEND: (PICK, 0.015, 1.0),
    Step.GRIP: (PICK, 0.015, 0.0),
    Step.LIFT: (PICK, 0.1, 0.0),
    Step.GO: (PLACE, 0.1, 0.0),
    Step.LOWER: (PLACE, 0.017, 0.0),
    Step.RELEASE: (PLACE, 0.017, 1.0),
    Step.RETREAT: (PLACE, 0.1, 1.0),
}


def pick_place(rig, **options):
    pick, place = (Selection(point, rig.fix(point)) for point in (PICK, PLACE))
    return PickPlace(rig.guard, pick, place, PickPlaceOptions(**options) if options else OPTIONS)


def assert_state(rig, point, above_m, opening):
    here, height_m = rig.guard.where()
    np.testing.assert_allclose(here, point, atol=0.01)
    assert height_m == pytest.approx(above_m, abs=1e-5)
    assert rig.robot.opening == opening


def test_the_steps_in_their_order():
    assert tuple(AFTER) == STEPS
    with guard_rig() as rig:
        machine = pick_place(rig)
        for step in STEPS:
            assert machine.next_step is step
            assert machine.advance() is step
            assert_state(rig, *AFTER[step])
        assert machine.done
        assert machine.next_step is None
        with pytest.raises(NotReadyError):
            machine.advance()


def test_a_run_takes_all_steps_and_travels_only_at_the_travel_height():
    with guard_rig() as rig:
        pick_place(rig).run()
        moves = [record.pose for record in rig.guard.records if record.command == "move"]
        for before, after in itertools.pairwise(moves):
            if before.distance_m(after.at_height(before.z_m)) > 1e-6:  # a lateral move
                assert min(before.z_m, after.z_m) == pytest.approx(0.02 + 0.1)


@pytest.mark.parametrize("count", range(1, len(STEPS) + 1))
def test_every_step_can_be_undone(count):
    with guard_rig() as rig:
        start = (*rig.guard.where(), rig.robot.opening)
        machine = pick_place(rig)
        for _ in range(count):
            machine.advance()
        for step in reversed(STEPS[:count]):
            assert machine.undo() is step
            place = STEPS.index(step)
            assert_state(rig, *(AFTER[STEPS[place - 1]] if place else start))
        with pytest.raises(NotReadyError, match="nothing"):
            machine.undo()
        machine.run()
        assert_state(rig, *AFTER[Step.RETREAT])


@pytest.mark.parametrize("then", ["advance", "undo"])
@pytest.mark.parametrize("step", STEPS)
def test_every_step_can_be_aborted_and_then_repeated_or_undone(step, then):
    with guard_rig() as rig:
        start = (*rig.guard.where(), rig.robot.opening)
        machine = pick_place(rig)
        while machine.next_step is not step:
            machine.advance()
        opening = rig.robot.opening
        rig.clock.at(rig.clock() + 0.15, machine.abort)
        with pytest.raises(StoppedError):
            machine.advance()
        assert not rig.is_moving()
        assert not rig.guard.armed
        assert machine.interrupted
        assert machine.next_step is step
        assert rig.robot.opening == opening  # the gripper keeps its hold
        with pytest.raises(NotArmedError):
            machine.advance()
        rig.guard.arm()
        if then == "advance":
            assert machine.advance() is step
            assert_state(rig, *AFTER[step])
        else:
            assert machine.undo() is step
            place = STEPS.index(step)
            assert_state(rig, *(AFTER[STEPS[place - 1]] if place else start))
        assert not machine.interrupted
        machine.run()
        assert_state(rig, *AFTER[Step.RETREAT])


def test_a_step_stopped_before_the_wait_is_not_completed(monkeypatch):
    with guard_rig() as rig:
        machine = pick_place(rig)
        while machine.next_step is not Step.GO:
            machine.advance()
        wait = rig.robot.wait

        def late(**fields):
            machine.abort()
            wait(**fields)

        with monkeypatch.context() as patch:
            patch.setattr(rig.robot, "wait", late)
            with pytest.raises(StoppedError):
                machine.advance()
        assert machine.interrupted
        assert machine.next_step is Step.GO
        rig.guard.arm()
        for step in (Step.GO, Step.LOWER):
            assert machine.advance() is step
            assert_state(rig, *AFTER[step])


def test_a_place_outside_the_region_is_refused_not_clamped():
    with guard_rig() as rig:
        inside, outside = (Selection(point, rig.fix(CENTRE)) for point in (CENTRE, [310.0, 50.0]))
        inside = Selection(np.array(CENTRE), inside.fix)
        outside = Selection(np.array([310.0, 50.0]), outside.fix)
        with pytest.raises(InvalidInputError, match=r"place at \(310, 50\)"):
            PickPlace(rig.guard, inside, outside)
        with pytest.raises(
            InvalidInputError, match=r"grip_m is 0\.005, outside the safe region; 0\.011 m"
        ):
            PickPlace(rig.guard, inside, inside, PickPlaceOptions(grip_m=0.005))


def test_an_unsuitable_gripper_is_refused_before_any_motion():
    with guard_rig() as rig:
        inside = Selection(np.array(CENTRE), rig.fix(CENTRE))
        with pytest.raises(InvalidInputError, match=r"gripper: 0\.5 m; a width from 0 to 0\.08"):
            PickPlace(rig.guard, inside, inside, PickPlaceOptions(grip=0.5))
        rig.robot._limits = replace(SIMULATED_LIMITS, gripper=GripperKind.NONE)
        with pytest.raises(GripperError, match="no gripper"):
            PickPlace(rig.guard, inside, inside)


def test_steps_exclude_each_other():
    with guard_rig() as rig:
        machine = pick_place(rig)
        errors = []

        def meddle():
            with pytest.raises(NotReadyError, match="being taken") as caught:
                machine.undo()
            errors.append(caught.value)

        rig.clock.at(rig.clock() + 0.5, meddle)
        machine.advance()
        machine.advance()
        assert len(errors) == 1
        assert_state(rig, *AFTER[Step.DESCEND])


def test_a_live_fix_can_be_required_throughout():
    with guard_rig() as rig:
        machine = pick_place(rig, needs=Presence.FIX)
        with pytest.raises(RefusedError, match="old"):
            machine.run()  # the selection's own fix is stale after the first move


def test_the_manual_clock_runs_due_actions_in_order():
    clock, done = ManualClock(), []
    for delay_s in (0.3, 0.1):
        clock.at(clock() + delay_s, lambda delay_s=delay_s: done.append(delay_s))
    clock.sleep(0.2)
    assert done == [0.1]
    clock.sleep(0.2)
    assert done == [0.1, 0.3]


def test_the_constants_of_the_rig():
    assert fix_at(CENTRE, 0.0).ellipse().semi_axes[0] == pytest.approx(2.448, abs=1e-3)
    assert REGION.contains(CENTRE, 0.1)
    assert PLANE.pose(CENTRE, 0.0).z_m == pytest.approx(0.02)
