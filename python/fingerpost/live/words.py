"""Headline of the page: the indicated point, or why there is none."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from fingerpost.live.moment import Moment, ViewMoment
from fingerpost.pointing import Status

_UNSURE = "ill_conditioned"


@dataclass(frozen=True, slots=True)
class Headline:
    """The headline.

    Attributes
    ----------
    status
        Status of the fix.
    said
        Text in place of a point; empty with one.
    detail
        The reason, or a remark on the point.
    point
        The point's numbers for display: x, y and their standard deviations.
    """

    status: str
    said: str
    detail: str
    point: tuple[str, str, str, str] | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return it as JSON values."""
        return asdict(self)


def headline(moment: Moment, digits: int) -> Headline:
    """Return the headline of a moment.

    Parameters
    ----------
    moment
        Moment of the main loop.
    digits
        Decimals of the point's numbers.
    """
    fix = moment.fix
    if fix.point is not None and fix.covariance is not None:
        numbers = [*fix.point, *np.sqrt(np.diag(fix.covariance))]
        x, y, sigma_x, sigma_y = (f"{number:.{digits}f}" for number in numbers)
        crossing = f"lines cross at {math.degrees(fix.crossing_angle_rad or 0.0):.0f}°"
        detail = f"{crossing}; {fix.reason}" if fix.reason else crossing
        return Headline(fix.status.value, "", detail, (x, y, sigma_x, sigma_y))
    without = [view for view in moment.views if view.finger is None]
    if not without:
        return Headline(fix.status.value, "where the views point is undetermined", fix.reason)
    return Headline(fix.status.value, _said(without), _why(without))


def digits_of(plane_size: float) -> int:
    """Return the number of decimals that resolve a thousandth of the plane."""
    return max(0, -math.floor(math.log10(plane_size / 1000.0)))


def _said(views: list[ViewMoment]) -> str:
    """Describe the views without a finger line, grouped by what they do."""
    does: dict[str, list[str]] = {}
    for view in views:
        does.setdefault(_does(view), []).append(view.name)
    return "; ".join(f"{_listed(names)} {_verb(what, names)}" for what, names in does.items())


def _does(view: ViewMoment) -> str:
    if view.time_s is None:
        return "has no picture"
    if view.status == "moved":
        return "has moved: its camera was pushed"
    if view.status == Status.LOST.value:
        return "has lost the finger"
    if view.status == _UNSURE:
        return "is in doubt"
    return "settles on the finger" if view.follows else "looks for the hand"


def _verb(what: str, names: list[str]) -> str:
    """Put a phrase into the plural for several views."""
    if len(names) == 1:
        return what
    verb, _, rest = what.partition(" ")
    plural = {"has": "have", "is": "are", "settles": "settle", "looks": "look"}[verb]
    return f"{plural} {rest.replace('its camera was', 'their cameras were')}"


def _listed(names: list[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def _why(views: list[ViewMoment]) -> str:
    """Return the views' reasons, each after the view's name if there are several."""
    reasons = {view.name: view.reasons[0] for view in views if view.reasons}
    if len(set(reasons.values())) == 1:
        return next(iter(reasons.values()))
    return "; ".join(f"{name}: {reason}" for name, reason in reasons.items())
