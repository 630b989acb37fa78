"""Photographs of a finger that bends: it is tracked while straight, a misfit while bent.

    python benches/photographs.py FOLDER

FOLDER holds images 547–568 of the TI1K data set (github.com/MahmudulAlam/TI1K-Dataset, MIT) and
`axis.csv` with their silhouettes' medial lines (frame, apex_x, apex_y, angle_deg, width_px). The
finger is straight in the middle images and bends towards either end. Each row is one tracker,
started on a straight frame with a template whose length is given in half-widths.
"""

from __future__ import annotations

import argparse
import csv
import math
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from fingerpost._core import ContourTracker, StartPose, Template, Track

STRAIGHT, BENT = range(550, 561), {547, 565, 566, 567, 568}
FRAME_S = 0.1
STILL_FRAMES = 8
RUNS = [
    (thumb, numbers, half_widths)
    for thumb, numbers in (
        ("none", range(553, 569)),
        ("none", range(556, 546, -1)),
        ("right", range(553, 569)),
    )
    for half_widths in (5.5, 6.5, 7.4)
]


def main() -> None:
    """Print a row for every run."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    if not (folder / "axis.csv").is_file():
        parser.error(f"{folder} has no axis.csv; the folder of the photographs is right")
    with (folder / "axis.csv").open() as rows:
        axes = {int(row["frame"][-8:-4]): row for row in csv.DictReader(rows)}
    for thumb, numbers, half_widths in RUNS:
        tracks = dict(followed(folder, axes, thumb, numbers, half_widths))
        errors_deg = [
            error_deg(axes[k], tracks[k]) for k in tracks if k in STRAIGHT and tracks[k].finger_line
        ]
        straight, bent = [k for k in tracks if k in STRAIGHT], [k for k in tracks if k in BENT]
        misfits = sum(tracks[k].diagnostics.refusal == "misfit" for k in bent)
        median = f"{np.median(errors_deg):.1f}" if errors_deg else "–"
        print(
            f"thumb {thumb:5}  {numbers[0]} to {numbers[-1]}  length {half_widths} half-widths: "
            f"straight {len(errors_deg)} of {len(straight)} with a line, median {median} deg; "
            f"bent {misfits} of {len(bent)} misfits"
        )


def followed(
    folder: Path, axes: dict[int, dict[str, str]], thumb: str, numbers: range, half_widths: float
) -> Iterator[tuple[int, Track]]:
    """Yield the track of each photograph, after several frames of the first one."""
    first = axes[numbers[0]]
    start = StartPose(
        (float(first["apex_x"]), float(first["apex_y"])),
        math.radians(float(first["angle_deg"])),
        half_widths * float(first["width_px"]) / 2,
    )
    tracker = ContourTracker(Template.pistol(thumb), start)
    for index, k in enumerate([numbers[0]] * STILL_FRAMES + list(numbers)):
        image = cv2.imread(str(folder / axes[k]["frame"]))
        grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        track = tracker.update(grey, index * FRAME_S, image)
        if index >= STILL_FRAMES:
            yield k, track


def error_deg(axis: dict[str, str], track: Track) -> float:
    """Return the angle between a finger line and the silhouette's medial line."""
    turn = track.finger_line.angle_rad - math.radians(float(axis["angle_deg"]))
    return abs(math.degrees(math.remainder(turn, math.tau)))


if __name__ == "__main__":
    main()
