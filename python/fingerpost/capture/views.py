"""Reads several views in steps."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace

from fingerpost.capture.source import Frame, Loss, Source, SourceKind
from fingerpost.checks import in_range
from fingerpost.errors import CaptureError, InvalidInputError

_log = logging.getLogger(__name__)

_GIVE_UP_AFTER_S = (1e-3, 1e9)
_SPEEDS = (1e-3, 1e3)
_STARTS_S = (0.0, 1e9)

_SLOW_PERIODS = 1.5
"""Ratio of a view's frame period to that of the fastest view above which it is not waited for."""

_ALL_LOST_STEP_S = 0.5
"""Time between steps while no view sends anything, so that the consumer continues to run [s]."""


def read_views(
    sources: Sequence[Source], *, give_up_after_s: float | None = None, start_s: float = 0.0
) -> Iterator[tuple[Frame | Loss | None, ...]]:
    """Step through several views together.

    Each frame keeps its own capture time: the frames of one step belong together but were not
    captured at the same instant.

    Parameters
    ----------
    sources
        One open source per view, all recorded or all live. The caller closes them.
    give_up_after_s
        Longest silence of a live view before an error is raised [s], above 0; None waits for ever.
    start_s
        Time after the first step at which to begin, of recorded views [s], 0 and more.

    Yields
    ------
    tuple of Frame, Loss or None
        One entry per source, in their order. Recorded views advance by their times and end with
        the shortest; an entry is None if a view has no frame at about that time because of a lower
        rate. For live views a step waits until every view has a new frame, or an overdue one, and
        contains the newest of each; a view of a much lower rate than another is not waited for.
        Views of one recording yield the steps in which they were recorded.

    Raises
    ------
    CaptureError
        A source fails while it is read, or is silent for too long.
    InvalidInputError
        `give_up_after_s` or `start_s` is out of range, live views are to begin later, there is no
        source, or recorded and live ones are mixed: their clocks are unrelated.
    """
    if not sources:
        raise InvalidInputError("no source: at least one view is needed")
    kinds = {source.kind for source in sources}
    if len(kinds) > 1:
        names = ", ".join(f"{source.name} ({source.kind.value})" for source in sources)
        raise InvalidInputError(f"views must be all recorded or all live, not {names}")
    if give_up_after_s is not None:
        in_range(give_up_after_s, "give_up_after_s", *_GIVE_UP_AFTER_S)
    in_range(start_s, "start_s", *_STARTS_S)
    if kinds == {SourceKind.LIVE}:
        if start_s:
            raise InvalidInputError("live views begin now; only recorded ones can begin later")
        return _newest_together(sources, give_up_after_s)
    recordings = {source.recording for source in sources}
    if len(recordings) == 1 and None not in recordings:
        for source in sources:
            source.begin_at(start_s)
        return _as_recorded(sources)
    return _later(_in_step(sources), start_s)


def _later(
    frames: Iterator[tuple[Frame | Loss | None, ...]], start_s: float
) -> Iterator[tuple[Frame | Loss | None, ...]]:
    """Leave out the steps up to a time after the first one's [s]."""
    begin_s = -math.inf
    for together in frames:
        time_s = max(seen.time_s for seen in together if seen is not None)
        begin_s = time_s + start_s if begin_s == -math.inf else begin_s
        if time_s >= begin_s:
            yield together


def at_speed(
    frames: Iterable[Sequence[Frame | Loss | None]],
    speed: float = 1.0,
    *,
    stamped: bool = False,
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
) -> Iterator[Sequence[Frame | Loss | None]]:
    """Yield the frames of recorded views at their times, as cameras would.

    No frame is skipped. If the caller spends longer on a frame than the interval to the next one,
    the recording pauses, and all later frames are postponed: the result does not depend on the
    speed of the computer, and no frame is late when it is yielded.

    Parameters
    ----------
    frames
        Output of `read_views`; the first frames are due at once.
    speed
        Ratio of recorded to real time, > 0.
    stamped
        Whether to stamp frames with the clock time at which they are due; otherwise they are
        unchanged.
    clock
        Returns the time [s].
    sleep
        Waits for a time on that clock [s].

    Raises
    ------
    InvalidInputError
        `speed` is out of range.
    """
    in_range(speed, "speed", *_SPEEDS)
    begin_s = -math.inf  # of the recording, on the clock
    for together in frames:
        times_s = [seen.time_s / speed for seen in together if seen is not None]
        if times_s:
            begin_s = max(begin_s, clock() - max(times_s))
            if (early_s := begin_s + max(times_s) - clock()) > 0.0:
                sleep(early_s)
        yield [_due(seen, begin_s, speed) for seen in together] if stamped else together


def _due(seen: Frame | Loss | None, begin_s: float, speed: float) -> Frame | Loss | None:
    return None if seen is None else replace(seen, time_s=begin_s + seen.time_s / speed)


def _as_recorded(sources: Sequence[Source]) -> Iterator[tuple[Frame | Loss | None, ...]]:
    heads = [next(source, None) for source in sources]
    while any(head is not None for head in heads):
        step = min(
            source.step for source, head in zip(sources, heads, strict=True) if head is not None
        )
        is_due = [
            head is not None and source.step == step
            for source, head in zip(sources, heads, strict=True)
        ]
        yield tuple(head if due else None for head, due in zip(heads, is_due, strict=True))
        heads = [
            next(source, None) if due else head
            for source, head, due in zip(sources, heads, is_due, strict=True)
        ]


def _in_step(sources: Sequence[Source]) -> Iterator[tuple[Frame | Loss | None, ...]]:
    frames = [next(source, None) for source in sources]
    # Until a second frame gives the period, only frames with equal times belong together.
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


def _newest_together(
    sources: Sequence[Source], give_up_after_s: float | None
) -> Iterator[tuple[Frame | Loss | None, ...]]:
    while True:
        # A consumer slower than the cameras is best served by frames that are new when it asks.
        if all(source.is_stale for source in sources):
            for source in sources:
                source.pass_over()
        fastest_s = min(source.period_s for source in sources)
        for source in sources:
            is_slow = math.inf > source.period_s > _SLOW_PERIODS * fastest_s
            _wait(source, 0.0 if is_slow else source.due_in_s, give_up_after_s)
        seen: list[Frame | Loss | None] = []
        try:
            for source in sources:
                seen.append(_newest(source))  # noqa: PERF401 - in a comprehension it cannot end
        except StopIteration:
            return
        yield tuple(seen)
        if all(isinstance(entry, Loss) for entry in seen):
            sources[0].linger(_ALL_LOST_STEP_S)


def _newest(source: Source) -> Frame | Loss | None:
    """Return a view's new frame, the loss in place of an overdue one, or None.

    Raises
    ------
    StopIteration
        The view has ended.
    """
    if (loss := source.overdue()) is not None:
        return loss
    return next(source) if source.has_next else None


def _wait(source: Source, at_most_s: float, give_up_after_s: float | None) -> None:
    """Wait for a view's frame, within the time limits."""
    if give_up_after_s is None:
        source.wait(at_most_s)
        return
    source.wait(min(at_most_s, give_up_after_s - source.silent_s))
    if source.silent_s >= give_up_after_s:
        raise CaptureError(
            f"{source.name}: no picture for {source.silent_s:.0f} s: given up after "
            f"{give_up_after_s:g} s, as was wished"
        )
