"""Work shared out among processes."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import get_context
from typing import Any

from fingerpost.errors import FingerpostError, InvalidInputError


def worker_count(workers: int | None) -> int:
    """Return how many processes to use; None stands for all cores.

    Raises
    ------
    InvalidInputError
        Fewer than one.
    """
    if workers is not None and workers < 1:
        raise InvalidInputError(f"workers is {workers}; 1 or more, or None for all cores, is right")
    return workers or os.cpu_count() or 1


@contextmanager
def sharing(
    workers: int, start: Callable[..., None] | None = None, *given: Any
) -> Iterator[Executor]:
    """Start processes afresh ("spawn"); what waits when this ends is not done any more.

    Parameters
    ----------
    workers
        How many, ≥ 1.
    start
        Called with `given` in each of them before its first work; None calls nothing.

    Raises
    ------
    FingerpostError
        A worker died.
    """
    pool = ProcessPoolExecutor(
        workers,
        mp_context=get_context("spawn"),
        initializer=_start,
        initargs=(start, given),
    )
    with pool:
        try:
            yield pool
        except BrokenProcessPool as error:
            raise FingerpostError(
                "a worker process died, perhaps for want of memory; try fewer workers"
            ) from error
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def _start(start: Callable[..., None] | None, given: tuple[Any, ...]) -> None:
    import cv2

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent stops the workers
    cv2.setNumThreads(1)  # the workers share the cores among themselves, and so does what draws:
    os.environ.setdefault("LP_NUM_THREADS", "1")
    if start is not None:
        start(*given)
