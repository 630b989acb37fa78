"""`fingerpost replay`: a recording once more, with the same options or others."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fingerpost.cli.following import Following, follow, following_options
from fingerpost.cli.outputs import keep_apart
from fingerpost.cli.recorder import check_recording
from fingerpost.installation import need_opencv
from fingerpost.signals import ending_at_once

if TYPE_CHECKING:
    from fingerpost.pipeline import Step


@click.command()
@click.argument("recording", metavar="X.MCAP", type=click.Path(path_type=Path))
@following_options
@click.option(
    "--beside",
    metavar="C.CSV",
    type=click.Path(path_type=Path),
    help="Write the fixes of the recording and those of now side by side.",
)
def replay(recording: Path, beside: Path | None, **asked: Any) -> None:
    """Follow the hand in a recording again.

    With the options that it was recorded with, and images that were recorded as they came or
    without loss, every fix is the same to the last bit. The summary says how they compare.
    """
    with ending_at_once():
        need_opencv()
        from fingerpost.config import Rig
        from fingerpost.recording.session.comparison import Comparison, write_beside

    check_recording(recording)
    following = Following(**asked)
    keep_apart({**following.written, "--beside": beside}, [("the recording itself", recording)])
    rig = Rig.load(recording)
    comparison = Comparison.with_recording(recording)
    with ExitStack() as stack:
        table = stack.enter_context(write_beside(beside)) if beside else None

        def take(step: Step) -> None:
            row = comparison.add(step.point_row())
            if table is not None:
                table.write(row)

        follow(rig, following, take, lambda: comparison.lines(rig.plane.unit))
