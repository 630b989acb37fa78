"""Bar chart of the statuses of the fixes of many recordings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from fingerpost.recording.picture.palette import INK, MUTED, PAGE, PANEL, STATUSES
from fingerpost.recording.sheet import LARGEST_PX, Image, Sheet

_ROW_PX, _BAR_PX, _TYPE_PX = 26, 16, 15
_NAME_PX, _BARS_PX, _SAID_PX, _MARGIN_PX = 260, 520, 300, 20
_SHOWN = ("ok", "acquiring", "ill_conditioned", "lost")
_MOST_ROWS = (LARGEST_PX - 4 * _MARGIN_PX) // _ROW_PX - 2


def draw_shares(recordings: Sequence[tuple[str, Mapping[str, int], str]]) -> Image:
    """Draw a bar for each recording.

    Parameters
    ----------
    recordings
        Name, number of fixes by status, and the reason of a failure, else empty. A picture has room
        for about 1200; later ones are left out.

    Returns
    -------
    (height, width, 3) of uint8
        Blue-green-red.
    """
    rows = list(recordings)[:_MOST_ROWS]
    width = _NAME_PX + _BARS_PX + _SAID_PX + 2 * _MARGIN_PX
    sheet = Sheet.blank((width, (len(rows) + 1) * _ROW_PX + 2 * _MARGIN_PX), PAGE)
    _draw_key(sheet)
    for k, (name, counts, reason) in enumerate(rows):
        _draw_row(sheet, _MARGIN_PX + (k + 1) * _ROW_PX, name, counts, reason)
    return sheet.pixels


def _draw_key(sheet: Sheet) -> None:
    left = float(_MARGIN_PX + _NAME_PX)
    for status in _SHOWN:
        words = status.replace("_", "-")
        place = (left, _MARGIN_PX + _TYPE_PX)
        _, left = sheet.text(words, place, _TYPE_PX, STATUSES[status], bold=True)
        left += 20


def _draw_row(sheet: Sheet, top: int, name: str, counts: Mapping[str, int], reason: str) -> None:
    baseline = top + _TYPE_PX
    sheet.text(name, (_MARGIN_PX, baseline), _TYPE_PX, INK, room=_NAME_PX - 10)
    total, left = sum(counts.values()), float(_MARGIN_PX + _NAME_PX)
    said = left + _BARS_PX + 12
    if reason or not total:
        words = reason or "no frames"
        sheet.text(words, (left, baseline), _TYPE_PX, STATUSES["lost"], room=_BARS_PX + _SAID_PX)
        return
    _area(sheet, left, left + _BARS_PX, top, PANEL)
    for status in _SHOWN:
        right = left + _BARS_PX * counts.get(status, 0) / total
        _area(sheet, left, right, top, STATUSES[status])
        left = right
    words = f"{100 * counts.get('ok', 0) / total:.1f} % of {total} ok"
    sheet.text(words, (said, baseline), _TYPE_PX, MUTED, room=_SAID_PX)


def _area(sheet: Sheet, left: float, right: float, top: int, colour: tuple[int, int, int]) -> None:
    if right > left:
        bottom = top + _BAR_PX
        sheet.area(np.array([[left, top], [right, top], [right, bottom], [left, bottom]]), colour)
