"""Opens the `source` of a rig file as a `Source`."""

from __future__ import annotations

import glob
import math
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path

from fingerpost.capture import over_zenoh
from fingerpost.capture.devices import named_cameras, the_camera
from fingerpost.capture.images import (
    ImageSequence,
    JpegFilm,
    PictureStack,
    is_motion_jpeg,
    natural_order,
    picture_count,
)
from fingerpost.capture.live import Device, LiveSource, connected
from fingerpost.capture.raw import STDIN, raw_format
from fingerpost.capture.settings import CameraSettings, Reading
from fingerpost.capture.source import Source
from fingerpost.capture.url import is_url, masked
from fingerpost.capture.video import VideoFile
from fingerpost.checks import opencv_path
from fingerpost.errors import CaptureError, InvalidInputError, SourceError

DEFAULT_FPS = 25.0
"""Frame rate of recordings that state none: still images and videos without times [1/s]."""

STILL_FRAMES = 25
"""Number of times a single still image is repeated: a tracker needs a few frames to confirm a
hand."""

DEFAULT_TIMEOUT_S = 5.0
"""Time limit for a live source to open, and to deliver its next frame [s]."""

_RECORDING = ".mcap"


def open_source(
    source: str | int,
    *,
    camera: CameraSettings | None = None,
    fps: float = DEFAULT_FPS,
    timeout_s: float = DEFAULT_TIMEOUT_S,
    clock: Callable[[], int] = time.monotonic_ns,
) -> Source:
    """Open a view's source.

    Parameters
    ----------
    source
        A video file, an animation or a TIFF of several pages, one still image (repeated
        `STILL_FRAMES` times), a glob of still images (`left/*.png`, in natural order: 2 before
        10), a camera number, a camera's name if there is no such file (Linux), a camera device
        (`/dev/video0`), a named pipe, or a URL (`http://`, `https://`, `rtsp://`, ...), which is
        live unless a web server declares it a film; or `-` for raw frames on standard input
        (`fingerpost.capture.raw`), which are live as well. A view of a recording is
        `session.mcap#left`, a camera on another machine `zenoh://HOST:PORT/KEY/NAME`.
    camera
        Requested camera settings, or the format of the raw frames on a pipe.
    fps
        Frames per second of still images and of videos whose file states no rate, > 0.
    timeout_s
        Time limit for a live source to open, and to deliver its next frame [s], > 0.
    clock
        Returns the time [ns]; used to stamp live frames.

    Returns
    -------
    Source
        To be closed by the caller, preferably by a `with` statement.

    Raises
    ------
    SourceError
        The source does not exist, cannot be opened, or holds no frame.
    InvalidInputError
        An argument is not as described above, or a file that OpenCV must open by name has a name
        that is not UTF-8 or that this locale cannot represent.
    """
    try:
        opened = _opened(source, camera, fps, timeout_s, clock)
    except CaptureError as error:
        raise SourceError(str(error)) from error
    if camera is not None and not isinstance(opened, LiveSource):
        opened.close()
        raise SourceError(f"{opened.name}: camera = {{ ... }} is for cameras and pipes, not for it")
    return opened


def _opened(
    source: str | int,
    camera: CameraSettings | None,
    fps: float,
    timeout_s: float,
    clock: Callable[[], int],
) -> Source:
    for name, value in (("fps", fps), ("timeout_s", timeout_s)):
        if not (math.isfinite(value) and value > 0):
            raise InvalidInputError(f"{name} = {value}: must be a finite number above 0")
    if isinstance(source, int):
        if isinstance(source, bool) or source < 0:
            raise InvalidInputError(f"camera {source}: cameras are numbered 0, 1, 2, ...")
        return LiveSource(source, timeout_s=timeout_s, clock=clock, camera=camera)
    if not source or "\0" in source:
        raise InvalidInputError(f"source {source!r}: must name a file, a glob, a camera or a URL")
    if source == STDIN:
        raw_format(camera)
        return LiveSource(source, timeout_s=timeout_s, clock=clock, camera=camera)
    if is_url(source):
        if camera is not None:
            raise InvalidInputError(
                f"{masked(source)}: camera = {{ ... }} is for cameras and pipes; set a network "
                "camera where it is"
            )
        if source.startswith(over_zenoh.SCHEME):
            over_zenoh.parts_of(source)
            connect = partial(_remote_camera, clock=clock)
            return LiveSource(source, timeout_s=timeout_s, clock=clock, connect=connect)
        if source.startswith("file:"):
            raise InvalidInputError(f"{source}: give the file's path instead of a file: URL")
        # Modules of the web take a quarter of a command's start, and few sources need them.
        from fingerpost.capture.remote import Remote, RemoteFilm, look_up

        if look_up(source, timeout_s) is Remote.FILM:
            return RemoteFilm(source, fps=fps, timeout_s=timeout_s)
        return LiveSource(source, timeout_s=timeout_s, clock=clock)

    try:
        os.fsencode(source)
    except UnicodeEncodeError as error:
        encoding = sys.getfilesystemencoding()
        raise InvalidInputError(
            f"{source}: file names are written in {encoding} here; a UTF-8 locale is right"
        ) from error
    if (in_recording := _view_of_recording(source)) is not None:
        from fingerpost.capture.recorded import RecordedView  # needs the extra mcap

        return RecordedView(*in_recording)
    path = Path(source)
    try:
        if path.is_fifo():
            raw_format(camera)
        if path.is_char_device() or path.is_fifo():
            return LiveSource(source, timeout_s=timeout_s, clock=clock, camera=camera)
        if path.is_dir():
            example = path / "*.png"
            raise CaptureError(f"{path}: is a folder; name the images in it, as in {example}")
        if path.is_file():
            return _open_file(path, fps)
        if path.exists():
            raise CaptureError(f"{path}: is no film, image, camera or pipe that can be read")
    except CaptureError:
        raise
    except OSError as error:
        raise CaptureError(f"{path}: {error.strerror}") from error
    if glob.has_magic(source) and (paths := _matching(source)):
        return ImageSequence(paths, fps=fps, name=source)
    return LiveSource(
        _name_of_camera(source),
        timeout_s=timeout_s,
        clock=clock,
        connect=partial(_camera_by_name, camera=camera),
        camera=camera,
    )


def _name_of_camera(source: str) -> str:
    """Return the camera name that a source without such a file contains."""
    try:
        return the_camera(source, named_cameras()).name_in(source)
    except CaptureError as error:
        files = "no file matches" if glob.has_magic(source) else "no such file"
        hint = "; a camera's number goes without quotes" if source.isdecimal() else f", and {error}"
        raise CaptureError(f"{source}: {files}{hint}") from None


def _camera_by_name(
    source: str | int, timeout_s: float, *, camera: CameraSettings | None
) -> Device:
    """Open a camera by its name: its number may change each time it is plugged in."""
    return connected(the_camera(str(source), named_cameras()).number, timeout_s, camera)


def _remote_camera(
    source: str | int, timeout_s: float, *, clock: Callable[[], int]
) -> over_zenoh.ZenohCamera:
    return over_zenoh.ZenohCamera(str(source), timeout_s, clock)


def _open_file(path: Path, fps: float) -> Source:
    import cv2

    with path.open("rb") as file:
        if not file.read(1):
            raise CaptureError(f"{path}: the file is empty; a video or an image is needed")
    if path.suffix.lower() == _RECORDING:
        from fingerpost.mcap_file import read_about

        views = " or ".join(f"{path}#{view}" for view in read_about(path)[0].views)
        raise CaptureError(f"{path}: is a recording; name one of its views: {views}")
    if is_motion_jpeg(path):
        return JpegFilm(path, fps=fps)
    if cv2.haveImageReader(opencv_path(path, "source")):
        if (count := picture_count(path)) > 1:
            return PictureStack(path, count, fps=fps)
        return ImageSequence([path] * STILL_FRAMES, fps=fps, name=str(path))
    return VideoFile(path, fps=fps)


def _view_of_recording(source: str) -> tuple[Path, str] | None:
    """Return file and view of a source such as `session.mcap#left`; None for any other."""
    name, mark, view = source.partition(f"{_RECORDING}#")
    return (Path(f"{name}{_RECORDING}"), view) if name and mark and view else None


def _matching(pattern: str) -> list[Path]:
    found = glob.glob(pattern, recursive=True)  # noqa: PTH207 - Path.glob takes no absolute one
    return sorted((p for p in map(Path, found) if not p.is_dir()), key=natural_order)


def source_files(source: str | int) -> list[Path]:
    """Return the files that `open_source` would read; none for a camera or a stream.

    A single name is returned whether or not the file exists.
    """
    if isinstance(source, int) or is_url(source) or source == STDIN:
        return []
    if (in_recording := _view_of_recording(source)) is not None:
        return [in_recording[0]]
    # Path.exists would raise for a name that is too long.
    if glob.has_magic(source) and not os.path.exists(source):  # noqa: PTH110
        return _matching(source)
    return [Path(source)]


@contextmanager
def open_views(
    sources: Mapping[str, str | int], readings: Sequence[Reading] = ()
) -> Iterator[list[Source]]:
    """Open the source of every view, and close all of them on exit.

    Parameters
    ----------
    sources
        Arguments of `open_source`, by view name.
    readings
        How each is read, in the same order; by default unchanged.

    Yields
    ------
    list of Source
        In the order of `sources`.

    Raises
    ------
    CaptureError
        As `open_source`.
    InvalidInputError
        As `open_source`, or two views read the same camera, stream or file.
    """
    refuse_repeated(sources)
    with ExitStack() as stack:
        opened = []
        each = readings or [Reading()] * len(sources)
        for source, reading in zip(sources.values(), each, strict=True):
            one = stack.enter_context(open_source(source, camera=reading.camera))
            one.offset_s, one.arrangement = reading.offset_s, reading.arrangement
            opened.append(one)
        yield opened


def refuse_repeated(sources: Mapping[str, str | int]) -> None:
    """Refuse views of which two read the same camera, stream or existing file, by any names.

    Parameters
    ----------
    sources
        Arguments of `open_source`, by view name.

    Raises
    ------
    InvalidInputError
        Two views share a source, or a file of it; both are named.
    """
    taken: dict[str | int, str] = {}
    for view, source in sources.items():
        for read in _what_is_read(source):
            other = taken.setdefault(read, view)
            if other != view:
                raise InvalidInputError(
                    f'views "{other}" and "{view}" both read {masked(read)}; each needs a source '
                    "of its own"
                )


_CAMERA_FILE = "/dev/video{}"
"""Device file of a numbered camera, on systems that have such files."""


def _what_is_read(source: str | int) -> list[str | int]:
    """Return canonical names of the devices and existing files that a source reads.

    A file that does not exist is refused when it is opened.
    """
    if isinstance(source, str) and (is_url(source) or source == STDIN):
        return [source]
    if isinstance(source, str) and (in_recording := _view_of_recording(source)) is not None:
        path, view = in_recording
        return [f"{os.path.realpath(path)}#{view}"]
    files = [] if isinstance(source, int) else source_files(source)
    # Path.exists would raise for a name that no file can have.
    existing = [os.path.realpath(path) for path in files if os.path.exists(path)]  # noqa: PTH110
    if existing:
        return [*existing]
    if (number := source if isinstance(source, int) else _number_of(source)) is None:
        return []
    file = _CAMERA_FILE.format(number)
    return [os.path.realpath(file) if os.path.exists(file) else number]  # noqa: PTH110


def is_camera_name(source: str) -> bool:
    """Return whether exactly one connected camera has this name."""
    return _number_of(source) is not None


def _number_of(name: str) -> int | None:
    """Return the number of the camera with a name; None if none or several have it."""
    try:
        return the_camera(name, named_cameras()).number
    except CaptureError:
        return None


def resolve_source(source: str | int, directory: Path) -> str | int:
    """Resolve a rig file's source relative to the rig's directory, for `open_source`.

    Camera numbers, URLs and absolute paths are returned unchanged.
    """
    if isinstance(source, int) or is_url(source) or source == STDIN:
        return source
    path = directory / source
    if _view_of_recording(source) is not None:
        return str(path)
    # Path.exists would raise for a name that is too long.
    if glob.has_magic(source) and not os.path.exists(path):  # noqa: PTH110
        return str(Path(glob.escape(str(directory))) / source)
    return str(path)


def source_relative_to(source: str | int, directory: Path) -> str | int:
    """Invert `resolve_source` for a rig file in `directory`, if the source lies below it.

    Any other source becomes an absolute path.
    """
    if isinstance(source, int) or is_url(source) or source == STDIN:
        return source
    path = Path(os.path.abspath(source))  # noqa: PTH100 - resolve() would follow links
    for base in (str(directory), glob.escape(str(directory))):
        below = Path(os.path.abspath(base))  # noqa: PTH100
        if path.is_relative_to(below):
            return str(path.relative_to(below))
    return str(path)
