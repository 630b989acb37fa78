"""The experiment on footage: the same figures, with truth from a file."""

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
from fingerpost.experiment.trial import Trial, trial_of
from fingerpost.pipeline import Pointer, steps
from fingerpost.pointing import Status
from fingerpost.recording import PointRow, read_points

_COLUMNS = ("frame", "x", "y")

# Greatest difference of the times of one frame, by rounding to hundredths: half a frame at 50 per
# second.
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
        (plane units), and optionally ``time_s`` (from the start of the recording) and others.
        Frames without a row, and rows without x and y, are skipped. If the first view is a video,
        whose frames have times, a row's time must equal its frame's.
    progress
        Called with the number of processed rows and of all.
    **options
        Keyword arguments of `fingerpost.Pointer`.

    Returns
    -------
    ExperimentResult
        One trial per frame with a truth; without bound and finger lines, whose truth is unknown.

    Raises
    ------
    RigError, CaptureError
        A rig file or a source that cannot be used.
    InvalidInputError
        A truth that cannot be read, does not belong to the recording, or has a frame at another
        time, or invalid options.
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
                _refuse_other_time(row, step.index, step.fix.time_s)
            trials.append(trial_of(step, pointer.plane_views, index=step.index, target=row.point))
            if progress is not None:
                progress(len(trials), len(truth))
    title = f"{len(trials)} frames of {rig_path} with a truth in {truth_path}"
    settings = {"recording": str(rig_path), "truth": str(truth_path), **options}
    return _result(title, settings, pointer, trials, truth)


def score_points(
    rig_path: str | Path, points_path: str | Path, truth_path: str | Path
) -> ExperimentResult:
    """Compare points that any program has found in a recording with the truth.

    Parameters
    ----------
    rig_path
        The rig file, for plane and unit; no footage is read.
    points_path
        A `points.csv` (`fingerpost.recording.read_points`). Frames with a truth but without a row
        count as lost; points may lack a covariance.
    truth_path
        As in `run_recording`.

    Returns
    -------
    ExperimentResult
        One trial per frame that has a truth.

    Raises
    ------
    RigError
        A rig file that cannot be used.
    InvalidInputError
        A table that cannot be read, or a row of another time than its frame's truth.
    """
    rig = Rig.load(rig_path)
    truth = _read_truth(Path(truth_path))
    rows = {row.frame: row for row in read_points(points_path)}
    trials = []
    for index, true in sorted(truth.items()):
        row = rows.get(index)
        if row is None:
            trials.append(Trial(index, true.point, Status.LOST, "no row"))
            continue
        _refuse_other_time(true, index, row.time_s)
        trials.append(_scored(row, true.point))
    title = f"{len(trials)} frames with a truth in {truth_path}, scored by {points_path}"
    settings = {"points": str(points_path), "truth": str(truth_path)}
    return _result(title, settings, Pointer(rig), trials, truth)


def _scored(row: PointRow, target: NDArray[np.float64]) -> Trial:
    """Compare a row of a table with the truth of its frame."""
    status = Status(row.status)
    if row.x is None or row.y is None:
        return Trial(row.frame, target, status, row.reason)
    point, covariance = np.array([row.x, row.y]), None
    if row.cov_xx is not None and row.cov_xy is not None and row.cov_yy is not None:
        covariance = np.array([[row.cov_xx, row.cov_xy], [row.cov_xy, row.cov_yy]])
    return Trial(row.frame, target, status, row.reason, point, covariance)


def _result(
    title: str,
    settings: dict[str, Any],
    pointer: Pointer,
    trials: list[Trial],
    truth: dict[int, _TrueRow],
) -> ExperimentResult:
    if not trials:
        raise InvalidInputError(
            f"{settings['truth']}: no frame of the recording has a row with x and y; its frames "
            f"are {min(truth)} to {max(truth)}"
        )
    return ExperimentResult(
        title=(title,),
        settings=settings,
        unit=pointer.rig.plane.unit,
        plane_size=max(view.plane_size for view in pointer.plane_views),
        plane_points=pointer.plane_views[0].plane_points,
        trials=tuple(trials),
    )


def _refuse_other_time(row: _TrueRow, frame: int, time_s: float) -> None:
    """Refuse a truth of other footage, or with another numbering of frames."""
    if row.time_s is not None and abs(row.time_s - time_s) > _ROUNDING_S:
        raise InvalidInputError(
            f"{row.place}: time_s of frame {frame} is {row.time_s:g}, but the recording shows "
            f"it at {time_s:.6g} s; a truth of this recording is needed"
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
