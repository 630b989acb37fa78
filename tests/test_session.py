"""Recordings (MCAP): contents, replay to the same bits, export, and failures."""

import dataclasses
import itertools
import json
import os
import re
import signal
import subprocess
import sys
import threading
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import invoked, refused
from live_server import served
from patience import wait_until
from recordings import messages

from fingerpost.capture import Frame, Loss, open_source, open_views, read_views
from fingerpost.cli.following import SETTING_EXAMPLE, settings_of
from fingerpost.cli.recorder import open_recorder
from fingerpost.config import Rig
from fingerpost.errors import InvalidInputError, RecordingError, SourceError
from fingerpost.mcap_file import read_about
from fingerpost.pipeline import Pointer, steps
from fingerpost.recording import read_points, read_tracks
from fingerpost.recording.session import About, Images, Recorder
from fingerpost.simulate import DevicePose, SimulatedRig, Trajectory, write_recording

FRAMES = 8


def simulated(folder: Path, picture_format: str = "jpg") -> Path:
    pose = DevicePose.pointing_at((200.0, 200.0), azimuth_deg=20.0, slant_deg=50.0, hover_mm=120.0)
    motion = Trajectory.hold(pose, 1.0)
    return write_recording(
        folder, SimulatedRig(), motion, frames=FRAMES, picture_format=picture_format
    )


@pytest.fixture(scope="module")
def rig_file(tmp_path_factory):
    return simulated(tmp_path_factory.mktemp("session"))


@pytest.fixture(scope="module")
def recording(rig_file, tmp_path_factory):
    path = tmp_path_factory.mktemp("recorded") / "s.mcap"
    tables = [path.with_name(name) for name in ("p.csv", "t.csv")]
    done = invoked("run", rig_file, "--record", path, "--points", tables[0], "--tracks", tables[1])
    assert done.exit_code == 0, done.output
    return path


def about(*views: str, is_live: bool = False) -> About:
    return About(version="1", views=views, sources=views, started="", unit="mm", is_live=is_live)


# --- contents --------------------------------------------------------------------------------


def test_another_library_reads_standard_messages(recording, rig_file):
    found = {}
    for topic, schema, _, message in messages(recording):
        found.setdefault((topic, schema), []).append(message)
    for view in ("left", "right"):
        images = found[f"/{view}/image", "foxglove.CompressedImage"]
        files = sorted((rig_file.parent / view).iterdir())
        assert [image.data for image in images] == [file.read_bytes() for file in files]
        assert {image.format for image in images} == {"jpeg"}
        (calibration,) = found[f"/{view}/calibration", "foxglove.CameraCalibration"]
        height, width = cv2.imread(str(files[0])).shape[:2]
        assert (calibration.width, calibration.height) == (width, height)
        drawn = found[f"/{view}/annotations", "foxglove.ImageAnnotations"]
        assert len(drawn) == FRAMES
        assert drawn[-1].timestamp.ToNanoseconds() == images[-1].timestamp.ToNanoseconds()
        assert drawn[-1].texts[0].text.startswith("tracking")
        assert len(found[f"/{view}/track", "fingerpost.TrackRow"]) == FRAMES
    assert len(found["/plane", "foxglove.SceneUpdate"]) == FRAMES
    assert found["/fix", "fingerpost.PointRow"][-1]["status"] == "ok"


def test_annotations_are_at_the_hand_in_pixels_from_the_corner(recording, rig_file):
    rig = Rig.load(rig_file)
    pointer = Pointer(rig)
    with open_views(rig.sources) as sources:
        *_, last = steps(pointer, read_views(sources))
    drawn = [m for topic, *_, m in messages(recording) if topic == "/left/annotations"][-1]
    contour = max(drawn.points, key=lambda part: (part.type == part.LINE_LOOP) * len(part.points))
    annotated = np.array([[point.x, point.y] for point in contour.points])
    np.testing.assert_allclose(annotated, last.observations[0].contour_px + 0.5, atol=1 / 64)


def test_the_probabilities_of_targets_are_recorded_with_each_point(rig_file, tmp_path):
    text = rig_file.read_text() + '[[target]]\nname = "cup"\npoint = [200, 200]\nradius = 30\n'
    (rig_file.parent / "cup.toml").write_text(text)
    path = tmp_path / "s.mcap"
    assert invoked("run", rig_file.parent / "cup.toml", "--record", path).exit_code == 0
    rows = {topic: [] for topic in ("/fix", "/targets")}
    for topic, *_, message in messages(path):
        rows.get(topic, []).append(message)
    fixes = [row for row in rows["/fix"] if row["x"] is not None]
    assert [row["frame"] for row in rows["/targets"]] == [row["frame"] for row in fixes]
    last = rows["/targets"][-1]
    assert last["target"] == "cup"
    assert last["probabilities"]["cup"] > 0.5
    assert last["probabilities"]["cup"] + last["none"] == pytest.approx(1.0)


def test_the_rig_in_a_recording_has_its_views(recording):
    found, _ = read_about(recording)
    assert found.views == ("left", "right")
    rig = Rig.load(recording)
    assert rig.sources == {view: str(recording) + f"#{view}" for view in found.views}
    with open_views(rig.sources) as sources:
        assert [source.frame_count for source in sources] == [FRAMES, FRAMES]


# --- replay -----------------------------------------------------------------------------------


@pytest.mark.parametrize("picture_format", ["png", "mp4"])
def test_a_replay_gives_the_same_tables_bit_by_bit(tmp_path, picture_format):
    rig_file = simulated(tmp_path / "rig", picture_format)
    for command, source, extra in (
        ("run", rig_file, ("--record", tmp_path / "s.mcap")),
        ("replay", tmp_path / "s.mcap", ()),
    ):
        tables = ["--points", tmp_path / f"{command}.p", "--tracks", tmp_path / f"{command}.t"]
        done = invoked(command, source, *tables, *extra)
        assert done.exit_code == 0, done.output
    assert done.stdout.splitlines()[-1] == (
        f"all {FRAMES} fixes are the recorded ones, to the last bit"
    )
    for table in ("p", "t"):
        run, replay = ((tmp_path / f"{name}.{table}").read_bytes() for name in ("run", "replay"))
        assert run == replay


def test_pictures_and_times_are_recorded_as_they_were_used(rig_file, tmp_path):
    text = rig_file.read_text()
    turned = text.replace('name = "left"', 'name = "left"\nrotate_deg = 180\noffset_s = 0.01', 1)
    rig = rig_file.with_name("turned.toml")
    rig.write_text(turned)
    recording, first, again = (tmp_path / name for name in ("s.mcap", "p.csv", "q.csv"))
    run = ("run", rig, "--record", recording, "--images", "png", "--tracks", first)
    assert invoked(*run).exit_code == 0
    assert invoked("replay", recording, "--tracks", again).exit_code == 0
    assert again.read_bytes() == first.read_bytes()
    assert Rig.load(recording).views[0].rotate_deg == 0


def test_a_recording_without_tracking_replays_as_a_run(recording, rig_file, tmp_path):
    done = invoked("record", rig_file, tmp_path / "r.mcap")
    assert done.exit_code == 0, done.output
    assert f"{FRAMES} frames of each view" in done.stdout
    done = invoked("replay", tmp_path / "r.mcap", "--points", tmp_path / "p.csv")
    assert done.exit_code == 0, done.output
    assert "recorded ones" not in done.stdout
    assert (tmp_path / "p.csv").read_bytes() == recording.with_name("p.csv").read_bytes()


def test_a_session_on_the_page_replays_as_it_was_shown(recording, rig_file, tmp_path):
    path, tables = tmp_path / "live.mcap", [tmp_path / "p.csv", tmp_path / "t.csv"]
    with served(rig_file, "--record", path) as running:
        wait_until(lambda: path.exists() and "whole" in invoked("info", path).output)
        running.process.send_signal(signal.SIGINT)
        running.end()
    done = invoked("replay", path, "--points", tables[0], "--tracks", tables[1])
    assert done.exit_code == 0, done.output
    assert f"all {FRAMES} fixes are the recorded ones, to the last bit" in done.output
    for table, of_run in zip(tables, ("p.csv", "t.csv"), strict=True):
        assert table.read_bytes() == recording.with_name(of_run).read_bytes()


def test_a_replay_of_a_view_that_was_silent_gives_the_recorded_fixes(rig_file, tmp_path):
    """Meanwhile the number of its next frame is that of several fixes; nothing is damaged."""
    rig = Rig.load(rig_file)
    path = tmp_path / "s.mcap"
    pointer = Pointer(rig)
    with open_views(rig.sources) as sources:
        first, *later = read_views(sources)
        silent = [
            (Loss(1, right.time_s, f"no picture has come for 0.{k} s"), right)
            for k, (_, right) in enumerate(later)
        ]
        with open_recorder(path, rig, sources, None, is_live=True) as recorder:
            for step in steps(pointer, recorder.watch([first, *silent])):
                recorder.take(step)
    done = invoked("replay", path)
    assert done.exit_code == 0, done.output
    assert f"all {FRAMES} fixes are the recorded ones, to the last bit" in done.stdout
    assert "damaged" not in done.stdout


def test_a_replay_from_a_time_gives_the_fixes_of_a_run_from_there(recording, rig_file, tmp_path):
    tables = []
    for command, source in (("run", rig_file), ("replay", recording)):
        tables.append(tmp_path / f"{command}.csv")
        done = invoked(command, source, "--start", 0.2, "--points", tables[-1])
        assert done.exit_code == 0, done.output
    begun = read_points(tables[0])
    assert [row.time_s for row in begun] == pytest.approx([0.2, 0.24, 0.28])
    assert tables[0].read_bytes() == tables[1].read_bytes()
    assert "the views end before that" in refused("replay", recording, "--start", 9)


def test_fixes_with_other_options_are_compared_with_the_recorded_ones(recording, tmp_path):
    table = tmp_path / "b.csv"
    done = invoked("replay", recording, "--model", "paper", "--beside", table)
    assert done.exit_code == 0, done.output
    assert "fixes differ from the recorded ones" in done.stdout
    header, *rows = table.read_text().splitlines()
    assert header == "frame,time_s,status,x,y,recorded_status,recorded_x,recorded_y,distance"
    cells = rows[-1].split(",")
    x, y, old_x, old_y, distance = (float(cells[k]) for k in (3, 4, 6, 7, 8))
    assert distance > 0
    assert distance == pytest.approx(np.hypot(x - old_x, y - old_y))
    recorded = recording.with_name("p.csv").read_text().splitlines()[-1].split(",")
    assert cells[6:8] == recorded[3:5]


def test_options_of_the_tracker_are_set_by_name(recording):
    assert "no_such" in refused("replay", recording, "--set", "fit.no_such=1")
    said = refused("replay", recording, "--set", "fit")
    assert said.endswith(f"KEY=VALUE as in TOML is right, such as {SETTING_EXAMPLE}")
    Pointer(Rig.load(recording), tracker_options=settings_of("ribbon", (SETTING_EXAMPLE,)))
    done = invoked("replay", recording, "--set", 'model="paper"')
    assert "differ from the recorded" in done.stdout


def test_steps_are_replayed_in_order_whatever_their_times(tmp_path):
    picture = np.zeros((4, 6, 3), np.uint8)
    together = [
        (Frame(0, 0.0, picture), None),
        (Frame(1, 0.1, picture), Frame(0, -0.35, picture)),
        (Loss(2, 0.1 + 0.2, "its picture is damaged"), Frame(5, 1 / 3, picture[..., 0])),
    ]
    path = tmp_path / "s.mcap"
    with Recorder(path, about("a", "b"), "", [None, None], images=Images.PNG) as recorder:
        assert list(recorder.watch(together)) == together
    sources = {view: f"{path}#{view}" for view in "ab"}
    with open_views(sources) as opened:
        seen = list(read_views(opened))
    assert [[entry and (entry.index, entry.time_s) for entry in step] for step in seen] == [
        [entry and (entry.index, entry.time_s) for entry in step] for step in together
    ]
    assert seen[2][0] == together[2][0]
    assert seen[2][1].image.shape == (4, 6)
    assert (seen[1][1].image == picture).all()


def test_a_view_that_is_not_in_a_recording_is_named(recording, tmp_path):
    with pytest.raises(SourceError, match="has no view 'top'; it has left, right"):
        open_source(f"{recording}#top")
    with pytest.raises(SourceError, match=r"name one of its views: .*#left or .*#right"):
        open_source(str(recording))
    with pytest.raises(SourceError, match="No such file"):
        open_source(str(tmp_path / "none.mcap#left"))
    (tmp_path / "text.mcap").write_text("nothing of the kind")
    assert "is no MCAP file" in refused("replay", tmp_path / "text.mcap")
    assert "ends in .mcap" in refused("replay", tmp_path / "text.csv")


def test_two_views_may_read_one_recording_but_not_one_view_of_it(recording):
    with pytest.raises(InvalidInputError, match=r'"a" and "b" both read .*#left'):
        open_views({"a": f"{recording}#left", "b": f"{recording}#left"}).__enter__()


# --- export -----------------------------------------------------------------------------------


def test_exported_tables_are_those_of_the_run(recording, tmp_path):
    tables = [tmp_path / "p.csv", tmp_path / "t.csv"]
    done = invoked("export", recording, "--points", tables[0], "--tracks", tables[1])
    assert done.exit_code == 0, done.output
    for table in tables:
        assert table.read_bytes() == recording.with_name(table.name).read_bytes()
    assert "nothing to write" in refused("export", recording)


def test_exported_parquet_is_read_by_arrow(recording, tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet")
    paths = [tmp_path / "p.parquet", tmp_path / "t.parquet"]
    done = invoked("export", recording, "--points", paths[0], "--tracks", paths[1])
    assert done.exit_code == 0, done.output
    points, tracks = (parquet.read_table(path) for path in paths)
    assert points.schema.names == [
        *("frame", "time_s", "status", "x_mm", "y_mm", "cov_xx_mm2", "cov_xy_mm2", "cov_yy_mm2"),
        *("crossing_angle_deg", "reason"),
    ]
    assert [str(kind) for kind in points.schema.types] == [
        *("int64", "double", "string", *["double"] * 6, "string")
    ]
    assert points.schema.metadata[b"unit"] == b"mm"
    assert "[mm²]" in points.schema.field("cov_xy_mm2").metadata[b"meaning"].decode()
    rows = read_points(recording.with_name("p.csv"))
    for row, cells in zip(rows, points.to_pylist(), strict=True):
        assert list(cells.values()) == list(dataclasses.asdict(row).values())
    lines = read_tracks(recording.with_name("t.csv"))
    assert "tip_u_px" in tracks.schema.names
    for line, cells in zip(lines, tracks.to_pylist(), strict=True):
        assert list(cells.values()) == list(dataclasses.asdict(line).values())
    nowhere = tmp_path / "nowhere" / "p.parquet"
    assert "No such file or directory" in refused("export", recording, "--points", nowhere)


def test_a_full_disk_leaves_the_previous_parquet(recording, tmp_path):
    pytest.importorskip("pyarrow.parquet")
    table = tmp_path / "p.parquet"
    assert invoked("export", recording, "--points", table).exit_code == 0
    before = table.read_bytes()
    program = """
import resource, sys
from fingerpost.cli import main
resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))
main(["export", sys.argv[1], "--points", sys.argv[2]])
"""
    done = subprocess.run(
        [sys.executable, "-c", program, recording, table],
        check=False,
        capture_output=True,
        text=True,
    )
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"fingerpost: {table}: cannot be written: ")
    assert "File too large" in line
    assert done.returncode != 0
    assert table.read_bytes() == before
    assert list(tmp_path.iterdir()) == [table]


def test_an_exported_video_shows_every_step_at_its_time(recording, rig_file, tmp_path):
    assert invoked("export", recording, "--video", tmp_path / "v.webm").exit_code == 0
    with open_source(str(tmp_path / "v.webm")) as video:
        frames = list(video)
    times = [row.time_s for row in read_points(recording.with_name("p.csv"))]
    assert [frame.time_s for frame in frames] == pytest.approx(times, abs=2e-3)
    plain = [
        cv2.imread(str(sorted((rig_file.parent / v).iterdir())[-1])) for v in ("left", "right")
    ]
    shown, views = frames[-1].image, np.hstack(plain)
    assert shown.shape == views.shape
    differs = np.abs(shown.astype(int) - views).max(axis=2) > 90
    assert 0.002 < differs.mean() < 0.1  # only lines and words


# --- failures --------------------------------------------------------------------------------


def test_a_recording_overwrites_no_file(rig_file, recording):
    before = recording.read_bytes()
    assert "is there already" in refused("record", rig_file, recording)
    assert recording.read_bytes() == before
    assert "ends in .mcap" in refused("run", rig_file, "--record", recording.with_suffix(".avi"))


def test_a_run_refused_at_its_first_frame_leaves_no_recording(rig_file, tmp_path):
    wrong = rig_file.with_name("wrong.toml")
    wrong.write_text(re.sub(r"size_px = .*", "size_px = [99, 99]", rig_file.read_text()))
    for command in (["run", wrong, "--record"], ["record", wrong]):
        assert "size_px = [99, 99]" in refused(*command, tmp_path / "s.mcap")
        assert not (tmp_path / "s.mcap").exists()


def test_without_the_extra_one_line_says_how_to_install_it(recording, rig_file, tmp_path):
    program = (
        "import sys; sys.modules['mcap.records'] = None; "
        "from fingerpost.cli import main; main(sys.argv[1:])"
    )
    for arguments in (["info", recording], ["replay", recording], ["record", rig_file, "s.mcap"]):
        command = [sys.executable, "-c", program, *map(str, arguments)]
        done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path)
        assert done.returncode == 1
        (line,) = done.stderr.splitlines()
        assert "pip install 'fingerpost[mcap]'" in line


class Held:
    """An encoder that blocks until it is released."""

    def __init__(self) -> None:
        self.may_go = threading.Event()
        self.is_held = threading.Event()

    def encode(self, *_):
        self.is_held.set()
        assert self.may_go.wait(60)
        return b"\xff\xd8\xff"


def test_live_frames_are_dropped_if_the_recorder_is_slow(tmp_path, monkeypatch, caplog):
    held = Held()
    monkeypatch.setattr("fingerpost.recording.session.recorder._encoded", held.encode)
    picture = np.zeros((4, 6), np.uint8)
    path = tmp_path / "s.mcap"
    with Recorder(path, about("a", is_live=True), "", [None], images=Images.JPEG) as recorder:
        given = recorder.watch((Frame(k, 0.1 * k, picture),) for k in itertools.count())
        next(given)
        assert held.is_held.wait(60)
        seen = list(itertools.islice(given, 50))  # the queue takes 32 of them
        held.may_go.set()
    assert len(seen) == 50
    assert recorder.notes() == [
        f"{path}: 18 of 51 steps were dropped: the disk or the processor was too slow"
    ]
    assert "frames are dropped" in caplog.text
    kept = [m["step"] for topic, *_, m in messages(path) if topic == "/frames"]
    assert kept == list(range(33))


def test_recorded_frames_wait_for_the_recorder(tmp_path):
    picture = np.zeros((4, 6), np.uint8)
    path = tmp_path / "s.mcap"
    with Recorder(path, about("a"), "", [None], images=Images.PNG) as recorder:
        for _ in recorder.watch((Frame(k, 0.1 * k, picture),) for k in range(200)):
            pass
    assert recorder.notes() == []
    assert [m["step"] for topic, *_, m in messages(path) if topic == "/frames"] == list(range(200))


def test_ctrl_c_leaves_a_whole_recording(tmp_path):
    picture = np.zeros((4, 6), np.uint8)
    path = tmp_path / "s.mcap"

    def record():
        with Recorder(path, about("a"), "", [None], images=Images.PNG) as recorder:
            for (frame,) in recorder.watch((Frame(k, 0.1 * k, picture),) for k in range(9)):
                if frame.index == 5:
                    raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        record()
    assert [m["step"] for topic, *_, m in messages(path) if topic == "/frames"] == list(range(6))
    assert json.loads(invoked("info", path, "--json").stdout)["wrong"] == ""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="needs /dev/full's error")
def test_a_full_disk_is_reported_at_once(rig_file, tmp_path, monkeypatch):
    def full(_descriptor):
        raise OSError(28, "No space left on device")

    path = tmp_path / "s.mcap"
    recorder = Recorder(path, about("a"), "", [None], images=Images.PNG)
    whole = path.stat().st_size
    monkeypatch.setattr(os, "fsync", full)
    picture = np.random.default_rng(0).integers(0, 255, (400, 600), dtype=np.uint8)
    endless = recorder.watch((Frame(k, 0.1 * k, picture),) for k in itertools.count())
    with pytest.raises(RecordingError, match="No space left on device"):
        for _ in endless:
            pass
    recorder.close()
    assert path.stat().st_size == whole


@pytest.mark.parametrize("flushes", [0, 1])
def test_a_recording_onto_a_full_disk_is_not_said_to_hold_all_frames(
    rig_file, tmp_path, monkeypatch, flushes
):
    left = iter([None] * flushes)
    full = OSError(28, "No space left on device")

    def fill(_descriptor):
        if next(left, full) is full:
            raise full

    monkeypatch.setattr(os, "fsync", fill)
    done = invoked("record", rig_file, tmp_path / "s.mcap")
    assert (done.exit_code, done.stdout) == (1, "")
    assert ("nothing is left" in done.stderr) == (flushes == 0)
    assert (tmp_path / "s.mcap").exists() == (flushes == 1)


@pytest.mark.skipif(os.name == "nt", reason="Windows keeps open files")
def test_a_removed_recording_is_reported(tmp_path):
    folder = tmp_path / "gone"
    folder.mkdir()
    recorder = Recorder(folder / "s.mcap", about("a"), "", [None], images=Images.PNG)
    (folder / "s.mcap").unlink()
    folder.rmdir()
    picture = np.zeros((4, 6), np.uint8)
    with pytest.raises(RecordingError, match="was removed while it was written"), recorder:
        for _ in recorder.watch((Frame(k, 0.1 * k, picture),) for k in range(3)):
            pass


def test_buffered_entries_are_written_within_a_second(tmp_path):
    """By the recorder's clock, an entry that arrives when a flush is due is flushed at once."""
    clock = itertools.chain([0.0, 0.1, 0.6], itertools.repeat(0.6))
    path = tmp_path / "s.mcap"
    recorder = Recorder(path, about("a"), "", [None], images=Images.PNG, clock=lambda: next(clock))
    empty = path.stat().st_size
    with recorder:
        next(recorder.watch([(Frame(0, 0.0, np.zeros((4, 6), np.uint8)),)]))
        with open_source(f"{path}#a") as source:
            deadline = threading.Event()
            for _ in range(600):
                if path.stat().st_size > empty:
                    break
                deadline.wait(0.1)
            assert next(source).index == 0
