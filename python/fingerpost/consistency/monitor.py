"""Tests while a rig runs: images are new, and the views' clocks agree."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import cycle

import numpy as np

from fingerpost.capture import Frame, Loss
from fingerpost.consistency.freshness import Freshness
from fingerpost.consistency.synchrony import (
    Lag,
    Tips,
    clocks_agree,
    lag_between,
    tip_in_first_view,
)
from fingerpost.pointing import FingerLine, PlaneView

_log = logging.getLogger(__name__)

FROZEN = "its picture stands still"
"""Reason for a view that repeats its image."""

LOOK_EVERY_S = 0.5
"""Interval between comparisons of a view's clock with the first one's; each takes some ms, so
that the views take turns."""

REPEATS_SHARE = 0.1
"""Least share of repeated images that is reported."""

VARIES_S = 0.05
"""Least difference of estimates of a lag that is reported: more than their error of a frame."""

RATE_FRAMES = 50
LEAST_RATE_FRAMES = 10
"""Number of frames whose median interval is the rate of a view, and least number for it."""

USUAL_RATES = (10.0, 12.5, 15.0, 20.0, 24.0, 25.0, 30.0, 50.0, 60.0, 90.0, 100.0, 120.0)
RATE_ERROR = 0.04
"""Usual frame rates of cameras [1/s]; one within this part of an estimate is meant. In synthetic
motions 90 % of the estimates are nearer."""


@contextmanager
def unannounced() -> Iterator[None]:
    """Log no warnings: the caller corrects the clocks, or reports the notes itself."""
    logger = logging.getLogger("fingerpost")
    before = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(before)


class Monitor:
    """Tests the images of several views, and the tip that they follow.

    Parameters
    ----------
    names
        Names of the views.

    Attributes
    ----------
    lags
        Lag of each view's clock behind the first one's; None if unknown or none. One that was found
        stands until the tips exclude it: a hand at rest is no evidence of equal clocks.
    confirms
        Whether clocks are also shown to agree if no lag was found, which takes some ms more until
        they are.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self._names = names
        self._freshness = Freshness(len(names))
        self._tips = [Tips() for _ in names]
        self._compared_s = -np.inf
        self._turns = cycle(range(1, len(names)))
        self._interval_s = LOOK_EVERY_S / (len(names) - 1)
        self._said: set[tuple[str, str]] = set()
        self._begun_s = np.inf
        self._found: list[list[Lag]] = [[] for _ in names]
        self._rates = [_Rate() for _ in names]
        self._agree = [False] * len(names)
        self.lags: list[Lag | None] = [None] * len(names)
        self.confirms = False

    def look(self, seen: Sequence[Frame | Loss | None]) -> list[Frame | Loss | None]:
        """Take the next entry of every view; return it, or None or a `Loss` for a repeated image.

        A repeated image is no new measurement (None); a view that repeats one for long is lost.
        """
        old = self._freshness.look([one if isinstance(one, Frame) else None for one in seen])
        return [
            self._old(k, one) if is_old and isinstance(one, Frame) else one
            for k, (one, is_old) in enumerate(zip(seen, old, strict=True))
        ]

    def _old(self, k: int, frame: Frame) -> Loss | None:
        if not self._freshness.is_frozen(k, frame.time_s):
            return None
        self._say_once("frozen", self._names[k], f'view "{self._names[k]}": {FROZEN}')
        return Loss(frame.index, frame.time_s, FROZEN)

    def take(
        self,
        times_s: Sequence[float | None],
        fingers: Sequence[FingerLine | object],
        plane_views: Sequence[PlaneView],
    ) -> None:
        """Take the finger line of every view's last frame, and compare the clocks."""
        for tips, rate, time_s, finger, view in zip(
            self._tips, self._rates, times_s, fingers, plane_views, strict=True
        ):
            if time_s is None:
                continue
            rate.add(time_s)
            if not isinstance(finger, FingerLine):
                continue
            if (tip := tip_in_first_view(finger, view, plane_views[0])) is not None:
                tips.add(time_s, tip)
        self._begun_s = min([self._begun_s, *(time_s for time_s in times_s if time_s is not None)])
        if times_s[0] is not None and times_s[0] >= self._compared_s + self._interval_s:
            self._compared_s = times_s[0]
            self._compare(next(self._turns))

    def _compare(self, k: int) -> None:
        first, other, known = self._tips[0], self._tips[k], self.lags[k]
        lag = lag_between(first, other, self._begun_s)
        if lag is None:
            is_asked = known is not None or (self.confirms and not self._agree[k])
            if is_asked and clocks_agree(first, other):
                self.lags[k], self._agree[k] = None, True
                self._found[k].clear()
            return
        self._agree[k] = False
        # The few tips in common of clocks of different rates may fit a constant lag for a while.
        if known is None or known.rate == 1.0 or lag.rate != 1.0:
            self.lags[k] = lag
            self._found[k].append(lag)
            kind = "lag" if lag.rate == 1.0 else "rate"
            words = f"{self._lag_words(k)}; earlier points do not allow for it"
            self._say_once(kind, self._names[k], words)

    @property
    def has_compared_clocks(self) -> bool:
        """Whether motion has shown every view's clock to agree with the first one's, or to lag."""
        return all(
            agrees or lag is not None
            for agrees, lag in zip(self._agree[1:], self.lags[1:], strict=True)
        )

    def _lag_words(self, k: int) -> str:
        """Describe the lag of a view by all estimates."""
        growing = [lag for lag in self._found[k] if lag.rate != 1.0]
        if growing:
            return self._rate_words(k, float(np.median([lag.rate for lag in growing])))
        name, first = self._names[k], self._names[0]
        lags_s = [lag.lag_s for lag in self._found[k]]
        lag_s = float(np.median(lags_s))
        way = "after" if lag_s > 0.0 else "before"
        spread = ""
        if np.ptp(lags_s) > VARIES_S:
            spread = f" ({min(lags_s):.2f} to {max(lags_s):.2f} s at different times)"
        return (
            f'view "{name}" shows the hand {abs(lag_s):.2f} s {way} view "{first}" does{spread}, '
            f"by how it moves in both; offset_s = {-lag_s:.2f} more in its [[view]] brings them "
            "together, if they were begun apart"
        )

    def _rate_words(self, k: int, rate: float) -> str:
        rates = [1.0 / self._rates[j].interval_s for j in (0, k)]
        first, other = self._names[0], self._names[k]
        return (
            f'view "{other}" lags further and further: its clock runs {rate:.2f} times as fast as '
            f'that of view "{first}", by how the hand moves in both; right frame rates would be '
            f'about {_usual_rate(rates[1] * rate):.3g} a second for "{other}" in place of '
            f'{rates[1]:.3g}, or {_usual_rate(rates[0] / rate):.3g} for "{first}" in place of '
            f"{rates[0]:.3g}"
        )

    def _say_once(self, kind: str, name: str, words: str) -> None:
        if (kind, name) not in self._said:
            self._said.add((kind, name))
            _log.warning("%s", words)

    def notes(self) -> list[str]:
        """Return the observations, a line each."""
        notes = [self._lag_words(k) for k, found in enumerate(self._found) if found]
        for name, repeats, frames in zip(
            self._names, self._freshness.repeats, self._freshness.frames, strict=True
        ):
            if repeats > REPEATS_SHARE * frames:
                notes.append(
                    f'view "{name}": {repeats} of {frames} pictures were old ones, handed out '
                    "again; they are no new measurements"
                )
        return notes


class _Rate:
    """Frame interval of a view, by its first frames."""

    def __init__(self) -> None:
        self._times_s = np.empty(RATE_FRAMES)  # allocated once, so that frames keep nothing
        self._count = 0
        self.interval_s = np.nan

    def add(self, time_s: float) -> None:
        """Add the time of the next frame [s]."""
        if self._count == RATE_FRAMES:
            return
        self._times_s[self._count] = time_s
        self._count += 1
        if self._count >= LEAST_RATE_FRAMES:
            self.interval_s = float(np.median(np.diff(self._times_s[: self._count])))


def _usual_rate(rate: float) -> float:
    """Return the usual frame rate next to an estimate, or the estimate if none is near [1/s]."""
    nearest = min(USUAL_RATES, key=lambda usual: abs(usual - rate))
    return nearest if abs(nearest - rate) <= RATE_ERROR * rate else rate
