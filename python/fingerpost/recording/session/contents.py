"""Contents of an MCAP file, counted by reading all of it: an index would not show damage.

A gigabyte takes three seconds of one core.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import msgspec

from fingerpost.mcap_file import (
    END_NAME,
    FRAMES_TOPIC,
    METADATA_NAME,
    About,
    Channel,
    Header,
    Message,
    Metadata,
    Records,
    Schema,
)


@dataclass(frozen=True, kw_only=True)
class Contents:
    """Contents of an MCAP file.

    Attributes
    ----------
    path
        The file.
    size_bytes
        Its size.
    library
        The program that wrote it.
    about
        Its description, if fingerpost wrote it.
    messages
        Number of messages, by topic.
    schemas
        Schema of the messages, by topic.
    start_ns, end_ns
        The first and the last log time.
    dropped
        Number of dropped steps.
    wrong
        What is wrong with the file; empty if it is complete.
    """

    path: Path
    size_bytes: int
    library: str
    about: About | None
    messages: Mapping[str, int]
    schemas: Mapping[str, str]
    start_ns: int
    end_ns: int
    dropped: int
    wrong: str

    @property
    def duration_s(self) -> float:
        """From the first log time to the last [s]."""
        return (self.end_ns - self.start_ns) / 1e9

    def lines(self) -> list[str]:
        """Return everything as lines of text."""
        rows = {"file": f"{self.path}, {self.size_bytes / 1e6:.1f} MB, {self.wrong or 'whole'}"}
        if self.about is None:
            rows["written by"] = self.library or "a program that does not say"
        else:
            rows["written by"] = f"fingerpost {self.about.version}, {self.about.started}"
        rows["duration"] = f"{self.duration_s:.2f} s"
        if self.about is not None:
            taken = self.messages.get(FRAMES_TOPIC, 0)
            rows["frames"] = f"{taken} of each view, {self.dropped} dropped"
            for view, source in zip(self.about.views, self.about.sources, strict=True):
                rows[f"view {view}"] = source
        lines = [f"{name:<16} {value}" for name, value in rows.items()]
        counted = sorted(self.messages.items())
        return [*lines, *(f"{n:16d} {topic}   {self.schemas[topic]}" for topic, n in counted)]

    def as_dict(self) -> dict[str, Any]:
        """Return everything for programs, as JSON values."""
        about = None if self.about is None else msgspec.to_builtins(self.about)
        named = {one.name: getattr(self, one.name) for one in fields(self)}
        return {**named, "path": str(self.path), "about": about}


def contents(path: Path) -> Contents:
    """Return the contents of an MCAP file.

    Raises
    ------
    SourceError
        The file cannot be read, or is not an MCAP file.
    """
    count = _Count()
    records = Records(path)
    for record in records:
        count.add(record)
    start_ns, end_ns = count.times_ns or (0, 0)
    return Contents(
        path=path,
        size_bytes=path.stat().st_size,
        library=count.library,
        about=count.about,
        messages=count.messages,
        schemas=count.schemas,
        start_ns=start_ns,
        end_ns=end_ns,
        dropped=count.dropped,
        wrong=records.wrong,
    )


@dataclass
class _Count:
    library: str = ""
    about: About | None = None
    topics: dict[int, str] = field(default_factory=dict)
    kinds: dict[int, str] = field(default_factory=dict)
    messages: Counter[str] = field(default_factory=Counter)
    schemas: dict[str, str] = field(default_factory=dict)
    times_ns: tuple[int, int] | None = None
    steps: int = 0
    noted: int | None = None

    @property
    def dropped(self) -> int:
        """Number of dropped steps, as noted at the end, or else by the gaps between steps."""
        gaps = self.steps - self.messages[FRAMES_TOPIC]
        return gaps if self.noted is None else self.noted

    def add(self, record: object) -> None:
        if isinstance(record, Header):
            self.library = record.library
        elif isinstance(record, Metadata) and record.name == METADATA_NAME:
            self.about = _about(record.metadata)
        elif isinstance(record, Metadata) and record.name == END_NAME:
            self.noted = _dropped(record.metadata)
        elif isinstance(record, Schema):
            self.kinds[record.id] = record.name
        elif isinstance(record, Channel):
            self.topics[record.id] = record.topic
            kind = self.kinds.get(record.schema_id, record.message_encoding)
            self.schemas[record.topic] = kind
        elif isinstance(record, Message) and record.channel_id in self.topics:
            topic = self.topics[record.channel_id]
            self.messages[topic] += 1
            first, last = self.times_ns or (record.log_time, record.log_time)
            self.times_ns = min(first, record.log_time), max(last, record.log_time)
            if topic == FRAMES_TOPIC:
                self.steps = max(self.steps, record.sequence + 1)


def _about(metadata: dict[str, str]) -> About | None:
    try:
        return About.of(metadata)
    except (msgspec.MsgspecError, KeyError):
        return None


def _dropped(metadata: dict[str, str]) -> int | None:
    said = metadata.get("dropped", "")
    return int(said) if said.isdecimal() else None
