"""`SCHEME://HOST:PORT/PATH?key=value`, as a publisher's address is given."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from urllib.parse import parse_qsl, urlsplit

from fingerpost.errors import InvalidInputError

LOOPBACK = "127.0.0.1"
_LARGEST_PORT = 65535


@dataclass(frozen=True, slots=True)
class Address:
    """Where to publish.

    Attributes
    ----------
    url
        As it was given.
    scheme
        Which receivers it is for.
    host, port
        Where they are, or where they come to; this machine alone if nothing is said. The port is
        None if nothing is said.
    path
        Without slashes at its ends.
    options
        By their keys; one without a value is empty.
    """

    url: str
    scheme: str
    host: str
    port: int | None
    path: str
    options: Mapping[str, str]

    @classmethod
    def of(cls, url: str) -> Address:
        """Read a URL.

        Raises
        ------
        InvalidInputError
            It is none.
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
            Where nothing is said.
        is_free
            Whether 0, any that is free, is right as well.
        """
        port = default if self.port is None else self.port
        if not (is_free or 1 <= port <= _LARGEST_PORT):
            raise InvalidInputError(f"{self.url}: port {port}; 1 to {_LARGEST_PORT} is right")
        return port

    def refuse_others(self, known: Sequence[str], *, has_path: bool = False) -> None:
        """Refuse what this scheme knows nothing of.

        Parameters
        ----------
        known
            Keys of options.
        has_path
            Whether a path means anything.

        Raises
        ------
        InvalidInputError
            An option or a path that means nothing.
        """
        for key in self.options:
            if key not in known:
                words = f"known are {', '.join(known)}" if known else "there are none"
                raise InvalidInputError(f"{self.url}: unknown option {key!r}; {words}")
        if self.path and not has_path:
            raise InvalidInputError(f"{self.url}: a path means nothing here; leave it out")

    def choice(self, key: str, choices: Sequence[str]) -> str:
        """Return an option that is one of several words; the first where nothing is said."""
        value = self.options.get(key, choices[0])
        if value not in choices:
            raise InvalidInputError(
                f"{self.url}: {key} is {value!r}; one of {', '.join(choices)} is right"
            )
        return value
