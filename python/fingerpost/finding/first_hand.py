"""First hand of a view with an initial template.

The template may lock on to a pattern on the table before any hand has come: what it follows is a
hand for the rest of the run only once it is proven.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable

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
from fingerpost.finding.foreground import (
    stands_out,
    template_is_foreground,
    whole_finger_is_foreground,
)

MIN_TABLE_FLATNESS = 0.4
"""Running mean of the flatness from which a pattern on the table is followed. A hand has 0 in
colour and 0.27 at most in grey, even with its finger on the table."""

FLATNESS_DECAY = 0.5
"""Factor of the previous mean in the running mean of the flatness."""

ONE_HAND_RAD = 0.1
"""Greatest change of direction of one moving hand between two frames."""

RAISED_FRAMES = 30
"""Number of frames in which the flatness is tested."""


class FirstHand:
    """Decides whether a view follows a hand; a second template waits while it may not.

    Call `confirm` with every frame before the view's tracker is updated, and `prove` after.

    Parameters
    ----------
    background
        The view's background model.
    start
        Pose of the initial template.
    waiting
        Makes a tracker with the initial template.
    """

    def __init__(
        self, background: Background, start: StartPose, waiting: Callable[[], ContourTracker]
    ) -> None:
        self.is_proven = False
        """Whether the view has followed a hand; the initial template then waits no more."""
        self.entered_free_template = False
        """Whether the initial template's region is foreground and nothing was followed yet."""
        self.is_newcomer = False
        """Whether the hand has come after the background was learned."""
        self.body = Body.none()
        """Silhouette of the system's moving bodies in the next frame."""
        self._background = background
        self._start = start
        self._waiting = waiting
        self._earliest: FingerLine | None = None
        self._latest: deque[FingerLine] = deque(maxlen=LATELY)
        self._second: ContourTracker | None = None
        self.has_rival = False
        """Whether the second template has found another finger."""
        self._flat = 0.0
        self._raised_frames = 0

    def update_flatness(self, flat: float) -> bool:
        """Update the running mean of the flatness; True if the table is followed.

        Parameters
        ----------
        flat
            Flatness with respect to the other views in this frame, 0 to 1.
        """
        self._flat = FLATNESS_DECAY * self._flat + (1.0 - FLATNESS_DECAY) * flat
        self._raised_frames += 1
        return self._flat >= MIN_TABLE_FLATNESS

    @property
    def has_moved(self) -> bool:
        """Whether the followed finger has moved across its axis since its first line."""
        earliest = self._earliest
        return earliest is not None and any(
            has_moved_across(earliest, line) for line in self._latest
        )

    def restart_waiting(self) -> ContourTracker:
        """Reset; return a tracker with the initial template."""
        self._earliest, self._raised_frames, self.entered_free_template = None, 0, False
        self._latest.clear()
        return self._waiting()

    @property
    def may_be_flat(self) -> bool:
        """Whether the flatness is still to be tested."""
        return not self.is_proven and self._raised_frames < RAISED_FRAMES

    def confirm(
        self, frame: Frame, followed: FingerLine | None, *, is_supported: bool
    ) -> ContourTracker | None:
        """Return the second template's tracker if it has confirmed a hand in a new frame, or None.

        A finger followed when foreground comes to the template may be the table, unless it moves: a
        second template then waits beside it. Once the finger moves, the second one is discarded,
        for the thumb may come there as well.

        Parameters
        ----------
        frame
            The frame; the background model is prepared for it.
        followed
            Finger line of the view's tracker in the last frame; None if it was the table.
        is_supported
            Whether another view followed the same finger in the last frame, and had found no other:
            then a newcomer in this view alone is an object that covers the hand.
        """
        had_rival, self.has_rival = self.has_rival, False
        self.entered_free_template = False
        if self.is_proven or not template_is_foreground(self._background, frame, self._start):
            self._second = None
            return None
        if not self._latest:
            self.entered_free_template = True
            return None
        if followed is not None and moves(self._latest):
            self._second = None
            return None
        return self._wait_beside(frame, waits=is_supported or not had_rival)

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
        if not whole_finger_is_foreground(self._background, frame, line):
            # It may be an object that covers part of the hand that is followed.
            self._second = None
            return None
        self.has_rival = True
        if waits:
            return None
        if self._earliest is not None and self._is_same(line):
            # Both follow one hand: the background learned at its first place is the hand.
            self._background.forget(hand_region(self._earliest))
        self._second, self.is_proven, self.is_newcomer = None, True, True
        return second

    def _is_same(self, line: FingerLine) -> bool:
        """Whether the second template may have found the finger that is followed."""
        turn_rad = math.remainder(line.angle_rad - self._latest[-1].angle_rad, 2.0 * math.pi)
        has_turned = abs(turn_rad) >= ONE_HAND_RAD
        return (moves(self._latest) and not has_turned) or not has_moved(self._latest[-1], line)

    def prove(self, frame: Frame, line: FingerLine | None) -> None:
        """Accept a hand that has come, or has moved in front of the background."""
        if line is None or self.is_proven:
            return
        earliest = self._earliest = self._earliest or line
        self._latest.append(line)
        if self.entered_free_template:
            self.is_proven = self.is_newcomer = True
        elif (
            self._second is None
            and has_moved_across(earliest, line)
            and stands_out(self._background, frame, line)
        ):
            self.is_proven = True
            # The background learned at its first place is the hand.
            self._background.forget(hand_region(earliest))

    def accept_from_search(self) -> None:
        """Accept the hand that the search has found; it is evidence for the other views as well."""
        self.is_proven = self.is_newcomer = True

    @property
    def has_second_template(self) -> bool:
        """Whether a second template waits or follows beside the followed finger."""
        return self._second is not None

    def accept_from_view(self) -> None:
        """Accept the followed finger as a hand, by another view's evidence."""
        self.is_proven = True
        if self._earliest is not None:
            self._background.forget(hand_region(self._earliest))
