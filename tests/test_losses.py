"""A picture that is lost is lost for its view only: in tables, summary, doctor and tracker."""

import csv
import json
import shutil
from pathlib import Path

import pytest
from command_line import invoked

from fingerpost.capture import Frame, Loss, open_source
from fingerpost.config import Rig
from fingerpost.pipeline import Pointer
from fingerpost.pointing import Status
from fingerpost.simulate import DevicePose, SimulatedRig, Trajectory, write_recording

FRAMES = 12
BROKEN = 8


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pose = DevicePose.pointing_at((200.0, 200.0), azimuth_deg=20.0, slant_deg=50.0, hover_mm=120.0)
    directory = tmp_path_factory.mktemp("recording")
    return write_recording(directory, SimulatedRig(), Trajectory.hold(pose, 1.0), frames=FRAMES)


@pytest.fixture(params=["left", "right"])
def damaged(request: pytest.FixtureRequest, recording: Path, tmp_path: Path) -> tuple[str, Path]:
    """The view with one truncated picture, and the rig file."""
    shutil.copytree(recording.parent, tmp_path / "copy")
    images = sorted((tmp_path / "copy" / request.param).glob("*.png"))
    images[BROKEN].write_bytes(images[BROKEN].read_bytes()[:500])
    return request.param, tmp_path / "copy" / recording.name


def test_a_picture_that_cannot_be_decoded_is_lost_for_its_view_and_reported(damaged, tmp_path):
    view, rig_file = damaged
    tables = tmp_path / "points.csv", tmp_path / "tracks.csv"
    done = invoked("run", rig_file, "--points", tables[0], "--tracks", tables[1])
    assert done.exit_code == 0
    points, tracks = (list(csv.DictReader(table.read_text().splitlines())) for table in tables)
    assert [int(row["frame"]) for row in points] == list(range(FRAMES))
    assert [row["status"] for row in points[BROKEN - 1 : BROKEN + 2]] == ["ok", "lost", "ok"]
    assert points[BROKEN]["reason"] == f'view "{view}": its picture cannot be decoded'
    assert [row["status"] for row in tracks if int(row["frame"]) == BROKEN] == (
        ["lost", "tracking"] if view == "left" else ["tracking", "lost"]
    )
    said = done.stdout.splitlines()
    (note,) = said[said.index("notes") + 1 :]
    assert note.strip().startswith(f"{view}: 1 of {FRAMES} pictures are damaged (")


def test_json_output_and_the_doctor_report_a_loss_as_well(damaged):
    view, rig_file = damaged
    *rows, last = map(json.loads, invoked("run", rig_file, "--json").stdout.splitlines())
    assert len(rows) == FRAMES
    (note,) = last["notes"]
    assert note.startswith(f"{view}: 1 of {FRAMES} pictures are damaged (")
    report = json.loads(invoked("doctor", rig_file, "--json").stdout)
    (finding,) = [f for f in report["findings"] if f["check"] == "pictures"]
    assert (finding["severity"], finding["view"]) == ("warning", view)
    assert finding["what"].startswith(f"1 of {FRAMES} pictures are damaged (")
    assert [f for f in report["findings"] if f["check"] == "timing"] == []


def test_sound_pictures_leave_no_note(recording):
    assert "notes" not in invoked("run", recording).stdout
    assert "notes" not in invoked("run", recording, "--json").stdout
    assert json.loads(invoked("doctor", recording, "--json").stdout)["notes"] == []


def test_trackers_treat_a_loss_as_a_missing_frame(recording):
    rig = Rig.load(recording)
    with open_source(rig.views[0].source) as left, open_source(rig.views[1].source) as right:
        pairs = list(zip(left, right, strict=True))
    lost = Loss(BROKEN, BROKEN / 25, "its picture is damaged")
    with_none, with_loss = (
        [pairs[k] if k != BROKEN else (pairs[k][0], gone) for k in range(FRAMES)]
        for gone in (None, lost)
    )
    runs = []
    for frames in (with_none, with_loss):
        pointer = Pointer(rig)
        steps = [step for seen in frames for step in pointer.update(seen)]
        runs.append([*steps, *pointer.finish()])
    without, with_ = runs
    step = with_[BROKEN]
    assert step.observations[1].frame is None
    assert step.observations[1].reasons == (lost.why,)
    assert (step.fix.status, step.fix.reason) == (Status.LOST, f'view "right": {lost.why}')
    # Later frames are as if that picture had not existed.
    for one, other in zip(without[BROKEN + 1 :], with_[BROKEN + 1 :], strict=True):
        assert one.point_row() == other.point_row()


def test_a_first_view_that_is_lost_has_its_row(recording):
    rig = Rig.load(recording)
    with open_source(rig.views[1].source) as right:
        frame = next(right)
    assert isinstance(frame, Frame)
    pointer = Pointer(rig)
    (step,) = pointer.update([Loss(0, frame.time_s, "its picture is damaged"), frame])
    assert step.point_row().reason.startswith('view "left": its picture is damaged')
    assert step.observations[0].track_row() is not None
