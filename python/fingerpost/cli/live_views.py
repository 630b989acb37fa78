"""Common part of commands that read live views."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

import click

from fingerpost.cli.arming import seconds

_LONGEST_SILENCE_S = 1e9

give_up_option = click.option(
    "--give-up-after",
    "give_up_after_s",
    metavar="S",
    type=float,
    callback=seconds(_LONGEST_SILENCE_S),
    help="End when a live view has sent nothing for so long.  [default: wait until it is back]",
)
"""Adds the parameter `give_up_after_s` to a command."""


def hush_streams(sources: Mapping[str, str | int]) -> None:
    """Silence the decoders of streams, before the first is opened.

    The messages of a file's decoder are captured and kept from the terminal (`capture.messages`).
    A stream's thread decodes at any time; its messages would appear between other lines.

    Parameters
    ----------
    sources
        As `Rig.sources`.
    """
    from fingerpost.capture import is_url

    names = [source for source in sources.values() if isinstance(source, str)]
    if any(is_url(name) or Path(name).is_fifo() for name in names):
        os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
