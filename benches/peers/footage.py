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
    """Yield the time and the images of all views, for as long as all have one.

    In this thread alone: others would decode the next images in a peer's time.
    """
    alone = [cv2.CAP_PROP_N_THREADS, 1]
    films = [cv2.VideoCapture(view["source"], cv2.CAP_FFMPEG, alone) for view in views]
    while True:
        read = [film.read() for film in films]
        if not all(done for done, _ in read):
            return
        yield films[0].get(cv2.CAP_PROP_POS_MSEC) / 1e3, [image for _, image in read]


def report(
    version: str,
    followers: list[Callable[[Any], Line | None]],
    clock: Callable[[], float] = time.process_time,
    helper: int | None = None,
) -> None:
    """Follow the footage with a function per view, and print lines, time and memory as JSON.

    `clock` gives the processor time spent so far; `helper` is a process that the functions use.
    """
    with open(sys.argv[1], encoding="utf-8") as file:  # noqa: PTH123
        views = json.load(file)["views"]
    lines, spent_s = [], []
    for index, (time_s, images) in enumerate(frames(views)):
        begun = clock()
        found = [follow(image) for follow, image in zip(followers, images, strict=True)]
        spent_s.append(clock() - begun)
        lines.append((index, time_s, found))
    finish({"version": version, "lines": lines}, spent_s, helper)


def finish(said: dict[str, Any], spent_s: list[float], helper: int | None = None) -> None:
    """Print what was found, with the median time a pair and the most memory that was used."""
    memory_mb = used_mb("self") + (0.0 if helper is None else used_mb(str(helper)))
    said |= {"pair_s": statistics.median(spent_s), "memory_mb": memory_mb}
    sys.stdout.write(json.dumps(said) + "\n")


def used_mb(process: str) -> float:
    """Return the most memory that a process has used; other than on Linux, that this one has.

    On Linux `ru_maxrss` will not do: it is at least what the process that started this one had.
    """
    if sys.platform != "linux":
        unit = 1e6 if sys.platform == "darwin" else 1e3
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit
    with open(f"/proc/{process}/status", encoding="ascii") as status:  # noqa: PTH123
        return next(int(line.split()[1]) for line in status if line.startswith("VmHWM")) / 1e3
