"""Zenoh sessions with a single end point, and the keys of their messages.

By default zenoh listens on every interface and discovers peers by multicast. Here a session has one
end point, to which it connects or at which it listens, and no scouting of any kind.
"""

from __future__ import annotations

import json
import re
import struct
from typing import TYPE_CHECKING

from fingerpost.errors import CaptureError
from fingerpost.installation import require

if TYPE_CHECKING:
    import zenoh

DEFAULT_PORT = 7447
"""Default port of zenoh's routers."""

_STAMP = struct.Struct("<qq")
_NOT_IN_KEYS = re.compile(r"[/*$?#\s]")


def open_session(host: str, port: int, *, listens: bool) -> zenoh.Session:
    """Open a session; it must be closed, or the program does not end.

    Parameters
    ----------
    host, port
        The end point, by TCP.
    listens
        Whether to listen there; otherwise connect to a router or a listening peer.

    Raises
    ------
    CaptureError
        Nobody answers there, or the port cannot be listened at.
    MissingExtraError
        The extra `net` is not installed.
    """
    library = require("zenoh", "net")
    place = f"{host}:{port}" if ":" not in host else f"[{host}]:{port}"
    endpoint = json.dumps([f"tcp/{place}"])
    settings = {
        "mode": '"peer"' if listens else '"client"',
        "listen/endpoints": endpoint if listens else "[]",
        "connect/endpoints": "[]" if listens else endpoint,
        "connect/timeout_ms": "0",
        "scouting/multicast/enabled": "false",
        "scouting/gossip/enabled": "false",
        # Intervals at which a lost peer is tried again.
        "connect/retry": "{period_init_ms: 200, period_max_ms: 2000, period_increase_factor: 1.5}",
    }
    config = library.Config()
    for key, value in settings.items():
        config.insert_json5(key, value)
    try:
        session: zenoh.Session = library.open(config)
    except library.ZError as error:
        raise CaptureError(_failure(str(error), place, listens=listens)) from error
    return session


def _failure(said: str, place: str, *, listens: bool) -> str:
    if not listens:
        return f"nobody answers at {place}"
    if "in use" in said:
        return f"{place} is in use; a port that is free is right"
    return f"cannot listen at {place}; an address of this machine is right"


def image_key(prefix: str, view: str) -> str:
    """Return the key of a view's images: JPEG, with a stamp attached."""
    return f"{prefix}/{re.sub(_NOT_IN_KEYS, '_', view)}/image"


def clock_key(prefix: str) -> str:
    """Return the key under which the clock of the stamps is queried."""
    return f"{prefix}/clock"


def stamp(index: int, time_ns: int) -> bytes:
    """Return the attachment of an image: its index and its capture time by the sender's clock.

    Parameters
    ----------
    index
        Index in the source.
    time_ns
        Capture time [ns].
    """
    return _STAMP.pack(index, time_ns)


def read_stamp(attached: bytes) -> tuple[int, int]:
    """Invert `stamp`.

    Raises
    ------
    CaptureError
        The attachment is not a stamp.
    """
    try:
        index, time_ns = _STAMP.unpack(attached)
    except struct.error as error:
        raise CaptureError(
            "its pictures have no stamp; fingerpost has to publish them, as `fingerpost cameras "
            "--publish` does"
        ) from error
    return index, time_ns
