"""`fingerpost cameras`: which cameras are plugged in, and what each of them shows."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import TYPE_CHECKING

import click

from fingerpost.cli.camera_server import address_of, named, serve, settings_of
from fingerpost.errors import CaptureError
from fingerpost.installation import need_opencv
from fingerpost.signals import ending_at_once

if TYPE_CHECKING:
    from fingerpost.capture import Camera

NONE = "no camera found; plug one in, or name films, URLs or a pipe in the rig file"

_SHOWN_MODES = 6  # --json has all
_SETTLED_FRAMES = 10  # after which the exposure of most cameras has settled
_WIDTH_PX = 320


@click.command()
@click.argument("sources", metavar="[CAMERA...]", nargs=-1)
@click.option(
    "--publish",
    metavar="URL",
    help="Send the pictures of all cameras, or of those named, to rigs on other machines: "
    "zenoh://ADDRESS:PORT/KEY, where ADDRESS is this machine's.",
)
@click.option(
    "--set",
    "settings",
    metavar="KEY=VALUE",
    multiple=True,
    help="Ask the cameras that are published for it, as the key camera of a rig file does: "
    "width=1280.",
)
@click.option(
    "--thumbnails",
    "folder",
    metavar="DIR",
    type=click.Path(path_type=Path, file_okay=False),
    default=Path(),
    help="Where camera-0.jpg and so on are written.  [default: here]",
)
@click.option("--no-thumbnails", is_flag=True, help="Open no camera; list them alone.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object a camera, all modes.")
def cameras(
    sources: tuple[str, ...],
    publish: str | None,
    settings: tuple[str, ...],
    folder: Path,
    no_thumbnails: bool,
    as_json: bool,
) -> None:
    """List the cameras that are plugged in: number, name, modes, and a picture of each.

    The number or, on Linux, the name is what stands in a rig file as the view's source; the modes,
    what its camera can be asked for.

    With --publish, a CAMERA is a number, NAME=NUMBER, or NAME= and whatever a rig file may have as
    a live source; what the rig file on the other machine has to say is printed. Ctrl-C ends it.
    """
    with ending_at_once():
        need_opencv()
        from fingerpost.capture import list_cameras

    if publish is not None:
        address = address_of(publish)
        given = sources or [str(camera.number) for camera in list_cameras()]
        if not given:
            raise CaptureError(NONE)
        serve(named(given), address, settings_of(settings))
        return
    if sources or settings:
        raise click.UsageError(f"{(*sources, *settings)[0]}: is for --publish, which is not given")
    found = list_cameras()
    for camera in found:
        picture = None if no_thumbnails or camera.trouble else _thumbnail(camera, folder)
        if as_json:
            click.echo(json.dumps({**dataclasses.asdict(camera), "thumbnail": picture}))
        else:
            is_shared = sum(other.name == camera.name for other in found) > 1
            click.echo("\n".join(_lines(camera, picture, is_shared=is_shared)))
    if not found:
        click.echo(NONE, err=as_json)


def _lines(camera: Camera, picture: str | None, *, is_shared: bool) -> list[str]:
    """Describe a camera in lines of text, with a unique name if cameras share its name."""
    lines = [f"camera {camera.number}   {camera.name}".rstrip()]
    lines += [f"    also {link}" for link in camera.links[:1] if is_shared]
    lines += [f"    {mode}" for mode in camera.modes[:_SHOWN_MODES]]
    if len(camera.modes) > _SHOWN_MODES:
        lines.append(f"    and {len(camera.modes) - _SHOWN_MODES} smaller ones")
    if camera.trouble:
        lines.append(f"    {camera.trouble}")
    return [*lines, f"    picture: {picture}"] if picture else lines


def _thumbnail(camera: Camera, folder: Path) -> str | None:
    """Write an image of a camera to a file; print the reason and return None on failure."""
    import cv2

    from fingerpost.capture import Frame, open_source
    from fingerpost.checks import opencv_path
    from fingerpost.errors import CaptureError

    path = folder / f"camera-{camera.number}.jpg"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with open_source(camera.number) as source:
            seen = [next(source) for _ in range(_SETTLED_FRAMES)][-1]
        if not isinstance(seen, Frame):
            raise CaptureError(f"camera {camera.number}: {seen.why}")
        scale = min(1.0, _WIDTH_PX / seen.image.shape[1])
        small = cv2.resize(seen.image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        if not cv2.imwrite(opencv_path(path, "--thumbnails"), small):
            raise CaptureError(f"{path}: cannot be written")
    except (CaptureError, OSError) as error:
        click.echo(f"camera {camera.number}: no picture: {error}", err=True)
        return None
    return str(path)
