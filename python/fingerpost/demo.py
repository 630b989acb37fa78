"""A demonstration without cameras: built-in footage → fixes, a summary, pictures.

The footage is either a short rendered clip of a hand (`data/desk`) or the simulated rig, both with
ground truth. They are processed by the same pipeline as any recording, without special tuning.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from fingerpost.capture import Frame, Loss, open_views, read_views
from fingerpost.checks import make_folder
from fingerpost.config import Rig
from fingerpost.errors import InvalidInputError
from fingerpost.pipeline import DEFAULT_REFERENCE_SIGMA_PX, Pointer, Step, steps
from fingerpost.recording import VideoWriter, write_picture, write_points, write_tracks
from fingerpost.recording.picture import Composition
from fingerpost.simulate import (
    Background,
    FrameTruth,
    Hand,
    Lighting,
    Motion,
    Sensor,
    SimulatedRig,
    StartError,
    figure_eight,
    pointing_session,
)
from fingerpost.simulated_rig_file import rig_from_simulation

T = TypeVar("T")
Frames = tuple[Frame | Loss | None, ...]
Watch = Callable[[Iterable[Frames], int], Iterable[Frames]]

_CLIP = Path(__file__).with_name("data") / "desk"

_SIMULATED_FPS = 30.0
_START_ERROR = StartError(offset_px=5.0, angle_deg=5.0)
_TRAIL = 40  # fixes that the overlay shows behind the newest one


@dataclass(frozen=True)
class DemoSummary:
    """Results of a demo; lengths in plane units.

    Attributes
    ----------
    footage
        The footage that was played.
    unit
        Name of the plane's unit.
    plane_size
        Side of the working plane.
    frames
        Frames of the first view.
    fixes
        Number of fixes with an indicated point.
    availability
        Share of frames with a fix among those from the first fix on that show the whole finger, 0
        to 1; None without a fix.
    rms, median, percentile_95
        Distance from the indicated point to the true point, over the frames that have both; None
        if there is no such frame.
    coverage
        Share of these frames whose 95 % ellipse contains the true point, 0 to 1.
    tracking_ms
        Mean time to track the hand in a frame of every view and to point, in ms.
    decoding_ms
        Mean time to decode, or simulate, that frame of every view, in ms.
    files
        Written files.
    """

    footage: str
    unit: str
    plane_size: float
    frames: int
    fixes: int
    availability: float | None
    rms: float | None
    median: float | None
    percentile_95: float | None
    coverage: float | None
    tracking_ms: float
    decoding_ms: float
    files: tuple[str, ...]

    def lines(self) -> list[str]:
        """Return the summary as lines of text for a person."""
        lines = [f"frames    {self.frames} of {self.footage}, {self.fixes} with a fix"]
        if self.availability is not None:
            lines.append(
                f"available {100 * self.availability:.1f} % of the frames that show the whole "
                "finger, from the first fix on"
            )
        if self.rms is not None and self.median is not None and self.percentile_95 is not None:
            lines.append(
                f"error     RMS {self._length(self.rms)}, median {self._length(self.median)}, "
                f"95th percentile {self._length(self.percentile_95)}; % of the plane's side"
            )
        if self.coverage is not None:
            lines.append(
                f"honesty   {100 * self.coverage:.0f} % of the 95 % ellipses hold the true point"
            )
        lines.append(
            f"speed     {self.tracking_ms:.1f} ms to track and point, "
            f"{self.decoding_ms:.1f} ms to decode, per frame of all views"
        )
        return [*lines, *(f"written   {file}" for file in self.files)]

    def as_dict(self) -> dict[str, Any]:
        """Return the summary for JSON; a None is a figure that does not exist."""
        return dataclasses.asdict(self)

    def _length(self, length: float) -> str:
        digits = max(0, -math.floor(math.log10(self.plane_size / 1000.0)))
        return f"{length:.{digits}f} {self.unit} ({100 * length / self.plane_size:.1f} %)"


def run_demo(
    output: str | Path,
    *,
    simulate: bool = False,
    seed: int = 0,
    max_frames: int | None = None,
    clock: Callable[[], int] = time.perf_counter_ns,
    watch: Watch | None = None,
) -> DemoSummary:
    """Process the built-in footage, and write the results.

    The folder gets ``points.csv``, ``tracks.csv``, ``overlay.webm`` and ``summary.png``: both views
    with outline, finger line and indicated point, and the plan with the indicated and the true
    points. Files of a former run are overwritten.

    Parameters
    ----------
    output
        The folder; created if needed.
    simulate
        False plays the clip, True the simulated rig: a hand that enters, waits, points along a
        path, leaves and returns.
    seed
        Seed of the simulation, ≥ 0.
    max_frames
        Number of frames after which to stop, ≥ 1; None plays all.
    clock
        Returns the time in nanoseconds; measures the speed.
    watch
        Gets the frames and their number and returns the frames, such as a progress bar.

    Returns
    -------
    DemoSummary

    Raises
    ------
    InvalidInputError
        The folder cannot be created or written into, or an argument is out of range.
    FingerpostError
        Writing a file has failed.
    """
    if max_frames is not None and max_frames < 1:
        raise InvalidInputError(f"max_frames is {max_frames}; 1 or more is right")
    folder = make_folder(Path(output))
    with ExitStack() as stack:
        footage = _simulation(seed) if simulate else _clip(stack)
        count = min(footage.count, max_frames or footage.count)
        played = _Timed(islice(footage.frames, count), clock)
        pointer = Pointer(footage.rig, reference_sigma_px=footage.reference_sigma_px)
        followed = _Timed(steps(pointer, watch(played, count) if watch else played), clock)
        outcome = _Outcome(footage.truth)
        files = _write_all(stack, folder, footage, pointer, followed, outcome, count)
    return outcome.summary(
        footage=footage,
        plane_size=pointer.plane_views[0].plane_size,
        # Decoding happens during tracking, on demand.
        tracking_ns=followed.elapsed_ns - played.elapsed_ns,
        decoding_ns=played.elapsed_ns,
        files=files,
    )


def clip_rig() -> Rig:
    """Return the rig of the built-in clip: two recordings of a hand over a table."""
    return Rig.load(_CLIP / "rig.toml")


# --- footage ----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Footage:
    """Frames, their rig and their ground truth."""

    name: str
    rig: Rig
    reference_sigma_px: float
    frames: Iterable[Frames]
    count: int
    fps: float
    truth: dict[int, NDArray[np.float64]]
    """True point by frame, for frames in which every view shows the whole finger; the simulation
    adds it as it renders."""


def _clip(stack: ExitStack) -> _Footage:
    """Open the packaged clip until the stack unwinds."""
    rig = clip_rig()
    sources = stack.enter_context(open_views(rig.sources, rig.readings))
    table = np.loadtxt(_CLIP / "truth.csv", delimiter=",", skiprows=1)
    return _Footage(
        name="the built-in clip",
        rig=rig,
        reference_sigma_px=DEFAULT_REFERENCE_SIGMA_PX,
        frames=read_views(sources),
        count=len(table),
        fps=1.0 / float(np.diff(table[:, 1]).mean()),
        truth={int(row[0]): row[2:4] for row in table},
    )


# Standard deviation of the simulation's reference points, as from a fit to a drawn edge [px].
_SIMULATED_REFERENCE_SIGMA_PX = 0.1


def _simulation(seed: int) -> _Footage:
    """Set up the simulated rig: a hand over a sheet of paper on a wooden table."""
    if seed < 0:
        raise InvalidInputError(f"seed is {seed}; 0 or more is right")
    simulated = SimulatedRig(
        device=Hand(),
        background=Background(texture="wood", sheet=60.0),
        lighting=Lighting(side_light=0.2, limb_darkening=0.2, shadow=0.4),
        sensor=Sensor(channels="bgr", cells_per_sigma=2),
    )
    path = figure_eight(simulated.workspace)
    motion = pointing_session([*path, path[0]], entry_speed_m_s=0.9)
    count = math.floor(motion.duration_s * _SIMULATED_FPS)
    rng = np.random.default_rng(seed)
    truth: dict[int, NDArray[np.float64]] = {}
    return _Footage(
        name="the simulated rig",
        rig=_rig_of(simulated, simulated.truth(path[0]), rng),
        reference_sigma_px=_SIMULATED_REFERENCE_SIGMA_PX,
        frames=_rendered(simulated, motion, count, rng, truth),
        count=count,
        fps=_SIMULATED_FPS,
        truth=truth,
    )


def _rig_of(simulated: SimulatedRig, waiting: FrameTruth, rng: np.random.Generator) -> Rig:
    """Return the rig that a person would describe: slightly inexact."""
    points_px, starts = [], []
    for view, exact_px in zip(waiting.views, simulated.reference_points_px, strict=True):
        starts.append(None if view.finger is None else view.finger.start(_START_ERROR, rng))
        points_px.append(rng.normal(exact_px, _SIMULATED_REFERENCE_SIGMA_PX))
    return rig_from_simulation(simulated, reference_points_px=points_px, starts=starts)


def _rendered(
    simulated: SimulatedRig,
    motion: Motion,
    count: int,
    rng: np.random.Generator,
    truth: dict[int, NDArray[np.float64]],
) -> Iterator[Frames]:
    """Render frame by frame, and add the true points to `truth`."""
    for index in range(count):
        frame = simulated.render(motion, time_s=index / _SIMULATED_FPS, rng=rng)
        indicated_mm = frame.truth.indicated_mm
        if indicated_mm is not None and _shows_finger(frame.truth):
            truth[index] = indicated_mm
        yield tuple(
            Frame(index, view.time_s, image)
            for view, image in zip(frame.truth.views, frame.images, strict=True)
        )


def _shows_finger(truth: FrameTruth) -> bool:
    return all(view.finger is not None and view.finger.in_view for view in truth.views)


# --- results ----------------------------------------------------------------------------------


class _Timed(Generic[T], Iterator[T]):
    """Iterator that measures the time spent waiting for items."""

    def __init__(self, items: Iterable[T], clock: Callable[[], int]) -> None:
        self._items = iter(items)
        self._clock = clock
        self.elapsed_ns = 0

    def __next__(self) -> T:
        started_ns = self._clock()
        try:
            return next(self._items)
        finally:
            self.elapsed_ns += self._clock() - started_ns


@dataclass(eq=False)
class _Outcome:
    """Results of the steps, compared with the truth."""

    truth: dict[int, NDArray[np.float64]]
    frames: int = 0
    points: list[NDArray[np.float64]] = field(default_factory=list)
    with_finger: int = 0  # frames since the first fix that show the whole finger
    errors: list[float] = field(default_factory=list)
    held: list[bool] = field(default_factory=list)  # whether the 95 % ellipse contains the truth

    def add(self, step: Step) -> None:
        self.frames += 1
        fix, true_point = step.fix, self.truth.get(step.index)
        if fix.point is not None:
            self.points.append(fix.point)
        if true_point is None or not self.points:
            return
        self.with_finger += 1
        ellipse = fix.ellipse(0.95)
        if fix.point is not None and ellipse is not None:
            self.errors.append(math.dist(fix.point, true_point))
            self.held.append(bool(ellipse.contains(true_point)))

    def summary(
        self,
        *,
        footage: _Footage,
        plane_size: float,
        tracking_ns: int,
        decoding_ns: int,
        files: Sequence[Path],
    ) -> DemoSummary:
        errors = np.array(self.errors)
        known = len(errors) > 0
        per_frame_ms = 1e-6 / max(self.frames, 1)
        return DemoSummary(
            footage=footage.name,
            unit=footage.rig.plane.unit,
            plane_size=plane_size,
            frames=self.frames,
            fixes=len(self.points),
            availability=len(errors) / self.with_finger if self.with_finger else None,
            rms=float(np.sqrt((errors**2).mean())) if known else None,
            median=float(np.median(errors)) if known else None,
            percentile_95=float(np.percentile(errors, 95.0)) if known else None,
            coverage=float(np.mean(self.held)) if known else None,
            tracking_ms=tracking_ns * per_frame_ms,
            decoding_ms=decoding_ns * per_frame_ms,
            files=tuple(str(file) for file in files),
        )


def _write_all(
    stack: ExitStack,
    folder: Path,
    footage: _Footage,
    pointer: Pointer,
    followed: Iterable[Step],
    outcome: _Outcome,
    count: int,
) -> list[Path]:
    """Process every step, and write the tables, the video and the picture."""
    files = [folder / name for name in ("points.csv", "tracks.csv", "overlay.webm", "summary.png")]
    points = stack.enter_context(write_points(files[0]))
    tracks = stack.enter_context(write_tracks(files[1]))
    video = stack.enter_context(VideoWriter(files[2], fps=footage.fps))
    composition = Composition(pointer.plane_views, unit=footage.rig.plane.unit)
    pictured: Step | None = None
    for step in followed:
        outcome.add(step)
        points.write(step.point_row())
        for observation in step.observations:
            row = observation.track_row()
            if row is not None:
                tracks.write(row)
        video.write(
            composition.draw(
                step.observations,
                step.fix,
                truth=footage.truth.get(step.index),
                trail=outcome.points[-_TRAIL:],
            )
        )
        if pictured is None or _shows_more(step, pictured, count):
            pictured = step
    if pictured is not None:
        image = composition.draw(
            pictured.observations,
            pictured.fix,
            truth=footage.truth.get(pictured.index),
            trail=outcome.points,
            truth_trail=_unbroken(footage.truth, count),
        )
        write_picture(files[3], image)
    return files


def _shows_more(step: Step, pictured: Step, count: int) -> bool:
    """Whether a step suits the summary better: with a fix, and, up to the middle, later."""
    if step.fix.point is None:
        return False
    return pictured.fix.point is None or step.index <= count // 2


def _unbroken(truth: dict[int, NDArray[np.float64]], count: int) -> NDArray[np.float64]:
    """Return the true points of all frames; NaN where there is none."""
    nowhere = np.full(2, np.nan)
    return np.array([truth.get(index, nowhere) for index in range(count)])
