"""Tasks of a simulated person: point at a block, then at a place, to have the block carried there.

A person acts at every frame of the cameras: holds a key down, which is the dead-man's switch, and
continues a script, which is a generator.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fingerpost.closed_loop.layout import WORKSPACE_MM
from fingerpost.closed_loop.loop import ClosedLoop
from fingerpost.closed_loop.operator import Operator
from fingerpost.closed_loop.world import World
from fingerpost.guidance.session import AWAY_KEY, HIDDEN_S
from fingerpost.pointing import Status

Array = NDArray[np.float64]
Script = Generator[None, None, None]
Waiting = Generator[None, None, bool]

HOLD_KEY = " "
"""Key without a command: held down, it only shows that the operator is present."""

MARGIN_MM = 20.0
"""Least distance of targets from the edge of the workspace."""

APART_MM = 70.0
"""Least distance from the block to its place."""

SETTLED_S = 0.4
"""Time at the indicated point after which the open-loop phase ends [s]."""

OPEN_LOOP_S = 20.0
FEEDBACK_S = 60.0
FIX_S = 6.0
FOLLOWED_S = 0.7
AWAY_S = 20.0
CARRYING_S = 60.0
"""Timeouts of the phases [s]."""

TASK_S = 300.0
"""Longest duration of a task [s]."""


@dataclass(frozen=True)
class Leg:
    """One target that was pointed at."""

    open_mm: float  # distance from gripper to target, open loop
    open_s: float  # until the gripper stood there
    closed_mm: float | None  # from gripper to target at the selection; None: never selected
    closed_s: float  # from the first correction until then
    corrections: int
    lost: int  # times that the hand was lost and had to return to its start pose


class Scripted:
    """A person who follows a script and holds a key down all the time.

    Parameters
    ----------
    world, loop
        The simulated world, and the loop under test.

    Attributes
    ----------
    problem : str
        Why the script ended early; else empty.
    """

    def __init__(self, world: World, loop: ClosedLoop) -> None:
        self.done = False
        self.hand_is_away = True
        self.doing = "make room"
        self.problem = ""
        self._world = world
        self._loop = loop
        self._key = HOLD_KEY
        self._script = self._play()

    def act(self, time_s: float) -> None:  # noqa: ARG002 - the world's time, which it knows
        """Hold the key down, and continue the script."""
        self._loop.session.press(self._key)
        if self._loop.guard.armed:  # before, there is nothing to react to
            self.done = self.done or next(self._script, self) is self

    def _play(self) -> Script:
        """Clear the view of the hand first."""
        yield from self._clear_view()

    def _clear_view(self) -> Waiting:
        """Let the arm clear the view; return whether it did in time."""
        self._key = AWAY_KEY
        session = self._loop.session
        has_cleared = yield from self._until(lambda: session.is_out_of_the_way, AWAY_S)
        self._key = HOLD_KEY
        return has_cleared

    def _until(self, true: Callable[[], bool], timeout_s: float) -> Waiting:
        """Wait for a condition; return whether it became true in time."""
        end_s = self._world.time_s + timeout_s
        while not true():
            if self._world.time_s >= end_s:
                return False
            yield
        return True

    def _idle(self, span_s: float) -> Script:
        """Wait for a time span."""
        yield from self._until(lambda: False, span_s)

    def _is_known(self) -> bool:
        """Whether there is a fix of the person's hand."""
        fix = self._loop.guard.newest_fix
        return fix is not None and fix.status is Status.OK


class Task(Scripted):
    """Point at a block, correct, point at a place, correct, and wait for the block to be carried.

    Parameters
    ----------
    world, loop, operator
        The participants; the robot is homed.
    block_mm, place_mm : (2,)
        Positions of the block and of its destination [mm].

    Attributes
    ----------
    legs : list of Leg
        The completed targets.
    """

    def __init__(
        self,
        world: World,
        loop: ClosedLoop,
        operator: Operator,
        block_mm: Array,
        place_mm: Array,
    ) -> None:
        super().__init__(world, loop)
        self._operator = operator
        self._targets_mm = block_mm, place_mm
        self._lost = 0
        self.legs: list[Leg] = []

    @property
    def placed_mm(self) -> float | None:
        """Distance of the block from its place [mm]; None if it was not carried there."""
        if not self._loop.session.done:
            return None
        return float(np.hypot(*(self._world.cell.block_mm[:2] - self._targets_mm[1])))

    def _play(self) -> Script:
        yield from self._clear_view()
        self.hand_is_away = False
        self.doing = "show the hand"
        if not (yield from self._until(self._is_known, FIX_S)):
            self._give_up("the hand was not found")
            return
        for number, target_mm in enumerate(self._targets_mm, start=1):
            if not (yield from self._point(target_mm, number)):
                self._give_up("nothing was selected")
                return
        self.hand_is_away, self.doing = True, "watch"
        if not (yield from self._until(lambda: self._loop.session.done, CARRYING_S)):
            self._give_up("the block was not carried")

    def _point(self, target_mm: Array, number: int) -> Waiting:
        """Point open loop, then with feedback until a point is selected."""
        world, operator = self._world, self._operator
        begin_s = world.time_s
        self.doing, operator.corrects = "open loop", False
        operator.mean(target_mm, begin_s)
        self._lost = 0
        yield from self._patiently(self._settled(), OPEN_LOOP_S)
        open_mm, corrected_from_s = self._off_mm(target_mm), world.time_s
        before = operator.corrections
        self.doing, operator.corrects = "with feedback", True
        is_selected = yield from self._patiently(
            lambda: self._loop.session.selections >= number, FEEDBACK_S
        )
        self.legs.append(
            Leg(
                open_mm,
                corrected_from_s - begin_s,
                self._off_mm(target_mm) if is_selected else None,
                world.time_s - corrected_from_s,
                operator.corrections - before,
                self._lost,
            )
        )
        return is_selected

    def _patiently(self, true: Callable[[], bool], timeout_s: float) -> Waiting:
        """Wait for a condition; return the hand to its start pose whenever it is lost."""
        end_s = self._world.time_s + timeout_s
        while self._world.time_s < end_s:
            left_s = end_s - self._world.time_s
            yield from self._until(lambda: true() or self._is_lost, left_s)
            if true():
                return True
            if self._is_lost:
                yield from self._find_again()
        return False

    @property
    def _is_lost(self) -> bool:
        return self._world.time_s - self._loop.usable_s > HIDDEN_S

    def _find_again(self) -> Script:
        """Let the arm retreat and the hand wait at its start pose, then point as before."""
        operator, doing, corrects = self._operator, self.doing, self._operator.corrects
        self._lost += 1
        self.doing, operator.corrects = "make room", False
        operator.rest(self._world.time_s)
        yield from self._clear_view()
        yield from self._until(self._is_known, FIX_S)
        operator.resume(self._world.time_s)
        self.doing, operator.corrects = doing, corrects

    def _settled(self) -> Callable[[], bool]:
        """Return a test whether the arm has stood for a while at the point of a still hand."""
        since_s = self._world.time_s

        def settled() -> bool:
            nonlocal since_s
            now_s = self._world.time_s
            if not self._loop.is_there or self._operator.is_moving(now_s):
                since_s = now_s
            return now_s - since_s > SETTLED_S

        return settled

    def _off_mm(self, target_mm: Array) -> float:
        return float(np.hypot(*(1000 * self._loop.gripper_m[:2] - target_mm)))

    def _give_up(self, problem: str) -> None:
        fix = self._loop.views.fix
        state = "no fix" if fix is None else f"fix is {fix.status}: {fix.reason}"
        why = self._loop.guard.why_stopped
        self.problem = f"{problem} ({state}{f'; stopped: {why}' if why else ''})"


class Absence(Scripted):
    """Hold the key down and show no hand for `SPAN_S`.

    Attributes
    ----------
    from_m : (3,) or None
        Position of the gripper after clearing the view [m].
    """

    SPAN_S = 20.0

    def __init__(self, world: World, loop: ClosedLoop) -> None:
        super().__init__(world, loop)
        self.from_m: Array | None = None

    def _play(self) -> Script:
        yield from self._clear_view()
        self.doing = "no hand"
        self.from_m = self._loop.gripper_m
        yield from self._idle(self.SPAN_S)


class Vanishing(Task):
    """Point at a block; the hand vanishes between two frames while the arm follows.

    Attributes
    ----------
    gone_s
        Time at which the hand vanished [s]; infinite before.
    from_m : (3,) or None
        Position of the gripper then [m].
    """

    SPAN_S = 10.0
    gone_s = math.inf
    from_m: Array | None = None

    def _play(self) -> Script:
        yield from self._clear_view()
        self.hand_is_away = False
        if not (yield from self._until(self._is_known, FIX_S)):
            self._give_up("the hand was not found")
            return
        self._operator.mean(self._targets_mm[0], self._world.time_s)
        yield from self._idle(FOLLOWED_S)
        if not (yield from self._until(lambda: self._loop.guard.busy, FIX_S)):
            self._give_up("the arm did not follow")
            return
        self.hand_is_away = True
        self._loop.views.vanish()
        self.gone_s, self.from_m = self._world.time_s, self._loop.gripper_m
        yield from self._idle(self.SPAN_S)


def block_and_place_mm(rng: np.random.Generator) -> tuple[Array, Array]:
    """Draw the positions of a block and of its place, both (2,) [mm]."""
    block_mm = place_mm = target_mm(rng)
    while np.hypot(*(place_mm - block_mm)) < APART_MM:
        place_mm = target_mm(rng)
    return block_mm, place_mm


def target_mm(rng: np.random.Generator) -> Array:
    """Draw a point (2,) of the workspace [mm]."""
    lower, upper = WORKSPACE_MM.min(axis=0), WORKSPACE_MM.max(axis=0)
    return np.asarray(rng.uniform(lower + MARGIN_MM, upper - MARGIN_MM))
