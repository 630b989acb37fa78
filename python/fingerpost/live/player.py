"""Plays a recording at its own pace: goes on, stops, steps and jumps, and asks for what it needs.

The loop tracks as far as the player asks; what it has tracked is kept, so that to go back needs no
tracking, and to go forward past its end runs there as fast as it can.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable

from fingerpost.live.reel import Message, Reel

_AHEAD = 3
"""Steps that are tracked before they are due, so that tracking does not make them late."""

_LATE_S = 0.25
"""A pace that falls further behind begins anew, rather than hurry after it."""


class Player:
    """What of a recording is shown, and when.

    Parameters
    ----------
    ask
        Called with how many steps the loop may have made in all.
    show
        Called with the number of the moment to show, and its data.
    frames
        How many frames the recording should have; None if nobody knows.
    clock
        Gives the time in seconds.
    """

    def __init__(
        self,
        ask: Callable[[float], None],
        show: Callable[[int, bytes], None],
        frames: int | None,
        clock: Callable[[], float],
    ) -> None:
        self.reel = Reel()
        self.shown = -1
        self.is_playing = True
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
        """How many moments there are, or should be."""
        known = len(self.reel)
        return known if self.has_ended else max(known, self._frames or 0)

    def arrived(self, message: Message) -> None:
        """Take the next moment that the loop has made."""
        self.reel.append(message)
        if message.number <= self._goal:
            self._show_now(message.number)
        self._changed.set()

    def end(self) -> None:
        """Take it that no more will come."""
        self.has_ended = True
        self._changed.set()

    def stop(self) -> None:
        """Stand still where it is."""
        self.is_playing = False
        self._goal = min(self._goal, self.shown)
        self._change()

    def play(self) -> None:
        """Go on; at the end, from the beginning."""
        if self.has_ended and self.shown >= len(self.reel) - 1:
            self.shown = -1
        self.is_playing = True
        self._change()

    def go_to(self, number: int) -> None:
        """Show a moment, or run there."""
        last = max(self.total - 1, 0) if self._frames or self.has_ended else number
        self._goal = min(max(number, 0), last)
        if self._goal < len(self.reel):
            self._show_now(self._goal)
        self._change()

    def step(self, by: int) -> None:
        """Stand still, so many moments further."""
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
                # What arrives meanwhile changes nothing; a command begins the pace anew.
                await asyncio.wait_for(self._changed.wait(), early_s)
                return
            except TimeoutError:
                pass
        self._show_now(following)
        await asyncio.sleep(0)

    def _early_s(self, time_s: float) -> float:
        """How long a moment is to be waited for."""
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
