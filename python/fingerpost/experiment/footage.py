"""The experiment on footage: the same figures, where a file gives the truth."""

import csv
import math
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fingerpost.capture import open_views, read_views
from fingerpost.capture.video import VideoFile
from fingerpost.config import Rig
from fingerpost.errors import InvalidInputError
from fingerpost.experiment.result import ExperimentResult
from fingerpost.experiment.trial import trial_of
from fingerpost.pipeline import Pointer, Step, steps

_COLUMNS = ("frame", "x", "y")

# Times of one frame differ by less: tables round to hundredths. Half a frame at 50 per second.
_ROUNDING_S = 0.01


class _TrueRow(NamedTuple):
    """Truth of a frame, and its place in the file: the point, and perhaps the time."""

    place: str
    time_s: float | None
    point: NDArray[np.float64]


def run_recording(
    rig_path: str | Path,
    truth_path: str | Path,
    *,
    progress: Callable[[int, int], None] | None = None,
    **options: Any,
) -> ExperimentResult:
    """Track a recording and compare the indicated points with the truth.

    Parameters
    ----------
    rig_path
        The rig file (`fingerpost.config.Rig`).
    truth_path
        CSV with the columns ``frame`` (index in the source of the first view), ``x`` and ``y``
        (plane units) and perhaps ``time_s`` (from the start of the recording) and others. Frames
        without a row, and rows without x and y, are skipped. Where the first view is a video,
        whose frames have times, a row's time must be its frame's.
    progress
        Called with the number of rows met and of all.
    **options
        Those of `fingerpost.Pointer`.

    Returns
    -------
    ExperimentResult
        One trial per frame that has a truth; without bound and finger lines, whose truth is
        unknown.

    Raises
    ------
    RigError, CaptureError
        A rig file or a source that cannot be used.
    InvalidInputError
        A truth that cannot be read, belongs to no frame of the recording or has a frame at another
        time, or options that cannot be used.
    """
    rig = Rig.load(rig_path)
    truth = _read_truth(Path(truth_path))
    pointer = Pointer(rig, **options)
    trials = []
    with ExitStack() as stack:
        sources = stack.enter_context(open_views(rig.sources, rig.readings))
        for step in steps(pointer, read_views(sources)):
            if step.index not in truth:
                continue
            row = truth[step.index]
            if isinstance(sources[0], VideoFile):
                _refuse_other_time(row, step)
            trials.append(trial_of(step, pointer.plane_views, index=step.index, target=row.point))
            if progress is not None:
                progress(len(trials), len(truth))
    if not trials:
        raise InvalidInputError(
            f"{truth_path}: no frame of the recording has a row with x and y; its frames are "
            f"{min(truth)} to {max(truth)}"
        )
    return ExperimentResult(
        title=(f"{len(trials)} frames of {rig_path} with a truth in {truth_path}",),
        settings={"recording": str(rig_path), "truth": str(truth_path), **options},
        unit=rig.plane.unit,
        plane_size=max(view.plane_size for view in pointer.plane_views),
        plane_points=pointer.plane_views[0].plane_points,
        trials=tuple(trials),
    )


def _refuse_other_time(row: _TrueRow, step: Step) -> None:
    """Refuse a truth of other footage, or one that counts frames otherwise."""
    if row.time_s is not None and abs(row.time_s - step.fix.time_s) > _ROUNDING_S:
        raise InvalidInputError(
            f"{row.place}: time_s of frame {step.index} is {row.time_s:g}, but the recording shows "
            f"it at {step.fix.time_s:.6g} s; a truth of this recording is needed"
        )


def _read_truth(path: Path) -> dict[int, _TrueRow]:
    """Read the indicated point of every frame that has one."""
    truth: dict[int, _TrueRow] = {}
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            rows = csv.DictReader(file)
            missing = [name for name in _COLUMNS if name not in (rows.fieldnames or ())]
            if missing:
                raise InvalidInputError(f"{path}: the column {missing[0]} is missing")
            for row in rows:
                place = f"{path}: line {rows.line_num}"
                frame = _frame(row["frame"], place)
                if frame in truth:
                    raise InvalidInputError(f"{place}: frame {frame} has a row already")
                if row["x"] or row["y"]:
                    x, y = (_number(row[name], name, place) for name in ("x", "y"))
                    text = row.get("time_s")
                    time_s = _number(text, "time_s", place) if text else None
                    truth[frame] = _TrueRow(place, time_s, np.array([x, y]))
    except OSError as error:
        raise InvalidInputError(f"{path}: {error.strerror}; a truth (CSV) is needed") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise InvalidInputError(f"{path}: not a CSV file in UTF-8 ({error})") from error
    if not truth:
        raise InvalidInputError(f"{path}: no row has x and y; at least one is needed")
    return truth


def _frame(cell: str | None, place: str) -> int:
    if cell is None or not cell.isascii() or not cell.isdigit():
        raise InvalidInputError(f"{place}: frame is {cell!r}; a whole number from 0 is right")
    return int(cell)


def _number(cell: str | None, name: str, place: str) -> float:
    try:
        value = float(cell or "")
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InvalidInputError(f"{place}: {name} is {cell!r}; a finite number is right")
    return value
