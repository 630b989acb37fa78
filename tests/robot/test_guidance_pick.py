"""`fingerpost robot pick` end to end, on a recording and an emulated Scorbot."""

import numpy as np
import pytest
from guided_process import (
    BY_HAND,
    EMPTY_FRAMES,
    FIRST_MM,
    HEIGHT_M,
    HOLD_FRAMES,
    PATIENT,
    SECOND_MM,
    EmulatedArm,
    Guided,
    commands,
    cut_film,
    robot_xy,
    write_rig,
)

FAST = ("--speed", "0.3", *PATIENT, *BY_HAND)


def picking_film(tmp_path, film):
    """Extend both pauses of the recording, the second one for the time to carry a block."""
    frames = [
        *range(HOLD_FRAMES),
        *([HOLD_FRAMES - 1] * 60),
        *range(HOLD_FRAMES, HOLD_FRAMES + 45),
        *([HOLD_FRAMES + 44] * 330),
    ]
    return write_rig(tmp_path, film, cut_film(tmp_path / "film", film, frames))


def test_a_block_is_picked_and_placed_where_the_hand_dwells(hand_film, tmp_path):
    rig, log = picking_film(tmp_path, hand_film), tmp_path / "commands.csv"
    with EmulatedArm() as arm:
        url = arm.url + "&gripper_s=0.2"
        options = ("--arm", "--log", log, "--dwell", 0.8, *FAST)
        with Guided("pick", rig, "--url", url, *options) as guided:
            assert guided.end() == 0, guided.said()
    assert "1 picked and placed" in guided.out
    rows = [row for row in commands(log) if row["outcome"] == "sent"]
    grips = [k for k, row in enumerate(rows) if row["command"] == "gripper"]
    assert [rows[k]["detail"] for k in grips] == ["open", "close", "open"]
    for grip, target, above_m in ((grips[1], FIRST_MM, 0.015), (grips[2], SECOND_MM, 0.017)):
        at = [float(rows[grip - 1][name]) for name in ("x_m", "y_m", "z_m")]
        np.testing.assert_allclose(at[:2], robot_xy(target), atol=0.008)
        assert at[2] == pytest.approx(HEIGHT_M + above_m)
    for word in ("block at (0.4", "point at its new place", "approach", "retreat", "placed"):
        assert word in guided.said()


def test_the_command_fails_if_the_views_end_before_the_block_is_placed(hand_film, tmp_path):
    with EmulatedArm() as arm:
        options = ("--url", arm.url, "--arm", "--max-frames", EMPTY_FRAMES + 40, *FAST)
        with Guided("pick", write_rig(tmp_path, hand_film), *options) as guided:
            assert guided.end() == 1, guided.said()
    assert "the views ended with 0 of 1 blocks picked and placed" in guided.said().splitlines()[-1]
    assert "fixes" in guided.out


def test_keys_select_stop_undo_and_continue(hand_film, tmp_path):
    rig, log = picking_film(tmp_path, hand_film), tmp_path / "commands.csv"
    with EmulatedArm() as arm:
        url = arm.url + "&gripper_s=0.2"
        options = ("--arm", "--log", log, "--select", "key", *FAST)
        with Guided("pick", rig, "--url", url, *options, terminal=True) as guided:
            guided.until_said("point at the block")
            guided.until(arm.travels)
            guided.press("s")
            guided.until_said("block at")
            guided.press("s")
            guided.until_said("place at")
            guided.until_said("descend ...")
            aborts = arm.controller.aborts
            guided.press("x")
            arm.assert_stopped(aborts, within_s=0.3)
            guided.until_said("stopped: stopped by key")
            guided.press("u")
            guided.until_said("undone")
            guided.press("c")
            guided.until_said("grip ...")
            guided.press("q")
            assert guided.end() == 0, guided.said()
        assert not arm.is_moving()
    rows = commands(log)
    assert [row["command"] for row in rows].count("arm") == 2  # the undo key arms again
    assert any(row["detail"] == "stopped by key" for row in rows)


def test_with_step_every_step_waits_for_a_key(hand_film, tmp_path):
    rig = picking_film(tmp_path, hand_film)
    with EmulatedArm() as arm:
        url = arm.url + "&gripper_s=0.2"
        options = ("--arm", "--dwell", 0.8, "--step", *FAST)
        with Guided("pick", rig, "--url", url, *options, terminal=True) as guided:
            guided.until_said("next: approach")
            moves = len(arm.controller.moves)
            guided.press("c")
            guided.until_said("next: descend")
            assert len(arm.controller.moves) > moves
            guided.press("u")
            guided.until_said("approach undone")
            guided.press("q")
            assert guided.end() == 0, guided.said()
