"""Cameras: their settings, rotated and cropped pictures, raw pipes, and the list of cameras."""

import errno
import os
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import ClassVar

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from patience import PATIENCE_S, wait_until

import fingerpost as fp
from fingerpost.capture import (
    Arrangement,
    Camera,
    CameraSettings,
    Frame,
    Reading,
    list_cameras,
    open_source,
    open_views,
    opening,
    refuse_repeated,
)
from fingerpost.capture.live import LiveSource
from fingerpost.capture.raw import RawFormat, RawStream, StreamEndedError
from fingerpost.cli import main
from fingerpost.errors import CaptureError, InvalidInputError, SourceError
from fingerpost.simulate import DevicePose, SimulatedRig, Trajectory, write_recording

PLANE = '[plane]\nunit = "mm"\npoints = [[0, 0], [400, 0], [400, 400], [0, 400]]\n'
VIEW = (
    '[[view]]\nname = "left"\nsource = {source}\n'
    "reference_points_px = [[234, 452], [567, 359], [422, 161], [126, 231]]\n"
)


def loaded(folder: Path, *lines: str, source: str = "0") -> fp.Rig:
    text = PLANE + VIEW.format(source=source) + "\n".join(lines)
    (folder / "rig.toml").write_text(text, encoding="utf-8")
    return fp.Rig.load(folder / "rig.toml")


# --- settings ---------------------------------------------------------------------------------


class Webcam:
    """A camera whose driver takes the nearest supported value without an error."""

    SIZES = ((640, 480), (1280, 720))
    AUTO: ClassVar = {
        cv2.CAP_PROP_EXPOSURE: (cv2.CAP_PROP_AUTO_EXPOSURE, 1.0),
        cv2.CAP_PROP_WB_TEMPERATURE: (cv2.CAP_PROP_AUTO_WB, 0.0),
    }

    def __init__(self) -> None:
        self.asked: list[int] = []
        self.values = {
            cv2.CAP_PROP_FOURCC: float(cv2.VideoWriter.fourcc(*"MJPG")),
            cv2.CAP_PROP_FRAME_WIDTH: 640.0,
            cv2.CAP_PROP_FRAME_HEIGHT: 480.0,
            cv2.CAP_PROP_FPS: 30.0,
            cv2.CAP_PROP_EXPOSURE: 157.0,
            cv2.CAP_PROP_AUTO_EXPOSURE: 3.0,
            cv2.CAP_PROP_WB_TEMPERATURE: 4600.0,
            cv2.CAP_PROP_AUTO_WB: 1.0,
        }
        self.grabbed = threading.Event()

    def getBackendName(self) -> str:  # noqa: N802
        return "V4L2"

    def set(self, prop: int, value: float) -> bool:
        self.asked.append(prop)
        if prop not in self.values:
            return False
        automatic = self.AUTO.get(prop)
        if automatic and self.values[automatic[0]] != automatic[1]:
            return True  # V4L2 accepts it, but the automatic control stays on
        if prop == cv2.CAP_PROP_FPS:
            value = 30.0
        self.values[prop] = value
        if prop in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT):
            axis = int(prop == cv2.CAP_PROP_FRAME_HEIGHT)
            size = min(self.SIZES, key=lambda size: abs(size[axis] - value))
            self.values[cv2.CAP_PROP_FRAME_WIDTH], self.values[cv2.CAP_PROP_FRAME_HEIGHT] = size
        return True

    def get(self, prop: int) -> float:
        return self.values.get(prop, -1.0)

    def isOpened(self) -> bool:  # noqa: N802
        return True

    def grab(self) -> bool:
        self.grabbed.set()
        return True

    def retrieve(self) -> tuple[bool, np.ndarray]:
        return True, np.zeros((480, 640, 3), np.uint8)

    def release(self) -> None:
        pass


def test_a_camera_that_applies_its_settings_has_no_differences():
    camera = Webcam()
    settings = CameraSettings(1280, 720, 30, "YUYV", exposure=80, white_balance_k=5000)
    assert settings.apply(camera) == []
    assert camera.values[cv2.CAP_PROP_EXPOSURE] == 80
    assert camera.values[cv2.CAP_PROP_WB_TEMPERATURE] == 5000
    # The pixel format is set first: sizes and rates depend on it.
    order = [cv2.CAP_PROP_FOURCC, cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FPS]
    assert [prop for prop in camera.asked if prop in order] == order


def test_settings_are_read_back_and_differences_reported():
    assert CameraSettings(1920, 1080, fps=60, focus=10, gain=4).apply(Webcam()) == [
        "width is 1280, 1920 was asked for",
        "height is 720, 1080 was asked for",
        "fps is 30, 60 was asked for",
        "gain cannot be set, 4 was asked for",
        "focus cannot be set, 10 was asked for",
    ]


def test_another_pixel_format_is_reported_by_its_fourcc():
    camera = Webcam()
    camera.set = lambda *_: True
    differences = CameraSettings(fourcc="YUYV").apply(camera)
    assert differences == ["fourcc is MJPG, YUYV was asked for"]


def test_differences_are_logged_once_and_kept_as_notes(caplog):
    camera = CameraSettings(1920, 1080)
    with LiveSource(
        3,
        timeout_s=PATIENCE_S,
        clock=time.monotonic_ns,
        camera=camera,
        connect=lambda *_: Webcam(),
    ) as source:
        next(source)
        assert source.notes == (
            "width is 1280, 1920 was asked for",
            "height is 720, 1080 was asked for",
        )
    said = [record.getMessage() for record in caplog.records]
    assert sorted(said) == [f"camera 3: {note}" for note in sorted(source.notes)]


def test_keys_of_a_rig_become_camera_settings_and_arrangement(tmp_path):
    line = 'camera = { width = 1280, height = 720, fps = 30, fourcc = "YUYV", exposure = -6 }'
    rig = loaded(tmp_path, line, "rotate_deg = 90", "mirror = true", "crop = [0, 40, 640, 400]")
    assert rig.readings == (
        Reading(
            arrangement=Arrangement(90, True, (0, 40, 640, 400)),
            camera=CameraSettings(1280, 720, 30.0, "YUYV", exposure=-6.0),
        ),
    )
    rig.save(tmp_path / "again.toml")
    assert fp.Rig.load(tmp_path / "again.toml") == rig


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("rotate_deg = 45", "view[0]: rotate_deg is 45; 0, 90, 180 or 270, clockwise, is right"),
        ("mirror = 1", "view[0].mirror is 1; needed: true or false"),
        ("crop = [0, 0, 10]", "view[0].crop is [0, 0, 10]; needed: the part of the turned picture"),
        ("crop = [0, 0, 0, 10]", "view[0]: crop is [0, 0, 0, 10]; [x, y, width, height] with"),
        ("camera = { widht = 9 }", "view[0].camera.widht is not a key of a rig file; did you mean"),
        ("camera = { width = 0 }", "view[0].camera: width is 0; from 1 to 32767 is right"),
        ('camera = { fourcc = "JPEG!" }', 'fourcc is "JPEG!"; needed: four letters in quotes'),
    ],
)
def test_invalid_settings_are_refused_by_name(tmp_path, line, words):
    with pytest.raises(InvalidInputError) as raised:
        loaded(tmp_path, line)
    assert words in str(raised.value)


@pytest.mark.parametrize("source", ["a.png", "http://127.0.0.1:1/stream"])
def test_settings_for_a_source_without_a_camera_are_refused(tmp_path, monkeypatch, source):
    monkeypatch.chdir(tmp_path)
    cv2.imwrite("a.png", np.zeros((8, 8), np.uint8))
    with pytest.raises(InvalidInputError, match="is for cameras and pipes"):
        open_source(source, camera=CameraSettings(width=640))


# --- rotated, mirrored and cropped pictures ---------------------------------------------------


def test_pictures_are_rotated_clockwise_then_mirrored_then_cropped():
    picture = np.arange(4 * 6 * 3, dtype=np.uint8).reshape(4, 6, 3)
    turned = cv2.rotate(picture, cv2.ROTATE_90_CLOCKWISE)
    found = Arrangement(90, mirror=True, crop=(1, 2, 2, 3)).of(picture)
    np.testing.assert_array_equal(found, cv2.flip(turned, 1)[2:5, 1:3])
    assert found.flags.c_contiguous
    np.testing.assert_array_equal(Arrangement().of(picture), picture)


UNDONE = {
    "clockwise": (cv2.ROTATE_90_CLOCKWISE, "rotate_deg = 270"),
    "upside down": (cv2.ROTATE_180, "rotate_deg = 180"),
    "mirrored": (None, "mirror = true"),
}


@pytest.mark.parametrize(("turn", "line"), UNDONE.values(), ids=UNDONE.keys())
def test_a_rotated_or_mirrored_camera_gives_the_same_points(tmp_path, turn, line):
    pose = DevicePose.pointing_at((200.0, 200.0), azimuth_deg=20.0, slant_deg=50.0, hover_mm=120.0)
    rig_file = write_recording(
        tmp_path, SimulatedRig(), Trajectory.hold(pose, 1.0), frames=7, rng=4
    )
    straight = list(fp.track(fp.Rig.load(rig_file)))
    text = rig_file.read_text(encoding="utf-8")
    for path in (tmp_path / "left").glob("*.png"):
        shown = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        askew = cv2.flip(shown, 1) if turn is None else cv2.rotate(shown, turn)
        cv2.imwrite(str(path), askew)
    rig_file.write_text(text.replace("[[view]]", f"[[view]]\n{line}", 1), encoding="utf-8")
    rig = fp.Rig.load(rig_file)
    askew_fixes = list(fp.track(rig))
    assert straight[-1].status is fp.Status.OK
    assert [f.point.tolist() for f in askew_fixes[-2:]] == [f.point.tolist() for f in straight[-2:]]
    # Pushed images are as the camera gives them, and are rotated in the same way.
    with open_views(rig.sources) as sources:
        pointer = fp.Pointer(rig)
        for seen in zip(*sources, strict=True):
            fixes = pointer.push([frame.image for frame in seen], seen[0].time_s)
    assert fixes[-1].point.tolist() == straight[-1].point.tolist()


def test_a_crop_beyond_the_picture_is_refused_with_its_size(tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((48, 64), np.uint8))
    rig = loaded(tmp_path, "crop = [0, 0, 65, 48]", source='"a.png"')
    with (
        open_views(rig.sources, rig.readings) as (source,),
        pytest.raises(
            SourceError, match=r"a\.png: crop \[0, 0, 65, 48\] reaches beyond the picture"
        ),
    ):
        next(source)


# --- raw pipes --------------------------------------------------------------------------------


def gradient(number: int = 0) -> np.ndarray:
    """A picture of smooth colours, which chroma at half the resolution preserves."""
    v, u = np.mgrid[:48, :64]
    planes = [60 + u + number, 90 + v, 200 - u - v]
    return np.stack(planes, axis=2).astype(np.uint8)


def planar(picture: np.ndarray) -> bytes:
    return cv2.cvtColor(picture, cv2.COLOR_BGR2YUV_I420).tobytes()


def semiplanar(picture: np.ndarray) -> bytes:
    yuv = cv2.cvtColor(picture, cv2.COLOR_BGR2YUV_I420).reshape(-1)
    luma, u, v = np.split(yuv, [48 * 64, 48 * 64 * 5 // 4])
    return luma.tobytes() + np.stack([u, v], axis=1).tobytes()


def packed(picture: np.ndarray) -> bytes:
    luma, u, v = np.split(np.frombuffer(planar(picture), np.uint8), [48 * 64, 48 * 64 * 5 // 4])
    chroma = np.stack([u, v], axis=1).reshape(24, 64).repeat(2, axis=0)
    return np.stack([luma.reshape(48, 64), chroma], axis=2).tobytes()


LAYOUTS = {
    "BGR3": lambda p: p.tobytes(),
    "RGB3": lambda p: p[..., ::-1].tobytes(),
    "YU12": planar,
    "I420": planar,
    "NV12": semiplanar,
    "YUYV": packed,
}


def piped(data: bytes, known: RawFormat | None) -> list[np.ndarray]:
    """Return every frame of a pipe into which `data` is written."""
    reading, writing = os.pipe()

    def write() -> None:
        with os.fdopen(writing, "wb") as file:
            file.write(data)

    writer = threading.Thread(target=write)
    writer.start()
    stream, pictures = RawStream(reading, known, timeout_s=PATIENCE_S, ends=True), []
    try:
        while True:
            if stream.grab():
                pictures.append(stream.retrieve()[1])
    except StreamEndedError:
        return pictures
    finally:
        stream.release()
        writer.join()


@pytest.mark.parametrize(("fourcc", "written"), LAYOUTS.items())
def test_raw_frames_are_read_as_written(fourcc, written):
    shown = [gradient(k) for k in range(3)]
    found = piped(b"".join(map(written, shown)), RawFormat(64, 48, fourcc))
    assert len(found) == 3
    for a, b in zip(found, shown, strict=True):
        assert np.abs(a.astype(int) - b).max() <= (0 if fourcc in ("BGR3", "RGB3") else 6)


def test_grey_raw_frames_stay_grey():
    (found,) = piped(gradient()[..., 0].tobytes(), RawFormat(64, 48, "GREY"))
    np.testing.assert_array_equal(found, gradient()[..., 0])


def y4m(*pictures: np.ndarray, parameters: str = "F25:1 Ip A1:1 C420jpeg XYSCSS=420JPEG") -> bytes:
    frames = (b"FRAME Xanything\n" + planar(picture) for picture in pictures)
    return f"YUV4MPEG2 W64 H48 {parameters}\n".encode() + b"".join(frames)


def test_a_y4m_stream_gives_its_own_size():
    found = piped(y4m(gradient(0), gradient(5)), None)
    assert len(found) == 2
    assert np.abs(found[1].astype(int) - gradient(5)).max() <= 6


RUBBISH = {
    "no size": (bytes(100), None, "raw frames do not state their size; camera = { width = ...,"),
    "nothing": (b"", None, "nothing was written to it|it ended before the first frame"),
    "short": (bytes(100), RawFormat(64, 48, "BGR3"), "within the first frame, of 64 × 48 px in BG"),
    "pixels": (y4m(parameters="C422"), None, "have the pixels 422; -pix_fmt yuv420p is right"),
    "no width": (b"YUV4MPEG2 F25:1\nFRAME\n", None, "has no size"),
    "odd": (b"YUV4MPEG2 W63 H48\nFRAME\n", None, "this layout has even sides"),
    "endless": (b"YUV4MPEG2 W63 " + b"X" * 999, None, "lines have no end"),
    "damaged": (y4m(gradient()) + b"noise\n", None, "do not follow one another"),
}


@pytest.mark.parametrize(("data", "known", "words"), RUBBISH.values(), ids=RUBBISH.keys())
def test_an_invalid_raw_stream_is_refused_with_its_fault(data, known, words):
    with pytest.raises((CaptureError, InvalidInputError)) as raised:
        piped(data, known)
    assert any(part in str(raised.value) for part in words.split("|"))


@pytest.mark.parametrize(
    ("camera", "words"),
    [
        (CameraSettings(640), "camera of a pipe needs width and height"),
        (CameraSettings(640, 480, exposure=3), "camera.exposure cannot be set through a pipe"),
        (CameraSettings(640, 480, fourcc="MJPG"), "fourcc of raw frames is MJPG; BGR3, RGB3"),
    ],
)
def test_invalid_settings_of_a_pipe_are_refused_at_once(camera, words):
    with pytest.raises(InvalidInputError) as raised:
        open_source("-", camera=camera)
    assert words in str(raised.value)


READ = """
import sys
from fingerpost.capture import CameraSettings, open_source
size = CameraSettings(64, 48) if sys.argv[1:] else None
with open_source("-", camera=size) as source:
    print(source.name, source.kind.name, *(f"{f.index}:{f.image[0, 0, 0]}" for f in source))
"""


@pytest.mark.parametrize("raw", [True, False])
def test_standard_input_is_a_live_view_that_ends_with_its_writer(raw):
    pictures = [gradient(k) for k in range(40)]
    data = b"".join(map(LAYOUTS["BGR3"], pictures)) if raw else y4m(*pictures)
    done = subprocess.run(
        [sys.executable, "-c", READ, *(["raw"] if raw else [])],
        input=data,
        capture_output=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    name, kind, *seen = done.stdout.decode().rsplit(maxsplit=done.stdout.count(b" ") - 1)
    assert (name, kind) == ("standard input", "LIVE")
    index, level = map(int, seen[-1].split(":"))
    assert index == 39  # frames may be skipped, but not the newest
    assert abs(level - pictures[-1][0, 0, 0]) <= (0 if raw else 6)


def test_raw_frames_are_read_from_a_named_pipe(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    pictures = [gradient(k) for k in range(3)]

    def write() -> None:
        with (tmp_path / "pipe").open("wb") as file:
            for picture in pictures:
                file.write(picture.tobytes())
                file.flush()
            assert done.wait(PATIENCE_S)

    done = threading.Event()
    writer = threading.Thread(target=write)
    writer.start()
    size = CameraSettings(64, 48)
    with open_source(str(tmp_path / "pipe"), camera=size, timeout_s=PATIENCE_S) as source:
        seen = [next(source)]
        while seen[-1].index < 2:
            seen.append(next(source))
        np.testing.assert_array_equal(seen[-1].image, pictures[2])
        done.set()
    writer.join()


def test_two_views_cannot_share_standard_input(tmp_path):
    with (
        pytest.raises(InvalidInputError, match='views "a" and "b" both read -'),
        open_views({"a": "-", "b": "-"}),
    ):
        pass
    assert loaded(tmp_path, source='"-"').views[0].source == "-"


# --- the list of cameras ----------------------------------------------------------------------

MODES = {
    b"MJPG": {(1280, 720): [(1, 30), (1, 60)], (640, 480): [(1, 30)]},
    b"YUYV": {(640, 480): []},
}


def kernel(descriptor: int, request: int, data: bytearray) -> None:
    """V4L2 of one webcam, by the layouts of videodev2.h; its second node has metadata only."""
    number, size = request & 0xFF, request >> 16 & 0x3FFF
    assert size == len(data)
    if number == 0:
        is_camera = Path(f"/proc/self/fd/{descriptor}").resolve().name == "video0"
        struct.pack_into("=I", data, 84, 0x84A00001)  # of the whole device
        struct.pack_into("=I", data, 88, 0x04200001 if is_camera else 0x04A00000)
        return
    (index,) = struct.unpack_from("=I", data)
    try:
        if number == 2:
            assert struct.unpack_from("=I", data, 4) == (1,)
            data[44:48] = list(MODES)[index]
        elif number == 74:
            struct.pack_into("=III", data, 8, 1, *list(MODES[bytes(data[4:8])])[index])
        elif number == 75:
            width, height = struct.unpack_from("=II", data, 8)
            rates = MODES[bytes(data[4:8])][width, height]
            struct.pack_into("=III", data, 16, 1, *rates[index])
    except IndexError:
        raise OSError(errno.EINVAL, "Invalid argument") from None


@pytest.fixture
def machine(tmp_path: Path) -> tuple[Path, Path]:
    """/sys and /dev with a webcam, the node of its metadata, and a camera missing in /dev."""
    for name, title in (("video0", "HD Webcam"), ("video1", "HD Webcam"), ("video10", "Other")):
        (tmp_path / "sys" / name).mkdir(parents=True)
        (tmp_path / "sys" / name / "name").write_text(f"{title}\n")
    (tmp_path / "dev").mkdir()
    for name in ("video0", "video1"):
        (tmp_path / "dev" / name).touch()
    return tmp_path / "sys", tmp_path / "dev"


needs_linux = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="V4L2 is Linux's")


@needs_linux
def test_cameras_are_listed_with_name_and_modes(machine):
    webcam, other = list_cameras(sys_folder=machine[0], dev_folder=machine[1], ioctl=kernel)
    assert (webcam.number, webcam.name, webcam.trouble) == (0, "HD Webcam", "")
    assert list(map(str, webcam.modes)) == [
        "MJPG 1280 × 720 60 fps",
        "MJPG 640 × 480 30 fps",
        "YUYV 640 × 480",
    ]
    assert (other.number, other.trouble) == (10, "cannot be opened: No such file or directory")


def test_the_command_lists_cameras_and_writes_their_pictures(machine, tmp_path, monkeypatch):
    found = list_cameras(sys_folder=machine[0], dev_folder=machine[1], ioctl=kernel)
    monkeypatch.setattr("fingerpost.capture.list_cameras", lambda: found)
    cv2.imwrite(str(tmp_path / "seen.png"), np.full((960, 1280, 3), 77, np.uint8))
    monkeypatch.setattr(
        "fingerpost.capture.open_source", lambda _: open_source(str(tmp_path / "seen.png"))
    )
    done = CliRunner().invoke(main, ["cameras", "--thumbnails", str(tmp_path / "out")])
    picture = tmp_path / "out" / "camera-0.jpg"
    assert done.output.splitlines() == [
        "camera 0   HD Webcam",
        "    MJPG 1280 × 720 60 fps",
        "    MJPG 640 × 480 30 fps",
        "    YUYV 640 × 480",
        f"    picture: {picture}",
        "camera 10   Other",
        "    cannot be opened: No such file or directory",
    ]
    assert cv2.imread(str(picture)).shape == (240, 320, 3)


LINKS = {
    "by-id/usb-Maker_HD_Webcam_A1-video-index0": "video0",
    "by-id/usb-Maker_HD_Webcam_B2-video-index0": "video4",
    "by-path/pci-0:1-video-index0": "video0",
}


@pytest.fixture
def twins(tmp_path, monkeypatch) -> Path:
    """A machine with two webcams of one model, a third of another, and the links of udev."""
    places = {"video0": "HD Webcam", "video4": "HD Webcam", "video2": "Desk [left]: C920"}
    for node, title in places.items():
        (tmp_path / "sys" / node).mkdir(parents=True)
        (tmp_path / "sys" / node / "name").write_text(f"{title}\n")
        (tmp_path / "dev").mkdir(exist_ok=True)
        (tmp_path / "dev" / node).touch()
    for link, node in LINKS.items():
        path = tmp_path / "dev" / "v4l" / link
        path.parent.mkdir(parents=True, exist_ok=True)
        path.symlink_to(tmp_path / "dev" / node)

    def every_node_is_a_camera(descriptor: int, request: int, data: bytearray) -> None:
        if request & 0xFF:
            raise OSError(errno.EINVAL, "Invalid argument")
        struct.pack_into("=I", data, 84, 0x1)

    def there() -> list[Camera]:
        folders = {"sys_folder": tmp_path / "sys", "dev_folder": tmp_path / "dev"}
        return list_cameras(**folders, ioctl=every_node_is_a_camera)

    monkeypatch.setattr(opening, "named_cameras", there)
    return tmp_path


@pytest.fixture
def opened(monkeypatch) -> list[object]:
    """Sources that were connected; each is replaced by a stub."""
    asked: list[object] = []

    def connected(source: object, *_: object) -> Webcam:
        asked.append(source)
        return Webcam()

    monkeypatch.setattr(opening, "connected", connected)
    return asked


@needs_linux
@pytest.mark.parametrize(
    ("name", "number"),
    [
        ("Desk [left]: C920", 2),
        ("usb-Maker_HD_Webcam_B2-video-index0", 4),
        ("pci-0:1-video-index0", 0),
    ],
)
def test_a_camera_is_opened_by_its_name(twins, tmp_path, opened, name, number):
    rig = loaded(tmp_path, source=f'"{name}"')
    with open_source(rig.sources["left"]) as source:
        assert isinstance(next(source), Frame)
        assert source.name == name
    assert opened == [number]
    rig.save(tmp_path / "again.toml")
    assert f'source = "{name}"' in (tmp_path / "again.toml").read_text(encoding="utf-8")
    with pytest.raises(InvalidInputError, match="each needs a source of its own"):
        refuse_repeated({"left": rig.sources["left"], "right": number})


@needs_linux
@pytest.mark.parametrize(
    ("name", "said"),
    [
        (
            "HD webcam",
            'no such file, and no camera has that name; plugged in: "HD Webcam" (0), '
            '"Desk [left]: C920" (2), "HD Webcam" (4)',
        ),
        (
            "HD Webcam",
            'no such file, and 2 cameras have that name; name one as "usb-Maker_HD_Webcam_A1-video-'
            'index0", "usb-Maker_HD_Webcam_B2-video-index0"',
        ),
    ],
)
def test_an_unknown_or_ambiguous_name_is_refused_with_the_existing_ones(twins, name, said):
    with pytest.raises(SourceError) as raised:
        open_source(name)
    assert str(raised.value) == f"{name}: {said}"


@needs_linux
def test_a_camera_reconnected_under_another_number_is_found_by_its_name(twins, opened, monkeypatch):
    monkeypatch.setattr("fingerpost.capture.live._FIRST_PAUSE_S", 0.0)
    monkeypatch.setattr("fingerpost.capture.live._ENDED_S", 0.0)
    monkeypatch.setattr(Webcam, "grab", lambda _: True)
    with open_source("Desk [left]: C920") as source:
        next(source)
        for folder in ("sys", "dev"):
            (twins / folder / "video2").rename(twins / folder / "video6")
        monkeypatch.setattr(Webcam, "grab", lambda _: len(opened) > 1)  # unplugged
        wait_until(lambda: opened == [2, 6])
        assert any(isinstance(entry, Frame) for entry in source)


def test_without_a_camera_the_command_prints_one_line(monkeypatch):
    monkeypatch.setattr("fingerpost.capture.list_cameras", list)
    done = CliRunner().invoke(main, ["cameras"])
    assert (done.exit_code, done.output.count("\n")) == (0, 1)
    assert done.output.startswith("no camera found; plug one in")


def test_rotated_frames_keep_their_index_and_time(tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((48, 64), np.uint8))
    reading = Reading(offset_s=2.0, arrangement=Arrangement(90))
    with open_views({"a": str(tmp_path / "a.png")}, [reading]) as (source,):
        next(source)
        frame = next(source)
    assert isinstance(frame, Frame)
    assert (frame.index, frame.time_s, frame.image.shape) == (1, 2.04, (64, 48))
