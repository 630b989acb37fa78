"""Connected cameras: their numbers, names and modes, without opening a stream.

On Linux the kernel lists them (V4L2: /sys/class/video4linux, and the enumerations of videodev2.h),
and udev links each by identity and by port (/dev/v4l/by-id, /dev/v4l/by-path). On other systems
OpenCV tries one number after the other, which gives no names.
"""

from __future__ import annotations

import errno
import os
import struct
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fingerpost.errors import CaptureError

_SYS = Path("/sys/class/video4linux")
_DEV = Path("/dev")
_LINKS = ("v4l/by-id", "v4l/by-path")
_MOST_NUMBERS = 10
_MOST_ENTRIES = 256  # of an enumeration that a driver does not end

# videodev2.h: requests, the sizes of their structures, and what is read of those.
_READ, _WRITE = 2, 1


def _request(direction: int, number: int, size: int) -> int:
    return direction << 30 | size << 16 | ord("V") << 8 | number


_CAPABILITY = struct.Struct("=16s32s32sIII12x")
_QUERY_CAPABILITY = _request(_READ, 0, _CAPABILITY.size)
_FORMAT = struct.Struct("=III32s4s16x")
_ENUM_FORMATS = _request(_READ | _WRITE, 2, _FORMAT.size)
_FRAME_SIZE = struct.Struct("=I4sI6I8x")
_ENUM_FRAME_SIZES = _request(_READ | _WRITE, 74, _FRAME_SIZE.size)
_INTERVAL = struct.Struct("=I4sIII6I8x")
_ENUM_INTERVALS = _request(_READ | _WRITE, 75, _INTERVAL.size)
_CAPTURES, _HAS_DEVICE_CAPABILITIES = 0x1 | 0x1000, 0x80000000
_BUFFER_CAPTURE, _DISCRETE = 1, 1

Ioctl = Callable[[int, int, bytearray], object]


@dataclass(frozen=True, slots=True)
class Mode:
    """Format, size and rate at which a camera sends pictures.

    Attributes
    ----------
    fourcc
        Pixel format, as `fourcc` in a rig file.
    width, height
        Size [px]; the largest one if the camera offers a range.
    fps
        Highest frame rate [1/s]; 0 if unknown.
    """

    fourcc: str
    width: int
    height: int
    fps: float

    def __str__(self) -> str:
        rate = f" {self.fps:g} fps" if self.fps else ""
        return f"{self.fourcc} {self.width} × {self.height}{rate}"


@dataclass(frozen=True, slots=True)
class Camera:
    """A connected camera.

    Attributes
    ----------
    number
        Number to give as `source` in a rig file.
    name
        Name to give there instead; empty if the system reports none.
    modes
        Modes, largest pictures first.
    trouble
        Why it cannot be queried; else empty.
    links
        Names that distinguish cameras of one model: by serial number, if there is one, and by port.
    """

    number: int
    name: str = ""
    modes: list[Mode] = field(default_factory=list)
    trouble: str = ""
    links: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        return f'"{self.name}" ({self.number})' if self.name else str(self.number)

    def name_in(self, source: str) -> str:
        """Return the camera's name that a source equals or, as a path, ends in; else empty.

        The sources of a rig file are first resolved as paths relative to it.
        """
        names = [name for name in (self.name, *self.links) if name]
        return next((name for name in names if f"/{source}".endswith(f"/{name}")), "")


def list_cameras(
    *, sys_folder: Path = _SYS, dev_folder: Path = _DEV, ioctl: Ioctl | None = None
) -> list[Camera]:
    """Return the connected cameras, by number.

    Parameters
    ----------
    sys_folder, dev_folder
        Folders of the kernel's entries of video devices, and of their device files.
    ioctl
        Queries a device; by default the system's `ioctl`.
    """
    if not sys.platform.startswith("linux"):
        return list(_by_number())
    ask = ioctl or _system_ioctl()
    nodes = [path for path in sys_folder.glob("video*") if path.name[5:].isdecimal()]
    cameras = (_asked(path, dev_folder, ask) for path in nodes)
    return sorted(filter(None, cameras), key=lambda camera: camera.number)


def named_cameras() -> list[Camera]:
    """Return the connected cameras; none on a system that does not name them."""
    return list_cameras() if sys.platform.startswith("linux") else []


def the_camera(source: str, cameras: Iterable[Camera]) -> Camera:
    """Return the camera that a source names.

    Raises
    ------
    CaptureError
        No camera or several have that name; the message lists the available names.
    """
    each = list(cameras)
    found = [camera for camera in each if camera.name_in(source)]
    if len(found) == 1:
        return found[0]
    if not found:
        there = ", ".join(map(str, each)) or "none that has one"
        raise CaptureError(f"no camera has that name; plugged in: {there}")
    others = ", ".join(f'"{camera.links[0]}"' if camera.links else str(camera) for camera in found)
    raise CaptureError(f"{len(found)} cameras have that name; name one as {others}")


def _system_ioctl() -> Ioctl:
    from fcntl import ioctl  # Unix alone has it

    return ioctl


def _asked(node: Path, dev_folder: Path, ioctl: Ioctl) -> Camera | None:
    """Query a video device; None if it is not a camera, such as one for metadata or a codec."""
    number, name, links = int(node.name[5:]), _name(node), _links(node.name, dev_folder)
    try:
        descriptor = os.open(dev_folder / node.name, os.O_RDWR | os.O_NONBLOCK)
    except OSError as error:
        hint = "; join the group video" if error.errno == errno.EACCES else ""
        trouble = f"cannot be opened: {error.strerror}{hint}"
        return Camera(number, name, trouble=trouble, links=links)
    try:
        if not _captures(descriptor, ioctl):
            return None
        found = {(m.fourcc, m.width, m.height): m for m in _modes(descriptor, ioctl)}
    except OSError as error:
        return Camera(number, name, trouble=f"cannot be asked: {error.strerror}", links=links)
    finally:
        os.close(descriptor)
    modes = sorted(found.values(), key=lambda mode: (-mode.width * mode.height, mode.fourcc))
    return Camera(number, name, modes, links=links)


def _links(node: str, dev_folder: Path) -> list[str]:
    """Return the names by which udev links a video device."""
    links = (link for kind in _LINKS for link in sorted((dev_folder / kind).glob("*")))
    return [link.name for link in links if link.resolve().name == node]


def _name(node: Path) -> str:
    try:
        name = (node / "name").read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""
    return "".join(character for character in name if character.isprintable())


def _captures(descriptor: int, ioctl: Ioctl) -> bool:
    buffer = bytearray(_CAPABILITY.size)
    ioctl(descriptor, _QUERY_CAPABILITY, buffer)
    *_, every, own = _CAPABILITY.unpack(buffer)
    return bool((own if every & _HAS_DEVICE_CAPABILITIES else every) & _CAPTURES)


def _enumerated(
    descriptor: int, ioctl: Ioctl, request: int, entry: struct.Struct, *key: object
) -> Iterator[tuple[Any, ...]]:
    """Yield the entries of an enumeration, which the kernel ends with an error."""
    for index in range(_MOST_ENTRIES):
        empty = entry.unpack(bytes(entry.size))
        buffer = bytearray(entry.pack(index, *key, *empty[1 + len(key) :]))
        try:
            ioctl(descriptor, request, buffer)
        except OSError as error:
            if error.errno in (errno.EINVAL, errno.ENOTTY):
                return
            raise
        yield entry.unpack(buffer)


def _modes(descriptor: int, ioctl: Ioctl) -> Iterator[Mode]:
    formats = _enumerated(descriptor, ioctl, _ENUM_FORMATS, _FORMAT, _BUFFER_CAPTURE)
    for *_, code in list(formats):
        sizes = _enumerated(descriptor, ioctl, _ENUM_FRAME_SIZES, _FRAME_SIZE, code)
        for _, _, kind, *sides in list(sizes):
            # A range of sizes: least width, greatest width, step, and likewise for the height.
            width, height = sides[:2] if kind == _DISCRETE else (sides[1], sides[4])
            fps = _highest_rate(descriptor, ioctl, code, width, height)
            yield Mode(code.decode("latin-1").strip("\0 "), width, height, fps)
            if kind != _DISCRETE:
                break


def _highest_rate(descriptor: int, ioctl: Ioctl, code: bytes, width: int, height: int) -> float:
    """Highest number of frames a second; 0 if unknown."""
    entries = _enumerated(descriptor, ioctl, _ENUM_INTERVALS, _INTERVAL, code, width, height)
    # An interval is a fraction of seconds; the first of a range is the shortest.
    shortest = [(entry[5], entry[6]) for entry in entries]
    return max((below / above for above, below in shortest if above), default=0.0)


def _by_number() -> Iterator[Camera]:
    import cv2

    for number in range(_MOST_NUMBERS):
        capture = cv2.VideoCapture(number)
        try:
            if not capture.isOpened():
                return
            width, height, fps = (
                capture.get(prop)
                for prop in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT, cv2.CAP_PROP_FPS)
            )
            yield Camera(number, modes=[Mode("", int(width), int(height), max(fps, 0.0))])
        finally:
            capture.release()
