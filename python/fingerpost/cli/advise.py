"""`fingerpost advise`: where to put the cameras, before anybody points."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fingerpost.cli.outputs import keep_apart, rig_files
from fingerpost.cli.progress import counting
from fingerpost.installation import need_opencv
from fingerpost.signals import ending_at_once

if TYPE_CHECKING:
    from fingerpost.advise import AdviceOptions
    from fingerpost.config import Rig

_PATH = click.Path(path_type=Path)


@click.command()
@click.argument("rig_file", metavar="RIG.TOML", type=_PATH)
@click.option("--draw", metavar="A.PNG", type=_PATH, help="Draw map, cameras and directions.")
@click.option(
    "--device",
    type=click.Choice(["hand", "rod"]),
    default="hand",
    show_default=True,
    help="A bare hand, whose finger is no cylinder, or a straight rod.",
)
@click.option("--hover", type=(float, float), metavar="MIN MAX", help="Height of the tip, mm.")
@click.option("--slant", type=(float, float), metavar="MIN MAX", help="Below the horizontal, deg.")
@click.option("--azimuth", type=(float, float), metavar="MIN MAX", help="0: to the cameras, deg.")
@click.option("--length", type=float, help="Straight, visible part of the finger, mm.")
@click.option("--contrast", type=float, help="Finger minus background, grey levels.")
@click.option("--noise", type=float, help="Image noise, sigma in grey levels.")
@click.option("--blur", type=float, help="Sigma of the point spread function, px.")
@click.option("--reference-noise", type=float, help="Sigma of the reference points, px.")
@click.option("--unit-mm", type=float, help="Length of a plane unit, mm, if its name gives none.")
@click.option(
    "--size",
    type=(int, int),
    metavar="W H",
    help="Of every view's images, px; otherwise a frame of each source is read.",
)
@click.option("--json", "as_json", is_flag=True, help="Print everything as JSON.")
def advise(
    rig_file: Path,
    draw: Path | None,
    device: str,
    size: tuple[int, int] | None,
    as_json: bool,
    **settings: Any,
) -> None:
    """Predict errors over the workspace, and say which camera to move and why.

    RIG.TOML needs the plane, to scale, and each view's reference points; nobody needs to point
    yet. What is not given is the hand of the accuracy experiment in an ordinary picture.
    """
    with ending_at_once():
        need_opencv()
        from fingerpost.advise import advise as predicted
        from fingerpost.config import Rig
        from fingerpost.recording import check_picture

    rig = Rig.load(rig_file)
    if draw is not None:
        check_picture(draw)
        keep_apart({"--draw": draw}, rig_files(rig_file, rig))
    options = _options(device, settings)
    sizes = [size] * len(rig.views) if size is not None else _sizes(rig)
    with counting("moves") as progress:
        result = predicted(rig, sizes, options, progress=progress)
    click.echo(json.dumps(result.as_dict()) if as_json else "\n".join(result.table()))
    if draw is not None:
        result.draw(draw)


def _options(device: str, settings: dict[str, Any]) -> AdviceOptions:
    """Replace defaults by the given options; the defaults are defined with the options."""
    from fingerpost.advise import AdviceOptions
    from fingerpost.pointing import DEFAULT_OPTIONS, UNSEEN_HAND
    from fingerpost.simulate import PoseLimits

    given = {name: value for name, value in settings.items() if value is not None}

    def taken(**names: str) -> dict[str, Any]:
        return {field: given.pop(name) for field, name in names.items() if name in given}

    poses = PoseLimits(**taken(hover_mm="hover", slant_deg="slant", azimuth_deg="azimuth"))
    renamed = taken(
        length_mm="length", blur_px="blur", reference_sigma_px="reference_noise", unit_mm="unit_mm"
    )
    pointing = UNSEEN_HAND if device == "hand" else DEFAULT_OPTIONS
    return AdviceOptions(poses=poses, pointing=pointing, **renamed, **given)


def _sizes(rig: Rig) -> list[tuple[int, int]]:
    """Return the sizes of the views' images, from the first frame of each."""
    from fingerpost.capture import Frame, open_views
    from fingerpost.errors import InvalidInputError

    sizes = []
    for (name, named), reading in zip(rig.sources.items(), rig.readings, strict=True):
        with open_views({name: named}, [reading]) as (source,):
            frame = next((seen for seen in source if isinstance(seen, Frame)), None)
        if frame is None:
            raise InvalidInputError(
                f'view "{name}": {named} holds no frame; name one, or give --size'
            )
        sizes.append((frame.image.shape[1], frame.image.shape[0]))
    return sizes
