"""Inputs of a picture, besides the fix."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fingerpost.checks import finite_array
from fingerpost.pointing import FingerLine, Status
from fingerpost.recording.sheet import Image, Points


class Pictured(Protocol):
    """A frame; `fingerpost.capture.Frame` is one."""

    @property
    def image(self) -> Image:
        """(height, width) grey or (height, width, 3) blue-green-red."""


class Observed(Protocol):
    """Result of one view for one frame; `fingerpost.pipeline.Observation` is one."""

    @property
    def view(self) -> str:
        """The view's name."""

    @property
    def frame(self) -> Pictured | None:
        """The frame; None if there is none at that time."""

    @property
    def contour_px(self) -> Points:
        """(N, 2) outline of the template [px]."""

    @property
    def search(self) -> SearchMarks:
        """The last edge search around it."""

    @property
    def reasons(self) -> Sequence[str]:
        """Explanation of the result: the decision, then details."""

    @property
    def finger(self) -> FingerLine | Status:
        """The finger line, or the status without one."""


@dataclass(frozen=True, eq=False)
class SearchMarks:
    """An edge search along the normals of a contour, in the order along it.

    Parameters
    ----------
    lines_px : (N, 2, 2)
        Both ends of each search line [px].
    edges_px : (N, 2)
        The edge chosen on each line [px]; NaN without one.
    agrees : (N,) of bool
        Whether that edge agrees with the fit; the others are rejected.
    """

    lines_px: Points
    edges_px: Points
    agrees: NDArray[np.bool_]

    @classmethod
    def none(cls) -> SearchMarks:
        """Return the marks of a frame that was not searched."""
        return cls(np.empty((0, 2, 2)), np.empty((0, 2)), np.empty(0, np.bool_))


@dataclass(frozen=True, eq=False)
class RobotMarks:
    """A robot on the plan, and in views whose images do not contain it.

    Parameters
    ----------
    gripper : (2,)
        Point of the plane under or over the gripper [plane units].
    jaw_width
        Opening of the jaws [plane units], ≥ 0.
    jaw_angle_rad
        Direction in which they close, from the plane's X towards its Y [rad].
    trail : (N, 2)
        Earlier positions of the gripper, oldest first [plane units].
    block : (M, 2) or None
        Outline of the block that it carries, or will carry [plane units].
    place : (2,) or None
        Destination of the block [plane units].
    words
        Description of its activity.
    in_views
        Whether to mark gripper and block in the views as well.
    jaw_length
        Length of a jaw as drawn [plane units], ≥ 0.
    """

    gripper: ArrayLike
    jaw_width: float
    jaw_angle_rad: float
    trail: ArrayLike = ()
    block: ArrayLike | None = None
    place: ArrayLike | None = None
    words: str = ""
    in_views: bool = False
    jaw_length: float = 0.0

    def jaws(self) -> Points:
        """(2, 2, 2) ends of both jaws."""
        along = np.array([math.cos(self.jaw_angle_rad), math.sin(self.jaw_angle_rad)])
        across = np.array([-along[1], along[0]])
        middle = finite_array(self.gripper, "gripper", (2,))
        sides = np.array([[-0.5], [0.5]]) * self.jaw_width * along
        ends = np.array([[-0.5], [0.5]]) * self.jaw_length * across
        return np.asarray(middle + sides[:, None] + ends[None])


def status_of(observed: Observed) -> str:
    """Return the displayed status: a key of `palette.STATUSES`."""
    return "tracking" if isinstance(observed.finger, FingerLine) else observed.finger.value


def as_rows(points: ArrayLike) -> Points:
    """Return points as (N, 2), also for an empty input."""
    return np.asarray(points, np.float64).reshape(-1, 2)
