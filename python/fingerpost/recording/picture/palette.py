"""Colours of the pictures, chosen so that colour-blind people can distinguish them."""

from __future__ import annotations

from fingerpost.recording.sheet import CASING, Colour


def _colour(red_green_blue: int) -> Colour:
    return red_green_blue & 255, red_green_blue >> 8 & 255, red_green_blue >> 16


PAGE = CASING
PANEL = _colour(0x1B222A)
PLANE = _colour(0x26303A)
GRID = _colour(0x37434F)
MUTED = _colour(0x93A0AD)
INK = _colour(0xECF0F3)
POINT = _colour(0xFF1473)
"""The indicated point, its ellipse and its trail."""
TRUTH = INK
"""The true indicated point, if known."""
VIEWS = (_colour(0x56B4E9), _colour(0xF2A33A), _colour(0xF0E442), _colour(0x9A4DFF))
"""One colour per view, repeated if there are more views."""
NORMAL = _colour(0xB9C4CE)
"""A search line."""
REJECTED = _colour(0xFF6B52)
"""An edge that does not agree with the fit."""
ROBOT = _colour(0xA8E05F)
"""The robot's gripper and its trail."""
BLOCK = _colour(0xDEBC8C)
"""The block that it carries."""
STATUSES = {
    "tracking": _colour(0x4FDBA5),
    "ok": _colour(0x4FDBA5),
    "acquiring": INK,
    "lost": _colour(0xFF6B52),
    "ill_conditioned": _colour(0xF2A33A),
}


def colour_of(index: int) -> Colour:
    """Return the colour of a view, by its index in the rig."""
    return VIEWS[index % len(VIEWS)]


def mixed(ground: Colour, colour: Colour, share: float) -> Colour:
    """Blend a colour over a ground; with a share of 1 it is opaque."""
    blue, green, red = (round(a + share * (b - a)) for a, b in zip(ground, colour, strict=True))
    return blue, green, red
