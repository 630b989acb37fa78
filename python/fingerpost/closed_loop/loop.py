"""The whole product on a cell's pixels: pictures → fixes → guard → robot, and the operator's eyes.

Whatever a real set-up runs side by side happens here on the beat of the cameras, in between the
bytes that the driver exchanges with its controller: the pointer takes every picture, the guard sees
every fix and may stop the arm, and the operator sees the gripper and moves his hand.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray

from fingerpost.capture import Frame
from fingerpost.closed_loop.layout import Aim, indicated_mm
from fingerpost.closed_loop.operator import Operator
from fingerpost.closed_loop.world import World
from fingerpost.config import Rig
from fingerpost.guidance import guard_of, robot_of
from fingerpost.pipeline import Pointer, Step
from fingerpost.pointing import Fix, PlaneView, Status
from fingerpost.robot import (
    DwellSelector,
    Follower,
    FollowOptions,
    FollowReport,
    Guard,
    GuardOptions,
    PickPlace,
    PickPlaceOptions,
    Robot,
    Selection,
)
from fingerpost.robot import Step as PickStep
from fingerpost.simulate import DevicePose

Array = NDArray[np.float64]

ASIDE_M = (0.0, 1.0)
"""Towards where the arm makes room; the nearest corner of the safe region is taken [m]."""

LOST_S = 2.0
"""A hand without a fix for so long is not about to be found where it is [s]."""

AWAY_MM = 700.0
"""A hand drawn back so far along its finger is out of every view [mm]."""

AWAY_SPEED_MM_S = 700.0
"""How fast it goes there, and comes [mm/s]."""


class LoopOptions(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How the product is run in a cell.

    Attributes
    ----------
    guard, follow, pick_place
        The product's own options.
    dwell_s, dwell_m : float
        The hand selects where it stays for so long [s], within so much [m], while the arm is there.
    """

    guard: GuardOptions = GuardOptions(
        # The open gripper takes a block that stands within 20 mm of its middle; feedback does the
        # rest.
        tolerance_m=0.02,
    )
    follow: FollowOptions = FollowOptions(above_m=0.06, stride_s=0.8, dead_band_m=0.002)
    pick_place: PickPlaceOptions = PickPlaceOptions()
    dwell_s: Annotated[float, msgspec.Meta(gt=0)] = 2.5
    dwell_m: Annotated[float, msgspec.Meta(gt=0)] = 0.006


@dataclass(frozen=True, eq=False, slots=True)
class Moment:
    """One frame of a session.

    Attributes
    ----------
    time_s
        Of the world [s].
    step
        What the views saw and where the hand points.
    pose
        Where the hand really is; None while it is away.
    indicated_m : (2,) or None
        Where it really points, in the robot's X, Y [m].
    gripper_m : (3,)
        Where the gripper really is [m].
    jaw
        How far it is open: 0 closed … 1 open.
    block_m : (3,)
        Where the block really is [m].
    doing
        What is being done, in a word or two.
    """

    time_s: float
    step: Step
    pose: DevicePose | None
    indicated_m: Array | None
    gripper_m: Array
    jaw: float
    block_m: Array
    doing: str


class FixAccuracy:
    """How far fixes are from where the hand really points.

    Attributes
    ----------
    moments, fixes : int
        Frames in which the hand was there, and those with an indicated point.
    """

    def __init__(self) -> None:
        self.moments = 0
        self.fixes = 0
        self._sum_mm2 = 0.0

    def add(self, moment: Moment) -> None:
        """Count a frame."""
        if moment.indicated_m is None:
            return
        self.moments += 1
        if moment.step.fix.point is not None:
            self.fixes += 1
            self._sum_mm2 += 1e6 * float(((moment.step.fix.point - moment.indicated_m) ** 2).sum())

    @property
    def rms_mm(self) -> float | None:
        """Of the distance [mm]; None without a fix."""
        return math.sqrt(self._sum_mm2 / self.fixes) if self.fixes else None


class ClosedLoop:
    """One operator, one robot, one rig.

    Parameters
    ----------
    world
        With its cell.
    robot
        Homed.
    rig
        With a [robot] table and start poses.
    operator
        Whose hand it is.
    options
        How the product is run.
    aim
        How the hand is held; its point and plane do not count.
    at_once
        Whether the hand is there from the beginning, or comes in.
    on_moment
        Called with every frame.

    Attributes
    ----------
    guard
        The robot's guard; to be armed.
    doing
        What is being done, in a word or two, for `Moment`.
    looking
        Whether the cameras take pictures; without them there are no fixes.
    fix
        The newest; None before the first.
    on_moment
        Called with every frame.
    """

    def __init__(
        self,
        world: World,
        robot: Robot,
        rig: Rig,
        operator: Operator,
        options: LoopOptions | None = None,
        *,
        aim: Aim | None = None,
        at_once: bool = True,
        on_moment: Callable[[Moment], None] = lambda _: None,
    ) -> None:
        self.options = options = options or LoopOptions()
        table = robot_of(rig)
        self.guard: Guard = guard_of(robot, table, options.guard, clock=world.now)
        self.doing = "waiting"
        self.looking = True
        self._world = world
        self._plane_mm = 1000 * table.height_m
        self._pointer = Pointer(rig, moving=self.guard.body)
        self._operator = operator
        self.on_moment = on_moment
        self._aim = aim or Aim((0.0, 0.0))
        self._index = 0
        self._entered = False
        self._seen_s = world.time_s
        self._withdrawn = False
        self._away_mm = 0.0 if at_once else AWAY_MM
        self.fix: Fix | None = None
        world.on_frame = self._on_frame

    @property
    def plane_views(self) -> tuple[PlaneView, ...]:
        """How each view sees the plane."""
        return self._pointer.plane_views

    @property
    def gripper_m(self) -> Array:
        """(2,) the robot's X, Y where the gripper really is [m]."""
        return np.asarray(self._world.cell.gripper_mm[:2] / 1000)

    @property
    def hand_lost(self) -> bool:
        """Whether there has been no fix for `LOST_S`: the arm may be in the way."""
        return self._world.time_s - self._seen_s > LOST_S

    def go_aside(self) -> None:
        """Have the arm wait where it hides nothing from the cameras: beside and behind the hand.

        Raises
        ------
        RobotError
            The robot's own; it has been stopped.
        """
        if not self.guard.armed:
            self.guard.arm()
        if not self._entered:
            self.guard.enter()
            self._entered = True
        self.guard.make_way(ASIDE_M, speed_m_s=self.options.guard.max_speed_m_s)
        self.fix = None  # the hand may have been hidden

    def wait_for_fix(self, timeout_s: float) -> bool:
        """Let time pass until the hand is tracked in every view; False if it is not in time."""
        end_s = self._world.time_s + timeout_s
        while self._world.time_s < end_s:
            self._world.to_next_frame()
            if self.fix is not None and self.fix.status is Status.OK:
                return True
        return False

    def follow(self, until: Callable[[Fix, FollowReport], bool], timeout_s: float) -> bool:
        """Have the robot follow the hand.

        Parameters
        ----------
        until
            Ends it; called after every decision of the follower.
        timeout_s
            Ends it as well, and so does a hand that stays lost (`hand_lost`).

        Returns
        -------
        bool
            Whether `until` ended it.

        Raises
        ------
        RobotError
            The robot's own; it has been stopped.
        """
        follower = Follower(self.guard, self.options.follow)
        self._seen_s = self._world.time_s
        end_s = self._world.time_s + timeout_s
        while self._world.time_s < end_s and not self.hand_lost:
            before_s = self._world.time_s
            fix = self.fix
            if fix is not None:
                report = follower.update(fix)
                if until(fix, report):
                    return True
            if self._world.time_s - before_s < self._world.frame_s:
                self._world.to_next_frame()
        return False

    def select(self, timeout_s: float) -> Selection | None:
        """Follow until the hand has selected a point by staying; None if not in time, or if lost.

        A point outside the safe region is none.
        """
        selection: Selection | None = None
        selector = DwellSelector(
            self.guard, dwell_s=self.options.dwell_s, radius_m=self.options.dwell_m
        )

        def selected(fix: Fix, report: FollowReport) -> bool:
            nonlocal selection
            selection = selector.update(self.fix or fix, report)
            if selection is not None and not self._within_reach(selection):
                selection = None
            return selection is not None

        self.follow(selected, timeout_s)
        return selection

    def pick_and_place(
        self,
        pick: Selection,
        place: Selection,
        on_step: Callable[[PickStep], None] = lambda _: None,
    ) -> None:
        """Carry the block.

        Raises
        ------
        RobotError
            The robot's own; it has been stopped.
        """
        carrying = PickPlace(self.guard, pick, place, self.options.pick_place)
        while (step := carrying.next_step) is not None:
            self.doing = step.value
            on_step(step)
            carrying.advance()

    def withdraw(self) -> None:
        """Have the operator take his hand away."""
        self._withdrawn = True

    def close(self) -> None:
        """Stop the arm and look no more."""
        self._world.on_frame = None
        if self.guard.armed:
            self.guard.halt("the end")

    def _within_reach(self, selection: Selection) -> bool:
        low_m = self.options.pick_place.grip_m
        allowed, allowed_m = self.guard.clamp(selection.point, low_m)
        return bool((allowed == selection.point).all()) and allowed_m == low_m

    def _on_frame(self, time_s: float) -> None:
        """Do what happens on every beat: hand, picture, fix, guard, eyes."""
        self.guard.heartbeat()
        if not self.looking:
            self.guard.check()
            return
        cell = self._world.cell
        pose = self._hand(time_s)
        cell.put_hand(pose)
        frames = [Frame(self._index, time_s, image) for image in cell.picture()]
        self._index += 1
        for step in self._pointer.update(frames):
            self.fix = step.fix
            if step.fix.status is Status.OK:
                self._seen_s = time_s
            self.guard.observe(step.fix)
            self._tell(step, pose, time_s)
        self.guard.check()
        self._operator.see(cell.gripper_mm[:2], time_s)

    def _hand(self, time_s: float) -> DevicePose | None:
        """Return where the hand is, on its way in or out as well."""
        step_mm = AWAY_SPEED_MM_S * self._world.frame_s
        goal_mm = AWAY_MM if self._withdrawn else 0.0
        way_mm = goal_mm - self._away_mm
        self._away_mm += min(max(way_mm, -step_mm), step_mm)
        if self._away_mm == AWAY_MM:
            return None
        x, y = self._operator.indicated_mm(time_s)
        aim = replace(self._aim, point_mm=(float(x), float(y)), plane_mm=self._plane_mm)
        return aim.pose().retreated(self._away_mm)

    def _tell(self, step: Step, pose: DevicePose | None, time_s: float) -> None:
        cell = self._world.cell
        indicated = None if pose is None else indicated_mm(pose, self._plane_mm)
        self.on_moment(
            Moment(
                time_s,
                step,
                pose,
                None if indicated is None else indicated / 1000,
                cell.gripper_mm / 1000,
                cell.jaw,
                cell.block_mm / 1000,
                self.doing,
            )
        )
