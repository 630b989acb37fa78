"""Exact area coverage of polygons.

A pixel's coverage is the area of the polygon inside it. It is summed from the polygon's edges, each
cut at every row and column it crosses: within one cell an edge of height dy at mean distance x from
the cell's left side adds dy·(1 − x) to that cell and dy·x to the next, and the running sum along
the row is the coverage (Green's theorem on a grid; font rasterisers work this way). No sampling, no
fixed point: the error is rounding.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Patch:
    """Coverage 0…1 of one polygon, in the window of the grid that holds it."""

    rows: slice
    columns: slice
    coverage: NDArray[np.float32]

    @property
    def place(self) -> tuple[slice, slice]:
        """Index of the window in the grid."""
        return self.rows, self.columns


def polygon_coverage(polygons: Array, height: int, width: int) -> list[Patch | None]:
    """Coverage of simple polygons by the cells of a grid.

    Parameters
    ----------
    polygons
        (L, V, 2) vertices (x, y); cell (row i, column j) is [j, j + 1) × [i, i + 1). Repeated
        vertices and either orientation are fine. Polygons may reach beyond the grid.
    height, width
        Size of the grid.

    Returns
    -------
    list
        One patch for each polygon, or None if it lies outside the grid.
    """
    low = np.floor(polygons.min(axis=1)).astype(np.int64).clip(0, (width, height))
    high = np.ceil(polygons.max(axis=1)).astype(np.int64).clip(0, (width, height))
    size = high - low
    inside = (size > 0).all(axis=1)
    if not inside.any():
        return [None] * len(polygons)
    low, size = low[inside], size[inside]
    sums = _edge_sums(polygons[inside] - low[:, None], size)
    patches: list[Patch | None] = [None] * len(polygons)
    offset = 0
    for place, (column, row), (columns, rows) in zip(
        np.flatnonzero(inside), low, size, strict=True
    ):
        stride = int(columns) + 1
        block = sums[offset : offset + rows * stride].reshape(rows, stride)[:, :-1]
        offset += rows * stride
        patches[place] = Patch(slice(row, row + rows), slice(column, column + columns), block)
    return patches


def _edge_sums(polygons: Array, size: NDArray[np.int64]) -> NDArray[np.float32]:
    """Coverage of each polygon (L, V, 2) in a window of its own size (L, 2), one after the other.

    Every row has one column more than its window, which takes what lies to the right.
    """
    polygon = np.repeat(np.arange(len(polygons)), polygons.shape[1])
    x0, y0 = polygons.reshape(-1, 2).T
    x1, y1 = np.roll(polygons, -1, axis=1).reshape(-1, 2).T
    height = size[polygon, 1]

    # Cut at rows: the piece of each edge in each row that it crosses.
    top, bottom = np.minimum(y0, y1), np.maximum(y0, y1)
    crosses = (bottom > 0) & (top < height) & (bottom > top)
    polygon, x0, y0, x1, y1, top, bottom, height = (
        a[crosses] for a in (polygon, x0, y0, x1, y1, top, bottom, height)
    )
    first = np.floor(np.maximum(top, 0)).astype(np.int64)
    last = np.minimum(np.ceil(bottom).astype(np.int64), height) - 1
    edge, row = _ranges(first, last)
    upper = np.maximum(top[edge], row)
    lower = np.minimum(bottom[edge], row + 1)
    # Parts of the edge, not its slope: that of one that is all but level is beyond all floats.
    part = [(y - y0[edge]) / (y1 - y0)[edge] for y in (upper, lower)]
    x_upper, x_lower = (x0[edge] + p * (x1 - x0)[edge] for p in part)
    rise = np.where(y1 > y0, 1.0, -1.0)[edge] * (lower - upper)
    polygon = polygon[edge]

    # Cut at columns; column −1 stands for everything left of the window, the last for the right.
    left, right = np.minimum(x_upper, x_lower), np.maximum(x_upper, x_lower)
    width = size[polygon, 0]
    first = np.floor(left).clip(-1, width).astype(np.int64)
    last = np.maximum(np.ceil(right).clip(0, width + 1).astype(np.int64) - 1, first)
    piece, column = _ranges(first, last)
    width = width[piece]
    enter = np.where(column < 0, left[piece], np.maximum(left[piece], column))
    leave = np.where(column == width, right[piece], np.minimum(right[piece], column + 1))
    run = (right - left)[piece]
    share = np.where(run > 0, (leave - enter) / np.where(run > 0, run, 1.0), 1.0)
    rise = rise[piece] * share
    in_window = (column >= 0) & (column < width)
    beyond = np.where(in_window, (enter + leave) / 2 - column, 0.0)
    column = np.maximum(column, 0)

    stride = size[:, 0] + 1
    start = np.concatenate([[0], np.cumsum(stride * size[:, 1])])
    cell = start[polygon[piece]] + row[piece] * stride[polygon[piece]] + column
    sums = np.bincount(cell, rise * (1 - beyond), minlength=start[-1] + 1)
    sums += np.bincount(cell + 1, rise * beyond, minlength=start[-1] + 1)
    # Each row of a closed polygon sums to zero, so one running sum serves all rows.
    return np.abs(np.cumsum(sums)).astype(np.float32)


def _ranges(first: NDArray[np.int64], last: NDArray[np.int64]) -> tuple[NDArray[np.int64], ...]:
    """All whole numbers first[i]…last[i], with the i each belongs to."""
    counts = np.maximum(last - first + 1, 0)
    owner = np.repeat(np.arange(len(first)), counts)
    ends = np.cumsum(counts)
    value = np.arange(len(owner)) - np.repeat(ends - counts, counts) + first[owner]
    return owner, value
