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
from collections.abc import Sequence
from itertools import combinations

from fingerpost.finding import Viewpoint, tips_distance
from fingerpost.pointing import FingerLine

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

    def update(
        self, viewpoints: Sequence[Viewpoint], lines: Sequence[FingerLine | object]
    ) -> dict[int, float]:
        """Take the finger lines of a time; return displacements by index of the view.

        Parameters
        ----------
        viewpoints
            Camera centres and homographies of the views.
        lines
            The finger line of each; any other object for a view without one.

        Returns
        -------
        dict
            Standard deviation [plane units], of the views that disagree with all others.
        """
        least: dict[int, float] = {}
        for pair in combinations(range(len(lines)), 2):
            first, second = (lines[k] for k in pair)
            if not (isinstance(first, FingerLine) and isinstance(second, FingerLine)):
                continue
            views = viewpoints[pair[0]], viewpoints[pair[1]]
            distance = tips_distance(views, (first, second)) / views[0].plane_view.plane_size
            if not math.isfinite(distance):
                continue
            latest = self._distances.setdefault(pair, deque(maxlen=FRAMES))
            latest.append(distance)
            square = statistics.median(latest) ** 2
            for k in pair:
                # The rays show one of the two components of a displacement.
                least[k] = min(least.get(k, math.inf), 2.0 * (square - EXPECTED**2))
        return {
            k: math.sqrt(square) * viewpoints[k].plane_view.plane_size
            for k, square in least.items()
            if square > 0.0
        }
