"""Messages about a rig in the words of the page, whose users never see the rig file."""

from __future__ import annotations

import re

_POINTS = r"(?:reference_points_px|plane\.points) ?\[(\d+(?:, \d+)*)\]"
_ORDER = r"in the order \[(\d+(?:, \d+)*)\]"

_WORDS: tuple[tuple[str, str], ...] = (
    (r"reference_points_px = \[(\[.*?\])\](?!,)", r"corners at \1"),
    (r"reference_points_px must be in the order of plane\.points", "click its corners in order"),
    (r"check plane\.points and their order, or give its lens", "check size and order of corners"),
    (r"measure plane\.points", "measure what lies on the table"),
    (r"or give the lens[^;]*", "or calibrate the camera"),
    (r"reference_points_px", "corners"),
    (r"plane\.points", "corners of the plane"),
    (r"lens = \{[^}]*\}", "an estimated lens"),
    (r"offset_s = (\S+) more in its \[\[view\]\] brings", r"\1 s more in its times bring"),
    (r"correct tip_px, angle_deg and length_px", "move, turn and scale the template"),
    (r"if one waits at \[view\.start\], it", "if one waits at the template, it"),
    (r"\[view\.start\]", "the template"),
    (r"start\.tip_px", "the template's tip"),
)
"""Parts of messages, as regular expressions, and what the page says instead, in this order."""


def page_words(message: str) -> str:
    """Return a message without keys of the rig file; points are numbered from 1, as on the page."""
    message = re.sub(_POINTS, lambda found: f"corner {_numbers(found)}", message)
    message = re.sub(_ORDER, lambda found: f"in the order {_numbers(found)}", message)
    for key, words in _WORDS:
        message = re.sub(key, words, message)
    return message


def _numbers(found: re.Match[str]) -> str:
    return ", ".join(str(int(k) + 1) for k in found[1].split(", "))
