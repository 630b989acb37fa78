"""Damaged pictures are lost, and sound ones are not.

Films are written, damaged in their files, and read; what the intact film shows is the truth.
"""

import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from films import Picture, textured, write_film

from fingerpost.capture import Frame, Loss, open_source
from fingerpost.capture.messages import Listener
from fingerpost.capture.source import ends_filled
from fingerpost.capture.video import Chain
from fingerpost.errors import CaptureError, SourceError

COUNT = 60
# What a picture that its decoder has mended differs by somewhere; one that is sound does nowhere.
SEEN_LEVELS = 12
TS_PACKET = 188


def read(path: Path) -> list[Frame | Loss]:
    with open_source(str(path)) as source:
        return list(source)


def lost(path: Path) -> int:
    with open_source(str(path)) as source:
        list(source)
        return source.losses


def overwritten(data: bytes, at: float, length: int) -> bytes:
    """Noise over a stretch of a file that begins at this part of it."""
    noise = np.random.default_rng(1).integers(0, 256, length, dtype=np.uint8).tobytes()
    start = int(at * len(data))
    return data[:start] + noise + data[start + length :]


def without_packets(data: bytes, at: float, count: int) -> bytes:
    """Leave out packets of an MPEG transport stream, as a network does."""
    start = int(at * len(data)) // TS_PACKET * TS_PACKET
    return data[:start] + data[start + count * TS_PACKET :]


@pytest.mark.parametrize(
    ("name", "fourcc", "damaged", "amount"),
    [
        ("a.mp4", "mp4v", overwritten, 60),
        ("a.mp4", "mp4v", overwritten, 900),
        ("a.mkv", "mp4v", overwritten, 60),
        ("a.ts", "mp4v", without_packets, 2),
        ("a.ts", "mpg2", without_packets, 3),
        ("a.avi", "MJPG", overwritten, 40),
        ("a.flv", "FLV1", overwritten, 60),
    ],
)
@pytest.mark.parametrize("at", [0.35, 0.62])
def test_what_damage_reaches_is_lost_and_all_else_is_shown(
    tmp_path, name, fourcc, damaged, amount, at
):
    path = write_film(tmp_path / name, textured(COUNT), fourcc)
    truth = {round(1000 * frame.time_s): frame.image for frame in read(path)}
    assert len(truth) == COUNT
    path.write_bytes(damaged(path.read_bytes(), at, amount))
    with open_source(str(path)) as source:
        seen = list(source)
        losses, damage = source.losses, source.damage
    frames = [entry for entry in seen if isinstance(entry, Frame)]
    assert losses == len(seen) - len(frames) > 0
    assert damage.startswith(f"{losses} of {len(seen)} pictures are damaged (")
    for frame in frames:
        true = truth[round(1000 * frame.time_s)]
        assert cv2.absdiff(frame.image, true).max() <= SEEN_LEVELS, frame.index
    # The next picture that is coded by itself comes twelve later at most; mended once, it is two.
    assert len(frames) >= COUNT - 30


def test_a_chain_is_whole_again_with_a_picture_that_is_coded_by_itself():
    def sound(kinds: str, complaints: set[int]) -> str:
        chain = Chain()
        took = [chain.take(kind, complained=k in complaints) for k, kind in enumerate(kinds)]
        return "".join("s" if is_sound else "." for is_sound in took)

    assert sound("IPPIPP", {1}) == "s..sss"
    assert sound("IPPIPP", {3}) == "sss..."
    assert sound("IIII", {1}) == "s.ss"
    # Two pictures wait for one after them: the complaint may be of the picture coded by itself.
    assert sound("IBBPIBBPIBBP", {3}) == "sss....." + "ssss"
    assert sound("IBBPPPPIBBP", {4}) == "ssss..." + "...."


@pytest.mark.parametrize("fourcc", ["mp4v", "MJPG"])
@pytest.mark.parametrize(
    "kind", ["dark", "night", "lens cap, then light", "still drawing", "plain wall", "all white"]
)
def test_sound_pictures_of_any_kind_are_not_called_damaged(tmp_path, kind, fourcc):
    width, height = 160, 128
    rng = np.random.default_rng(2)

    def picture(number: int) -> Picture:
        shape = (height, width, 3)
        noise = rng.normal(0.0, 2.0, shape)
        drawing = np.full(shape, 128.0)
        drawing[:50] = (200, 60, 20)
        level = {
            "dark": np.full(shape, 12.0) + noise,
            "night": np.abs(noise),
            "lens cap, then light": np.full(shape, 0.0) if number < 10 else 120.0 + 20 * noise,
            "still drawing": drawing,
            "plain wall": np.full(shape, 128.0) + noise / 2,
            "all white": np.full(shape, 255.0),
        }[kind]
        return np.clip(level, 0, 255).astype(np.uint8)

    path = write_film(tmp_path / "a.avi", [picture(k) for k in range(20)], fourcc)
    assert lost(path) == 0
    for number in range(4):
        cv2.imwrite(str(tmp_path / f"{number}.png"), picture(8 + number))
    assert lost(tmp_path / "*.png") == 0


def test_a_picture_that_is_filled_up_is_lost_where_others_are_not(tmp_path):
    pictures = textured(4)
    pictures[2][70:] = 128
    for number, picture in enumerate(pictures):
        cv2.imwrite(str(tmp_path / f"{number}.png"), picture)
    seen = read(tmp_path / "*.png")
    assert [type(entry) for entry in seen] == [Frame, Frame, Loss, Frame]
    assert seen[2] == Loss(2, 2 / 25, "its picture is damaged")


def test_what_decoders_fill_in_is_one_level_over_the_lowest_eighth():
    picture = textured(1)[0]
    assert not ends_filled(picture)
    for level in ((128, 128, 128), (127, 128, 129), (0, 135, 0)):
        filled = picture.copy()
        filled[-20:] = level
        assert ends_filled(filled)
        assert ends_filled(filled[..., 0]) == (level[0] >= 127)
        filled[-10, 5] = 90
        assert not ends_filled(filled)


def test_a_jpeg_that_its_decoder_mends_is_lost(tmp_path):
    for number, picture in enumerate(textured(3)):
        cv2.imwrite(str(tmp_path / f"{number}.jpg"), picture)
    middle = tmp_path / "1.jpg"
    middle.write_bytes(overwritten(middle.read_bytes(), 0.5, 300))
    assert [type(entry) for entry in read(tmp_path / "*.jpg")] == [Frame, Loss, Frame]


def test_a_film_without_a_sound_picture_is_an_error_that_says_so(tmp_path):
    path = write_film(tmp_path / "a.mp4", textured(10), "mp4v")
    path.write_bytes(overwritten(path.read_bytes(), 0.1, 300))
    with pytest.raises(CaptureError, match=r"a\.mp4: no picture is sound: 10 of 10 pictures are"):
        read(path)


def interlaced(data: bytes) -> bytes:
    """Mark an MPEG-2 film as interlaced: the flags of its sequence and of each picture."""
    changed = bytearray(data)
    start = -1
    while (start := data.find(b"\0\0\1\xb5", start + 1)) >= 0:
        extension = data[start + 4] >> 4
        if extension == 1:
            changed[start + 5] &= ~0x08  # progressive_sequence
        elif extension == 8:
            changed[start + 8] &= ~0x80  # progressive_frame
    return bytes(changed)


FIRST_PICTURE = """
import cv2, numpy
_, first = cv2.VideoCapture("a film.mpg").read()
print(numpy.corrcoef(first.ravel(), numpy.load("first.npy").ravel())[0, 1])
"""
"""In a process of its own: an old picture in a decoder's memory would pass for one."""


def test_interlaced_video_is_read_or_refused_with_the_remedy_and_never_black(tmp_path):
    pictures = textured(10)
    path = write_film(tmp_path / "a film.mpg", pictures, "mpg2")
    path.write_bytes(interlaced(path.read_bytes()))
    remedy = (
        f"{path}: mpg2 video that is interlaced, which this OpenCV cannot read; deinterlace it: "
        f"ffmpeg -i '{path}' -vf yadif -c:v libx264 -crf 14 'a film-h264.mp4'"
    )
    np.save(tmp_path / "first.npy", pictures[0])
    if float(subprocess.check_output([sys.executable, "-c", FIRST_PICTURE], cwd=tmp_path)) > 0.8:
        assert len(read(path)) == 10  # this OpenCV reads it
        return
    with pytest.raises(SourceError) as raised:
        read(path)
    assert str(raised.value) == remedy


def test_a_codec_that_cannot_be_decoded_is_named_with_the_remedy(tmp_path):
    path = write_film(tmp_path / "a.mp4", textured(5), "mp4v")
    start, table = path.read_bytes().rsplit(b"mp4v", 1)
    path.write_bytes(start + b"av01" + table.replace(b"esds", b"free"))
    with pytest.raises(SourceError) as raised:
        open_source(str(path))
    assert str(raised.value) == (
        f"{path}: AV1 video, which this OpenCV cannot decode; convert it: ffmpeg -i {path} "
        "-c:v libx264 -crf 14 a-h264.mp4"
    )


# --- listening -------------------------------------------------------------------------------


def test_a_listener_hears_decoders_and_passes_on_what_others_write(capfd):
    listener = Listener()
    with listener:
        os.write(2, b"[h264 @ 0x55ae9e1c95c0] [error] error while decoding MB 5 8\n")
        os.write(2, b"somebody else's words\n")
        os.write(2, b"[h264 @ 0x55ae9e1c95c0] [warning] nothing of weight\n")
        os.write(2, b"[mjpeg @ 0x55ae9e1c95c0] [error] unable to decode APP fields\n")
        os.write(2, b"\x1b[0;36m[h264 @ 0x1] \x1b[0m[info] concealing 30 DC, 30 AC in P frame\n")
    assert listener.complaint == "error while decoding MB 5 8"
    assert listener.lines[-1] == "concealing 30 DC, 30 AC in P frame"
    assert capfd.readouterr().err == "somebody else's words\n"
    with listener:
        pass
    assert listener.complaint == ""


def test_damage_is_heard_without_a_standard_error_stream(tmp_path):
    path = write_film(tmp_path / "a.mp4", textured(COUNT), "mp4v")
    path.write_bytes(overwritten(path.read_bytes(), 0.35, 900))
    program = (
        "import os, sys; os.close(2)\nfrom fingerpost.capture import open_source\n"
        "with open_source(sys.argv[1]) as source: list(source); print(source.losses)"
    )
    command = [sys.executable, "-c", program, str(path)]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    assert int(done.stdout) == lost(path) > 0
