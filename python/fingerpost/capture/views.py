"""Several views, step by step."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence

from fingerpost.capture.source import Frame, Source, SourceKind
from fingerpost.errors import InvalidInputError

_log = logging.getLogger(__name__)


def read_views(sources: Sequence[Source]) -> Iterator[tuple[Frame | None, ...]]:
    """Step through several views together.

    Each frame keeps its own capture time: frames of one step belong together but were not taken
    at the same instant.

    Parameters
    ----------
    sources
        One open source per view, all recorded or all live. They stay the caller's to close.

    Yields
    ------
    tuple of Frame or None
        One entry per source, in their order. Recorded views advance by their times and end with
        the shortest; an entry is None where a view has no frame of about that time, as it was
        recorded at a lower rate or its frame cannot be read. Live views wait until every view has
        a new frame and then give the newest of each.

    Raises
    ------
    CaptureError
        A source fails while it is read.
    InvalidInputError
        There is no source, or recorded and live ones are mixed: their times have nothing in
        common.
    """
    if not sources:
        raise InvalidInputError("no source: at least one view is needed")
    kinds = {source.kind for source in sources}
    if len(kinds) > 1:
        names = ", ".join(f"{source.name} ({source.kind.value})" for source in sources)
        raise InvalidInputError(f"views must be all recorded or all live, not {names}")
    return _newest_together(sources) if kinds == {SourceKind.LIVE} else _in_step(sources)


def _in_step(sources: Sequence[Source]) -> Iterator[tuple[Frame | None, ...]]:
    frames = [next(source, None) for source in sources]
    # Before any second frame only equal times are known to belong together.
    steps_s = [0.0] * len(sources)
    while True:
        heads = [frame for frame in frames if frame is not None]
        if len(heads) < len(sources):
            break
        latest_s = min(head.time_s for head in heads) + min(steps_s) / 2
        yield tuple(head if head.time_s <= latest_s else None for head in heads)
        for k, head in enumerate(heads):
            if head.time_s <= latest_s:
                frames[k] = following = next(sources[k], None)
                steps_s[k] = following.time_s - head.time_s if following else steps_s[k]
    if heads:
        ended = sources[frames.index(None)]
        _log.warning("%s ended before the other views; their rest is not read", ended.name)


def _newest_together(sources: Sequence[Source]) -> Iterator[tuple[Frame | None, ...]]:
    while True:
        for source in sources:
            source.wait()
        frames = tuple(next(source, None) for source in sources)
        if None in frames:
            return
        yield frames
