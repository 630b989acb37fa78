"""Publishes to each address in a separate thread, so that the main loop never waits for a receiver.

With live views, the oldest waiting fixes are dropped and counted; recorded views wait, so that all
their fixes are published. A missing receiver is reported once, in one line, and tried again with
every fix.
"""

from __future__ import annotations

import logging
import threading
from collections import deque
from types import TracebackType
from typing import Protocol, Self

from fingerpost.publishing.fix import Pictures, PublishedFix
from fingerpost.signals import leave_behind, wait_hearing_signals

_log = logging.getLogger(__name__)

_WAITING = 64
"""Greatest number of fixes that wait for a receiver: two seconds of them."""

_CLOSING_S = 2.0


class Transport(Protocol):
    """Sends fixes to receivers of one kind."""

    wants_pictures: bool

    def send(self, fix: PublishedFix, pictures: Pictures) -> None:
        """Send a fix; raise an OSError of one line without a receiver."""

    def close(self) -> None:
        """Disconnect; closing twice does nothing."""


class Publisher:
    """Passes fixes to a transport in a separate thread; a context manager.

    Parameters
    ----------
    name
        Name in messages: its address.
    transport
        The transport, which is closed at the end.
    waits
        Whether to wait for a slow receiver, as for recorded views, or to drop the oldest fixes.
    """

    def __init__(self, name: str, transport: Transport, *, waits: bool) -> None:
        self.name = name
        self._transport, self._waits = transport, waits
        self._queue: deque[tuple[PublishedFix, Pictures]] = deque()
        self._changed = threading.Condition()
        self._closed = False
        self._dropped = self._put = 0
        self._is_silent = False
        self._thread = threading.Thread(target=self._run, name=f"publish {name}", daemon=True)
        self._thread.start()

    @property
    def wants_pictures(self) -> bool:
        """Whether pictures are published as well."""
        return self._transport.wants_pictures

    def put(self, fix: PublishedFix, pictures: Pictures = ()) -> None:
        """Publish a fix.

        Parameters
        ----------
        fix
            The fix.
        pictures
            The views' frames; not used unless `wants_pictures`.
        """
        with self._changed:
            self._put += 1
            if self._waits:
                wait_hearing_signals(lambda most_s: self._changed.wait_for(self._has_room, most_s))
            elif len(self._queue) >= _WAITING:
                self._queue.popleft()
                self._dropped += 1
            self._queue.append((fix, pictures))
            self._changed.notify_all()

    def _has_room(self) -> bool:
        return len(self._queue) < _WAITING or self._closed

    def notes(self) -> list[str]:
        """Return remarks for the user at the end; none if all fixes were published."""
        if not self._dropped:
            return []
        return [f"{self.name}: {self._dropped} of {self._put} fixes were dropped: it was too slow"]

    def close(self) -> None:
        """Publish waiting fixes, for at most 2 s; closing twice does nothing."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join(_CLOSING_S)
        if self._thread.is_alive():
            _log.warning("%s: takes nothing; what waits is not published", self.name)
            leave_behind(self._thread)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    # --- in the publisher's thread ----------------------------------------------------------------

    def _run(self) -> None:
        try:
            while (taken := self._next()) is not None:
                self._send(*taken)
        finally:
            self._transport.close()

    def _next(self) -> tuple[PublishedFix, Pictures] | None:
        with self._changed:
            self._changed.wait_for(lambda: self._queue or self._closed)
            taken = self._queue.popleft() if self._queue else None
            self._changed.notify_all()
        return taken

    def _send(self, fix: PublishedFix, pictures: Pictures) -> None:
        try:
            self._transport.send(fix, pictures)
        except Exception as error:
            # A library may raise anything; tracking must continue.
            if not self._is_silent:
                self._is_silent = True
                strerror = getattr(error, "strerror", None)
                said = strerror or " ".join(str(error).split()) or repr(error)
                _log.warning("%s: %s; fixes go on, and it is tried again", self.name, said)
