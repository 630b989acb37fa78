"""A progress bar on stderr, only where a person watches."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

import click

T = TypeVar("T")


def watched(items: Iterable[T], length: int | None, label: str) -> Iterator[T]:
    """Yield the items, with a bar that moves as they go by.

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
    told = False

    def tell(words: str) -> None:
        nonlocal told
        told = True
        click.echo(f"\r{words:<60}", nl=False, err=True)

    try:
        yield tell
    finally:
        if told:
            click.echo(err=True)


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
