"""Common part of `run` and `replay`: a rig's views in, fixes out into tables and videos."""

from __future__ import annotations

import dataclasses
import json
import sys
import time
import tomllib
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fingerpost.cli.endings import ending_as_interrupted
from fingerpost.cli.events import EVENT_OPTIONS, STDOUT, event_taker
from fingerpost.cli.live_status import LiveStatus
from fingerpost.cli.live_views import hush_streams
from fingerpost.cli.operators import operator_called, operator_option
from fingerpost.cli.progress import StatusLine, status_line, watched
from fingerpost.cli.publishing import prints_fixes, publish_option
from fingerpost.cli.run_summary import RunSummary, source_notes
from fingerpost.cli.session_outputs import SessionOutputs

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from fingerpost.capture import Frame, Loss, Source
    from fingerpost.config import Rig
    from fingerpost.pipeline import Pointer, Step
    from fingerpost.recording import TableWriter, TrackRow

SETTING_EXAMPLE = "search.blur_px=1.5"

_OVERLAY_TRAIL = 40  # points that the plan shows behind the newest one

_OUT = click.Path(path_type=Path)


@dataclass(frozen=True, kw_only=True)
class Following:
    """Requested uses of the fixes; one attribute per parameter of the command."""

    points: Path | None = None
    tracks: Path | None = None
    overlay: Path | None = None
    events: Path | None = None
    dwell_s: float = 1.0
    record: Path | None = None
    images: str | None = None
    max_frames: int | None = None
    start_s: float = 0.0
    give_up_after_s: float | None = None
    model: str = "ribbon"
    settings: tuple[str, ...] = ()
    reference_sigma_px: float | None = None
    operator: str | None = None
    publish: Sequence[str] = ()
    speed: float | None = None
    as_json: bool = False

    @property
    def written(self) -> dict[str, Path | None]:
        """Files that will be written, by their options."""
        return {
            "--points": self.points,
            "--tracks": self.tracks,
            "--overlay": self.overlay,
            "--events": None if self.events == STDOUT else self.events,
            "--record": self.record,
        }

    @property
    def prints_lines(self) -> bool:
        """Whether standard output is lines of JSON only."""
        return self.as_json or self.events == STDOUT or prints_fixes(self.publish)

    def pointer(self, rig: Rig) -> Pointer:
        """Return the pointer for a rig's views with these options."""
        from fingerpost.pipeline import Pointer

        known = _reference_noise(rig, self.reference_sigma_px)
        options = settings_of(self.model, self.settings)
        operator = operator_called(self.operator)
        return Pointer(rig, tracker_options=options, operator=operator, **known)


_TRACKER_OPTIONS = (
    click.option(
        "--model",
        type=click.Choice(["ribbon", "paper"]),
        default="ribbon",
        show_default=True,
        help="The hand: bands of their own width, or the planar template of 1994.",
    ),
    click.option(
        "--set",
        "settings",
        metavar="KEY=VALUE",
        multiple=True,
        help=f"Set an option of the tracker, as in {SETTING_EXAMPLE}.",
    ),
)

_OPTIONS = (
    click.option("--points", metavar="P.CSV", type=_OUT, help="Write the fixes, one row a frame."),
    click.option(
        "--tracks", metavar="T.CSV", type=_OUT, help="Write the finger lines of every view."
    ),
    click.option("--overlay", metavar="O.WEBM", type=_OUT, help="Write a video that shows both."),
    *EVENT_OPTIONS,
    click.option(
        "--start",
        "start_s",
        metavar="S",
        type=click.FloatRange(0.0, 1e9),
        default=0.0,
        help="Begin S seconds after the first frame of recorded views.",
    ),
    click.option(
        "--max-frames", metavar="N", type=click.IntRange(min=1), help="Stop after N frames."
    ),
    click.option(
        "--reference-noise",
        "reference_sigma_px",
        metavar="PX",
        type=float,
        help="Sigma of reference points for which the rig file gives no covariance, px.  "
        "[default: 0.5]",
    ),
    operator_option,
    publish_option,
    click.option(
        "--speed",
        type=click.FloatRange(1e-3, 1e3),
        help="Play recorded views at their own pace times this, as receivers of --publish expect.  "
        "[default: as fast as they are followed]",
    ),
    click.option(
        "--json",
        "as_json",
        is_flag=True,
        help="Print one JSON object a frame, no summary; one with notes at the end if there are "
        "any.",
    ),
    *_TRACKER_OPTIONS,
)


def tracker_options(command: Callable[..., None]) -> Callable[..., None]:
    """Add the parameters of `settings_of` to a command."""
    for option in reversed(_TRACKER_OPTIONS):
        command = option(command)
    return command


def following_options(command: Callable[..., None]) -> Callable[..., None]:
    """Add the options that are attributes of `Following` to a command."""
    for option in reversed(_OPTIONS):
        command = option(command)
    return command


def follow(
    rig: Rig,
    asked: Following,
    take: Callable[[Step], None] | None = None,
    closing_words: Callable[[], list[str]] = list,
) -> None:
    """Follow the hand in all views of a rig; write and print the requested output.

    Parameters
    ----------
    rig
        The rig.
    asked
        Requested uses of the fixes.
    take
        Also called with every step.
    closing_words
        Returns the last lines of the summary.
    """
    from fingerpost.capture import SourceKind, at_speed, open_views, read_views
    from fingerpost.pipeline import at_most, steps

    if asked.events is not None and not rig.targets:
        raise click.UsageError("--events: the rig has no [[target]] to point at")
    pointer = asked.pointer(rig)
    hush_streams(rig.sources)
    summary = RunSummary()
    outputs = SessionOutputs(publish=asked.publish, record=asked.record, images=asked.images)
    sources: list[Source] = []
    started_s = time.monotonic()
    try:
        with ending_as_interrupted(), ExitStack() as stack:
            line = None
            if not (asked.prints_lines and sys.stdout.isatty()):
                line = stack.enter_context(status_line())
            if line is not None:
                line.show(f"opening {', '.join(rig.sources)}")
            sources = stack.enter_context(open_views(rig.sources, rig.readings))
            pointer.hold_back(sources)
            is_live = sources[0].kind is SourceKind.LIVE
            takers = _takers(stack, pointer, rig.plane.unit, asked, is_live)
            if asked.events is not None:
                takers.append(event_taker(stack, rig, asked.events, asked.dwell_s))
            frames: Iterator[Sequence[Frame | Loss | None]] = at_most(
                read_views(sources, give_up_after_s=asked.give_up_after_s, start_s=asked.start_s),
                asked.max_frames,
            )
            if asked.speed is not None:
                if is_live:
                    raise click.UsageError("--speed: live views come at their own pace")
                frames = at_speed(frames, asked.speed)
            stack.enter_context(outputs.opened(rig, sources, is_live=is_live))
            takers.append(outputs.take)
            frames = outputs.watch(frames)
            if take is not None:
                takers.append(take)
            if line is not None:
                line.clear()
                is_known = not (is_live or asked.start_s)
                count = _frame_count(asked.max_frames, sources) if is_known else None
                if count is None:
                    takers.append(_live_status(line, pointer, rig.plane.unit))
                else:
                    bar = watched(frames, count, "tracking")
                    frames = stack.enter_context(closing(bar))
            started_s = time.monotonic()
            for step in steps(pointer, frames):
                summary.add(step.fix)
                for taker in takers:
                    taker(step)
            if asked.start_s and not summary.frames:
                raise click.UsageError(f"--start {asked.start_s:g}: the views end before that")
    finally:
        notes = [*source_notes(rig.sources, sources), *pointer.notes(), *outputs.notes()]
        if asked.prints_lines:
            lines = [json.dumps({"notes": notes})] if notes else []
        elif summary.frames:
            lines = [*summary.lines(time.monotonic() - started_s, notes), *closing_words()]
        else:
            lines = []
        if lines:
            click.echo("\n".join(lines))


def _frame_count(max_frames: int | None, sources: Sequence[Source]) -> int | None:
    """Return the expected number of frames, if known."""
    counts = (max_frames, *(source.frame_count for source in sources))
    return min((count for count in counts if count), default=None)


def settings_of(model: str, settings: tuple[str, ...]) -> dict[str, Any]:
    """Return options of the tracker; each setting is a line of TOML."""
    try:
        return {"model": model, **tomllib.loads("\n".join(settings))}
    except tomllib.TOMLDecodeError as error:
        raise click.UsageError(
            f"--set {' '.join(settings)}: {error}; KEY=VALUE as in TOML is right, such as "
            f"{SETTING_EXAMPLE}"
        ) from error


def _reference_noise(rig: Rig, sigma_px: float | None) -> dict[str, Any]:
    """Return the option of `Pointer` for --reference-noise; refuse it if it has no effect."""
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
    asked: Following,
    is_live: bool,
) -> list[Callable[[Step], None]]:
    """Return the receivers of the steps: tables, video, standard output."""
    from fingerpost.recording import write_points, write_tracks

    takers: list[Callable[[Step], None]] = []
    if asked.points:
        point_table = stack.enter_context(write_points(asked.points))
        takers.append(lambda step: point_table.write(step.point_row()))
    if asked.tracks:
        track_table = stack.enter_context(write_tracks(asked.tracks))
        takers.append(lambda step: _write_tracks(track_table, step))
    if asked.overlay:
        takers.append(_overlay_video(stack, asked.overlay, pointer, unit, drops=is_live))
    if asked.as_json:
        takers.append(lambda step: click.echo(json.dumps(dataclasses.asdict(step.point_row()))))
    return takers


def _write_tracks(table: TableWriter[TrackRow], step: Step) -> None:
    for observation in step.observations:
        row = observation.track_row()
        if row is not None:
            table.write(row)


def _overlay_video(
    stack: ExitStack, path: Path, pointer: Pointer, unit: str, *, drops: bool
) -> Callable[[Step], None]:
    from fingerpost.recording import VideoWriter
    from fingerpost.recording.picture import Composition

    video = stack.enter_context(VideoWriter(path, fps=None, drops=drops))
    composition = Composition(pointer.plane_views, unit=unit, edges=True)
    trail: deque[NDArray[np.float64]] = deque(maxlen=_OVERLAY_TRAIL)

    def take(step: Step) -> None:
        views = [observation.plane_view for observation in step.observations]
        video.write(
            composition.draw(step.observations, step.fix, trail=list(trail), plane_views=views),
            step.fix.time_s,
        )
        if step.fix.point is not None:
            trail.append(step.fix.point)

    return take
