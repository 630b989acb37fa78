"""Errors in the definition of a plane by a robot."""

from __future__ import annotations

from fingerpost.errors import FingerpostError


class PlaneError(FingerpostError):
    """Base class of the errors in the definition of a plane by the robot."""


class GripperNotFoundError(PlaneError):
    """The gripper is not detected in a view, or not clearly enough."""


class PoorPlaneError(PlaneError):
    """The visited places are consistent, but the plane is too uncertain for pointing."""


class InconsistentPlaneError(PlaneError):
    """The visited places contradict each other, and it is undetermined which of them is wrong."""
