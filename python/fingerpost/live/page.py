"""The main loop's interface to the operator's page: shows steps, and limits the loop's progress.

A separate process (`fingerpost.live.process`) serves the page, so that neither clients nor
transmissions hold the interpreter lock of the tracker. Pictures are encoded in a thread of low
priority, by code that releases the lock. With cameras, older steps are dropped for the newest; with
recordings none is dropped, and the loop runs as far as the page requests.
"""

from __future__ import annotations

import logging
import os
import secrets
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from multiprocessing import get_context
from types import TracebackType
from typing import Any, Self, TypeVar

from fingerpost.errors import FingerpostError, InvalidInputError
from fingerpost.installation import require
from fingerpost.live.commands import FRAMED, Gone, RobotCommand
from fingerpost.live.moment import Moment
from fingerpost.live.process import serve
from fingerpost.live.scene import RigScene
from fingerpost.live.setup.asked import Arrange, Dropped, SetUpCommand
from fingerpost.pipeline import Step
from fingerpost.signals import wait_hearing_signals
from fingerpost.workers import held_back

_log = logging.getLogger(__name__)

Frames = TypeVar("Frames")

WINDOW = 2
"""Greatest number of moments that the page's process has not finished."""

_EXTRA = "page"
_MODULES = ("starlette", "uvicorn", "websockets")

_NICE = 10
_END_S = 4.0
_TOKEN_BYTES = 24


class Page:
    """Serves the operator's page for the duration of a context.

    Parameters
    ----------
    host
        Address of this machine at which the page is served.
    port
        Port; 0 chooses a free one.

    Raises
    ------
    InvalidInputError
        The address cannot be used.
    MissingExtraError
        The extra `page` is not installed.

    Attributes
    ----------
    address
        Address to open in a browser; it contains the required token.
    framed_address
        Address for a frame in a page of another site, such as a notebook.
    """

    def __init__(self, host: str, port: int) -> None:
        for module in _MODULES:
            require(module, _EXTRA)
        self._lock = threading.Lock()
        self._changed = threading.Condition()
        self._is_live = False
        self._allowed = 0.0
        self._given = 0
        self._next: tuple[Step, int, float, float] | None = None
        self._number = 0
        self._begun_s = 0.0
        self._asked: deque[SetUpCommand | Dropped] = deque()
        self._guide: Callable[[RobotCommand], None] = lambda _command: None
        self._unanswered = 0
        self._lost = False
        self._closed = False
        token = secrets.token_urlsafe(_TOKEN_BYTES)
        context = get_context("spawn")
        self._pipe, theirs = context.Pipe()
        with held_back():
            self._process = context.Process(
                target=serve, args=(theirs, host, port, token), name="fingerpost page", daemon=True
            )
            self._process.start()
        theirs.close()
        try:
            base = f"http://{host}:{self._listening(host, port)}"
        except BaseException:
            self.close()
            raise
        self.address = f"{base}/?token={token}"
        self.framed_address = f"{base}{FRAMED}{token}/"
        self._threads = [
            threading.Thread(target=self._send_moments, name="page pictures", daemon=True),
            threading.Thread(target=self._listen, name="page commands", daemon=True),
        ]
        for thread in self._threads:
            thread.start()

    def _listening(self, host: str, port: int) -> int:
        """Wait until the process listens, and return its port."""
        try:
            kind, content = self._pipe.recv()
        except EOFError:
            raise FingerpostError("the page's process has ended before it began") from None
        if kind == "listening":
            return int(content)
        raise InvalidInputError(
            f"{host}:{port}: the page cannot be served there: {content}; another --port is right, "
            "or none"
        )

    @property
    def is_closed(self) -> bool:
        """Whether the program has closed it."""
        return self._closed

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def show_setup(self, state: dict[str, Any]) -> None:
        """Show the state of a rig's set-up."""
        self._post("setup", state)

    def show_still(self, place: int, jpeg: bytes) -> None:
        """Show a picture of an offered source, by its index."""
        self._post("still", (place, jpeg))

    def asked(self) -> SetUpCommand | Dropped:
        """Wait for a command of the page while a rig is set up.

        Of several consecutive arrangements only the last one counts, if it requests as much.

        Raises
        ------
        FingerpostError
            The page's process has ended.
        """
        with self._changed:
            self._wait_for(lambda: self._lost or self._asked)
            self._refuse_lost()
            asked = self._asked.popleft()
            while (
                isinstance(asked, Arrange)
                and self._asked
                and isinstance(newer := self._asked[0], Arrange)
                and newer.finds >= asked.finds
            ):
                asked = self._asked.popleft()
            return asked

    def is_asked(self) -> bool:
        """Return whether a command of the page is waiting; true once its process has ended."""
        return self._lost or bool(self._asked)

    def open_rig(self, scene: RigScene) -> None:
        """Show a rig, to which the following steps belong."""
        with self._changed:
            self._is_live = scene.is_live
            self._allowed = 0.0
            self._given = self._number = 0
        self._post("rig", scene)

    def allowed(self, frames: Iterator[Frames]) -> Iterator[Frames]:
        """Yield frames of all views for as long as the page permits.

        Raises
        ------
        FingerpostError
            The page's process has ended.
        """
        while True:
            with self._changed:
                self._wait_for(lambda: self._lost or self._given < self._allowed)
            self._refuse_lost()
            together = next(frames, None)
            if together is None:
                return
            self._begun_s = time.monotonic()
            self._given += 1
            yield together

    def show(self, step: Step, *, begun_s: float | None = None) -> None:
        """Show a step; for a recording, wait until the previous ones have been sent.

        Parameters
        ----------
        step
            The step.
        begun_s
            Monotonic time at which processing began; by default, for a camera, the capture time.

        Raises
        ------
        FingerpostError
            The page's process has ended.
        """
        reported_s = time.monotonic()
        if begun_s is None:
            begun_s = step.fix.time_s if self._is_live else self._begun_s
        with self._changed:
            if not self._is_live:
                self._wait_for(lambda: self._lost or self._next is None)
            self._next = step, self._number, begun_s, reported_s
            self._number += 1
            self._changed.notify_all()
        self._refuse_lost()

    def show_arm(self, state: dict[str, Any]) -> None:
        """Show the state of an arm, from any thread."""
        self._post("arm", state)

    @contextmanager
    def guiding(self, guide: Callable[[RobotCommand], None]) -> Iterator[None]:
        """Pass on the page's commands to an arm, for the duration of the block.

        Parameters
        ----------
        guide
            Called with each command at once, from a thread, and with `Gone` when the page's process
            has ended. Must not wait.
        """
        self._guide = guide
        try:
            yield
        finally:
            self._guide = lambda _command: None

    def note(self, words: str) -> None:
        """Show a message to the user, one line."""
        self._post("note", words)

    def end(self, words: str) -> None:
        """Report the end of the steps, with the reason."""
        with self._changed:
            self._wait_for(lambda: self._lost or (self._next is None and self._unanswered == 0))
        self._post("ended", words)

    def wait(self) -> None:
        """Wait until the page's process has ended.

        Raises
        ------
        FingerpostError
            It has.
        """
        with self._changed:
            self._wait_for(lambda: self._lost)
        self._refuse_lost()

    def close(self) -> None:
        """End the page's process; clients are notified. Closing twice does nothing."""
        if self._closed:
            return
        with self._changed:
            self._closed = self._lost = True
            self._changed.notify_all()
        with suppress(OSError, ValueError), self._lock:
            self._pipe.send(("close", None))
        self._process.join(_END_S)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        for thread in getattr(self, "_threads", ()):
            thread.join()
        self._pipe.close()

    def _wait_for(self, true: Callable[[], object]) -> None:
        wait_hearing_signals(lambda most_s: self._changed.wait_for(true, most_s))

    def _refuse_lost(self) -> None:
        if self._lost:
            raise FingerpostError("the page's process has ended; start the command again")

    def _post(self, kind: str, content: Any) -> None:
        with suppress(OSError), self._lock:  # the end of the process is detected by the listener
            self._pipe.send((kind, content))

    def _send_moments(self) -> None:
        """Encode and send moments: the body of a thread."""
        _yield_to_others()
        while True:
            with self._changed:
                self._changed.wait_for(
                    lambda: self._lost or (self._next and self._unanswered < WINDOW)
                )
                if self._lost or self._next is None:
                    return
                taken, self._next = self._next, None
                self._unanswered += 1
                self._changed.notify_all()
            self._post("moment", Moment.of(*taken))

    def _listen(self) -> None:
        """Receive the page's answers and commands: the body of a thread."""
        with suppress(EOFError, OSError):
            while True:
                kind, content = self._pipe.recv()
                if kind == "arm":
                    self._hand_on(content)
                    continue
                with self._changed:
                    if kind == "done":
                        self._unanswered -= 1
                    elif kind == "allow":
                        self._allowed = content
                    elif kind == "setup":
                        self._asked.append(content)
                    self._changed.notify_all()
        self._hand_on(Gone())
        with self._changed:
            self._lost = True
            self._changed.notify_all()

    def _hand_on(self, command: RobotCommand) -> None:
        """Pass on a command; after any error the next one, which may be a stop, must work."""
        try:
            self._guide(command)
        except Exception:
            _log.exception("the page's %s failed", type(command).__name__)


def _yield_to_others() -> None:
    """Lower the priority of this thread, if the system supports priorities of threads."""
    if hasattr(os, "setpriority") and hasattr(threading, "get_native_id"):
        with suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)
