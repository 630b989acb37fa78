"""Distribution of work to processes that end with the program that started them.

However the program ends, even by a signal that it cannot handle, its workers exit at once: each
holds one end of a pipe. Only the program has the other end, and the system closes it when the
program ends.
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
    """Return the number of processes to use; None means all cores.

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
    """Start processes by "spawn"; tasks that are still queued at the end are cancelled.

    If the context ends with an exception, such as the KeyboardInterrupt of Ctrl-C, running tasks
    are not awaited.

    Parameters
    ----------
    workers
        Number of processes, ≥ 1.
    start
        Called with `given` in each process before its first task; None calls nothing.

    Raises
    ------
    FingerpostError
        A worker died.
    """
    context = get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    with receiver, sender:
        # Pickled here, so that a worker watches its pipe before it imports their modules.
        given_start = pickle.dumps((start, given))
        with held_back():
            pool = _Pool(
                workers, mp_context=context, initializer=_start, initargs=(receiver, given_start)
            )
        try:
            yield pool
        except BrokenProcessPool as error:
            sender.close()
            raise FingerpostError(
                "a worker process died, perhaps for want of memory; try fewer workers"
            ) from error
        except BaseException:
            sender.close()
            raise
        finally:
            pool.shutdown(cancel_futures=True)


class _Pool(ProcessPoolExecutor):
    """Workers that leave the handling of signals to the program."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Submit a task to a worker, and start one if there are fewer than allowed."""
        with held_back():
            future = super().submit(fn, *args, **kwargs)
        # The manager thread watches a new worker only after its next wake-up: the death of one that
        # is killed before would remain undetected, and all would wait for ever.
        with self._shutdown_lock:
            self._executor_manager_thread_wakeup.wakeup()
        return future


@contextmanager
def held_back() -> Iterator[None]:
    """Start processes, meanwhile, with the signals blocked that end programs.

    A terminal sends Ctrl-C, and a service manager its signal, to a program and its workers. A child
    inherits the blocked signals of its parent permanently, from before its first import; in this
    process they are delivered when the context ends.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, *ENDING_SIGNALS})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _start(receiver: Connection, given_start: bytes) -> None:
    threading.Thread(target=_end_with, args=(receiver,), daemon=True).start()
    for library in ("OPENBLAS", "MKL", "OMP", "VECLIB_MAXIMUM"):  # read when NumPy is imported
        os.environ[f"{library}_NUM_THREADS"] = "1"
    import cv2

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # where it cannot be blocked
    cv2.setNumThreads(1)  # one core per worker, also for the software renderer:
    os.environ.setdefault("LP_NUM_THREADS", "1")
    start, given = pickle.loads(given_start)
    if start is not None:
        start(*given)


def _end_with(receiver: Connection) -> None:
    """Wait until the program has closed its end of the pipe or ended; then end the process."""
    try:
        receiver.poll(None)
    finally:
        os._exit(1)
