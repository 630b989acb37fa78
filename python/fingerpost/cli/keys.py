"""Keys that are pressed while a command runs on a terminal."""

from __future__ import annotations

import os
import sys
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext

TAKE_KEY = " "
"""Selects the target, or takes the point, that is pointed at."""


def has_keys() -> bool:
    """Whether standard input is a terminal whose keys can be read one by one."""
    return os.name == "posix" and sys.stdin is not None and sys.stdin.isatty()


@contextmanager
def pressed_keys() -> Iterator[deque[str]]:
    """Yield the queue of pressed keys, the oldest first; empty if `has_keys` is false."""
    from fingerpost.guidance import Keys

    pressed: deque[str] = deque()
    with Keys(pressed.append, lambda: None) if has_keys() else nullcontext():
        yield pressed
