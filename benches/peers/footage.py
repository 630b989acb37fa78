"""What every peer's program needs, in OpenCV and the standard library alone."""

from __future__ import annotations

import json
import resource
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import cv2

Line = tuple[tuple[float, float], tuple[float, float]]


def frames(views: list[dict[str, Any]]) -> Iterator[tuple[float, list[Any]]]:
    """Yield the time and the images of all views, for as long as all have one."""
    films = [cv2.VideoCapture(view["source"]) for view in views]
    while True:
        read = [film.read() for film in films]
        if not all(done for done, _ in read):
            return
        yield films[0].get(cv2.CAP_PROP_POS_MSEC) / 1e3, [image for _, image in read]


def report(version: str, followers: list[Callable[[Any], Line | None]]) -> None:
    """Follow the footage with a function per view, and print lines, time and memory as JSON."""
    with open(sys.argv[1], encoding="utf-8") as file:  # noqa: PTH123
        views = json.load(file)["views"]
    lines, spent_s = [], []
    for index, (time_s, images) in enumerate(frames(views)):
        begun = time.process_time()
        found = [follow(image) for follow, image in zip(followers, images, strict=True)]
        spent_s.append(time.process_time() - begun)
        lines.append((index, time_s, found))
    finish({"version": version, "lines": lines}, spent_s)


def finish(said: dict[str, Any], spent_s: list[float]) -> None:
    """Print what was found, with the median time a pair and the most memory that was used."""
    unit = 1e6 if sys.platform == "darwin" else 1e3
    memory_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit
    said |= {"pair_s": statistics.median(spent_s), "memory_mb": memory_mb}
    sys.stdout.write(json.dumps(said) + "\n")
