"""Tests while a rig runs: images are new, and the views' clocks agree."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import cycle

import numpy as np

from fingerpost.capture import Frame, Loss
from fingerpost.consistency.freshness import Freshness
from fingerpost.consistency.synchrony import Lag, Tips, lag_between, tip_in_first_view
from fingerpost.pointing import FingerLine, PlaneView

_log = logging.getLogger(__name__)

FROZEN = "its picture stands still"
"""Reason for a view that repeats its image."""

LOOK_EVERY_S = 0.5
"""Interval between comparisons of a view's clock with the first one's; each takes some ms, so
that the views take turns."""

REPEATS_SHARE = 0.1
"""Least share of repeated images that is reported."""


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
        Lag of each view's clock behind the first one's; None if unknown or none.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self._names = names
        self._freshness = Freshness(len(names))
        self._tips = [Tips() for _ in names]
        self._compared_s = -np.inf
        self._turns = cycle(range(1, len(names)))
        self._interval_s = LOOK_EVERY_S / (len(names) - 1)
        self._said: set[tuple[str, str]] = set()
        self._worst: dict[str, Lag] = {}
        self.lags: list[Lag | None] = [None] * len(names)

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
        for tips, time_s, finger, view in zip(
            self._tips, times_s, fingers, plane_views, strict=True
        ):
            if time_s is None or not isinstance(finger, FingerLine):
                continue
            if (tip := tip_in_first_view(finger, view, plane_views[0])) is not None:
                tips.add(time_s, tip)
        if times_s[0] is not None and times_s[0] >= self._compared_s + self._interval_s:
            self._compared_s = times_s[0]
            self._compare(next(self._turns))

    def _compare(self, k: int) -> None:
        lag = self.lags[k] = lag_between(self._tips[0], self._tips[k])
        if lag is not None:
            name = self._names[k]
            self._worst[name] = lag
            self._say_once("lag", name, self._lag_words(name, lag))

    def _lag_words(self, name: str, lag: Lag) -> str:
        way = "after" if lag.lag_s > 0.0 else "before"
        return (
            f'view "{name}" shows the hand {abs(lag.lag_s):.2f} s {way} view "{self._names[0]}" '
            f"does, by how it moves in both; offset_s = {-lag.lag_s:.2f} more in its [[view]] "
            "brings them together, if they were begun apart"
        )

    def _say_once(self, kind: str, name: str, words: str) -> None:
        if (kind, name) not in self._said:
            self._said.add((kind, name))
            _log.warning("%s", words)

    def notes(self) -> list[str]:
        """Return the observations, a line each."""
        notes = [self._lag_words(name, lag) for name, lag in self._worst.items()]
        for name, repeats, frames in zip(
            self._names, self._freshness.repeats, self._freshness.frames, strict=True
        ):
            if repeats > REPEATS_SHARE * frames:
                notes.append(
                    f'view "{name}": {repeats} of {frames} pictures were old ones, handed out '
                    "again; they are no new measurements"
                )
        return notes
