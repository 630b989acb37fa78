"""What a page may ask for: one JSON object a message, and nothing else."""

from __future__ import annotations

import msgspec

from fingerpost.live.setup.asked import SetUpCommand

LARGEST_BYTES = 64 * 1024
"""Longest message that is read at all."""


class _Command(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="do"):
    """What all commands share: no other keys."""


class Ack(_Command, frozen=True, tag="ack"):
    """A moment has been drawn."""


class Stop(_Command, frozen=True, tag="stop"):
    """Stand still at once."""


class Play(_Command, frozen=True, tag="play"):
    """Go on."""


class Step(_Command, frozen=True, tag="step"):
    """Stand still, so many moments further.

    Attributes
    ----------
    by
        How many; below 0 is back.
    """

    by: int


class GoTo(_Command, frozen=True, tag="seek"):
    """Show a moment.

    Attributes
    ----------
    number
        Which, from 0.
    """

    number: int


class Take(_Command, frozen=True, tag="take"):
    """Take the control over from another page."""


Command = Ack | Stop | Play | Step | GoTo | Take | SetUpCommand

decode = msgspec.json.Decoder(Command).decode
"""From JSON to a command; raises `msgspec.MsgspecError`."""
