"""`fingerpost markers`: a sheet of markers to be printed, or to be shown on a screen."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

import click

from fingerpost.errors import InvalidInputError
from fingerpost.installation import need_opencv
from fingerpost.signals import ending_at_once

if TYPE_CHECKING:
    from fingerpost.recording.marker_sheet import Cells

_MOST_PX = 20_000


@click.command()
@click.argument("file", metavar="SHEET.PDF", type=click.Path(path_type=Path))
@click.option(
    "--size", default="A4", show_default=True, help="A4, letter, A3, or WxH in mm: the paper."
)
@click.option(
    "--sheet",
    metavar="N",
    type=click.IntRange(1, 6),
    default=1,
    show_default=True,
    help="Number of the sheet; each has markers of its own.",
)
@click.option(
    "--screen",
    metavar="WxH",
    help="Write a picture (.png) of so many pixels instead, for a screen that shows it full size.",
)
def markers(file: Path, size: str, sheet: int, screen: str | None) -> None:
    """Write a sheet of markers, which a rig finds as { kind = "markers" }.

    Print it at 100 % and check the ruler on it. On a screen, show the picture in full size; the rig
    needs { kind = "screen", size = [w, h] } with the width and height of what shines, in its unit.
    """
    with ending_at_once():
        need_opencv()
        from fingerpost.formats import sides_of
        from fingerpost.recording import check_picture, write_picture
        from fingerpost.recording.marker_sheet import sheet_picture, write_sheet_pdf
        from fingerpost.references import marker_cells, sheet_markers
        from fingerpost.setting_up import UNIT, plane_size

    def cells(sides: tuple[float, float]) -> Cells:
        return {
            (float(at[0, 0]), float(at[0, 1]), float(at[1, 0] - at[0, 0])): marker_cells(number)
            for number, at in sheet_markers(sides, sheet).items()
        }

    if screen is not None:
        size_px = _pixels(screen)
        check_picture(file)
        write_picture(file, sheet_picture(size_px, cells((float(size_px[0]), float(size_px[1])))))
        return
    if file.suffix.lower() != ".pdf":
        raise InvalidInputError(
            f"{file}: a name that ends in .pdf is right; --screen 1920x1080 writes a picture"
        )
    size_mm = sides_of(plane_size(size), UNIT)
    write_sheet_pdf(file, size_mm, cells(size_mm), f"fingerpost sheet {sheet}")


def _pixels(words: str) -> tuple[int, int]:
    sides = re.fullmatch(r"\s*(\d+)\s*[x×*]\s*(\d+)\s*", words)
    size_px = (int(sides[1]), int(sides[2])) if sides is not None else (0, 0)
    if not 100 <= min(size_px) <= max(size_px) <= _MOST_PX:
        raise click.UsageError(f"--screen {words}: width and height in px, such as 1920x1080")
    return size_px
