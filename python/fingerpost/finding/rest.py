"""Suspension of the search: a table on which nothing changes is not searched in every frame."""

from __future__ import annotations

from collections.abc import Sequence

from fingerpost.capture import Frame
from fingerpost.finding.hand_view import HandView

REST_FRAMES = 100
"""Consecutive frames without a finger or foreground in any view after which the search rests. Until
then a hand that has lain still from the start is searched for in every frame."""


class SearchRest:
    """Decides whether the search rests, for all views together: a hand is confirmed by two.

    Searching costs as much as tracking many hands, and a table may be empty for hours. A hand that
    enters is foreground, and ends the rest in the first frame that contains it. The search does not
    rest while a background is unknown, such as that of a moving camera.
    """

    def __init__(self) -> None:
        self._quiet_frames = 0

    def update(self, views: Sequence[HandView], frames: Sequence[Frame | None]) -> bool:
        """Take the next frame of every view, None where there is none; return whether to rest.

        Call it after the trackers' updates, which prepare the background models for the frames.
        """
        is_quiet = all(
            view.is_quiet(frame)
            for view, frame in zip(views, frames, strict=True)
            if frame is not None
        )
        self._quiet_frames = self._quiet_frames + 1 if is_quiet else 0
        return self._quiet_frames > REST_FRAMES
