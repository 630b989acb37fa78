"""The course of one errand: point at a block, point at a place, have it carried there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from fingerpost.closed_loop.layout import WORKSPACE_MM
from fingerpost.closed_loop.loop import ClosedLoop
from fingerpost.closed_loop.operator import Operator
from fingerpost.closed_loop.world import World
from fingerpost.pointing import Fix
from fingerpost.robot import FollowReport, FollowState, Selection

Array = NDArray[np.float64]
T = TypeVar("T")

MARGIN_MM = 20.0
"""Targets lie so far inside the workspace; people do not ask for what is on its rim."""

APART_MM = 70.0
"""From the block to where it shall go, at least."""

SETTLED_S = 0.4
"""Open loop is over when the arm has been where the hand points for so long [s]."""

OPEN_LOOP_S = 20.0
FEEDBACK_S = 60.0
FIX_S = 4.0


@dataclass(frozen=True)
class Leg:
    """One target that was pointed at."""

    open_mm: float  # from gripper to target, open loop
    open_s: float  # until the gripper stood there
    closed_mm: float | None  # from gripper to target when the operator had selected; None: never
    closed_s: float  # from when he began to correct until then
    corrections: int
    lost: int  # how often the hand was lost and had to be brought back to where it is found


class Course:
    """One errand.

    Parameters
    ----------
    world, loop, operator
        Who takes part; the robot homed.
    looking
        Whether the cameras go on taking pictures while no fix is needed.

    Attributes
    ----------
    legs : list of Leg
        What was pointed at so far.
    problem : str
        Why the errand ended early; else empty.
    """

    def __init__(
        self, world: World, loop: ClosedLoop, operator: Operator, *, looking: bool
    ) -> None:
        self._world = world
        self._loop = loop
        self._operator = operator
        self._looking = looking
        self._lost = 0
        self.legs: list[Leg] = []
        self.problem = ""

    def carry(self, block_mm: Array, place_mm: Array) -> float | None:
        """Point, correct, pick and place.

        Parameters
        ----------
        block_mm, place_mm : (2,)
            Where the block lies and where it shall go [mm].

        Returns
        -------
        float or None
            How far from there it lies in the end [mm]; None if it was not carried, see `problem`.

        Raises
        ------
        RobotError
            The robot's own; it has been stopped.
        """
        selections: list[Selection] = []
        for target_mm in (block_mm, place_mm):
            self._go_aside()
            if not self._loop.wait_for_fix(FIX_S):
                self._give_up("the hand was not found")
                return None
            selection = self._point(target_mm)
            if selection is None:
                self._give_up("nothing was selected")
                return None
            selections.append(selection)
        self._loop.withdraw()
        self._loop.looking = self._looking
        pick, place = selections
        self._loop.pick_and_place(pick, place)
        self._loop.doing = "done"
        self._world.advance(SETTLED_S)
        return float(np.hypot(*(self._world.cell.block_mm[:2] - place_mm)))

    def _go_aside(self) -> None:
        self._loop.doing = "make room"
        self._loop.looking, looked = self._looking, self._loop.looking
        self._loop.go_aside()
        self._loop.looking = looked

    def _point(self, target_mm: Array) -> Selection | None:
        """Point open loop, then with feedback until a point is selected."""
        world, loop, operator = self._world, self._loop, self._operator
        begin_s = world.time_s
        loop.doing, operator.corrects = "open loop", False
        operator.mean(target_mm, begin_s)
        self._lost = 0
        self._patiently(lambda left_s: loop.follow(self._settled(), left_s) or None, OPEN_LOOP_S)
        open_mm, corrected_from_s = self._off_mm(target_mm), world.time_s
        before = operator.corrections
        loop.doing, operator.corrects = "with feedback", True
        selection = self._patiently(loop.select, FEEDBACK_S)
        self.legs.append(
            Leg(
                open_mm,
                corrected_from_s - begin_s,
                None if selection is None else self._off_mm(target_mm),
                world.time_s - corrected_from_s,
                operator.corrections - before,
                self._lost,
            )
        )
        return selection

    def _patiently(self, run: Callable[[float], T | None], timeout_s: float) -> T | None:
        """Run what a lost hand ends early, and again after it has been found."""
        end_s = self._world.time_s + timeout_s
        while (result := run(end_s - self._world.time_s)) is None:
            if self._world.time_s >= end_s or not self._loop.hand_lost:
                return None
            self._find_again()
        return result

    def _find_again(self) -> None:
        """Have the arm make room and the hand wait where it is looked for, then point as before."""
        operator, doing, corrects = self._operator, self._loop.doing, self._operator.corrects
        self._lost += 1
        operator.corrects = False
        operator.rest(self._world.time_s)
        self._go_aside()
        self._loop.wait_for_fix(FIX_S)
        operator.resume(self._world.time_s)
        self._loop.doing, operator.corrects = doing, corrects

    def _settled(self) -> Callable[[Fix, FollowReport], bool]:
        """Return what tells when the arm has been for a while where a still hand points."""
        since_s = self._world.time_s

        def settled(_: Fix, report: FollowReport) -> bool:
            nonlocal since_s
            now_s = self._world.time_s
            if report.state is not FollowState.THERE or self._operator.is_moving(now_s):
                since_s = now_s
            return now_s - since_s > SETTLED_S

        return settled

    def _off_mm(self, target_mm: Array) -> float:
        return float(np.hypot(*(1000 * self._loop.gripper_m - target_mm)))

    def _give_up(self, problem: str) -> None:
        fix = self._loop.fix
        told = "no fix" if fix is None else f"fix is {fix.status}: {fix.reason}"
        self.problem = f"{problem} ({told})"


def block_and_place_mm(rng: np.random.Generator) -> tuple[Array, Array]:
    """Draw where a block lies and where it shall go, both (2,) [mm]."""
    block_mm = place_mm = target_mm(rng)
    while np.hypot(*(place_mm - block_mm)) < APART_MM:
        place_mm = target_mm(rng)
    return block_mm, place_mm


def target_mm(rng: np.random.Generator) -> Array:
    """Draw a point (2,) of the workspace [mm]."""
    lower, upper = WORKSPACE_MM.min(axis=0), WORKSPACE_MM.max(axis=0)
    return np.asarray(rng.uniform(lower + MARGIN_MM, upper - MARGIN_MM))
