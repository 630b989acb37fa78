"""Processing of many recordings on all cores; completed ones are not repeated, failures are listed.

Each recording gets a folder of its own with `points.csv`, `tracks.csv` and `outcome.json`. It is
called `NAME.part` until it is complete, so a batch that was stopped resumes where it was.
"""

from __future__ import annotations

import glob
import logging
import os
import shutil
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from fingerpost.capture import SourceKind, open_views, read_views
from fingerpost.checks import make_folder
from fingerpost.cluster import Cluster
from fingerpost.config import Rig
from fingerpost.errors import FingerpostError, InvalidInputError
from fingerpost.pipeline import Pointer, steps
from fingerpost.recording import write_points, write_tracks
from fingerpost.uncertainty import confidence_ellipse
from fingerpost.workers import sharing, worker_count

_OUTCOME = "outcome.json"
_PART = ".part"
_TRIES = 2


class Task(msgspec.Struct, frozen=True, kw_only=True):
    """One recording to process.

    Attributes
    ----------
    name
        Name of its folder.
    rig
        The rig file or recording, as an absolute path.
    changed_ns
        Time of the file's last change.
    options
        Options that differ from the tracker's defaults.
    """

    name: str
    rig: str
    changed_ns: int
    options: dict[str, Any]


class Outcome(msgspec.Struct, frozen=True, kw_only=True):
    """Result of a recording.

    Attributes
    ----------
    task
        The recording.
    unit
        The plane's unit; empty if it failed.
    statuses
        Number of fixes of each status.
    semi_axis
        Median of the larger semi-axis of the 95 % ellipses, in plane units; None without a point.
    reason
        Why it failed; empty if it did not.
    notes
        Remarks on its views, for people.
    """

    task: Task
    unit: str = ""
    statuses: dict[str, int] = {}
    semi_axis: float | None = None
    reason: str = ""
    notes: tuple[str, ...] = ()

    @property
    def frames(self) -> int:
        """Number of fixes."""
        return sum(self.statuses.values())


def tasks(patterns: Sequence[str], options: Mapping[str, Any]) -> list[Task]:
    """Return the recordings that match patterns.

    Parameters
    ----------
    patterns
        Rig files and recordings, by name or as globs. A name without a file is a task that fails.
    options
        Options that differ from the tracker's defaults.

    Raises
    ------
    InvalidInputError
        A glob that no file matches.
    """
    paths: dict[Path, None] = {}
    for pattern in patterns:
        found = sorted(glob.glob(pattern, recursive=True))  # noqa: PTH207 - absolute patterns too
        if not found and glob.has_magic(pattern):
            raise InvalidInputError(f"{pattern}: no file matches; rigs or recordings are needed")
        named = found or [pattern]
        paths.update(dict.fromkeys(Path(os.path.abspath(name)) for name in named))  # noqa: PTH100
    return [
        Task(
            name=name,
            rig=str(path),
            changed_ns=_changed_ns(path),
            options=dict(options),
        )
        for name, path in zip(_names(list(paths)), paths, strict=True)
    ]


def _changed_ns(path: Path) -> int:
    """Return the time of a file's last change [ns]; 0 if there is no file."""
    try:
        return path.stat().st_mtime_ns
    except OSError:
        return 0


def _names(paths: Sequence[Path]) -> list[str]:
    """Return a unique name for each path: its stem, prefixed by as few folders as needed."""
    for depth in range(1, max(len(path.parts) for path in paths) + 1):
        names = ["-".join(path.with_suffix("").parts[-depth:]) for path in paths]
        if len(set(names)) == len(names):
            return names
    return [f"{k}-{path.stem}" for k, path in enumerate(paths)]  # they differ only in the suffix


def run_batch(
    todo: Sequence[Task],
    folder: Path,
    *,
    workers: int | None = None,
    cluster: Cluster | None = None,
    report: Callable[[int, int], None] = lambda _done, _of: None,
) -> list[Outcome]:
    """Process recordings; those whose outcome is in the folder are not processed again.

    Parameters
    ----------
    todo
        The recordings.
    folder
        Gets a folder for each; created if needed.
    workers
        Number of processes; None for all cores.
    cluster
        Machines to use instead of this one. Their workers need the recordings under the same paths.
    report
        Called with the number of finished recordings and that of all.

    Returns
    -------
    list of Outcome
        In the order of the recordings; failed ones have a reason.

    Raises
    ------
    InvalidInputError
        Fewer than one worker, or a folder that cannot be created.
    """
    count = worker_count(workers)
    make_folder(folder)
    done = {task.name: known for task in todo if (known := _known(task, folder)) is not None}
    begun: Counter[str] = Counter()
    report(len(done), len(todo))
    if cluster is not None:
        left = [task for task in todo if task.name not in done]
        for outcome in _far_away(left, folder, cluster):
            done[outcome.task.name] = outcome
            report(len(done), len(todo))
    while left := [task for task in todo if task.name not in done]:
        for outcome in _shared(left, folder, min(count, len(left))):
            done[outcome.task.name] = outcome
            report(len(done), len(todo))
        for task in left:
            if task.name not in done and _part(task, folder).exists():
                begun[task.name] += 1
                if begun[task.name] >= _TRIES:
                    reason = "its worker process died, perhaps for want of memory"
                    done[task.name] = Outcome(task=task, reason=reason)
    return [done[task.name] for task in todo]


def _shared(left: Sequence[Task], folder: Path, workers: int) -> Iterable[Outcome]:
    """Distribute recordings to processes until all are done or a process has died."""
    for task in left:
        shutil.rmtree(_part(task, folder), ignore_errors=True)
    with sharing(workers) as pool:
        waiting = {pool.submit(work, task, str(folder)): task for task in left}
        for future in as_completed(waiting):
            try:
                yield future.result()
            except BrokenProcessPool:
                return


def _far_away(left: Sequence[Task], folder: Path, cluster: Cluster) -> Iterator[Outcome]:
    """Process recordings on a cluster; the results are written here."""
    for task, came, reason in cluster.each(work_far_away, left):
        if reason:
            yield Outcome(task=task, reason=reason)
            continue
        outcome, written = came
        if not outcome.reason:
            part = _part(task, folder)
            shutil.rmtree(part, ignore_errors=True)
            make_folder(part)
            for name, data in written.items():
                (part / name).write_bytes(data)
            _complete(part, folder / task.name)
        yield outcome


def work_far_away(task: Task) -> tuple[Outcome, dict[str, bytes]]:
    """Process one recording on a worker of a cluster, which needs no shared disk for the results.

    Returns
    -------
    tuple
        The outcome, and the files of its folder by name. If it failed, there are no files, and the
        reason names the worker.
    """
    import cv2
    from distributed import get_worker

    cv2.setNumThreads(1)  # as many workers as cores; Dask's nannies limit the threads of BLAS
    with tempfile.TemporaryDirectory() as folder:
        outcome = work(task, folder)
        if outcome.reason:
            reason = f"{outcome.reason} (on worker {get_worker().address})"
            return msgspec.structs.replace(outcome, reason=reason), {}
        files = (Path(folder) / task.name).iterdir()
        return outcome, {file.name: file.read_bytes() for file in files}


def _part(task: Task, folder: Path) -> Path:
    return folder / f"{task.name}{_PART}"


def _known(task: Task, folder: Path) -> Outcome | None:
    """Return the outcome of a recording that was processed before with these options."""
    try:
        data = (folder / task.name / _OUTCOME).read_bytes()
        outcome = msgspec.json.decode(data, type=Outcome)
    except (OSError, msgspec.MsgspecError):
        return None
    return outcome if outcome.task == task else None


def work(task: Task, folder: str) -> Outcome:
    """Process one recording in a process of its own; an error becomes its outcome."""
    part = _part(task, Path(folder))
    try:
        part.mkdir(parents=True, exist_ok=True)
        with _warnings() as warnings:
            outcome = _follow(task, part)
        notes = *outcome.notes, *dict.fromkeys(warnings)
        outcome = msgspec.structs.replace(outcome, notes=notes)
        (part / _OUTCOME).write_bytes(msgspec.json.encode(outcome))
        _complete(part, Path(folder) / task.name)
    except (FingerpostError, OSError) as error:
        shutil.rmtree(part, ignore_errors=True)
        return Outcome(task=task, reason=" ".join(str(error).split()))
    return outcome


def _complete(part: Path, complete: Path) -> None:
    shutil.rmtree(complete, ignore_errors=True)
    part.replace(complete)


@contextmanager
def _warnings() -> Iterator[list[str]]:
    """Collect the messages logged meanwhile, which would interrupt the progress display."""
    messages: list[str] = []
    handler = logging.Handler(logging.WARNING)
    handler.emit = lambda record: messages.append(record.getMessage())  # type: ignore[method-assign]
    logger = logging.getLogger("fingerpost")
    logger.addHandler(handler)
    logger.propagate = False
    try:
        yield messages
    finally:
        logger.propagate = True
        logger.removeHandler(handler)


def _follow(task: Task, part: Path) -> Outcome:
    rig = Rig.load(task.rig)
    pointer = Pointer(rig, tracker_options=task.options)
    statuses: Counter[str] = Counter()
    semi_axes: list[float] = []
    with (
        open_views(rig.sources, rig.readings) as sources,
        write_points(part / "points.csv") as points,
        write_tracks(part / "tracks.csv") as tracks,
    ):
        if sources[0].kind is SourceKind.LIVE:
            raise InvalidInputError(f"{task.rig}: has live views; a batch works on recordings")
        pointer.hold_back(sources)
        for step in steps(pointer, read_views(sources)):
            statuses[step.fix.status.value] += 1
            points.write(step.point_row())
            for row in (seen.track_row() for seen in step.observations):
                if row is not None:
                    tracks.write(row)
            if step.fix.point is not None and step.fix.covariance is not None:
                ellipse = confidence_ellipse(step.fix.point, step.fix.covariance, 0.95)
                semi_axes.append(float(ellipse.semi_axes[0]))
        notes = [note for source in sources for note in (source.damage, *source.notes) if note]
    return Outcome(
        task=task,
        unit=rig.plane.unit,
        statuses=dict(statuses),
        notes=tuple(dict.fromkeys([*notes, *pointer.notes()])),
        semi_axis=float(np.median(semi_axes)) if semi_axes else None,
    )
