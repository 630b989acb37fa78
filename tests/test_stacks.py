"""Files of several pictures: all are read, at the animation's times and in 8 bits."""

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from films import textured, write_film

from fingerpost.capture import Frame, Loss, open_source
from fingerpost.capture.container import is_cut_off
from fingerpost.capture.opening import STILL_FRAMES
from fingerpost.errors import SourceError

DURATIONS_MS = [40] * 20 + [100] * 20 + [0]
# Mean error of a picture in few colours or with lossy compression.
LOSSY_LEVELS = 40


def read(path: Path) -> list[Frame | Loss]:
    with open_source(str(path)) as source:
        return list(source)


@pytest.mark.parametrize("suffix", ["gif", "png", "webp"])
def test_an_animation_gives_all_its_pictures_at_their_times(tmp_path, suffix):
    animation = cv2.Animation()
    animation.frames = textured(len(DURATIONS_MS))
    animation.durations = DURATIONS_MS
    path = tmp_path / f"a.{suffix}"
    assert cv2.imwriteanimation(str(path), animation)
    with open_source(str(path)) as source:
        assert source.frame_count == len(DURATIONS_MS)
        frames = list(source)
    shown_s = np.cumsum([0.0, *(d / 1000 for d in DURATIONS_MS[:-1])])
    np.testing.assert_allclose([frame.time_s for frame in frames], shown_s, atol=1e-9)
    for number, frame in enumerate(frames):
        off = [np.abs(frame.image.astype(int) - picture).mean() for picture in animation.frames]
        assert np.argmin(off) == number
        assert off[number] < LOSSY_LEVELS


def number_of(picture: np.ndarray) -> int:
    """First column of the bright square."""
    return int(np.argmax((picture[50, :, :3] > 190).all(axis=1)))


def test_a_tiff_gives_all_its_pages(tmp_path):
    pictures = textured(40)
    assert cv2.imwritemulti(str(tmp_path / "a.tiff"), pictures)
    frames = read(tmp_path / "a.tiff")
    assert [frame.time_s for frame in frames] == [k / 25 for k in range(40)]
    for frame, picture in zip(frames, pictures, strict=True):
        np.testing.assert_array_equal(frame.image, picture)


def test_a_damaged_animation_loses_pictures_or_is_refused_by_name(tmp_path):
    animation = cv2.Animation()
    animation.frames, animation.durations = textured(6), [40] * 6
    path = tmp_path / "a.gif"
    assert cv2.imwriteanimation(str(path), animation)
    data = path.read_bytes()
    middle = len(data) * 2 // 3
    path.write_bytes(data[:middle] + bytes(50) + data[middle + 50 :])
    seen = read(path)
    # Later pictures are stored as changes to earlier ones.
    assert [type(entry) for entry in seen] == [Frame] * 3 + [Loss] * 3
    path.write_bytes(data[:middle])
    with pytest.raises(SourceError, match=r"a\.gif: cannot be decoded: damaged, cut off, or not"):
        open_source(str(path))


def jpeg(picture: np.ndarray, segment: bytes = b"") -> bytes:
    data = cv2.imencode(".jpg", picture)[1].tobytes()
    return data[:2] + segment + data[2:]


@pytest.mark.parametrize("name", ["a.mjpeg", "a.mjpg", "a.jpg"])
def test_concatenated_jpegs_are_a_film(tmp_path, name):
    pictures = textured(30)
    (tmp_path / name).write_bytes(b"".join(jpeg(picture) for picture in pictures))
    frames = read(tmp_path / name)
    assert [number_of(frame.image) for frame in frames] == [number_of(p) for p in pictures]
    np.testing.assert_allclose([frame.time_s for frame in frames], np.arange(30) / 25)


def test_a_truncated_jpeg_of_a_film_loses_no_other(tmp_path):
    jpegs = [jpeg(picture) for picture in textured(6)]
    jpegs[2] = jpegs[2][:-400]
    jpegs[4] = jpegs[4][:-800] + bytes(400) + jpegs[4][-400:]
    (tmp_path / "a.mjpeg").write_bytes(b"".join(jpegs))
    seen = read(tmp_path / "a.mjpeg")
    assert [type(entry) for entry in seen] == [Frame, Frame, Loss, Frame, Loss, Frame]


def test_a_photo_with_an_appended_second_one_is_one_still(tmp_path):
    first, second = textured(2)
    listed = b"MPF\0" + bytes(20)
    segment = b"\xff\xe2" + struct.pack(">H", len(listed) + 2) + listed
    (tmp_path / "a.jpg").write_bytes(jpeg(first, segment) + jpeg(second))
    (tmp_path / "b.jpg").write_bytes(jpeg(first) + b"\0\0\0\x18ftypmp42" + bytes(100))
    for name in ("a.jpg", "b.jpg"):
        assert len(read(tmp_path / name)) == STILL_FRAMES


@pytest.mark.parametrize("bits", [10, 12, 14, 16])
@pytest.mark.parametrize("kind", ["images", "pages"])
def test_the_bits_in_use_are_scaled_and_reported(tmp_path, bits, kind):
    most = (1 << bits) - 1
    # The brightest picture is the last; the scale must hold for the first as well.
    eight = [
        np.clip(picture * part, 0, 255)
        for picture, part in zip(textured(3), (0.1, 0.5, 1.0), strict=True)
    ]
    eight[2][0, 0] = 255
    pages = [np.rint(picture * (most / 255)).astype(np.uint16) for picture in eight]
    if kind == "images":
        for number, page in enumerate(pages):
            assert cv2.imwrite(str(tmp_path / f"{number}.png"), page)
    else:
        assert cv2.imwritemulti(str(tmp_path / "a.tiff"), pages)
    with open_source(str(tmp_path / ("*.png" if kind == "images" else "a.tiff"))) as source:
        frames = list(source)
        notes = (f"16-bit pictures use {bits} bits, scaled",) if bits < 16 else ()
        assert source.notes == notes
    for frame, picture in zip(frames, eight, strict=True):
        np.testing.assert_allclose(frame.image, picture, atol=1.0)


def test_a_picture_of_more_bits_than_the_sequence_is_lost(tmp_path):
    for number in range(40):
        page = np.full((20, 20), 40000 if number == 1 else 4000, np.uint16)
        assert cv2.imwrite(str(tmp_path / f"{number}.png"), page)
    with open_source(str(tmp_path / "*.png")) as source:
        seen = list(source)
        assert [k for k, entry in enumerate(seen) if isinstance(entry, Loss)] == [1]
        assert source.damage.endswith(f"({tmp_path}/1.png: holds more than 12 bits)")


# --- duration stated by a container ---------------------------------------------------------------


@pytest.mark.parametrize(("name", "fourcc"), [("a.mkv", "mp4v"), ("a.flv", "FLV1")])
def test_a_cut_file_is_reported_and_a_whole_one_is_not(tmp_path, caplog, name, fourcc):
    path = write_film(tmp_path / name, textured(40), fourcc)
    assert len(read(path)) == 40
    assert not is_cut_off(path)
    assert caplog.records == []
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * 0.7)])
    read(path)
    assert "the file is shorter than it says: cut off" in caplog.text


def test_a_matroska_with_too_long_a_stated_duration_is_not_reported(tmp_path, caplog):
    path = write_film(tmp_path / "a.mkv", textured(40), "mp4v")
    data = path.read_bytes()
    duration = data.index(b"\x44\x89\x88") + 3  # in milliseconds, as a double
    (stated_ms,) = struct.unpack_from(">d", data, duration)
    path.write_bytes(data[:duration] + struct.pack(">d", 1.5 * stated_ms) + data[duration + 8 :])
    assert len(read(path)) == 40
    assert caplog.records == []
