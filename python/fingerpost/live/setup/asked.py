"""What a page may ask for while a rig is set up: one JSON object a message."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import msgspec

Pair = tuple[float, float]


class _Asked(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="do"):
    """What all of them share: no other keys."""


class Held(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Where a template waits for the hand; as `fingerpost.config.Start`."""

    tip_px: Pair
    angle_deg: float
    length_px: float
    thumb: Literal["left", "right"]


class Chosen(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A view as it stands on the page.

    Attributes
    ----------
    offer
        Which of the offered sources, from 0.
    points_px
        Its reference points (u, v), in the order of the plane's; none yet, or all four.
    held
        Where the hand is held up to a template, if it is.
    """

    offer: int
    points_px: tuple[Pair, ...] = ()
    held: Held | None = None


class Arrange(_Asked, frozen=True, tag="arrange"):
    """Take views and plane as they stand on the page, and judge them.

    Attributes
    ----------
    views
        In the rig's order.
    plane
        What lies on the table, as `fingerpost.setting_up.reference_of` reads it; empty where the
        pictures are to say.
    finds
        Whether references of views without points are looked for.
    """

    views: tuple[Chosen, ...]
    plane: str = ""
    finds: bool = False


class LookForHand(_Asked, frozen=True, tag="hand"):
    """Look for the hand in all views."""


class Aim(_Asked, frozen=True, tag="aim"):
    """Have the operator point at known places, and learn his habit.

    Attributes
    ----------
    learns
        Whether he does; else what was learned is forgotten.
    """

    learns: bool = True


class Leave(_Asked, frozen=True, tag="leave"):
    """Leave off looking for the hand, or learning."""


class Begin(_Asked, frozen=True, tag="begin"):
    """Write the rig file, and begin."""


class Dropped(_Asked, frozen=True, tag="dropped"):
    """Offer a recording that has been dropped onto the page; the page's server asks, no page.

    Attributes
    ----------
    path
        Where it was written.
    """

    path: Path


SetUpCommand = Arrange | LookForHand | Aim | Leave | Begin
"""What a page may ask for."""
