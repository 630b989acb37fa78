"""`fingerpost record`: the views of a rig into a file."""

from __future__ import annotations

import time
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

import click

from fingerpost.cli.endings import ending_as_interrupted
from fingerpost.cli.live_views import give_up_option, hush_streams
from fingerpost.cli.outputs import keep_apart, rig_files
from fingerpost.cli.progress import status_line
from fingerpost.cli.recorder import check_recording, images_option, open_recorder
from fingerpost.cli.run_summary import source_notes
from fingerpost.errors import RecordingError
from fingerpost.installation import need_opencv
from fingerpost.signals import ending_at_once

if TYPE_CHECKING:
    from fingerpost.capture import Source

_SHOWN_S = 0.2


@click.command()
@click.argument("rig_file", metavar="RIG.TOML", type=click.Path(path_type=Path))
@click.argument("recording", metavar="OUT.MCAP", type=click.Path(path_type=Path))
@click.option("--max-frames", metavar="N", type=click.IntRange(min=1), help="Stop after N frames.")
@images_option
@give_up_option
def record(
    rig_file: Path,
    recording: Path,
    max_frames: int | None,
    images: str | None,
    give_up_after_s: float | None,
) -> None:
    """Record the views of a rig, without following a hand.

    `fingerpost replay OUT.MCAP` follows it afterwards; Foxglove, Lichtblick and Rerun open the file
    as well. Ctrl-C ends the recording. What is older than a second is on the disk: after a crash
    `fingerpost recover` gets it back.
    """
    with ending_at_once():
        need_opencv()
        from fingerpost.admission import Admission
        from fingerpost.capture import SourceKind, open_views, read_views
        from fingerpost.config import Rig
        from fingerpost.pipeline import at_most

    rig = Rig.load(rig_file)
    check_recording(recording)
    keep_apart({"OUT.MCAP": recording}, rig_files(rig_file, rig))
    hush_streams(rig.sources)
    admission = Admission(rig.views)
    sources: list[Source] = []
    notes: list[str] = []
    count, started_s, shown_s = 0, time.monotonic(), 0.0
    try:
        with ending_as_interrupted(), ExitStack() as stack:
            line = stack.enter_context(status_line())
            sources = stack.enter_context(open_views(rig.sources, rig.readings))
            is_live = sources[0].kind is SourceKind.LIVE
            recorder = stack.enter_context(
                open_recorder(recording, rig, sources, images, is_live=is_live)
            )
            frames = at_most(read_views(sources, give_up_after_s=give_up_after_s), max_frames)
            for seen in recorder.watch(frames):
                admission.admit(seen)
                count += 1
                elapsed_s = time.monotonic() - started_s
                if line is not None and elapsed_s > shown_s + _SHOWN_S:
                    shown_s = elapsed_s
                    line.show(f"recording: {count} frames of each view in {elapsed_s:.1f} s")
                notes = recorder.notes()
    except RecordingError:
        count = 0  # fewer are in the file
        raise
    finally:
        notes = [*source_notes(rig.sources, sources), *notes]
        if count:
            elapsed_s = time.monotonic() - started_s
            click.echo(f"{recording}: {count} frames of each view in {elapsed_s:.1f} s")
        for note in notes:
            click.echo(f"        {note}")
