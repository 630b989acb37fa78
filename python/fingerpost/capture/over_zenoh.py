"""A camera on another machine, as published by `fingerpost cameras --publish`.

Its pictures are stamped by the other machine's clock, whose offset is estimated as in NTP (Mills
1991): from the exchange with the shortest round trip among the latest ones. The error of the offset
is at most half that round-trip time.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import numpy as np

from fingerpost.errors import CaptureError, InvalidInputError
from fingerpost.installation import require
from fingerpost.zenoh_link import DEFAULT_PORT, clock_key, image_key, open_session, read_stamp

if TYPE_CHECKING:
    import zenoh

SCHEME = "zenoh://"

_KEPT_ANSWERS = 8
_ASKED_AT_FIRST = 8
_ASKED_EVERY_S = 1.0
_ANSWERED_S = 0.5
_GRAB_S = 0.1
"""Longest wait for a picture, after which a reader checks whether it is to stop [s]."""


class ClockOffset:
    """Offset of another clock, by exchanges of time stamps.

    Parameters
    ----------
    clock
        This machine's clock [ns].
    """

    def __init__(self, clock: Callable[[], int]) -> None:
        self._clock = clock
        self._answers: deque[tuple[int, int]] = deque(maxlen=_KEPT_ANSWERS)

    def add(self, asked_ns: int, answered_ns: int, there_ns: int) -> None:
        """Add one exchange.

        Parameters
        ----------
        asked_ns, answered_ns
            Times of the request and of the answer on this machine's clock [ns].
        there_ns
            Time on the other clock in the answer [ns].
        """
        round_trip_ns = answered_ns - asked_ns
        self._answers.append((round_trip_ns, there_ns - (asked_ns + round_trip_ns // 2)))

    @property
    def is_known(self) -> bool:
        """Whether there has been an answer."""
        return bool(self._answers)

    @property
    def best(self) -> tuple[int, int]:
        """Offset of the other clock, positive if it is ahead, and greatest error of that [ns]."""
        round_trip_ns, offset_ns = min(self._answers)
        return offset_ns, round_trip_ns // 2

    def here(self, there_ns: int) -> int:
        """Convert a time of the other clock to this machine's clock [ns]."""
        return there_ns - self.best[0]


class ZenohCamera:
    """Pictures under one key as a `Device`, which keeps the newest.

    Parameters
    ----------
    url
        `zenoh://HOST:PORT/KEY/VIEW`.
    timeout_s
        Time limit for the first answer of the other clock [s].
    clock
        This machine's clock [ns].

    Raises
    ------
    CaptureError
        There is no answer, or no pictures are published under the key.
    InvalidInputError
        The URL names no key.
    """

    def __init__(self, url: str, timeout_s: float, clock: Callable[[], int]) -> None:
        host, port, self._prefix, view = parts_of(url)
        self._clock = clock
        self._offset = ClockOffset(clock)
        self._arrived = threading.Condition()
        self._newest: zenoh.Sample | None = None
        self._taken = b""
        self._captured_ns = 0
        self._session = open_session(host, port, listens=False)
        self._released = threading.Event()
        try:
            self._ask_until_known(timeout_s / 2.0)  # to report it before its reader gives up
            channel: Any = require("zenoh", "net").handlers.RingChannel(1)
            self._pictures = self._session.declare_subscriber(
                image_key(self._prefix, view), channel
            )
        except BaseException:
            self._session.close()  # type: ignore[no-untyped-call]
            raise
        # Channels and Python's own threads: a thread of zenoh that calls Python while the
        # interpreter shuts down crashes the process.
        self._threads = [
            threading.Thread(target=one) for one in (self._take_pictures, self._ask_on)
        ]
        for thread in self._threads:
            thread.start()

    def _ask_until_known(self, longest_s: float) -> None:
        end_s = time.monotonic() + longest_s
        for _ in range(_ASKED_AT_FIRST):
            self._ask()
        while not self._offset.is_known:
            if time.monotonic() > end_s:
                raise CaptureError(
                    f"nobody publishes pictures under {self._prefix!r} there; "
                    "`fingerpost cameras --publish` does"
                )
            time.sleep(_GRAB_S)
            self._ask()

    def _ask(self) -> None:
        """Request the other clock's time, and wait for the answer."""
        asked_ns = self._clock()
        for reply in self._session.get(clock_key(self._prefix), timeout=_ANSWERED_S):
            answered_ns = self._clock()
            if reply.ok is not None:
                self._offset.add(asked_ns, answered_ns, int(reply.ok.payload.to_bytes()))

    def _ask_on(self) -> None:
        while not self._released.wait(_ASKED_EVERY_S):
            self._ask()

    def _take_pictures(self) -> None:
        for sample in self._pictures:
            with self._arrived:
                self._newest = sample
                self._arrived.notify_all()

    def isOpened(self) -> bool:  # noqa: N802 - OpenCV's name
        """Whether pictures may come."""
        return self._offset.is_known

    def grab(self) -> bool:
        """Wait for a new picture, at most `_GRAB_S`."""
        with self._arrived:
            self._arrived.wait_for(lambda: self._newest is not None, _GRAB_S)
            sample, self._newest = self._newest, None
        if sample is None:
            return False
        attached = b"" if sample.attachment is None else sample.attachment.to_bytes()
        _, there_ns = read_stamp(attached)
        self._captured_ns = self._offset.here(there_ns)
        self._taken = sample.payload.to_bytes()
        return True

    def captured_ns(self) -> int:
        """Return the capture time of the last picture on this machine's clock [ns]."""
        return self._captured_ns

    def retrieve(self) -> tuple[bool, Any]:
        """Return the last picture as it was sent, in one row."""
        return bool(self._taken), np.frombuffer(self._taken, np.uint8)[None]

    @property
    def notes(self) -> tuple[str, ...]:
        """Remarks for the user on the other machine's clock."""
        offset_ns, error_ns = self._offset.best
        way = "ahead of" if offset_ns >= 0 else "behind"
        return (
            f"its clock is {abs(offset_ns) / 1e6:.1f} ms {way} this machine's, "
            f"to within {error_ns / 1e6:.1f} ms, and its times are corrected by that",
        )

    def release(self) -> None:
        """Close the session."""
        self._released.set()
        self._pictures.undeclare()  # type: ignore[no-untyped-call]
        for thread in self._threads:
            thread.join()
        self._session.close()  # type: ignore[no-untyped-call]


def parts_of(url: str) -> tuple[str, int, str, str]:
    """Return host, port, key and view of a URL such as `zenoh://pi.local:7447/fingerpost/left`.

    Raises
    ------
    InvalidInputError
        Not such a URL.
    """
    try:
        parts = urlsplit(url)
        port = parts.port or DEFAULT_PORT
    except ValueError as error:
        raise InvalidInputError(f"{url}: is no URL: {error}") from error
    prefix, _, view = parts.path.strip("/").rpartition("/")
    if not (prefix and view):
        raise InvalidInputError(
            f"{url}: names no camera; zenoh://HOST:PORT/KEY/NAME is right, as `fingerpost cameras "
            "--publish` prints it"
        )
    return parts.hostname or "127.0.0.1", port, prefix, view
