"""Outputs of commands overwrite neither inputs nor each other, and are checked before the work."""

import json
import os
import re
from pathlib import Path

import cv2
import pytest
from command_line import invoked, refused

from fingerpost.cli.outputs import keep_apart
from fingerpost.cli.progress import counting
from fingerpost.errors import InvalidInputError
from fingerpost.recording import check_picture, read_tracks
from fingerpost.simulate import DevicePose, Placement, SimulatedRig, Trajectory, write_recording

FRAMES = 6
SMALL = ("--targets", 2, "--size", 320, 240)


def recorded(folder: Path, picture_format: str) -> Path:
    pose = DevicePose.pointing_at((200.0, 200.0), azimuth_deg=20.0, slant_deg=50.0, hover_mm=120.0)
    rig = SimulatedRig(Placement(width_px=320, height_px=240))
    motion = Trajectory.hold(pose, 1.0)
    return write_recording(folder, rig, motion, frames=FRAMES, picture_format=picture_format)


@pytest.fixture
def videos(tmp_path):
    return recorded(tmp_path / "videos", "mp4")


@pytest.fixture
def pictures(tmp_path):
    return recorded(tmp_path / "pictures", "png")


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def with_detour(path: Path, target: Path) -> Path:
    path.mkdir()
    return path / ".." / os.path.relpath(target, path.parent)


def symlinked(path: Path, target: Path) -> Path:
    path.symlink_to(target)
    return path


def hard_linked(path: Path, target: Path) -> Path:
    os.link(target, path)
    return path


# --- inputs -----------------------------------------------------------------------------------


@pytest.mark.parametrize("named", [with_detour, symlinked, hard_linked])
@pytest.mark.parametrize(
    ("option", "victim", "what"),
    [
        ("--overlay", "left.mp4", 'footage of view "left"'),
        ("--points", "right.mp4", 'footage of view "right"'),
        ("--tracks", "rig.toml", "the rig file"),
    ],
)
def test_run_does_not_write_over_its_inputs(videos, tmp_path, named, option, victim, what):
    output = named(tmp_path / "link.mp4", videos.with_name(victim))
    before = contents(tmp_path)
    line = refused("run", videos, option, output)
    assert f"{option} {output} would overwrite {videos.with_name(victim)}, {what}" in line
    assert contents(tmp_path) == before


def test_run_does_not_write_over_an_image_of_a_glob(pictures):
    image = pictures.parent / "left" / "00003.png"
    before = image.read_bytes()
    assert str(image) in refused("run", pictures, "--points", image)
    assert image.read_bytes() == before


def test_a_refused_video_leaves_tables_unchanged(videos, tmp_path):
    table = tmp_path / "points.csv"
    table.write_text("of the last run")
    refused("run", videos, "--points", table, "--overlay", tmp_path / "overlay.gif")
    assert table.read_text() == "of the last run"


@pytest.mark.parametrize(
    "refusing", [("--tracks", "missing/t.csv"), ("--overlay", "missing/o.mp4"), ("--tracks", ".")]
)
def test_a_refused_run_leaves_tables_unchanged_and_creates_none(videos, tmp_path, refusing):
    (tmp_path / "keep.csv").write_text("of the last run")
    before = contents(tmp_path)
    option, name = refusing
    for table in ("keep.csv", "new.csv"):
        refused("run", videos, "--points", tmp_path / table, option, tmp_path / name)
        assert contents(tmp_path) == before


def test_a_refused_first_frame_leaves_tables_unchanged(videos, tmp_path):
    table = tmp_path / "keep.csv"
    table.write_text("of the last run")
    measured_in_larger_images = re.sub(r"(\d+\.\d{6})", r"\1e1", videos.read_text())
    videos.write_text(measured_in_larger_images)
    assert "reference points lie outside" in refused(
        "run", videos, "--points", table, "--overlay", tmp_path / "o.mp4"
    )
    assert table.read_text() == "of the last run"
    assert not list(tmp_path.glob("o*.mp4"))


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="needs a folder nobody can write into")
def test_a_video_in_a_read_only_folder_leaves_tables_unchanged(videos, tmp_path):
    table = tmp_path / "keep.csv"
    table.write_text("of the last run")
    line = refused("run", videos, "--points", table, "--overlay", "/proc/overlay.mp4")
    assert "/proc/overlay.mp4: cannot be written" in line
    assert table.read_text() == "of the last run"


def test_a_video_in_progress_overwrites_no_existing_file(videos, tmp_path):
    text = videos.read_text().replace("left.mp4", "left.part.mp4")
    videos.write_text(text)
    footage = (videos.parent / "left.mp4").rename(videos.parent / "left.part.mp4")
    before = footage.read_bytes()
    done = invoked("run", videos, "--overlay", videos.parent / "left.mp4", "--max-frames", 2)
    assert done.exit_code == 0, done.output
    assert footage.read_bytes() == before
    names = sorted(path.name for path in videos.parent.glob("*.mp4"))
    assert names == ["left.mp4", "left.part.mp4", "right.mp4"]


def test_a_table_may_have_the_name_of_a_video_in_progress(videos, tmp_path):
    table, video = tmp_path / "o.part.mp4", tmp_path / "o.mp4"
    done = invoked("run", videos, "--tracks", table, "--overlay", video, "--max-frames", 2)
    assert done.exit_code == 0, done.output
    assert len(read_tracks(table)) == 4
    assert cv2.VideoCapture(str(video)).get(cv2.CAP_PROP_FRAME_COUNT) == 2


def test_the_experiment_does_not_draw_over_its_inputs(pictures):
    truth = pictures.with_name("truth.csv")
    image = pictures.parent / "right" / "00000.png"
    before = contents(pictures.parent)
    line = refused("experiment", "--recording", pictures, "--truth", truth, "--draw", image)
    assert f"--draw {image} would overwrite {image}" in line
    renamed = truth.rename(truth.with_suffix(".png"))
    line = refused("experiment", "--recording", pictures, "--truth", renamed, "--draw", renamed)
    assert "the truth" in line
    renamed.rename(truth)
    assert contents(pictures.parent) == before


def test_advise_does_not_draw_over_its_inputs(pictures):
    image = pictures.parent / "left" / "00000.png"
    before = image.read_bytes()
    assert 'footage of view "left"' in refused("advise", pictures, "--draw", image)
    assert image.read_bytes() == before


# --- other outputs ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    "options",
    [
        ("--points", "same.csv", "--tracks", "same.csv"),
        ("--points", "same.csv", "--tracks", "there/../same.csv"),
        ("--points", "o.mp4", "--overlay", "o.mp4"),
    ],
)
def test_two_outputs_to_one_file_are_refused(videos, tmp_path, monkeypatch, options):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there").mkdir()
    line = refused("run", videos, *options)
    assert "are one file; name two" in line
    assert options[0] in line
    assert options[2] in line
    assert sorted(path.name for path in tmp_path.iterdir()) == ["there", "videos"]


def test_outputs_through_links_to_one_new_file_are_refused(tmp_path):
    outputs = {name: symlinked(tmp_path / name, tmp_path / "new.csv") for name in ("a", "b")}
    with pytest.raises(InvalidInputError, match="are one file"):
        keep_apart(outputs, [])


def test_different_files_and_the_null_device_pass(tmp_path):
    (tmp_path / "old.csv").touch()
    read = [("the rig file", tmp_path / "rig.toml")]
    outputs = {"--a": tmp_path / "old.csv", "--b": tmp_path / "new.csv", "--c": None}
    keep_apart(outputs, read)
    keep_apart({"--a": Path(os.devnull), "--b": Path(os.devnull)}, read)
    keep_apart({"--a": tmp_path / ("x" * 5000), "--b": tmp_path / ("y" * 5000)}, read)


def test_sources_of_live_views_are_not_treated_as_files(tmp_path, videos):
    text = videos.read_text().replace('"left.mp4"', "0").replace("right.mp4", "rtsp://nowhere/*")
    (tmp_path / "rig.toml").write_text(text)
    line = refused("run", tmp_path / "rig.toml", "--points", "p.csv", "--tracks", "p.csv")
    assert "are one file" in line


# --- pictures, before and after the work ------------------------------------------------------


@pytest.fixture
def no_work(monkeypatch):
    """Fail if the work is begun."""

    def begun(*_: object, **__: object) -> None:
        pytest.fail("the work was begun")

    for name in ("experiment.run_experiment", "experiment.run_recording", "advise.advise"):
        monkeypatch.setattr(f"fingerpost.{name}", begun)


@pytest.mark.parametrize(
    ("picture", "words"),
    [
        ("missing/x.png", "does not exist"),
        ("x.nonsense", "a name that ends in .png is right"),
        ("x", "a name that ends in .png is right"),
        ("folder.png", "is a folder"),
    ],
)
@pytest.mark.usefixtures("no_work")
def test_an_invalid_picture_name_is_refused_before_the_work(pictures, tmp_path, picture, words):
    (tmp_path / "folder.png").mkdir()
    path = tmp_path / picture
    truth = pictures.with_name("truth.csv")
    assert words in refused("experiment", *SMALL, "--draw", path)
    assert words in refused("experiment", "--recording", pictures, "--truth", truth, "--draw", path)
    assert words in refused("advise", pictures, "--draw", path)


def test_a_valid_picture_name_passes_and_nothing_is_written(tmp_path):
    check_picture(tmp_path / "new.png")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("command", "kind"),
    [("experiment", "experiment.ExperimentResult"), ("advise", "advise.Advice")],
)
def test_figures_are_printed_even_if_drawing_fails(pictures, tmp_path, monkeypatch, command, kind):
    def full(_result: object, path: Path) -> None:
        raise InvalidInputError(f"{path}: cannot be written: No space left on device")

    monkeypatch.setattr(f"fingerpost.{kind}.draw", full)
    arguments = SMALL if command == "experiment" else (pictures,)
    done = invoked(command, *arguments, "--json", "--draw", tmp_path / "x.png")
    assert done.exit_code == 2
    assert json.loads(done.stdout)
    assert "No space left" in done.stderr


# --- options without effect -------------------------------------------------------------------


@pytest.mark.parametrize(
    "options",
    [
        ("--noise", 99),
        ("--targets", 400),
        ("--seed", 1),
        ("--size", 320, 240),
        ("--background-frames", 3),
        ("--approach-frames", 3),
        ("--lens", "known"),
    ],
)
@pytest.mark.usefixtures("no_work")
def test_options_of_the_simulation_are_refused_with_a_recording(pictures, options):
    truth = pictures.with_name("truth.csv")
    line = refused("experiment", "--recording", pictures, "--truth", truth, *options)
    assert f"{options[0]} does not go with --recording" in line


def test_a_recording_takes_the_other_options(pictures, tmp_path):
    arguments = ["--recording", pictures, "--truth", pictures.with_name("truth.csv")]
    arguments += ["--tracker", "paper", "--draw", tmp_path / "e.png", "--json"]
    done = invoked("experiment", *arguments)
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["settings"]["tracker_options"] == {"model": "paper"}
    assert (tmp_path / "e.png").stat().st_size > 0


# --- progress ---------------------------------------------------------------------------------


def progress(monkeypatch, capsys, *, watched: bool, counts: int) -> str:
    monkeypatch.setattr("sys.stderr.isatty", lambda: watched)
    with counting("moves") as count:
        for done in range(1, counts + 1):
            count(done, 2)
    return capsys.readouterr().err


def test_counting_updates_one_line_on_a_terminal(monkeypatch, capsys):
    said = progress(monkeypatch, capsys, watched=True, counts=2)
    assert [words.rstrip() for words in said.split("\r")] == ["", "1 of 2 moves", "2 of 2 moves"]
    assert said.endswith("\n")
    assert said.count("\n") == 1


def test_counting_is_silent_without_a_terminal_or_without_counts(monkeypatch, capsys):
    assert progress(monkeypatch, capsys, watched=False, counts=2) == ""
    assert progress(monkeypatch, capsys, watched=True, counts=0) == ""
