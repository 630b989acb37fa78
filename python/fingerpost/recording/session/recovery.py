"""Recovery of a complete MCAP file from a truncated one of any program."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from mcap.writer import Writer

from fingerpost.errors import RecordingError, SourceError
from fingerpost.mcap_file import (
    Attachment,
    Channel,
    Header,
    McapRecord,
    Message,
    Metadata,
    Records,
    Schema,
)
from fingerpost.recording.session.stream import RecordingStream


@dataclass(frozen=True, slots=True)
class Recovered:
    """Result of a recovery.

    Attributes
    ----------
    messages
        Number of messages.
    duration_s
        Duration from the first log time to the last [s].
    wrong
        What was wrong with the file; empty if it was complete.
    """

    messages: int
    duration_s: float
    wrong: str


def recover(cut: Path, whole: Path) -> Recovered:
    """Write all readable contents of a file into a complete one.

    Parameters
    ----------
    cut
        An MCAP file that may be truncated at any byte.
    whole
        The file to write; it must not exist.

    Raises
    ------
    SourceError
        `cut` cannot be read, is not an MCAP file, or is truncated within its first record.
    InvalidInputError
        `whole` exists, or cannot be created.
    RecordingError
        `whole` cannot be written to its end; it is removed again.
    """
    with closing(Records(cut)) as records:
        copied = iter(records)
        header = next(copied, None)
        if not isinstance(header, Header):
            raise SourceError(f"{cut}: {records.wrong or 'has no header'}: nothing is left of it")
        with closing(RecordingStream(whole)) as stream:
            try:
                copy = _copied(header, copied, stream)
            except RecordingError:
                stream.discard()
                raise
    return Recovered(copy.messages, (copy.end_ns - copy.start_ns) / 1e9, records.wrong)


def _copied(header: Header, records: Iterator[McapRecord], stream: RecordingStream) -> _Copy:
    """Copy all records of a file into a stream, up to its index and onto the disk."""
    copy = _Copy(stream, header)
    for record in records:
        copy.add(record)
    copy.finish()
    stream.flush()
    return copy


class _Copy:
    """A file that receives the records of another; its schemas and channels are renumbered."""

    def __init__(self, stream: RecordingStream, header: Header) -> None:
        self.messages = self.start_ns = self.end_ns = 0
        self._writer = Writer(stream)  # type: ignore[arg-type]
        self._writer.start(header.profile, header.library)
        self._schemas: dict[int, int] = {0: 0}  # 0 stands for none
        self._channels: dict[int, int] = {}

    def add(self, record: McapRecord) -> None:
        if isinstance(record, Message) and record.channel_id in self._channels:
            self._add_message(record)
        elif isinstance(record, Schema) and record.id not in self._schemas:
            self._schemas[record.id] = self._writer.register_schema(
                record.name, record.encoding, record.data
            )
        elif isinstance(record, Channel) and record.id not in self._channels:
            self._channels[record.id] = self._writer.register_channel(
                record.topic,
                record.message_encoding,
                self._schemas.get(record.schema_id, 0),
                record.metadata,
            )
        elif isinstance(record, Metadata):
            self._writer.add_metadata(record.name, record.metadata)
        elif isinstance(record, Attachment):
            self._writer.add_attachment(
                record.create_time, record.log_time, record.name, record.media_type, record.data
            )

    def _add_message(self, message: Message) -> None:
        self._writer.add_message(
            self._channels[message.channel_id],
            message.log_time,
            message.data,
            publish_time=message.publish_time,
            sequence=message.sequence,
        )
        start_ns = self.start_ns if self.messages else message.log_time
        self.start_ns = min(start_ns, message.log_time)
        self.end_ns = max(self.end_ns, message.log_time)
        self.messages += 1

    def finish(self) -> None:
        self._writer.finish()  # type: ignore[no-untyped-call]
