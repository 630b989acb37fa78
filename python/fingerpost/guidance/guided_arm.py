"""One arm that fixes guide, used by the terminal, the operator's page and tests.

Everything is checked before anything moves: the safe region, the heights of picking and placing,
and, once the arm is connected, its limits and its gripper.
"""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from fingerpost.config import RobotTable
from fingerpost.guidance.session import Session
from fingerpost.guidance.setup import guard_of
from fingerpost.pipeline import Step
from fingerpost.robot import (
    CommandRecord,
    DwellSelector,
    Follower,
    FollowOptions,
    Guard,
    GuardOptions,
    PickPlaceOptions,
    Robot,
    check_heights,
)
from fingerpost.robot.guard import RecordCallback


@dataclass(frozen=True, kw_only=True)
class GuidingOptions:
    """Options of guidance.

    Attributes
    ----------
    guard
        Options of the guard.
    follow
        Options of following.
    carry
        Heights and grip of picking and placing; None only follows.
    selector
        Makes the selector by dwelling; None selects by key alone.
    """

    guard: GuardOptions = field(default_factory=GuardOptions)
    follow: FollowOptions = field(default_factory=FollowOptions)
    carry: PickPlaceOptions | None = None
    selector: Callable[[Guard], DwellSelector] | None = None


class GuidedArm:
    """An arm with its guard and options of guidance.

    Parameters
    ----------
    robot
        The arm, not yet connected.
    table
        Plane, region, and orientation of the gripper.
    options
        Options of guidance.

    Raises
    ------
    InvalidInputError
        An invalid region, heights outside it, or an error of `selector`.

    Attributes
    ----------
    robot, guard, options
        The arguments, and the arm's guard.
    """

    def __init__(self, robot: Robot, table: RobotTable, options: GuidingOptions) -> None:
        self.robot, self.options = robot, options
        self._on_record: RecordCallback | None = None
        self.guard: Guard = guard_of(robot, table, options.guard, on_record=self._record)
        self._selector = None if options.selector is None else options.selector(self.guard)
        if options.carry is not None:
            check_heights(self.guard, options.carry)

    def _record(self, record: CommandRecord) -> None:
        if self._on_record is not None:
            self._on_record(record)

    @contextmanager
    def connected(
        self,
        *,
        on_record: RecordCallback | None = None,
        home: Callable[[Robot], None] | None = None,
        signals: Sequence[signal.Signals] = (),
    ) -> Iterator[None]:
        """Connect the arm, check its abilities, and watch it for the duration of the block.

        Parameters
        ----------
        on_record
            Called with every command.
        home
            Homes the arm before it is watched; None does not home it.
        signals
            Signals that halt the arm; in the main thread only.

        Raises
        ------
        RobotError
            As the arm, `Guard.check_limits` and `Guard.check_gripper`.
        """
        with self.robot:
            self.guard.check_limits()
            if self.options.carry is not None:
                self.guard.check_gripper(self.options.carry.grip)
            if home is not None:
                home(self.robot)
            self._on_record = on_record
            with self.guard.signals(*signals), self.guard.watching():
                yield

    def session(self, **how: Any) -> Session:
        """Return a session that guides the arm.

        Parameters
        ----------
        **how
            Arguments of `Session`, except those that the options determine.
        """
        follower = Follower(self.guard, self.options.follow)
        return Session(
            self.guard, follower, selector=self._selector, carry=self.options.carry, **how
        )


def guided(session: Session, steps: Iterator[Step]) -> Iterator[Step]:
    """Yield the steps of the views after the session has processed them, until it is done.

    Raises
    ------
    NotArmedError, RobotError
        As for `Session.take`.
    """
    for step in steps:
        session.take(step)
        yield step
        if session.done:
            return
