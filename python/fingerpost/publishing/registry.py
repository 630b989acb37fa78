"""Transports by scheme: a new kind of receiver is one more entry."""

from __future__ import annotations

from collections.abc import Callable

from fingerpost.errors import InvalidInputError
from fingerpost.publishing.address import Address
from fingerpost.publishing.fix import Extent
from fingerpost.publishing.ndjson import JsonLines
from fingerpost.publishing.osc import Osc, Tuio
from fingerpost.publishing.over_zenoh import Zenoh
from fingerpost.publishing.publisher import Publisher, Transport
from fingerpost.publishing.ros2 import Ros2
from fingerpost.publishing.websocket import WebSockets

Opener = Callable[[Address, Extent], Transport]
"""Makes a transport from an address and the plane's extent. Raises `InvalidInputError` if either is
invalid, `MissingExtraError` if the extra `net` is not installed."""

SCHEMES: dict[str, Opener] = {
    "ndjson": JsonLines,
    "osc": Osc,
    "tuio": Tuio,
    "ws": WebSockets,
    "zenoh": Zenoh,
    "zenoh+ros2": Ros2,
}
"""Transport of each scheme."""


def open_publisher(url: str, extent: Extent, *, waits: bool) -> Publisher:
    """Begin to publish.

    Parameters
    ----------
    url
        The address; see `docs/publishing.md`.
    extent
        Extent of the plane.
    waits
        As in `Publisher`.

    Raises
    ------
    InvalidInputError
        An invalid URL, or one that cannot be published to.
    MissingExtraError
        The extra `net` is not installed.
    """
    address = refuse_unknown(url)
    name = url.removesuffix(":")
    return Publisher(name, SCHEMES[address.scheme](address, extent), waits=waits)


def refuse_unknown(url: str) -> Address:
    """Parse a URL; refuse an unknown scheme.

    Raises
    ------
    InvalidInputError
        An invalid URL, or an unknown scheme.
    """
    address = Address.of(url)
    if address.scheme not in SCHEMES:
        known = ", ".join(f"{scheme}:" for scheme in SCHEMES)
        raise InvalidInputError(f"{url}: cannot be published to; {known} are right at its start")
    return address
