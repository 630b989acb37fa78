"""`fingerpost doctor`: what is wrong with the pictures and the rig file, or the installation."""

from __future__ import annotations

import json
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

import click

from fingerpost.cli.live_views import hush_streams
from fingerpost.cli.progress import watched
from fingerpost.errors import InvalidInputError, MissingExtraError
from fingerpost.installation import Installation, examine_installation, need_opencv
from fingerpost.signals import ending_at_once

if TYPE_CHECKING:
    from fingerpost.doctor import Diagnosis

SERIOUS = 1


@click.command()
@click.argument("rig_file", metavar="[RIG.TOML]", required=False, type=click.Path(path_type=Path))
@click.option(
    "--frames",
    metavar="N",
    type=click.IntRange(min=1),
    help="Frames of each view to look at.  [default: 120]",
)
@click.option("--json", "as_json", is_flag=True, help="Print readings and findings as JSON.")
def doctor(rig_file: Path | None, frames: int | None, as_json: bool) -> None:
    """Look at some frames of every view and say what is wrong.

    Contrast, focus, exposure, noise, size of the hand, reference points, lens, frame rates: what,
    where and what would be right. Without a rig, look at the installation: whether OpenCV is whole,
    whether another one is beside it, and which extras, cameras and means to draw there are. Exits
    with 0 if nothing serious is found, with 1 if something prevents tracking (marked "error").
    """
    found: Installation | Diagnosis
    if rig_file is not None:
        found = _examined(rig_file, frames)
    elif frames is not None:
        raise click.UsageError("--frames goes with a rig file; name one")
    else:
        with ending_at_once():
            found = examine_installation(_surroundings())
    click.echo(json.dumps(found.as_dict()) if as_json else "\n".join(found.table()))
    if found.serious:
        sys.exit(SERIOUS)


def _surroundings() -> dict[str, str]:
    """Return the machine's cameras, and the renderer of the simulated robot."""
    try:
        from fingerpost.capture import list_cameras
        from fingerpost.closed_loop.engine import require_mujoco

        found = [camera.name or f"number {camera.number}" for camera in list_cameras()]
    except ImportError:  # OpenCV is broken: reported as another finding
        return {}
    cameras = ", ".join(found) or "none found"
    try:
        require_mujoco()
    except MissingExtraError as error:
        return {"cameras": cameras, "drawing": str(error)}
    return {"cameras": cameras, "drawing": "EGL" if sys.platform == "linux" else "by the system"}


def _examined(rig_file: Path, frames: int | None) -> Diagnosis:
    """Examine some frames of every view of a rig."""
    with ending_at_once():
        need_opencv()
        from fingerpost.capture import Frame, open_views
        from fingerpost.config import Rig
        from fingerpost.doctor import DEFAULT_FRAMES, examine, look, reduced
        from fingerpost.locating import ReferenceSearch

    rig = Rig.load(rig_file)
    count = DEFAULT_FRAMES if frames is None else frames
    seen: list[list[Frame]] = [[] for _ in rig.views]
    sizes_px = [(0, 0) for _ in rig.views]
    hush_streams(rig.sources)
    search = ReferenceSearch(rig)
    known = None if ReferenceSearch.is_needed(rig) else rig
    with ExitStack() as stack:
        sources = stack.enter_context(open_views(rig.sources, rig.readings))
        for together in watched(look(sources, count), count, "looking"):
            if known is None:
                known = search.look(
                    {k: seen.image for k, seen in enumerate(together) if isinstance(seen, Frame)}
                )
            for k, frame in enumerate(together):
                if isinstance(frame, Frame):
                    sizes_px[k] = (frame.image.shape[1], frame.image.shape[0])
                    seen[k].append(reduced(frame))
        for source in sources:
            source.refuse_unsound()
        damage = [source.damage for source in sources]
        notes = [
            f"{view}: {note}"
            for view, source in zip(rig.sources, sources, strict=True)
            for note in source.notes
        ]
    known = known or search.agreed()
    if known is None:
        raise InvalidInputError("; ".join(search.missing.values()))
    return examine(known, seen, sizes_px, damage=damage, notes=notes)
