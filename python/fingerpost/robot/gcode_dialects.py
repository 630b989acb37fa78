"""What the families of G-code arms do each in its own way; how they are talked to is elsewhere.

* Marlin: any machine whose axes are X, Y and Z, or that says so. `M114` reports the *goal*, so it
  is asked only after `M400`, which answers when all motion has ended. `M410` stops the motors
  without slowing them down; they may slip, so positions mean nothing until the next homing. Boards
  built with `EMERGENCY_PARSER` (`M115` says so) look for it in the stream, ahead of all queues.
* Rotrics' DexArm: a Marlin with absolute encoders, which it reads again after `M410`.
* uArm Swift Pro: `#n …` and `$n …`, absolute encoders (`P2220`), and Ctrl-X, which from firmware 4
  on stops the motors from the controller's interrupt.

All are moved by `G1`, which goes straight. With `G0` the last two turn their joints from one end to
the other in the shortest time: the hand goes along a curve.
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
"""A feed rate of `F1`; Marlin takes `F0` for none given, and goes as fast as before [m/s]."""

KEEPALIVE_S = 2.0
"""Marlin says that it is busy this often, unless `M113` has set something else [s]."""

FIRST_STOPPABLE_UARM = 4
"""Major version of the first firmware of a uArm that acts on Ctrl-X at once."""


class Numbering(StrEnum):
    """How lines are numbered and answers distinguished."""

    CHECKSUM = "checksum"
    """`N7 G1 X10*92`, answered by `ok`."""
    HASH = "hash"
    """`#7 G1 X10`, answered by `$7 ok`."""


class Tool(StrEnum):
    """What an arm holds things with."""

    SUCTION = "suction"
    GRIPPER = "gripper"


@dataclass(frozen=True, slots=True)
class Grip:
    """Commands that hold a thing and let it go."""

    close: str
    open: str


@dataclass(frozen=True, slots=True)
class Firmware:
    """What a controller's firmware says of itself.

    Attributes
    ----------
    name : str
        Its name and version, as far as it reports them.
    stops_at_once : bool
        A stop passes every queue. Otherwise it waits for whatever keeps the controller from
        reading: homing, `M400`, a move that is longer than its planner's buffer.
    """

    name: str
    stops_at_once: bool


@dataclass(frozen=True, slots=True)
class Stroke:
    """One straight move: its feed rate `F` in the controller's own unit, and how long it takes."""

    feed: str
    duration_s: float


class FeedRule(Protocol):
    """How a speed is sent to a controller."""

    def stroke(
        self, start_mm: NDArray[np.float64], goal_mm: NDArray[np.float64], speed_mm_s: float
    ) -> Stroke:
        """Return the feed rate at which the hand is nowhere faster than a speed.

        Raises
        ------
        OutOfReachError
            The arm cannot go straight from one to the other.
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
    """`F` is the length of the joint angles' velocity, whatever that makes of the hand's.

    Attributes
    ----------
    arm : Palletiser
        Whose joints they are.
    unit_deg : float
        A feed rate of 1 turns the joints by this in a minute [°].
    greatest : float
        Greatest feed rate of `G1`; a greater one counts as this.
    """

    arm: Palletiser
    unit_deg: float
    greatest: float

    STEP_MM = 1.0
    """The way is looked at this often; the joints turn by less than a degree on it [mm]."""

    def stroke(
        self, start_mm: NDArray[np.float64], goal_mm: NDArray[np.float64], speed_mm_s: float
    ) -> Stroke:
        """Return the feed rate of the place where the hand is fastest for its joints' sake."""
        length_mm = math.dist(start_mm, goal_mm)
        steps = max(1, math.ceil(length_mm / self.STEP_MM))
        shares = np.linspace(0.0, 1.0, steps + 1)[:, None]
        joints = self.arm.joints_deg(start_mm + shares * (goal_mm - start_mm))
        if np.isnan(joints[1:]).any():  # where the arm is, it is
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
    """Read the answer to `M115`; what it does not say, the board does not have."""
    name = re.search(r"FIRMWARE_NAME:\s*(.+?)(?=\s+[A-Z_]{4,}:|$)", answer, re.MULTILINE)
    parser = re.search(r"^Cap:EMERGENCY_PARSER:1\s*$", answer, re.MULTILINE)
    return Firmware(name[1] if name else "unnamed firmware", parser is not None)


def uarm_firmware(answer: str) -> Firmware:
    """Read the answer to `P2203`.

    Raises
    ------
    CommandRefusedError
        An older firmware, or one that does not say how old it is: nothing would stop it at once.
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
    """What one family of controllers does in its own way.

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
        Asks which firmware it is.
    firmware : callable
        Reads the answer.
    where : str
        Asks for the position; the answer holds `X… Y… Z…`.
    straight : str
        Goes straight to `X… Y… Z…`.
    drain : str or None
        Answered when all motion has ended; needed where `where` reports a goal.
    stop : bytes
        Stops at once, in the middle of anything.
    after_stop : tuple of str
        Commands that make the controller ready again.
    slips : str
        Why positions mean nothing after a stop in the middle of a motion; empty where they do.
    feed : FeedRule
        How a speed is sent to it.
    tools : mapping of Tool to Grip
        What it can hold things with, the usual first.
    limits : Limits or None
        Of a known arm; None where only its owner knows.
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
"""A line of its own, twice, so that no byte lost to noise loses it."""

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
"""Any Marlin machine; limits and gripper are its owner's. `G01` is how ISO 6983 writes `G1`, and
also what moves a board on which both are one command, known by its first two letters."""

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
"""Rotrics' DexArm. Its pump sucks (`M1000`) or blows (`M1001`): the cup holds by the one, the soft
gripper by the other."""

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
"""uArm Swift Pro, with round figures for its limits. Homing goes to a place above its front, at
`F10` nowhere faster than 0.09 m/s. Its firmware counts 6400 steps of its motors as 1 mm, 80 to a
degree, and takes `F` for the speed of these: the vendor gives 0 … 200 as its range."""
