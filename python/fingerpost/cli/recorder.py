"""Recording of a session by commands."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

import click

import fingerpost
from fingerpost.errors import InvalidInputError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from fingerpost.capture import Source
    from fingerpost.config import Rig
    from fingerpost.recording.session import Recorder

SUFFIX = ".mcap"


def _named(_context: click.Context, _parameter: click.Parameter, path: Path | None) -> Path | None:
    """Refuse a name that is not a recording's, before anything is opened."""
    if path is not None:
        check_recording(path)
    return path


_record = click.option(
    "--record",
    metavar="R.MCAP",
    type=click.Path(path_type=Path),
    callback=_named,
    help="Record frames and fixes; `fingerpost replay` gives the same again.",
)

images_option = click.option(
    "--images",
    type=click.Choice(["png", "jpeg"]),
    help="How images are recorded that are neither JPEG nor PNG already: without loss, or with "
    "quality 95.  [default: png, jpeg of live views]",
)
"""Adds the parameter `images` to a command."""


def record_options(command: Callable[..., None]) -> Callable[..., None]:
    """Add the parameters `record` and `images` to a command."""
    return _record(images_option(command))


def check_recording(path: Path) -> None:
    """Refuse a name that is not a recording's.

    Raises
    ------
    InvalidInputError
        It does not end in .mcap.
    """
    if path.suffix != SUFFIX:
        raise InvalidInputError(f"{path}: a recording's name ends in {SUFFIX}")


def open_recorder(
    path: Path, rig: Rig, sources: Sequence[Source], images: str | None, *, is_live: bool
) -> Recorder:
    """Begin to record the views of a rig.

    Parameters
    ----------
    path
        The recording, which must not exist.
    rig
        The rig.
    sources
        Open sources of its views.
    images
        "png" or "jpeg", for images that are neither; None chooses by the sources.
    is_live
        Whether times are the machine's clock's; then steps are dropped rather than waited for.

    Raises
    ------
    InvalidInputError
        A name that does not end in .mcap, or a file that exists or cannot be created.
    MissingExtraError
        The extra `mcap` is not installed.
    """
    from msgspec import structs

    from fingerpost.recording.session import About, Images, Recorder

    check_recording(path)
    views = tuple(view.recorded_as(f"{path.name}#{view.name}") for view in rig.views)
    about = About(
        version=fingerpost.__version__,
        views=tuple(rig.sources),
        sources=tuple(source.name for source in sources),
        started=datetime.now().astimezone().isoformat(timespec="seconds"),
        unit=rig.plane.unit,
        is_live=is_live,
    )
    return Recorder(
        path,
        about,
        structs.replace(rig, views=views).dumps(),
        [view.lens for view in rig.views],
        images=Images(images or ("jpeg" if is_live else "png")),
    )
