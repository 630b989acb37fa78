"""Loss of the hand, the fixes or the operator stops the arm, as measured at the controller.

The command runs in a subprocess; the test sees only its bytes on the line.
"""

import tempfile
import time
from pathlib import Path

import numpy as np
import pytest
from guided_process import (
    FPS,
    STOPPED_S,
    JpegStreams,
    Travelling,
    show_instead,
    still_film,
    write_rig,
)
from robot_rig import CrowdedError, best_of_three

GIVE_UP_AFTER_S = 6.0
MAX_AGE_S = 0.3
"""Greatest age of a fix that may move the arm."""
OPERATOR_TIMEOUT_S = 1.0


@pytest.fixture
def rig(hand_film, tmp_path):
    return write_rig(tmp_path, hand_film, z_m=(0.03, 0.4))


def test_a_lost_hand_stops_the_arm(hand_film, tmp_path):
    sources = still_film(tmp_path / "film", hand_film)
    rig = write_rig(tmp_path, hand_film, sources, z_m=(0.03, 0.4))
    with Travelling(rig, tmp_path) as run:
        aborts = run.travel()
        show_instead(tmp_path / "film", np.full((480, 640), 70, np.uint8))
        run.guided.until(lambda: run.arm.controller.aborts > aborts, "held")
        run.arm.assert_stopped(aborts, STOPPED_S)
        assert run.guided.end() == 0
    assert run.reasons()[0].startswith("fix is lost")
    assert "holding: fix is lost" in run.guided.said()


@best_of_three
def test_fixes_that_stop_coming_stop_the_arm(hand_film, tmp_path):
    folder = Path(tempfile.mkdtemp(dir=tmp_path))
    # The recording repeats, for the moment at which the command starts to read is unknown.
    films = [
        [path.read_bytes() for path in sorted((hand_film / view).glob("*.jpg"))]
        for view in ("left", "right")
    ]
    with JpegStreams(films) as streams:
        rig = write_rig(folder, hand_film, streams.urls, z_m=(0.03, 0.4))
        options = ("--max-age", MAX_AGE_S, "--give-up-after", GIVE_UP_AFTER_S)
        with Travelling(rig, folder, *options) as run:
            aborts, held_before = run.travel(), len(run.reasons())
            streams.stalled = True
            stalled_s = time.monotonic()
            run.guided.until(lambda: run.arm.controller.aborts > aborts, "held")
            assert time.monotonic() - stalled_s < MAX_AGE_S + 5 / FPS + STOPPED_S
            run.arm.assert_stopped(aborts, STOPPED_S)
            assert run.guided.end() == 1
    # On a loaded machine, late frames may have held the arm before the stall.
    reason = run.reasons()[held_before]
    if "are bridged" in reason:
        raise CrowdedError(reason)
    assert "no picture has come for 0." in reason  # reported before any fix is too old
    assert "no new frame" in run.guided.said()


def test_releasing_the_dead_mans_key_stops_the_arm(rig, tmp_path):
    options = ("--attendance", "key", "--operator-timeout", OPERATOR_TIMEOUT_S)
    with Travelling(rig, tmp_path, *options, terminal=True) as run:
        run.guided.until_said("homing")

        def held():
            run.guided.press(" ")
            time.sleep(0.02)
            return run.log.exists() and run._moves() and run.arm.travels()

        run.guided.until(held, "following")
        aborts, let_go_s = run.arm.controller.aborts, time.monotonic()
        run.guided.until(lambda: run.arm.controller.aborts > aborts, "halted")
        stopped_s = time.monotonic() - let_go_s
        assert OPERATOR_TIMEOUT_S - 0.2 < stopped_s < OPERATOR_TIMEOUT_S + STOPPED_S
        run.arm.assert_stopped(aborts, STOPPED_S)
        run.guided.until_said("stopped: the operator is gone")
        run.guided.press("q")
        assert run.guided.end() == 0


def test_a_terminal_that_vanishes_stops_the_arm(rig, tmp_path):
    with Travelling(rig, tmp_path, terminal=True) as run:
        aborts = run.travel()
        run.guided.hang_up()
        run.arm.assert_stopped(aborts, STOPPED_S)
        run.guided.end()
    assert run.reasons()[0] == "the terminal is gone"


@pytest.mark.parametrize("key", ["x", "\x1b"])
def test_the_stop_key_stops_the_arm(rig, tmp_path, key):
    with Travelling(rig, tmp_path, terminal=True) as run:
        aborts = run.travel()
        run.guided.press(key)
        run.arm.assert_stopped(aborts, STOPPED_S)
        run.guided.press("q")
        assert run.guided.end() == 0
