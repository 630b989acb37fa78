"""`fingerpost run`: a rig's views in, fixes out."""

from __future__ import annotations

import dataclasses
import json
import sys
import time
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack, closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fingerpost.cli.endings import ending_as_interrupted
from fingerpost.cli.live_status import LiveStatus
from fingerpost.cli.live_views import give_up_option, hush_streams
from fingerpost.cli.outputs import keep_apart, rig_files
from fingerpost.cli.progress import StatusLine, status_line, watched
from fingerpost.cli.run_summary import RunSummary, source_notes
from fingerpost.installation import need_opencv
from fingerpost.signals import ending_at_once

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from fingerpost.capture import Source
    from fingerpost.config import Rig
    from fingerpost.pipeline import Pointer, Step
    from fingerpost.recording import TableWriter, TrackRow

_OVERLAY_FPS = 25.0
_OVERLAY_TRAIL = 40  # points that the plan shows behind the newest one

_OUT = click.Path(path_type=Path)


@click.command()
@click.argument("rig_file", metavar="RIG.TOML", type=click.Path(path_type=Path))
@click.option("--points", metavar="P.CSV", type=_OUT, help="Write the fixes, one row a frame.")
@click.option("--tracks", metavar="T.CSV", type=_OUT, help="Write the finger lines of every view.")
@click.option("--overlay", metavar="O.MP4", type=_OUT, help="Write a video that shows both.")
@click.option("--max-frames", metavar="N", type=click.IntRange(min=1), help="Stop after N frames.")
@give_up_option
@click.option(
    "--model",
    type=click.Choice(["ribbon", "paper"]),
    default="ribbon",
    show_default=True,
    help="The hand: bands of their own width, or the planar template of 1994.",
)
@click.option(
    "--reference-noise",
    "reference_sigma_px",
    metavar="PX",
    type=float,
    help="Sigma of reference points for which the rig file gives no covariance, px.  "
    "[default: 0.5]",
)
@click.option(
    "--json",
    "as_json",
    is_flag=True,
    help="Print one JSON object a frame, no summary; one with notes at the end if there are any.",
)
def run(
    rig_file: Path,
    points: Path | None,
    tracks: Path | None,
    overlay: Path | None,
    max_frames: int | None,
    give_up_after_s: float | None,
    model: str,
    reference_sigma_px: float | None,
    as_json: bool,
) -> None:
    """Track a hand in every view of a rig and tell where on the plane it points.

    RIG.TOML names the views (video files, globs of images, camera numbers or URLs), the plane and
    where the hand is first seen. A live view that sends nothing is lost until it comes back; a
    damaged picture is lost for its view. Ctrl-C ends a run; what was written stays, and the summary
    tells of the frames until then.
    """
    with ending_at_once():
        need_opencv()
        from fingerpost.capture import SourceKind, open_views, read_views
        from fingerpost.config import Rig
        from fingerpost.pipeline import Pointer, at_most, steps

    rig = Rig.load(rig_file)
    written = {"--points": points, "--tracks": tracks, "--overlay": overlay}
    keep_apart(written, rig_files(rig_file, rig))
    known = _reference_noise(rig, reference_sigma_px)
    pointer = Pointer(rig, tracker_options={"model": model}, **known)
    hush_streams(rig.sources)
    summary = RunSummary()
    sources: list[Source] = []
    started_s = time.monotonic()
    try:
        with ending_as_interrupted(), ExitStack() as stack:
            line = None if as_json and sys.stdout.isatty() else stack.enter_context(status_line())
            if line is not None:
                line.show(f"opening {', '.join(rig.sources)}")
            sources = stack.enter_context(open_views(rig.sources, rig.offsets_s))
            takers = _takers(stack, pointer, rig.plane.unit, points, tracks, overlay, as_json)
            frames = at_most(read_views(sources, give_up_after_s=give_up_after_s), max_frames)
            if line is not None:
                line.clear()
                counts = [n for n in (max_frames, *(source.frame_count for source in sources)) if n]
                if counts and sources[0].kind is SourceKind.RECORDED:
                    bar = watched(frames, min(counts), "tracking")
                    frames = stack.enter_context(closing(bar))
                else:
                    takers.append(_live_status(line, pointer, rig.plane.unit))
            started_s = time.monotonic()
            for step in steps(pointer, frames):
                summary.add(step.fix)
                for take in takers:
                    take(step)
    finally:
        notes = [*source_notes(rig.sources, sources), *pointer.notes()]
        if summary.frames and not as_json:
            click.echo("\n".join(summary.lines(time.monotonic() - started_s, notes)))
        if notes and as_json:
            click.echo(json.dumps({"notes": notes}))


def _reference_noise(rig: Rig, sigma_px: float | None) -> dict[str, Any]:
    """Give the option of `Pointer` that --reference-noise sets; refuse it where it sets nothing."""
    if sigma_px is None:
        return {}
    if all(view.reference_covariances_px2 for view in rig.views):
        raise click.UsageError(
            "--reference-noise would do nothing: every view has its own reference_covariances_px2"
        )
    return {"reference_sigma_px": sigma_px}


def _live_status(line: StatusLine, pointer: Pointer, unit: str) -> Callable[[Step], None]:
    plane_size = pointer.plane_views[0].plane_size
    return LiveStatus(line, unit=unit, plane_size=plane_size, clock=time.monotonic).take


def _takers(
    stack: ExitStack,
    pointer: Pointer,
    unit: str,
    points: Path | None,
    tracks: Path | None,
    overlay: Path | None,
    as_json: bool,
) -> list[Callable[[Step], None]]:
    """Everything that takes the steps as they come: tables, video, standard output."""
    from fingerpost.recording import write_points, write_tracks

    takers: list[Callable[[Step], None]] = []
    if points:
        point_table = stack.enter_context(write_points(points))
        takers.append(lambda step: point_table.write(step.point_row()))
    if tracks:
        track_table = stack.enter_context(write_tracks(tracks))
        takers.append(lambda step: _write_tracks(track_table, step))
    if overlay:
        takers.append(_overlay_video(stack, overlay, pointer, unit))
    if as_json:
        takers.append(lambda step: click.echo(json.dumps(dataclasses.asdict(step.point_row()))))
    return takers


def _write_tracks(table: TableWriter[TrackRow], step: Step) -> None:
    for observation in step.observations:
        row = observation.track_row()
        if row is not None:
            table.write(row)


def _overlay_video(
    stack: ExitStack, path: Path, pointer: Pointer, unit: str
) -> Callable[[Step], None]:
    from fingerpost.recording import VideoWriter
    from fingerpost.recording.picture import Composition

    video = stack.enter_context(VideoWriter(path, fps=_OVERLAY_FPS))
    compositions: list[Composition] = []  # one, from when the views know the plane
    trail: deque[NDArray[np.float64]] = deque(maxlen=_OVERLAY_TRAIL)

    def take(step: Step) -> None:
        views = [observation.plane_view for observation in step.observations]
        if not pointer.sees_plane:
            return
        if not compositions:
            compositions.append(Composition(pointer.plane_views, unit=unit, edges=True))
        video.write(
            compositions[0].draw(step.observations, step.fix, trail=list(trail), plane_views=views)
        )
        if step.fix.point is not None:
            trail.append(step.fix.point)

    return take
