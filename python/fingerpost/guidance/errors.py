"""Why the robot's visits do not tell where a plane lies."""

from __future__ import annotations

from fingerpost.errors import FingerpostError


class PlaneError(FingerpostError):
    """Base of everything by which a plane defined by the robot fails."""


class GripperNotFoundError(PlaneError):
    """A view does not show the gripper, or not clearly enough to say where."""


class PoorPlaneError(PlaneError):
    """The places visited agree, but they leave the plane too uncertain to point on."""


class InconsistentPlaneError(PlaneError):
    """The places visited contradict each other, and which of them is wrong is not determined."""
