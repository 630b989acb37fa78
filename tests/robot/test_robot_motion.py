"""Queued paths, looked at and stopped by several threads."""

import numpy as np

from fingerpost.robot.motion import MotionQueue, straight

START, GOAL = np.zeros(3), np.array([1.0, 0.0, 0.0])
WAY = straight(START, GOAL, lengths=slice(0, 3))


class BusyTime(float):
    """A time during whose every comparison another thread stops the arm."""

    def __new__(cls, value, stop):
        """Give a float that calls `stop`."""
        time_s = super().__new__(cls, value)
        time_s.stop = stop
        return time_s

    def __lt__(self, other):
        self.stop()
        return float(self) < other

    def __ge__(self, other):
        self.stop()
        return float(self) >= other


def queue():
    motion = MotionQueue(START)
    motion.add(WAY, 1.0, 1e6, 0.0)
    return motion


def test_a_stop_may_come_while_another_thread_looks():
    for look in ("position", "is_moving"):
        motion = queue()
        getattr(motion, look)(BusyTime(2.0, lambda motion=motion: motion.abort(0.5)))
        assert not motion.is_moving(0.6)
        np.testing.assert_allclose(motion.end, [0.5, 0.0, 0.0], atol=1e-5)


def test_looking_changes_nothing():
    motion = queue()
    assert not motion.is_moving(2.0)
    np.testing.assert_array_equal(motion.position(2.0), GOAL)
    np.testing.assert_allclose(motion.position(0.5), [0.5, 0.0, 0.0], atol=1e-5)
    assert motion.is_moving(0.5)


def test_paths_run_one_after_the_other():
    motion = queue()
    back = straight(GOAL, START, lengths=slice(0, 3))
    end_s = motion.add(back, 1.0, 1e6, 0.5)
    np.testing.assert_allclose(motion.position(1.5), [0.5, 0.0, 0.0], atol=1e-5)
    np.testing.assert_array_equal(motion.end, START)
    assert motion.is_moving(end_s - 1e-3)
    assert not motion.is_moving(end_s)
    assert motion.add(WAY, 1.0, 1e6, 10.0) > 11.0  # after a rest, from then on
