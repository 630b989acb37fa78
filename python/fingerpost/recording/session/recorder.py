"""Records a session in parallel with the main loop, in a separate thread with a bounded queue.

With live sources, steps for which the queue has no room are dropped and counted, so that tracking
does not depend on the disk. Recorded sources wait. Data are written to the disk twice a second, so
that a crash costs less than a second.
"""

from __future__ import annotations

import contextlib
import logging
import queue
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from enum import Enum
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeVar

import msgspec
import numpy as np
from mcap.writer import Writer
from mcap_protobuf.schema import register_schema
from numpy.typing import NDArray

from fingerpost.errors import InvalidInputError, RecordingError
from fingerpost.lens import Lens
from fingerpost.mcap_file import (
    END_NAME,
    FIX_TOPIC,
    FRAMES_TOPIC,
    METADATA_NAME,
    PLANE_TOPIC,
    RIG_NAME,
    TARGETS_TOPIC,
    About,
    Captured,
    TargetProbabilities,
    Together,
    annotations_topic,
    calibration_topic,
    image_topic,
    track_topic,
)
from fingerpost.pointing import Fix
from fingerpost.recording.interrupts import uninterrupted
from fingerpost.recording.session.messages import (
    calibration,
    compressed_image,
    drawn_over,
    plane_scene,
    pose_in,
)
from fingerpost.recording.session.recordable import RecordableStep, Seen
from fingerpost.recording.session.stream import RecordingStream
from fingerpost.recording.tables import PointRow, TrackRow

_log = logging.getLogger(__name__)

_FLUSH_S = 0.5
_WAITING = 32
"""Greatest number of queued entries: about half a second of frames and steps."""

_JPEG_QUALITY = 95
_JPEG = b"\xff\xd8"


class Images(Enum):
    """Format of images that were not received as JPEG or PNG."""

    PNG = "png"
    """Lossless."""
    JPEG = "jpeg"
    """JPEG of quality 95: ten times as fast, and a fifth of the size."""


Together_ = TypeVar("Together_", bound=Sequence[Seen | None])


class Recorder:
    """Writes a recording; a context manager, which completes the file.

    Parameters
    ----------
    path
        The file; it must not exist.
    about
        Description of the recording.
    rig_text
        The rig, with the recording's views as sources, as TOML.
    lenses
        Lenses of the views, if known.
    images
        Format of images that were not received as JPEG or PNG.
    clock
        Returns a monotonic time [s].

    Raises
    ------
    InvalidInputError
        The file exists or cannot be created.
    RecordingError
        The disk is full from the beginning; no file is left.
    """

    def __init__(
        self,
        path: Path,
        about: About,
        rig_text: str,
        lenses: Sequence[Lens | None],
        *,
        images: Images,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._stream = RecordingStream(path)
        self._about, self._lenses, self._images = about, lenses, images
        self._clock = clock
        self._epoch_ns = time.time_ns() - time.monotonic_ns() if about.is_live else 0
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._calibrated: set[str] = set()
        self._writer: Any = Writer(self._stream)  # type: ignore[arg-type]
        self._queue: queue.Queue[Callable[[], None] | None] = queue.Queue(_WAITING)
        # Also filled by signal handlers, which must not wait for a lock of the code that they
        # interrupt.
        self._rows: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._steps = self._taken = 0
        self._dropped = 0
        self._failure: RecordingError | None = None
        self._begin(rig_text)
        self._thread = threading.Thread(target=self._run, name=f"recorder {path}", daemon=True)
        self._thread.start()

    def watch(self, frames: Iterable[Together_]) -> Iterator[Together_]:
        """Pass on and record the frames of all views.

        Raises
        ------
        RecordingError
            The file cannot be written any more, for instance because the disk is full.
        """
        for seen in frames:
            step, self._steps = self._steps, self._steps + 1
            self._put(lambda step=step, seen=seen: self._write_frames(step, seen))  # type: ignore[misc]
            yield seen

    def take(self, step: RecordableStep) -> None:
        """Record a step.

        Raises
        ------
        RecordingError
            As `watch`.
        """
        self._taken += 1
        self._put(lambda: self._write_step(step))

    def add_row(self, topic: str, row: object, time_s: float, step: int = 0) -> None:
        """Record additional data, such as a command to a robot; never waits.

        It may be called from any thread, and from a signal handler.

        Parameters
        ----------
        topic
            Its topic.
        row
            A dataclass of numbers, strings and None.
        time_s
            Time on the clock of the frames [s].
        step
            Number of the step that it belongs to, if any.
        """
        self._rows.put(lambda: self._write_json(topic, type(row), row, self._ns(time_s), step))

    def add_pose(
        self,
        topic: str,
        frame: str,
        position_m: Iterable[float],
        orientation: Iterable[float],
        time_s: float,
        step: int = 0,
    ) -> None:
        """Record a pose in a frame: position x, y, z [m], quaternion x, y, z, w; as `add_row`."""
        time_ns = self._ns(time_s)
        message = pose_in(frame, time_ns, position_m, orientation)
        self._rows.put(lambda: self._write_message(topic, message, time_ns, step))

    def notes(self) -> list[str]:
        """Return remarks on the recording for the user; none if it is complete."""
        if not self._dropped:
            return []
        return [
            f"{self._stream.path}: {self._dropped} of {self._steps} steps were dropped: "
            "the disk or the processor was too slow"
        ]

    def close(self) -> None:
        """Write queued entries and complete the file; closing twice does nothing.

        Raises
        ------
        RecordingError
            As `watch`.
        """
        if self._writer is None:
            return
        with uninterrupted():
            while self._thread.is_alive():
                with contextlib.suppress(queue.Full):
                    self._queue.put(None, timeout=_FLUSH_S)
                    break
            self._thread.join()
            self._stream.close()
            self._writer = None
        self._refuse_if_failed()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            self.close()
        finally:
            # If the first frame is refused, no file is left.
            if isinstance(error, InvalidInputError) and self._steps <= 1 and not self._taken:
                self._stream.path.unlink(missing_ok=True)

    def _put(self, entry: Callable[[], None]) -> None:
        while True:
            self._refuse_if_failed()
            try:
                self._queue.put(entry, block=not self._about.is_live, timeout=_FLUSH_S)
            except queue.Full:
                if self._about.is_live:
                    self._drop()
                    return
            else:
                return

    def _drop(self) -> None:
        if not self._dropped:
            _log.warning("%s: recording is too slow: frames are dropped", self._stream.path)
        self._dropped += 1

    def _refuse_if_failed(self) -> None:
        if self._failure is not None:
            failure, self._failure = self._failure, None
            raise failure

    # --- in the recorder's thread -------------------------------------------------------------

    def _run(self) -> None:
        try:
            self._write_until_closed()
            self._writer.add_metadata(END_NAME, {"dropped": str(self._dropped)})
            self._writer.finish()
            self._stream.flush()
        except RecordingError as error:
            self._failure = error
        except Exception as error:
            self._failure = RecordingError(f"{self._stream.path}: cannot be recorded: {error!r}")

    def _write_until_closed(self) -> None:
        due_s = self._clock() + _FLUSH_S
        while True:
            with contextlib.suppress(queue.Empty):
                entry = self._queue.get(timeout=max(due_s - self._clock(), 0.0))
                self._write_rows()
                if entry is None:
                    return
                entry()
            if self._clock() >= due_s:
                self._write_rows()
                self._writer.flush()
                due_s = self._clock() + _FLUSH_S

    def _write_rows(self) -> None:
        while not self._rows.empty():
            self._rows.get()()

    def _begin(self, rig_text: str) -> None:
        try:
            self._writer.start(library=f"fingerpost {self._about.version}")
            self._writer.add_metadata(METADATA_NAME, self._about.metadata())
            self._writer.add_attachment(0, 0, RIG_NAME, "application/toml", rig_text.encode())
            self._writer.flush()
        except RecordingError:
            self._stream.discard()
            raise

    def _write_frames(self, step: int, frames: Sequence[Seen | None]) -> None:
        log_ns = self._time_ns(next(seen for seen in frames if seen is not None))
        for view, lens, seen in zip(self._about.views, self._lenses, frames, strict=True):
            image = getattr(seen, "image", None)
            if seen is None or image is None:
                continue
            data = getattr(seen, "encoded", b"") or _encoded(image, self._images)
            kind = "jpeg" if data.startswith(_JPEG) else "png"
            time_ns = self._time_ns(seen)
            if view not in self._calibrated:
                self._calibrated.add(view)
                size_px = image.shape[1], image.shape[0]
                camera = calibration(view, time_ns, size_px, lens)
                self._write_message(calibration_topic(view), camera, log_ns, step)
            message = compressed_image(view, time_ns, data, kind)
            self._write_message(image_topic(view), message, log_ns, step)
        together = Together(
            step, tuple(None if seen is None else _captured(seen) for seen in frames)
        )
        self._write_json(FRAMES_TOPIC, Together, together, log_ns, step)

    def _write_step(self, step: RecordableStep) -> None:
        row = step.point_row()
        log_ns = self._ns(row.time_s)
        for k, observed in enumerate(step.observations):
            if (track := observed.track_row()) is not None:
                self._write_json(track_topic(observed.view), TrackRow, track, log_ns, row.frame)
            if observed.frame is None or observed.plane_view is None:
                continue
            message = drawn_over(
                observed,
                k,
                self._time_ns(observed.frame),  # type: ignore[arg-type]
                observed.plane_view,
                observed.reduction.whole_from_reduced,
            )
            self._write_message(annotations_topic(observed.view), message, log_ns, row.frame)
        self._write_json(FIX_TOPIC, PointRow, row, log_ns, row.frame)
        if step.fix.targets:
            pointed = _target_probabilities(step.fix, row)
            self._write_json(TARGETS_TOPIC, TargetProbabilities, pointed, log_ns, row.frame)
        plane_views = [observed.plane_view for observed in step.observations]
        if plane_views and plane_views[0] is not None:
            scene = plane_scene(step.fix, plane_views[0], log_ns)
            self._write_message(PLANE_TOPIC, scene, log_ns, row.frame)

    def _time_ns(self, seen: Seen) -> int:
        return self._ns(seen.time_s)

    def _ns(self, time_s: float) -> int:
        """Return a time in the file's format: since 1970 for live sources, never below 0."""
        return max(0, self._epoch_ns + round(time_s * 1e9))

    def _write_message(self, topic: str, message: Any, log_ns: int, sequence: int) -> None:
        if topic not in self._channels:
            name = message.DESCRIPTOR.full_name
            if name not in self._schemas:
                self._schemas[name] = register_schema(self._writer, type(message))
            self._register(topic, "protobuf", name)
        self._add(topic, message.SerializeToString(), log_ns, sequence)

    def _write_json(
        self, topic: str, kind: type, message: object, log_ns: int, sequence: int
    ) -> None:
        if topic not in self._channels:
            name = f"fingerpost.{kind.__name__}"
            if name not in self._schemas:
                schema = msgspec.json.encode(_inlined(msgspec.json.schema(kind)))
                self._schemas[name] = self._writer.register_schema(name, "jsonschema", schema)
            self._register(topic, "json", name)
        self._add(topic, msgspec.json.encode(message), log_ns, sequence)

    def _register(self, topic: str, encoding: str, schema: str) -> None:
        self._channels[topic] = self._writer.register_channel(
            topic, encoding, self._schemas[schema]
        )

    def _add(self, topic: str, data: bytes, log_ns: int, sequence: int) -> None:
        self._writer.add_message(
            self._channels[topic], log_ns, data, publish_time=log_ns, sequence=sequence
        )


def _target_probabilities(fix: Fix, row: PointRow) -> TargetProbabilities:
    named = {name: share for name, share in fix.targets.items() if name is not None}
    return TargetProbabilities(row.frame, row.time_s, fix.target, named, fix.targets.get(None, 0.0))


def _captured(seen: Seen) -> Captured:
    return Captured(seen.index, seen.time_s, getattr(seen, "why", ""))


def _encoded(image: NDArray[np.uint8], images: Images) -> bytes:
    import cv2

    if images is Images.JPEG:
        options = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
    else:
        # A third of the defaults' time for the same size; older versions have no filter options.
        options = [cv2.IMWRITE_PNG_COMPRESSION, 1]
        if hasattr(cv2, "IMWRITE_PNG_FILTER"):
            options += [cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_UP]
    done, data = cv2.imencode(f".{images.value}", image, options)
    if not done:
        raise RecordingError(f"an image of shape {image.shape} cannot be encoded")
    return data.tobytes()


def _inlined(schema: dict[str, Any]) -> dict[str, Any]:
    """Return a JSON schema whose root is the message itself, as viewers require."""
    definitions = schema.pop("$defs", {})
    root = schema.pop("$ref", "").rpartition("/")[2]
    return {**definitions.pop(root, schema), **({"$defs": definitions} if definitions else {})}
