"""Conditions on the fixes that may move a robot, and the other options of its guard.

The upper bounds of `GuardOptions` are far beyond practical values; they prevent that a check is
disabled. Those of the two time-outs allow for simulated time; the command line accepts at most a
minute.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from enum import StrEnum
from typing import Annotated

import msgspec
import numpy as np

from fingerpost.errors import InvalidInputError
from fingerpost.pointing import Fix, Status
from fingerpost.robot.options import CheckedOptions
from fingerpost.robot.plane import RobotPlane
from fingerpost.robot.stopping import WATCH_S
from fingerpost.uncertainty import confidence_ellipse

logger = logging.getLogger(__name__)


class GuardOptions(CheckedOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Conditions for commands.

    Attributes
    ----------
    tolerance_m : float
        Largest semi-axis of the fix's ellipse in the robot's frame [m]; the paper's block of
        wood needs about 10 mm.
    confidence : float
        Probability of that ellipse.
    max_fix_age_s : float
        Greatest age of a fix [s]: no motion starts on an older one, and a motion that needs a fix
        is stopped at most `WATCH_S` later.
    operator_timeout_s : float
        Time without a heartbeat after which the operator counts as absent [s].
    clearance_m : float
        Distance kept from the rim of the safe region, for rounding by the controller [m].
    max_speed_m_s : float
        Greatest speed of any command [m/s].

    Raises
    ------
    InvalidInputError
        A value out of range, or not a number.
    """

    tolerance_m: Annotated[float, msgspec.Meta(gt=0, le=1)] = 0.01
    confidence: Annotated[float, msgspec.Meta(gt=0, lt=1)] = 0.95
    max_fix_age_s: Annotated[float, msgspec.Meta(gt=0, le=1e6)] = 0.3
    operator_timeout_s: Annotated[float, msgspec.Meta(gt=0, le=1e6)] = 1.0
    clearance_m: Annotated[float, msgspec.Meta(ge=0, le=1)] = 0.001
    max_speed_m_s: Annotated[float, msgspec.Meta(gt=0, le=10)] = 0.1


class Presence(StrEnum):
    """Condition for the duration of a command."""

    FIX = "fix"
    """The operator's presence and a live fix: for following."""
    OPERATOR = "operator"
    """The operator's presence: for the execution of a selection."""


class FixGate:
    """Keeps the newest fix, and decides whether a fix permits motion.

    Parameters
    ----------
    plane : RobotPlane
        Position of the plane in the robot's frame.
    clock : callable
        The clock of the fixes' `time_s` [s].
    """

    def __init__(self, plane: RobotPlane, clock: Callable[[], float]) -> None:
        self._plane = plane
        self._clock = clock
        self._newest: Fix | None = None

    @property
    def newest(self) -> Fix | None:
        """The newest fix that was observed."""
        return self._newest

    def observe(self, fix: Fix) -> None:
        """Keep a fix if it is the newest.

        An impossible fix is dropped: its time or its point is not finite, or its time is ahead of
        the clock by more than `WATCH_S`. It would make all later fixes seem old. If the kept fix is
        ahead of the clock, because the clock has been set back, any other replaces it.
        """
        now_s = self._clock()
        if fault := _fault(fix, now_s):
            logger.info("a fix is dropped: %s", fault)
            return
        newest = self._newest
        if newest is None or newest.time_s <= fix.time_s or newest.time_s > now_s + WATCH_S:
            self._newest = fix

    def doubt(self, fix: Fix, options: GuardOptions) -> str:
        """Return why a fix does not permit motion; empty if it does."""
        if fix.status is not Status.OK:
            return f"fix is {fix.status}{f': {fix.reason}' if fix.reason else ''}"
        age_s = self._clock() - fix.time_s
        if not -WATCH_S <= age_s <= options.max_fix_age_s:
            return f"fix is {age_s:.3f} s old; at most {options.max_fix_age_s:g} s will do"
        try:
            semi_axis_m = self.semi_axis_m(fix, options.confidence)
        except InvalidInputError as error:
            return str(error)
        if not semi_axis_m <= options.tolerance_m:
            return (
                f"{100 * options.confidence:g} % ellipse reaches {1000 * semi_axis_m:.1f} mm; "
                f"at most {1000 * options.tolerance_m:g} mm will do"
            )
        return ""

    def semi_axis_m(self, fix: Fix, confidence: float) -> float:
        """Return the larger semi-axis of a fix's ellipse on the robot's plane [m].

        Raises
        ------
        InvalidInputError
            The fix has no point, or it is beyond the horizon of the plane's tie.
        """
        if fix.point is None or fix.covariance is None:
            raise InvalidInputError(f"a fix that is {fix.status} has no ellipse")
        centre = self._plane.position_m(fix.point)
        covariance = self._plane.covariance_m2(fix.point, fix.covariance)
        return float(confidence_ellipse(centre, covariance, confidence).semi_axes[0])


def _fault(fix: Fix, now_s: float) -> str:
    """Return why a fix is impossible at the present time; empty if it is possible."""
    if not math.isfinite(fix.time_s):
        return f"its time is {fix.time_s} s"
    if fix.time_s > now_s + WATCH_S:
        return f"its time, {fix.time_s:.3f} s, is {fix.time_s - now_s:.3f} s ahead of the clock"
    if fix.status is not Status.OK:
        return ""  # it permits no motion; the covariance of a refused point may be infinite
    for name, values in (("point", fix.point), ("covariance", fix.covariance)):
        if values is None or not np.isfinite(values).all():
            return f"its {name} is {None if values is None else values.tolist()}"
    return ""
