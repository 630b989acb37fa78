"""Disagreement of views, as the standard deviation of an unknown displacement of their lines.

Two lines always intersect: what is wrong between two views does not show in their point. But the
viewing rays through the fingertip then miss each other. Wrong reference points and lenses displace
all that a view shows, and a lag displaces a moving tip: in all cases the line of the finger is
displaced by about as much as the tip's ray. A displacement along the line between the cameras does
not separate the rays; texture may show it (`scenery`).
"""

from __future__ import annotations

import math
import statistics
from collections import deque
from collections.abc import Mapping

EXPECTED = 0.02
"""Distance of the rays through the tips of right rigs [plane sizes], at most. In rendered films it
is 0.005, in real footage of a hand that moves by 10 px per frame 0.02. Reference points that are
off by 10 px give 0.03, by 45 px 0.05 to 0.25, and a lag of 5 frames 0.03."""

FRAMES = 15
"""Number of frames whose median distance counts: while a view goes over from one hand to another,
single distances are as great as the hands are apart."""


class Disagreement:
    """Latest distances of the rays through the tips of all pairs of views."""

    def __init__(self) -> None:
        self._distances: dict[tuple[int, int], deque[float]] = {}

    def update(self, distances: Mapping[tuple[int, int], float]) -> dict[int, float]:
        """Take the distances of a time; return displacements by index of the view.

        Parameters
        ----------
        distances
            Distance of the rays of every two views that have a line [plane sizes]; NaN if unknown.

        Returns
        -------
        dict
            Standard deviation [plane sizes], of the views that disagree with all others.
        """
        least: dict[int, float] = {}
        for pair, distance in distances.items():
            if not math.isfinite(distance):
                continue
            latest = self._distances.setdefault(pair, deque(maxlen=FRAMES))
            latest.append(distance)
            square = statistics.median(latest) ** 2
            for k in pair:
                # The rays show one of the two components of a displacement.
                least[k] = min(least.get(k, math.inf), 2.0 * (square - EXPECTED**2))
        return {k: math.sqrt(square) for k, square in least.items() if square > 0.0}
