"""Dialects of G-code arms; the dialogue with them is in `gcode_dialogue`.

* Marlin: any machine with the axes X, Y and Z, or that reports them. `M114` reports the *goal*, so
  it is sent only after `M400`, which answers at the end of all motion. `M410` stops the motors
  without deceleration; they may lose steps, so positions are invalid until the next homing. Boards
  built with `EMERGENCY_PARSER` (reported by `M115`) detect it in the stream, ahead of all queues.
* Rotrics' DexArm: Marlin with absolute encoders, which it reads again after `M410`.
* uArm Swift Pro: `#n …` and `$n …`, absolute encoders (`P2220`), and Ctrl-X, which from firmware 4
  on stops the motors from the controller's interrupt.

All are moved by `G1`, in a straight line. With `G0` the joints of the last two turn from start to
end in the shortest time: the hand moves along a curve.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from fingerpost.robot.errors import CommandRefusedError, OutOfReachError
from fingerpost.robot.palletiser import UARM_SWIFT_PRO, Palletiser
from fingerpost.robot.protocol import GripperKind, Limits

MM_PER_M = 1000.0
S_PER_MIN = 60.0

LEAST_SPEED_M_S = 1.0 / (S_PER_MIN * MM_PER_M)
"""Speed of a feed rate of `F1`; Marlin treats `F0` as none given, and keeps the last one [m/s]."""

KEEPALIVE_S = 2.0
"""Interval of Marlin's busy messages, unless `M113` has set another [s]."""

FIRST_STOPPABLE_UARM = 4
"""Major version of the first firmware of a uArm that acts on Ctrl-X at once."""


class Numbering(StrEnum):
    """How lines are numbered and answers distinguished."""

    CHECKSUM = "checksum"
    """`N7 G1 X10*92`, answered by `ok`."""
    HASH = "hash"
    """`#7 G1 X10`, answered by `$7 ok`."""


class Tool(StrEnum):
    """Tool with which an arm holds objects."""

    SUCTION = "suction"
    GRIPPER = "gripper"


@dataclass(frozen=True, slots=True)
class Grip:
    """Commands that hold and release an object."""

    close: str
    open: str


@dataclass(frozen=True, slots=True)
class Firmware:
    """Firmware of a controller, as it reports itself.

    Attributes
    ----------
    name : str
        Its name and version, as far as it reports them.
    stops_at_once : bool
        Whether a stop bypasses every queue. Otherwise it waits while the controller does not read:
        during homing, `M400`, or a move longer than its planner's buffer.
    """

    name: str
    stops_at_once: bool


@dataclass(frozen=True, slots=True)
class Stroke:
    """One straight move: its feed rate `F` in the controller's own unit, and its duration."""

    feed: str
    duration_s: float


class FeedRule(Protocol):
    """Conversion of a speed to a controller's feed rate."""

    def stroke(
        self, start_mm: NDArray[np.float64], goal_mm: NDArray[np.float64], speed_mm_s: float
    ) -> Stroke:
        """Return the greatest feed rate at which the hand nowhere exceeds a speed.

        Raises
        ------
        OutOfReachError
            The arm cannot move in a straight line from one to the other.
        """


class CartesianFeed:
    """`F` is the hand's speed [mm/min]."""

    def stroke(
        self, start_mm: NDArray[np.float64], goal_mm: NDArray[np.float64], speed_mm_s: float
    ) -> Stroke:
        """Return the speed itself, rounded down."""
        duration_s = math.dist(start_mm, goal_mm) / speed_mm_s
        return Stroke(f"{math.floor(S_PER_MIN * speed_mm_s + 1e-9)}", duration_s)


@dataclass(frozen=True, slots=True)
class JointFeed:
    """`F` is the norm of the joint velocities, regardless of the hand's speed.

    Attributes
    ----------
    arm : Palletiser
        The arm.
    unit_deg : float
        Rotation of the joints per minute at a feed rate of 1 [°].
    greatest : float
        Greatest feed rate of `G1`; a greater one is reduced to it.
    """

    arm: Palletiser
    unit_deg: float
    greatest: float

    STEP_MM = 1.0
    """Interval of sampling along a move, in which the joints turn by less than a degree [mm]."""

    def stroke(
        self, start_mm: NDArray[np.float64], goal_mm: NDArray[np.float64], speed_mm_s: float
    ) -> Stroke:
        """Return the feed rate at the place where the hand is fastest relative to its joints."""
        length_mm = math.dist(start_mm, goal_mm)
        steps = max(1, math.ceil(length_mm / self.STEP_MM))
        shares = np.linspace(0.0, 1.0, steps + 1)[:, None]
        joints = self.arm.joints_deg(start_mm + shares * (goal_mm - start_mm))
        if np.isnan(joints[1:]).any():  # the present position is reachable
            raise OutOfReachError(
                f"the arm cannot go straight from {_shown(start_mm)} to {_shown(goal_mm)} mm: its "
                "joints do not reach all of the way"
            )
        turns_deg = np.linalg.norm(np.diff(joints, axis=0), axis=1)
        turn_deg = float(np.nansum(turns_deg))
        if turn_deg == 0.0 or length_mm == 0.0:
            return Stroke("1", 0.0)
        least_deg_per_mm = float(np.nanmin(turns_deg)) * steps / length_mm
        feed = min(self.greatest, S_PER_MIN * speed_mm_s * least_deg_per_mm / self.unit_deg)
        feed = math.floor(100 * feed) / 100
        return Stroke(f"{feed:.2f}", turn_deg / (feed * self.unit_deg / S_PER_MIN))


def _shown(position_mm: NDArray[np.float64]) -> str:
    return f"({', '.join(f'{value:.0f}' for value in position_mm)})"


def marlin_firmware(answer: str) -> Firmware:
    """Parse the answer to `M115`; features that it does not list are absent."""
    name = re.search(r"FIRMWARE_NAME:\s*(.+?)(?=\s+[A-Z_]{4,}:|$)", answer, re.MULTILINE)
    parser = re.search(r"^Cap:EMERGENCY_PARSER:1\s*$", answer, re.MULTILINE)
    return Firmware(name[1] if name else "unnamed firmware", parser is not None)


def uarm_firmware(answer: str) -> Firmware:
    """Parse the answer to `P2203`.

    Raises
    ------
    CommandRefusedError
        An older firmware, or one of unknown version, which could not be stopped at once.
    """
    version = re.search(r"\bV?(\d+)\.[\d.]*\d", answer)
    if version is None or int(version[1]) < FIRST_STOPPABLE_UARM:
        raise CommandRefusedError(
            f"uArm firmware {version[0] if version else 'of no version'} does not stop at once (on "
            f"Ctrl-X); V{FIRST_STOPPABLE_UARM}.0 and newer do: update it before the arm may move"
        )
    return Firmware(f"uArm {version[0]}", stops_at_once=True)


@dataclass(frozen=True, slots=True, kw_only=True)
class Dialect:
    """Properties of one family of controllers.

    Attributes
    ----------
    numbering : Numbering
        How lines are numbered and answers distinguished.
    baud : int
        Usual bits per second.
    reply_s : float
        Longest time to an answer [s].
    start, home : tuple of str
        Commands after connecting, and for homing.
    identify : str
        Command that queries the firmware.
    firmware : callable
        Parses the answer.
    where : str
        Command that queries the position; the answer contains `X… Y… Z…`.
    straight : str
        Command that moves in a straight line to `X… Y… Z…`.
    drain : str or None
        Command that is answered at the end of all motion; required if `where` reports a goal.
    stop : bytes
        Bytes that stop at once, at any time.
    after_stop : tuple of str
        Commands that make the controller ready again.
    slips : str
        Why positions are invalid after a stop during a motion; empty if they are valid.
    feed : FeedRule
        Conversion of speeds.
    tools : mapping of Tool to Grip
        Possible tools, the usual one first.
    limits : Limits or None
        Limits of a known arm; None if the user must give them.
    """

    numbering: Numbering
    baud: int = 115200
    reply_s: float
    start: tuple[str, ...] = ()
    home: tuple[str, ...]
    identify: str
    firmware: Callable[[str], Firmware]
    where: str
    straight: str = "G1"
    drain: str | None = None
    stop: bytes
    after_stop: tuple[str, ...] = ()
    slips: str = ""
    feed: FeedRule = field(default_factory=CartesianFeed)
    tools: Mapping[Tool, Grip] = field(default_factory=dict)
    limits: Limits | None = None


QUICK_STOP = "M410"
"""Marlin's stop."""

_STOP_MARLIN = 2 * f"\n{QUICK_STOP}\n".encode("ascii")
"""A separate line, sent twice, in case noise destroys one byte."""

MARLIN = Dialect(
    numbering=Numbering.CHECKSUM,
    reply_s=2.5 * KEEPALIVE_S,
    start=("G21", "G90"),
    home=("G28",),
    identify="M115",
    firmware=marlin_firmware,
    where="M114",
    straight="G01",
    drain="M400",
    stop=_STOP_MARLIN,
    slips="M410 has stopped its motors without slowing them down, and they may have slipped",
)
"""Any Marlin machine; its user gives limits and gripper. `G01` is the notation of `G1` in ISO 6983,
and also works on a board that identifies commands by their first two letters."""

DEXARM = Dialect(
    numbering=Numbering.CHECKSUM,
    reply_s=2.5 * KEEPALIVE_S,
    start=("G21", "G90"),
    home=("M1112",),
    identify="M115",
    firmware=marlin_firmware,
    where="M114",
    drain="M400",
    stop=_STOP_MARLIN,
    tools={Tool.SUCTION: Grip("M1000", "M1001"), Tool.GRIPPER: Grip("M1001", "M1000")},
)
"""Rotrics' DexArm. Its pump sucks (`M1000`) or blows (`M1001`): the cup holds by suction, the soft
gripper by pressure."""

UARM = Dialect(
    numbering=Numbering.HASH,
    reply_s=2.0,
    start=("M17",),
    home=("G1 X200 Y0 Z150 F10",),
    identify="P2203",
    firmware=uarm_firmware,
    where="P2220",
    stop=b"\x18\x18",
    after_stop=("M17",),
    feed=JointFeed(UARM_SWIFT_PRO, unit_deg=80.0, greatest=100.0),
    tools={
        Tool.SUCTION: Grip("M2231 V1", "M2231 V0"),
        Tool.GRIPPER: Grip("M2232 V1", "M2232 V0"),
    },
    limits=Limits(
        lower_m=(0.0, -0.32, -0.1),
        upper_m=(0.32, 0.32, 0.15),
        max_speed_m_s=0.1,
        min_speed_m_s=0.001,
        reach_m=0.32,
        min_reach_m=0.12,
        gripper=GripperKind.OPEN_CLOSE,
    ),
)
"""uArm Swift Pro, with round figures for its limits. Homing moves to a place above its front, at
`F10` nowhere faster than 0.09 m/s. Its firmware treats 6400 steps of its motors as 1 mm, with 80
steps per degree, and interprets `F` as their speed: the vendor's range is 0 … 200."""
