"""Universal Robots through their vendor-neutral library `ur_rtde` (extra `ur`).

`ur_rtde` uses metres, radians and rotation vectors, and answers with a bool. Moves are always sent
asynchronously: a blocking `moveL` would block the line for `stopL`. The arm has no gripper of its
own; one on a digital output can be configured.

The arm is moved by a script that the library uploads to the controller, its *control script*.
Commands reach it through registers, one at a time, so they wait for each other here. It ends when
its program is stopped at the pendant, after a protective stop, and by the watchdog: the controller
stops it, and with it the arm, when this process no longer writes to it. Homing starts it again.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Annotated, Any

import msgspec
import numpy as np

from fingerpost.errors import FingerpostError
from fingerpost.installation import require
from fingerpost.robot import ur_dashboard
from fingerpost.robot.arm import Arm, ArrivalRule, Turn
from fingerpost.robot.errors import (
    CommandRefusedError,
    ConnectionLostError,
    GripperError,
    OutOfReachError,
    RobotError,
    RobotFaultError,
)
from fingerpost.robot.options import CheckedOptions
from fingerpost.robot.orientation import (
    pose_angles,
    rotation_matrix,
    rotation_vector,
    tool_rotation,
)
from fingerpost.robot.protocol import Angle, GripperKind, Limits, Pose

logger = logging.getLogger(__name__)

MODE_RUNNING = 7
"""Robot mode of an arm that is switched on with its brakes released."""

PROGRAM_STOPPED = 1
"""Runtime state of a controller whose program has ended; a paused one may continue."""

SCRIPT_START_S = 5.0
"""Time limit from the upload of the control script to its start [s], as in `ur_rtde` itself."""

COMMAND_S = 0.01
"""Time that a stop waits for the previous command to be accepted [s]; it has 20 ms in all."""

KICKS = 4
"""Number of watchdog signals per period, because a busy machine may delay some."""

SCRIPT_STOPPED = (
    "the control script has stopped, as when a program is stopped at the pendant: see why, then "
    "home the arm to start it again"
)
REMOTE_CONTROL_OFF = (
    "remote control is switched off: switch it on at the pendant (Local to Remote, at the top "
    "right), then connect and home again"
)
PROTECTIVE_STOP = (
    "protective stop: see to its cause and unlock it at the pendant, then home the arm to go on"
)
EMERGENCY_STOP = "emergency stop: release it and switch the arm on at the pendant, then home again"


class UrOptions(CheckedOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of a Universal Robots arm.

    Attributes
    ----------
    reach_m : float
        Reach of the model: 0.5 (UR3), 0.85 (UR5), 1.3 (UR10) [m].
    lower_z_m : float
        The lowest permitted height [m].
    max_speed_m_s, acceleration_m_s2, stop_m_s2 : float
        Greatest speed, acceleration of moves, and deceleration of a stop.
    gripper_output : int or None
        Standard digital output that closes a gripper when high.
    gripper_s : float
        Time the gripper takes [s].
    watchdog_hz : float
        The controller stops the arm if there is no signal of this process for one period of this
        rate [Hz], for example when it is killed.
    poll_s, stall_s : float
        Parameters of the end of a move [s], as in `ArrivalRule`.
    """

    reach_m: Annotated[float, msgspec.Meta(gt=0, le=10)] = 0.85
    lower_z_m: float = 0.0
    max_speed_m_s: Annotated[float, msgspec.Meta(gt=0, le=10)] = 0.25
    acceleration_m_s2: Annotated[float, msgspec.Meta(gt=0, le=1000)] = 0.5
    stop_m_s2: Annotated[float, msgspec.Meta(ge=0.1, le=1000)] = 5.0
    gripper_output: Annotated[int, msgspec.Meta(ge=0, le=7)] | None = None
    gripper_s: Annotated[float, msgspec.Meta(ge=0, le=3600)] = 1.0
    watchdog_hz: Annotated[float, msgspec.Meta(ge=1, le=50)] = 5.0
    poll_s: Annotated[float, msgspec.Meta(ge=0, le=3600)] = 0.02
    stall_s: Annotated[float, msgspec.Meta(gt=0, le=3600)] = 1.0


class UniversalRobot(Arm):
    """A Universal Robots arm.

    Parameters
    ----------
    host : str
        Its address.
    options : UrOptions
        Its options.
    limits : Limits, optional
        Limits of commands; by default a half ball of `reach_m`.
    clock, sleep : callable
        Monotonic time [s], and a wait for a time on that clock [s].

    Raises
    ------
    MissingExtraError
        `ur_rtde` is not installed.
    """

    def __init__(
        self,
        host: str,
        options: UrOptions | None = None,
        *,
        limits: Limits | None = None,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._options = options = options or UrOptions()
        has_gripper = options.gripper_output is not None
        reach = options.reach_m
        super().__init__(
            limits
            or Limits(
                lower_m=(-reach, -reach, options.lower_z_m),
                upper_m=(reach, reach, reach),
                max_speed_m_s=options.max_speed_m_s,
                reach_m=reach,
                angles=frozenset(Angle),
                gripper=GripperKind.OPEN_CLOSE if has_gripper else GripperKind.NONE,
            ),
            arrival=ArrivalRule(poll_s=options.poll_s, stall_s=options.stall_s),
            clock=clock,
            sleep=sleep,
        )
        self._host = host
        self._control_library = require("rtde_control", "ur")
        self._receive_library = require("rtde_receive", "ur")
        self._io_library = require("rtde_io", "ur") if has_gripper else None
        self._control: Any = None
        self._receive: Any = None
        self._io: Any = None
        self._commands = threading.RLock()  # a signal handler may stop its own thread's command
        self._stop_waits = False  # a lock alone is not fair
        self._kicking: threading.Event | None = None  # set to end the watchdog thread

    def _open(self) -> None:
        self._close()  # two clients of one controller would write to the same registers
        with self._translated():
            self._receive = self._receive_library.RTDEReceiveInterface(self._host)
            try:
                self._control = self._control_library.RTDEControlInterface(self._host)
            except Exception as error:
                self._explain_no_control(error)
                raise
            if self._io_library is not None:
                self._io = self._io_library.RTDEIOInterface(self._host)
        self._send_stop()

    def _explain_no_control(self, error: Exception) -> None:
        """Raise an error with the cause of the library's exception, if it is known."""
        text = str(error).lower()
        if "remote control" in text:
            raise CommandRefusedError(REMOTE_CONTROL_OFF) from error
        if "control script" in text:  # uploaded, but not running
            self._see_to_faults()
            self._see_to_mode()
            if ur_dashboard.remote_control_is_off(self._host):
                raise CommandRefusedError(REMOTE_CONTROL_OFF) from error

    def _close(self) -> None:
        if self._kicking is not None:
            self._kicking.set()
        with self._holding(SCRIPT_START_S):  # a part that receives a command reopens itself
            parts = (self._control, self._receive, self._io)
            self._control = self._receive = self._io = self._kicking = None
            for part in parts:
                if part is not None:
                    self._disconnect(part)

    def _disconnect(self, part: Any) -> None:
        try:
            part.disconnect()
        except Exception as error:  # the other parts must be closed as well
            logger.warning("%s: closing the connection: %s", self._host, error)

    def _home(self, turn: Turn, report: Callable[[str], None]) -> None:
        """Start the control script with its watchdog; encoders are absolute, so nothing moves."""
        self._check(turn)
        self._see_to_faults()
        with self._translated():
            self._see_to_mode()
            if not (self._control.isProgramRunning() and self._set_watchdog()):
                report("starting the control script")
                self._start_script(turn)
        report("absolute encoders: no motion needed")

    def _start_script(self, turn: Turn) -> None:
        """Upload the control script, wait until it runs, and set its watchdog."""
        with self._commanding():
            uploaded = self._control.reuploadScript()
        end_s = self._clock() + SCRIPT_START_S
        while not self._control.isProgramRunning():
            if not uploaded or self._clock() > end_s:
                raise self._without_script("the control script does not start")
            self._pause(self._options.poll_s, turn)
        if not self._set_watchdog():
            raise self._refusal("setWatchdog")

    def _set_watchdog(self) -> bool:
        """Set the controller's watchdog on this process; False if refused."""
        control = self._control
        if not hasattr(control, "setWatchdog"):
            logger.warning("this ur_rtde has no watchdog: the arm outlives a killed process")
            return True
        with self._commanding():
            if not control.setWatchdog(self._options.watchdog_hz):
                return False
        if self._kicking is None:
            self._kicking = done = threading.Event()
            threading.Thread(target=self._kick, args=(done,), name="ur", daemon=True).start()
        return True

    def _kick(self, done: threading.Event) -> None:
        """Signal the watchdog until the connection is closed or lost."""
        while True:
            with self._commanding():
                if done.is_set():
                    return
                try:
                    if self._control.isProgramRunning():
                        self._control.kickWatchdog()
                except Exception as error:  # the arm is stopped; the next command reports it
                    logger.warning("%s: the watchdog cannot be kicked: %s", self._host, error)
                    self._kicking = None
                    return
            done.wait(1 / (KICKS * self._options.watchdog_hz))

    def _start_move(self, pose: Pose, speed_m_s: float, turn: Turn) -> None:
        self._see_to_faults()
        with self._translated():
            self._see_to_script()
            if (angles := pose.angles()) is not None:
                turned = rotation_vector(tool_rotation(*angles)).tolist()
            else:
                turned = list(self._receive.getActualTCPPose())[3:]
            goal = [*pose.position_m.tolist(), *turned]
            with self._commanding():
                reachable = self._control.isPoseWithinSafetyLimits(goal)
            if not reachable:
                self._see_to_faults()  # False may also mean that no script accepted the command
                self._see_to_script()
                raise OutOfReachError(f"{pose} is outside the arm's own safety limits")
            accepted: list[bool] = []

            def send() -> None:
                with self._commanding():
                    accepted.append(
                        self._control.moveL(goal, speed_m_s, self._options.acceleration_m_s2, True)
                    )

            self._issue(send, turn)
            if not accepted[0]:
                raise self._refusal("moveL")

    def _read_pose(self, turn: Turn) -> Pose:
        self._check(turn)
        self._see_to_faults()
        with self._translated():
            self._see_to_script()
            x, y, z, *turned = (float(value) for value in self._receive.getActualTCPPose())
        pitch, roll, yaw = pose_angles(rotation_matrix(np.array(turned)))
        return Pose(x, y, z, pitch_rad=pitch, roll_rad=roll, yaw_rad=yaw)

    def _send_stop(self) -> None:
        control = self._control
        if control is None:
            raise ConnectionLostError(f"{self._host}: not connected")
        refusal = self._try_stop(control)
        if refusal is None or self._program_has_ended():
            return
        try:
            ur_dashboard.stop_program(self._host)
        except OSError as error:
            raise type(refusal)(
                f"{refusal}; nor could the program be stopped instead: {error}"
            ) from error
        logger.warning("%s; the program was stopped instead", refusal)

    def _try_stop(self, control: Any) -> RobotError | None:
        """Stop by the control script; return an error if that cannot have worked."""
        self._stop_waits = True
        try:
            with self._translated(), self._holding(COMMAND_S):
                self._stop_waits = False
                accepted = control.stopL(self._options.stop_m_s2, True)
                # Some versions of the library return None; False means that no script accepted it.
                if accepted is False or not control.isProgramRunning():
                    return CommandRefusedError("stopL was refused")
        except RobotError as error:
            return error
        finally:
            self._stop_waits = False
        return None

    def _program_has_ended(self) -> bool:
        """Whether no program that moves the arm runs or is paused."""
        try:
            return bool(self._receive.getRuntimeState() == PROGRAM_STOPPED)
        except Exception:
            return False

    def _move_gripper(self, opening: float, turn: Turn) -> None:
        self._see_to_faults()
        done: list[bool] = []
        with self._translated():
            self._issue(
                lambda: done.append(
                    self._io.setStandardDigitalOut(self._options.gripper_output, opening < 0.5)
                ),
                turn,
            )
        if not done[0]:
            self._see_to_faults()
            raise GripperError(f"digital output {self._options.gripper_output} was refused")
        self._pause(self._options.gripper_s, turn)

    def _see_to_faults(self) -> None:
        with self._translated():
            if not self._receive.isConnected():
                raise ConnectionLostError(f"{self._host}: connection lost")
            if self._receive.isEmergencyStopped():
                raise RobotFaultError(EMERGENCY_STOP)
            if self._receive.isProtectiveStopped():
                raise RobotFaultError(PROTECTIVE_STOP)

    def _see_to_mode(self) -> None:
        mode = self._receive.getRobotMode()
        if mode != MODE_RUNNING:
            raise RobotFaultError(
                f"robot mode {mode}: switch the arm on and release its brakes at the pendant",
                number=mode,
            )

    def _see_to_script(self) -> None:
        if not self._control.isProgramRunning():
            raise self._without_script(SCRIPT_STOPPED)

    def _without_script(self, otherwise: str) -> RobotFaultError:
        """Return the error for a control script that does not run."""
        self._see_to_faults()
        off = ur_dashboard.remote_control_is_off(self._host)
        return RobotFaultError(REMOTE_CONTROL_OFF if off else otherwise)

    def _refusal(self, command: str) -> RobotError:
        """Return the error for a command that the controller has refused."""
        self._see_to_faults()
        self._see_to_script()
        if ur_dashboard.remote_control_is_off(self._host):
            return CommandRefusedError(REMOTE_CONTROL_OFF)
        return CommandRefusedError(
            f"{command} was refused though the control script runs: see that remote control is on "
            "and that no other program uses the arm"
        )

    @contextmanager
    def _commanding(self) -> Iterator[None]:
        """Send a command after the previous one, and after any waiting stop."""
        while self._stop_waits:
            time.sleep(COMMAND_S / 10)
        with self._commands:
            yield

    @contextmanager
    def _holding(self, patience_s: float) -> Iterator[None]:
        """Wait for the previous command, but continue after a time."""
        held = self._commands.acquire(timeout=patience_s)
        try:
            yield
        finally:
            if held:
                self._commands.release()

    @contextmanager
    def _translated(self) -> Iterator[None]:
        """Convert the library's exceptions to `RobotError`s."""
        try:
            yield
        except FingerpostError:
            raise
        except (RuntimeError, OSError, AttributeError) as error:
            raise ConnectionLostError(f"{self._host}: {error}") from error
        except Exception as error:
            raise CommandRefusedError(f"{self._host}: {type(error).__name__}: {error}") from error
