"""A simulated operator: points not quite where he means to, sees where the gripper went, corrects.

What people do when they point under visual feedback, in the simplest form that has its features:

* a hand's movement is a smooth bell of speed (minimum jerk: Flash & Hogan 1985), and it lands with
  an error that grows with its length (Harris & Wolpert 1998);
* corrections are separate small movements, each made by what was seen before it (Woodworth 1899;
  Meyer, Abrams, Kornblum, Wright & Smith 1988), and seeing takes 0.2 to 0.3 s (Keele & Posner
  1968);
* a hand that is held still is not still: it trembles and drifts.

The size of the offset with which he points, and how well he judges where over the table a gripper
is, are assumptions: the paper gives neither. Its operator's result, "to within 1cm", is what the
closed loop is held against.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fingerpost.simulate import checks

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Habits:
    """How an operator points and corrects."""

    offset_mm: tuple[float, float] = (20.0, 40.0)  # mm, how far from what he means, 0…200
    seeing_s: float = 0.3  # s from a movement of the gripper to his answer, 0…2
    judging_mm: float = 1.5  # mm, sigma of where he sees the gripper at every look, 0…50
    parallax_mm: float = 1.0  # mm, sigma of an error of judgement that stays the same, 0…50
    gain: float = 0.9  # of a correction, 0.1…1.5
    gain_sigma: float = 0.08  # of its scatter from one correction to the next, 0…0.5
    aim_sigma: float = 0.05  # error of a movement over its length, 0…0.5
    speed_mm_s: float = 250.0  # mm/s, mean speed of a long movement, 20…2000
    shortest_s: float = 0.35  # s that the shortest movement takes, 0.05…2
    patience_s: float = 1.2  # s that the gripper stands still before he judges: it is slow, 0…5
    content_mm: float = 4.0  # mm that he no longer corrects, 0.1…50
    hold_s: float = 4.5  # s that he then holds still before he looks again, 0…10
    drift_mm: float = 0.6  # mm, sigma of the slow drift of a hand held still, 0…20
    drift_s: float = 1.0  # s, its correlation time, 0.01…100
    tremor_mm: float = 0.25  # mm, amplitude of the tremor, 0…20
    tremor_hz: float = 9.0  # Hz, 1…30

    def __post_init__(self) -> None:
        checks.interval("offset_mm", self.offset_mm, 0, 200)
        ranges = {
            "seeing_s": (0, 2),
            "judging_mm": (0, 50),
            "parallax_mm": (0, 50),
            "gain": (0.1, 1.5),
            "gain_sigma": (0, 0.5),
            "aim_sigma": (0, 0.5),
            "speed_mm_s": (20, 2000),
            "shortest_s": (0.05, 2),
            "patience_s": (0, 5),
            "content_mm": (0.1, 50),
            "hold_s": (0, 10),
            "drift_mm": (0, 20),
            "drift_s": (0.01, 100),
            "tremor_mm": (0, 20),
            "tremor_hz": (1, 30),
        }
        for name, (low, high) in ranges.items():
            checks.number(name, getattr(self, name), low, high)

    @classmethod
    def exact(cls) -> Habits:
        """Return the habits of a machine: no offset, no noise, a steady hand."""
        return cls(
            offset_mm=(0.0, 0.0),
            judging_mm=0.0,
            parallax_mm=0.0,
            gain_sigma=0.0,
            aim_sigma=0.0,
            drift_mm=0.0,
            tremor_mm=0.0,
        )


@dataclass(frozen=True, slots=True)
class _Movement:
    start_s: float
    span_s: float
    start_mm: Array
    end_mm: Array

    def at(self, time_s: float) -> Array:
        """Point on the way; of least jerk."""
        share = min(max((time_s - self.start_s) / self.span_s, 0.0), 1.0)
        eased = share**3 * (10 - 15 * share + 6 * share**2)
        return self.start_mm + eased * (self.end_mm - self.start_mm)

    @property
    def end_s(self) -> float:
        return self.start_s + self.span_s


class Operator:
    """One operator.

    Parameters
    ----------
    habits : Habits
        How he points and corrects.
    start_mm : (2,)
        Point of the plane that his hand indicates at first.
    rng : numpy.random.Generator
        Everything random about him.
    time_s : float
        When he begins [s].

    Attributes
    ----------
    corrects : bool
        Whether he answers to what he sees; False points open loop.
    corrections : int
        How many corrections he has made.
    """

    def __init__(
        self,
        habits: Habits,
        start_mm: tuple[float, float],
        rng: np.random.Generator,
        *,
        time_s: float = 0.0,
    ) -> None:
        self._habits = habits
        self._rng = rng
        start = np.array(start_mm, dtype=np.float64)
        self._start_mm = self._left_mm = start
        self._movement = _Movement(time_s, habits.shortest_s, start, start)
        self._target_mm: Array | None = None
        self._parallax_mm = rng.normal(0.0, habits.parallax_mm, 2)
        self._phases = rng.uniform(0, 2 * math.pi, 2)
        self._drift_mm = rng.normal(0.0, habits.drift_mm, 2)
        self._drift_at_s = time_s
        self._seen: deque[tuple[float, Array]] = deque()
        self.corrects = False
        self.corrections = 0

    def mean(self, target_mm: Array, time_s: float) -> None:
        """Set out to point at a target (2,) [mm]; he misses by an offset of his own each time."""
        heading = self._rng.uniform(0, 2 * math.pi)
        length = self._rng.uniform(*self._habits.offset_mm)
        offset = length * np.array([math.cos(heading), math.sin(heading)])
        self._target_mm = np.asarray(target_mm, dtype=np.float64)
        self._move(self._target_mm + offset, time_s)

    def rest(self, time_s: float) -> None:
        """Go back to where he began, as when the machine has lost his hand."""
        self._left_mm = self._movement.end_mm
        self._move(self._start_mm, time_s)

    def resume(self, time_s: float) -> None:
        """Point again where he pointed before he went to rest."""
        self._move(self._left_mm, time_s)

    def indicated_mm(self, time_s: float) -> Array:
        """Return the point (2,) of the plane that his hand indicates [mm]; times must not fall."""
        habits = self._habits
        span_s = max(time_s - self._drift_at_s, 0.0)
        kept = math.exp(-span_s / habits.drift_s)
        fresh = self._rng.normal(0.0, 1.0, 2)
        self._drift_mm = kept * self._drift_mm + habits.drift_mm * math.sqrt(1 - kept**2) * fresh
        self._drift_at_s = time_s
        tremor = habits.tremor_mm * np.sin(2 * math.pi * habits.tremor_hz * time_s + self._phases)
        return np.asarray(self._movement.at(time_s) + self._drift_mm + tremor)

    def is_moving(self, time_s: float) -> bool:
        """Whether his hand is on its way."""
        return time_s < self._movement.end_s

    def see(self, gripper_mm: Array, time_s: float) -> None:
        """See where over the plane the gripper is (2,) [mm], and answer to what was seen before."""
        self._seen.append((time_s, np.array(gripper_mm, dtype=np.float64)))
        habits = self._habits
        looked_s = time_s - habits.seeing_s
        while len(self._seen) > 1 and self._seen[1][0] <= looked_s - habits.patience_s:
            self._seen.popleft()
        if not self.corrects or self._target_mm is None or self.is_moving(time_s):
            return
        if looked_s - habits.patience_s < max(self._seen[0][0], self._movement.end_s):
            return  # he waits for the gripper to have had its time
        past = [place for seen_s, place in self._seen if seen_s <= looked_s]
        if max(float(np.linalg.norm(place - past[-1])) for place in past) > habits.judging_mm + 1.0:
            return  # and to stand still
        seen = past[-1] + self._parallax_mm + self._rng.normal(0.0, habits.judging_mm, 2)
        error = seen - self._target_mm
        if float(np.linalg.norm(error)) <= habits.content_mm:
            still = self._movement.end_mm
            self._movement = _Movement(time_s, habits.hold_s, still, still)  # that is where it is
            return
        gain = max(self._rng.normal(habits.gain, habits.gain_sigma), 0.0)
        self.corrections += 1
        self._move(self._movement.end_mm - gain * error, time_s)

    def _move(self, end_mm: Array, time_s: float) -> None:
        habits = self._habits
        start_mm = self._movement.at(time_s)
        length = float(np.linalg.norm(end_mm - start_mm))
        landed = end_mm + self._rng.normal(0.0, habits.aim_sigma * length, 2)
        span_s = max(habits.shortest_s, length / habits.speed_mm_s)
        self._movement = _Movement(time_s, span_s, start_mm, landed)
