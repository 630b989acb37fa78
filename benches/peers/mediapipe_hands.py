"""MediaPipe Hands: `mediapipe_hands.py JOB.JSON COMPLEXITY`, 0 for the lite model, 1 for the full.

The finger line leads through the middle joint (PIP) and the tip of the index finger. On the
built-in clip the full model's points are off by 22.6 mm (RMS) so, by 25.2 mm with the knuckle in
place of that joint, and by 35.7 mm with the last joint.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from typing import Any

import cv2
import mediapipe
from footage import Line, report

JOINT, TIP = 6, 8


def follower() -> Callable[[Any], Line | None]:
    """Return what follows a hand through the images of one view, as for a film."""
    hands = mediapipe.solutions.hands.Hands(
        static_image_mode=False, max_num_hands=1, model_complexity=int(sys.argv[2])
    )

    def follow(image: Any) -> Line | None:
        found = hands.process(cv2.cvtColor(image, cv2.COLOR_BGR2RGB)).multi_hand_landmarks
        if not found:
            return None
        height, width = image.shape[:2]
        # Landmarks are parts of the picture, whose first pixel begins at 0.
        joint, tip = (
            (mark.x * width - 0.5, mark.y * height - 0.5)
            for mark in (found[0].landmark[k] for k in (JOINT, TIP))
        )
        return joint, tip

    return follow


with open(sys.argv[1], encoding="utf-8") as job:  # noqa: PTH123
    count = len(json.load(job)["views"])
report(mediapipe.__version__, [follower() for _ in range(count)])
