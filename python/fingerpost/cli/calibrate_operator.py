"""`fingerpost calibrate-operator`: by how much a person points beside known targets."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fingerpost.cli.endings import ending_as_interrupted
from fingerpost.cli.keys import TAKE_KEY, has_keys, pressed_keys
from fingerpost.cli.live_status import LiveStatus
from fingerpost.cli.live_views import give_up_option, hush_streams
from fingerpost.cli.outputs import keep_apart, rig_files
from fingerpost.cli.progress import StatusLine, status_line, watched
from fingerpost.errors import InvalidInputError
from fingerpost.installation import need_opencv
from fingerpost.signals import ending_at_once

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from fingerpost.calibration import Calibration, Place, Visit
    from fingerpost.config import Rig
    from fingerpost.operators import Operator
    from fingerpost.pipeline import Step

    Fixes = Iterator[tuple[float, NDArray[np.float64] | None]]

_FILE = click.Path(path_type=Path)


@click.command("calibrate-operator")
@click.argument("rig_file", metavar="RIG.TOML", type=_FILE)
@click.option(
    "--operator", "name", metavar="NAME", required=True, help="Who points; or a .toml file for it."
)
@click.option(
    "--targets",
    metavar="'X,Y; ...'",
    help="Point at these places, in plane units, not at the [[target]]s of the rig.",
)
@click.option(
    "--dwell",
    "dwell_s",
    metavar="S",
    type=click.FloatRange(0.1, 60.0),
    default=1.0,
    show_default=True,
    help="Stay so long on each; the space bar takes it at once.",
)
@click.option(
    "--points",
    metavar="P.CSV",
    type=_FILE,
    help="Take the fixes that `fingerpost run --points` wrote, not the rig's views.",
)
@click.option(
    "--visits",
    metavar="V.CSV",
    type=_FILE,
    help="Take from when to when each was pointed at from a table: target,begin_s,end_s.",
)
@give_up_option
def calibrate_operator(
    rig_file: Path, name: str, points: Path | None, visits: Path | None, **asked: Any
) -> None:
    """Estimate by how much a person points beside what he means.

    Point at five or more targets of the rig, one after another in their order, and stay on each;
    live or in a recording. The habit is kept under the person's name, and `fingerpost run
    RIG.TOML --operator NAME` subtracts it.
    """
    with ending_at_once():
        need_opencv()
        from fingerpost.calibration import habit_of, places_in, places_of, refuse_too_few
        from fingerpost.config import Rig
        from fingerpost.operators import Operator, operator_file

    rig = Rig.load(rig_file)
    path = operator_file(name)
    keep_apart({"--operator": path}, _read(rig_file, rig, points, visits))
    places = places_of(rig) if asked["targets"] is None else places_in(asked["targets"])
    refuse_too_few(places)
    seen = _visits(rig, places, points, visits, asked)
    operator = Operator(path.stem, rig.plane.unit, habit_of(seen))
    operator.save(path)
    click.echo("\n".join(_summary(seen, operator)))
    click.echo(f"saved          {path}\nuse it         fingerpost run {rig_file} --operator {name}")


def _read(
    rig_file: Path, rig: Rig, points: Path | None, visits: Path | None
) -> Iterator[tuple[str, Path]]:
    """Yield the input files for `keep_apart`: those of the views only without a table."""
    if points is None:
        yield from rig_files(rig_file, rig)
    else:
        yield from (("the rig file", rig_file), ("the table of fixes", points))
    if visits is not None:
        yield "the table of visits", visits


def _visits(
    rig: Rig,
    places: Sequence[Place],
    points: Path | None,
    visits: Path | None,
    asked: dict[str, Any],
) -> list[Visit]:
    """Collect the visits from the chosen input."""
    from fingerpost.calibration import Calibration, read_stays, visits_of

    stays = None if visits is None else read_stays(visits)
    calibration = Calibration(places, asked["dwell_s"]) if stays is None else None
    with ending_as_interrupted(), ExitStack() as stack:
        fixes = (
            _followed(rig, calibration, asked["give_up_after_s"], stack)
            if points is None
            else _tabled(points)
        )
        if calibration is None:
            return visits_of(places, stays or [], fixes)
        for time_s, point in fixes:
            calibration.take(time_s, point)
            if calibration.next is None:
                break
    return _complete(calibration, len(places), asked["dwell_s"])


def _complete(calibration: Calibration, count: int, dwell_s: float) -> list[Visit]:
    """Return the visits of an ended session; refuse too few."""
    from fingerpost.habit import MIN_TARGETS

    seen, missing = calibration.visits, calibration.next
    if missing is None:
        return seen
    words = (
        f"{len(seen)} of {count} targets were pointed at, in their order; none was stayed on for "
        f'{dwell_s:g} s after that, where "{missing.name}" was next'
    )
    if len(seen) < MIN_TARGETS:
        raise InvalidInputError(
            f"{words}; --dwell S says how long, --visits V.CSV when each was pointed at"
        )
    click.echo(words, err=True)
    return seen


def _tabled(path: Path) -> Fixes:
    import numpy as np

    from fingerpost.recording import read_points

    for row in read_points(path):
        yield row.time_s, None if row.x is None or row.y is None else np.array([row.x, row.y])


def _followed(
    rig: Rig, calibration: Calibration | None, give_up_after_s: float | None, stack: ExitStack
) -> Fixes:
    """Follow the hand in the views; with cameras, prompt for the targets."""
    from fingerpost.capture import SourceKind, open_views, read_views
    from fingerpost.pipeline import Pointer, steps

    pointer = Pointer(rig)
    hush_streams(rig.sources)
    sources = stack.enter_context(open_views(rig.sources, rig.readings))
    frames = read_views(sources, give_up_after_s=give_up_after_s)
    if sources[0].kind is not SourceKind.LIVE or calibration is None:
        counts = [source.frame_count for source in sources if source.frame_count]
        for step in steps(pointer, watched(frames, min(counts, default=None), "tracking")):
            yield step.fix.time_s, step.fix.point
        return
    line = stack.enter_context(status_line())
    pressed = stack.enter_context(pressed_keys())
    prompt = _Prompt(calibration, line, takes_key=has_keys())
    size = pointer.plane_views[0].plane_size
    status = (
        None
        if line is None
        else LiveStatus(line, unit=rig.plane.unit, plane_size=size, clock=time.monotonic)
    )
    yield from _prompted(steps(pointer, frames), calibration, prompt, pressed, status)


def _prompted(
    followed: Iterable[Step],
    calibration: Calibration,
    prompt: _Prompt,
    pressed: deque[str],
    status: LiveStatus | None = None,
) -> Fixes:
    """Yield the fixes of steps; between them, handle keys and prompt for the targets."""
    prompt.say()
    for step in followed:
        yield step.fix.time_s, step.fix.point
        while pressed:
            if pressed.popleft() == TAKE_KEY and calibration.press() is None:
                prompt.refuse()
        prompt.say()
        if calibration.next is None:
            return
        if status is not None:
            status.take(step)


class _Prompt:
    """Announces each next target once."""

    def __init__(self, calibration: Calibration, line: StatusLine | None, *, takes_key: bool):
        self._calibration = calibration
        self._line = line
        self._key = ", or press the space bar" if takes_key else ""
        self._said = -1

    def say(self) -> None:
        """Announce the target to point at, if it has changed."""
        place, number = self._calibration.next, len(self._calibration.visits)
        if place is None or number == self._said:
            return
        self._said = number
        x, y = place.point.tolist()
        self._print(
            f'{number + 1}: point at "{place.name}" ({x:g}, {y:g}) and stay there{self._key}'
        )

    def refuse(self) -> None:
        """Report that a key was ignored for want of points."""
        self._print("no point just now: hold the hand so that two views follow it")

    def _print(self, words: str) -> None:
        if self._line is not None:
            self._line.clear()
        click.echo(words, err=True)


def _summary(visits: Sequence[Visit], operator: Operator) -> list[str]:
    """Return the result as lines of text for a person."""
    import numpy as np

    habit, unit = operator.habit, operator.unit
    off = habit.points - habit.targets
    left = np.hypot(*(off - habit.error(habit.points)).T)
    width = max(len("target"), *(len(visit.place.name) for visit in visits))
    lines = [f"{'target':<{width}}   {'off by':^19}   left over / {unit}"]
    lines += [
        f"{visit.place.name:<{width}}   {x:+8.4g}, {y:+8.4g}    {rest:9.3g}"
        for visit, (x, y), rest in zip(visits, off.tolist(), left.tolist(), strict=True)
    ]
    usual = float(np.sqrt(np.mean(np.sum(off**2, axis=1))))
    others = ", ".join(f"{model} {error:.3g}" for model, error in habit.left_out.items())
    return [
        *lines,
        f"habit          {usual:.3g} {unit}, {habit.model}; scatter {habit.scatter:.3g} {unit}",
        f"one left out   {others} {unit}",
    ]
