"""The simulated operator: pointing offset, visual delay, corrections, tolerance."""

import dataclasses

import numpy as np
import pytest

from fingerpost.closed_loop import Habits, Operator
from fingerpost.errors import InvalidInputError

START = (400.0, 0.0)
TARGET = np.array([450.0, 60.0])
STEP_S = 0.05


def run(operator, seconds, gripper, *, from_s=0.0, is_there=True):
    """Simulate; `gripper` maps the indicated place to the gripper's. Return the latter."""
    places = []
    for time_s in np.arange(from_s, from_s + seconds, STEP_S):
        place = gripper(operator.indicated_mm(time_s))
        operator.see(place, time_s, is_there=is_there)
        places.append(place)
    return np.array(places)


@pytest.mark.parametrize("seed", range(20))
def test_open_loop_the_error_is_the_operators_offset(seed):
    habits = dataclasses.replace(Habits.exact(), offset_mm=(20.0, 40.0))
    operator = Operator(habits, START, np.random.default_rng(seed))
    operator.mean(TARGET, 0.0)
    places = run(operator, 6.0, lambda place: place)
    assert places[0] == pytest.approx(START, abs=1e-6)
    assert 20.0 <= np.linalg.norm(places[-1] - TARGET) <= 40.0
    assert operator.corrections == 0


def test_an_exact_operator_points_exactly():
    operator = Operator(Habits.exact(), START, np.random.default_rng(0))
    operator.mean(TARGET, 0.0)
    assert run(operator, 3.0, lambda place: place)[-1] == pytest.approx(TARGET)


def test_the_operator_corrects_errors_of_the_machine():
    # The gripper's map has an offset and a gain of 10 %; the operator's own offset is zero.
    operator = Operator(Habits.exact(), START, np.random.default_rng(0))
    operator.mean(TARGET, 0.0)
    operator.corrects = True
    wrong = run(operator, 20.0, lambda place: 1.1 * place - [30.0, 5.0])[-1]
    assert np.linalg.norm(wrong - TARGET) <= Habits.exact().content_mm
    assert operator.corrections >= 1


def test_an_arm_that_holds_is_not_corrected():
    # Corrections without an effect would add up, and the hand would leave the views.
    operator = Operator(Habits(), START, np.random.default_rng(0))
    operator.mean(TARGET, 0.0)
    operator.corrects = True
    run(operator, 20.0, lambda _: np.array(START), is_there=False)
    assert operator.corrections == 0
    last = run(operator, 25.0, lambda place: place, from_s=20.0)[-1]
    assert np.linalg.norm(last - TARGET) < 10.0


@pytest.mark.parametrize("seed", range(30))
def test_the_operator_ends_within_a_centimetre(seed):
    operator = Operator(Habits(), START, np.random.default_rng(seed))
    operator.mean(TARGET, 0.0)
    operator.corrects = True
    last = run(operator, 25.0, lambda place: place)[-1]
    assert np.linalg.norm(last - TARGET) < 10.0


def test_the_operator_returns_to_his_target_after_a_rest():
    operator = Operator(Habits.exact(), START, np.random.default_rng(0))
    operator.mean(TARGET, 0.0)
    run(operator, 3.0, lambda place: place)
    operator.rest(3.0)
    assert run(operator, 3.0, lambda place: place, from_s=3.0)[-1] == pytest.approx(START)
    operator.resume(6.0)
    assert run(operator, 3.0, lambda place: place, from_s=6.0)[-1] == pytest.approx(TARGET)


def test_the_operator_reacts_after_his_visual_delay():
    habits = dataclasses.replace(Habits.exact(), offset_mm=(30.0, 30.0), seeing_s=0.5)
    operator = Operator(habits, START, np.random.default_rng(3))
    operator.mean(TARGET, 0.0)
    operator.corrects = True
    places = run(operator, 10.0, lambda place: place)
    still = np.linalg.norm(np.diff(places, axis=0), axis=1) < 1e-9
    landed = int(np.argmax(still))
    answered = landed + int(np.argmax(~still[landed:]))
    assert (answered - landed) * STEP_S >= habits.seeing_s + habits.patience_s - 2 * STEP_S


def test_tremor_and_drift_of_a_still_hand_have_their_variance():
    habits = Habits()
    operator = Operator(habits, START, np.random.default_rng(5))
    places = run(operator, 400.0, lambda place: place)
    sigma = places.std(axis=0)
    expected = np.hypot(habits.drift_mm, habits.tremor_mm / np.sqrt(2))
    assert sigma == pytest.approx([expected, expected], rel=0.2)


@pytest.mark.parametrize(
    "wrong", [{"gain": 0.0}, {"offset_mm": (30.0, 20.0)}, {"seeing_s": np.nan}, {"drift_s": 0.0}]
)
def test_invalid_habits_are_refused(wrong):
    with pytest.raises(InvalidInputError, match=next(iter(wrong))):
        Habits(**wrong)
