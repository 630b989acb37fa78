"""Defers exceptions of signal handlers during calls of libraries that cannot handle them."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

_STOPPING = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Defer the exceptions of signal handlers to the end of the block, which must be short.

    The handlers of SIGINT and SIGTERM themselves run at once, so that a robot's stop does not wait.
    Outside the main thread, where no handler ever runs, nothing is done.

    Raises
    ------
    BaseException
        At the end, the exception of a handler: KeyboardInterrupt, unless the program has its own.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    raised: list[BaseException] = []
    handlers = {number: signal.getsignal(number) for number in _STOPPING}
    for number, handler in handlers.items():
        if callable(handler):
            signal.signal(number, _keeping(handler, raised))
    try:
        yield
    finally:
        for number, handler in handlers.items():
            if callable(handler):
                signal.signal(number, handler)
    if raised:
        raise raised[0]


def _keeping(
    handler: Callable[[int, FrameType | None], object], raised: list[BaseException]
) -> Callable[[int, FrameType | None], None]:
    def handle(number: int, frame: FrameType | None) -> None:
        try:
            handler(number, frame)
        except BaseException as error:
            raised.append(error)

    return handle
