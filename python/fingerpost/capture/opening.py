"""From what a rig file says under `source` to an open `Source`."""

from __future__ import annotations

import glob
import math
import os
import time
from collections.abc import Callable
from pathlib import Path

from fingerpost.capture.images import ImageSequence, natural_order
from fingerpost.capture.live import LiveSource
from fingerpost.capture.source import Source
from fingerpost.capture.video import VideoFile
from fingerpost.errors import CaptureError, InvalidInputError

DEFAULT_FPS = 25.0
"""Frame rate of recordings that state none: still images, and videos without times."""

STILL_FRAMES = 25
"""How often a single still image is shown: a tracker needs a few frames to settle on a hand."""

DEFAULT_TIMEOUT_S = 5.0
"""How long a live source may take to open, and to deliver its next frame."""


def open_source(
    source: str | int,
    *,
    fps: float = DEFAULT_FPS,
    timeout_s: float = DEFAULT_TIMEOUT_S,
    clock: Callable[[], int] = time.monotonic_ns,
) -> Source:
    """Open a view's source.

    Parameters
    ----------
    source
        A video file, one still image (shown `STILL_FRAMES` times), a glob of still images
        (`left/*.png`, taken in natural order: 2 before 10), a camera number, a camera device
        (`/dev/video0`), or a URL (`http://`, `https://`, `rtsp://`, ...), which is always taken as
        live.
    fps
        Frames per second of still images and of videos whose file states no rate, > 0.
    timeout_s
        How long a live source may take to open, and to deliver its next frame, > 0.
    clock
        Gives the time in nanoseconds; live frames are stamped with it.

    Returns
    -------
    Source
        To be closed by the caller, best in a `with` statement.

    Raises
    ------
    CaptureError
        The source does not exist, cannot be opened, or holds no frame.
    InvalidInputError
        An argument is not of the kind described above.
    """
    for name, value in (("fps", fps), ("timeout_s", timeout_s)):
        if not (math.isfinite(value) and value > 0):
            raise InvalidInputError(f"{name} = {value}: must be a finite number above 0")
    if isinstance(source, int):
        if isinstance(source, bool) or source < 0:
            raise InvalidInputError(f"camera {source}: cameras are numbered 0, 1, 2, ...")
        return LiveSource(source, timeout_s=timeout_s, clock=clock)
    if not source or "\0" in source:
        raise InvalidInputError(
            f"source {source!r}: must name a file, a glob, a camera number or a URL"
        )
    if _is_url(source):
        if source.startswith("file:"):
            raise InvalidInputError(f"{source}: give the file's path instead of a file: URL")
        return LiveSource(source, timeout_s=timeout_s, clock=clock)

    path = Path(source)
    try:
        if path.is_char_device():
            return LiveSource(source, timeout_s=timeout_s, clock=clock)
        if path.is_dir():
            example = path / "*.png"
            raise CaptureError(f"{path}: is a folder; name the images in it, as in {example}")
        if path.exists():
            return _open_file(path, fps)
    except CaptureError:
        raise
    except OSError as error:
        raise CaptureError(f"{path}: {error.strerror}") from error
    if glob.has_magic(source):
        paths = _matching(source)
        if not paths:
            raise CaptureError(f"{source}: no file matches")
        return ImageSequence(paths, fps=fps, name=source)
    hint = "; a camera's number goes without quotes" if source.isdecimal() else ""
    raise CaptureError(f"{source}: no such file{hint}")


def _open_file(path: Path, fps: float) -> Source:
    import cv2

    with path.open("rb") as file:
        if not file.read(1):
            raise CaptureError(f"{path}: the file is empty; a video or an image is needed")
    if cv2.haveImageReader(str(path)):
        return ImageSequence([path] * STILL_FRAMES, fps=fps, name=str(path))
    return VideoFile(path, fps=fps)


def _matching(pattern: str) -> list[Path]:
    found = glob.glob(pattern, recursive=True)  # noqa: PTH207 - Path.glob takes no absolute one
    return sorted((p for p in map(Path, found) if not p.is_dir()), key=natural_order)


def source_files(source: str | int) -> list[Path]:
    """Return the files that `open_source` would read; none of a camera or a stream.

    A single name is returned whether there is such a file or not.
    """
    if isinstance(source, int) or _is_url(source):
        return []
    # Path.exists would raise where a name is too long to exist.
    if glob.has_magic(source) and not os.path.exists(source):  # noqa: PTH110
        return _matching(source)
    return [Path(source)]


def _is_url(source: str) -> bool:
    return "://" in source


def resolve_source(source: str | int, directory: Path) -> str | int:
    """Return a rig file's source as `open_source` takes it: relative to the rig's directory.

    Camera numbers, URLs and absolute paths stay as they are.
    """
    if isinstance(source, int) or _is_url(source):
        return source
    path = directory / source
    # Path.exists would raise where a name is too long to exist.
    if glob.has_magic(source) and not os.path.exists(path):  # noqa: PTH110
        return str(Path(glob.escape(str(directory))) / source)
    return str(path)


def source_relative_to(source: str | int, directory: Path) -> str | int:
    """Undo `resolve_source` for a rig file in `directory`, where the source lies below it.

    A source elsewhere becomes an absolute path, so that it is found from anywhere.
    """
    if isinstance(source, int) or _is_url(source):
        return source
    path = Path(os.path.abspath(source))  # noqa: PTH100 - resolve() would follow links
    for base in (str(directory), glob.escape(str(directory))):
        below = Path(os.path.abspath(base))  # noqa: PTH100
        if path.is_relative_to(below):
            return str(path.relative_to(below))
    return str(path)
