"""Writes a simulated recording to disk: pictures, rig file and ground truth."""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Literal, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from fingerpost.checks import opencv_path
from fingerpost.errors import CaptureError, InvalidInputError
from fingerpost.simulate import checks
from fingerpost.simulate.camera import Camera
from fingerpost.simulate.device import PointingDevice
from fingerpost.simulate.motion import Motion
from fingerpost.simulate.rig import SimulatedRig
from fingerpost.simulate.truth import FrameTruth, StartError, StartPose

Array = NDArray[np.float64]
Picture = NDArray[Any]
PictureFormat = Literal["png", "jpg", "mp4"]


def write_recording(
    directory: str | Path,
    rig: SimulatedRig,
    motion: Motion,
    *,
    frames: int,
    fps: float = 30.0,
    rng: np.random.Generator | int = 0,
    picture_format: PictureFormat = "png",
    device: PointingDevice | None = None,
    others: Sequence[tuple[PointingDevice, Motion]] = (),
    start_time_s: float | None = 0.0,
    start_error: StartError | None = None,
    reference_noise_px: float = 0.0,
    with_lens: bool = True,
) -> Path:
    """Render a motion and write it as a directory that `fingerpost run` can read.

    The directory receives ``rig.toml``, the pictures of each view (``left/00000.png``, … or
    ``left.mp4``) and ``truth.csv`` with the columns ``frame,time_s,x,y``: the indicated point in mm
    at the rig's time, empty while a view does not show the whole finger.

    Parameters
    ----------
    directory
        The directory; created if necessary. Files of a previous recording are overwritten.
    rig, motion, device, others
        As for `SimulatedRig.render`.
    frames, fps
        Number of frames, 1 to 100,000, and frames per second, 0.1 to 1000.
    rng
        Source of all randomness, or its seed.
    picture_format
        ``png`` is exact; ``jpg`` and ``mp4`` are smaller and lossy.
    start_time_s
        Time of the hand's poses that become start poses in the rig file; None omits them.
    start_error
        Their error.
    reference_noise_px
        Sigma of the reference points in the rig file, in u and in v [px], 0 to 20.
    with_lens
        Whether the rig file gives the lens of views that distort.

    Returns
    -------
    pathlib.Path
        The rig file.

    Raises
    ------
    InvalidInputError
        A value out of range, a start at a time when a view does not show the finger, or a video in
        a folder whose name cannot be passed to OpenCV.
    OSError
        A file cannot be written; `CaptureError` for a video.
    """
    checks.whole("frames", frames, 1, 100_000)
    checks.number("fps", fps, 0.1, 1000)
    checks.choice("picture_format", picture_format, ("png", "jpg", "mp4"))
    checks.number("reference_noise_px", reference_noise_px, 0, 20)
    draw = checks.generator("rng", rng)
    folder = Path(directory)
    folder.mkdir(parents=True, exist_ok=True)

    starts: list[StartPose | None] = [None] * len(rig.cameras)
    if start_time_s is not None:
        truth = rig.truth(motion, time_s=start_time_s, device=device)
        starts = [_start(truth, i, start_error, draw) for i in range(len(rig.cameras))]
    noise = draw.normal(0, reference_noise_px, (len(rig.cameras), len(rig.plane_points), 2))
    views = [
        _view_toml(camera, rig.reference_points_px[i] + noise[i], start, picture_format, with_lens)
        for i, (camera, start) in enumerate(zip(rig.cameras, starts, strict=True))
    ]
    rig_file = folder / "rig.toml"
    rig_file.write_text("\n".join([_plane_toml(rig.plane_points), *views]), encoding="utf-8")

    rows = ["frame,time_s,x,y"]
    with ExitStack() as stack:
        writers = [
            stack.enter_context(_writer(folder, camera, picture_format, fps))
            for camera in rig.cameras
        ]
        for index in range(frames):
            frame = rig.render(motion, time_s=index / fps, rng=draw, device=device, others=others)
            for writer, image in zip(writers, frame.images, strict=True):
                writer.write(index, image)
            rows.append(_truth_row(index, frame.truth))
    (folder / "truth.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    return rig_file


class _PictureWriter(Protocol):
    def write(self, index: int, image: Picture) -> None: ...


class _SequenceWriter:
    """One file per picture."""

    def __init__(self, folder: Path, suffix: str) -> None:
        folder.mkdir(exist_ok=True)
        self._folder, self._suffix = folder, suffix

    def write(self, index: int, image: Picture) -> None:
        encoded, data = cv2.imencode(f".{self._suffix}", image)
        path = self._folder / f"{index:05d}.{self._suffix}"
        if not encoded:
            raise CaptureError(f"{path}: OpenCV cannot encode it")
        path.write_bytes(data.tobytes())


class _VideoWriter:
    """One video file, MPEG-4."""

    def __init__(self, path: Path, camera: Camera, fps: float) -> None:
        size = (camera.width_px, camera.height_px)
        name = opencv_path(path, "video")
        self._video = cv2.VideoWriter(name, cv2.VideoWriter.fourcc(*"mp4v"), fps, size)
        if not self._video.isOpened():
            raise CaptureError(f"{path}: OpenCV cannot write this video; choose png or jpg")

    def write(self, index: int, image: Picture) -> None:  # noqa: ARG002
        colour = image if image.ndim == 3 else cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
        self._video.write(colour)

    def close(self) -> None:
        self._video.release()


@contextmanager
def _writer(
    folder: Path, camera: Camera, picture_format: PictureFormat, fps: float
) -> Iterator[_PictureWriter]:
    if picture_format != "mp4":
        yield _SequenceWriter(folder / camera.name, picture_format)
        return
    video = _VideoWriter(folder / f"{camera.name}.mp4", camera, fps)
    try:
        yield video
    finally:
        video.close()


def _start(
    truth: FrameTruth, view: int, error: StartError | None, rng: np.random.Generator
) -> StartPose:
    finger = truth.views[view].finger
    if finger is None or not finger.in_view:
        raise InvalidInputError(
            f"start_time_s is {truth.time_s:g}; view {truth.views[view].name!r} does not show the "
            "whole finger then, choose a time at which it does, or None"
        )
    return finger.start(error, rng)


def _plane_toml(points_mm: Array) -> str:
    points = ", ".join(f"[{x:.10g}, {y:.10g}]" for x, y in points_mm)
    return f'# A simulated recording.\n[plane]\nunit = "mm"\npoints = [{points}]\n'


def _view_toml(
    camera: Camera,
    references_px: Array,
    start: StartPose | None,
    picture_format: PictureFormat,
    with_lens: bool,
) -> str:
    references = ", ".join(f"[{u:.6f}, {v:.6f}]" for u, v in references_px)
    source = f"{camera.name}/*.{picture_format}"
    if picture_format == "mp4":
        source = f"{camera.name}.mp4"
    lines = [
        "[[view]]",
        f'name = "{camera.name}"',
        f'source = "{source}"',
        f"reference_points_px = [{references}]",
        f"size_px = [{camera.width_px}, {camera.height_px}]",
    ]
    if with_lens and camera.k1 != 0:
        cx, cy = camera.principal_point_px
        f, k1 = camera.f_px, camera.k1
        lines.append(f"lens = {{ fx = {f:.6f}, fy = {f:.6f}, cx = {cx}, cy = {cy}, k1 = {k1} }}")
    if start is not None:
        lines += [
            "[view.start]",
            f"tip_px = [{start.tip_px[0]:.3f}, {start.tip_px[1]:.3f}]",
            f"angle_deg = {start.angle_deg:.3f}",
            f"length_px = {start.length_px:.3f}",
            f'thumb = "{start.thumb}"',
        ]
    return "\n".join(lines) + "\n"


def _truth_row(index: int, truth: FrameTruth) -> str:
    shown = all(view.finger is not None and view.finger.in_view for view in truth.views)
    if not shown or truth.indicated_mm is None:
        return f"{index},{truth.time_s:.6f},,"
    x, y = truth.indicated_mm
    return f"{index},{truth.time_s:.6f},{x:.6f},{y:.6f}"
