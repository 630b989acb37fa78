"""Calibration of the operator's habit: the operator points at five places in turn."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fingerpost.calibration import Calibration, Place, habit_of
from fingerpost.capture import Frame, Loss
from fingerpost.config import Rig
from fingerpost.habit import MIN_TARGETS, Habit
from fingerpost.live.setup.wording import page_words
from fingerpost.operators import Operator
from fingerpost.pipeline import Pointer, Step, steps

OPERATOR = "operator"

DWELL_S = 1.0
"""Time for which the operator points at a place [s]."""

_INSET = 0.2  # of the plane's extent: a habit is valid between the outermost places

Shown = Callable[[dict[str, Any], Step], None]


@dataclass(frozen=True, eq=False, slots=True)
class Aimed:
    """Result of a calibration.

    Attributes
    ----------
    operator
        The operator with the habit; None if cancelled, or with too few places.
    state
        Places, the points indicated at each, and the accuracy, as JSON values.
    """

    operator: Operator | None
    state: dict[str, Any]


def places_on(rig: Rig) -> list[Place]:
    """Return five places of a rig's plane: four near its corners, and the middle last."""
    points = np.array(rig.plane.points, np.float64)
    lower, upper = points.min(axis=0), points.max(axis=0)
    shares = [(0, 0), (1, 0), (1, 1), (0, 1)]
    near = [_INSET + (1.0 - 2.0 * _INSET) * np.array(share, np.float64) for share in shares]
    return [
        Place(str(k + 1), lower + share * (upper - lower))
        for k, share in enumerate([*near, np.array([0.5, 0.5])])
    ]


def learn(
    rig: Rig,
    frames: Iterator[Sequence[Frame | Loss | None]],
    is_left: Callable[[], bool],
    show: Shown,
    dwell_s: float = DWELL_S,
) -> Aimed:
    """Follow the hand from place to place, until all are done or the page sends a command.

    Parameters
    ----------
    rig
        The rig, complete.
    frames
        Frames of all views.
    is_left
        Returns whether to cancel.
    show
        Called with the progress, and the step.
    dwell_s
        Time for each place [s].
    """
    places = places_on(rig)
    calibration = Calibration(places, dwell_s)
    for step in steps(Pointer(rig), frames):
        calibration.take(step.fix.time_s, step.fix.point)
        show(_state(rig, places, calibration, step), step)
        if calibration.next is None or is_left():
            break
    state = _state(rig, places, calibration, None)
    if len(calibration.visits) < MIN_TARGETS:
        return Aimed(None, {**state, "running": False})
    habit = habit_of(calibration.visits)
    return Aimed(
        Operator(OPERATOR, rig.plane.unit, habit),
        {**state, "running": False, **_accuracy(habit)},
    )


def _accuracy(habit: Habit) -> dict[str, Any]:
    """Return the operator's error without and with correction of the habit."""
    off = habit.points - habit.targets
    return {
        "off": float(f"{math.sqrt(np.mean(np.sum(off**2, axis=1))):.3g}"),
        "left": float(f"{habit.left_out[habit.model]:.3g}"),
        "model": str(habit.model),
    }


def _state(
    rig: Rig, places: Sequence[Place], calibration: Calibration, step: Step | None
) -> dict[str, Any]:
    point = None if step is None else step.fix.point
    return {
        "unit": rig.plane.unit,
        "running": True,
        "places": [np.round(place.point, 2).tolist() for place in places],
        "visits": [np.round(visit.point, 2).tolist() for visit in calibration.visits],
        "share": round(calibration.stayed, 2),
        "point": None if point is None else np.round(point, 2).tolist(),
        "words": "" if step is None or point is not None else page_words(step.fix.reason),
    }
