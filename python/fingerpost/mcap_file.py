"""MCAP files as recordings of fingerpost: their contents, and reading of truncated files.

A recording is an MCAP file (https://mcap.dev) of these parts, so that common viewers show it:

- an attachment `rig.toml`, the rig with the recording's views, and metadata `fingerpost`: version,
  views, sources of their frames;
- `/frames`, JSON: the frames captured together, with the exact index and time of each
  (`Together`). The message follows the images of its step; without it, the step is incomplete;
- `/VIEW/image`, foxglove.CompressedImage, whose bytes decode to the exact processed pixels if they
  were passed through or are PNG; `/VIEW/calibration`, foxglove.CameraCalibration;
- of a run that followed hands: `/VIEW/annotations`, foxglove.ImageAnnotations; `/VIEW/track` and
  `/fix`, JSON with the columns of the tables; `/plane`, foxglove.SceneUpdate in plane units;
  `/targets`, JSON (`TargetProbabilities`), if the rig has targets;
- of a run that guided an arm: `/robot/pose`, foxglove.PoseInFrame; `/robot/state` and
  `/robot/command`, JSON (`fingerpost.guidance.arm_recording`).

All messages of a step have one log time, and the step's number as their sequence; commands to an
arm have their own time. The library reads files from the index at their end, which is missing after
a crash. `Records` reads from the start up to the last valid byte, also within a truncated chunk.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

import msgspec

from fingerpost.errors import InvalidInputError, MissingExtraError, SourceError

try:
    import lz4.frame
    import zstandard
    from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
    from google.protobuf.message import DecodeError
    from mcap.data_stream import ReadDataStream
    from mcap.exceptions import McapError
    from mcap.opcode import Opcode
    from mcap.reader import make_reader
    from mcap.records import Attachment as Attachment
    from mcap.records import Channel as Channel
    from mcap.records import Header as Header
    from mcap.records import McapRecord as McapRecord
    from mcap.records import Message as Message
    from mcap.records import Metadata as Metadata
    from mcap.records import Schema as Schema
    from mcap.summary import Summary as Summary
except ImportError as error:
    raise MissingExtraError(
        f"recordings need what is not installed ({error}); install it with: "
        "pip install 'fingerpost[mcap]'"
    ) from error

MAGIC = b"\x89MCAP0\r\n"
FRAMES_TOPIC = "/frames"
FIX_TOPIC = "/fix"
PLANE_TOPIC = "/plane"
TARGETS_TOPIC = "/targets"
METADATA_NAME = "fingerpost"
END_NAME = "fingerpost/end"
RIG_NAME = "rig.toml"

_HEAD = struct.Struct("<BQ")
_CHUNK_HEAD = struct.Struct("<QQQII")  # start, end, size, CRC, length of the compression's name
_CHUNK_TIMES = struct.Struct("<QQ")  # its first fields: the first and the last log time
# Self-contained records; indices and statistics are recomputed when a file is written.
_KEPT: dict[int, type[McapRecord]] = {
    Opcode.HEADER: Header,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.MESSAGE: Message,
    Opcode.ATTACHMENT: Attachment,
    Opcode.METADATA: Metadata,
}
_LARGEST_CHUNK_BYTES = 1 << 31


def image_topic(view: str) -> str:
    """Return the topic of a view's images."""
    return f"/{view}/image"


def annotations_topic(view: str) -> str:
    """Return the topic of the annotations of a view's images."""
    return f"/{view}/annotations"


def calibration_topic(view: str) -> str:
    """Return the topic of a view's lens."""
    return f"/{view}/calibration"


def track_topic(view: str) -> str:
    """Return the topic of a view's rows of `tracks.csv`."""
    return f"/{view}/track"


def image_data(message: bytes) -> bytes:
    """Return the JPEG or PNG data of an image message; empty if it cannot be decoded."""
    try:
        return bytes(CompressedImage.FromString(message).data)
    except DecodeError:
        return b""


class Captured(msgspec.Struct, frozen=True, omit_defaults=True):
    """One view's frame of a step, or its loss.

    Attributes
    ----------
    index, time_s
        As in `fingerpost.capture.Frame`.
    why
        Why there is no image; empty if there is one.
    """

    index: int
    time_s: float
    why: str = ""


class Together(msgspec.Struct, frozen=True):
    """Frames captured together: a message of `/frames`.

    Attributes
    ----------
    step
        Counts from 0; dropped steps leave a gap.
    frames
        One per view, in their order; None if a view had none at that time.
    """

    step: int
    frames: tuple[Captured | None, ...]


class TargetProbabilities(msgspec.Struct, frozen=True):
    """At which target the hand points: a message of `/targets` for each fix with a point.

    Attributes
    ----------
    frame, time_s
        As in the fix.
    target
        The most probable target; None if it is more probable that there is none.
    probabilities
        Probability of each target, by name.
    none
        Probability that the hand points at no target.
    """

    frame: int
    time_s: float
    target: str | None
    probabilities: dict[str, float]
    none: float


class About(msgspec.Struct, frozen=True, kw_only=True):
    """Metadata of a recording.

    Attributes
    ----------
    version
        Version of fingerpost.
    views
        Names of the views, in the rig's order.
    sources
        Sources of the frames, in that order; secrets are masked.
    started
        Begin of the recording, ISO 8601.
    unit
        Unit of the plane.
    is_live
        Whether the frames came from cameras or streams.
    """

    version: str
    views: tuple[str, ...]
    sources: tuple[str, ...]
    started: str
    unit: str
    is_live: bool

    def metadata(self) -> dict[str, str]:
        """Return the metadata in the form that MCAP stores."""
        return {"about": msgspec.json.encode(self).decode()}

    @classmethod
    def of(cls, metadata: dict[str, str]) -> About:
        """Invert `metadata`; raises `msgspec.MsgspecError` or `KeyError`."""
        return msgspec.json.decode(metadata["about"], type=cls)


class Records:
    """The self-contained records of an MCAP file, in the order of the file.

    Iterate once. Records in chunks are included. Schemas and channels may be in a damaged chunk
    only: those of the index at the end follow such a chunk, so that later messages can be assigned.

    Parameters
    ----------
    path
        The file.
    start_s
        Messages whose log time is less than this after the first one's are left out [s]. A file
        with an index is read from there.

    Attributes
    ----------
    wrong
        After the iteration, a description of the file's damage; empty if it is complete.

    Raises
    ------
    SourceError
        The file cannot be read, or is no MCAP file.
    """

    def __init__(self, path: Path, *, start_s: float = 0.0) -> None:
        self.wrong = ""
        self._path = path
        self._start_ns = round(1e9 * start_s)
        try:
            self._size = path.stat().st_size
            self._file: BinaryIO = path.open("rb")
            start = self._file.read(len(MAGIC))
        except OSError as error:
            raise SourceError(f"{path}: {error.strerror}; a recording (MCAP) is needed") from error
        if start != MAGIC:
            self._file.close()
            kind = "is empty" if not start else "is no MCAP file"
            raise SourceError(f"{path}: {kind}; a recording as `fingerpost record` writes is right")

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __iter__(self) -> Iterator[McapRecord]:
        summary = read_summary(self._path) if self._start_ns else None
        if summary is None or summary.statistics is None:
            yield from self._later(self._from(0))
            return
        begin_ns = summary.statistics.message_start_time + self._start_ns
        yield from summary.schemas.values()
        yield from summary.channels.values()
        for record in self._from(begin_ns):
            if not isinstance(record, Message) or record.log_time >= begin_ns:
                yield record

    def _later(self, records: Iterator[McapRecord]) -> Iterator[McapRecord]:
        """Leave out the messages before the start, counted from the first message."""
        first_ns: int | None = None
        for record in records:
            if isinstance(record, Message):
                first_ns = record.log_time if first_ns is None else first_ns
                if record.log_time < first_ns + self._start_ns:
                    continue
            yield record

    def _from(self, begin_ns: int) -> Iterator[McapRecord]:
        """Yield all records but those of chunks that end before a log time."""
        with self._file:
            while (head := self._file.read(_HEAD.size)) and len(head) == _HEAD.size:
                opcode, length = _HEAD.unpack(head)
                place = self._file.tell()
                if opcode == Opcode.FOOTER:
                    self._judge_end(place + length)
                    return
                is_whole = place + length <= self._size
                if opcode == Opcode.CHUNK and is_whole and self._ends_before(begin_ns):
                    self._file.seek(place + length)
                elif opcode == Opcode.CHUNK:
                    yield from self._in_chunk(self._file.read(length), is_whole)
                elif opcode in _KEPT and is_whole:
                    yield from self._read(opcode, self._file.read(length))
                else:
                    self._file.seek(min(length, self._size), 1)
                if not is_whole:
                    break
            self.wrong = self.wrong or f"cut off at byte {self._size}"

    def _ends_before(self, begin_ns: int) -> bool:
        """Return whether the chunk at the present place has no message from a log time on."""
        head = self._file.read(_CHUNK_TIMES.size)
        self._file.seek(-len(head), 1)
        return len(head) == _CHUNK_TIMES.size and _CHUNK_TIMES.unpack(head)[1] < begin_ns

    def _judge_end(self, end: int) -> None:
        self._file.seek(end)
        if self._file.read() != MAGIC:
            self.wrong = self.wrong or f"cut off at byte {self._size}"

    def _read(self, opcode: int, data: bytes) -> Iterator[McapRecord]:
        """Yield a record; none if it cannot be decoded."""
        stream = ReadDataStream(BytesIO(data))
        try:
            if opcode == Opcode.MESSAGE:
                yield Message.read(stream, len(data))
            else:
                yield _KEPT[opcode].read(stream)  # type: ignore[attr-defined]
        except (McapError, struct.error, UnicodeDecodeError, EOFError):
            self.wrong = self.wrong or f"damaged before byte {self._file.tell()}"

    def _in_chunk(self, data: bytes, is_whole: bool) -> Iterator[McapRecord]:
        if len(data) < _CHUNK_HEAD.size:
            return
        *_, size, crc, name_length = _CHUNK_HEAD.unpack_from(data)
        start = _CHUNK_HEAD.size + name_length
        compression = data[_CHUNK_HEAD.size : start].decode("utf-8", "replace")
        content = _decompressed(compression, data[start + 8 :], size, self._path)
        if is_whole and (len(content) != size or (crc and zlib.crc32(content) != crc)):
            self.wrong = self.wrong or f"damaged before byte {self._file.tell()}"
            yield from self._indexed()
            return
        place = 0
        while place + _HEAD.size <= len(content):
            opcode, length = _HEAD.unpack_from(content, place)
            place += _HEAD.size
            if opcode in _KEPT and place + length <= len(content):
                yield from self._read(opcode, content[place : place + length])
            place += length

    def _indexed(self) -> Iterator[McapRecord]:
        """Yield the schemas and channels of the index; none without one."""
        summary = read_summary(self._path)
        if summary is not None:
            yield from summary.schemas.values()
            yield from summary.channels.values()


def _decompressed(compression: str, data: bytes, size: int, path: Path) -> bytes:
    """Return the contents of a chunk up to a truncation; empty if its data are damaged."""
    if size > _LARGEST_CHUNK_BYTES:
        return b""
    try:
        if compression == "zstd":
            return zstandard.ZstdDecompressor().decompressobj().decompress(data)
        if compression == "lz4":
            return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data))
    except (zstandard.ZstdError, RuntimeError, EOFError):
        return b""
    if compression:
        raise InvalidInputError(
            f"{path}: chunks are compressed by {compression!r}; none, zstd or lz4 can be read"
        )
    return data


def read_summary(path: Path) -> Summary | None:
    """Return the index at the end of an MCAP file; None if it is missing or incomplete."""
    try:
        with path.open("rb") as file:
            file.seek(-len(MAGIC), 2)
            if file.read() != MAGIC:
                return None
            file.seek(0)
            return make_reader(file).get_summary()
    except (McapError, struct.error, OSError, ValueError, StopIteration):
        return None


def message_counts(summary: Summary) -> dict[str, int]:
    """Return the number of messages of each topic in an index; empty if it has no statistics."""
    if summary.statistics is None:
        return {}
    counts = summary.statistics.channel_message_counts
    topics: dict[str, int] = {}
    for channel in summary.channels.values():
        topics[channel.topic] = topics.get(channel.topic, 0) + counts.get(channel.id, 0)
    return topics


def read_about(path: Path) -> tuple[About, bytes]:
    """Return a recording's metadata, and its rig as TOML.

    Raises
    ------
    SourceError
        The file cannot be read, is not an MCAP file, or was not made by fingerpost.
    """
    about: About | None = None
    library = ""
    records = Records(path)
    for record in records:
        if isinstance(record, Header):
            library = record.library
        elif isinstance(record, Metadata) and record.name == METADATA_NAME:
            try:
                about = About.of(record.metadata)
            except (msgspec.MsgspecError, KeyError):
                break
        elif isinstance(record, Attachment) and record.name == RIG_NAME and about is not None:
            records.close()
            return about, record.data
        elif isinstance(record, Message):
            break
    records.close()
    if not library:
        raise SourceError(f"{path}: {records.wrong}: nothing is left of the recording")
    raise SourceError(
        f"{path}: is an MCAP file of another program ({library}) or the start of one; "
        "a recording as `fingerpost record` writes is right"
    )
