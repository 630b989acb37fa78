"""Every Python and TOML snippet of the README runs."""

import re
from pathlib import Path

import numpy as np
import pytest

from fingerpost.config import Rig
from fingerpost.simulate import DevicePose, SimulatedRig, Trajectory, write_recording

README = (Path(__file__).resolve().parents[1] / "README.md").read_text(encoding="utf-8")


def snippets(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", README, re.DOTALL | re.MULTILINE)


def test_the_rig_file_of_the_readme_loads(tmp_path):
    (snippet,) = snippets("toml")
    (tmp_path / "rig.toml").write_text(snippet, encoding="utf-8")
    rig = Rig.load(tmp_path / "rig.toml")
    assert [view.name for view in rig.views] == ["left", "right"]


@pytest.mark.parametrize("snippet", snippets("python"))
def test_the_python_of_the_readme_runs(snippet, tmp_path, monkeypatch, capsys):
    pose = DevicePose.pointing_at((200.0, 200.0), azimuth_deg=20.0, slant_deg=50.0, hover_mm=120.0)
    rng = np.random.default_rng(1)
    hold = Trajectory.hold(pose, 1.0)
    write_recording(tmp_path, SimulatedRig(), hold, frames=5, rng=rng, picture_format="mp4")
    monkeypatch.chdir(tmp_path)
    exec(compile(snippet, "README.md", "exec"), {})
    assert capsys.readouterr().out
