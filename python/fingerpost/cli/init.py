"""`fingerpost init`: from cameras or films to a rig file."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fingerpost.cli.live_views import give_up_option, hush_streams
from fingerpost.cli.outputs import keep_apart, rig_files
from fingerpost.cli.progress import watched
from fingerpost.cli.questions import answered, confirmed, is_terminal
from fingerpost.errors import InvalidInputError
from fingerpost.installation import need_opencv
from fingerpost.signals import ending_at_once

if TYPE_CHECKING:
    from fingerpost.config import Rig
    from fingerpost.setting_up import SetUp

RIG_FILE = "rig.toml"
"""Name of the rig file unless another is given."""

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

    asks = is_terminal()
    names = list(sources) or _asked_sources(asks)
    search = _Search(names, plane or _asked_plane(asks), _near(near), asks and not plane)
    rig = search.rig()
    rig_file = _rig_file(output, asks=asks, force=force)
    picture = picture or rig_file.with_suffix(".png")
    keep_apart({"-o": rig_file, "--picture": picture}, [*rig_files(rig_file, rig)][1:])
    check_picture(picture)
    while True:
        found = search.result(frames, give_up_after_s)
        write_picture(picture, found.picture)
        click.echo("\n".join([*found.lines, *found.hints]))
        click.echo(f"picture   {picture}")
        if not asks or confirmed("Is that right?", default=True):
            break
        search.correct()
    found.rig.save(rig_file)
    click.echo(f"rig file  {rig_file}")
    for name in found.without_hand:
        click.echo(
            f'fingerpost: view "{name}": no hand is found; hold it over the table with the index '
            "finger out, in sight of every camera",
            err=True,
        )


@dataclass
class _Search:
    """What is searched for, which a user at a terminal may correct."""

    names: Sequence[str]
    plane: str
    near_px: dict[str, tuple[float, float]]
    asks_again: bool
    """Whether a plane that is not found is asked for again."""

    def rig(self) -> Rig:
        """Return the rig whose references are to be found."""
        from fingerpost.setting_up import reference_of, rig_of

        sources = [_source(name) for name in self.names]
        return rig_of(sources, reference_of(self.plane), self.near_px)

    def result(self, frames: int | None, give_up_after_s: float | None) -> SetUp:
        """Search until the references are found."""
        from fingerpost.setting_up import NotFoundError

        while True:
            try:
                return _found(self.rig(), frames, give_up_after_s)
            except NotFoundError as error:
                if not self.asks_again:
                    raise
                click.echo(f"fingerpost: {error}", err=True)
                self._ask_plane()

    def correct(self) -> None:
        """Ask which rectangle is meant, or else for its size."""
        self.asks_again = True
        from fingerpost.config import RectangleReference

        view = self.rig().views[0]
        if isinstance(view.reference, RectangleReference):
            question = f"Pixel inside the right one, as {view.name}=320,240 (empty: another size)"
            if answer := answered(question, self._check_near, default="", show_default=False):
                self.near_px |= _near((answer,))
                return
        self._ask_plane()

    def _ask_plane(self) -> None:
        self.near_px.clear()
        self.plane = _asked_plane(asks=True)

    def _check_near(self, answer: str) -> None:
        if answer:
            replace(self, near_px=_near((answer,))).rig()


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


def _asked_plane(asks: bool) -> str:
    from fingerpost.setting_up import reference_of

    if not asks:
        raise click.UsageError("--plane is missing; such as --plane A4")
    question = "On the table lies: A4, letter, A3, credit-card, WxH in mm, or markers"
    return answered(question, reference_of, default="A4")


def _rig_file(given: Path | None, *, asks: bool, force: bool) -> Path:
    """Return the rig file; on a terminal, ask for another if one may not be written over."""
    if given is not None:
        _check_rig_file(str(given))
    path = given or (_asked_rig_file() if asks else Path(RIG_FILE))
    # Path.exists would raise for a name that is too long.
    while not force and os.path.exists(path):  # noqa: PTH110
        if not asks:
            raise InvalidInputError(f"{path}: exists already; --force writes over it")
        if confirmed(f"{path} exists. Overwrite?", default=False):
            break
        path = _asked_rig_file()
    return path


def _asked_rig_file() -> Path:
    return _path(answered("Rig file", _check_rig_file, default=RIG_FILE))


def _check_rig_file(answer: str) -> None:
    """Refuse a name that is a folder's, or that names another kind of file."""
    path = _path(answer)
    # Path.is_dir would raise for a name that is too long.
    if os.path.isdir(path):  # noqa: PTH112
        raise InvalidInputError(f"{answer}: is a folder; name a file, such as {path / RIG_FILE}")
    if not os.path.isdir(path.parent):  # noqa: PTH112
        raise InvalidInputError(
            f"{answer}: the folder {path.parent} does not exist; name a file in an existing folder"
        )
    if path.suffix.lower() not in ("", ".toml"):
        raise InvalidInputError(
            f"{answer}: a rig file's name ends in .toml, such as {path.with_suffix('.toml')}"
        )


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
        answer = answered(question, partial(_check_source, names), **options)
        if not answer:
            return names
        names.append(answer)


def _check_source(before: Sequence[str], answer: str) -> None:
    """Refuse a source that cannot be opened, or that another view reads."""
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
    _check_opens(source)


def _check_opens(source: str | int) -> None:
    """Open a source; but a pipe, whose writer a reader that leaves would end."""
    from fingerpost.capture import open_source

    if isinstance(source, str) and Path(source).is_fifo():
        return
    hush_streams({"": source})
    open_source(source).close()


def _show_cameras() -> None:
    """Print the connected cameras with the numbers that are asked for."""
    from fingerpost.capture import list_cameras

    for camera in list_cameras():
        click.echo(f"camera {camera.number}  {camera.name or camera.trouble}", err=True)


def _source(name: str) -> str | int:
    """Return the source that a name stands for; a shell leaves "~" in quotes as it is."""
    if name.isascii() and name.isdecimal():
        return int(name)
    return os.path.expanduser(name)  # noqa: PTH111 - a URL is no path


def _path(name: str) -> Path:
    return Path(os.path.expanduser(name))  # noqa: PTH111 - Path.expanduser raises without a home


def _near(given: tuple[str, ...]) -> dict[str, tuple[float, float]]:
    """Parse the pixels of --near, by view."""
    near = {}
    for words in given:
        view, _, place = words.rpartition("=")
        try:
            u, v = (float(number) for number in place.split(","))
        except ValueError:
            raise InvalidInputError(
                f"near is {words}; a view and a pixel are right, such as left=320,240"
            ) from None
        near[view] = (u, v)
    return near
