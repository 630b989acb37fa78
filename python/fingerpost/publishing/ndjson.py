"""`ndjson:`: one JSON object a line, on standard output."""

from __future__ import annotations

import os
import sys

from fingerpost.publishing.address import Address
from fingerpost.publishing.fix import Extent, Pictures, PublishedFix


class JsonLines:
    """Writes to standard output; parameters as `registry.Opener`."""

    wants_pictures = False

    def __init__(self, address: Address, _extent: Extent) -> None:
        address.refuse_others([])
        self._has_reader = True

    def send(self, fix: PublishedFix, _pictures: Pictures) -> None:
        """Write a line, unless nobody reads them any more; raises `OSError` once."""
        if not self._has_reader:
            return
        try:
            _write(fix.as_json() + b"\n")
        except OSError:
            self._has_reader = False
            raise

    def close(self) -> None:
        """Leave standard output as it is."""


def _write(line: bytes) -> None:
    """Write below Python's buffers: a thread that waits in them holds up the program's end."""
    try:
        descriptor = sys.stdout.fileno()
    except OSError:  # no file, but an object that keeps what is written
        sys.stdout.write(line.decode())
        return
    while line:
        line = line[os.write(descriptor, line) :]
