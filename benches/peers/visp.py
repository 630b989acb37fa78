"""ViSP's moving edges: `visp.py JOB.JSON PROGRAM`, the latter `visp_moving_edges.cpp` compiled.

Images go to the program as they are decoded; lines and processor time come back. This process
decodes and is in the memory, as for every peer; passing images on is not in the time.
"""

from __future__ import annotations

import json
import struct
import subprocess
import sys
from collections.abc import Callable
from typing import Any

from footage import Line, report


class Program:
    """The program that follows the fingers of all views, and the processor time that it spent."""

    def __init__(self, path: str, starts: list[dict[str, Any]]) -> None:
        poses = [[*start["tip_px"], start["angle_deg"], start["length_px"]] for start in starts]
        words = [str(number) for pose in poses for number in pose]
        pipe = subprocess.PIPE
        self._process = subprocess.Popen([path, *words], stdin=pipe, stdout=pipe)
        assert self._process.stdout is not None
        self.version = self._process.stdout.readline().decode().strip()
        self.pid = self._process.pid
        self.spent_s = 0.0

    def follower(self, view: int) -> Callable[[Any], Line | None]:
        """Return what follows the finger through the images of one view."""
        given, answers = self._process.stdin, self._process.stdout
        assert given is not None
        assert answers is not None

        def follow(image: Any) -> Line | None:
            height, width = image.shape[:2]
            given.write(struct.pack("=III", view, width, height) + image.tobytes())
            given.flush()
            self.spent_s, *ends = map(float, answers.readline().split())
            return ((ends[0], ends[1]), (ends[2], ends[3])) if ends else None

        return follow


with open(sys.argv[1], encoding="utf-8") as job:  # noqa: PTH123
    starts = [view["start"] for view in json.load(job)["views"]]
if None in starts:
    sys.exit("a start pose in every view is needed")
program = Program(sys.argv[2], starts)
followers = [program.follower(view) for view in range(len(starts))]
report(program.version, followers, lambda: program.spent_s, program.pid)
