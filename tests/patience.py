"""How long tests wait for events: no result depends on the speed of a machine."""

import time
from collections.abc import Callable

PATIENCE_S = 300.0
"""Longer than the slowest machine takes; only a failing test waits for all of it."""


def wait_until(happened: Callable[[], object], what: str = "the event") -> None:
    """Wait for an event of another thread or process."""
    end_s = time.monotonic() + PATIENCE_S
    while not happened():
        assert time.monotonic() < end_s, f"{what} never came"
        time.sleep(0.002)
