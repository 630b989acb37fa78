"""Commands of a page: each message is one JSON object."""

from __future__ import annotations

from enum import StrEnum

import msgspec

from fingerpost.live.setup.asked import SetUpCommand

LARGEST_BYTES = 64 * 1024
"""Longest message that is read."""

FRAMED = "/framed/"
"""Prefix, before the token, of the paths of a page in a frame of another site."""


class _Command(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="do"):
    """Base class of all commands: unknown keys are refused."""


class Ack(_Command, frozen=True, tag="ack"):
    """A moment has been drawn."""


class Stop(_Command, frozen=True, tag="stop"):
    """Stop at once."""


class Play(_Command, frozen=True, tag="play"):
    """Continue playing."""


class Step(_Command, frozen=True, tag="step"):
    """Stop after a number of further moments.

    Attributes
    ----------
    by
        Number of moments; negative for backwards.
    """

    by: int


class GoTo(_Command, frozen=True, tag="seek"):
    """Show a moment.

    Attributes
    ----------
    number
        Number of the moment, from 0.
    """

    number: int


class Take(_Command, frozen=True, tag="take"):
    """Take control from another page."""


class Wish(StrEnum):
    """Commands of an operator to an arm."""

    ARM = "arm"
    """Permit motion while the page's button is held."""
    DISARM = "disarm"
    HOME = "home"
    FOLLOW = "follow"
    CARRY = "carry"
    """Pick and place selected blocks."""
    UNDO = "undo"
    """Undo the last step of picking and placing."""
    WAY = "way"
    """Retreat from a hand that the arm hides."""
    SELECT = "select"
    HAND = "hand"
    """Confirm that the tracked hand is the operator's."""


class Ask(_Command, frozen=True, tag="robot"):
    """Command the arm.

    Attributes
    ----------
    what
        The command.
    """

    what: Wish


class Beat(_Command, frozen=True, tag="beat"):
    """The operator holds down the button that permits motion; sent several times a second."""


class LetGo(_Command, frozen=True, tag="release"):
    """The operator has released the button."""


class Try(StrEnum):
    """Commands of an operator in an experiment."""

    START = "start"
    SELECT = "select"
    SKIP = "skip"
    END = "end"


class Experiment(_Command, frozen=True, tag="experiment"):
    """Control an experiment, in which the operator points at targets in random order.

    Attributes
    ----------
    what
        The command.
    """

    what: Try


class Gone(msgspec.Struct, frozen=True):
    """The controlling page has disconnected or lost control; sent by the server itself."""


RobotCommand = Stop | Ask | Beat | LetGo | Gone

Command = Ack | Stop | Play | Step | GoTo | Take | SetUpCommand | Ask | Beat | LetGo | Experiment

decode = msgspec.json.Decoder(Command).decode
"""Decodes a command from JSON; raises `msgspec.MsgspecError`."""
