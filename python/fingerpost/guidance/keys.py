"""Reads single key presses from a terminal."""

from __future__ import annotations

import os
import select
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from types import TracebackType
from typing import Any, Self

from fingerpost.errors import InvalidInputError


class Keys:
    """Reads a terminal's keys in a thread, so that a stop is never delayed; a context manager.

    The terminal returns every key at once, without echo; Ctrl-C and Ctrl-Z remain signals. Its
    settings are restored on exit. An error in a callback does not end the thread, because the next
    key may be a stop: the first error is raised on exit, unless another exception is being raised.

    Parameters
    ----------
    on_key
        Called in the thread with every key, one character each.
    on_end
        Called once in the thread when the terminal is closed.
    descriptor
        File descriptor of the terminal; by default that of standard input.

    Raises
    ------
    InvalidInputError
        Not a terminal.
    """

    def __init__(
        self,
        on_key: Callable[[str], None],
        on_end: Callable[[], None],
        *,
        descriptor: int | None = None,
    ) -> None:
        self._on_key = on_key
        self._on_end = on_end
        self._descriptor = sys.stdin.fileno() if descriptor is None else descriptor
        if not os.isatty(self._descriptor):
            raise InvalidInputError("keys need a terminal as standard input")
        self._error: Exception | None = None
        self._before: list[Any] = []
        self._wake_out, self._wake_in = -1, -1
        self._thread = threading.Thread(target=self._read, name="keys", daemon=True)

    def __enter__(self) -> Self:
        import termios
        import tty

        self._before = termios.tcgetattr(self._descriptor)
        tty.setcbreak(self._descriptor, termios.TCSADRAIN)
        self._wake_out, self._wake_in = os.pipe()
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        import termios

        os.write(self._wake_in, b"x")
        self._thread.join()
        os.close(self._wake_out)
        os.close(self._wake_in)
        with suppress(termios.error):  # the terminal may be closed
            termios.tcsetattr(self._descriptor, termios.TCSADRAIN, self._before)
        if kind is None and self._error is not None:
            raise self._error

    def _read(self) -> None:
        while True:
            ready, _, _ = select.select([self._descriptor, self._wake_out], [], [])
            if self._wake_out in ready:
                return
            try:
                pressed = os.read(self._descriptor, 64)
            except OSError:
                pressed = b""
            if not pressed:
                self._call(self._on_end)
                return
            for key in pressed.decode("utf-8", errors="replace"):
                self._call(self._on_key, key)

    def _call(self, callback: Callable[..., None], *keys: str) -> None:
        try:
            callback(*keys)
        except Exception as error:  # the stop key must continue to work after any error
            self._error = self._error or error
