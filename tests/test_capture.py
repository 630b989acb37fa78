"""Sources: every frame once and in order, the newest frame of live ones, and reported faults.

The number of each frame is painted into it as bars, so a frame can be identified by its pixels.
"""

import errno
import http.server
import logging
import os
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from patience import PATIENCE_S, wait_until

from fingerpost.capture import Frame, Loss, SourceKind, open_source, opening, read_views
from fingerpost.capture.as_sent import picture_of
from fingerpost.capture.live import FRESH_S, LiveSource
from fingerpost.capture.opening import STILL_FRAMES, refuse_repeated
from fingerpost.capture.video import FrameTimes
from fingerpost.errors import CaptureError, InvalidInputError, SourceError

WIDTH, HEIGHT, BARS = 160, 120, 8


def painted(number: int) -> np.ndarray:
    """An image whose eight bars encode `number` in binary, black for 0 and white for 1."""
    bits = [number >> bar & 1 for bar in range(BARS)]
    row = np.repeat(np.array(bits, np.uint8) * 255, WIDTH // BARS)
    return np.ascontiguousarray(np.broadcast_to(row[None, :, None], (HEIGHT, WIDTH, 3)))


def number_in(image: np.ndarray) -> int:
    width = image.shape[1] // BARS
    centres = image.reshape(*image.shape[:2], -1)[HEIGHT // 2, width // 2 :: width, 0]
    return sum(int(grey > 127) << bar for bar, grey in enumerate(centres))


def write_video(path: Path, count: int, *, fourcc: str = "mp4v", fps: float = 25) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*fourcc), fps, (WIDTH, HEIGHT))
    assert writer.isOpened()
    for number in range(count):
        writer.write(painted(number))
    writer.release()
    return path


def write_images(folder: Path, names: list[str]) -> None:
    for number, name in enumerate(names):
        assert cv2.imwrite(str(folder / name), painted(number))


def test_an_image_is_in_colour_if_its_channels_differ_anywhere():
    rng = np.random.default_rng(0)
    levels = rng.integers(0, 256, (HEIGHT, WIDTH), dtype=np.uint8)
    grey = np.repeat(levels[..., None], 3, axis=2)
    assert Frame(0, 0.0, levels).colour() is None
    assert Frame(0, 0.0, grey).colour() is None
    np.testing.assert_array_equal(Frame(0, 0.0, grey).grey(), levels)
    for place, channel in (((0, 0), 2), ((17, 30), 0), ((HEIGHT - 1, WIDTH - 1), 1)):
        coloured = grey.copy()
        coloured[(*place, channel)] ^= 4
        assert Frame(0, 0.0, coloured).colour() is coloured


@pytest.mark.parametrize("name", ["%02d.jpg", "%02d.png", "film.mp4", "film.avi"])
def test_a_monochrome_film_in_three_channels_is_grey(tmp_path: Path, name: str):
    if "%" in name:
        for number in range(3):
            assert cv2.imwrite(str(tmp_path / (name % number)), painted(number))
        path = tmp_path / f"*{Path(name).suffix}"
    else:
        fourcc = {"film.mp4": "mp4v", "film.avi": "MJPG"}[name]
        path = write_video(tmp_path / name, 3, fourcc=fourcc)
    with open_source(str(path)) as source:
        frames = list(source)
    assert len(frames) == 3
    assert all(frame.colour() is None for frame in frames)


def numbers(source: str | Path, **options: float) -> list[int]:
    with open_source(str(source), **options) as frames:
        return [number_in(frame.image) for frame in frames]


# --- video files -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "fourcc"), [("a.mp4", "mp4v"), ("a.avi", "MJPG"), ("a.mkv", "mp4v")]
)
def test_a_video_gives_every_frame_once_with_its_time(tmp_path, caplog, name, fourcc):
    path = write_video(tmp_path / name, 40, fourcc=fourcc, fps=20)
    with open_source(str(path)) as source:
        assert source.kind is SourceKind.RECORDED
        assert source.frame_count == 40
        frames = list(source)
        assert list(source) == []
    assert [number_in(frame.image) for frame in frames] == list(range(40))
    assert [frame.index for frame in frames] == list(range(40))
    np.testing.assert_allclose([frame.time_s for frame in frames], np.arange(40) / 20, atol=1e-3)
    assert {(frame.image.shape, frame.image.dtype.name) for frame in frames} == {
        ((HEIGHT, WIDTH, 3), "uint8")
    }
    assert caplog.records == []


def boxes(data: bytes, start: int, end: int) -> Iterator[tuple[bytes, int, int]]:
    """Kind, start and end of each MP4 box between two positions."""
    while start < end:
        size, kind = struct.unpack_from(">I4s", data, start)
        yield kind, start, start + size
        start += size


def replace_box(data: bytes, path: list[bytes], change) -> bytes:
    """Replace the content of one box, found by its path, in all enclosing sizes."""

    def inside(start: int, end: int, path: list[bytes]) -> bytes:
        out = b""
        for kind, first, last in boxes(data, start, end):
            content = data[first + 8 : last]
            if kind == path[0]:
                content = inside(first + 8, last, path[1:]) if path[1:] else change(content)
            out += struct.pack(">I4s", len(content) + 8, kind) + content
        return out

    return inside(0, len(data), path)


def test_a_video_of_variable_rate_keeps_the_times_of_its_file(tmp_path, caplog):
    path = write_video(tmp_path / "a.mp4", 6, fps=25)
    steps = [300, 700, 256, 600, 400, 512]  # in the writer's time base of 1/12800 s
    table = struct.pack(">II", 0, len(steps)) + b"".join(
        struct.pack(">II", 1, step) for step in steps
    )
    media = [b"moov", b"trak", b"mdia", b"minf", b"stbl", b"stts"]
    path.write_bytes(replace_box(path.read_bytes(), media, lambda _: table))
    with open_source(str(path)) as source:
        frames = list(source)
    expected = np.cumsum([0, *steps[:-1]]) / 12800
    np.testing.assert_allclose([frame.time_s for frame in frames], expected, atol=1e-6)
    assert [frame.index for frame in frames] == list(range(6))
    assert caplog.records == []


def test_a_video_stored_rotated_is_read_upright(tmp_path):
    path = write_video(tmp_path / "a.mp4", 2)
    quarter_turn = struct.pack(">9i", 0, 1 << 16, 0, -(1 << 16), 0, 0, 0, 0, 1 << 30)
    turned = replace_box(
        path.read_bytes(),
        [b"moov", b"trak", b"tkhd"],
        lambda content: content[:40] + quarter_turn + content[76:],
    )
    path.write_bytes(turned)
    with open_source(str(path)) as source:
        assert next(source).image.shape == (WIDTH, HEIGHT, 3)


@pytest.mark.parametrize(("name", "resumed"), [("a.mp4", 64), ("a.mkv", 64)])
def test_a_damaged_middle_is_skipped_and_reported(tmp_path, caplog, name, resumed):
    path = write_video(tmp_path / name, 90)
    data = bytearray(path.read_bytes())
    damage = slice(int(len(data) * 0.4), int(len(data) * 0.6))
    rng = np.random.default_rng(0)
    data[damage] = rng.integers(0, 256, damage.stop - damage.start, dtype=np.uint8).tobytes()
    path.write_bytes(data)

    with open_source(str(path)) as source:
        seen = list(source)
        assert "pictures are damaged" in source.damage
    frames = [entry for entry in seen if isinstance(entry, Frame)]
    indices = [frame.index for frame in frames]
    assert indices[:20] == list(range(20))
    assert indices[indices.index(resumed) :] == list(range(resumed, 90))
    assert len(seen) < 90
    # After the gap the decoder conceals errors until a key frame: those pictures are lost, too.
    assert any(isinstance(entry, Loss) for entry in seen)
    assert [number_in(frame.image) for frame in frames] == indices
    assert all(entry.time_s == pytest.approx(entry.index / 25) for entry in seen)
    assert f"{path}: " in caplog.text
    assert "damaged or missing frames between" in caplog.text


def test_a_truncated_video_gives_its_frames_and_reports_the_cut(tmp_path, caplog):
    path = write_video(tmp_path / "a.avi", 60, fourcc="MJPG")
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with open_source(str(path)) as source:
        found = list(source)
    whole = [entry for entry in found if isinstance(entry, Frame)]
    assert [number_in(frame.image) for frame in whole] == list(range(len(whole)))
    assert len(whole) >= len(found) - 1  # the last may be cut in two
    assert 20 < len(found) < 50
    assert (
        f"{path}: ends at {len(found) / 25:.3f} s although its header says 2.400 s" in caplog.text
    )


@pytest.mark.parametrize("stretch", [slice(0.4, 0.6), slice(0.495, 0.505)])
def test_frames_of_an_avi_hidden_by_damage_are_counted_and_reported(tmp_path, caplog, stretch):
    path = write_video(tmp_path / "a.avi", 60, fourcc="MJPG")
    data = bytearray(path.read_bytes())
    damage = slice(int(stretch.start * len(data)), int(stretch.stop * len(data)))
    data[damage] = bytes(damage.stop - damage.start)
    path.write_bytes(data)
    with open_source(str(path)) as source:
        frames = list(source)
    # Frames after the gap move up in the count, and AVI has no other times.
    hidden = 59 - frames[-1].index
    assert 0 < hidden < 60 - len(frames[:20])
    assert number_in(frames[-1].image) == 59
    (said,) = [record.getMessage() for record in caplog.records if "ends at" in record.getMessage()]
    assert said == (
        f"{path}: ends at {2.4 - hidden / 25:.3f} s although its header says 2.400 s: cut off or "
        "damaged; as AVI stores no times, frames behind damage are dated up to "
        f"{hidden / 25:.3f} s early"
    )


def test_frame_times_always_increase(caplog):
    times = FrameTimes(0.1, "a.avi")
    placed = [times.place(time_s, 0) for time_s in (0.0, 0.0, 0.0, float("nan"), 0.4, 0.55)]
    assert [index for index, _ in placed] == list(range(6))
    np.testing.assert_allclose([s for _, s in placed], [0, 0.1, 0.2, 0.3, 0.4, 0.55])
    assert caplog.text.count("a.avi: frame 1 has no time after its predecessor's") == 1


def test_a_gap_counts_missing_frames_only_at_a_constant_rate():
    constant = FrameTimes(0.1, "a.avi")
    assert [constant.place(s, 0)[0] for s in (0.0, 0.1, 0.2, 0.6, 0.7)] == [0, 1, 2, 6, 7]
    variable = FrameTimes(0.1, "a.avi")
    assert [variable.place(s, 0)[0] for s in (0.0, 0.13, 0.2, 0.6, 0.7)] == [0, 1, 2, 3, 4]
    assert variable.place(1.0, 2)[0] == 7


# --- still images ----------------------------------------------------------------------------


def test_images_come_in_natural_order_at_the_given_rate(tmp_path):
    names = ["img1.png", "img2.png", "img9.png", "img10.png", "img100.png"]
    write_images(tmp_path, names)
    (tmp_path / "img5.png").mkdir()
    with open_source(str(tmp_path / "img*.png"), fps=10) as source:
        assert source.frame_count == 5
        frames = list(source)
    assert [number_in(frame.image) for frame in frames] == [0, 1, 2, 3, 4]
    assert [(frame.index, frame.time_s) for frame in frames] == [
        (0, 0.0),
        (1, 0.1),
        (2, 0.2),
        (3, 0.3),
        (4, 0.4),
    ]
    assert numbers(tmp_path / "**" / "img9.png") == [2]


def test_one_still_image_is_repeated(tmp_path):
    write_images(tmp_path, ["a [1].png"])
    assert numbers(tmp_path / "a [1].png") == [0] * STILL_FRAMES


def test_a_glob_of_one_image_is_one_frame(tmp_path):
    write_images(tmp_path, ["a1.png"])
    assert numbers(tmp_path / "a*.png") == [0]


def test_pixel_formats_are_converted_to_eight_bits(tmp_path):
    def read(name: str, stored: np.ndarray) -> np.ndarray:
        assert cv2.imwrite(str(tmp_path / name), stored)
        with open_source(str(tmp_path / name)) as source:
            return next(source).image

    rng = np.random.default_rng(1)
    grey = rng.integers(0, 256, (6, 5), dtype=np.uint8)
    deep = rng.integers(0, 65536, (6, 5, 3), dtype=np.uint16)
    clear = rng.integers(0, 256, (6, 5, 4), dtype=np.uint8)
    np.testing.assert_array_equal(read("grey.png", grey), grey)
    np.testing.assert_array_equal(read("deep.png", deep), np.rint(deep * (255 / 65535)))
    np.testing.assert_array_equal(read("deep_grey.png", deep[..., 0]), np.rint(deep[..., 0] / 257))
    np.testing.assert_array_equal(read("clear.png", clear), clear[..., :3])
    with pytest.raises(CaptureError, match=r"float\.tiff: pixels are stored as float32; 8 or 16"):
        read("float.tiff", grey.astype(np.float32))


def test_grey_is_the_luma_of_a_colour_image_or_the_grey_image_itself(tmp_path):
    cv2.imwrite(str(tmp_path / "colour.png"), np.full((4, 4, 3), (10, 100, 200), np.uint8))
    cv2.imwrite(str(tmp_path / "grey.png"), np.full((4, 4), 77, np.uint8))
    with open_source(str(tmp_path / "colour.png")) as source:
        luma = 0.114 * 10 + 0.587 * 100 + 0.299 * 200
        assert np.abs(next(source).grey() - luma).max() <= 0.51
    with open_source(str(tmp_path / "grey.png")) as source:
        frame = next(source)
        assert frame.grey() is frame.image


def test_a_photo_stored_rotated_is_read_upright(tmp_path):
    ok, jpeg = cv2.imencode(".jpg", painted(0))
    assert ok
    # EXIF with one entry: orientation (0x112), type short, one value, 6 = turn right.
    exif = b"Exif\0\0II*\0" + struct.pack("<IHHHIII", 8, 1, 0x112, 3, 1, 6, 0)
    segment = b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif
    data = jpeg.tobytes()
    (tmp_path / "a.jpg").write_bytes(data[:2] + segment + data[2:])
    with open_source(str(tmp_path / "a.jpg")) as source:
        assert next(source).image.shape == (WIDTH, HEIGHT, 3)


@pytest.mark.parametrize("suffix", ["png", "jpg", "bmp"])
@pytest.mark.parametrize("kept", [0.9, 0.5, 0.1])
def test_a_truncated_image_is_a_loss_and_named_in_the_damage(tmp_path, suffix, kept):
    write_images(tmp_path, [f"{number}.{suffix}" for number in range(3)])
    broken = tmp_path / f"1.{suffix}"
    broken.write_bytes(broken.read_bytes()[: int(broken.stat().st_size * kept)])
    with open_source(str(tmp_path / f"*.{suffix}")) as source:
        first, lost, last = source
        assert (number_in(first.image), number_in(last.image)) == (0, 2)
        assert lost == Loss(1, 1 / 25, "its picture cannot be decoded")
        assert source.damage.startswith(f"1 of 3 pictures are damaged ({broken}: cannot be decoded")


def test_truncation_of_a_jpeg_is_detected_behind_its_thumbnail(tmp_path):
    ok, jpeg = cv2.imencode(".jpg", painted(5))
    assert ok
    data = jpeg.tobytes()
    thumbnail = b"\xff\xe1" + struct.pack(">H", len(data) + 2) + data
    whole = data[:2] + thumbnail + data[2:]
    (tmp_path / "whole.jpg").write_bytes(whole)
    assert set(numbers(tmp_path / "whole.jpg")) == {5}
    (tmp_path / "cut.jpg").write_bytes(whole[: int(len(whole) * 0.9)])
    with pytest.raises(CaptureError, match=r"cut\.jpg: cannot be decoded"):
        numbers(tmp_path / "cut.jpg")


def test_images_of_another_size_or_kind_are_named(tmp_path):
    write_images(tmp_path, ["1.png", "2.png", "3.png"])
    cv2.imwrite(str(tmp_path / "2.png"), np.zeros((10, 20), np.uint8))
    with pytest.raises(CaptureError, match=r"2\.png: 20 x 10 pixels.*160 x 120"):
        numbers(tmp_path / "*.png")
    (tmp_path / "2.png").write_text("hello")
    assert lost_of_three(
        tmp_path
    ) == f"{tmp_path}/2.png: cannot be decoded: damaged, cut off, or " + (
        "not an image that OpenCV reads"
    )
    (tmp_path / "2.png").write_bytes(b"")
    assert lost_of_three(tmp_path) == f"{tmp_path}/2.png: the file is empty; an image is needed"


def lost_of_three(folder: Path) -> str:
    """Read three images of which the second is lost; return the reported reason."""
    with open_source(str(folder / "*.png")) as source:
        assert [type(entry) for entry in source] == [Frame, Loss, Frame]
        return source.damage.removeprefix("1 of 3 pictures are damaged (").removesuffix(")")


def test_images_of_which_none_can_be_decoded_are_an_error(tmp_path):
    for name in ("1.png", "2.png"):
        (tmp_path / name).write_text("hello")
    with pytest.raises(CaptureError, match=r"no picture is sound: 2 of 2 .*1\.png: cannot be"):
        list(open_source(str(tmp_path / "*.png")))


# --- sources that cannot be opened -----------------------------------------------------------


def test_a_source_that_cannot_be_opened_is_named_with_a_remedy(tmp_path):
    (tmp_path / "empty.mp4").touch()
    (tmp_path / "text.mp4").write_text("no video " * 1000)
    header_only = write_video(tmp_path / "none.avi", 0, fourcc="MJPG")
    for source, said in [
        (tmp_path / "none.mp4", "no such file"),
        (tmp_path / "*.png", "no file matches"),
        (tmp_path, r"is a folder; name the images in it, as in .*\*\.png"),
        (tmp_path / "empty.mp4", "the file is empty; a video or an image is needed"),
        (tmp_path / "text.mp4", "no frame can be read"),
        (header_only, "no frame can be read|the file is empty"),
        ("a" * 5000, "File name too long"),
        ("[a]" * 2000, "File name too long"),
        ("7", "no such file; a camera's number goes without quotes"),
    ]:
        with pytest.raises(CaptureError, match=said) as raised:
            open_source(str(source))
        assert str(raised.value).startswith(f"{source}: ")
        assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("source", "options", "said"),
    [
        (-1, {}, "cameras are numbered 0, 1"),
        (True, {}, "cameras are numbered 0, 1"),
        ("", {}, "must name a file"),
        ("a\0b", {}, "must name a file"),
        ("file:///a.mp4", {}, "give the file's path instead"),
        ("a.mp4", {"fps": 0.0}, "fps = 0.0"),
        ("a.mp4", {"fps": float("nan")}, "fps = nan"),
        ("a.mp4", {"timeout_s": -1.0}, "timeout_s = -1.0"),
    ],
)
def test_invalid_sources_and_options_are_refused(source, options, said):
    with pytest.raises(InvalidInputError, match=said):
        open_source(source, **options)


def in_another_process(program: str, *arguments: str | bytes, **environment: str) -> str:
    """Return the output of a program that opens sources; OpenCV could crash this process."""
    done = subprocess.run(
        [
            sys.executable,
            "-c",
            f"from fingerpost.capture import open_source\n{program}",
            *arguments,
        ],
        capture_output=True,
        check=False,
        text=True,
        env={**os.environ, **environment},
    )
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout


COUNT = """
import sys
with open_source(sys.argv[1]) as source:
    print(len(list(source)))
"""

REFUSED = """
import sys
from fingerpost.errors import InvalidInputError
try:
    open_source({source})
except InvalidInputError as error:
    print(ascii(str(error)))
"""

needs_bytes_for_names = pytest.mark.skipif(
    sys.platform in ("win32", "darwin"), reason="file names are no bytes here"
)


@needs_bytes_for_names
@pytest.mark.parametrize("suffix", ["avi", "png"])
def test_a_name_that_is_not_utf8_is_refused_in_one_line(tmp_path, suffix):
    named = os.fsencode(tmp_path) + b"/hand\xff." + suffix.encode()
    write_video(tmp_path / "a.avi", 3, fourcc="MJPG").rename(os.fsdecode(named))
    said = in_another_process(REFUSED.format(source="sys.argv[1]"), named)
    assert "source: the path" in said
    assert f"hand\\\\udcff.{suffix} is not UTF-8, as OpenCV needs it; rename the file" in said


@needs_bytes_for_names
def test_images_of_a_glob_may_have_names_that_are_not_utf8(tmp_path):
    write_images(tmp_path, ["1.png"])
    (tmp_path / "1.png").rename(os.fsdecode(os.fsencode(tmp_path) + b"/\xff.png"))
    assert numbers(tmp_path / "*.png") == [0]


@needs_bytes_for_names
def test_a_name_in_utf8_is_opened_under_any_locale(tmp_path):
    path = write_video(tmp_path / "a.avi", 3, fourcc="MJPG").rename(tmp_path / "né.avi")
    ascii_alone = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    assert in_another_process(COUNT, str(path).encode(), **ascii_alone) == "3\n"
    # As given in a rig file, which is UTF-8 under every locale.
    said = in_another_process(REFUSED.format(source="'n\\xe9.avi'"), **ascii_alone)
    assert "file names are written in ascii here; a UTF-8 locale is right" in said


def test_views_that_read_one_source_are_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_images(tmp_path, ["1.png", "2.png", "left.png"])
    (tmp_path / "link.png").symlink_to("left.png")
    url = "http://name:secret@127.0.0.1/stream.mjpg"
    for left, right, named in [
        ("left.png", "left.png", "left.png"),
        ("left.png", "./left.png", "left.png"),
        (str(tmp_path / "left.png"), "link.png", "left.png"),
        ("?.png", "[2-9].png", "2.png"),
        (0, 0, "camera 0"),
        (url, url, "http://***@127.0.0.1/stream.mjpg"),
    ]:
        with pytest.raises(InvalidInputError) as raised:
            refuse_repeated({"left": left, "middle": "other.mp4", "right": right})
        read = tmp_path / named if named.endswith("png") else named
        assert str(raised.value) == (
            f'views "left" and "right" both read {read}; each needs a source of its own'
        )
    refuse_repeated({"left": "1.png", "right": "2.png", "above": 0, "below": 1})
    # Equal names of sources that cannot be opened are allowed.
    refuse_repeated({"left": "none.mp4", "right": "none.mp4", "above": "a\0b", "below": "a\0b"})


def test_a_camera_is_identified_by_its_number_and_by_its_file(tmp_path, monkeypatch):
    monkeypatch.setattr(opening, "_CAMERA_FILE", str(tmp_path / "video{}"))
    for number in (0, 2):
        (tmp_path / f"video{number}").touch()
    by_name = tmp_path / "webcam-on-the-left"
    by_name.symlink_to("video2")
    for file, number in ((tmp_path / "video0", 0), (by_name, 2)):
        with pytest.raises(InvalidInputError, match=f"both read {tmp_path}/video{number}; each"):
            refuse_repeated({"left": str(file), "right": number})
    refuse_repeated({"left": str(by_name), "right": 0, "above": 1})


def test_a_file_that_may_not_be_read_is_named(tmp_path, monkeypatch):
    path = write_video(tmp_path / "a.mp4", 1)

    def forbidden(*_, **__):  # file permissions would not stop the superuser
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(Path, "open", forbidden)
    with pytest.raises(CaptureError, match=r"a\.mp4: Permission denied"):
        open_source(str(path))


# --- live sources ----------------------------------------------------------------------------


class HandFedDevice:
    """A camera that gives the frames fed to it; without one, `grab` fails after 10 ms."""

    def __init__(self, *, opened: bool = True) -> None:
        self.opened = opened
        self.released = threading.Event()
        self.unplugged = False
        self._fed = threading.Condition()
        self._waiting = 0
        self._number = -1

    def feed(self, count: int) -> None:
        with self._fed:
            self._waiting += count
            self._fed.notify_all()

    def isOpened(self) -> bool:  # noqa: N802 - OpenCV's name
        return self.opened

    def grab(self) -> bool:
        with self._fed:
            self._fed.wait_for(lambda: self._waiting, timeout=0.01)
            if self.unplugged or not self._waiting:
                return False
            self._waiting -= 1
            self._number += 1
            return True

    def retrieve(self):
        return True, painted(self._number)

    def release(self) -> None:
        self.released.set()


def live(device, *, timeout_s: float = PATIENCE_S, clock=time.monotonic_ns) -> LiveSource:
    return LiveSource(0, timeout_s=timeout_s, clock=clock, connect=lambda *_: device)


def test_a_slow_consumer_gets_the_newest_frame_with_its_grab_time():
    device = HandFedDevice()
    device.feed(1)
    ticks = iter(range(10**9, 10**12, 10**9))
    with live(device, clock=lambda: next(ticks)) as source:
        assert source.kind is SourceKind.LIVE
        first = next(source)
        assert (first.index, number_in(first.image)) == (0, 0)
        for newest in (10, 20, 30):
            device.feed(10)
            wait_until(lambda newest=newest: source.frames_grabbed == newest + 1)
            frame = next(source)
            assert (frame.index, number_in(frame.image)) == (newest, newest)
            if newest == 10:
                start_s = frame.time_s
        assert frame.time_s >= start_s + 20
        assert frame.time_s % 1 == 0
    assert device.released.is_set()
    assert list(source) == []


def test_no_frame_is_given_twice():
    device = HandFedDevice()
    device.feed(1)
    with live(device) as source:
        next(source)
        late = threading.Timer(0.1, device.feed, [1])
        late.start()
        assert next(source).index == 1
        late.join()


def test_a_silent_camera_is_lost_until_it_sends_again(caplog, monkeypatch):
    monkeypatch.setattr("fingerpost.capture.live._FIRST_PAUSE_S", 0.01)
    device = HandFedDevice()
    device.feed(2)
    with live(device) as source:
        next(source)
        source._timeout_s = 0.05  # only now: a busy machine may open it late
        lost = next(entry for entry in source if isinstance(entry, Loss))
        assert lost.why == "no picture has come for 0.1 s"
        assert [record.getMessage() for record in caplog.records] == [
            "camera 0: no new frame within 0.05 s: lost until it sends again"
        ]
        wait_until(device.released.is_set)  # it is then reopened
        source._timeout_s = PATIENCE_S
        device.feed(1)
        wait_until(lambda: source.frames_grabbed == 3)
        assert number_in(next(source).image) == 2
        assert "camera 0: sends again" in caplog.text
        assert source.notes == (f"sent nothing for {PATIENCE_S:g} s and more, once",)


def test_a_camera_is_lost_while_its_pictures_have_another_size(caplog):
    device = HandFedDevice()
    rows = [120, 100, 100, 120]
    device.retrieve = lambda: (True, painted(device._number)[: rows[device._number]].copy())
    device.feed(1)
    with live(device) as source:
        seen = [next(source)]
        for _ in rows[1:]:
            device.feed(1)
            seen.append(next(source))
    why = "its pictures have another size than the first"
    assert [getattr(entry, "why", "") for entry in seen] == ["", why, why, ""]
    assert [record.getMessage() for record in caplog.records] == [
        "camera 0: 160 × 100 px, where the first picture has 160 × 120: "
        "lost until that size is back",
        "camera 0: its first size again",
    ]
    assert source.damage == ""


def test_a_camera_of_a_low_rate_is_not_overdue():
    device = HandFedDevice()
    device.feed(1)
    with live(device) as source:
        assert source.due_in_s <= 1.0  # while the rate is unknown, others do not wait longer
        source._periods_s.extend([200.0, 200.0, 0.01, 200.0])
        assert source.overdue() is None
        assert 300.0 < source.due_in_s <= 400.0


@pytest.mark.parametrize(("bridged_s", "taken"), [(1e6, 2), (0.0, 1)])
def test_an_old_frame_is_replaced_by_the_next_if_that_is_due_soon(monkeypatch, bridged_s, taken):
    monkeypatch.setattr("fingerpost.capture.live._OVERDUE_S", bridged_s)
    device = HandFedDevice()
    device.feed(1)
    with live(device) as source:
        steps = read_views([source])
        assert number_in(next(steps)[0].image) == 0
        source._periods_s.extend([1e3] * 9)
        device.feed(1)
        wait_until(lambda: source.silent_s > FRESH_S and source.frames_grabbed == 2)
        following = threading.Timer(0.05, device.feed, [1])
        following.start()
        assert number_in(next(steps)[0].image) == taken
        following.join()


def test_a_camera_that_does_not_open_or_send_is_an_error():
    with pytest.raises(CaptureError, match="camera 0: cannot be opened; is it plugged in"):
        live(HandFedDevice(opened=False))
    # A busy machine may not even open it in that time.
    with pytest.raises(CaptureError, match=r"camera 0: (no new frame|did not open) within 0\.1 s"):
        live(HandFedDevice(), timeout_s=0.1)


def test_an_exception_of_the_driver_reaches_the_caller():
    class Raising(HandFedDevice):
        def retrieve(self):
            raise cv2.error("the driver\nsays no")

    device = Raising()
    device.feed(1)
    with pytest.raises(CaptureError, match="camera 0: the driver says no"):
        live(device)
    assert device.released.is_set()


def test_a_blocked_device_is_abandoned(caplog, monkeypatch):
    monkeypatch.setattr("fingerpost.capture.live._JOIN_S", 0.05)
    unblock = threading.Event()

    def connect(source, limit):
        assert unblock.wait(PATIENCE_S)
        return HandFedDevice(opened=False)

    with pytest.raises(CaptureError, match=r"camera 0: did not open within 0\.05 s"):
        LiveSource(0, timeout_s=0.05, clock=time.monotonic_ns, connect=connect)
    assert "camera 0: the device does not answer" in caplog.text
    unblock.set()


def test_closing_wakes_a_waiting_consumer():
    device = HandFedDevice()
    device.feed(1)
    source = live(device)
    next(source)
    rest: list[object] = []
    consumer = threading.Thread(target=lambda: rest.extend(source))
    consumer.start()
    source.close()
    consumer.join(PATIENCE_S)
    assert not consumer.is_alive()
    assert rest == []


def test_there_is_no_camera_63():
    with pytest.raises(CaptureError, match="camera 63: cannot be opened"):
        open_source(63)


@pytest.mark.skipif(not Path("/dev/null").is_char_device(), reason="needs a device file")
def test_a_device_file_is_opened_as_a_camera():
    with pytest.raises(CaptureError, match="/dev/null: cannot be opened"):
        open_source("/dev/null")


class JpegServer(http.server.ThreadingHTTPServer):
    """Motion JPEG on a loopback port: sends the first `allowed` frames."""

    daemon_threads = True
    # Frames that the demuxer holds back until later ones begin.
    HELD_BACK = 2

    def __init__(self, allowed: int) -> None:
        super().__init__(("127.0.0.1", 0), JpegHandler)
        self.allowed = allowed
        self.closing = False
        self.url = f"http://name:secret@127.0.0.1:{self.server_port}/stream.mjpg"


class JpegHandler(http.server.BaseHTTPRequestHandler):
    server: JpegServer

    def do_GET(self) -> None:
        if "stream" not in self.path:
            self.send_error(404)
            return
        self.send_response(200)
        self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
        self.end_headers()
        number = 0
        while not self.server.closing:
            if number >= self.server.allowed:
                time.sleep(0.005)
                continue
            jpeg = cv2.imencode(".jpg", painted(number))[1].tobytes()
            head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
            try:
                self.wfile.write(head.encode() + jpeg + b"\r\n")
            except ConnectionError:  # the reader has closed it
                return
            number += 1

    def log_message(self, *args: object) -> None:
        pass


@pytest.fixture
def server():
    server = JpegServer(allowed=30)
    thread = threading.Thread(target=server.serve_forever, args=[0.02])
    thread.start()
    yield server
    server.closing = True
    server.shutdown()
    thread.join()
    server.server_close()


def test_a_stream_read_slowly_gives_its_newest_frame(server):
    with open_source(server.url, timeout_s=PATIENCE_S) as source:
        for sent in (30, 80, 130, 180):
            server.allowed = sent
            reached = sent - server.HELD_BACK
            wait_until(lambda reached=reached: source.frames_grabbed >= reached)
            assert number_in(next(source).image) >= reached - 1


def test_a_stream_of_jpegs_keeps_the_encoded_pictures(server):
    with open_source(server.url, timeout_s=PATIENCE_S) as source:
        frame = next(source)
    sent = cv2.imencode(".jpg", painted(number_in(frame.image)))[1]
    assert frame.encoded == sent.tobytes()
    assert (frame.image == cv2.imdecode(sent, cv2.IMREAD_ANYCOLOR)).all()


@pytest.mark.parametrize("sent", [b"\xff\xd8\xff", b"\xff\xd8\xff\xe0no jpeg\xff\xd9"])
def test_an_undecodable_jpeg_gives_no_picture(sent):
    picture, _ = picture_of(np.frombuffer(sent, np.uint8)[None])
    assert picture is None


def test_decoded_pictures_are_passed_through():
    flat = np.full((1, 30), 7, np.uint8)
    padded = np.frombuffer(cv2.imencode(".jpg", painted(3))[1].tobytes() + bytes(9), np.uint8)
    assert picture_of(flat)[0].tolist() == flat.tolist()
    picture, encoded = picture_of(padded[None])
    assert number_in(picture) == 3
    assert encoded == padded.tobytes()[:-9]


def test_a_stream_that_ends_is_lost_until_it_is_reopened(server, monkeypatch):
    monkeypatch.setattr("fingerpost.capture.live._FIRST_PAUSE_S", 0.01)
    with open_source(server.url, timeout_s=PATIENCE_S) as source:
        server.closing = True
        source._timeout_s = 0.2  # only now: a busy machine may open it late
        assert any(isinstance(entry, Loss) for entry in source)
        server.closing = False
        assert any(isinstance(entry, Frame) for entry in source)
    assert "secret" not in source.name


def test_urls_without_a_stream_are_errors(server):
    with pytest.raises(SourceError, match=r"nothing\.mjpg: the server answers 404") as raised:
        open_source(server.url.replace("stream", "nothing"), timeout_s=PATIENCE_S)
    assert "secret" not in str(raised.value)


def test_a_server_that_never_answers_times_out():
    with http.server.socketserver.socket.create_server(("127.0.0.1", 0)) as silent:
        url = f"http://127.0.0.1:{silent.getsockname()[1]}/stream.mjpg"
        with pytest.raises(CaptureError, match=r"did not answer within 0\.3 s"):
            open_source(url, timeout_s=0.3)


def test_opencv_is_loaded_only_where_pixels_are_needed():
    program = "import sys, fingerpost.config, fingerpost.recording; print('cv2' in sys.modules)"
    command = [sys.executable, "-c", program]
    assert subprocess.run(command, check=True, capture_output=True, text=True).stdout == "False\n"


# --- several views ---------------------------------------------------------------------------


def test_recorded_views_are_paired_by_their_times(tmp_path, caplog):
    write_video(tmp_path / "a.mp4", 12, fps=25)
    write_video(tmp_path / "b.avi", 9, fourcc="MJPG", fps=20)
    with open_source(str(tmp_path / "a.mp4")) as a, open_source(str(tmp_path / "b.avi")) as b:
        steps = list(read_views([a, b]))
    # Intervals of 0.04 and 0.05 s: a's fourth frame, at 0.12 s, is the nearest to none of b's.
    together = [[k, k] for k in range(3)] + [[3, None], [4, 3], [5, 4], [6, 5], [7, 6]]
    together += [[8, None], [9, 7], [10, 8]]
    assert [[frame and frame.index for frame in step] for step in steps] == together
    for step in steps:
        assert all(frame is None or number_in(frame.image) == frame.index for frame in step)
        assert all(
            frame is None or frame.time_s == pytest.approx(frame.index * step_s)
            for frame, step_s in zip(step, (1 / 25, 1 / 20), strict=True)
        )
    assert f"{tmp_path / 'b.avi'} ended before the other views" in caplog.text


def test_views_stay_paired_behind_a_damaged_stretch(tmp_path, caplog):
    caplog.set_level(logging.CRITICAL)
    whole = write_video(tmp_path / "whole.mp4", 60)
    data = bytearray(whole.read_bytes())
    damage = slice(int(len(data) * 0.4), int(len(data) * 0.6))
    data[damage] = bytes(damage.stop - damage.start)
    (tmp_path / "damaged.mp4").write_bytes(data)
    with (
        open_source(str(whole)) as a,
        open_source(str(tmp_path / "damaged.mp4")) as b,
    ):
        steps = list(read_views([a, b]))
    assert [step[0].index for step in steps] == list(range(60))
    both = [step for step in steps if step[1] is not None]
    assert 30 < len(both) < 60
    assert all(left.index == right.index for left, right in both)
    assert [number_in(step[1].image) for step in steps[48:]] == list(range(48, 60))


def test_live_views_give_a_new_frame_of_each(tmp_path):
    devices = [HandFedDevice(), HandFedDevice()]
    for device in devices:
        device.feed(1)
    with live(devices[0]) as a, live(devices[1]) as b:
        steps = read_views([a, b])
        assert [frame.index for frame in next(steps)] == [0, 0]
        devices[0].feed(5)
        wait_until(lambda: a.frames_grabbed == 6)
        devices[1].feed(1)
        assert [frame.index for frame in next(steps)] == [5, 1]
        a.close()
        devices[1].feed(1)
        assert list(steps) == []


def test_a_view_of_a_lower_rate_delays_no_other_and_is_named_once(caplog):
    devices = [HandFedDevice(), HandFedDevice()]
    for device in devices:
        device.feed(12)
    with live(devices[0]) as fast, live(devices[1]) as slow:
        wait_until(lambda: fast.frames_grabbed == slow.frames_grabbed == 12)
        fast._periods_s.extend([50.0] * 9)
        slow._periods_s.extend([200.0] * 9)
        steps = read_views([fast, slow])
        assert [frame.index for frame in next(steps)] == [11, 11]
        for index in (12, 13):
            devices[0].feed(1)
            wait_until(lambda index=index: fast.frames_grabbed == index + 1)
            frame, nothing = next(steps)
            assert (frame.index, nothing) == (index, None)
        for device in devices:
            device.feed(1)
        wait_until(lambda: (fast.frames_grabbed, slow.frames_grabbed) == (15, 13))
        assert [frame.index for frame in next(steps)] == [14, 12]
        (slowness,) = slow.notes
        assert slowness.startswith("sends 0.005 pictures a second; more than 10 are needed")
        assert caplog.text.count(f"camera 0: {slowness}") == 1


def test_no_views_or_views_of_different_kinds_are_refused(tmp_path):
    write_images(tmp_path, ["1.png"])
    device = HandFedDevice()
    device.feed(1)
    with (
        open_source(str(tmp_path / "1.png")) as recorded,
        live(device) as camera,
        pytest.raises(InvalidInputError, match=r"1\.png \(recorded\), camera 0 \(live\)"),
    ):
        read_views([recorded, camera])
    with pytest.raises(InvalidInputError, match="at least one view"):
        read_views([])


def test_times_of_one_view_increase(tmp_path):
    path = write_video(tmp_path / "a.mp4", 30, fps=29.97)
    with open_source(str(path)) as source:
        times = [frame.time_s for frame in source]
    assert all(later > earlier for earlier, later in pairwise(times))
