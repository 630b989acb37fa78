"""Who does what waits for the arm: one job at a time, the newest of those that wait.

`Worker` does it in a thread, so that views and keys are taken meanwhile. `Turns` does it in the
caller's thread, on request: for a simulated world, in which nothing happens at one time.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from types import TracebackType
from typing import Protocol, Self

Job = Callable[[], None]


class Jobs(Protocol):
    """What a session needs of its worker; a context manager."""

    @property
    def idle(self) -> bool:
        """Whether there is nothing to do."""

    def offer(self, job: Job) -> None:
        """Do this next, in place of whatever waits."""

    def check(self) -> None:
        """Raise what a job has raised; nothing more is done after that."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None: ...


class Worker:
    """Does one thing at a time in a thread; of those that wait, the newest. A context manager."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._job: Job | None = None
        self._busy = False
        self._closing = False
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="worker", daemon=True)

    @property
    def idle(self) -> bool:
        """Whether there is nothing to do."""
        with self._changed:
            return self._job is None and not self._busy

    def offer(self, job: Job) -> None:
        """Do this next, in place of whatever waits."""
        with self._changed:
            self._job = job
            self._changed.notify_all()

    def check(self) -> None:
        """Raise what a job has raised; nothing more is done after that."""
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
            except BaseException as error:  # whatever it is, the caller's thread must hear of it
                self._error = error
                return
            finally:
                with self._changed:
                    self._busy = False


class Turns:
    """Does its jobs in the caller's thread, one for every call of `run`; a context manager."""

    def __init__(self) -> None:
        self._job: Job | None = None
        self._busy = False
        self._error: BaseException | None = None

    @property
    def idle(self) -> bool:
        """Whether there is nothing to do."""
        return self._job is None and not self._busy

    def offer(self, job: Job) -> None:
        """Do this next, in place of whatever waits."""
        self._job = job

    def check(self) -> None:
        """Raise what a job has raised; nothing more is done after that."""
        if self._error is not None:
            raise self._error

    def run(self) -> bool:
        """Do what waits, and return whether anything did."""
        job, self._job = self._job, None
        if job is None or self._error is not None:
            return False
        self._busy = True
        try:
            job()
        except BaseException as error:  # whatever it is, the session must hear of it
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
