"""One view of a recording (MCAP) as a recorded source: `session.mcap#left`.

The frames have the index and time of their capture and are grouped into the original steps. Their
pixels are identical if the recording is lossless. A truncated recording yields all frames up to the
cut.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import msgspec

from fingerpost.capture.as_sent import decoded
from fingerpost.capture.source import UNDECODABLE, Frame, Loss, Source, SourceKind
from fingerpost.errors import CaptureError, SourceError
from fingerpost.mcap_file import (
    FRAMES_TOPIC,
    Captured,
    Channel,
    Message,
    Records,
    Together,
    image_data,
    image_topic,
    message_counts,
    read_about,
    read_summary,
)


class RecordedView(Source):
    """The frames of one view of a recording.

    Parameters
    ----------
    path
        The recording.
    view
        The view's name.

    Raises
    ------
    SourceError
        The file cannot be read, is not a recording of fingerpost, or has no such view.
    """

    kind = SourceKind.RECORDED

    def __init__(self, path: Path, view: str) -> None:
        super().__init__(f"{path}#{view}")
        about, _ = read_about(path)
        if view not in about.views:
            raise SourceError(f"{path}: has no view {view!r}; it has {', '.join(about.views)}")
        self.has_own_clock = not about.is_live
        self.recording = path.resolve()
        self._path = path
        self._view = view
        self._place_of_view = about.views.index(view)
        summary = read_summary(path)
        if summary is not None:
            self.frame_count = message_counts(summary).get(image_topic(view))
        self._wrong = ""
        self._start_s = 0.0
        self._entries = self._read()

    def begin_at(self, start_s: float) -> None:
        """Leave out the steps up to a time after the first one's; the file is read from there."""
        self._start_s = start_s

    def _next_frame(self) -> Frame | Loss:
        self.step, seen, data = next(self._entries)
        if seen.why:
            return Loss(seen.index, seen.time_s, seen.why)
        # Damage was checked at capture and is not checked again.
        image = decoded(data)
        if image is None:
            return Loss(seen.index, seen.time_s, UNDECODABLE)
        return Frame(seen.index, seen.time_s, image, data)

    def _read(self) -> Iterator[tuple[int, Captured, bytes]]:
        """Yield each step with an entry of the view, that entry, and its encoded picture."""
        records = Records(self._path, start_s=self._start_s)
        topics: dict[int, str] = {}
        step, data = -1, b""
        with closing(records):
            for record in records:
                if isinstance(record, Channel):
                    topics[record.id] = record.topic
                if not isinstance(record, Message):
                    continue
                topic = topics.get(record.channel_id)
                if topic == image_topic(self._view):
                    step, data = record.sequence, image_data(record.data)
                elif topic == FRAMES_TOPIC and (entry := self._entry(record.data)) is not None:
                    yield *entry, data if entry[0] == step else b""
        self._wrong = records.wrong

    @property
    def notes(self) -> tuple[str, ...]:
        """Further final remarks on the source, for people."""
        return (f"{self._path}: {self._wrong}",) if self._wrong else ()

    def _entry(self, message: bytes) -> tuple[int, Captured] | None:
        try:
            together = msgspec.json.decode(message, type=Together)
            seen = together.frames[self._place_of_view]
        except (msgspec.MsgspecError, IndexError) as error:
            raise CaptureError(f"{self.name}: a step cannot be understood: {error}") from error
        return None if seen is None else (together.step, seen)

    def close(self) -> None:
        """Close the file: no more frames will come."""
        self._entries.close()  # type: ignore[attr-defined]
