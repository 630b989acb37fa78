"""A camera on another machine, as `fingerpost cameras --publish` sends it.

Its pictures are stamped by the other machine's clock. What that clock shows is asked as NTP does
(Mills 1991): of the latest answers the one that came back soonest is believed, and the error of its
offset is half that time at most.
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
"""A reader that is to stop waits no longer for a picture."""


class ClockOffset:
    """How far another clock is ahead, by questions and answers.

    Parameters
    ----------
    clock
        This machine's [ns].
    """

    def __init__(self, clock: Callable[[], int]) -> None:
        self._clock = clock
        self._answers: deque[tuple[int, int]] = deque(maxlen=_KEPT_ANSWERS)

    def add(self, asked_ns: int, answered_ns: int, there_ns: int) -> None:
        """Take an answer.

        Parameters
        ----------
        asked_ns, answered_ns
            When the question left and the answer came, by this machine's clock [ns].
        there_ns
            What the other clock showed [ns].
        """
        round_trip_ns = answered_ns - asked_ns
        self._answers.append((round_trip_ns, there_ns - (asked_ns + round_trip_ns // 2)))

    @property
    def is_known(self) -> bool:
        """Whether there was an answer."""
        return bool(self._answers)

    @property
    def best(self) -> tuple[int, int]:
        """By how much the other clock is ahead, and how far off that may be [ns]."""
        round_trip_ns, offset_ns = min(self._answers)
        return offset_ns, round_trip_ns // 2

    def here(self, there_ns: int) -> int:
        """Return what this machine's clock showed when the other one showed a time [ns]."""
        return there_ns - self.best[0]


class ZenohCamera:
    """Pictures of one key as a `Device`; the newest wins.

    Parameters
    ----------
    url
        `zenoh://HOST:PORT/KEY/VIEW`.
    timeout_s
        How long the other clock may take to answer at first.
    clock
        This machine's [ns].

    Raises
    ------
    CaptureError
        Nobody answers there, or nobody publishes pictures under the key.
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
            self._ask_until_known(timeout_s / 2.0)  # to say so before its reader gives up
            channel: Any = require("zenoh", "net").handlers.RingChannel(1)
            self._pictures = self._session.declare_subscriber(
                image_key(self._prefix, view), channel
            )
        except BaseException:
            self._session.close()  # type: ignore[no-untyped-call]
            raise
        # Channels and threads of Python's own, for one of zenoh's that calls Python while the
        # interpreter ends takes the process down.
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
        """Ask for the other clock's time, and wait for the answer."""
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
        """Wait for a new picture, a tenth of a second at most."""
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
        """Return when the last picture was captured, by this machine's clock [ns]."""
        return self._captured_ns

    def retrieve(self) -> tuple[bool, Any]:
        """Return the last picture as it was sent, in one row."""
        return bool(self._taken), np.frombuffer(self._taken, np.uint8)[None]

    @property
    def notes(self) -> tuple[str, ...]:
        """What is to be said of the other machine's clock, for people."""
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
        It is none.
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
