"""`zenoh://`: fixes as JSON, and the views' pictures if asked for, to programs on other machines.

`KEY/fix` carries JSON. With `?pictures`, `KEY/VIEW/image` carries each frame as JPEG with its time
stamp, and a query of `KEY/clock` returns the clock's time, so that a rig on another machine can use
them as a source (`fingerpost.capture`).
"""

from __future__ import annotations

import threading
import time
from typing import TYPE_CHECKING, Any

from fingerpost.errors import CaptureError, InvalidInputError
from fingerpost.publishing.address import Address
from fingerpost.publishing.encoding import encoded
from fingerpost.publishing.fix import Extent, Pictures, PublishedFix
from fingerpost.zenoh_link import DEFAULT_PORT, clock_key, image_key, open_session, stamp

if TYPE_CHECKING:
    import zenoh

_KEY = "fingerpost"
_ROLES = ("connect", "listen")
_RETRY_S = 1.0
_MOST_QUESTIONS = 16


class Link:
    """A session that is opened as soon as there is a peer, and checked for its presence.

    Parameters
    ----------
    address
        Host and port of the end point.
    listens
        Whether to listen there, rather than to connect.

    Raises
    ------
    InvalidInputError
        The address cannot be used.
    MissingExtraError
        The extra `net` is not installed.
    """

    def __init__(self, address: Address, *, listens: bool) -> None:
        self._address, self._listens = address, listens
        self._session: zenoh.Session | None = None
        self._one_at_a_time = threading.Lock()  # several cameras share a link
        self._asked_s = -_RETRY_S
        self._failure: CaptureError | None = None
        try:
            self._open()
        except CaptureError as error:
            if listens:
                raise InvalidInputError(f"{address.url}: {error}") from error
            self._failure = error

    def _open(self) -> None:
        self._asked_s = time.monotonic()
        port = self._address.port_or(DEFAULT_PORT)
        self._session = open_session(self._address.host, port, listens=self._listens)

    def session(self) -> zenoh.Session:
        """Return the session.

        Raises
        ------
        CaptureError
            There is no peer. This is checked once a second.
        """
        with self._one_at_a_time:
            return self._checked()

    def _checked(self) -> zenoh.Session:
        now_s = time.monotonic()
        if now_s - self._asked_s >= _RETRY_S:
            self._failure = None
            if self._session is None:
                try:
                    self._open()
                except CaptureError as error:
                    self._failure = error
            elif not self._listens and not self._has_peer():
                self._failure = CaptureError("the other end is gone")
            self._asked_s = now_s
        if self._failure is not None or self._session is None:
            raise self._failure or CaptureError("nobody is there")
        return self._session

    def _has_peer(self) -> bool:
        assert self._session is not None
        info = self._session.info
        return bool(info.routers_zid() or info.peers_zid())

    def close(self) -> None:
        """Close the session, if there is one."""
        if self._session is not None:
            self._session.close()  # type: ignore[no-untyped-call]
        self._session = None
        self._asked_s = float("inf")


class Zenoh:
    """Publishes fixes, or pictures alone; parameters as `registry.Opener`."""

    def __init__(self, address: Address, _extent: Extent | None = None) -> None:
        address.refuse_others(["role", "pictures"], has_path=True)
        self._key = address.path or _KEY
        refuse_wild(address, self._key)
        self.wants_pictures = "pictures" in address.options
        self._link = Link(address, listens=address.choice("role", _ROLES) == "listen")
        self._clock: _Clock | None = None
        self._one_at_a_time = threading.Lock()

    def send(self, fix: PublishedFix, pictures: Pictures) -> None:
        """Send a fix, and pictures if requested."""
        import zenoh

        session = self._link.session()
        session.put(
            f"{self._key}/fix",
            fix.as_json(),
            encoding=zenoh.Encoding.APPLICATION_JSON,
            congestion_control=congestion_control(waits=fix.is_recorded),
            express=True,
        )
        if self.wants_pictures:
            self.send_pictures(pictures, waits=fix.is_recorded)

    def send_pictures(self, pictures: Pictures, *, waits: bool = False) -> None:
        """Send pictures, each with its time stamp; raises `CaptureError` without a peer."""
        import zenoh

        session = self._link.session()
        with self._one_at_a_time:
            if self._clock is None:
                self._clock = _Clock(session, clock_key(self._key))
        for view, picture in pictures:
            session.put(
                image_key(self._key, view),
                encoded(picture),
                encoding=zenoh.Encoding.IMAGE_JPEG,
                congestion_control=congestion_control(waits=waits),
                attachment=stamp(picture.index, round(picture.time_s * 1e9)),
            )

    def close(self) -> None:
        """Close the session."""
        if self._clock is not None:
            self._clock.close()
        self._clock = None
        self._link.close()


class _Clock:
    """Answers queries with the time of the clock by which pictures are stamped [ns].

    It uses Python's own thread: a thread of zenoh that calls Python while the interpreter shuts
    down crashes the process.
    """

    def __init__(self, session: zenoh.Session, key: str) -> None:
        import zenoh

        channel: Any = zenoh.handlers.FifoChannel(_MOST_QUESTIONS)
        self._questions = session.declare_queryable(key, channel)
        self._thread = threading.Thread(target=self._answer, daemon=True)
        self._thread.start()

    def _answer(self) -> None:
        for query in self._questions:
            with query:
                query.reply(query.key_expr, str(time.monotonic_ns()))

    def close(self) -> None:
        self._questions.undeclare()  # type: ignore[no-untyped-call]
        self._thread.join()


def congestion_control(*, waits: bool) -> zenoh.CongestionControl:
    """Return whether a message waits for a busy connection, or is dropped as outdated."""
    import zenoh

    return zenoh.CongestionControl.BLOCK if waits else zenoh.CongestionControl.DROP


def refuse_wild(address: Address, key: str) -> None:
    """Refuse a key with wildcards, or an invalid one.

    Raises
    ------
    InvalidInputError
        Such a key.
    """
    if any(sign in key for sign in "*$?#") or "//" in key:
        raise InvalidInputError(f"{address.url}: {key!r} is no single key; lab/left is right")
