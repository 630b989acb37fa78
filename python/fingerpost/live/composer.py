"""Encodes moments as messages, once for all clients."""

from __future__ import annotations

import math
from collections import deque

import msgspec

from fingerpost.live.moment import Moment
from fingerpost.live.reel import Indicated, Message
from fingerpost.live.scene import CONFIDENCE, RigScene, scene_of
from fingerpost.pointing import Fix

_TRAIL = 40  # earlier points that the plan shows

_LEAST, _LARGEST = 1e-3, 0.2
"""Range of the ellipse's size on the strip's logarithmic scale, relative to the plane."""

_CODES = {"ok": "o", "tracking": "o", "acquiring": "a", "lost": "l", "moved": "m"}


class Composer:
    """Encodes a rig's moments in order; each message includes the trail of earlier points.

    Parameters
    ----------
    rig
        The rig.
    """

    def __init__(self, rig: RigScene) -> None:
        self._rig = rig
        self._trail: deque[tuple[float, float]] = deque(maxlen=_TRAIL)

    def message(self, moment: Moment) -> Message:
        """Encode a moment for the page."""
        scene = msgspec.json.encode(scene_of(moment, self._rig, self._trail))
        length = len(scene).to_bytes(4, "little")
        if moment.fix.point is not None:
            x, y = moment.fix.point.tolist()
            self._trail.append((x, y))
        statuses = [moment.fix.status.value, *(view.status for view in moment.views)]
        return Message(
            number=moment.number,
            time_s=moment.fix.time_s,
            begun_s=moment.begun_s,
            codes="".join(_CODES.get(status, "i") for status in statuses)
            + uncertainty_code(moment.fix, self._rig.plane_size),
            data=b"".join([length, scene, *(view.jpeg for view in moment.views)]),
            indicated=Indicated.of(moment.frame, moment.fix),
        )


def uncertainty_code(fix: Fix, plane_size: float) -> str:
    """Return the uncertainty of a fix as the strip shows it: a digit, or a dash without a point.

    Parameters
    ----------
    fix
        The fix.
    plane_size
        Side of the working plane [plane units].
    """
    ellipse = fix.ellipse(CONFIDENCE)
    if ellipse is None:
        return "-"
    share = max(float(ellipse.semi_axes.max()) / plane_size, _LEAST)
    level = 9.0 * math.log(share / _LEAST) / math.log(_LARGEST / _LEAST)
    return str(min(round(level), 9))
