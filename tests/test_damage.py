"""Damaged pictures become losses, and sound ones do not.

Films are written, damaged in their files, and read; the pictures of the intact film are the truth.
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
# Greatest difference of a sound picture from the truth; one with concealed errors exceeds it.
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
    """Overwrite `length` bytes with noise, from the part `at` of a file on."""
    noise = np.random.default_rng(1).integers(0, 256, length, dtype=np.uint8).tobytes()
    start = int(at * len(data))
    return data[:start] + noise + data[start + length :]


def without_packets(data: bytes, at: float, count: int) -> bytes:
    """Remove packets of an MPEG transport stream, as a network loses them."""
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
def test_damaged_pictures_are_lost_and_all_others_agree_with_the_truth(
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
    # Key frames are at most twelve apart; if one has concealed errors, the loss lasts to the next.
    assert len(frames) >= COUNT - 30


def test_a_chain_is_sound_again_from_a_key_frame_on():
    def sound(kinds: str, complaints: set[int]) -> str:
        chain = Chain()
        took = [chain.take(kind, complained=k in complaints) for k, kind in enumerate(kinds)]
        return "".join("s" if is_sound else "." for is_sound in took)

    assert sound("IPPIPP", {1}) == "s..sss"
    assert sound("IPPIPP", {3}) == "sss..."
    assert sound("IIII", {1}) == "s.ss"
    # Two B pictures delay the decoder's output: the complaint may concern the I picture.
    assert sound("IBBPIBBPIBBP", {3}) == "sss....." + "ssss"
    assert sound("IBBPPPPIBBP", {4}) == "ssss..." + "...."


@pytest.mark.parametrize("fourcc", ["mp4v", "MJPG"])
@pytest.mark.parametrize(
    "kind", ["dark", "night", "lens cap, then light", "still drawing", "plain wall", "all white"]
)
def test_sound_pictures_of_any_kind_are_not_lost(tmp_path, kind, fourcc):
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


def test_a_partly_filled_picture_among_whole_ones_is_lost(tmp_path):
    pictures = textured(4)
    pictures[2][70:] = 128
    for number, picture in enumerate(pictures):
        cv2.imwrite(str(tmp_path / f"{number}.png"), picture)
    seen = read(tmp_path / "*.png")
    assert [type(entry) for entry in seen] == [Frame, Frame, Loss, Frame]
    assert seen[2] == Loss(2, 2 / 25, "its picture is damaged")


def test_a_filled_picture_has_one_level_over_its_lowest_eighth():
    picture = textured(1)[0]
    assert not ends_filled(picture)
    for level in ((128, 128, 128), (127, 128, 129), (0, 135, 0)):
        filled = picture.copy()
        filled[-20:] = level
        assert ends_filled(filled)
        assert ends_filled(filled[..., 0]) == (level[0] >= 127)
        filled[-10, 5] = 90
        assert not ends_filled(filled)


def test_a_jpeg_with_concealed_errors_is_lost(tmp_path):
    for number, picture in enumerate(textured(3)):
        cv2.imwrite(str(tmp_path / f"{number}.jpg"), picture)
    middle = tmp_path / "1.jpg"
    middle.write_bytes(overwritten(middle.read_bytes(), 0.5, 300))
    assert [type(entry) for entry in read(tmp_path / "*.jpg")] == [Frame, Loss, Frame]


def test_a_film_without_a_sound_picture_is_an_error(tmp_path):
    path = write_film(tmp_path / "a.mp4", textured(10), "mp4v")
    path.write_bytes(overwritten(path.read_bytes(), 0.1, 300))
    with pytest.raises(CaptureError, match=r"a\.mp4: no picture is sound: 10 of 10 pictures are"):
        read(path)


def interlaced(data: bytes) -> bytes:
    """Mark an MPEG-2 film as interlaced, in the flags of its sequence and of each picture."""
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
"""Run in a process of its own: a decoder may return an old picture left in its memory."""


def test_interlaced_video_is_read_or_refused_with_a_remedy(tmp_path):
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


def test_an_unsupported_codec_is_named_with_a_remedy(tmp_path):
    path = write_film(tmp_path / "a.mp4", textured(5), "mp4v")
    start, table = path.read_bytes().rsplit(b"mp4v", 1)
    path.write_bytes(start + b"av01" + table.replace(b"esds", b"free"))
    with pytest.raises(SourceError) as raised:
        open_source(str(path))
    assert str(raised.value) == (
        f"{path}: AV1 video, which this OpenCV cannot decode; convert it: ffmpeg -i {path} "
        "-c:v libx264 -crf 14 a-h264.mp4"
    )


# --- messages of decoders --------------------------------------------------------------------


def test_a_listener_captures_decoder_messages_and_passes_on_others(capfd):
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


def test_damage_is_detected_without_a_standard_error_stream(tmp_path):
    path = write_film(tmp_path / "a.mp4", textured(COUNT), "mp4v")
    path.write_bytes(overwritten(path.read_bytes(), 0.35, 900))
    program = (
        "import os, sys; os.close(2)\nfrom fingerpost.capture import open_source\n"
        "with open_source(sys.argv[1]) as source: list(source); print(source.losses)"
    )
    command = [sys.executable, "-c", program, str(path)]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    assert int(done.stdout) == lost(path) > 0
