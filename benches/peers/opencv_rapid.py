"""OpenCV's RAPID (Harris & Stennett 1990): `opencv_rapid.py JOB.JSON`.

RAPID follows a rigid body of known shape before a calibrated camera. The camera here is a pinhole
of 60° and the body a flat index finger with a round end, as long and as wide as the template of
the rig file, which starts at its pose; rotation out of the image stands in for foreshortening.

Results differ from run to run, perhaps because `extractLineBundle` leaves the last places of a
search line unset when it has fewer pixels than there are places.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from footage import Line, report

HALF_WIDTH = 0.115
"""Of a usual finger, in visible lengths."""
SEARCH_LINES, SEARCH_RADIUS_PX, ITERATIONS = 100, 12, 5
LEAST_MATCHED = 0.5
END_SAMPLES = 12


def finger() -> tuple[Any, Any]:
    """Return the corners (N, 3) and triangles of a finger of length 1 that points along +x."""
    turns = np.linspace(-math.pi / 2, math.pi / 2, END_SAMPLES)
    end = [(HALF_WIDTH * (math.cos(t) - 1.0), HALF_WIDTH * math.sin(t), 0.0) for t in turns]
    corners = [(-1.0, -HALF_WIDTH, 0.0), *end, (-1.0, HALF_WIDTH, 0.0)]
    fan = [(0, k + 1, k) for k in range(1, len(corners) - 1)]
    return np.array(corners, np.float32), np.array(fan, np.int32)


def follower(start: dict[str, Any]) -> Callable[[Any], Line | None]:
    """Return what follows the finger through the images of one view from its start pose."""
    corners, triangles = finger()
    state: dict[str, Any] = {}

    def follow(image: Any) -> Line | None:
        height, width = image.shape[:2]
        focal_px = width / (2.0 * math.tan(math.radians(30.0)))
        camera = np.array(
            [[focal_px, 0, (width - 1) / 2], [0, focal_px, (height - 1) / 2], [0, 0, 1]]
        )
        if not state:
            depth = focal_px / start["length_px"]
            place = np.linalg.solve(camera, [*start["tip_px"], 1.0]) * depth
            turn = np.array([[0.0], [0.0], [math.radians(start["angle_deg"])]])
            state.update(turn=turn, place=place.reshape(3, 1))
        turn, place = state["turn"].copy(), state["place"].copy()
        matched = 0.0
        try:
            for _ in range(ITERATIONS):
                matched, turn, place, _ = cv2.rapid.rapid(
                    image, SEARCH_LINES, SEARCH_RADIUS_PX, corners, triangles, camera, turn, place
                )
        except cv2.error:  # the body has left the picture, or turned its edge to the camera
            return None
        if matched < LEAST_MATCHED or not np.all(np.isfinite(place)):
            return None
        state.update(turn=turn, place=place)
        axis = np.array([[-0.5, 0.0, 0.0], [0.0, 0.0, 0.0]])
        shown, _ = cv2.projectPoints(axis, turn, place, camera, None)
        (base, tip) = shown.reshape(2, 2).tolist()
        return tuple(base), tuple(tip)

    return follow


if not hasattr(cv2, "rapid"):
    sys.exit(f"OpenCV {cv2.__version__} without its extra modules has no rapid")
with open(sys.argv[1], encoding="utf-8") as job:  # noqa: PTH123
    views = json.load(job)["views"]
if any(view["start"] is None for view in views):
    sys.exit("a start pose in every view is needed")
report(f"OpenCV {cv2.__version__}", [follower(view["start"]) for view in views])
