"""The whole product in the loop: an operator points and corrects, a block is picked and placed."""

from fingerpost.closed_loop import GuidanceOptions
from fingerpost.closed_loop.setup import exact_rig
from fingerpost.closed_loop.trials import GOAL_MM, WITHIN_MM, guide


def test_an_operator_has_a_block_carried():
    options = GuidanceOptions(seed=2)
    trial = guide(0, exact_rig(options.cameras.cameras(), 0.0), options)
    assert trial.problem == ""
    assert [leg.open_mm > GOAL_MM for leg in trial.legs] == [True, True]
    assert all(leg.closed_mm is not None and leg.closed_mm <= WITHIN_MM for leg in trial.legs)
    assert all(leg.corrections >= 1 for leg in trial.legs)
    assert trial.placed_mm is not None
    assert trial.placed_mm <= WITHIN_MM
    assert trial.table_steps == 0
    assert trial.fixes > 0.9 * trial.frames
