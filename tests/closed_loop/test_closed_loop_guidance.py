"""The guidance experiment: the plane by the robot, its figures, and refusals."""

import numpy as np
import pytest
from click.testing import CliRunner

from fingerpost.cli import main
from fingerpost.closed_loop import CameraPlacement, GuidanceOptions, GuidanceResult, Leg
from fingerpost.closed_loop.trials import (
    GuidanceTrial,
    PlaneAccuracy,
    measure_plane,
    run_guidance,
)
from fingerpost.errors import InvalidInputError

PLANE_RMS_MM = 2.0
"""Required accuracy of the plane by the robot, open loop with exact pointing."""


@pytest.mark.parametrize("height_mm", [0.0, 50.0])
def test_the_robot_defines_the_plane_it_points_by(height_mm):
    rig, accuracy = measure_plane(height_mm, GuidanceOptions(plane_targets=4))
    assert rig.plane.unit == "m"
    assert rig.robot is not None
    assert rig.robot.height_m == pytest.approx(height_mm / 1000, abs=3e-4)
    assert len(rig.plane.points) == 9
    assert accuracy.missing == 0
    assert accuracy.rms_mm < PLANE_RMS_MM


def a_result() -> GuidanceResult:
    plane = PlaneAccuracy(0.0, 0.5, ((3.0, 4.0), (0.0, 0.0)), 1)
    legs = (Leg(30.0, 3.0, 2.0, 8.0, 2, 0), Leg(25.0, 4.0, 12.0, 9.0, 1, 1))
    good = GuidanceTrial(0, legs, 4.0, 0, 1.0, 100, 99)
    bad = GuidanceTrial(1, legs[:1], None, 3, 1.0, 100, 100, "nothing was selected")
    return GuidanceResult(0, (plane,), (good, bad))


def test_the_table_counts_what_failed():
    text = "\n".join(a_result().table())
    assert a_result().planes[0].rms_mm == pytest.approx(np.sqrt(12.5))
    assert "1 without a fix" in text
    assert "trial 1: nothing was selected" in text
    # Of four targets in two trials, two were selected within 10 mm; of two blocks, one placed.
    (feedback,) = (line for line in text.splitlines() if "with feedback" in line)
    assert feedback.split()[-4:] == ["50", "%", "50", "%"]
    (placed,) = (line for line in text.splitlines() if "block placed" in line)
    assert placed.split()[-4:] == ["50", "%", "50", "%"]
    assert a_result().as_dict()["planes"][0]["rms_mm"] == pytest.approx(np.sqrt(12.5))


def test_a_plane_without_fixes_has_no_figures():
    plane = PlaneAccuracy(0.0, 0.5, (), 4)
    assert np.isnan(plane.rms_mm)
    text = "\n".join(GuidanceResult(0, (plane,), ()).table())
    assert "4 without a fix" in text
    assert "nan" not in text.lower()


@pytest.mark.parametrize(("trials", "workers"), [(-1, None), (1, 0)])
def test_numbers_out_of_range_are_refused(trials, workers):
    with pytest.raises(InvalidInputError, match="is right"):
        run_guidance(trials, workers=workers)


@pytest.mark.parametrize("wrong", [{"seed": -1}, {"heights_mm": ()}])
def test_options_out_of_range_are_refused(wrong):
    with pytest.raises(InvalidInputError, match=next(iter(wrong))):
        GuidanceOptions(**wrong)


def test_guidance_excludes_other_experiments():
    result = CliRunner().invoke(main, ["experiment", "--guidance", "1", "--noise", "2"])
    assert result.exit_code == 2


def test_both_cameras_see_the_workspace():
    for camera in CameraPlacement().cameras():
        corners = camera.project([[330, -120, 0], [520, 130, 0], [520, -120, 0], [330, 130, 50]])
        assert camera.contains(corners, border_px=10).all()
