"""A stand-in for the three modules of `ur_rtde` and the Universal Robots controller behind them.

`libraries` returns the modules' classes for the test's own process; `serve` answers those in
`stand_ins`, in a subprocess that may be killed. The controller behaves like the real one: only a
running control script accepts commands; a protective stop pauses it; stopping the program at the
pendant ends it; the watchdog ends it if nothing is written for a period.
"""

# ruff: noqa: ARG002, N802 - the vendor's names and parameters

import contextlib
import itertools
import json
import socketserver
import threading
import time
from enum import IntEnum

from fake_arm import FakeArm
from scipy.spatial.transform import Rotation

TAKES_S = 0.002
"""Time to accept a command, one cycle of an e-series."""


class Program(IntEnum):
    """The relevant states of a program, by the library's numbers."""

    STOPPED = 1
    PLAYING = 2
    PAUSED = 4


class UrController:
    """One arm, its control script, and actions at the pendant."""

    def __init__(self, *, patience=1.0):
        """Create a controller whose watchdog waits `patience` periods, for loaded machines."""
        self.arm = FakeArm()
        self.patience = patience
        self.program = Program.STOPPED
        self.mode = 7
        self.connected = True
        self.remote_control = True
        self.emergency = self._protective = False
        self.accepts = self.reachable = self.starts = True
        self.stuck = False
        self.stop_error = None
        self.outputs = {}
        self.uploads = self.clients = self.kicks = 0
        self.overlaps = 0
        self.watchdog_hz = None
        self._paused_goal = None
        self._written_s = time.monotonic()
        self._writing = threading.Lock()

    # At the pendant.

    @property
    def protective(self):
        """Whether the arm is in a protective stop."""
        return self._protective

    @protective.setter
    def protective(self, stopped):
        if stopped:
            self._protective = True
            self.pause()
        else:  # unlocked; a paused program may be resumed
            self._protective = False

    def pause(self):
        """Pause the program; `resume` continues the motion."""
        if self.program is Program.PLAYING:
            self.program = Program.PAUSED
            self._paused_goal = self.arm.goal
            self.arm.stop()

    def resume(self):
        """Continue a paused program."""
        if self.program is Program.PAUSED:
            self.program = Program.PLAYING
            self.arm.go(self._paused_goal, self.arm.rotation, self.arm.speed)

    def stop_program(self, at_s=None):
        """End the program and all motion."""
        self.program, self.watchdog_hz, self._paused_goal = Program.STOPPED, None, None
        self.arm.stop(at_s)

    # Called by the modules.

    def look(self):
        """End the program if the watchdog's period has expired."""
        if self.watchdog_hz is not None and self.program is Program.PLAYING:
            end_s = self._written_s + self.patience / self.watchdog_hz
            if time.monotonic() > end_s:
                self.stop_program(end_s)

    def upload(self):
        """Receive a control script, and run it if permitted."""
        self.uploads += 1
        if self.remote_control and self.starts and not (self._protective or self.emergency):
            self.stop_program()
            self.program = Program.PLAYING

    def takes(self):
        """Accept a command; return False if no script does."""
        if not self._writing.acquire(blocking=False):
            self.overlaps += 1  # simultaneous commands would overwrite each other's registers
            return False
        try:
            self.look()
            time.sleep(TAKES_S)
            if self.program is not Program.PLAYING:
                return False
            self._written_s = time.monotonic()
            return True
        finally:
            self._writing.release()


def libraries(controller):
    """Return the classes of the vendor's modules by module name."""

    class RTDEControlInterface:
        def __init__(self, hostname):
            if hostname == "nobody":
                raise RuntimeError("connect: No route to host")
            if not controller.remote_control:
                raise RuntimeError("ur_rtde: Please enable remote control on the robot!")
            controller.clients += 1
            controller.upload()
            if controller.program is not Program.PLAYING:
                raise RuntimeError(
                    "ur_rtde: Failed to start control script, before timeout of 5 seconds"
                )

        def isProgramRunning(self):
            controller.look()
            return controller.program is Program.PLAYING

        def reuploadScript(self):
            controller.upload()
            return True

        def setWatchdog(self, min_frequency=10.0):
            if not controller.takes():
                return False
            controller.watchdog_hz = min_frequency
            return True

        def kickWatchdog(self):
            controller.kicks += 1
            return controller.takes()

        def moveL(self, pose, speed=0.25, acceleration=1.2, asynchronous=False):
            assert asynchronous, "a blocking moveL would keep the stop from the arm"
            assert len(pose) == 6
            if not (controller.takes() and controller.accepts):
                return False
            if not controller.stuck:
                controller.arm.go(pose[:3], Rotation.from_rotvec(pose[3:]), speed)
            return True

        def stopL(self, a=10.0, asynchronous=False):
            if controller.stop_error is not None:
                raise controller.stop_error
            if controller.takes():
                controller.arm.stop()

        def isPoseWithinSafetyLimits(self, pose):
            return controller.takes() and controller.reachable

        def disconnect(self):
            pass

    class RTDEReceiveInterface:
        def __init__(self, hostname):
            pass

        def isConnected(self):
            return controller.connected

        def isEmergencyStopped(self):
            return controller.emergency

        def isProtectiveStopped(self):
            return controller.protective

        def getRobotMode(self):
            return controller.mode

        def getRuntimeState(self):
            controller.look()
            return int(controller.program)

        def getActualTCPPose(self):
            controller.look()
            return [*map(float, controller.arm.position()), *controller.arm.rotation.as_rotvec()]

        def disconnect(self):
            pass

    class RTDEIOInterface:
        def __init__(self, hostname):
            pass

        def setStandardDigitalOut(self, output_id, signal_level):
            controller.outputs[output_id] = signal_level
            return controller.accepts

        def disconnect(self):
            pass

    return {
        "rtde_control": RTDEControlInterface,
        "rtde_receive": RTDEReceiveInterface,
        "rtde_io": RTDEIOInterface,
    }


class _Lines(socketserver.ThreadingTCPServer):
    """A line-based server on a free loopback port, in a thread."""

    daemon_threads = True

    def __init__(self, answering):
        super().__init__(("127.0.0.1", 0), socketserver.StreamRequestHandler)
        self.answering = answering

    @property
    def port(self):
        return self.server_address[1]

    def finish_request(self, request, client_address):
        request.settimeout(None)  # some libraries set a time-out for the whole process
        answer = self.answering()
        with request.makefile("rwb") as text, contextlib.suppress(ConnectionError):
            for line in itertools.chain([answer(None)], map(answer, text)):
                if line:
                    text.write(line + b"\n")
                    text.flush()


@contextlib.contextmanager
def _serving(answering):
    with _Lines(answering) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.02,))
        thread.start()
        try:
            yield server.port
        finally:
            server.shutdown()
            thread.join()


def dashboard(controller):
    """Serve the controller's dashboard; yield its port."""
    answers = {
        b"is in remote control": lambda: b"true" if controller.remote_control else b"false",
        b"stop": lambda: controller.stop_program() or b"Stopped",
    }

    def answer(line):
        if line is None:
            return b"Connected: Universal Robots Dashboard Server"
        known = answers.get(line.strip(), lambda: b"could not understand: " + line.strip())
        return known()

    return _serving(lambda: answer)


def serve(controller):
    """Serve the modules in `stand_ins` from this process; yield the port."""

    def answering():
        parts = []

        def answer(line):
            if line is None:
                return None
            name, arguments = json.loads(line)
            try:
                if not parts:
                    parts.append(libraries(controller)[name](*arguments))
                    return b"[null, null]"
                return json.dumps([getattr(parts[0], name)(*arguments), None]).encode()
            except RuntimeError as error:
                return json.dumps([None, str(error)]).encode()

        return answer

    return _serving(answering)
