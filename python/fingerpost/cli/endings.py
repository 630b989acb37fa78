"""How a command ends that is told to."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

ENDING_SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGTERM", "SIGHUP", "SIGQUIT") if hasattr(signal, name)
)
"""Signals that end a program; an interrupted one exits with 128 and the signal's number."""


def _handling(handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    before = {number: signal.signal(number, handler) for number in ENDING_SIGNALS}
    try:
        yield
    finally:
        for number, former in before.items():
            signal.signal(number, former)


@contextmanager
def ending_orderly() -> Iterator[None]:
    """Let signals that end the program unwind it, so that terminals and files are left whole."""
    yield from _handling(lambda number, _: sys.exit(128 + number))


@contextmanager
def ending_as_interrupted() -> Iterator[None]:
    """Let signals that end the program do what Ctrl-C does, which leaves whole what is written."""
    yield from _handling(lambda *_: signal.raise_signal(signal.SIGINT))
