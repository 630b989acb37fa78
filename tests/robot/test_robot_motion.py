"""Queued paths, queried and stopped by several threads."""

import numpy as np

from fingerpost.robot.motion import MotionQueue, straight

START, GOAL = np.zeros(3), np.array([1.0, 0.0, 0.0])
WAY = straight(START, GOAL, lengths=slice(0, 3))


class BusyTime(float):
    """A time whose every comparison calls `stop`, to simulate a stop from another thread."""

    def __new__(cls, value, stop):
        """Create a float that calls `stop` when compared."""
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


def test_a_stop_may_interrupt_a_query_in_another_thread():
    for query in ("position", "is_moving"):
        motion = queue()
        getattr(motion, query)(BusyTime(2.0, lambda motion=motion: motion.abort(0.5)))
        assert not motion.is_moving(0.6)
        np.testing.assert_allclose(motion.end, [0.5, 0.0, 0.0], atol=1e-5)


def test_queries_do_not_change_the_state():
    motion = queue()
    assert not motion.is_moving(2.0)
    np.testing.assert_array_equal(motion.position(2.0), GOAL)
    np.testing.assert_allclose(motion.position(0.5), [0.5, 0.0, 0.0], atol=1e-5)
    assert motion.is_moving(0.5)


def test_paths_run_in_sequence():
    motion = queue()
    back = straight(GOAL, START, lengths=slice(0, 3))
    end_s = motion.add(back, 1.0, 1e6, 0.5)
    np.testing.assert_allclose(motion.position(1.5), [0.5, 0.0, 0.0], atol=1e-5)
    np.testing.assert_array_equal(motion.end, START)
    assert motion.is_moving(end_s - 1e-3)
    assert not motion.is_moving(end_s)
    assert motion.add(WAY, 1.0, 1e6, 10.0) > 11.0  # after an idle time, from its start
