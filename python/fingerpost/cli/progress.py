"""A progress bar, or a line that is updated, on stderr; only if that is a terminal."""

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

_USUAL_COLUMNS = 80  # of a terminal of unknown width


def watched(items: Iterable[T], length: int | None, label: str) -> Generator[T, None, None]:
    """Yield the items and advance a bar; closing the generator ends its line.

    Parameters
    ----------
    items
        Items to process.
    length
        Expected number of items; without it, as for a live source, there is no bar.
    label
        Name of the activity.
    """
    if length is None or not _is_watched():
        yield from items
        return
    with click.progressbar(items, length=length, label=label, file=sys.stderr) as bar:
        yield from bar


class StatusLine:
    """A line of a terminal that is overwritten.

    It is never wider than the terminal, so that it remains one line; its text begins at the left.

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
        """Largest width of a line: one column less than the terminal, for the cursor."""
        try:
            columns = os.get_terminal_size(self._stream.fileno()).columns
        except (OSError, ValueError):  # not a terminal, or a stream without a file
            columns = 0
        return (columns or _USUAL_COLUMNS) - 1

    def show(self, words: str) -> None:
        """Replace the text of the line; text beyond its width is cut off."""
        columns = self.columns
        if cell_count(words) > columns:
            words = _fitting(words, columns - 1) + "…"
        cells = cell_count(words)
        self._write(f"\r{words}{' ' * (min(self._covered, columns) - cells)}")
        self._covered = cells

    def clear(self) -> None:
        """Clear the line for other output."""
        if self._covered:
            # A terminal shows Ctrl-C as two characters after the text.
            self._write(f"\r{' ' * min(self._covered + 2, self.columns)}\r")
            self._covered = 0

    def end(self) -> None:
        """Keep the text, and begin a new line."""
        if self._covered:
            self._write("\n")
            self._covered = 0

    def _write(self, text: str) -> None:
        click.echo(text, file=self._stream, nl=False)


def cell_count(words: str) -> int:
    """Return the number of columns of a text on a terminal: wide characters take two."""
    return sum(_cells(character) for character in words)


def _cells(character: str) -> int:
    return 2 if unicodedata.east_asian_width(character) in "WF" else 1


def _fitting(words: str, columns: int) -> str:
    """Return the part of a text that fits into a number of columns."""
    ends = accumulate(map(_cells, words))
    return "".join(c for c, end in zip(words, ends, strict=True) if end <= columns)


@contextmanager
def status_line() -> Iterator[StatusLine | None]:
    """Yield a line on stderr that is cleared at the end; None if stderr is not a terminal.

    Messages that are logged meanwhile get lines of their own.
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
def reporting() -> Iterator[Callable[[str], None]]:
    """Yield a function that shows the current activity in one line, if stderr is a terminal.

    Yields
    ------
    callable
        Takes the text.
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
    """Yield a function that shows the number of completed items in one line.

    Parameters
    ----------
    what
        Name of the items, in the plural.

    Yields
    ------
    callable
        Takes the number of completed items and that of all.
    """
    with reporting() as report:
        yield lambda done, of: report(f"{done} of {of} {what}")


def _is_watched() -> bool:
    # Python has no stderr if it was closed before the start.
    return sys.stderr is not None and sys.stderr.isatty()
