"""A minimal arm model: a pose that moves to its goal at constant speed, in real time."""

import math
import time

import numpy as np
from scipy.spatial.transform import Rotation

TOOL_DOWN = Rotation.from_euler("x", math.pi)


class FakeArm:
    """A pose that moves to its goal at constant speed."""

    def __init__(self):
        self.start = self.goal = np.array([0.3, 0.0, 0.3])
        self.rotation = TOOL_DOWN
        self.began_s, self.speed = time.monotonic(), 1.0
        self.stops = 0

    def position(self, now_s=None):
        """Return the position [m], now or at a given time."""
        now_s = time.monotonic() if now_s is None else now_s
        way = np.linalg.norm(self.goal - self.start)
        gone = self.speed * max(0.0, now_s - self.began_s)
        return self.goal if gone >= way else self.start + gone / way * (self.goal - self.start)

    def is_moving(self):
        """Return whether the goal is not yet reached."""
        return bool(np.any(self.position() != self.goal))

    def go(self, position, rotation, speed):
        """Start to move to a goal."""
        self.start, self.goal, self.rotation = self.position(), np.array(position), rotation
        self.began_s, self.speed = time.monotonic(), speed

    def stop(self, at_s=None):
        """Stop, now or at an earlier time."""
        self.stops += 1
        self.start = self.goal = self.position(at_s)
