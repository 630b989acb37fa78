"""Sessions of zenoh that reach no further than they are asked to, and what stands under which key.

Left to itself zenoh listens on every interface and looks for others by multicast. Here a session
has one end point, which it connects to or listens at, and no scouting of any kind.
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
"""Where zenoh's routers listen."""

_STAMP = struct.Struct("<qq")
_NOT_IN_KEYS = re.compile(r"[/*$?#\s]")


def open_session(host: str, port: int, *, listens: bool) -> zenoh.Session:
    """Open a session; close it in the end, or the program does not end.

    Parameters
    ----------
    host, port
        The end point, by TCP.
    listens
        Whether to wait there for others; to connect to a router, or to who listens, if not.

    Raises
    ------
    CaptureError
        Nobody answers there, or nothing can listen there.
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
        # A lost peer is tried again at this pace.
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
    """Return the key of a view's pictures: JPEG, with a stamp attached."""
    return f"{prefix}/{re.sub(_NOT_IN_KEYS, '_', view)}/image"


def clock_key(prefix: str) -> str:
    """Return the key that is asked for the time by which pictures are stamped."""
    return f"{prefix}/clock"


def stamp(index: int, time_ns: int) -> bytes:
    """Return what is attached to a picture: its index, and its capture time by the sender's clock.

    Parameters
    ----------
    index
        In its source.
    time_ns
        [ns]
    """
    return _STAMP.pack(index, time_ns)


def read_stamp(attached: bytes) -> tuple[int, int]:
    """Undo `stamp`.

    Raises
    ------
    CaptureError
        It is none.
    """
    try:
        index, time_ns = _STAMP.unpack(attached)
    except struct.error as error:
        raise CaptureError(
            "its pictures have no stamp; fingerpost has to publish them, as `fingerpost cameras "
            "--publish` does"
        ) from error
    return index, time_ns
