"""What a page may ask for: one JSON object a message, and nothing else."""

from __future__ import annotations

from enum import StrEnum

import msgspec

from fingerpost.live.setup.asked import SetUpCommand

LARGEST_BYTES = 64 * 1024
"""Longest message that is read at all."""

FRAMED = "/framed/"
"""Paths that begin with this and the token are those of a page in a frame of another site."""


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


class Wish(StrEnum):
    """What an operator may ask of an arm."""

    ARM = "arm"
    """Let it move while the page holds."""
    DISARM = "disarm"
    HOME = "home"
    FOLLOW = "follow"
    CARRY = "carry"
    """Pick and place what is selected."""
    UNDO = "undo"
    """Undo the last step of picking and placing."""
    WAY = "way"
    """Make way for a hand that it hides."""
    SELECT = "select"
    HAND = "hand"
    """The hand that is seen is the operator's."""


class Ask(_Command, frozen=True, tag="robot"):
    """Ask something of the arm.

    Attributes
    ----------
    what
        What.
    """

    what: Wish


class Beat(_Command, frozen=True, tag="beat"):
    """The operator holds down what lets the arm move; several a second."""


class LetGo(_Command, frozen=True, tag="release"):
    """The operator has let go."""


class Try(StrEnum):
    """What an operator does in an experiment."""

    START = "start"
    SELECT = "select"
    SKIP = "skip"
    END = "end"


class Experiment(_Command, frozen=True, tag="experiment"):
    """Point at targets in random order.

    Attributes
    ----------
    what
        What is done.
    """

    what: Try


class Gone(msgspec.Struct, frozen=True):
    """The page that had the control has gone, or another one has it: the server says so itself."""


RobotCommand = Stop | Ask | Beat | LetGo | Gone

Command = Ack | Stop | Play | Step | GoTo | Take | SetUpCommand | Ask | Beat | LetGo | Experiment

decode = msgspec.json.Decoder(Command).decode
"""From JSON to a command; raises `msgspec.MsgspecError`."""
