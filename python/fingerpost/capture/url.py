"""Sources that are URLs, and their names in messages.

Parts of a URL that may be secret are never shown: user names, passwords, queries, and parts of
paths that resemble tokens.
"""

from __future__ import annotations

import re

_HIDDEN = "***"
# Words and short numbers, as in "Streaming/Channels/101" or "cam-2/video.mjpg"; a token is longer,
# or mixes letters and digits.
_PLAIN = re.compile(
    r"(?=.{0,16}$)(?:[A-Za-z]?[a-z]+|[A-Z]+)(?:[-_.][A-Za-z]+)*[-_]?\d{0,2}(?:\.\w{2,5})?|\d{1,4}|"
)


def is_url(source: str) -> bool:
    """Return whether a source is a URL."""
    return "://" in source


def masked(source: str | int) -> str:
    """Return the name of a live source for messages, without parts that may be secret."""
    if isinstance(source, int):
        return f"camera {source}"
    if not is_url(source):
        return source
    scheme, _, rest = source.partition("://")
    place, question, _ = rest.partition("?")
    authority, slash, path = place.partition("/")
    if "@" in place:  # a password may hold a slash
        authority, slash, path = place.rpartition("@")[2].partition("/")
        authority = f"{_HIDDEN}@{authority}"
    parts = [part if _PLAIN.fullmatch(part) else _HIDDEN for part in path.split("/")]
    return f"{scheme}://{authority}{slash}{'/'.join(parts)}{question}{_HIDDEN if question else ''}"
