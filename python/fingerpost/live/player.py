"""Plays a recording at its own pace: plays, stops, steps and jumps, and requests steps in time.

The loop tracks as far as the player requests. Its results are kept, so that going back needs no
tracking, while going forward past their end tracks as fast as possible.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable

from fingerpost.live.reel import Message, Reel

_AHEAD = 3
"""Steps that are tracked in advance, so that tracking does not delay them."""

_LATE_S = 0.25
"""Delay beyond which the pace restarts instead of catching up [s]."""


class Player:
    """Decides which moment of a recording is shown, and when.

    Parameters
    ----------
    ask
        Called with the total number of steps that the loop may make.
    show
        Called with the number of the moment to show, and its data.
    frames
        Expected number of frames of the recording; None if unknown.
    clock
        Returns the time [s].
    is_playing
        Whether it begins at once.
    """

    def __init__(
        self,
        ask: Callable[[float], None],
        show: Callable[[int, bytes], None],
        frames: int | None,
        clock: Callable[[], float],
        *,
        is_playing: bool = True,
    ) -> None:
        self.reel = Reel()
        self.shown = -1
        self.is_playing = is_playing
        self.has_ended = False
        self._ask = ask
        self._show = show
        self._frames = frames
        self._clock = clock
        self._goal = -1
        self._pace: tuple[float, float] | None = None
        self._changed = asyncio.Event()

    @property
    def total(self) -> int:
        """Number of moments, actual or expected."""
        known = len(self.reel)
        return known if self.has_ended else max(known, self._frames or 0)

    def arrived(self, message: Message) -> None:
        """Add the next moment of the loop."""
        self.reel.append(message)
        if message.number <= self._goal:
            self._show_now(message.number)
        self._changed.set()

    def end(self) -> None:
        """Mark the end of the moments."""
        self.has_ended = True
        self._changed.set()

    def stop(self) -> None:
        """Stop at the present moment."""
        self.is_playing = False
        self._goal = min(self._goal, self.shown)
        self._change()

    def play(self) -> None:
        """Continue; at the end, restart from the beginning."""
        if self.has_ended and self.shown >= len(self.reel) - 1:
            self.shown = -1
        self.is_playing = True
        self._change()

    def go_to(self, number: int) -> None:
        """Show a moment; track up to it if necessary."""
        last = max(self.total - 1, 0) if self._frames or self.has_ended else number
        self._goal = min(max(number, 0), last)
        if self._goal < len(self.reel):
            self._show_now(self._goal)
        self._change()

    def step(self, by: int) -> None:
        """Move by a number of moments, and stop there."""
        self.is_playing = False
        self.go_to(self.shown + by)

    async def run(self) -> None:
        """Play until cancelled."""
        while True:
            self._changed.clear()
            if self._goal >= len(self.reel) and not self.has_ended:
                self._ask(self._goal + 1)
                await self._changed.wait()
            elif not self.is_playing:
                await self._changed.wait()
            else:
                await self._play_next()

    async def _play_next(self) -> None:
        following = self.shown + 1
        if not self.has_ended:
            self._ask(following + 1 + _AHEAD)
        if following >= len(self.reel):
            if self.has_ended:
                self.stop()
            await self._changed.wait()
            return
        early_s = self._early_s(self.reel.time_s(following))
        if early_s > 0.0:
            try:
                # Arriving moments change nothing; a command restarts the pace.
                await asyncio.wait_for(self._changed.wait(), early_s)
                return
            except TimeoutError:
                pass
        self._show_now(following)
        await asyncio.sleep(0)

    def _early_s(self, time_s: float) -> float:
        """Return the time until a moment is due [s]."""
        now_s = self._clock()
        if self._pace is not None:
            begun_s, first_s = self._pace
            early_s = begun_s + (time_s - first_s) - now_s
            if -_LATE_S < early_s < math.inf:
                return early_s
        self._pace = now_s, time_s
        return 0.0

    def _change(self) -> None:
        self._pace = None
        self._changed.set()

    def _show_now(self, number: int) -> None:
        self.shown = number
        self._show(number, self.reel.data(number))
