"""The robot demo: a hand points, a robot follows and carries a block, and a video is recorded.

With MuJoCo it is the complete closed loop: an arm with physics, driven through its emulated
controller's serial port; a plane defined by its own gripper; a block that friction lifts. Without
it, a simulated robot moves to the point indicated by the simulated rig's hand.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fingerpost.checks import make_folder
from fingerpost.closed_loop.engine import require_mujoco
from fingerpost.closed_loop.kinematic import KinematicCell
from fingerpost.closed_loop.layout import Aim, CameraPlacement
from fingerpost.closed_loop.loop import ClosedLoop, FixAccuracy, LoopOptions, Moment
from fingerpost.closed_loop.operator import Habits, Operator
from fingerpost.closed_loop.physics import BLOCK_MM, JAW_M, Optics, PhysicalCell
from fingerpost.closed_loop.setup import (
    exact_rig,
    plane_by_card,
    rig_without_plane,
    robot_table,
    scorbot_in,
    with_start,
)
from fingerpost.closed_loop.task import TASK_S, Leg, Task, block_and_place_mm
from fingerpost.closed_loop.world import Cell, World
from fingerpost.config import Rig
from fingerpost.errors import InvalidInputError, MissingExtraError
from fingerpost.recording import VideoWriter, write_picture, write_points, write_tracks
from fingerpost.recording.picture import Composition, RobotMarks
from fingerpost.robot import Robot, RobotError, SimulatedRobot
from fingerpost.robot.simulated import SimulatedOptions
from fingerpost.simulate import Hand

Array = NDArray[np.float64]
Report = Callable[[str], None]

FRAMES_PER_S = 15.0
WAITING_MM = (425.0, 0.0)
TURN_RAD = 0.2
"""Rotation of the block relative to the robot's axes."""

BESIDE_MM = (620.0, 300.0)
"""Position of the block while the gripper defines the plane."""

FILMED_EVERY = 2
"""Moments for each frame of the video."""

PLANE_M = 0.0
_TRAIL = 30  # earlier fixes and gripper positions that the plan shows
_GRIPPER_TRAIL = 75
_JAW_LENGTH_M = 0.02


@dataclass(frozen=True)
class RobotDemoSummary:
    """Result of a robot demo.

    Attributes
    ----------
    cell
        Name of the cell.
    note
        Missing component for the physics; empty if none.
    plane
        Summary of the plane's definition by the robot, line by line.
    legs
        The two targets, block and place.
    placed_mm
        Distance of the block from its place; None if it was not carried.
    problem
        Why it was not carried; empty if it was, or if `shortened`.
    shortened
        Whether `max_frames` ended it.
    table_steps
        Steps of the physics in which the arm touched the table; None without physics.
    line_bytes
        Bytes sent by the controller over its serial line, including echoes; None without a line.
    frames, fixes
        Frames with a hand, and those among them with an indicated point.
    false_fixes
        Frames with an indicated point but no hand.
    fix_rms_mm
        RMS distance from the indicated to the true point; None without a fix.
    time_s
        Duration of the task in the simulated world [s].
    files
        Written files.
    """

    cell: str
    note: str
    plane: tuple[str, ...]
    legs: tuple[Leg, ...]
    placed_mm: float | None
    problem: str
    shortened: bool
    table_steps: int | None
    line_bytes: int | None
    frames: int
    fixes: int
    false_fixes: int
    fix_rms_mm: float | None
    time_s: float
    files: tuple[str, ...]

    def lines(self) -> list[str]:
        """Return the summary as lines of text."""
        lines = [f"played    {self.cell}, {self.time_s:.0f} s"]
        lines += [f"plane     {line}" for line in self.plane]
        if self.fix_rms_mm is not None:
            lines.append(
                f"pointing  {self.fixes} of {self.frames} frames with a fix, "
                f"{self.fix_rms_mm:.1f} mm RMS from where the hand points"
            )
        for name, leg in zip(("block", "place"), self.legs, strict=False):
            closed = "not reached" if leg.closed_mm is None else f"{leg.closed_mm:.1f} mm"
            corrections = f"{leg.corrections} correction{'s' * (leg.corrections != 1)}"
            lines.append(
                f"{name:<9} gripper {leg.open_mm:.1f} mm off open loop, {closed} with feedback, "
                f"{corrections} in {leg.closed_s:.1f} s"
            )
        if self.placed_mm is not None:
            lines.append(f"placed    {self.placed_mm:.1f} mm from where it should be")
        if self.problem:
            lines.append(f"failed    {self.problem}")
        if self.shortened:
            lines.append("stopped   after as many frames as were asked for")
        if self.table_steps is not None:
            touched = f"touched in {self.table_steps} steps" if self.table_steps else "not touched"
            lines.append(f"table     {touched}; {self.line_bytes} bytes from the controller")
        lines += [f"written   {file}" for file in self.files]
        return [*lines, self.note] if self.note else lines

    def as_dict(self) -> dict[str, Any]:
        """Return the summary as JSON values; None for a figure that does not exist."""
        return dataclasses.asdict(self)


def run_robot_demo(
    output: str | Path,
    *,
    seed: int = 0,
    max_frames: int | None = None,
    report: Report = lambda _: None,
) -> RobotDemoSummary:
    """Run the robot demo, and write its results.

    The folder receives ``rig.toml`` with the plane defined by the robot, ``points.csv``,
    ``tracks.csv``, ``overlay.webm`` with both views and the plan, and ``summary.png``. Files of a
    previous run are overwritten.

    Parameters
    ----------
    output
        The folder; made if need be.
    seed
        Seed of all random numbers, ≥ 0.
    max_frames
        Number of frames, ≥ 1; None runs to the end.
    report
        Called with messages on the progress.

    Raises
    ------
    InvalidInputError
        The folder cannot be made or written into, or an argument is out of range.
    FingerpostError
        A file cannot be written any further.
    """
    if seed < 0:
        raise InvalidInputError(f"seed is {seed}; 0 or more is right")
    if max_frames is not None and max_frames < 1:
        raise InvalidInputError(f"max_frames is {max_frames}; 1 or more is right")
    folder = make_folder(Path(output))
    rng = np.random.default_rng(seed)
    block_mm, place_mm = block_and_place_mm(rng)
    with ExitStack() as stack:
        stage, note = stack.enter_context(staged(rng, block_mm, report))
        return _play(stack, stage, folder, block_mm, place_mm, rng, max_frames, report, note)


@contextmanager
def staged(
    rng: np.random.Generator, block_mm: Array, report: Report
) -> Iterator[tuple[Stage, str]]:
    """Yield a cell whose robot is ready, with physics if they are installed.

    Parameters
    ----------
    rng
        Random numbers.
    block_mm
        (2,) Position of the block.
    report
        Called with messages on the progress.

    Returns
    -------
    tuple
        The cell, and the missing component for the physics; empty if none.
    """
    note = _missing()
    with (_kinematic if note else _physical)(rng, block_mm, report) as stage:
        yield stage, note


def _missing() -> str:
    """Return the missing component for the physics; empty if none is."""
    try:
        require_mujoco()
    except MissingExtraError as error:
        return f"no physics: {error}"
    return ""


# --- the two stages ---------------------------------------------------------------------------


@dataclass(eq=False)
class Stage:
    """A cell whose robot is ready.

    Attributes
    ----------
    name
        Its name.
    cell, world, robot, rig
        The cell, its time, its homed robot, and the rig without start poses.
    plane
        Summary of the plane's definition by the robot, line by line.
    options
        Options of the product.
    in_views
        Whether the robot must be drawn into the pictures.
    line_bytes, table_steps
        Bytes of the serial line, and steps in which the arm touched the table; None without them.
    """

    name: str
    cell: Cell
    world: World
    robot: Robot
    rig: Rig
    plane: tuple[str, ...]
    options: LoopOptions
    in_views: bool
    line_bytes: Callable[[], int | None]
    table_steps: Callable[[], int | None]


@contextmanager
def _physical(rng: np.random.Generator, block_mm: Array, report: Report) -> Iterator[Stage]:
    cell = PhysicalCell(CameraPlacement().cameras(), Hand().body, rng=rng, optics=Optics())
    cell.put_block(BESIDE_MM, 0.0)
    world = World(cell, FRAMES_PER_S)
    try:
        with scorbot_in(cell, world) as line:
            plane = plane_by_card(
                cell,
                world,
                line.robot,
                PLANE_M,
                progress=lambda visit: report(f"the gripper visits the plane: {visit.place + 1}"),
            )
            cell.put_block(_pair(block_mm), TURN_RAD)
            yield Stage(
                "MuJoCo: a Scorbot driven through its controller's serial port",
                cell,
                world,
                line.robot,
                plane.rig(rig_without_plane(cell.cameras), robot_table(PLANE_M)),
                tuple(plane.lines()),
                LoopOptions(),
                in_views=False,
                line_bytes=lambda: line.answered_bytes,
                table_steps=lambda: cell.contacts.table_steps,
            )
    finally:
        cell.close()


@contextmanager
def _kinematic(rng: np.random.Generator, block_mm: Array, _report: Report) -> Iterator[Stage]:
    robot = SimulatedRobot(
        SimulatedOptions(homing_s=0.5),
        clock=lambda: world.time_s,
        sleep=lambda span_s: world.advance(span_s),
    )
    cell = KinematicCell(CameraPlacement().cameras(), Hand(), robot, rng=rng)
    cell.put_block(_pair(block_mm), TURN_RAD)
    world = World(cell, FRAMES_PER_S)
    with robot:
        robot.home()
        yield Stage(
            "a simulated robot without physics",
            cell,
            world,
            robot,
            exact_rig(cell.cameras, PLANE_M),
            (),
            LoopOptions(),
            in_views=True,
            line_bytes=lambda: None,
            table_steps=lambda: None,
        )


# --- results ----------------------------------------------------------------------------------


def _play(
    stack: ExitStack,
    stage: Stage,
    folder: Path,
    block_mm: Array,
    place_mm: Array,
    rng: np.random.Generator,
    max_frames: int | None,
    report: Report,
    note: str,
) -> RobotDemoSummary:
    waiting = Aim(WAITING_MM, plane_mm=1000 * PLANE_M)
    hand = Hand().body
    rig = with_start(stage.rig, stage.cell.cameras, hand, waiting.pose(), rng)
    files = [
        folder / name
        for name in ("rig.toml", "points.csv", "tracks.csv", "overlay.webm", "summary.png")
    ]
    rig.save(files[0])
    operator = Operator(Habits(), WAITING_MM, rng, time_s=stage.world.time_s)
    loop = ClosedLoop(stage.world, stage.robot, rig, operator, stage.options, aim=waiting)
    accuracy = FixAccuracy()
    film = _Film(stack, files, stage, loop, place_mm)
    begin_s = stage.world.time_s

    def on_moment(moment: Moment) -> None:
        accuracy.add(moment)
        film.add(moment)
        report(f"{moment.time_s - begin_s:6.1f} s  {moment.doing}")
        if film.frames == max_frames:
            raise _EnoughError

    loop.on_moment = on_moment
    task = Task(stage.world, loop, operator, block_mm, place_mm)
    shortened = False
    try:
        loop.run(task, TASK_S)
    except RobotError as error:
        task.problem = f"{type(error).__name__}: {error}"
    except _EnoughError:
        shortened = True
    film.picture()
    return RobotDemoSummary(
        cell=stage.name,
        note=note,
        plane=stage.plane,
        legs=tuple(task.legs),
        placed_mm=task.placed_mm,
        problem=task.problem,
        shortened=shortened,
        table_steps=stage.table_steps(),
        line_bytes=stage.line_bytes(),
        frames=accuracy.moments,
        fixes=accuracy.fixes,
        false_fixes=accuracy.false_fixes,
        fix_rms_mm=accuracy.rms_mm,
        time_s=stage.world.time_s - begin_s,
        files=tuple(str(file) for file in files),
    )


class _EnoughError(Exception):
    """Ends the demo early."""


class _Film:
    """Records tables of every moment, a video, and a picture of the selection of the block."""

    def __init__(
        self, stack: ExitStack, files: list[Path], stage: Stage, loop: ClosedLoop, place_mm: Array
    ) -> None:
        self._points = stack.enter_context(write_points(files[1]))
        self._tracks = stack.enter_context(write_tracks(files[2]))
        fps = FRAMES_PER_S / FILMED_EVERY
        self._video = stack.enter_context(VideoWriter(files[3], fps=fps))
        self._summary = files[4]
        self._composition = Composition(loop.plane_views, unit="m")
        self._stage = stage
        self._place_m = place_mm / 1000
        self._indicated: list[Array] = []
        self._gripper: list[Array] = []
        self._best: NDArray[np.uint8] | None = None
        self.frames = 0

    def add(self, moment: Moment) -> None:
        """Record a moment."""
        self.frames += 1
        step = moment.step
        self._points.write(step.point_row())
        for observation in step.observations:
            if (row := observation.track_row()) is not None:
                self._tracks.write(row)
        if step.fix.point is not None:
            self._indicated.append(step.fix.point)
        self._gripper.append(moment.gripper_m[:2])
        if (self.frames - 1) % FILMED_EVERY:
            return
        image = self._composition.draw(
            step.observations,
            step.fix,
            truth=moment.indicated_m,
            trail=self._indicated[-_TRAIL:],
            robot=self._marks(moment),
        )
        self._video.write(image)
        has_feedback = moment.doing == "with feedback" and step.fix.point is not None
        if self._best is None or has_feedback:
            self._best = image

    def picture(self) -> None:
        """Write the last moment with feedback as the picture of the summary."""
        if self._best is None:
            return
        write_picture(self._summary, self._best)

    def _marks(self, moment: Moment) -> RobotMarks:
        x, y = moment.gripper_m[:2]
        turn = self._stage.cell.block_turn_rad
        half = BLOCK_MM / 2000
        square = np.array([[-half, -half], [half, -half], [half, half], [-half, half]])
        rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        return RobotMarks(
            gripper=np.array([x, y]),
            jaw_width=2 * JAW_M * moment.jaw,
            # With zero roll the jaws close perpendicular to the arm's direction.
            jaw_angle_rad=float(np.arctan2(y, x)) + np.pi / 2,
            jaw_length=_JAW_LENGTH_M,
            trail=self._gripper[-_GRIPPER_TRAIL:],
            block=moment.block_m[:2] + square @ rotation.T,
            place=self._place_m,
            words=moment.doing,
            in_views=self._stage.in_views,
        )


def _pair(point: Array) -> tuple[float, float]:
    return float(point[0]), float(point[1])
