"""`fingerpost batch`: many recordings, on all cores."""

from __future__ import annotations

import csv
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fingerpost.cli.endings import ending_as_interrupted
from fingerpost.cli.following import settings_of, tracker_options
from fingerpost.cli.progress import counting
from fingerpost.errors import RecordingError
from fingerpost.installation import need_opencv
from fingerpost.signals import ending_at_once

if TYPE_CHECKING:
    from fingerpost.batch import Outcome

_FAILED = 1


@click.command()
@click.argument("rigs", metavar="RIG.TOML...", nargs=-1, required=True)
@click.option(
    "--out",
    "folder",
    metavar="FOLDER",
    required=True,
    type=click.Path(path_type=Path),
    help="Gets a folder for each recording, batch.csv and batch.png.",
)
@click.option("--workers", metavar="N", type=int, help="Processes.  [default: one a core]")
@click.option(
    "--dask",
    metavar="tcp://HOST:PORT|local:N",
    help="Work on a Dask cluster: its scheduler's address, or N workers on this machine.",
)
@tracker_options
def batch(
    rigs: tuple[str, ...], folder: Path, workers: int | None, dask: str | None, **options: Any
) -> None:
    """Work through many rig files and recordings, named or as globs in quotes.

    Every recording gets a folder with its tables; batch.csv and batch.png show all of them. What is
    done already, with the same options, is not done again. What fails is listed with its reason and
    stops nothing; the exit code is 1 then.

    With --dask the results are the same to the last bit. The workers of the cluster need
    fingerpost, and have to see the recordings by the same names; tables are written here.
    """
    if dask is not None and workers is not None:
        raise click.UsageError("--workers: a cluster has the workers that it has; leave it out")
    with ending_at_once():
        need_opencv()
        from fingerpost.batch import run_batch, tasks
        from fingerpost.cluster import cluster_at
        from fingerpost.recording import write_picture
        from fingerpost.recording.picture.shares import draw_shares

    todo = tasks(rigs, settings_of(**options))
    with ending_as_interrupted(), ExitStack() as stack:
        cluster = None if dask is None else stack.enter_context(cluster_at(dask))
        report = stack.enter_context(counting("recordings"))
        outcomes = run_batch(todo, folder, workers=workers, cluster=cluster, report=report)
    _write_table(folder / "batch.csv", outcomes)
    shares = [(one.task.name, one.statuses, one.reason) for one in outcomes]
    write_picture(folder / "batch.png", draw_shares(shares))
    failed = [one for one in outcomes if one.reason]
    click.echo(f"{len(outcomes) - len(failed)} of {len(outcomes)} recordings: {folder}/batch.csv")
    for one in failed:
        click.echo(f"{one.task.name}: {one.reason}", err=True)
    if failed:
        sys.exit(_FAILED)


def _write_table(path: Path, outcomes: list[Outcome]) -> None:
    from fingerpost.recording import PointRow

    try:
        with path.open("w", encoding="utf-8", newline="") as file:
            table = csv.writer(file, lineterminator="\n")
            words = ("unit", "reason", "notes")
            table.writerow(["recording", "frames", *PointRow.STATUSES, "semi_axis_95", *words])
            for one in outcomes:
                counts = [one.statuses.get(status, 0) for status in PointRow.STATUSES]
                semi_axis = "" if one.semi_axis is None else one.semi_axis
                said = [one.unit, one.reason, "; ".join(one.notes)]
                table.writerow([one.task.name, one.frames, *counts, semi_axis, *said])
    except OSError as error:
        raise RecordingError(f"{path}: cannot be written: {error.strerror}") from error
