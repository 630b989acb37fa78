"""A rig and what belies it."""

from __future__ import annotations

from typing import NamedTuple


class Contradiction(NamedTuple):
    """What a rig says and its pictures or its other views belie.

    Attributes
    ----------
    what
        What is wrong, with the values found.
    right
        What would be right.
    """

    what: str
    right: str
