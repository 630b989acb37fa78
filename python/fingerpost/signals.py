"""How a program ends: by which signals, while it is being loaded, and beside a stuck thread."""

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

STOPPED = 130
"""Exit code of a program that Ctrl-C has ended: 128 and the signal's number, as shells have it."""

ENDING_SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGTERM", "SIGHUP", "SIGQUIT") if hasattr(signal, name)
)
"""Those that end a program beside Ctrl-C's SIGINT."""


@contextmanager
def ending_at_once() -> Iterator[None]:
    """Let Ctrl-C end the program without a word, as long as nothing has been begun.

    For imports: an exception may come in the middle of one, where native modules turn it into
    another or print it. Outside of the main thread, or where Ctrl-C does something else than to
    raise KeyboardInterrupt, nothing is done.
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


_stuck: list[threading.Thread] = []


def leave_behind(thread: threading.Thread) -> None:
    """Note a thread that does not come back from native code, and will not be waited for."""
    _stuck.append(thread)


def is_anything_stuck() -> bool:
    """Whether a thread that was left behind still runs."""
    return any(thread.is_alive() for thread in _stuck)
