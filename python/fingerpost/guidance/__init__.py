"""Guidance of a robot by fixes: definition of the plane, following, picking and placing.

`define_plane` moves the gripper over a plane and registers every view with the robot; `guard_of`
makes the guard of a rig with a [robot] table. This package is independent of the command line.
"""

from fingerpost.guidance.agreement import Agreement, Sightings, ViewTie, agree, need_certainty
from fingerpost.guidance.arm_recording import ArmRecording
from fingerpost.guidance.attendance import Attendance, attended_at_first
from fingerpost.guidance.errors import (
    GripperNotFoundError,
    InconsistentPlaneError,
    PlaneError,
    PoorPlaneError,
)
from fingerpost.guidance.finders import (
    ContourFinder,
    GivenFinder,
    GripperFinder,
    MarkerFinder,
    MotionFinder,
    Sighting,
    load_outline,
    load_pixels,
)
from fingerpost.guidance.guided_arm import GuidedArm, GuidingOptions, guided
from fingerpost.guidance.keys import Keys
from fingerpost.guidance.log import CommandLog
from fingerpost.guidance.plane import (
    PlaneByRobot,
    PlaneOptions,
    Visit,
    define_plane,
    places_to_visit,
    spread_places,
)
from fingerpost.guidance.session import KEY_HELP, Activity, Session, SessionReport
from fingerpost.guidance.setup import guard_of, held_down, plane_of, region_of, robot_of
from fingerpost.guidance.worker import Jobs, Turns, Worker

__all__ = [
    "KEY_HELP",
    "Activity",
    "Agreement",
    "ArmRecording",
    "Attendance",
    "CommandLog",
    "ContourFinder",
    "GivenFinder",
    "GripperFinder",
    "GripperNotFoundError",
    "GuidedArm",
    "GuidingOptions",
    "InconsistentPlaneError",
    "Jobs",
    "Keys",
    "MarkerFinder",
    "MotionFinder",
    "PlaneByRobot",
    "PlaneError",
    "PlaneOptions",
    "PoorPlaneError",
    "Session",
    "SessionReport",
    "Sighting",
    "Sightings",
    "Turns",
    "ViewTie",
    "Visit",
    "Worker",
    "agree",
    "attended_at_first",
    "define_plane",
    "guard_of",
    "guided",
    "held_down",
    "load_outline",
    "load_pixels",
    "need_certainty",
    "places_to_visit",
    "plane_of",
    "region_of",
    "robot_of",
    "spread_places",
]
