"""Recording of a guided arm with the views: its state at every step, and every command."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from fingerpost.guidance.guided_arm import GuidedArm
from fingerpost.guidance.log import CommandRow
from fingerpost.robot import CommandRecord, Pose

if TYPE_CHECKING:
    from fingerpost.pipeline import Step
    from fingerpost.recording.session import Recorder

STATE_TOPIC, POSE_TOPIC, COMMAND_TOPIC = "/robot/state", "/robot/pose", "/robot/command"
ROBOT_FRAME = "robot"


@dataclass(frozen=True, slots=True)
class ArmRow:
    """State of an arm at the time of a step.

    Attributes
    ----------
    time_s
        Time of the step [s].
    state
        State of the driver: `moving`, `idle`, `fault` and the like.
    homed, armed, moves
        Whether it is homed; whether commands may pass; whether one may still be in execution.
    why_stopped
        Reason for the guard's last stop; empty without one.
    """

    time_s: float
    state: str
    homed: bool
    armed: bool
    moves: bool
    why_stopped: str


class ArmRecording:
    """Adds an arm to a recording.

    Parameters
    ----------
    arm
        The arm; connected while steps are taken.
    recorder
        Recorder of the views.
    """

    def __init__(self, arm: GuidedArm, recorder: Recorder) -> None:
        self._arm, self._recorder = arm, recorder

    def take(self, step: Step) -> None:
        """Record the arm's state and its last pose at the time of a step, without waiting."""
        guard, status, time_s = self._arm.guard, self._arm.robot.status(), step.fix.time_s
        row = ArmRow(
            time_s, status.state.value, status.homed, guard.armed, guard.busy, guard.why_stopped
        )
        self._recorder.add_row(STATE_TOPIC, row, time_s, step.index)
        if (pose := guard.pose) is not None:
            self._recorder.add_pose(
                POSE_TOPIC, ROBOT_FRAME, pose.position_m, _quaternion(pose), time_s, step.index
            )

    def on_record(self, record: CommandRecord) -> None:
        """Record a command; from any thread, and from a signal's handler."""
        time_s = record.time_s if math.isfinite(record.time_s) else self._arm.guard.time_s
        self._recorder.add_row(COMMAND_TOPIC, CommandRow.of(record), time_s)


def _quaternion(pose: Pose) -> tuple[float, float, float, float]:
    """Return R = Rz(yaw) · Ry(−pitch) · Rx(roll) as x, y, z, w; angles not set count as 0."""
    roll, pitch, yaw = pose.roll_rad or 0.0, pose.pitch_rad or 0.0, pose.yaw_rad or 0.0
    halves = (0.5 * roll, -0.5 * pitch, 0.5 * yaw)
    (cr, cp, cy), (sr, sp, sy) = map(math.cos, halves), map(math.sin, halves)
    return (
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )
