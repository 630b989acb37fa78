"""Experiments on the page without a browser: how targets are selected, and the table."""

import numpy as np
import pytest

from fingerpost.live.reel import Indicated
from fingerpost.live.scene import RigScene
from fingerpost.live.trials import DWELL_S, OperatorExperiment, new_table, targets_of
from fingerpost.pointing import Status
from fingerpost.recording import read_targets
from fingerpost.targets import Target

SQUARE = np.array([[0.0, 0.0], [400.0, 0.0], [400.0, 400.0], [0.0, 400.0]])
STEP_S = 0.1


def scene(*targets):
    return RigScene(
        title="square",
        unit="mm",
        plane_points=SQUARE,
        hull=(0, 1, 2, 3),
        plan_from_plane=np.eye(2),
        plane_size=400.0,
        digits=1,
        targets=targets,
        views=("left", "right"),
        is_live=True,
        frames=None,
    )


@pytest.fixture
def experiment(tmp_path):
    made = OperatorExperiment(scene(), tmp_path / "t.csv", np.random.default_rng(3))
    yield made
    made.end()


class Hand:
    """A hand that points at a place for a given time."""

    def __init__(self, experiment):
        self.experiment, self.time_s, self.frame = experiment, 0.0, 0

    def point(self, place, seconds, *, status=Status.OK):
        for _ in range(round(seconds / STEP_S) + 1):
            covariance = None if place is None else (4.0, 1.0, 9.0)
            self.experiment.take(Indicated(self.frame, self.time_s, status, place, covariance))
            self.time_s += STEP_S
            self.frame += 1

    def target(self):
        return np.array(self.experiment.as_dict()["target"])


def test_dwelling_selects_once_and_again_only_after_the_hand_has_left(experiment):
    hand = Hand(experiment)
    there = tuple(np.add(hand.target(), [3.0, -4.0]))
    hand.point(there, DWELL_S - 3 * STEP_S)
    assert experiment.trials == ()
    assert 0.5 < experiment.as_dict()["dwell"] < 1.0
    hand.point(there, 3 * STEP_S)
    (trial,) = experiment.trials
    assert trial.error == pytest.approx(5.0)
    # Midas touch: staying in place does not select the next target.
    hand.point(there, 3 * DWELL_S)
    assert len(experiment.trials) == 1
    hand.point((1000.0, 1000.0), DWELL_S + STEP_S)
    assert len(experiment.trials) == 2


def test_a_hand_that_moves_or_is_lost_restarts_its_dwell(experiment):
    hand = Hand(experiment)
    for k in range(20):
        hand.point((20.0 * k, 0.0), DWELL_S / 2)
    hand.point((0.0, 0.0), DWELL_S * 0.8)
    hand.point(None, STEP_S, status=Status.LOST)
    hand.point((0.0, 0.0), DWELL_S * 0.8)
    assert experiment.trials == ()


def test_skipped_targets_count_as_trials_without_a_point(experiment, tmp_path):
    hand = Hand(experiment)
    assert "no point" in experiment.select()
    hand.point((10.0, 20.0), 0.0)
    experiment.skip()
    assert experiment.select() == ""
    hand.point(None, 0.0, status=Status.LOST)
    assert "no point" in experiment.select()
    experiment.end()
    skipped, selected = read_targets(tmp_path / "t.csv")
    assert (skipped.by, skipped.x, skipped.status) == ("skip", None, "lost")
    assert (selected.by, selected.x, selected.cov_xy, selected.status) == ("key", 10.0, 1.0, "ok")
    said = experiment.as_dict()
    assert said["over"]
    assert said["target"] is None
    assert "1 of 2" in said["lines"][0]


def test_the_rig_s_own_targets_are_used_if_there_are_at_least_four(tmp_path):
    names = "abcde"
    own = [
        Target(name, np.array([[10.0 * k, 5.0]]), 3.0, rest=name == "e")
        for k, name in enumerate(names)
    ]
    np.testing.assert_array_equal(targets_of(scene(*own)), [[10.0 * k, 5.0] for k in range(4)])
    grid = targets_of(scene(*own[:3]))
    assert grid.shape == (12, 2)
    assert grid.min() > 40.0
    assert grid.max() < 360.0
    assert new_table(tmp_path).name == "experiment.csv"
    (tmp_path / "experiment.csv").touch()
    assert new_table(tmp_path).name == "experiment-2.csv"
