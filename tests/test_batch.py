"""Many recordings at once: all are done, once; what fails is listed and stops nothing."""

import csv
import os
import signal
import sys
import threading
from pathlib import Path

import cv2
import pytest
from click.testing import CliRunner, Result
from patience import wait_until
from test_workers import children

from fingerpost.batch import run_batch, tasks
from fingerpost.cli import main
from fingerpost.errors import InvalidInputError
from fingerpost.recording.picture.palette import STATUSES
from fingerpost.recording.picture.shares import draw_shares
from fingerpost.simulate import DevicePose, SimulatedRig, Trajectory, write_recording

FRAMES = 6


def invoked(*arguments: object) -> Result:
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def rigs(tmp_path_factory):
    """Three rigs of one simulated recording."""
    folder = tmp_path_factory.mktemp("rigs")
    pose = DevicePose.pointing_at((200.0, 200.0), azimuth_deg=20.0, slant_deg=50.0, hover_mm=120.0)
    motion = Trajectory.hold(pose, 1.0)
    rig = write_recording(folder, SimulatedRig(), motion, frames=FRAMES, picture_format="jpg")
    for name in ("a", "b"):
        (folder / f"{name}.toml").write_text(rig.read_text())
    return folder


def rows(folder: Path) -> list[dict[str, str]]:
    with (folder / "batch.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_a_batch_gives_what_each_run_gives_and_lists_what_fails(rigs, tmp_path):
    recording, cut = tmp_path / "r.mcap", tmp_path / "cut.mcap"
    points = tmp_path / "p.csv"
    assert invoked("run", rigs / "a.toml", "--record", recording, "--points", points).exit_code == 0
    cut.write_bytes(recording.read_bytes()[: recording.stat().st_size // 2])
    (tmp_path / "bad.toml").write_text((rigs / "a.toml").read_text())  # its pictures are elsewhere
    out = tmp_path / "out"
    done = invoked("batch", rigs / "*.toml", recording, cut, tmp_path / "bad.toml", "--out", out)
    assert done.exit_code == 1
    assert done.stdout == f"5 of 6 recordings: {out}/batch.csv\n"
    (line,) = done.stderr.splitlines()
    assert line.startswith("bad: ")
    assert "no file matches" in line
    table = {row["recording"]: row for row in rows(out)}
    assert list(table) == ["a", "b", "rig", "r", "cut", "bad"]
    for name in ("a", "b", "rig", "r"):
        assert (out / name / "points.csv").read_bytes() == points.read_bytes()
        assert int(table[name]["frames"]) == FRAMES
    assert 0 < int(table["cut"]["frames"]) < FRAMES
    assert "cut off at byte" in table["cut"]["notes"]
    assert (table["bad"]["frames"], table["bad"]["reason"]) == ("0", line.removeprefix("bad: "))
    assert cv2.imread(str(out / "batch.png")) is not None
    assert not list(out.glob("*.part"))


def test_what_is_done_is_not_done_again(rigs, tmp_path):
    (tmp_path / "a").mkdir()
    todo = tasks([str(rigs / "a.toml"), str(rigs / "b.toml")], {"model": "ribbon"})
    first = run_batch(todo[:1], tmp_path)
    written = (tmp_path / "a" / "points.csv").stat().st_mtime_ns
    told = []
    both = run_batch(todo, tmp_path, workers=1, tell=lambda done, of: told.append((done, of)))
    assert told == [(1, 2), (2, 2)]
    assert both[0] == first[0]
    assert (tmp_path / "a" / "points.csv").stat().st_mtime_ns == written
    (other,) = run_batch(tasks([str(rigs / "a.toml")], {"model": "paper"}), tmp_path)
    assert other.semi_axis != first[0].semi_axis


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="needs /proc")
def test_a_worker_that_is_killed_costs_nothing(rigs, tmp_path):
    todo = tasks([str(rigs / "*.toml")], {})
    outcomes = []
    thread = threading.Thread(target=lambda: outcomes.extend(run_batch(todo, tmp_path, workers=1)))
    thread.start()
    wait_until(lambda: any(tmp_path.glob("*.part")))
    for child in children(os.getpid()):
        if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes():
            os.kill(child, signal.SIGKILL)
    thread.join()
    assert [one.reason for one in outcomes] == [""] * 3
    assert [one.frames for one in outcomes] == [FRAMES] * 3


def test_names_tell_files_of_one_name_apart(tmp_path):
    for folder in ("x", "y"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "rig.toml").touch()
    names = [task.name for task in tasks([str(tmp_path / "*" / "rig.toml")], {})]
    assert names == ["x-rig", "y-rig"]
    with pytest.raises(InvalidInputError, match="no file matches"):
        tasks([str(tmp_path / "*.csv")], {})


def test_bars_are_as_long_as_their_shares():
    picture = draw_shares([("a", {"ok": 3, "lost": 1}, ""), ("b", {}, "is broken")])
    row = picture[20 + 26 + 8]
    assert (row == STATUSES["ok"]).all(axis=1).sum() == pytest.approx(390, abs=2)
    assert (row == STATUSES["lost"]).all(axis=1).sum() == pytest.approx(130, abs=2)
