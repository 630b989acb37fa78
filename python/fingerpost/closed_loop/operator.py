"""A simulated operator, who points with an error, observes the gripper, and corrects.

The simplest model with the features of human pointing under visual feedback:

* a movement of the hand has a bell-shaped speed profile (minimum jerk: Flash & Hogan 1985), and an
  endpoint error that grows with its length (Harris & Wolpert 1998);
* corrections are separate small movements, each based on an earlier observation (Woodworth 1899;
  Meyer, Abrams, Kornblum, Wright & Smith 1988), with a visual latency of 0.2 to 0.3 s (Keele &
  Posner 1968);
* a hand held still has tremor and drift.

The offset in pointing, and the accuracy with which the operator judges the gripper's position over
the table, are assumptions: the paper gives neither. The closed loop is compared with its operator's
result, "to within 1cm".
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
    """Parameters of an operator's pointing and correction."""

    offset_mm: tuple[float, float] = (20.0, 40.0)  # mm, range of the pointing offset, 0…200
    seeing_s: float = 0.3  # s from a movement of the gripper to the reaction, 0…2
    judging_mm: float = 1.5  # mm, sigma of each observation of the gripper, 0…50
    parallax_mm: float = 1.0  # mm, sigma of a constant error of observation, 0…50
    gain: float = 0.9  # of a correction, 0.1…1.5
    gain_sigma: float = 0.08  # of its scatter from one correction to the next, 0…0.5
    aim_sigma: float = 0.05  # error of a movement over its length, 0…0.5
    speed_mm_s: float = 250.0  # mm/s, mean speed of a long movement, 20…2000
    shortest_s: float = 0.35  # s, duration of the shortest movement, 0.05…2
    patience_s: float = 1.2  # s without motion of the (slow) gripper before an observation, 0…5
    content_mm: float = 4.0  # mm, error that is no longer corrected, 0.1…50
    hold_s: float = 4.5  # s of holding still then, before the next observation, 0…10
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
        """Return parameters without offset, noise, tremor and drift."""
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
        """Return the point of the minimum-jerk movement at a time."""
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
        Parameters of pointing and correction.
    start_mm : (2,)
        Initial indicated point of the plane.
    rng : numpy.random.Generator
        Random numbers.
    time_s : float
        Initial time [s].

    Attributes
    ----------
    corrects : bool
        Whether to correct by feedback; False points open loop.
    corrections : int
        Number of corrections made.
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
        """Begin to point at a target (2,) [mm], with a new random offset."""
        heading = self._rng.uniform(0, 2 * math.pi)
        length = self._rng.uniform(*self._habits.offset_mm)
        offset = length * np.array([math.cos(heading), math.sin(heading)])
        self._target_mm = np.asarray(target_mm, dtype=np.float64)
        self._move(self._target_mm + offset, time_s)

    def rest(self, time_s: float) -> None:
        """Return to the start point, as when the system has lost the hand."""
        self._left_mm = self._movement.end_mm
        self._move(self._start_mm, time_s)

    def resume(self, time_s: float) -> None:
        """Return to the point indicated before `rest`."""
        self._move(self._left_mm, time_s)

    def indicated_mm(self, time_s: float) -> Array:
        """Return the indicated point (2,) of the plane [mm]; times must not decrease."""
        habits = self._habits
        span_s = max(time_s - self._drift_at_s, 0.0)
        kept = math.exp(-span_s / habits.drift_s)
        fresh = self._rng.normal(0.0, 1.0, 2)
        self._drift_mm = kept * self._drift_mm + habits.drift_mm * math.sqrt(1 - kept**2) * fresh
        self._drift_at_s = time_s
        tremor = habits.tremor_mm * np.sin(2 * math.pi * habits.tremor_hz * time_s + self._phases)
        return np.asarray(self._movement.at(time_s) + self._drift_mm + tremor)

    def is_moving(self, time_s: float) -> bool:
        """Whether the hand is moving."""
        return time_s < self._movement.end_s

    def see(self, gripper_mm: Array, time_s: float, *, is_there: bool) -> None:
        """Observe the gripper, and react to earlier observations.

        Parameters
        ----------
        gripper_mm : (2,)
            Its position [mm].
        time_s
            Time [s].
        is_there
            Whether the arm stands at the indicated point. The operator sees whether it follows: an
            arm that holds is not corrected, or the corrections would add up until it follows again.
        """
        self._seen.append((time_s, np.array(gripper_mm, dtype=np.float64)))
        habits = self._habits
        looked_s = time_s - habits.seeing_s
        while len(self._seen) > 1 and self._seen[1][0] <= looked_s - habits.patience_s:
            self._seen.popleft()
        waits = not is_there or self.is_moving(time_s)
        if not self.corrects or self._target_mm is None or waits:
            return
        if looked_s - habits.patience_s < max(self._seen[0][0], self._movement.end_s):
            return  # the gripper has not had enough time
        past = [place for seen_s, place in self._seen if seen_s <= looked_s]
        if max(float(np.linalg.norm(place - past[-1])) for place in past) > habits.judging_mm + 1.0:
            return  # or still moves
        seen = past[-1] + self._parallax_mm + self._rng.normal(0.0, habits.judging_mm, 2)
        error = seen - self._target_mm
        if float(np.linalg.norm(error)) <= habits.content_mm:
            still = self._movement.end_mm
            # The error is small enough: hold still.
            self._movement = _Movement(time_s, habits.hold_s, still, still)
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
