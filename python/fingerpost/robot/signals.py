"""Stops an arm on signals that end or suspend the program."""

from __future__ import annotations

import logging
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

logger = logging.getLogger(__name__)


@contextmanager
def stopping_on(stop: Callable[[str], None], *numbers: signal.Signals) -> Iterator[None]:
    """Stop on signals, every time, before their usual effect; in the main thread only.

    Parameters
    ----------
    stop : callable
        Called with the signal's name, in its handler; must not wait. Its exceptions are logged, and
        the signal has its usual effect.
    *numbers : signal.Signals
        The signals; SIGINT and SIGTERM by default.
    """
    before = {
        number: signal.getsignal(number) or signal.SIG_DFL
        for number in numbers or (signal.SIGINT, signal.SIGTERM)
    }

    def on_signal(number: int, frame: FrameType | None) -> None:
        try:
            stop(signal.Signals(number).name)
        except Exception as error:
            logger.error("signal %s: the stop failed: %s", signal.Signals(number).name, error)
        previous = before[signal.Signals(number)]
        if callable(previous):
            previous(number, frame)
        elif previous is not signal.SIG_IGN:
            signal.signal(number, signal.SIG_DFL)
            signal.raise_signal(number)  # in this thread, so it is delivered before this returns
            # A suspended program has been continued: the next suspension must stop the arm as well.
            signal.signal(number, on_signal)

    for number in before:
        signal.signal(number, on_signal)
    try:
        yield
    finally:
        for number, previous in before.items():
            signal.signal(number, previous)
