"""Address of a publisher: `SCHEME://HOST:PORT/PATH?key=value`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from urllib.parse import parse_qsl, urlsplit

from fingerpost.errors import InvalidInputError

LOOPBACK = "127.0.0.1"
_LARGEST_PORT = 65535


@dataclass(frozen=True, slots=True)
class Address:
    """Address to publish to.

    Attributes
    ----------
    url
        The original URL.
    scheme
        Scheme, which selects the protocol.
    host, port
        Address of the receivers, or at which to listen; by default this machine. The port is None
        by default.
    path
        Path without leading and trailing slashes.
    options
        Options by key; one without a value is empty.
    """

    url: str
    scheme: str
    host: str
    port: int | None
    path: str
    options: Mapping[str, str]

    @classmethod
    def of(cls, url: str) -> Address:
        """Parse a URL.

        Raises
        ------
        InvalidInputError
            Not a valid URL.
        """
        try:
            parts = urlsplit(url)
            port = parts.port
        except ValueError as error:
            raise InvalidInputError(f"{url}: is no URL: {error}") from error
        if parts.username is not None or parts.fragment:
            raise InvalidInputError(f"{url}: takes neither a user nor a #fragment")
        return cls(
            url,
            parts.scheme,
            parts.hostname or LOOPBACK,
            port,
            parts.path.strip("/"),
            dict(parse_qsl(parts.query, keep_blank_values=True)),
        )

    def with_options(self, options: Mapping[str, str]) -> Address:
        """Return the address with these options, in place of its own."""
        return replace(self, options=options)

    def port_or(self, default: int, *, is_free: bool = False) -> int:
        """Return the port.

        Parameters
        ----------
        default
            Port by default.
        is_free
            Whether 0, for any free port, is allowed.
        """
        port = default if self.port is None else self.port
        if not (is_free or 1 <= port <= _LARGEST_PORT):
            raise InvalidInputError(f"{self.url}: port {port}; 1 to {_LARGEST_PORT} is right")
        return port

    def refuse_others(self, known: Sequence[str], *, has_path: bool = False) -> None:
        """Refuse parts that this scheme does not use.

        Parameters
        ----------
        known
            Keys of options.
        has_path
            Whether it uses a path.

        Raises
        ------
        InvalidInputError
            An unknown option, or an unused path.
        """
        for key in self.options:
            if key not in known:
                words = f"known are {', '.join(known)}" if known else "there are none"
                raise InvalidInputError(f"{self.url}: unknown option {key!r}; {words}")
        if self.path and not has_path:
            raise InvalidInputError(f"{self.url}: a path means nothing here; leave it out")

    def choice(self, key: str, choices: Sequence[str]) -> str:
        """Return an option with a fixed set of values; the first by default."""
        value = self.options.get(key, choices[0])
        if value not in choices:
            raise InvalidInputError(
                f"{self.url}: {key} is {value!r}; one of {', '.join(choices)} is right"
            )
        return value
