"""How long tests wait for what must come: no verdict rests on the speed of a machine."""

import time
from collections.abc import Callable

PATIENCE_S = 300.0
"""Longer than the slowest machine takes; no test that passes waits it out."""


def wait_until(happened: Callable[[], object], what: str = "what was waited for") -> None:
    """Wait for something that another thread or process does."""
    end_s = time.monotonic() + PATIENCE_S
    while not happened():
        assert time.monotonic() < end_s, f"{what} never came"
        time.sleep(0.002)
