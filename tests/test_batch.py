"""Batches of recordings: each is processed once; failures are listed and stop no others."""

import csv
import os
import signal
import socket
import subprocess
import sys
import threading
from pathlib import Path

import cv2
import pytest
from command_line import invoked
from distributed import LocalCluster
from patience import wait_until
from test_publishing import listening
from test_workers import children

from fingerpost.batch import run_batch, tasks, work
from fingerpost.cluster import cluster_at
from fingerpost.errors import InvalidInputError
from fingerpost.recording.picture.palette import STATUSES
from fingerpost.recording.picture.shares import draw_shares
from fingerpost.simulate import DevicePose, SimulatedRig, Trajectory, write_recording

FRAMES = 6


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


@pytest.fixture(scope="module")
def recorded(rigs, tmp_path_factory):
    """A folder with a recording, a truncated one, and a rig whose pictures are missing."""
    folder = tmp_path_factory.mktemp("recorded")
    recording, points = folder / "r.mcap", folder / "p.csv"
    assert invoked("run", rigs / "a.toml", "--record", recording, "--points", points).exit_code == 0
    (folder / "cut.mcap").write_bytes(recording.read_bytes()[: recording.stat().st_size // 2])
    (folder / "bad.toml").write_text((rigs / "a.toml").read_text())
    return folder


def rows(folder: Path) -> list[dict[str, str]]:
    with (folder / "batch.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_a_batch_gives_the_results_of_single_runs_and_lists_failures(rigs, recorded, tmp_path):
    points, out = recorded / "p.csv", tmp_path / "out"
    others = [recorded / name for name in ("r.mcap", "cut.mcap", "bad.toml", "gone.mcap")]
    done = invoked("batch", rigs / "*.toml", *others, "--out", out)
    assert done.exit_code == 1
    assert done.stdout == f"5 of 7 recordings: {out}/batch.csv\n"
    line, gone = done.stderr.splitlines()
    assert line.startswith("bad: ")
    assert "no file matches" in line
    assert gone.startswith(f"gone: {recorded / 'gone.mcap'}: No such file")
    table = {row["recording"]: row for row in rows(out)}
    assert list(table) == ["a", "b", "rig", "r", "cut", "bad", "gone"]
    for name in ("a", "b", "rig", "r"):
        assert (out / name / "points.csv").read_bytes() == points.read_bytes()
        assert int(table[name]["frames"]) == FRAMES
    assert 0 < int(table["cut"]["frames"]) < FRAMES
    assert "cut off at byte" in table["cut"]["notes"]
    assert (table["bad"]["frames"], table["bad"]["reason"]) == ("0", line.removeprefix("bad: "))
    assert cv2.imread(str(out / "batch.png")) is not None
    assert not list(out.glob("*.part"))


def test_finished_recordings_are_not_processed_again(rigs, tmp_path):
    (tmp_path / "a").mkdir()
    todo = tasks([str(rigs / "a.toml"), str(rigs / "b.toml")], {"model": "ribbon"})
    first = run_batch(todo[:1], tmp_path)
    written = (tmp_path / "a" / "points.csv").stat().st_mtime_ns
    reported = []
    both = run_batch(todo, tmp_path, workers=1, report=lambda done, of: reported.append((done, of)))
    assert reported == [(1, 2), (2, 2)]
    assert both[0] == first[0]
    assert (tmp_path / "a" / "points.csv").stat().st_mtime_ns == written
    (other,) = run_batch(tasks([str(rigs / "a.toml")], {"model": "paper"}), tmp_path)
    assert other.semi_axis != first[0].semi_axis


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="needs /proc")
def test_all_recordings_are_processed_though_a_worker_is_killed(rigs, tmp_path):
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


# --- on a cluster -----------------------------------------------------------------------------

HIDING = (
    "import sys\n"
    "class Hidden:\n"
    "    def find_spec(self, name, path=None, target=None):\n"
    "        if name.partition('.')[0] == 'fingerpost':\n"
    "            raise ModuleNotFoundError(f'No module named {name!r}', name=name)\n"
    "sys.meta_path.insert(0, Hidden())\n"
)


@pytest.fixture
def cluster():
    """Function that starts a Dask scheduler and workers as processes; returns address, workers."""
    running = []

    def started(*words: str, before: str = "") -> subprocess.Popen:
        program = (
            f"{before}import sys; sys.argv[0] = 'dask'\nfrom dask.__main__ import main; main()"
        )
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        running.append(subprocess.Popen([sys.executable, "-c", program, *words], **quiet))
        return running[-1]

    def start(workers: int, before: str = "") -> tuple[str, list]:
        with socket.socket() as one:
            one.bind(("127.0.0.1", 0))
            port = one.getsockname()[1]
        address = f"tcp://127.0.0.1:{port}"
        place = ("--host", "127.0.0.1", "--port", str(port))
        started("scheduler", *place, "--no-dashboard", before=before)
        options = ("--nthreads", "1", "--no-nanny", "--no-dashboard")
        return address, [started("worker", address, *options) for _ in range(workers)]

    yield start
    for one in reversed(running):
        one.kill()
        one.wait()


def files_of(folder: Path) -> dict[str, bytes]:
    paths = (path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in paths}


def test_a_cluster_gives_the_same_files_though_a_worker_dies(rigs, recorded, cluster, tmp_path):
    paths = (rigs / "a.toml", recorded / "cut.mcap", recorded / "bad.toml")
    todo = tasks([str(path) for path in paths], {})
    for task in todo:
        work(task, str(tmp_path / "here"))
    address, workers = cluster(2)
    with cluster_at(address) as there:
        there._client.wait_for_workers(2)
        reported = []

        def report(done: int, _of: int) -> None:
            reported.append(done)
            if done == 1:
                workers[0].kill()

        outcomes = run_batch(todo, tmp_path / "there", cluster=there, report=report)
    assert reported == list(range(4))
    reasons = {one.task.name: one.reason for one in outcomes if one.reason}
    assert set(reasons) == {"bad"}
    assert "no file matches" in reasons["bad"]
    assert f"(on worker {address.rpartition(':')[0]}:" in reasons["bad"]
    found = files_of(tmp_path / "there")
    assert found == files_of(tmp_path / "here")
    assert {Path(name).parts[0] for name in found} == {"a", "cut"}


def test_a_local_cluster_listens_on_this_machine_only():
    with cluster_at("local:1") as there:
        assert list(there.each(abs, [-3])) == [(-3, 3, "")]
        (worker,) = there._client.scheduler_info(n_workers=-1)["workers"]
        assert worker.startswith("tcp://127.0.0.1:")
        if sys.platform.startswith("linux"):
            assert {address[:8] for address in listening()} == {"0100007F"}


def refused(rigs: Path, folder: Path, address: str) -> str:
    done = invoked("batch", rigs / "a.toml", "--out", folder, "--dask", address)
    assert (done.exit_code, done.stdout) == (1, "")
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"fingerpost: --dask {address}: ")
    return line


def test_a_scheduler_without_fingerpost_is_refused_in_one_line(rigs, cluster, tmp_path):
    address, _ = cluster(0, before=HIDING)
    said = refused(rigs, tmp_path, address)
    assert "the scheduler cannot import fingerpost (No module named 'fingerpost')" in said
    assert "pip install 'fingerpost[cluster]==" in said


def test_workers_of_several_threads_are_refused_in_one_line(rigs, tmp_path):
    given = {"host": "127.0.0.1", "protocol": "tcp", "dashboard_address": "127.0.0.1:0"}
    with LocalCluster(n_workers=1, threads_per_worker=2, processes=False, **given) as there:
        said = refused(rigs, tmp_path, there.scheduler_address)
    assert "has 2 threads; start as many workers as there are cores" in said


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["--dask", "local:0"], 2, "local:4 for four workers on this machine, is right"),
        (["--dask", "local:2", "--workers", "2"], 2, "leave it out"),
        (["--dask", "tcp://127.0.0.1:1"], 1, "no scheduler answers there"),
    ],
)
def test_an_invalid_cluster_address_is_refused_in_one_line(
    rigs, tmp_path, monkeypatch, arguments, code, said
):
    monkeypatch.setattr("fingerpost.cluster._ANSWERS_S", 0.5)
    done = invoked("batch", rigs / "a.toml", "--out", tmp_path, *arguments)
    assert done.exit_code == code, done.output
    assert said in done.stderr.splitlines()[-1]


# --- names and pictures -----------------------------------------------------------------------


def test_files_of_one_name_get_different_task_names(tmp_path):
    for folder in ("x", "y"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "rig.toml").touch()
    names = [task.name for task in tasks([str(tmp_path / "*" / "rig.toml")], {})]
    assert names == ["x-rig", "y-rig"]
    with pytest.raises(InvalidInputError, match="no file matches"):
        tasks([str(tmp_path / "*.csv")], {})


def test_the_bars_are_proportional_to_their_shares():
    picture = draw_shares([("a", {"ok": 3, "lost": 1}, ""), ("b", {}, "is broken")])
    row = picture[20 + 26 + 8]
    assert (row == STATUSES["ok"]).all(axis=1).sum() == pytest.approx(390, abs=2)
    assert (row == STATUSES["lost"]).all(axis=1).sum() == pytest.approx(130, abs=2)
