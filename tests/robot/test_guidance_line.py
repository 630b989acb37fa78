"""A failing line or view stops the arm, as measured at the emulated controller.

The command runs in a subprocess; the test sees only its bytes on the line.
"""

import numpy as np
import pytest
from guided_process import STOPPED_S, Travelling, show_instead, still_film, write_rig

from fingerpost.robot.emulator.faults import Fault


@pytest.fixture
def rig(hand_film, tmp_path):
    return write_rig(tmp_path, hand_film, z_m=(0.03, 0.4))


def test_a_silent_line_stops_the_arm(rig, tmp_path):
    with Travelling(rig, tmp_path) as run:
        aborts = run.travel()
        run.arm.emulator.inject(Fault.SILENT, count=100_000)
        run.guided.until(lambda: run.arm.controller.aborts > aborts, "halted")
        run.arm.assert_stopped(aborts, STOPPED_S)
        assert run.guided.end() == 1
    assert run.guided.said().splitlines()[-1].startswith("fingerpost: ")


def test_a_pulled_cable_ends_the_command(rig, tmp_path):
    with Travelling(rig, tmp_path) as run:
        run.travel()
        run.arm.emulator.inject(Fault.UNPLUG)
        assert run.guided.end() == 1
    assert "Traceback" not in run.guided.said()


def test_an_error_of_the_views_stops_the_arm(hand_film, tmp_path):
    """A frame of another size, in the middle of the recording, is such an error."""
    sources = still_film(tmp_path / "film", hand_film)
    rig = write_rig(tmp_path, hand_film, sources, z_m=(0.03, 0.4))
    with Travelling(rig, tmp_path) as run:
        aborts = run.travel()
        show_instead(tmp_path / "film", np.zeros((100, 100), np.uint8))
        run.guided.until(lambda: run.arm.controller.aborts > aborts, "halted")
        run.arm.assert_stopped(aborts, STOPPED_S)
        assert run.guided.end() == 1
    assert "all frames of a view must have one size" in run.guided.said()
    assert run.reasons()[0].startswith("CaptureError")
