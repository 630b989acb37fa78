"""Base class of arms that receive a stream of poses at a fixed rate.

A servo moves to its goal as fast as it can, and so does a controller for streams of poses: neither
implements straight lines or speeds. `StreamedArm` does. It interpolates the queued moves
(`fingerpost.robot.motion`) and sends the present nominal pose, from a separate thread, until the
last move has ended. Nothing is sent ahead: if the program is killed, the arm stops within one
period. Delays are not caught up: if the program or an answer is late, the arm is late, but neither
faster than commanded nor off its line.

A stop ends the stream by the number that voids every command (`fingerpost.robot.arm`), and the
driver holds the arm at its last measured pose. The next move begins at the arm's pose at that time.
An arm that has arrived keeps its goal: it sags slightly, and would sink further with every stop.
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
"""Greatest step from one place to the next, in periods, regardless of delays."""


class StreamedArm(Arm):
    """Base class of the drivers that stream; a *place* is a vector defined by the driver.

    Parameters
    ----------
    limits : Limits or None
        Limits of commands; None refuses every motion.
    rate_hz : float
        Rate of poses [Hz].
    acceleration_m_s2 : float
        Acceleration of every move [m/s²].
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
        self._motion: MotionQueue | None = None  # unknown after a stop
        self._path_s = 0.0  # time along the queued moves
        self._has_arrived = False  # at the last place sent, or held there
        self._stream_turn = Turn(0, 0.0)
        self._stream_error: RobotError | None = None
        self._wakes: queue.SimpleQueue[bool] | None = None  # of this connection's thread

    # Hooks of a driver, in addition to `_open` and `_move_gripper`.

    @abstractmethod
    def _make_ready(self, turn: Turn, report: Callable[[str], None]) -> None:
        """Home this arm in its own way, and check that it can move."""

    @abstractmethod
    def _disconnect(self) -> None:
        """Close the connection; harmless when closed."""

    @abstractmethod
    def _measure(self) -> Vector:
        """Return the present place of the arm; raise a fault that it reports."""

    @abstractmethod
    def _pose_at(self, place: Vector) -> Pose:
        """Return a place as a pose."""

    @abstractmethod
    def _path(self, start: Vector, pose: Pose, speed_m_s: float) -> Path:
        """Return the straight path of the gripper; raise if the arm cannot follow it.

        Its length [m] is run at the given speed, so it is longer than the gripper's path if another
        part would be too fast.
        """

    @abstractmethod
    def _send_place(self, place: Vector) -> None:
        """Send the present nominal place of the arm, without waiting for an answer."""

    @abstractmethod
    def _hold(self, *, has_arrived: bool) -> None:
        """Send the command to hold the last measured place, bypassing every queue.

        An arm that has arrived may hold its goal.
        """

    # Internals.

    def _close(self) -> None:
        if self._wakes is not None:
            self._wakes.put(False)
        self._wakes = self._motion = self._stream_error = None
        self._has_arrived = False
        self._disconnect()

    def _home(self, turn: Turn, report: Callable[[str], None]) -> None:
        self._motion = self._stream_error = None
        self._has_arrived = False  # it may have been moved by hand
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
        """Raise the error that ended the stream's thread, if any."""
        error, self._stream_error = self._stream_error, None
        if error is not None:
            raise error

    def _stream(self, wakes: queue.SimpleQueue[bool]) -> None:
        """Send places while there are moves, until the connection is closed."""
        while wakes.get():
            try:
                self._send_along(wakes)
            except StoppedError:
                continue  # a stop has held the arm
            except Exception as error:  # raised again by the thread that waits for the arm
                self._motion = None
                self._stream_error = _as_robot_error(error)
                self._hold_if_possible()

    def _send_along(self, wakes: queue.SimpleQueue[bool]) -> None:
        """Send the places of the queued moves, one per period, to the end of the last one."""
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
        self._has_arrived = False  # also after a stop meanwhile

    def _hold_if_possible(self) -> None:
        try:
            self._hold(has_arrived=False)
        except RobotError:  # the original error is kept
            return


def _as_robot_error(error: Exception) -> RobotError:
    """Return an error of the stream as a `RobotError`, which stops the arm."""
    return error if isinstance(error, RobotError) else RobotError(described(error))
