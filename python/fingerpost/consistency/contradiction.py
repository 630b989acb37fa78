"""A contradiction between a rig and its images."""

from __future__ import annotations

from typing import NamedTuple


class Contradiction(NamedTuple):
    """Statement of a rig that its images or its other views contradict.

    Attributes
    ----------
    what
        The contradiction, with the measured values.
    right
        The correction.
    """

    what: str
    right: str
