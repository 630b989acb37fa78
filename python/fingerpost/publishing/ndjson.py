"""`ndjson:`: one JSON object per line, on standard output."""

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
        """Write a line, unless the reader has closed the pipe; raises `OSError` once."""
        if not self._has_reader:
            return
        try:
            _write(fix.as_json() + b"\n")
        except OSError:
            self._has_reader = False
            raise

    def close(self) -> None:
        """Do nothing: standard output stays open."""


def _write(line: bytes) -> None:
    """Write without Python's buffers: a thread that waits in them delays the program's end."""
    try:
        descriptor = sys.stdout.fileno()
    except OSError:  # not a file, but an object that stores its input
        sys.stdout.write(line.decode())
        return
    while line:
        line = line[os.write(descriptor, line) :]
