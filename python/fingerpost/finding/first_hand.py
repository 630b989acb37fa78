"""The first hand that comes to a view whose template waits for it.

A template may lock on to the table, on which anything can lie, before any hand has come: what it
follows counts as a hand for the rest of the view only once it is proven.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import numpy as np

from fingerpost._core import Background, ContourTracker, FingerLine, StartPose
from fingerpost.capture import Frame
from fingerpost.finding.body import Body
from fingerpost.finding.finger import (
    LATELY,
    hand_region,
    has_moved,
    has_moved_across,
    moves,
)
from fingerpost.finding.foreground import has_come, has_come_whole, stands_out

IS_FLAT = 0.4
"""What a waiting template follows lies on the table where it has looked this flat of late; a hand,
even with its finger on the table, does not at all in colour, and by 0.27 at most without."""

FLAT_KEPT = 0.5
"""What that keeps from look to look; the rest is what the present frames show."""

ONE_HAND_RAD = 0.1
"""What moves and has turned by less than this between two frames may be one hand."""

RAISED_FRAMES = 30
"""What has looked raised above the table for so many frames is looked at no more."""


class FirstHand:
    """Tells whether what a view follows is a hand, and has a second template wait if it may not be.

    Every frame goes to `welcome` before the view's tracker has had it, and to `prove` after.

    Parameters
    ----------
    background
        What the view has learned of the table.
    start
        Where the template waits.
    waiting
        Makes a tracker that waits there.
    """

    def __init__(
        self, background: Background, start: StartPose, waiting: Callable[[], ContourTracker]
    ) -> None:
        self.is_proven = False
        """Whether the view has followed a hand; from then on none is waited for."""
        self.has_come = False
        """Whether something has come in this frame to where nothing was followed yet."""
        self.is_newcomer = False
        """Whether the hand has come after the table was known, and did not stand there before."""
        self.body = Body.none()
        """What the system itself moves, as the next frame shows it: no hand."""
        self._background = background
        self._start = start
        self._waiting = waiting
        self._earliest: FingerLine | None = None
        self._latest: deque[FingerLine] = deque(maxlen=LATELY)
        self._second: ContourTracker | None = None
        self.has_rival = False
        """Whether the second template has found something else to follow."""
        self._flat = 0.0
        self._raised_frames = 0

    def looks_flat(self, flat: float) -> bool:
        """Tell whether what is followed lies on the table.

        Parameters
        ----------
        flat
            How flat it looks to the other views in this frame, 0 to 1.
        """
        self._flat = FLAT_KEPT * self._flat + (1.0 - FLAT_KEPT) * flat
        self._raised_frames += 1
        return self._flat >= IS_FLAT

    @property
    def has_moved(self) -> bool:
        """Whether what is followed is where it was not at first, as a hand comes to be."""
        earliest = self._earliest
        return earliest is not None and any(
            has_moved_across(earliest, line) for line in self._latest
        )

    def wait_anew(self) -> ContourTracker:
        """Forget what was followed; return a tracker that waits for the hand."""
        self._earliest, self._raised_frames, self.has_come = None, 0, False
        self._latest.clear()
        return self._waiting()

    @property
    def may_be_flat(self) -> bool:
        """Whether what is followed may lie on the table."""
        return not self.is_proven and self._raised_frames < RAISED_FRAMES

    def welcome(
        self, frame: Frame, followed: FingerLine | None, *, is_backed: bool
    ) -> ContourTracker | None:
        """Return the tracker that has found the hand in a frame which is new, if it is another.

        What is followed by the time that something comes to the template may lie on the table,
        unless it moves: a second template waits for the hand beside it, and goes on waiting in
        vain once it does, for its thumb may come there as well.

        Parameters
        ----------
        frame
            The search has looked behind it.
        followed
            What the view's tracker has seen in the last frame, unless that was the table.
        is_backed
            Whether another view follows the same finger, and has found nothing else beside it, by
            the last frame: then what has come here alone covers the hand.
        """
        had_rival, self.has_rival = self.has_rival, False
        self.has_come = False
        if self.is_proven or not has_come(self._background, frame, self._start):
            self._second = None
            return None
        if not self._latest:
            self.has_come = True
            return None
        if followed is not None and moves(self._latest):
            self._second = None
            return None
        return self._wait_beside(frame, waits=is_backed or not had_rival)

    def _wait_beside(self, frame: Frame, *, waits: bool) -> ContourTracker | None:
        second = self._second = self._second or self._waiting()
        track = second.update(
            frame.grey(), frame.time_s, frame.colour(), background=self._background
        )
        line = track.finger_line
        if line is None:
            return None
        if self.body.shows_as(line):
            self._second = None
            return None
        if not has_come_whole(self._background, frame, line):
            # It may be what covers the hand that is followed already, in part.
            self._second = None
            return None
        self.has_rival = True
        if waits:
            return None
        if self._earliest is not None and self._is_same(line):
            # Both follow one hand: what was learned where it stood from the start is it.
            self._background.forget(hand_region(self._earliest))
        self._second, self.is_proven, self.is_newcomer = None, True, True
        return second

    def _is_same(self, line: FingerLine) -> bool:
        """Whether the second template may have found the hand that is followed already."""
        turn_rad = line.angle_rad - self._latest[-1].angle_rad
        has_turned = abs(np.remainder(turn_rad + np.pi, 2 * np.pi) - np.pi) >= ONE_HAND_RAD
        return (moves(self._latest) and not has_turned) or not has_moved(self._latest[-1], line)

    def prove(self, frame: Frame, line: FingerLine | None) -> None:
        """Believe in a hand once it has come, or has moved before the background."""
        if line is None or self.is_proven:
            return
        earliest = self._earliest = self._earliest or line
        self._latest.append(line)
        if self.has_come:
            self.is_proven = self.is_newcomer = True
        elif (
            self._second is None
            and has_moved_across(earliest, line)
            and stands_out(self._background, frame, line)
        ):
            self.is_proven = True
            # What was learned where it stood from the start is the hand.
            self._background.forget(hand_region(earliest))

    def believe(self) -> None:
        """Take the search's word for it that the view follows a hand."""
        self.is_proven = True

    @property
    def waits_beside(self) -> bool:
        """Whether something has come to the template beside what is followed: perhaps the hand."""
        return self._second is not None

    def recognise(self) -> None:
        """Take another view's word for it that what is followed is a hand, not the table."""
        self.is_proven = True
        if self._earliest is not None:
            self._background.forget(hand_region(self._earliest))
