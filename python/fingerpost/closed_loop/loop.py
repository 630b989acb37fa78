"""The whole product on a cell's pixels: pictures → fixes → session → robot → the operator's eyes.

A real set-up uses threads; here everything runs at the frames of the cameras, between the bytes
that the driver exchanges with its controller: a person presses keys and moves a hand, the pointer
processes every picture, and the same `Session` as for a real arm processes every step.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated, Protocol

import msgspec
import numpy as np
from numpy.typing import NDArray

from fingerpost.capture import Frame
from fingerpost.closed_loop.layout import Aim, indicated_mm
from fingerpost.closed_loop.operator import Operator
from fingerpost.closed_loop.world import World
from fingerpost.config import Rig
from fingerpost.guidance import Activity, Attendance, Session, Turns, guard_of, robot_of
from fingerpost.pipeline import Pointer, Step
from fingerpost.pointing import Fix, PlaneView
from fingerpost.robot import (
    DwellSelector,
    Follower,
    FollowOptions,
    FollowReport,
    FollowState,
    Guard,
    GuardOptions,
    PickPlaceOptions,
    Robot,
)
from fingerpost.simulate import DevicePose

Array = NDArray[np.float64]

AWAY_MM = 700.0
"""Distance by which a hand is withdrawn along its finger so that it is in no view [mm]."""

_ENDLESS = 2**31 - 1

AWAY_SPEED_MM_S = 700.0
"""Speed of withdrawal and return [mm/s]."""


class LoopOptions(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the product in a cell.

    Attributes
    ----------
    guard, follow, pick_place
        The product's own options.
    dwell_s, dwell_m : float
        Time [s] and radius [m] of a selection by dwelling, while the arm is there.
    """

    guard: GuardOptions = GuardOptions(
        # The open gripper can grip a block within 20 mm of its middle; feedback does the rest.
        tolerance_m=0.02,
    )
    # The hand is below the gripper, and passes under it.
    follow: FollowOptions = FollowOptions(above_m=0.15, stride_s=0.8, dead_band_m=0.002)
    pick_place: PickPlaceOptions = PickPlaceOptions()
    dwell_s: Annotated[float, msgspec.Meta(gt=0)] = 2.5
    dwell_m: Annotated[float, msgspec.Meta(gt=0)] = 0.006


@dataclass(frozen=True, eq=False, slots=True)
class Moment:
    """One frame of a session.

    Attributes
    ----------
    time_s
        Time of the world [s].
    step
        Results of the views, and the fix.
    pose
        True pose of the hand; None while it is away.
    indicated_m : (2,) or None
        True indicated point, in the robot's X, Y [m].
    gripper_m : (3,)
        True position of the gripper [m].
    jaw
        Its opening: 0 closed … 1 open.
    block_m : (3,)
        True position of the block [m].
    doing
        Present activity, in a word or two.
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
    """Distance of fixes from the true indicated points.

    Attributes
    ----------
    moments, fixes : int
        Frames with a hand, and those among them with an indicated point.
    false_fixes : int
        Frames with an indicated point but no hand.
    """

    def __init__(self) -> None:
        self.moments = 0
        self.fixes = 0
        self.false_fixes = 0
        self._sum_mm2 = 0.0

    def add(self, moment: Moment) -> None:
        """Count a frame."""
        point = moment.step.fix.point
        if moment.indicated_m is None:
            self.false_fixes += point is not None
            return
        self.moments += 1
        if point is not None:
            self.fixes += 1
            self._sum_mm2 += 1e6 * float(((point - moment.indicated_m) ** 2).sum())

    @property
    def rms_mm(self) -> float | None:
        """RMS of the distance [mm]; None without a fix."""
        return math.sqrt(self._sum_mm2 / self.fixes) if self.fixes else None


class Person(Protocol):
    """The operator of the cell: presses keys, and may show a hand."""

    @property
    def done(self) -> bool:
        """Whether the person has finished."""

    @property
    def hand_is_away(self) -> bool:
        """Whether the hand is to be outside the views."""

    @property
    def doing(self) -> str:
        """Present activity, in a word or two."""

    def act(self, time_s: float) -> None:
        """Act at one frame."""


class CellViews:
    """The cameras of a cell, the hand in their views, and the pointer that processes the pictures.

    Parameters
    ----------
    world
        The world, with its cell.
    pointer
        Pointer of the cell's rig.
    operator
        Owner of the hand.
    aim
        Pose of the hand; its point is not used.

    Attributes
    ----------
    fix
        The newest fix; None before the first.
    away_mm
        Distance by which the hand is withdrawn; it tends to `AWAY_MM` while `is_away`, else to 0.
    is_away
        Whether the hand is to be outside the views.
    """

    def __init__(self, world: World, pointer: Pointer, operator: Operator, aim: Aim) -> None:
        self.fix: Fix | None = None
        self.is_away = False
        self.away_mm = AWAY_MM
        self._world = world
        self._pointer = pointer
        self._operator = operator
        self._aim = aim
        self._index = 0

    def vanish(self) -> None:
        """Remove the hand from the views from the next frame on."""
        self.is_away, self.away_mm = True, AWAY_MM

    def take(self, time_s: float) -> tuple[DevicePose | None, list[Step]]:
        """Move the hand and take a picture with every camera; return the hand and the steps."""
        pose = self._hand(time_s)
        self._world.cell.put_hand(pose)
        images = self._world.cell.picture()
        steps = list(self._pointer.update([Frame(self._index, time_s, image) for image in images]))
        self._index += 1
        if steps:
            self.fix = steps[-1].fix
        return pose, steps

    def _hand(self, time_s: float) -> DevicePose | None:
        """Return the pose of the hand, also while it enters or leaves."""
        step_mm = AWAY_SPEED_MM_S * self._world.frame_s
        way_mm = (AWAY_MM if self.is_away else 0.0) - self.away_mm
        self.away_mm += min(max(way_mm, -step_mm), step_mm)
        if self.away_mm == AWAY_MM:
            return None
        x, y = self._operator.indicated_mm(time_s)
        return replace(self._aim, point_mm=(float(x), float(y))).pose().retreated(self.away_mm)


class ClosedLoop:
    """One operator, one robot, one rig.

    Parameters
    ----------
    world
        The world, with its cell.
    robot
        The robot, homed.
    rig
        The rig, with a [robot] table and start poses.
    operator
        Owner of the hand.
    options
        Options of the product.
    aim
        Pose of the hand; its point and plane are not used.
    on_moment
        Called with every frame.
    stands_by
        Whether the arm waits for a command of the session, which no number of blocks ends.

    Attributes
    ----------
    guard, session
        Those of the product.
    views
        Cameras and hand.
    report
        Last report of the follower; None while it is inactive.
    usable_s
        Time of the last fix that permits motion [s].
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
        on_moment: Callable[[Moment], None] = lambda _: None,
        stands_by: bool = False,
    ) -> None:
        options = options or LoopOptions()
        table = robot_of(rig)
        self.guard: Guard = guard_of(robot, table, options.guard, clock=world.now)
        self._turns = Turns()
        self.session = Session(
            self.guard,
            Follower(self.guard, options.follow),
            attendance=Attendance.KEY,
            selector=DwellSelector(self.guard, dwell_s=options.dwell_s, radius_m=options.dwell_m),
            carry=options.pick_place,
            keys=True,
            key_help="",
            blocks=_ENDLESS if stands_by else 1,
            home=robot.home if stands_by else None,
            activity=Activity.STAY if stands_by else Activity.CARRY,
            worker=self._turns,
            sleep=world.advance,
            say=self._keep_words,
            on_report=self._see_report,
        )
        self._plane_mm = 1000 * table.height_m
        aim = replace(aim or Aim((0.0, 0.0)), plane_mm=self._plane_mm)
        self._pointer = Pointer(rig, moving=self.guard.body)
        self.views = CellViews(world, self._pointer, operator, aim)
        self.report: FollowReport | None = None
        self.usable_s = world.time_s
        self.on_moment = on_moment
        self._world = world
        self._operator = operator
        self._begun = self._stands_by = stands_by
        self._said = ""

    @property
    def said(self) -> str:
        """Last message of the session."""
        return self._said

    @property
    def plane_views(self) -> tuple[PlaneView, ...]:
        """Homography of each view."""
        return self._pointer.plane_views

    @property
    def gripper_m(self) -> Array:
        """(3,) True position of the gripper in the robot's frame [m]."""
        return np.asarray(self._world.cell.gripper_mm / 1000)

    @property
    def is_there(self) -> bool:
        """Whether the arm stands at the indicated point."""
        return self.report is not None and self.report.state is FollowState.THERE

    def run(self, person: Person, timeout_s: float) -> None:
        """Let a person guide the arm until the session or the person is done, or time is up.

        Raises
        ------
        RobotError
            An error of the robot, which has been stopped.
        """
        self._world.on_frame = lambda time_s: self._on_frame(time_s, person)
        end_s = self._world.time_s + timeout_s
        try:
            with self.session as session:
                if not self._stands_by:
                    session.begin()
                self._begun = True
                while not (session.done or person.done) and self._world.time_s < end_s:
                    if not self._turns.run():
                        self._world.to_next_frame()
        finally:
            self._world.on_frame = None

    def _keep_words(self, words: str) -> None:
        self._said = words

    def _see_report(self, _: Fix, report: FollowReport) -> None:
        self.report = report

    def _on_frame(self, time_s: float, person: Person) -> None:
        """Process one frame: keys, hand, pictures, session, guard, eyes."""
        person.act(time_s)
        if self._begun:
            self.views.is_away = person.hand_is_away
            pose, steps = self.views.take(time_s)
            for step in steps:
                self.session.take(step)
                fix = self.guard.newest_fix
                if fix is not None and not self.guard.doubt(fix):
                    self.usable_s = time_s
                doing = person.doing
                if self.session.is_carrying:
                    doing = self._said.removesuffix(" ...")
                self._record(step, pose, time_s, doing)
        self.guard.check()
        # Only an arm that stands where the system believes the hand to point shows an error of it.
        self._operator.see(self._world.cell.gripper_mm[:2], time_s, is_there=self.is_there)

    def _record(self, step: Step, pose: DevicePose | None, time_s: float, doing: str) -> None:
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
                doing,
            )
        )
