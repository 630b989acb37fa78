"""Tables and videos: contents survive a crash and are read back unchanged."""

import math
import os
import re
import shutil
import signal
import struct
import subprocess
import sys
import threading
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from patience import PATIENCE_S

from fingerpost.errors import FingerpostError, InvalidInputError, RecordingError
from fingerpost.recording import (
    PointRow,
    TrackRow,
    VideoWriter,
    read_points,
    read_tracks,
    webm,
    write_points,
    write_tracks,
)

FORMER_POINTS_HEADER = "frame,time_s,status,x,y,cov_xx,cov_xy,cov_yy,crossing_angle_deg"
POINTS_HEADER = f"{FORMER_POINTS_HEADER},reason"
TRACKS_HEADER = "frame,time_s,view,status,tip_u,tip_v,angle_rad,sigma_angle_rad,sigma_offset_px"
POINT = PointRow(
    frame=3,
    time_s=0.12,
    status="ok",
    x=201.5,
    y=-3.25,
    cov_xx=0.5,
    cov_xy=-0.1,
    cov_yy=0.25,
    crossing_angle_deg=17.5,
)
TRACK = TrackRow(
    frame=3,
    time_s=0.12,
    view="left",
    status="tracking",
    tip_u=194.6,
    tip_v=211.9,
    angle_rad=0.75,
    sigma_angle_rad=0.001,
    sigma_offset_px=0.02,
)


# --- tables ----------------------------------------------------------------------------------


def test_tables_have_the_documented_format(tmp_path):
    with write_points(tmp_path / "p.csv") as points, write_tracks(tmp_path / "t.csv") as tracks:
        points.write(
            PointRow(frame=2, time_s=0.08, status="acquiring", reason='view "a": why, how')
        )
        points.write(POINT)
        tracks.write(TRACK)
        tracks.write(TrackRow(frame=4, time_s=0.16, view="up, down", status="lost"))
    assert (tmp_path / "p.csv").read_bytes().decode() == (
        f"{POINTS_HEADER}\n"
        '2,0.08,acquiring,,,,,,,"view ""a"": why, how"\n'
        "3,0.12,ok,201.5,-3.25,0.5,-0.1,0.25,17.5,\n"
    )
    assert (tmp_path / "t.csv").read_bytes().decode() == (
        f"{TRACKS_HEADER}\n3,0.12,left,tracking,194.6,211.9,0.75,0.001,0.02\n"
        '4,0.16,"up, down",lost,,,,,\n'
    )


def test_numbers_from_numpy_are_written_as_numbers(tmp_path):
    row = PointRow(frame=0, time_s=np.float64(0.1), status="ok", x=np.float64(1 / 3), y=2)
    with write_points(tmp_path / "p.csv") as table:
        table.write(row)
    assert (tmp_path / "p.csv").read_text().splitlines()[1] == f"0,0.1,ok,{1 / 3},2,,,,,"


finite = st.floats(allow_nan=False, allow_infinity=False)
sigmas = st.floats(min_value=0, allow_infinity=False) | st.none()
times = st.floats(0, 1e9)
words = st.text().filter(str.isprintable)


@st.composite
def point_rows(draw: st.DrawFn) -> PointRow:
    x, y = draw(st.tuples(finite, finite) | st.just((None, None)))
    deviations = st.just(0.0) | st.floats(1e-12, 1e12)
    correlation = st.floats(-1, 1)
    covariance = st.tuples(deviations, deviations, correlation).map(
        lambda d: (d[0] * d[0], d[0] * d[1] * d[2], d[1] * d[1])
    )
    xx, xy, yy = draw(covariance | st.just((None, None, None)))
    return PointRow(
        frame=draw(st.integers(0, 2**40)),
        time_s=draw(times),
        status=draw(st.sampled_from(PointRow.STATUSES[0 if x is not None else 1 :])),
        x=x,
        y=y,
        cov_xx=xx,
        cov_xy=xy,
        cov_yy=yy,
        crossing_angle_deg=draw(finite | st.none()),
        reason=draw(words),
    )


@st.composite
def track_rows(draw: st.DrawFn) -> TrackRow:
    u, v, angle = draw(st.tuples(finite, finite, finite) | st.just((None, None, None)))
    statuses = TrackRow.STATUSES if u is not None else ("acquiring", "lost")
    return TrackRow(
        frame=draw(st.integers(0, 2**40)),
        time_s=draw(times),
        view=draw(words.filter(bool)),
        status=draw(st.sampled_from(statuses)),
        tip_u=u,
        tip_v=v,
        angle_rad=angle,
        sigma_angle_rad=draw(sigmas),
        sigma_offset_px=draw(sigmas),
    )


@given(points=st.lists(point_rows(), max_size=5), tracks=st.lists(track_rows(), max_size=5))
def test_rows_are_read_as_they_were_written(tmp_path_factory, points, tracks):
    folder = tmp_path_factory.mktemp("tables")
    with write_points(folder / "p.csv") as table:
        for point in points:
            table.write(point)
    with write_tracks(folder / "t.csv") as table:
        for track in tracks:
            table.write(track)
    assert read_points(folder / "p.csv") == points
    assert read_tracks(folder / "t.csv") == tracks


def test_tables_of_spreadsheets_and_later_versions_are_read(tmp_path):
    path = tmp_path / "p.csv"
    path.write_bytes(
        f"\ufeffnote,{POINTS_HEADER}\r\nhi,3,.12,ok,2015e-1,-3.25,.5,-.1,.25,17.5,\r\n".encode()
    )
    assert read_points(path) == [POINT]


def test_a_table_from_before_there_were_reasons_is_read(tmp_path):
    path = tmp_path / "p.csv"
    path.write_text(f"{FORMER_POINTS_HEADER}\n3,0.12,ok,201.5,-3.25,0.5,-0.1,0.25,17.5\n")
    assert read_points(path) == [POINT]


@pytest.mark.parametrize("words", ["two\nlines", "two\rlines", "a\x1b[2Jterminal cleared"])
def test_texts_that_are_not_one_printable_line_are_refused(words):
    with pytest.raises(InvalidInputError, match=r"reason is .*; one line of printable text"):
        PointRow(frame=0, time_s=0.0, status="lost", reason=words)
    with pytest.raises(InvalidInputError, match=r"view is .*; one line of printable text"):
        TrackRow(frame=0, time_s=0.0, view=words, status="lost")


def test_a_killed_run_loses_no_row(tmp_path):
    program = """
import os, signal, sys
from fingerpost.recording import PointRow, write_points
table = write_points(sys.argv[1])
for frame in range(100):
    table.write(PointRow(frame=frame, time_s=frame / 25, status="lost"))
os.kill(os.getpid(), signal.SIGKILL)
"""
    done = subprocess.run([sys.executable, "-c", program, str(tmp_path / "p.csv")], check=False)
    assert done.returncode == -signal.SIGKILL
    assert [row.frame for row in read_points(tmp_path / "p.csv")] == list(range(100))


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs the device that is always full")
def test_a_full_disk_is_an_error():
    with (
        pytest.raises(FingerpostError, match="/dev/full: cannot be written: No space left"),
        write_points("/dev/full"),
    ):
        pass


def test_an_older_table_is_kept_until_the_first_row(tmp_path):
    path = tmp_path / "p.csv"
    path.write_text("of the last run, which was much longer than what comes now" * 10)
    before = path.read_bytes()
    with write_points(path) as table:
        assert path.read_bytes() == before
        table.write(POINT)
        assert read_points(path) == [POINT]
    assert read_points(path) == [POINT]


def test_an_older_table_is_kept_if_the_work_fails_before_the_first_row(tmp_path):
    path = tmp_path / "p.csv"
    path.write_text("of the last run")
    with pytest.raises(InvalidInputError, match="refused"), write_points(path):
        raise InvalidInputError("refused")
    assert path.read_text() == "of the last run"


def test_a_table_without_rows_has_a_header(tmp_path):
    path = tmp_path / "p.csv"
    path.write_text("of the last run")
    with write_points(path):
        pass
    assert path.read_text() == f"{POINTS_HEADER}\n"


def test_a_table_that_is_never_begun_creates_no_file(tmp_path):
    write_points(tmp_path / "p.csv").close()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_a_table_can_be_written_into_a_pipe(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    program = "import sys; sys.stdout.write(open(sys.argv[1]).read())"
    with subprocess.Popen(
        [sys.executable, "-c", program, str(pipe)], stdout=subprocess.PIPE, text=True
    ) as reader:
        with write_points(pipe) as table:
            table.write(POINT)
        assert reader.communicate(timeout=PATIENCE_S)[0].splitlines()[0] == POINTS_HEADER


def test_a_table_that_cannot_be_created_or_read_is_named(tmp_path):
    with pytest.raises(InvalidInputError, match=r"none/p\.csv: cannot be written: No such file"):
        write_points(tmp_path / "none" / "p.csv")
    with pytest.raises(InvalidInputError, match="cannot be written: embedded null byte"):
        write_points("p\0.csv")
    with pytest.raises(InvalidInputError, match=r"none\.csv: No such file"):
        read_tracks(tmp_path / "none.csv")
    (tmp_path / "p.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InvalidInputError, match=r"p\.csv: not a text file in UTF-8"):
        read_points(tmp_path / "p.csv")


@pytest.mark.parametrize(
    ("row", "said"),
    [
        ("3,0.12,ok", "line 3: 3 cells found; the header has 9"),
        ("3.0,0.12,lost,,,,,,", "line 3: frame is '3.0'; a whole number is needed"),
        ("-3,0.12,lost,,,,,,", "line 3: frame is '-3'"),
        (",0.12,lost,,,,,,", "line 3: frame is ''"),
        ("3,,lost,,,,,,", "line 3: time_s is ''; a number is needed"),
        ("3,nan,lost,,,,,,", "line 3: time_s is 'nan'"),
        ("3,1e999,lost,,,,,,", "line 3: time_s is inf; a finite number"),
        ("3,0.12,found,,,,,,", "line 3: status is 'found'; known are ok, acq"),
        ("3,0.12,ok,1,x,,,,", "line 3: y is 'x'"),
        ("3,0.12,ok,1_0,1,,,,", "line 3: x is '1_0'"),
        ("3,0.12,ok,1,,,,,", "line 3: x, y must all be given or all be empty"),
        ("3,0.12,ok,,,,,,", "line 3: x is empty; a fix with status ok has a point"),
        ("3,0.12,ok,1,1,1,,1,", "line 3: cov_xx, cov_xy, cov_yy must all be given"),
        ("3,0.12,ok,1,1,1,2,1,", "line 3: cov_xx, cov_xy, cov_yy = 1.0, 2.0, 1.0: not a cov"),
        ("3,0.12,ok,1,1,-1,0,1,", "not a covariance"),
        ('3,0.12,"ok', "line 3: unexpected end of data"),
    ],
)
def test_a_bad_row_is_named_by_its_line(tmp_path, row, said):
    path = tmp_path / "p.csv"
    path.write_text(f"{FORMER_POINTS_HEADER}\n0,0.0,lost,,,,,,\n{row}\n")
    with pytest.raises(InvalidInputError) as raised:
        read_points(path)
    assert str(raised.value).startswith(f"{path}: ")
    assert said in str(raised.value)
    assert "\n" not in str(raised.value)


def test_a_missing_column_is_named(tmp_path):
    path = tmp_path / "t.csv"
    path.write_text(TRACKS_HEADER.replace("view,", "") + "\n")
    with pytest.raises(InvalidInputError, match=r"t\.csv: line 1: the column view is missing"):
        read_tracks(path)
    path.write_text("")
    with pytest.raises(InvalidInputError, match="the column frame is missing"):
        read_tracks(path)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"view": ""}, "view is empty"),
        ({"tip_u": None}, "tip_u, tip_v, angle_rad must all be given"),
        ({"tip_u": None, "tip_v": None, "angle_rad": None}, "a finger that is tracked has a tip"),
        ({"angle_rad": math.inf}, "angle_rad is inf"),
        ({"sigma_offset_px": -1.0}, "sigma_offset_px is -1.0; 0 or more"),
        ({"status": "ok"}, "known are acquiring, tracking, lost"),
        ({"frame": True}, "frame is True"),
    ],
)
def test_an_inconsistent_row_is_refused(changes, said):
    cells = {name: getattr(TRACK, name) for name in TRACKS_HEADER.split(",")}
    with pytest.raises(InvalidInputError, match=said):
        TrackRow(**(cells | changes))


# --- videos ----------------------------------------------------------------------------------


def frames_of(path: Path) -> list[np.ndarray]:
    video = cv2.VideoCapture(str(path))
    frames = []
    while (read := video.read())[0]:
        frames.append(read[1])
    return frames


@pytest.mark.parametrize("suffix", [".webm", ".mp4", ".mkv", ".avi", ".MP4"])
@pytest.mark.parametrize("size", [(64, 48), (63, 47)])
def test_a_video_holds_every_frame(tmp_path, suffix, size):
    path = tmp_path / f"o{suffix}"
    levels = [0, 80, 160, 240]
    with VideoWriter(path, fps=25) as video:
        for level in levels:
            video.write(np.full((size[1], size[0]), level, np.uint8))
        assert not path.exists()
    frames = frames_of(path)
    assert [frame.shape for frame in frames] == [(48, 64, 3)] * 4
    np.testing.assert_allclose([frame.mean() for frame in frames], levels, atol=4)
    assert list(tmp_path.iterdir()) == [path]


def test_colours_are_preserved(tmp_path):
    colour = (30, 120, 220)
    with VideoWriter(tmp_path / "o.avi", fps=25) as video:
        video.write(np.full((48, 64, 3), colour, np.uint8))
    np.testing.assert_allclose(frames_of(tmp_path / "o.avi")[0].mean(axis=(0, 1)), colour, atol=4)


UNEVEN_S = [10.0, 10.04, 10.08, 10.2, 10.2, 13.0, 12.0, 14.5]


def times_of(path: Path) -> list[float]:
    video = cv2.VideoCapture(str(path))
    times = []
    while video.grab():
        times.append(video.get(cv2.CAP_PROP_POS_MSEC) / 1000)
    return times


def test_a_webm_keeps_every_time_to_the_millisecond(tmp_path):
    path = tmp_path / "o.webm"
    with VideoWriter(path, fps=None) as video:
        for time_s in UNEVEN_S:
            video.write(np.full((48, 64), 90, np.uint8), time_s)
    # A time that does not increase becomes one millisecond after the last.
    wanted = [0.0, 0.04, 0.08, 0.2, 0.201, 3.0, 3.001, 4.5]
    np.testing.assert_allclose(times_of(path), wanted, atol=1e-6)
    data = path.read_bytes()
    duration = data[data.index(b"\x44\x89\x01") + 10 :][:8]
    assert struct.unpack(">d", duration) == (4500 + 1499,)
    assert (
        int.from_bytes(data[data.index(b"\x18\x53\x80\x67") + 5 :][:7], "big")
        == len(data) - data.index(b"\x18\x53\x80\x67") - 12
    )


def test_a_webm_that_was_cut_plays_up_to_the_cut(tmp_path):
    path = tmp_path / "o.webm"
    rng = np.random.default_rng(0)
    with VideoWriter(path, fps=None) as video:
        for k in range(20):
            video.write(rng.integers(0, 256, (48, 64), dtype=np.uint8), k / 10)
    data = path.read_bytes()
    clusters = [found.start() for found in re.finditer(b"\x1f\x43\xb6\x75", data)]
    assert len(clusters) == 20
    (tmp_path / "cut.webm").write_bytes(data[: clusters[12] + 30])
    assert times_of(tmp_path / "cut.webm")[:12] == pytest.approx([k / 10 for k in range(12)])


@pytest.mark.parametrize("suffix", [".mp4", ".mkv", ".avi"])
def test_videos_of_a_fixed_rate_repeat_frames_to_keep_the_times(tmp_path, suffix):
    path = tmp_path / f"o{suffix}"
    levels = {0.0: 0, 0.1: 120, 0.5: 240}  # the first two set the rate: 10 frames/s
    with VideoWriter(path, fps=None) as video:
        for time_s, level in levels.items():
            video.write(np.full((48, 64), level, np.uint8), time_s)
    shown = [int(frame.mean()) for frame in frames_of(path)]
    assert shown == pytest.approx([0, 120, 120, 120, 120, 240], abs=12)


def test_a_slow_encoder_drops_only_the_frames_of_live_sources(tmp_path, monkeypatch):
    may_go, is_held = threading.Event(), threading.Event()
    frame = webm._key_frame(np.zeros((48, 64, 3), np.uint8))

    def held(_image):
        is_held.set()
        assert may_go.wait(PATIENCE_S)
        return frame

    monkeypatch.setattr(webm, "_key_frame", held)
    with VideoWriter(tmp_path / "o.webm", fps=None, drops=True) as video:
        video.write(np.zeros((48, 64), np.uint8), 0.0)
        assert is_held.wait(PATIENCE_S)
        video.write(np.zeros((48, 64), np.uint8), 0.1)
        may_go.set()
        video._film._settle()
        video.write(np.zeros((48, 64), np.uint8), 0.2)
    assert times_of(tmp_path / "o.webm") == pytest.approx([0.0, 0.2])


def test_an_interrupted_run_leaves_a_whole_video(tmp_path):
    def interrupted() -> None:
        with VideoWriter(tmp_path / "o.mp4", fps=25) as video:
            for _ in range(5):
                video.write(np.zeros((48, 64), np.uint8))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert len(frames_of(tmp_path / "o.mp4")) == 5


def test_a_killed_run_leaves_the_older_video_and_a_partial_one(tmp_path):
    for name in ("o.avi", "o.mp4"):
        with VideoWriter(tmp_path / name, fps=25) as video:
            video.write(np.zeros((48, 64), np.uint8))
    program = """
import os, signal, sys
import numpy as np
from fingerpost.recording import VideoWriter
rng = np.random.default_rng(0)
for path in sys.argv[1:]:
    video = VideoWriter(path, fps=25)
    for _ in range(100):
        video.write(rng.integers(0, 256, (240, 320), dtype=np.uint8))
os.kill(os.getpid(), signal.SIGKILL)
"""
    paths = [str(tmp_path / "o.avi"), str(tmp_path / "o.mp4")]
    done = subprocess.run([sys.executable, "-c", program, *paths], check=False)
    assert done.returncode == -signal.SIGKILL
    assert [len(frames_of(Path(path))) for path in paths] == [1, 1]
    assert len(frames_of(tmp_path / "o.part.avi")) > 80


def test_a_disk_that_is_full_is_an_error_and_no_video(tmp_path):
    program = """
import resource, sys
import numpy as np
from fingerpost.errors import FingerpostError
from fingerpost.recording import VideoWriter
resource.setrlimit(resource.RLIMIT_FSIZE, (400_000, 400_000))
rng = np.random.default_rng(0)
for path in sys.argv[1:]:
    try:
        with VideoWriter(path, fps=25) as video:
            for _ in range(30):
                video.write(rng.integers(0, 256, (240, 320), dtype=np.uint8))
    except FingerpostError as error:
        print(error)
"""
    paths = [str(tmp_path / f"o{suffix}") for suffix in (".webm", ".mp4", ".mkv", ".avi")]
    done = subprocess.run(
        [sys.executable, "-c", program, *paths], check=True, capture_output=True, text=True
    )
    assert "o.part.webm: cannot be written any more: File too large; it plays up to" in done.stdout
    assert len(frames_of(tmp_path / "o.part.webm")) > 1
    assert done.stdout.count("not all of 30 frames could be written; is the disk full?") == 3
    assert not any(map(os.path.exists, paths))


def test_a_video_that_fills_the_disk_keeps_the_name_of_a_part(tmp_path, monkeypatch):
    path = tmp_path / "o.mp4"
    path.write_bytes(b"of the last run")
    full = SimpleNamespace(free=0)
    monkeypatch.setattr(shutil, "disk_usage", lambda _folder: full)
    with (
        pytest.raises(RecordingError, match=r"o\.part\.mp4: .* the disk is full"),
        VideoWriter(path, fps=25) as video,
    ):
        video.write(np.zeros((48, 64), np.uint8))
    assert path.read_bytes() == b"of the last run"
    assert len(frames_of(tmp_path / "o.part.mp4")) == 1


def test_ctrl_c_while_a_frame_is_written_leaves_a_whole_video(tmp_path, monkeypatch):
    class Interrupted:
        def __init__(self, writer):
            self.writer, self.release = writer, writer.release

        def write(self, image):
            self.writer.write(image)
            signal.raise_signal(signal.SIGINT)

    def write():
        image = np.zeros((48, 64), np.uint8)
        with VideoWriter(tmp_path / "o.mp4", fps=25) as video:
            video.write(image)
            monkeypatch.setattr(video, "_writer", Interrupted(video._writer))
            video.write(image)

    with pytest.raises(KeyboardInterrupt):
        write()
    assert len(frames_of(tmp_path / "o.mp4")) == 2


def test_an_invalid_video_is_refused_at_once(tmp_path):
    for name, said in [
        ("none/o.mp4", "the folder .*none does not exist"),
        ("o.gif", r"a name ending in \.webm, \.mp4, \.mkv, \.avi is needed"),
    ]:
        with pytest.raises(InvalidInputError, match=said):
            VideoWriter(tmp_path / name, fps=25)
    (tmp_path / "o.mp4").mkdir()
    with pytest.raises(InvalidInputError, match="is a folder"):
        VideoWriter(tmp_path / "o.mp4", fps=25)
    for fps in (0, -1, math.nan, math.inf):
        with pytest.raises(InvalidInputError, match="must be a finite number above 0"):
            VideoWriter(tmp_path / "p.mp4", fps=fps)


def test_an_image_of_another_size_or_type_is_refused(tmp_path):
    with VideoWriter(tmp_path / "o.mp4", fps=25) as video:
        video.write(np.zeros((48, 64), np.uint8))
        with pytest.raises(InvalidInputError, match="64 x 50 pixels: the video's first one has 64"):
            video.write(np.zeros((50, 64), np.uint8))
        for image in (np.zeros((48, 64)), np.zeros((48, 64, 4), np.uint8), np.zeros(4, np.uint8)):
            with pytest.raises(InvalidInputError, match="of uint8 is needed"):
                video.write(image)
    assert len(frames_of(tmp_path / "o.mp4")) == 1


def test_a_size_that_the_encoder_refuses_is_named(tmp_path):
    with (
        VideoWriter(tmp_path / "o.mp4", fps=25) as video,
        pytest.raises(FingerpostError, match="mp4v does not open for 20000 x 20 pixels"),
    ):
        video.write(np.zeros((20, 20000), np.uint8))
    assert not (tmp_path / "o.mp4").exists()


def test_an_existing_partial_video_is_not_touched(tmp_path):
    for name in ("o.part.mp4", "o.part2.mp4"):
        (tmp_path / name).write_text("mine")
    (tmp_path / "o.part3.mp4").symlink_to(tmp_path / "nowhere")
    with VideoWriter(tmp_path / "o.mp4", fps=25) as video:
        assert video.part == tmp_path / "o.part4.mp4"
        video.write(np.zeros((48, 64), np.uint8))
    assert (tmp_path / "o.part.mp4").read_text() == (tmp_path / "o.part2.mp4").read_text() == "mine"
    assert not (tmp_path / "nowhere").exists()
    assert not video.part.exists()
    assert len(frames_of(tmp_path / "o.mp4")) == 1


def test_two_videos_of_one_name_have_separate_partial_files(tmp_path):
    path = tmp_path / "o.mp4"
    with VideoWriter(path, fps=25) as one, VideoWriter(path, fps=25) as other:
        for level in (0, 200):
            one.write(np.full((48, 64), level, np.uint8))
        other.write(np.zeros((48, 64), np.uint8))
    assert len(frames_of(path)) == 2  # the one that was completed last
    assert list(tmp_path.iterdir()) == [path]


# OpenCV aborts the process if a name is not UTF-8, so each test runs in a process of its own.
_NAMED = """
import os, sys
import numpy as np
from pathlib import Path
from fingerpost.errors import InvalidInputError
from fingerpost.recording import VideoWriter, check_picture
from fingerpost.simulate import DevicePose, SimulatedRig, Trajectory, write_recording
folder, kind, name = Path(sys.argv[1]), sys.argv[2], os.fsdecode(bytes.fromhex(sys.argv[3]))
try:
    if kind == "video":
        with VideoWriter(folder / f"{name}.mp4", fps=25) as video:
            video.write(np.zeros((48, 64), np.uint8))
    elif kind == "picture":
        check_picture(folder / f"x.{name}")
    else:
        pose = DevicePose.pointing_at((200.0, 200.0), azimuth_deg=20.0, slant_deg=50.0,
                                      hover_mm=120.0)
        motion = Trajectory.hold(pose, 1.0)
        write_recording(folder / name, SimulatedRig(), motion, frames=1, picture_format="mp4")
except InvalidInputError as error:
    print(ascii(str(error)))
"""


def named(folder: Path, kind: str, name: bytes, **environment: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", _NAMED, str(folder), kind, name.hex()],
        env=os.environ | environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


_IN_ASCII = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}


@pytest.mark.skipif(sys.platform != "linux", reason="file names are bytes")
@pytest.mark.parametrize("kind", ["video", "picture", "recording"])
@pytest.mark.parametrize("environment", [{}, _IN_ASCII])
def test_a_name_that_is_not_utf8_is_refused(tmp_path, kind, environment):
    assert "is not UTF-8" in named(tmp_path, kind, b"a\xffb", **environment)
    assert not [path for path in tmp_path.rglob("*") if path.suffix == ".mp4"]


@pytest.mark.skipif(sys.platform != "linux", reason="locales of POSIX")
def test_a_video_has_the_name_it_was_given_in_any_locale(tmp_path):
    assert named(tmp_path, "video", "ö".encode(), **_IN_ASCII) == ""
    assert [os.fsencode(path.name) for path in tmp_path.iterdir()] == ["ö.mp4".encode()]


def test_a_video_without_frames_creates_no_file(tmp_path):
    with VideoWriter(tmp_path / "o.mp4", fps=25):
        pass
    assert list(tmp_path.iterdir()) == []
