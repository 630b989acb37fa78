"""The closed loop: an operator, a hand, cameras, a robot and a block in one simulated world.

The whole product runs on the world's pixels: the pointer tracks the rendered hand, the robot
defines the plane by visiting it, follows the indicated point and carries a block, while a simulated
operator sees the gripper's position and corrects. With MuJoCo (extra ``mujoco``) the arm has
physics, and is driven by the package's own driver through the emulated controller's serial port.

    summary = run_robot_demo("out")            # fingerpost demo --robot
    result = run_guidance(50)                  # fingerpost experiment --guidance 50
"""

from fingerpost.closed_loop.demo import RobotDemoSummary, run_robot_demo
from fingerpost.closed_loop.kinematic import KinematicCell
from fingerpost.closed_loop.layout import Aim, CameraPlacement
from fingerpost.closed_loop.loop import ClosedLoop, LoopOptions, Moment
from fingerpost.closed_loop.operator import Habits, Operator
from fingerpost.closed_loop.physics import Optics, PhysicalCell
from fingerpost.closed_loop.task import Leg, Task
from fingerpost.closed_loop.trials import (
    GuidanceOptions,
    GuidanceResult,
    GuidanceTrial,
    PlaneAccuracy,
    run_guidance,
)
from fingerpost.closed_loop.world import Cell, World

__all__ = [
    "Aim",
    "CameraPlacement",
    "Cell",
    "ClosedLoop",
    "GuidanceOptions",
    "GuidanceResult",
    "GuidanceTrial",
    "Habits",
    "KinematicCell",
    "Leg",
    "LoopOptions",
    "Moment",
    "Operator",
    "Optics",
    "PhysicalCell",
    "PlaneAccuracy",
    "RobotDemoSummary",
    "Task",
    "World",
    "run_guidance",
    "run_robot_demo",
]
