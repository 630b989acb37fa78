"""Executes jobs that wait for the arm: one at a time, with only the newest one queued.

`Worker` uses a thread, so that views and keys are processed meanwhile. `Turns` uses the caller's
thread, on request, for a simulated world without concurrency.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from types import TracebackType
from typing import Protocol, Self

Job = Callable[[], None]


class Jobs(Protocol):
    """Interface of a session's worker; a context manager."""

    @property
    def idle(self) -> bool:
        """Whether there is no job."""

    def offer(self, job: Job) -> None:
        """Queue a job, in place of a waiting one."""

    def check(self) -> None:
        """Raise the error of a job, after which no other is executed."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None: ...


class Worker:
    """Executes one job at a time in a thread; only the newest one waits. A context manager."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._job: Job | None = None
        self._busy = False
        self._closing = False
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="worker", daemon=True)

    @property
    def idle(self) -> bool:
        """Whether there is no job."""
        with self._changed:
            return self._job is None and not self._busy

    def offer(self, job: Job) -> None:
        """Queue a job, in place of a waiting one."""
        with self._changed:
            self._job = job
            self._changed.notify_all()

    def check(self) -> None:
        """Raise the error of a job, after which no other is executed."""
        if self._error is not None:
            raise self._error

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        with self._changed:
            self._closing = True
            self._job = None
            self._changed.notify_all()
        self._thread.join()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._job is not None or self._closing)
                job, self._job = self._job, None
                if job is None:
                    return
                self._busy = True
            try:
                job()
            except BaseException as error:  # any error is raised again in the caller's thread
                self._error = error
                return
            finally:
                with self._changed:
                    self._busy = False


class Turns:
    """Executes jobs in the caller's thread, one per call of `run`; a context manager."""

    def __init__(self) -> None:
        self._job: Job | None = None
        self._busy = False
        self._error: BaseException | None = None

    @property
    def idle(self) -> bool:
        """Whether there is no job."""
        return self._job is None and not self._busy

    def offer(self, job: Job) -> None:
        """Queue a job, in place of a waiting one."""
        self._job = job

    def check(self) -> None:
        """Raise the error of a job, after which no other is executed."""
        if self._error is not None:
            raise self._error

    def run(self) -> bool:
        """Execute the waiting job; return whether there was one."""
        job, self._job = self._job, None
        if job is None or self._error is not None:
            return False
        self._busy = True
        try:
            job()
        except BaseException as error:  # any error is raised again in the session
            self._error = error
        finally:
            self._busy = False
        return True

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._job = None
