"""The robot demo, with and without physics, and its messages if something is missing."""

import json
import sys

import cv2
import numpy as np
import pytest
from click.testing import CliRunner

from fingerpost.cli import main
from fingerpost.closed_loop import run_robot_demo
from fingerpost.closed_loop.demo import FILMED_EVERY
from fingerpost.closed_loop.trials import GOAL_MM
from fingerpost.config import Rig
from fingerpost.errors import InvalidInputError

FILES = {"rig.toml", "points.csv", "tracks.csv", "overlay.webm", "summary.png"}


@pytest.fixture
def no_mujoco(monkeypatch):
    """An environment without MuJoCo."""
    monkeypatch.setitem(sys.modules, "mujoco", None)


def test_without_physics_a_simulated_robot_is_used(tmp_path, no_mujoco):
    summary = run_robot_demo(tmp_path, max_frames=60)
    assert "without physics" in summary.cell
    assert summary.note.startswith("no physics: ")
    assert summary.note.endswith("pip install 'fingerpost[mujoco]'")
    assert summary.line_bytes is None
    assert summary.shortened
    assert summary.problem == ""
    assert summary.fixes > 0
    assert summary.fix_rms_mm < 5.0
    assert shown_frames(tmp_path) == 60 / FILMED_EVERY


def test_with_physics_the_robot_defines_the_plane_and_the_block_is_placed(tmp_path):
    words = []
    summary = run_robot_demo(tmp_path, seed=0, report=words.append)
    assert "MuJoCo" in summary.cell
    assert summary.note == ""
    assert summary.line_bytes > 10_000
    assert summary.plane[0].startswith("plane at Z = 0.0000 m by 9 of 9 places")
    assert sum(word.startswith("the gripper visits") for word in words) == 9
    rig = Rig.load(tmp_path / "rig.toml")
    assert rig.robot is not None
    assert all(view.reference_covariances_px2 is not None for view in rig.views)
    assert FILMED_EVERY * shown_frames(tmp_path) > summary.frames  # the hand is absent in some
    assert summary.problem == ""
    assert not summary.shortened
    assert summary.placed_mm < 10.0
    assert len(summary.legs) == 2
    assert all(leg.open_mm > GOAL_MM for leg in summary.legs)  # without feedback
    assert all(leg.closed_mm < 10.0 for leg in summary.legs)
    assert all(leg.corrections >= 1 for leg in summary.legs)
    assert summary.false_fixes == 0  # the gripper, always visible, is not taken for a hand
    assert summary.fixes > 0.9 * summary.frames
    assert summary.table_steps == 0


def shown_frames(folder):
    """Check a demo's files; return the number of frames of its video."""
    assert {path.name for path in folder.iterdir()} == FILES
    video = cv2.VideoCapture(str(folder / "overlay.webm"))
    picture = cv2.imread(str(folder / "summary.png"))
    assert picture.shape[1] > 2 * picture.shape[0]
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 1000
    return int(video.get(cv2.CAP_PROP_FRAME_COUNT))


def test_the_command_names_the_missing_extra_in_one_line(tmp_path, no_mujoco):
    runner = CliRunner()
    demo = ["demo", "--robot", "--max-frames", "2", "--output", str(tmp_path)]
    played = runner.invoke(main, demo)
    assert played.exit_code == 0
    assert played.stdout.splitlines()[-1].startswith("no physics: MuJoCo is not installed")
    assert json.loads(runner.invoke(main, [*demo, "--json"]).stdout)["note"]
    refused = runner.invoke(main, ["experiment", "--guidance", "1"])
    assert refused.exit_code == 1
    assert refused.stderr.count("\n") == 1
    assert "pip install 'fingerpost[mujoco]'" in refused.stderr


def test_a_failed_task_makes_the_command_fail(tmp_path, monkeypatch, no_mujoco):
    monkeypatch.setattr("fingerpost.closed_loop.task.FIX_S", 0.0)  # the operator waits for no fix
    demo = ["demo", "--robot", "--output", str(tmp_path)]
    result = CliRunner().invoke(main, demo)
    assert result.exit_code == 1
    assert "failed    the hand was not found" in result.stdout
    assert "placed" not in result.stdout


@pytest.mark.parametrize(
    ("wrong", "message"), [({"seed": -1}, "seed"), ({"max_frames": 0}, "max_frames")]
)
def test_arguments_out_of_range_are_refused(tmp_path, wrong, message):
    with pytest.raises(InvalidInputError, match=message):
        run_robot_demo(tmp_path, **wrong)


def test_robot_and_simulate_exclude_each_other(tmp_path):
    result = CliRunner().invoke(main, ["demo", "--robot", "--simulate", "--output", str(tmp_path)])
    assert result.exit_code == 2
