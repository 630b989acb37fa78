"""Search for the hand in all views by the main loop, with remedies if it is not found."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fingerpost._core import StartPose, Template
from fingerpost.capture import Frame, Loss
from fingerpost.config import Rig, Start, View
from fingerpost.doctor.hand import FINGER_PX, judge_hand, read_hand
from fingerpost.live.setup.wording import page_words
from fingerpost.pipeline import Observation, Pointer, Step, steps
from fingerpost.pointing import FingerLine, Status
from fingerpost.recording.picture.shapes import ahead, with_gaps
from fingerpost.setting_up import SURE_FRAMES

Shown = Callable[[dict[str, Any], Step], None]

_KEPT_FRAMES = 25  # in which a hand held up to a template is confirmed
_OUTLINE_POINTS = 96


def templates() -> dict[str, list[float]]:
    """Return the outline of the template with the thumb at each side, flat x, y, x, y.

    The tip of the finger is the origin, it points along +x, and its length is 1.
    """
    pose = StartPose((0.0, 0.0), 0.0, 1.0)
    return {
        thumb: np.round(
            pose.centre_px + Template.pistol(thumb).outline(_OUTLINE_POINTS) @ pose.linear_px.T, 4
        )
        .ravel()
        .tolist()
        for thumb in ("left", "right")
    }


@dataclass(frozen=True, slots=True)
class HandSearch:
    """Result of a search.

    Attributes
    ----------
    is_found
        Whether the views give a point.
    state
        Result and problems of each view, as JSON values.
    """

    is_found: bool
    state: dict[str, Any]


def look_for_hand(
    rig: Rig,
    frames: Iterator[Sequence[Frame | Loss | None]],
    is_left: Callable[[], bool],
    show: Shown,
) -> HandSearch | None:
    """Search for the hand until it points, frames end, or the page sends a command.

    Parameters
    ----------
    rig
        The rig, complete.
    frames
        Frames of all views.
    is_left
        Returns whether to cancel.
    show
        Called with the intermediate result, and the step.

    Returns
    -------
    HandSearch or None
        None if it was cancelled: then nothing is known.
    """
    pointer = Pointer(rig)
    kept: deque[Sequence[Frame | Loss | None]] = deque(maxlen=_KEPT_FRAMES)
    in_a_row, last = 0, None
    for step in steps(pointer, _keeping(frames, kept)):
        last = step
        in_a_row = in_a_row + 1 if step.fix.status is Status.OK else 0
        is_found = in_a_row >= SURE_FRAMES
        state = {"found": is_found, "views": [_seen(seen) for seen in step.observations]}
        show(state, step)
        if is_found:
            return HandSearch(True, {**_judged(rig, step, list(kept)), "found": True})
        if is_left():
            return None
    return HandSearch(False, _judged(rig, last, list(kept)))


def _keeping(
    frames: Iterator[Sequence[Frame | Loss | None]], kept: deque[Sequence[Frame | Loss | None]]
) -> Iterator[Sequence[Frame | Loss | None]]:
    for together in frames:
        kept.append(together)
        yield together


def _judged(
    rig: Rig, last: Step | None, kept: list[Sequence[Frame | Loss | None]]
) -> dict[str, Any]:
    """Return the result of every view, with problems."""
    views = []
    for k, view in enumerate(rig.views):
        seen = {} if last is None else _seen(last.observations[k])
        frames = [together[k] for together in kept]
        pictures = [frame for frame in frames if isinstance(frame, Frame)]
        if view.start is not None and pictures:
            seen["words"] = held_wrong(view, view.start, pictures) or seen.get("words", "")
        views.append(seen)
    return {"found": False, "views": views}


def held_wrong(view: View, start: Start, frames: Sequence[Frame]) -> str:
    """Return what is wrong with a hand that is held up to a template; empty if nothing is.

    Parameters
    ----------
    view
        The view.
    start
        Its template.
    frames
        One or more frames, in order.
    """
    readings = read_hand(list(frames), start)
    height, width = frames[0].image.shape[:2]
    wrong = next(judge_hand(view.name, readings, start, (width, height), len(frames)), None)
    return "" if wrong is None else page_words(f"{wrong.what}; {wrong.right}")


def _seen(seen: Observation) -> dict[str, Any]:
    """Return the hand in a view, in pixels of its frames, as JSON values."""
    if seen.frame is None:
        return {"words": page_words(seen.reasons[0])}
    height, width = seen.frame.image.shape[:2]
    whole = seen.reduction.whole
    finger = seen.finger
    found: dict[str, Any] = {"contour": _polylines(whole(with_gaps(seen.contour_px)))}
    if not isinstance(finger, FingerLine):
        found["words"] = page_words(seen.reasons[0])
        return found
    corners = np.array([[-0.5, -0.5], [width - 0.5, height - 0.5]])
    length_px = seen.reduction.factor * 2.0 * math.dist(finger.anchor_px, finger.tip_px)
    found["tip"] = np.round(whole(finger.tip_px), 1).tolist()
    found["finger"] = _polylines(whole(ahead(finger, corners)))
    found["length"] = round(length_px, 1)
    found["words"] = ""
    if length_px < FINGER_PX[0]:
        found["words"] = (
            f"the hand is small: its finger is {length_px:.0f} px long, {FINGER_PX[0]:.0f} or more "
            "is right; zoom in, or come closer"
        )
    return found


def _polylines(points: NDArray[np.float64]) -> list[list[float]]:
    """Return the parts of a line with gaps, each flat x, y, x, y."""
    parts = np.split(points, np.flatnonzero(np.isnan(points).any(axis=1)))
    kept = (part[np.isfinite(part).all(axis=1)] for part in parts)
    return [np.round(part, 1).ravel().tolist() for part in kept if len(part) > 1]
