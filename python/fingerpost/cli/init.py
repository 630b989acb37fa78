"""`fingerpost init`: from cameras or films to a rig file."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fingerpost.cli.live_views import give_up_option, hush_streams
from fingerpost.cli.outputs import keep_apart, rig_files
from fingerpost.cli.progress import watched
from fingerpost.errors import FingerpostError, InvalidInputError
from fingerpost.installation import need_opencv
from fingerpost.signals import ending_at_once

if TYPE_CHECKING:
    from fingerpost.config import Rig
    from fingerpost.setting_up import SetUp

_FILE = click.Path(path_type=Path)


class _FromMany(click.Command):
    """Parses `--from A B C` as `--from A --from B --from C`."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        spread, is_source, count = [], False, 0
        for arg in args:
            if arg == "--from":
                is_source, count = True, 0
                continue
            if arg.startswith("-") and arg != "-":
                is_source = False
            if is_source:
                spread += ["--from", arg]
                count += 1
            else:
                spread.append(arg)
        return super().parse_args(ctx, spread)


@click.command(cls=_FromMany)
@click.option(
    "--from",
    "sources",
    metavar="SOURCE SOURCE ...",
    multiple=True,
    help="Films, globs of images in quotes, camera numbers or URLs, two or more.",
)
@click.option(
    "--plane",
    metavar="SIZE",
    help="What lies on the table: A4, letter, A3, credit-card, WxH in mm such as 350x220, or "
    "markers (a sheet of `fingerpost markers`; markers:letter for another paper).",
)
@click.option(
    "-o", "--output", metavar="RIG.TOML", type=_FILE, help="The rig file.  [default: rig.toml]"
)
@click.option(
    "--picture",
    metavar="P.PNG",
    type=_FILE,
    help="The picture of what was found.  [default: beside the rig file]",
)
@click.option(
    "--near",
    metavar="VIEW=U,V",
    multiple=True,
    help="A pixel inside of the rectangle in a view, where there are several.",
)
@click.option(
    "--frames",
    metavar="N",
    type=click.IntRange(min=1),
    help="Frames of each view to look at.  [default: 300]",
)
@click.option("--force", is_flag=True, help="Write over a rig file that exists.")
@give_up_option
def init(
    sources: tuple[str, ...],
    plane: str | None,
    output: Path | None,
    picture: Path | None,
    near: tuple[str, ...],
    frames: int | None,
    force: bool,
    give_up_after_s: float | None,
) -> None:
    """Find the rectangle and the hand in every view, and write a rig file that `run` takes.

    Lay a sheet of paper, a mat or any other rectangle of known size on the table, in full view of
    all cameras, and point at it. What is not given as an option is asked for on a terminal.
    """
    with ending_at_once():
        need_opencv()
        from fingerpost.recording import check_picture, write_picture
        from fingerpost.setting_up import reference_of, rig_of

    asks = _is_terminal()
    given = list(sources) or _asked_sources(asks)
    words = plane or _asked(
        asks, "--plane", "Size of the rectangle on the table", "A4", check=reference_of
    )
    output = output or Path(_asked(asks, "-o", "Rig file", "rig.toml") if asks else "rig.toml")
    picture = picture or output.with_suffix(".png")
    rig = rig_of([_source(name) for name in given], reference_of(words), _near(near))
    keep_apart({"-o": output, "--picture": picture}, [*rig_files(output, rig)][1:])
    check_picture(picture)
    may_write = force or not output.exists()
    may_write = may_write or (asks and _confirmed(f"{output} exists. Overwrite?", default=False))
    if not may_write:
        raise InvalidInputError(f"{output}: exists already; --force writes over it")
    found = _found(rig, frames, give_up_after_s)
    write_picture(picture, found.picture)
    click.echo("\n".join(found.lines))
    click.echo(f"picture   {picture}")
    if asks and not _confirmed("Is that right?", default=True):
        raise InvalidInputError("--near VIEW=U,V says which rectangle is meant")
    found.rig.save(output)
    click.echo(f"rig file  {output}")
    for name in found.without_hand:
        click.echo(
            f'fingerpost: view "{name}": no hand is found; hold it over the table with the index '
            "finger out, in sight of every camera",
            err=True,
        )


def _found(rig: Rig, count: int | None, give_up_after_s: float | None) -> SetUp:
    """Search the frames of all views until everything is found."""
    from fingerpost.capture import SourceKind, open_views, read_views
    from fingerpost.pipeline import at_most
    from fingerpost.setting_up import DEFAULT_FRAMES, set_up

    hush_streams(rig.sources)
    with ExitStack() as stack:
        views = stack.enter_context(open_views(rig.sources, rig.readings))
        most = count or DEFAULT_FRAMES
        if views[0].kind is SourceKind.RECORDED:
            most = min([most, *(view.frame_count for view in views if view.frame_count)])
        frames = at_most(read_views(views, give_up_after_s=give_up_after_s), most)
        return set_up(rig, watched(frames, most, "looking"))


def _is_terminal() -> bool:
    return all(stream is not None and stream.isatty() for stream in (sys.stdin, sys.stderr))


def _asked(
    asks: bool, option: str, question: str, default: str, check: Callable[[str], object] = str
) -> str:
    if not asks:
        raise click.UsageError(f"{option} is missing; such as {option} {default}")
    return _answered(question, check, default=default)


def _asked_sources(asks: bool) -> list[str]:
    if not asks:
        raise click.UsageError(
            "--from is missing; such as --from left.mp4 right.mp4, or --from 0 1"
        )
    _show_cameras()
    names: list[str] = []
    while True:
        question = f"View {len(names) + 1}: film, camera number or URL"
        is_enough = len(names) >= 2
        question += " (empty: no more)" if is_enough else ""
        options: dict[str, Any] = {"default": "", "show_default": False} if is_enough else {}
        answer = _answered(question, partial(_check_source, names), **options)
        if not answer:
            return names
        names.append(answer)


def _answered(question: str, check: Callable[[str], object], **options: Any) -> str:
    """Ask until an answer passes its check."""

    def checked(answer: str) -> str:
        answer = answer.strip()
        try:
            check(answer)
        except FingerpostError as error:
            # Makes click ask again.
            raise click.UsageError(str(error)) from error
        return answer

    with _ended_line():
        return str(click.prompt(question, value_proc=checked, err=True, **options))


def _confirmed(question: str, *, default: bool) -> bool:
    with _ended_line():
        return click.confirm(question, default=default, err=True)


@contextmanager
def _ended_line() -> Iterator[None]:
    """Begin a new line if a prompt is not answered because of Ctrl-C or the end of input."""
    try:
        yield
    except click.Abort:
        click.echo(err=True)
        raise


def _check_source(before: Sequence[str], answer: str) -> None:
    """Refuse a file that does not exist, or that another view reads."""
    from fingerpost.capture import is_camera_name, is_url, refuse_repeated, source_files

    if not answer and len(before) >= 2:
        return
    source = _source(answer)
    if source == "-":
        raise InvalidInputError("-: a terminal sends no frames; a named pipe does")
    # Path.exists would raise for a name that is too long.
    exists = [os.path.exists(file) for file in source_files(source)]  # noqa: PTH110
    if (
        isinstance(source, str)
        and not (is_url(source) or (exists and all(exists)))
        and not is_camera_name(source)
    ):
        raise InvalidInputError(f"{answer}: no such file")
    refuse_repeated({f"view {k + 1}": _source(name) for k, name in enumerate([*before, answer])})


def _show_cameras() -> None:
    """Print the connected cameras with the numbers that are asked for."""
    from fingerpost.capture import list_cameras

    for camera in list_cameras():
        click.echo(f"camera {camera.number}  {camera.name or camera.trouble}", err=True)


def _source(name: str) -> str | int:
    return int(name) if name.isascii() and name.isdecimal() else name


def _near(given: tuple[str, ...]) -> dict[str, tuple[float, float]]:
    """Parse the pixels of --near, by view."""
    near = {}
    for words in given:
        view, _, place = words.rpartition("=")
        try:
            u, v = (float(number) for number in place.split(","))
        except ValueError:
            raise click.UsageError(f"--near {words}: such as --near left=320,240") from None
        near[view] = (u, v)
    return near
