"""Set-up of a cell: the robot homed, the plane defined by its own gripper, the rig complete.

The same steps as with a real arm: connect it, home it, put a card with a marker into the gripper,
let the gripper visit the plane, and mark the start pose of the hand in the pictures.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import count

import msgspec
import numpy as np

from fingerpost.capture import Frame
from fingerpost.closed_loop.layout import WORKSPACE_MM
from fingerpost.closed_loop.line import LineToScorbot
from fingerpost.closed_loop.physics import PhysicalCell
from fingerpost.closed_loop.scene import CARD_MARKER_MM, CARD_MARKER_UP_MM, SPIKE_MM
from fingerpost.closed_loop.world import World
from fingerpost.config import Pair, Plane, Rig, RobotTable, Start, View
from fingerpost.guidance import (
    MarkerFinder,
    PlaneByRobot,
    PlaneOptions,
    Visit,
    define_plane,
    guard_of,
)
from fingerpost.robot import GuardOptions, Robot
from fingerpost.robot.scorbot import ScorbotOptions
from fingerpost.simulate import Body, Camera, DevicePose, StartError
from fingerpost.simulate.truth import finger_truth

HIGHEST_M = 0.16
"""Greatest height of the gripper above the table [m]."""

LOWEST_M = 0.0105
"""Least height of its working point [m]: the fingers reach 10 mm below it."""

SCORBOT = ScorbotOptions(lower_m=(-0.6, -0.6, 0.01), upper_m=(0.6, 0.6, 1.05))
"""The arm in this cell: its fingers never reach into the table."""

MARKER_SIGMA_PX = 0.15
"""Standard deviation of a corner of the card's marker [px]; a printed card is less flat."""

START_ERROR = StartError(offset_px=5.0, angle_deg=5.0)
"""Error of a person who marks the start pose."""

# A rig requires a plane; the robot defines the real one.
_UNDEFINED: tuple[Pair, ...] = ((0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0))


@contextmanager
def scorbot_in(
    cell: PhysicalCell, world: World, options: ScorbotOptions = SCORBOT
) -> Iterator[LineToScorbot]:
    """Connect the cell's controller; connect and home its driver."""
    with LineToScorbot(cell.controller, world.now, world.advance, options) as line:
        yield line


def robot_table(height_m: float) -> RobotTable:
    """Return the [robot] table of the cell's robot, for a plane of this height [m]."""
    return RobotTable(
        url="acl://the-cell",
        height_m=height_m,
        region_m=_pairs(WORKSPACE_MM / 1000),
        z_m=(LOWEST_M, height_m + HIGHEST_M),
        pitch_deg=-90.0,
        roll_deg=0.0,
    )


def plane_by_card(
    cell: PhysicalCell,
    world: World,
    robot: Robot,
    height_m: float,
    *,
    points: int = 9,
    progress: Callable[[Visit], None] = lambda _: None,
) -> PlaneByRobot:
    """Define a plane by the card in the gripper: section 3.4 of the paper.

    Parameters
    ----------
    cell, world, robot
        The cell, its time, and its homed robot.
    height_m
        The plane's height above the table [m], 0 to 0.06.
    points
        Number of places to visit.
    progress
        Called with every visit.
    """
    frames = _reader(cell, world)
    side = (CARD_MARKER_UP_MM + SPIKE_MM) / CARD_MARKER_MM
    finders = [MarkerFinder(0, tip=(0.0, side), sigma_px=MARKER_SIGMA_PX) for _ in cell.cameras]
    # No dead-man's switch while the gripper moves by itself in a simulation.
    guard = guard_of(
        robot,
        robot_table(height_m),
        GuardOptions(operator_timeout_s=1e6),
        clock=world.now,
    )
    cell.shows_card = True
    try:
        with guard:
            guard.arm()
            return define_plane(
                guard,
                rig_without_plane(cell.cameras),
                frames,
                finders,
                PlaneOptions(
                    points=points, offset_m=(0.0, 0.0, -SPIKE_MM / 1000), settle_s=0.15, frames=4
                ),
                progress=progress,
            )
    finally:
        cell.shows_card = False


def rig_without_plane(cameras: Sequence[Camera]) -> Rig:
    """Return the rig of cameras before a plane is defined."""
    views = tuple(
        View(name=camera.name, source=camera.name, reference_points_px=_UNDEFINED)
        for camera in cameras
    )
    return Rig(plane=Plane(unit="undefined", points=_UNDEFINED), views=views)


def exact_rig(cameras: Sequence[Camera], height_m: float) -> Rig:
    """Return the rig of a plane that is known exactly, in the robot's X and Y [m]."""
    corners = np.column_stack([WORKSPACE_MM, np.full(len(WORKSPACE_MM), 1000 * height_m)])
    views = tuple(
        View(
            name=camera.name,
            source=camera.name,
            reference_points_px=_pairs(camera.project(corners)),
        )
        for camera in cameras
    )
    plane = Plane(unit="m", points=_pairs(WORKSPACE_MM / 1000))
    return Rig(plane=plane, views=views, robot=robot_table(height_m))


def with_start(
    rig: Rig,
    cameras: Sequence[Camera],
    hand: Body,
    waiting: DevicePose,
    rng: np.random.Generator,
) -> Rig:
    """Return a rig with start poses, as a person would mark them."""
    views = []
    for view, camera in zip(rig.views, cameras, strict=True):
        start = finger_truth(camera, hand, waiting).start(START_ERROR, rng)
        views.append(msgspec.structs.replace(view, start=Start(**dataclasses.asdict(start))))
    return msgspec.structs.replace(rig, views=tuple(views))


def _reader(cell: PhysicalCell, world: World) -> Callable[[], Sequence[Frame]]:
    """Return a function that advances to the next frame and takes a picture with every camera."""
    numbers = count()

    def read() -> Sequence[Frame]:
        world.to_next_frame()
        index = next(numbers)
        return [Frame(index, world.time_s, image) for image in cell.picture()]

    return read


def _pairs(points: np.ndarray) -> tuple[Pair, ...]:
    return tuple((float(x), float(y)) for x, y in points)
