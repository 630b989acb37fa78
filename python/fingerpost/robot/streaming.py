"""The base of arms that are sent one pose after the other, at a fixed rate.

A servo goes to where it is sent as fast as it can, and a controller that takes a stream of poses
does the like: neither knows a straight line or a speed. `StreamedArm` knows both. It interpolates
the queued moves (`fingerpost.robot.motion`) and sends where the arm shall be now, from a thread of
its own, until the last move has ended. Nothing is sent ahead: a program that is killed leaves an
arm that stands within one period's way. Nor is anything caught up on: where the program, or an
answer, was late, the arm is late, and neither faster than asked for nor off its line.

A stop ends the stream by the count that voids every command (`fingerpost.robot.arm`), and has the
driver hold the arm where it was last measured. The next move begins where the arm then is. An arm
that has arrived keeps its goal: it hangs a little below it, and would sink with every stop.
"""

from __future__ import annotations

import queue
import threading
import time
from abc import abstractmethod
from collections.abc import Callable

from fingerpost.robot.arm import Arm, ArrivalRule, Turn
from fingerpost.robot.errors import RobotError, StoppedError
from fingerpost.robot.motion import MotionQueue, Path, Vector
from fingerpost.robot.protocol import Limits, Pose
from fingerpost.robot.stopping import described

LATE_PERIODS = 1.5
"""From one place to the next the arm goes no further than in so many periods, however late that
is."""


class StreamedArm(Arm):
    """Base of the drivers that stream; a *place* is a vector of the driver's own.

    Parameters
    ----------
    limits : Limits or None
        What may be asked; None refuses every motion.
    rate_hz : float
        Poses are sent so often [Hz].
    acceleration_m_s2 : float
        Of every move [m/s²].
    arrival, clock, sleep
        As for `Arm`.
    """

    def __init__(
        self,
        limits: Limits | None,
        *,
        rate_hz: float,
        acceleration_m_s2: float,
        arrival: ArrivalRule | None = None,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        super().__init__(limits, arrival=arrival, clock=clock, sleep=sleep)
        self._period_s = 1 / rate_hz
        self._acceleration_m_s2 = acceleration_m_s2
        self._motion: MotionQueue | None = None  # not known after a stop
        self._path_s = 0.0  # time by which the queued moves are run
        self._has_arrived = False  # at the place that was sent last, or is held there
        self._stream_turn = Turn(0, 0.0)
        self._stream_error: RobotError | None = None
        self._wakes: queue.SimpleQueue[bool] | None = None  # of this connection's thread

    # What a driver provides, beside `_open` and `_move_gripper`.

    @abstractmethod
    def _make_ready(self, turn: Turn, report: Callable[[str], None]) -> None:
        """Do what homing means for this arm, and see that it can move."""

    @abstractmethod
    def _disconnect(self) -> None:
        """Close the connection; harmless when closed."""

    @abstractmethod
    def _measure(self) -> Vector:
        """Return the place where the arm is now; raise a fault that it reports."""

    @abstractmethod
    def _pose_at(self, place: Vector) -> Pose:
        """Return a place as a pose."""

    @abstractmethod
    def _path(self, start: Vector, pose: Pose, speed_m_s: float) -> Path:
        """Return the straight way of the gripper; raise if the arm cannot go it.

        Its length [m] is run at the speed asked for, so it is longer than the gripper's way where
        something else than the gripper would be too fast.
        """

    @abstractmethod
    def _send_place(self, place: Vector) -> None:
        """Send where the arm shall be now, without waiting for an answer."""

    @abstractmethod
    def _hold(self, *, has_arrived: bool) -> None:
        """Send that the arm stays where it was last measured, past every queue.

        One that has arrived may stay where it was sent.
        """

    # Inside.

    def _close(self) -> None:
        if self._wakes is not None:
            self._wakes.put(False)
        self._wakes = self._motion = self._stream_error = None
        self._has_arrived = False
        self._disconnect()

    def _home(self, turn: Turn, report: Callable[[str], None]) -> None:
        self._motion = self._stream_error = None
        self._has_arrived = False  # somebody may have moved it by hand
        self._make_ready(turn, report)

    def _start_move(self, pose: Pose, speed_m_s: float, turn: Turn) -> None:
        self._raise_stream_error()
        motion = self._motion or MotionQueue(self._measure())
        path = self._path(motion.end, pose, speed_m_s)

        def start() -> None:
            motion.add(path, speed_m_s, self._acceleration_m_s2, self._path_s)
            self._motion, self._stream_turn = motion, turn

        self._issue(start, turn)
        if self._wakes is None:
            self._wakes = queue.SimpleQueue()
            threading.Thread(
                target=self._stream, args=(self._wakes,), name="stream", daemon=True
            ).start()
        self._wakes.put(True)

    def _read_pose(self, turn: Turn) -> Pose:
        self._check(turn)
        self._raise_stream_error()
        return self._pose_at(self._measure())

    def _await_arrival(self, goal: Pose, turn: Turn) -> None:
        """Wait until the last place has been sent, then for the arm to stand there."""
        while (motion := self._motion) is not None and motion.is_moving(self._path_s):
            self._pause(self._period_s, turn)
            self._raise_stream_error()
        super()._await_arrival(goal, turn)
        self._has_arrived = True

    def _send_stop(self) -> None:
        self._motion = None
        self._hold(has_arrived=self._has_arrived)
        self._has_arrived = True

    def _raise_stream_error(self) -> None:
        """Raise what the stream ended with; a thread has nobody else to say it to."""
        error, self._stream_error = self._stream_error, None
        if error is not None:
            raise error

    def _stream(self, wakes: queue.SimpleQueue[bool]) -> None:
        """Send while there is something to send, until the connection is closed."""
        while wakes.get():
            try:
                self._send_along(wakes)
            except StoppedError:
                continue  # a stop has held the arm
            except Exception as error:  # the thread that waits for the arm raises it
                self._motion = None
                self._stream_error = _as_robot_error(error)
                self._hold_if_possible()

    def _send_along(self, wakes: queue.SimpleQueue[bool]) -> None:
        """Send the places of the queued moves, one a period, up to the end of the last one."""
        due_s = last_s = self._clock()
        while True:
            with self._exchange_lock:
                motion, turn = self._motion, self._stream_turn
                if motion is None or self._wakes is not wakes:
                    return
                if not motion.is_moving(self._path_s):
                    return  # the last place has been sent
                self._measure()
                now_s = self._clock()
                self._path_s += min(now_s - last_s, LATE_PERIODS * self._period_s)
                last_s, place = now_s, motion.position(self._path_s)
                self._issue(lambda place=place: self._leave_for(place), turn)  # type: ignore[misc]
            due_s = max(due_s + self._period_s, self._clock())
            self._sleep_for(max(0.0, due_s - self._clock()))

    def _leave_for(self, place: Vector) -> None:
        self._has_arrived = False
        self._send_place(place)
        self._has_arrived = False  # also after a stop that came in between

    def _hold_if_possible(self) -> None:
        try:
            self._hold(has_arrived=False)
        except RobotError:  # the error that it is called for is kept
            return


def _as_robot_error(error: Exception) -> RobotError:
    """Return an error of the stream as one that stops the arm."""
    return error if isinstance(error, RobotError) else RobotError(described(error))
