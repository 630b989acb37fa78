"""How a command ends on request; an interrupted one exits with 128 and the signal's number."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

from fingerpost.signals import ENDING_SIGNALS


def _handling(handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    # Signals that the caller has set to be ignored, as `nohup` does, remain ignored.
    before = {
        number: signal.signal(number, handler)
        for number in ENDING_SIGNALS
        if signal.getsignal(number) is not signal.SIG_IGN
    }
    try:
        yield
    finally:
        for number, former in before.items():
            signal.signal(number, former)


@contextmanager
def ending_orderly() -> Iterator[None]:
    """Let signals that end the program unwind it, so that terminals and files are left intact."""
    yield from _handling(lambda number, _: sys.exit(128 + number))


@contextmanager
def ending_as_interrupted() -> Iterator[None]:
    """Let signals that end the program act like Ctrl-C, which completes the written files."""
    yield from _handling(lambda _, frame: _interrupt(frame))


def _interrupt(frame: FrameType | None) -> None:
    """Act like Ctrl-C, even in background jobs of a shell, in which SIGINT alone is ignored."""
    handler = signal.getsignal(signal.SIGINT)
    (handler if callable(handler) else signal.default_int_handler)(signal.SIGINT, frame)
