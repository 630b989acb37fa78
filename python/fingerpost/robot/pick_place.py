"""Picking up a block and placing it elsewhere, as a state machine of explicit steps.

    approach → descend → grip → lift → go → lower → release → retreat

Every step can be undone and aborted. The goal of a step is fixed when the machine is made, so an
interrupted step can simply be repeated. Undoing it leads back to its start, from any point of
interruption.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from fingerpost.errors import InvalidInputError
from fingerpost.robot.errors import NotReadyError
from fingerpost.robot.follow import Selection
from fingerpost.robot.guard import Guard, Presence
from fingerpost.robot.options import CheckedOptions


class PickPlaceOptions(CheckedOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Heights, speeds and grip.

    Attributes
    ----------
    travel_m : float
        Height above the plane during horizontal motion [m]; above all objects there, and no lower
        than the two places.
    grip_m, release_m : float
        Heights above the plane at which the block is gripped and released [m], ≥ 0.
    grip : float, "open" or "close"
        Command of the gripper that holds the block.
    speed_m_s, slow_m_s : float
        Speed of horizontal and of vertical motion [m/s].
    needs : Presence
        Condition throughout: the operator's presence, or a live fix as well.

    Raises
    ------
    InvalidInputError
        A value out of range, or a travel height lower than a place.
    """

    travel_m: Annotated[float, msgspec.Meta(ge=0, le=10)] = 0.1
    grip_m: Annotated[float, msgspec.Meta(ge=0, le=10)] = 0.015
    release_m: Annotated[float, msgspec.Meta(ge=0, le=10)] = 0.017
    grip: Annotated[float, msgspec.Meta(ge=0, le=1)] | Literal["open", "close"] = "close"
    speed_m_s: Annotated[float, msgspec.Meta(gt=0, le=10)] = 0.1
    slow_m_s: Annotated[float, msgspec.Meta(gt=0, le=10)] = 0.03
    needs: Presence = Presence.OPERATOR

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("grip_m", "release_m"):
            if self.travel_m < getattr(self, name):
                raise InvalidInputError(
                    f"travel_m is {self.travel_m:g}; at least {name}, {getattr(self, name):g}, is "
                    "right: the way is above the places"
                )


def check_heights(guard: Guard, options: PickPlaceOptions) -> None:
    """Check that the safe region includes all heights of picking and placing.

    Call it before the arm is homed: the heights do not depend on the blocks' places.

    Raises
    ------
    InvalidInputError
        It does not; the message names the height and the nearest one inside.
    """
    for name in ("travel_m", "grip_m", "release_m"):
        above_m = getattr(options, name)
        _, allowed_m = guard.clamp(guard.region.centre, above_m)
        if allowed_m != above_m:
            raise InvalidInputError(
                f"{name} is {above_m:g}, outside the safe region; {allowed_m:g} m above the plane "
                "is the nearest inside"
            )


class Step(StrEnum):
    """The steps, in order."""

    APPROACH = "approach"
    DESCEND = "descend"
    GRIP = "grip"
    LIFT = "lift"
    GO = "go"
    LOWER = "lower"
    RELEASE = "release"
    RETREAT = "retreat"


STEPS = tuple(Step)


@dataclass(frozen=True, slots=True)
class _Action:
    do: Callable[[], None]
    undo: Callable[[], None]


class PickPlace:
    """Moves one block from one place to another.

    Parameters
    ----------
    guard : Guard
        Armed guard, with the gripper inside the safe region.
    pick, place : Selection
        Present place and destination of the block.
    options : PickPlaceOptions
        Heights, speeds and grip.

    Raises
    ------
    InvalidInputError
        A height or place outside the safe region: for a block, the nearest permitted place would be
        wrong.
    GripperError
        The robot's gripper cannot execute the options' command.
    """

    def __init__(
        self,
        guard: Guard,
        pick: Selection,
        place: Selection,
        options: PickPlaceOptions | None = None,
    ) -> None:
        self._guard = guard
        self._options = options = options or PickPlaceOptions()
        self._pick = pick
        self._place = place
        self._start: tuple[NDArray[np.float64], float] | None = None
        self._completed = 0
        self._interrupted = False
        self._busy = threading.Lock()
        check_heights(guard, options)
        guard.check_gripper(options.grip)
        for name, selection in (("pick", pick), ("place", place)):
            _need_allowed(guard, name, selection)
        self._actions = self._plan()

    @property
    def next_step(self) -> Step | None:
        """The step that `advance` executes; None when all are done."""
        return STEPS[self._completed] if self._completed < len(STEPS) else None

    @property
    def interrupted(self) -> bool:
        """Whether `next_step` was begun and not finished."""
        return self._interrupted

    @property
    def done(self) -> bool:
        """Whether all steps are done."""
        return self._completed == len(STEPS)

    def advance(self) -> Step:
        """Execute the next step, or repeat an interrupted one, and return it.

        Raises
        ------
        NotReadyError
            All steps are done, or one is in progress.
        RobotError
            It was stopped or failed; it counts as interrupted.
        """
        step = self.next_step
        if step is None:
            raise NotReadyError("all steps have been taken")
        self._run(self._actions[step].do)
        self._completed += 1
        return step

    def run(self) -> None:
        """Execute all remaining steps.

        Raises
        ------
        RobotError
            As for `advance`.
        """
        while not self.done:
            self.advance()

    def undo(self) -> Step:
        """Undo the last step begun and return it; it becomes the next step.

        Raises
        ------
        NotReadyError
            No step has been done, or one is in progress.
        RobotError
            It was stopped or failed; undo again to continue.
        """
        if not self._interrupted:
            if self._completed == 0:
                raise NotReadyError("there is nothing to undo")
            self._completed -= 1
        step = STEPS[self._completed]
        self._run(self._actions[step].undo)
        return step

    def abort(self) -> None:
        """Stop at once and disarm; the gripper keeps its grip. From any thread.

        Afterwards, arm the guard again and `undo` or `advance`.
        """
        self._guard.halt("pick and place aborted")

    def _run(self, action: Callable[[], None]) -> None:
        if not self._busy.acquire(blocking=False):
            raise NotReadyError("a step is being taken")
        try:
            self._interrupted = True
            action()
            self._interrupted = False
        finally:
            self._busy.release()

    def _plan(self) -> dict[Step, _Action]:
        options = self._options
        pick_high, pick_low = self._up_down(self._pick, options.travel_m, options.grip_m)
        place_high, place_low = self._up_down(self._place, options.travel_m, options.release_m)
        return {
            Step.APPROACH: _Action(self._approach, self._return),
            Step.DESCEND: _Action(pick_low, pick_high),
            Step.GRIP: _Action(self._grip(self._pick), self._let_go(self._pick)),
            Step.LIFT: _Action(pick_high, pick_low),
            Step.GO: _Action(self._carry(self._place), self._carry(self._pick)),
            Step.LOWER: _Action(place_low, place_high),
            Step.RELEASE: _Action(self._let_go(self._place), self._grip(self._place)),
            Step.RETREAT: _Action(place_high, place_low),
        }

    def _approach(self) -> None:
        """Open the gripper, move straight up, then over the block."""
        here, above_m = self._guard.where()
        if self._start is None:
            self._start = (here, above_m)
        self._guard.gripper("open", fix=self._pick.fix)
        self._move(here, self._options.travel_m, self._pick, self._options.slow_m_s)
        self._move(self._pick.point, self._options.travel_m, self._pick, self._options.speed_m_s)

    def _return(self) -> None:
        """Move back above the start of the approach, then down to its height."""
        if self._start is None:
            return
        point, above_m = self._start
        self._move(point, self._options.travel_m, self._pick, self._options.speed_m_s)
        self._move(point, above_m, self._pick, self._options.slow_m_s)
        self._start = None

    def _carry(self, to: Selection) -> Callable[[], None]:
        return lambda: self._move(to.point, self._options.travel_m, to, self._options.speed_m_s)

    def _up_down(
        self, at: Selection, high_m: float, low_m: float
    ) -> tuple[Callable[[], None], Callable[[], None]]:
        slow = self._options.slow_m_s
        return (
            lambda: self._move(at.point, high_m, at, slow),
            lambda: self._move(at.point, low_m, at, slow),
        )

    def _grip(self, at: Selection) -> Callable[[], None]:
        return lambda: self._guard.gripper(self._options.grip, fix=at.fix)

    def _let_go(self, at: Selection) -> Callable[[], None]:
        return lambda: self._guard.gripper("open", fix=at.fix)

    def _move(
        self, point: NDArray[np.float64], above_m: float, cause: Selection, speed_m_s: float
    ) -> None:
        self._guard.move(
            point, above_m, fix=cause.fix, needs=self._options.needs, speed_m_s=speed_m_s
        )


def _need_allowed(guard: Guard, name: str, selection: Selection) -> None:
    allowed, _ = guard.clamp(selection.point, guard.allowed.lowest_m)
    if not np.array_equal(allowed, selection.point):
        x, y = selection.point
        raise InvalidInputError(
            f"{name} at ({x:g}, {y:g}) is outside the safe region; ({allowed[0]:g}, "
            f"{allowed[1]:g}) is the nearest inside"
        )
