"""End of a program: its signals, also during imports and waits, and threads that are stuck."""

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

STOPPED = 130
"""Exit code of a program that Ctrl-C has ended: 128 plus the signal's number, as in shells."""

ENDING_SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGTERM", "SIGHUP", "SIGQUIT") if hasattr(signal, name)
)
"""Signals that end a program, other than Ctrl-C's SIGINT."""


@contextmanager
def ending_at_once() -> Iterator[None]:
    """Let Ctrl-C end the program silently before any work has begun.

    For imports: an exception in the middle of one may be converted or printed by native modules.
    Outside the main thread, or if Ctrl-C does not raise KeyboardInterrupt, nothing is changed.
    """
    raising = signal.default_int_handler
    if signal.getsignal(signal.SIGINT) is not raising:
        yield
        return
    try:
        signal.signal(signal.SIGINT, lambda _number, _frame: os._exit(STOPPED))
    except ValueError:  # not the main thread
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, raising)


_WAIT_S = 0.2


def wait_hearing_signals(wait: Callable[[float], object]) -> None:
    """Wait in the main thread, as long as it takes, and let a signal end it.

    A signal that arrives just before a wait without a time-out, or that another thread receives, is
    handled only after that wait.

    Parameters
    ----------
    wait
        Waits for so many seconds at most; returns whether the event has happened.
    """
    while not wait(_WAIT_S):
        pass


_stuck: list[threading.Thread] = []


def leave_behind(thread: threading.Thread) -> None:
    """Register a thread that does not return from native code, and will not be joined."""
    _stuck.append(thread)


def is_anything_stuck() -> bool:
    """Whether a registered thread still runs."""
    return any(thread.is_alive() for thread in _stuck)
