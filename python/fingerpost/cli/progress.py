"""A progress bar, or a line that changes, on stderr, only where a person watches."""

from __future__ import annotations

import logging
import os
import sys
import unicodedata
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager
from itertools import accumulate
from typing import TextIO, TypeVar

import click

T = TypeVar("T")

_USUAL_COLUMNS = 80  # of a terminal that does not say how many it has


def watched(items: Iterable[T], length: int | None, label: str) -> Generator[T, None, None]:
    """Yield the items, with a bar that moves as they go by and ends its line when it is closed.

    Parameters
    ----------
    items
        What is worked through.
    length
        How many there should be; without it, as for a live source, there is no bar.
    label
        What is being done.
    """
    if length is None or not _is_watched():
        yield from items
        return
    with click.progressbar(items, length=length, label=label, file=sys.stderr) as bar:
        yield from bar


class StatusLine:
    """A line of a terminal that is written over.

    It is never wider than the terminal, so that it stays one line; its words begin at the left.

    Parameters
    ----------
    stream
        The terminal.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._covered = 0

    @property
    def columns(self) -> int:
        """How many columns a line may have: one fewer than the terminal, whose cursor needs it."""
        try:
            columns = os.get_terminal_size(self._stream.fileno()).columns
        except (OSError, ValueError):  # no terminal, or a stream without a file
            columns = 0
        return (columns or _USUAL_COLUMNS) - 1

    def show(self, words: str) -> None:
        """Write words over those before; what the line has no room for is cut off."""
        columns = self.columns
        if cell_count(words) > columns:
            words = _fitting(words, columns - 1) + "…"
        cells = cell_count(words)
        self._write(f"\r{words}{' ' * (min(self._covered, columns) - cells)}")
        self._covered = cells

    def clear(self) -> None:
        """Leave the line empty, for whatever is written next."""
        if self._covered:
            # A terminal shows Ctrl-C as two signs behind the words.
            self._write(f"\r{' ' * min(self._covered + 2, self.columns)}\r")
            self._covered = 0

    def end(self) -> None:
        """Leave the words standing, and begin a new line."""
        if self._covered:
            self._write("\n")
            self._covered = 0

    def _write(self, text: str) -> None:
        click.echo(text, file=self._stream, nl=False)


def cell_count(words: str) -> int:
    """Return how many columns words take on a terminal: wide characters take two."""
    return sum(_cells(character) for character in words)


def _cells(character: str) -> int:
    return 2 if unicodedata.east_asian_width(character) in "WF" else 1


def _fitting(words: str, columns: int) -> str:
    """Return the first words, as much as the columns hold."""
    ends = accumulate(map(_cells, words))
    return "".join(c for c, end in zip(words, ends, strict=True) if end <= columns)


@contextmanager
def status_line() -> Iterator[StatusLine | None]:
    """Give a line on stderr that is gone at the end; None where nobody watches.

    What is logged meanwhile stands on lines of its own.
    """
    if not _is_watched():
        yield None
        return
    line = StatusLine(sys.stderr)

    def make_way(_record: logging.LogRecord) -> bool:
        line.clear()
        return True

    handlers = list(logging.getLogger().handlers)
    for handler in handlers:
        handler.addFilter(make_way)
    try:
        yield line
    finally:
        for handler in handlers:
            handler.removeFilter(make_way)
        line.clear()


@contextmanager
def telling() -> Iterator[Callable[[str], None]]:
    """Give what shows, in one line that changes, what is being done; nothing where nobody watches.

    Yields
    ------
    callable
        Takes the words.
    """
    if not _is_watched():
        yield lambda _words: None
        return
    line = StatusLine(sys.stderr)
    try:
        yield line.show
    finally:
        line.end()


@contextmanager
def counting(what: str) -> Iterator[Callable[[int, int], None]]:
    """Give what shows, in one line that changes, how many of all are done.

    Parameters
    ----------
    what
        What is counted, in the plural.

    Yields
    ------
    callable
        Takes the number that is done and that of all.
    """
    with telling() as tell:
        yield lambda done, of: tell(f"{done} of {of} {what}")


def _is_watched() -> bool:
    # Python has no stderr where that was closed before it began.
    return sys.stderr is not None and sys.stderr.isatty()
