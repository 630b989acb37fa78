"""`fingerpost sync`: the offset between recordings that were not begun at once."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from fingerpost.cli.progress import watched
from fingerpost.installation import need_opencv
from fingerpost.signals import ending_at_once

if TYPE_CHECKING:
    from fingerpost.capture import Frame, Loss
    from fingerpost.config import Rig


@click.command()
@click.argument("rig_file", metavar="RIG.TOML", type=click.Path(path_type=Path))
@click.option(
    "-o",
    "--output",
    metavar="RIG.TOML",
    type=click.Path(path_type=Path),
    help="Write the rig with its offsets; comments are not kept.",
)
@click.option("--max-frames", metavar="N", type=click.IntRange(min=1), help="Look at N frames.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object a view.")
def sync(rig_file: Path, output: Path | None, max_frames: int | None, as_json: bool) -> None:
    """Estimate the offset_s of recordings that were not begun at once, from the footage itself.

    In all views a hand is to point and move, to and fro and across, for some seconds. Prints the
    offset_s of every view but the first, by which the rig's views come to one time.
    """
    with ending_at_once():
        need_opencv()
        from fingerpost.config import Rig
        from fingerpost.sync import synchronise

    rig = Rig.load(rig_file)
    found = synchronise(rig, lambda tried: _footage(tried, max_frames))
    if output is not None:
        found.rig.save(output)
    for view in found.rig.views[1:]:
        offset = found.offsets[view.name]
        result = {
            "view": view.name,
            "offset_s": round(view.offset_s, 6),
            "sigma_s": round(offset.sigma_s, 6),
            "tips": offset.pairs,
            "off_px": round(offset.off_px, 3),
        }
        click.echo(json.dumps(result) if as_json else _line(result))


def _line(result: dict[str, object]) -> str:
    return (
        f"{result['view']}: offset_s = {result['offset_s']:.4f}   ± {result['sigma_s']:.4f} s, "
        f"from {result['tips']} places of the tip, {result['off_px']:.2f} px from their lines"
    )


def _footage(rig: Rig, max_frames: int | None) -> Iterator[Sequence[Frame | Loss | None]]:
    """Play a rig's recordings."""
    from fingerpost.capture import SourceKind, open_views, read_views
    from fingerpost.errors import InvalidInputError
    from fingerpost.pipeline import at_most

    with open_views(rig.sources, rig.readings) as sources:
        for source in sources:
            if source.kind is SourceKind.LIVE:
                raise InvalidInputError(
                    f"{source.name} is live, and its frames are of this machine's clock; sync is "
                    "for recordings"
                )
        counts = [n for n in (max_frames, *(source.frame_count for source in sources)) if n]
        frames = at_most(read_views(sources), max_frames)
        yield from watched(frames, min(counts, default=0), "following")
