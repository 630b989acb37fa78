"""Commands of a page while a rig is set up: each message is one JSON object."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import msgspec

Pair = tuple[float, float]


class _Asked(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="do"):
    """Base class of the commands: unknown keys are refused."""


class Held(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Start pose of a template that waits for the hand; as `fingerpost.config.Start`."""

    tip_px: Pair
    angle_deg: float
    length_px: float
    thumb: Literal["left", "right"]


class Chosen(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A view as arranged on the page.

    Attributes
    ----------
    offer
        Index of the offered source, from 0.
    points_px
        Its reference points (u, v), in the order of the plane's; none or all four.
    held
        Start pose of a template to which the hand is held up, if any.
    """

    offer: int
    points_px: tuple[Pair, ...] = ()
    held: Held | None = None


class Arrange(_Asked, frozen=True, tag="arrange"):
    """Set views and plane as arranged on the page, and assess them.

    Attributes
    ----------
    views
        The views, in the rig's order.
    plane
        Reference on the table, as parsed by `fingerpost.setting_up.reference_of`; empty to
        recognise it in the pictures.
    finds
        Whether to search for the references of views without points.
    number
        Number by which the page recognises the result among those of earlier arrangements.
    """

    views: tuple[Chosen, ...]
    plane: str = ""
    finds: bool = False
    number: int = 0


class LookForHand(_Asked, frozen=True, tag="hand"):
    """Search for the hand in all views."""


class Aim(_Asked, frozen=True, tag="aim"):
    """Calibrate the operator's habit by pointing at known places.

    Attributes
    ----------
    learns
        Whether to calibrate; otherwise discard the habit.
    """

    learns: bool = True


class Leave(_Asked, frozen=True, tag="leave"):
    """Cancel the search for the hand, or the calibration."""


class Begin(_Asked, frozen=True, tag="begin"):
    """Write the rig file, and start the run."""


class Dropped(_Asked, frozen=True, tag="dropped"):
    """Offer a recording that has been dropped onto the page; sent by the server, not by a page.

    Attributes
    ----------
    path
        Its path.
    """

    path: Path


SetUpCommand = Arrange | LookForHand | Aim | Leave | Begin
"""Any command of a page."""
