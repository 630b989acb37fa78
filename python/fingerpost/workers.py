"""Work shared out among processes, which end with the program that has started them.

However a program ends, also by a signal that it never hears, its workers are gone a moment later,
in the middle of their work: each holds one end of a pipe whose other end the program alone has, and
the system closes that with it.
"""

from __future__ import annotations

import os
import pickle
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import Any

from fingerpost.errors import FingerpostError, InvalidInputError
from fingerpost.signals import ENDING_SIGNALS


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

    Where it ends with an exception, such as the KeyboardInterrupt of Ctrl-C, what the workers are
    at is not waited for.

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
    context = get_context("spawn")
    heard, held = context.Pipe(duplex=False)
    with heard, held:
        # Pickled here, so that a worker listens before it imports what these are made of.
        given_start = pickle.dumps((start, given))
        with held_back():
            pool = _Pool(
                workers, mp_context=context, initializer=_start, initargs=(heard, given_start)
            )
        try:
            yield pool
        except BrokenProcessPool as error:
            held.close()
            raise FingerpostError(
                "a worker process died, perhaps for want of memory; try fewer workers"
            ) from error
        except BaseException:
            held.close()
            raise
        finally:
            pool.shutdown(cancel_futures=True)


class _Pool(ProcessPoolExecutor):
    """Workers that leave it to the program what a signal to all of them means."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Hand work to a worker, and start one if there are fewer than there may be."""
        with held_back():
            future = super().submit(fn, *args, **kwargs)
        # A worker that has just been started is watched only from the manager's next waking on:
        # of one that is killed at once it would never hear, and all would wait for ever.
        with self._shutdown_lock:
            self._executor_manager_thread_wakeup.wakeup()
        return future


@contextmanager
def held_back() -> Iterator[None]:
    """Have processes that are started meanwhile never hear what ends programs.

    A terminal sends Ctrl-C, and a service manager what it ends by, to a program and its workers
    alike. What a process has blocked as it starts another is blocked there for good, from before
    its first import; here it comes a moment later.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, *ENDING_SIGNALS})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _start(heard: Connection, given_start: bytes) -> None:
    threading.Thread(target=_end_with, args=(heard,), daemon=True).start()
    for library in ("OPENBLAS", "MKL", "OMP", "VECLIB_MAXIMUM"):  # asked when NumPy is imported
        os.environ[f"{library}_NUM_THREADS"] = "1"
    import cv2

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # where it cannot be blocked
    cv2.setNumThreads(1)  # the workers share the cores among themselves, and so does what draws:
    os.environ.setdefault("LP_NUM_THREADS", "1")
    start, given = pickle.loads(given_start)
    if start is not None:
        start(*given)


def _end_with(heard: Connection) -> None:
    """Wait until the program has closed its end of the pipe, or is gone; then end the process."""
    try:
        heard.poll(None)
    finally:
        os._exit(1)
