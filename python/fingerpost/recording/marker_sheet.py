"""Sheets of markers as files: a PDF to print in true size, a picture for a screen."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fingerpost.errors import InvalidInputError

POINTS_A_MM = 72.0 / 25.4
"""Units of a PDF per millimetre."""

RULER_MM = 100.0

Cells = Mapping[tuple[float, float, float], NDArray[np.bool_]]
"""Masks of the black cells of markers, by left edge, upper edge and side of each marker."""


def write_sheet_pdf(path: Path, size_mm: tuple[float, float], markers: Cells, title: str) -> None:
    """Write a sheet of markers with a ruler, which shows whether it was printed in true size.

    Parameters
    ----------
    path
        The file; one that exists is replaced.
    size_mm
        Width and height of the paper [mm].
    markers
        Positions [mm] from the lower left corner, Y upwards.
    title
        Text beside the ruler.

    Raises
    ------
    InvalidInputError
        The file cannot be written.
    """
    ink = "\n".join([*_boxes(markers), "f", *_ruler(size_mm, markers, title)])
    width, height = (side * POINTS_A_MM for side in size_mm)
    objects = [
        "<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
        "<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {width:.3f} {height:.3f}] /Contents 4 0 R "
        "/Resources << /Font << /F 5 0 R >> >> >>",
        f"<< /Length {len(ink)} >>\nstream\n{ink}\nendstream",
        "<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>",
    ]
    text, places = "%PDF-1.4\n", []
    for k, content in enumerate(objects):
        places.append(len(text))
        text += f"{k + 1} 0 obj\n{content}\nendobj\n"
    table = "".join(f"{place:010d} 00000 n \n" for place in places)
    text += f"xref\n0 {len(objects) + 1}\n0000000000 65535 f \n{table}"
    text += f"trailer\n<< /Size {len(objects) + 1} /Root 1 0 R >>\nstartxref\n"
    text += f"{text.index('xref')}\n%%EOF\n"
    try:
        path.write_bytes(text.encode("latin-1"))
    except OSError as error:
        raise InvalidInputError(
            f"{path}: cannot be written: {error.strerror}; name a file in an existing folder"
        ) from error


def sheet_picture(size_px: tuple[int, int], markers: Cells) -> NDArray[np.uint8]:
    """Return the picture of a sheet that fills a screen, (H, W).

    Parameters
    ----------
    size_px
        Width and height of the screen [px].
    markers
        Positions [px] from the lower left corner, Y upwards.
    """
    width, height = size_px
    picture = np.full((height, width), 255, np.uint8)
    for (left, top, side), cells in markers.items():
        edges = np.round(np.linspace(0.0, side, len(cells) + 1)).astype(int)
        for row, column in np.argwhere(cells):
            rows = round(height - top) + edges[row : row + 2]
            columns = round(left) + edges[column : column + 2]
            picture[rows[0] : rows[1], columns[0] : columns[1]] = 0
    return picture


def _boxes(markers: Cells) -> Iterator[str]:
    """Yield black cells as parts of one path, so that there is no seam between neighbours."""
    for (left, top, side), cells in markers.items():
        cell = side / len(cells)
        for row, column in np.argwhere(cells).tolist():
            place = left + column * cell, top - (row + 1) * cell
            yield _box(*place, cell, cell)


def _ruler(size_mm: tuple[float, float], markers: Cells, title: str) -> Iterator[str]:
    """Yield a ruler between the lowest rows of markers, where the sheet has room for it."""
    width, _ = size_mm
    tops = sorted({round(top, 6) for _, top, _ in markers})
    side = next(iter(markers))[2]
    if len(tops) < 2 or width < RULER_MM + 20.0 or tops[1] - tops[0] - side < 16.0:
        return
    left, middle = 0.5 * (width - RULER_MM), 0.5 * (tops[0] + tops[1] - side)
    yield _box(left, middle, RULER_MM, 0.2)
    for k in range(int(RULER_MM) // 10 + 1):
        yield _box(left + 10.0 * k - 0.1, middle, 0.2, 3.0 if k % 5 == 0 else 2.0)
    yield "f"
    words = (
        f"{title}: this line must be {RULER_MM:g} mm long; print at 100 %, not fitted to the page"
    )
    place = (left * POINTS_A_MM, (middle - 4.0) * POINTS_A_MM)
    yield f"BT /F 6 Tf {place[0]:.3f} {place[1]:.3f} Td ({words}) Tj ET"


def _box(left: float, bottom: float, width: float, height: float) -> str:
    return " ".join(f"{v * POINTS_A_MM:.3f}" for v in (left, bottom, width, height)) + " re"
