r"""The guidance experiment of the paper's section 3.4, repeated, and the accuracy of its plane.

    result = run_guidance(50)
    print("\n".join(result.table()))

The robot defines the plane by visiting it, once. In each trial an operator points at a wooden block
at a random position and then at its destination: first open loop, with an offset, then with
corrections by the gripper's position, until the error is small and the hand is held still. Then the
robot carries the block. Every error is measured against the true state of the physics.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from concurrent.futures import Future, as_completed
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fingerpost.closed_loop.engine import require_mujoco
from fingerpost.closed_loop.layout import Aim, CameraPlacement
from fingerpost.closed_loop.loop import CellViews, ClosedLoop, FixAccuracy, LoopOptions
from fingerpost.closed_loop.operator import Habits, Operator
from fingerpost.closed_loop.physics import Optics, PhysicalCell
from fingerpost.closed_loop.setup import (
    plane_by_card,
    rig_without_plane,
    robot_table,
    scorbot_in,
    with_start,
)
from fingerpost.closed_loop.task import (
    SETTLED_S,
    TASK_S,
    Absence,
    Leg,
    Scripted,
    Task,
    Vanishing,
    block_and_place_mm,
    target_mm,
)
from fingerpost.closed_loop.world import World
from fingerpost.config import Rig
from fingerpost.errors import InvalidInputError
from fingerpost.guidance import robot_of
from fingerpost.pipeline import Pointer
from fingerpost.robot import RobotError
from fingerpost.simulate import Hand
from fingerpost.workers import sharing, worker_count

Array = NDArray[np.float64]
Progress = Callable[[int, int], None]
"""Called with the number of completed trials and of all."""

WITHIN_MM = 10.0
"""The paper: the operator positions the gripper "to within 1cm"."""

GOAL_MM = 5.0

WAITING_MM = (425.0, 0.0)
"""Point indicated by the hand while it waits."""

SHOWN_S = 3.0
"""Time for which it waits there to be accepted [s]."""

MOST_TURNED_RAD = 0.25
"""Greatest rotation of a block relative to the robot: parallel jaws align it when they close."""


@dataclass(frozen=True)
class GuidanceOptions:
    """Options of the experiment."""

    seed: int = 0
    """Seed of all random numbers, ≥ 0."""

    frames_per_s: float = 20.0
    """Frame rate of the cameras [1/s]; rendering is most of the work."""

    heights_mm: tuple[float, ...] = (0.0, 50.0)
    """Heights of the planes whose accuracy is measured; the first one is used for guidance."""

    points: int = 9
    """Number of places that the gripper visits to define a plane."""

    plane_targets: int = 40
    """Number of targets per plane at which the hand points exactly."""

    habits: Habits = field(default_factory=Habits)
    optics: Optics = field(default_factory=Optics)
    cameras: CameraPlacement = field(default_factory=CameraPlacement)
    loop: LoopOptions = field(default_factory=LoopOptions)

    def __post_init__(self) -> None:
        if self.seed < 0:
            raise InvalidInputError(f"seed is {self.seed}; 0 or more is right")
        if not self.heights_mm:
            raise InvalidInputError("heights_mm is empty; at least one plane is needed")


@dataclass(frozen=True)
class GuidanceTrial:
    """Result of one trial: a block picked and placed, or the reason of a failure."""

    index: int
    legs: tuple[Leg, ...]
    placed_mm: float | None  # from the block to where it should be; None: not carried
    table_steps: int  # steps of the physics in which the arm touched the table
    fix_rms_mm: float | None  # of the distance from the indicated to the true point
    frames: int
    fixes: int
    problem: str = ""
    false_fixes: int = 0  # frames with an indicated point but no hand


@dataclass(frozen=True)
class PlaneAccuracy:
    """Accuracy of indicated points in robot coordinates, with a plane defined by the robot."""

    height_mm: float
    sigma_mm: float  # standard deviation of its worst corner according to `define_plane`
    errors_mm: tuple[tuple[float, float], ...]  # robot's X, Y, estimated minus true
    missing: int  # targets without a fix

    @property
    def rms_mm(self) -> float:
        """RMS of the distance from estimate to truth; NaN without any."""
        if not self.errors_mm:
            return math.nan
        return float(np.sqrt((np.array(self.errors_mm) ** 2).sum(axis=1).mean()))


@dataclass(frozen=True)
class GuidanceResult:
    """Result of the experiment."""

    seed: int
    planes: tuple[PlaneAccuracy, ...]
    trials: tuple[GuidanceTrial, ...]

    def table(self) -> list[str]:
        """Return the figures as lines of text."""
        legs = [leg for trial in self.trials for leg in trial.legs]
        lines = [f"{'plane by the robot, exact pointing':<36}{'RMS':>8}{'median':>8}{'largest':>9}"]
        for plane in self.planes:
            errors = np.hypot(*np.reshape(plane.errors_mm, (-1, 2)).T)
            name = f"  {plane.height_mm:.0f} mm above the table, {len(errors)} targets"
            figures = "    none"
            if len(errors):
                figures = f"{plane.rms_mm:8.2f}{np.median(errors):8.2f}{errors.max():9.2f} mm"
            missing = f"   {plane.missing} without a fix" if plane.missing else ""
            lines.append(f"{name:<36}{figures}{missing}")
        within = f"within {WITHIN_MM:g} mm"
        goal = f"{GOAL_MM:g} mm"
        touched = sum(trial.table_steps > 0 for trial in self.trials)
        lines += [
            "",
            f"guidance, {len(self.trials)} trials".ljust(36)
            + f"{'median':>8}{'95 %':>8}{'largest':>9}   {within:>12}{goal:>9}",
            _distances("  open loop", [leg.open_mm for leg in legs], len(legs)),
            _distances(
                "  with feedback",
                [leg.closed_mm for leg in legs if leg.closed_mm is not None],
                2 * len(self.trials),
            ),
            _distances(
                "  block placed",
                [trial.placed_mm for trial in self.trials if trial.placed_mm is not None],
                len(self.trials),
            ),
            _times("  open loop", [leg.open_s for leg in legs]),
            _times("  feedback, dwell included", [leg.closed_s for leg in legs]),
            "",
            f"corrections per target {np.mean([leg.corrections for leg in legs] or [0]):.1f}; "
            f"hand brought back to be found {sum(leg.lost for leg in legs)} times; "
            f"trials in which the arm touched the table {touched}; "
            f"frames with a fix {self._availability():.1%}; fix RMS {self._fix_rms():.2f} mm; "
            f"frames with a fix and no hand {sum(t.false_fixes for t in self.trials)}",
        ]
        return lines + [f"trial {t.index}: {t.problem}" for t in self.trials if t.problem]

    def as_dict(self) -> dict[str, Any]:
        """Return all measurements as JSON values."""
        return asdict(self) | {
            "planes": [asdict(plane) | {"rms_mm": plane.rms_mm} for plane in self.planes]
        }

    def _availability(self) -> float:
        return sum(t.fixes for t in self.trials) / max(sum(t.frames for t in self.trials), 1)

    def _fix_rms(self) -> float:
        known = [(t.fix_rms_mm, t.fixes) for t in self.trials if t.fix_rms_mm is not None]
        return float(
            np.sqrt(sum(n * rms**2 for rms, n in known) / max(sum(n for _, n in known), 1))
        )


def _distances(name: str, values: list[float], of: int) -> str:
    if not values:
        return f"{name:<36}none of {of}"
    shares = [
        f"{100 * sum(value <= limit for value in values) / of:.0f} %"
        for limit in (WITHIN_MM, GOAL_MM)
    ]
    return (
        f"{name:<36}{np.median(values):8.1f}{np.percentile(values, 95):8.1f}{max(values):9.1f} mm"
        f"{shares[0]:>12}{shares[1]:>9}"
    )


def _times(name: str, values: list[float]) -> str:
    if not values:
        return f"{name:<36}none"
    return f"{name:<36}{np.median(values):8.1f}{np.percentile(values, 95):8.1f}{max(values):9.1f} s"


def run_guidance(
    trials: int,
    options: GuidanceOptions | None = None,
    *,
    workers: int | None = None,
    progress: Progress | None = None,
) -> GuidanceResult:
    """Define the planes, measure them, and repeat the guidance experiment.

    Parameters
    ----------
    trials
        Number of trials, ≥ 0; 0 only measures the planes.
    options
        Options of the experiment.
    workers
        Number of processes, ≥ 1; None uses all cores. The result is the same to the last bit. They
        are started afresh ("spawn"), so a script needs the usual ``if __name__ == "__main__":``.
    progress
        Called in this process when a trial or plane is completed.

    Raises
    ------
    MissingExtraError
        MuJoCo is not installed.
    InvalidInputError
        A number out of range.
    FingerpostError
        A plane could not be defined, or a worker died.
    """
    options = options or GuidanceOptions()
    require_mujoco()
    if trials < 0:
        raise InvalidInputError(f"trials is {trials}; 0 or more is right")
    total = trials + len(options.heights_mm)
    report = progress or (lambda _done, _of: None)
    planes: list[PlaneAccuracy] = []
    done: list[GuidanceTrial] = []
    with sharing(min(worker_count(workers), total)) as pool:
        defined: list[Future[Any]] = [
            pool.submit(measure_plane, height, options) for height in options.heights_mm
        ]
        rig, _ = defined[0].result()
        futures: list[Future[Any]] = [
            pool.submit(guide, index, rig, options) for index in range(trials)
        ]
        for future in as_completed([*defined, *futures]):
            result = future.result()
            if isinstance(result, GuidanceTrial):
                done.append(result)
            else:
                planes.append(result[1])
            report(len(done) + len(planes), total)
    return GuidanceResult(
        options.seed,
        tuple(sorted(planes, key=lambda plane: plane.height_mm)),
        tuple(sorted(done, key=lambda trial: trial.index)),
    )


def measure_plane(height_mm: float, options: GuidanceOptions) -> tuple[Rig, PlaneAccuracy]:
    """Let the robot define a plane, and measure the points of a hand that points exactly.

    Returns
    -------
    Rig
        The rig with this plane, without start poses.
    PlaneAccuracy
    """
    rng = _rng(options, 1, round(10 * height_mm))
    hand = Hand().body
    cell = PhysicalCell(options.cameras.cameras(), hand, rng=rng, optics=options.optics)
    cell.put_block((620.0, 300.0), 0.0)  # out of the way
    world = World(cell, options.frames_per_s)
    try:
        with scorbot_in(cell, world) as line:
            plane = plane_by_card(cell, world, line.robot, height_mm / 1000, points=options.points)
            rig = plane.rig(rig_without_plane(cell.cameras), robot_table(height_mm / 1000))
            aim = Aim(WAITING_MM, plane_mm=height_mm)
            operator = Operator(Habits.exact(), WAITING_MM, rng, time_s=world.time_s)
            line.robot.home()  # out of the way
            rig_with_start = with_start(rig, cell.cameras, hand, aim.pose(), rng)
            views = CellViews(world, Pointer(rig_with_start), operator, aim)

            def look(time_s: float) -> None:
                views.take(time_s)

            world.on_frame = look
            world.advance(SHOWN_S)
            errors = []
            for _ in range(options.plane_targets):
                goal_mm = target_mm(rng)
                operator.mean(goal_mm, world.time_s)
                while operator.is_moving(world.time_s):
                    world.to_next_frame()
                world.advance(SETTLED_S)
                if views.fix is not None and views.fix.point is not None:
                    x, y = 1000 * views.fix.point - goal_mm
                    errors.append((float(x), float(y)))
            world.on_frame = None
    finally:
        cell.close()
    sigma_mm = 1000 * float(plane.sigma_m.max())
    missing = options.plane_targets - len(errors)
    return rig, PlaneAccuracy(height_mm, sigma_mm, tuple(errors), missing)


def guide(index: int, rig: Rig, options: GuidanceOptions) -> GuidanceTrial:
    """Run one trial: point at a block and at a place, to have it carried there.

    Parameters
    ----------
    index
        Number of the trial, which together with the seed determines all random numbers.
    rig
        The rig with the plane defined by the robot.
    options
        Options of the experiment.
    """
    with _staged(index, rig, options) as stage:
        task = Task(stage.world, stage.loop, stage.operator, stage.block_mm, stage.place_mm)
        stage.play(task)
        return GuidanceTrial(
            index,
            tuple(task.legs),
            task.placed_mm,
            stage.cell.contacts.table_steps,
            stage.accuracy.rms_mm,
            stage.accuracy.moments,
            stage.accuracy.fixes,
            task.problem,
            stage.accuracy.false_fixes,
        )


@dataclass(frozen=True)
class Unattended:
    """Behaviour of the arm without a hand.

    Attributes
    ----------
    index
        Number of the trial.
    travel_mm
        Travel of the gripper after the hand had disappeared.
    held_s
        Time from then until the guard held the arm; None if it was not moving.
    false_fixes
        Frames with an indicated point.
    problem
        Why the trial failed; else empty.
    """

    index: int
    travel_mm: float
    held_s: float | None
    false_fixes: int
    problem: str = ""


def stay_away(index: int, rig: Rig, options: GuidanceOptions) -> Unattended:
    """Hold the key down without a pointing hand; the parameters are those of `guide`."""
    with _staged(index, rig, options) as stage:
        absence = Absence(stage.world, stage.loop)
        stage.play(absence)
        travel_mm = 0.0 if absence.from_m is None else stage.travel_mm(absence.from_m)
        return Unattended(index, travel_mm, None, stage.accuracy.false_fixes, absence.problem)


def vanish(index: int, rig: Rig, options: GuidanceOptions) -> Unattended:
    """Let the hand vanish while the arm follows; the parameters are those of `guide`."""
    with _staged(index, rig, options) as stage:
        hand = Vanishing(stage.world, stage.loop, stage.operator, stage.block_mm, stage.place_mm)
        stage.play(hand)
        travel_mm = 0.0 if hand.from_m is None else stage.travel_mm(hand.from_m)
        held_s = [
            record.time_s - hand.gone_s
            for record in stage.loop.guard.records
            if record.command in ("hold", "halt") and record.time_s >= hand.gone_s
        ]
        return Unattended(
            index,
            travel_mm,
            min(held_s, default=None),
            stage.accuracy.false_fixes,
            hand.problem,
        )


@dataclass(eq=False)
class _Stage:
    """A cell with all participants."""

    cell: PhysicalCell
    world: World
    operator: Operator
    loop: ClosedLoop
    accuracy: FixAccuracy
    block_mm: Array
    place_mm: Array

    def play(self, person: Scripted) -> None:
        """Run the session; an error of the robot becomes the person's `problem`."""
        try:
            self.loop.run(person, TASK_S)
        except RobotError as error:
            person.problem = f"{type(error).__name__}: {error}"

    def travel_mm(self, from_m: Array) -> float:
        """Return the final distance of the gripper from a place (3,)."""
        return float(1000 * np.linalg.norm(self.loop.gripper_m - from_m))


@contextmanager
def _staged(index: int, rig: Rig, options: GuidanceOptions) -> Iterator[_Stage]:
    rng = _rng(options, 0, index)
    hand = Hand().body
    cell = PhysicalCell(options.cameras.cameras(), hand, rng=rng, optics=options.optics)
    block_mm, place_mm = block_and_place_mm(rng)
    turn_rad = float(rng.uniform(-MOST_TURNED_RAD, MOST_TURNED_RAD))
    cell.put_block((float(block_mm[0]), float(block_mm[1])), turn_rad)
    world = World(cell, options.frames_per_s)
    waiting = Aim(WAITING_MM, plane_mm=1000 * robot_of(rig).height_m)
    accuracy = FixAccuracy()
    try:
        with scorbot_in(cell, world) as line:
            operator = Operator(options.habits, WAITING_MM, rng, time_s=world.time_s)
            loop = ClosedLoop(
                world,
                line.robot,
                with_start(rig, cell.cameras, hand, waiting.pose(), rng),
                operator,
                options.loop,
                aim=waiting,
                on_moment=accuracy.add,
            )
            yield _Stage(cell, world, operator, loop, accuracy, block_mm, place_mm)
    finally:
        cell.close()


def _rng(options: GuidanceOptions, *key: int) -> np.random.Generator:
    return np.random.default_rng([options.seed, *key])
