"""Every program in examples/ runs as it stands there, on films."""

import runpy
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from fingerpost.simulate import (
    DevicePose,
    Placement,
    SimulatedRig,
    Trajectory,
    write_recording,
)

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
FRAMES = 14
TARGET_MM = (200.0, 180.0)


def film_of(folder: Path, *azimuths_deg: float, frames: int = FRAMES) -> Path:
    """A recording, as MP4, of a rod that points at the target."""
    pose = DevicePose.pointing_at(TARGET_MM, azimuth_deg=20.0, slant_deg=50.0, hover_mm=120.0)
    rig = SimulatedRig(Placement(azimuths_deg=azimuths_deg))
    hold = Trajectory.hold(pose, 1.0)
    return write_recording(folder, rig, hold, frames=frames, rng=3, picture_format="mp4")


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return film_of(tmp_path_factory.mktemp("pair"), -15.0, 15.0)


@pytest.fixture
def run(monkeypatch, capsys):
    def run(program: str, *arguments: object) -> list[str]:
        monkeypatch.setattr(sys, "argv", [program, *map(str, arguments)])
        runpy.run_path(str(EXAMPLES / program), run_name="__main__")
        return capsys.readouterr().out.splitlines()

    return run


def test_every_example_is_run_here_and_in_the_table():
    programs = {path.name for path in EXAMPLES.glob("*.py")}
    here, table = Path(__file__).read_text(), (EXAMPLES / "README.md").read_text()
    for program in programs:
        assert f'run("{program}"' in here
        assert f"`{program}" in table


def test_two_webcams(run, pair):
    lines = run("two_webcams.py", pair, pair.parent / "left.mp4", pair.parent / "right.mp4")
    assert len(lines) == FRAMES
    assert "ok [" in lines[-1]


def test_pushed_frames(run):
    lines = run("pushed_frames.py")
    assert len(lines) >= 15
    numbers = lines[-1].replace("[", " ").replace("]", " ").split()
    found, true = np.array(numbers[3:5], float), np.array(numbers[6:8], float)
    assert np.hypot(*(found - true)) < 5.0


def test_three_cameras(run, tmp_path):
    lines = run("three_cameras.py", film_of(tmp_path, -20.0, 10.0, 35.0))
    assert len(lines) == FRAMES
    assert lines[-1].endswith("by view0 view1 view2")


def test_targets_with_dwell(run, tmp_path):
    rig_file = film_of(tmp_path, -15.0, 15.0, frames=36)
    cup = '[[target]]\nname = "cup"\npoint = [200, 180]\nradius = 25\n'
    rig_file.write_text(rig_file.read_text(encoding="utf-8") + cup, encoding="utf-8")
    entered, selected = (line.split() for line in run("targets_with_dwell.py", rig_file))
    assert (entered[2:4], selected[2:4]) == (["enter", "cup"], ["select", "cup"])
    assert float(selected[0]) - float(entered[0]) >= 0.99


def test_plot(run, pair, tmp_path, monkeypatch):
    pytest.importorskip("matplotlib").use("agg")
    (line,) = run("plot.py", pair, tmp_path / "plot.png")
    assert int(line.split()[-2]) >= FRAMES - 6
    assert cv2.imread(str(tmp_path / "plot.png")).std() > 1
