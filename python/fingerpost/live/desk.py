"""Guides an arm from the operator's page.

The arm moves only under two conditions: it has been armed by an explicit command, which is valid
until a stop; and a button or a key is held down, for which the page sends heartbeats. A missing
heartbeat, a page that disconnects and a released button stop the arm. A stop never waits: it is
passed to the guard by the thread that reads the page's commands, whereas the session executes all
other commands at the next step of the views.
"""

from __future__ import annotations

import logging
import math
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np

from fingerpost.guidance import Activity, Attendance, GuidedArm, Session
from fingerpost.live.commands import Ask, Beat, Gone, LetGo, RobotCommand, Stop, Wish
from fingerpost.robot import Guard, Robot, RobotState
from fingerpost.robot.errors import RobotError
from fingerpost.robot.guard import RecordCallback
from fingerpost.robot.stopping import WATCH_S

_log = logging.getLogger(__name__)

SILENT_S = 0.4
"""Time without a heartbeat after which a page that held the button counts as disconnected [s]."""

OPERATOR_TIMEOUT_S = 0.45
"""Time-out of the guard, in case the watch of the heartbeats itself fails [s]."""

MOST_BLOCKS = 2**31 - 1
"""Number of blocks of a session on the page: unlimited."""

_POST_S = 0.1
_UNDO, _WAY = Wish.UNDO, Wish.WAY
_ACTIVITIES = {Wish.FOLLOW: Activity.FOLLOW, Wish.CARRY: Activity.CARRY, Wish.HOME: Activity.HOME}
_KEYS = {Wish.SELECT: "s", Wish.HAND: "h"}


class Desk:
    """Executes the commands of an operator at the page.

    Parameters
    ----------
    guard, robot
        The arm and its guard.
    carries
        Whether it can pick and place.
    clock
        Returns the time [s].
    """

    def __init__(
        self,
        guard: Guard,
        robot: Robot,
        *,
        carries: bool,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._guard, self._robot, self._carries, self._clock = guard, robot, carries, clock
        self._session: Session | None = None
        self._wish = Wish.FOLLOW
        self._is_armed = False
        self._holds = False
        self._beat_s = -math.inf
        self._said = ""
        self._marks: dict[str, Any] = {}
        self._posted: dict[str, Any] = {}
        self._posted_s = -math.inf

    def add_marks(self, marks: dict[str, Any]) -> None:
        """Add known objects to the plan: a block, and its destination."""
        self._marks = marks

    def keep(self, words: str) -> None:
        """Store a message of the session for display."""
        self._said = words.strip()

    @contextmanager
    def opened(self, session: Session) -> Iterator[Session]:
        """Guide the arm by a session, initially idle, for the duration of the block."""
        self._session = session
        try:
            yield session
        finally:
            self._session = None

    def obey(self, command: RobotCommand) -> None:
        """Execute a command of the page, from any thread; a stop takes effect at once."""
        match command:
            case Stop():
                self._stop("STOP was pressed")
            case Gone():
                self._stop("the page is gone")
            case LetGo():
                self._let_go("let go")
            case Beat():
                self._beat()
            case Ask(what=what):
                self._ask(what)

    # Commands that stop the arm.

    def _stop(self, why: str) -> None:
        self._is_armed = self._holds = False
        self._guard.halt(why)

    def _let_go(self, why: str) -> None:
        if self._holds:
            self._holds = False
            self._guard.halt(why)

    # Commands that move the arm.

    def _beat(self) -> None:
        self._beat_s = self._clock()
        if self._holds:
            self._guard.heartbeat()
        elif self._is_armed and self._session is not None:
            self._guard.heartbeat()
            self._holds = True
            self._begin(self._session)

    def _ask(self, what: Wish) -> None:
        session = self._session
        if session is None:
            return
        if what is Wish.ARM:
            self._is_armed = True
        elif what is Wish.DISARM:
            self._stop("disarmed")
        elif what in _KEYS:
            session.press(_KEYS[what])
        elif what is not Wish.CARRY or self._carries:
            self._wish = what
            if self._holds:
                self._begin(session)

    def _begin(self, session: Session) -> None:
        """Start the chosen activity, for as long as the button is held."""
        if self._wish is _UNDO:
            session.press("u")
        elif self._wish is _WAY:
            session.take_up(Activity.STAY)
            session.press("c")
            session.press("w")
        else:
            activity = _ACTIVITIES[self._wish]
            session.take_up(activity)
            if activity is not Activity.HOME:
                session.press("c")

    # Watch and display.

    def tick(self, post: Callable[[dict[str, Any]], None]) -> None:
        """Stop motion without a held button, and update the display; call it every `WATCH_S`.

        Parameters
        ----------
        post
            Called with the arm's state for the page.
        """
        session, now_s = self._session, self._clock()
        if session is None:
            return
        if self._holds and now_s - self._beat_s > SILENT_S:
            self._stop("the page is silent")
        self._stop_homing_unheld(session)
        if now_s - self._posted_s >= _POST_S:
            state = self._state(session)
            if state != self._posted:
                post(state)
            self._posted, self._posted_s = state, now_s

    def _stop_homing_unheld(self, session: Session) -> None:
        """Stop homing without a held button: the guard does not stop it just before it begins."""
        if session.is_homing and not self._holds:
            with suppress(RobotError):
                if self._robot.status().state is RobotState.HOMING:
                    self._guard.halt("nobody holds")

    def _state(self, session: Session) -> dict[str, Any]:
        """Return the arm's state for the page, as JSON values."""
        status = self._robot.status()
        pose = self._guard.pose
        return {
            **self._marks,
            "homed": status.homed,
            "armed": self._is_armed,
            "holds": self._holds,
            "moves": self._guard.busy or session.is_homing,
            "wish": self._wish.value,
            "carries": self._carries,
            "carrying": session.is_carrying,
            "stranger": session.sees_stranger,
            "dwell": round(session.dwell_progress, 2),
            "why": self._why(session, homed=status.homed),
            "said": self._said,
            "pose_mm": None if pose is None else np.round(1e3 * pose.position_m, 1).tolist(),
            "region": self._guard.region.corners.tolist(),
            "body": [
                [round(float(x), 4) for x in (*part.start[:2], *part.end[:2], part.radius)]
                for part in self._guard.body()
            ],
        }

    def _why(self, session: Session, *, homed: bool) -> str:
        """Return why the arm stands; empty while it carries out its activity."""
        if session.is_homing:
            return ""
        why = self._guard.why_stopped
        if not self._is_armed:
            return f"not armed: {why}" if why else "not armed"
        if not self._holds:
            return "not held" if homed or self._wish is Wish.HOME else "not held, not homed yet"
        if not self._guard.armed:
            return why
        return session.waits_for


class GuidingDesk:
    """A desk with its arm, which it connects, watches and guides.

    Parameters
    ----------
    arm
        The arm.
    home
        Homes the arm.
    signals
        Signals that halt the arm; in the main thread only.
    """

    def __init__(
        self,
        arm: GuidedArm,
        home: Callable[[], None],
        *,
        signals: Sequence[signal.Signals] = (),
    ) -> None:
        self.arm = arm
        self.desk = Desk(arm.guard, arm.robot, carries=arm.options.carry is not None)
        self._home, self._signals = home, signals

    @contextmanager
    def guiding(
        self,
        post: Callable[[dict[str, Any]], None],
        on_record: RecordCallback | None = None,
    ) -> Iterator[Session]:
        """Connect the arm and yield the session that processes the steps of the views.

        Parameters
        ----------
        post
            Called with the arm's state for the page, from a thread.
        on_record
            Called with every command of the guard.

        Raises
        ------
        RobotError
            An error of the arm.
        """
        with self.arm.connected(on_record=on_record, signals=self._signals):
            session = self.arm.session(
                attendance=Attendance.KEY,
                blocks=MOST_BLOCKS,
                keys=True,
                home=self._home,
                activity=Activity.STAY,
                key_help="",
                say=self.desk.keep,
            )
            with self.desk.opened(session), self._watching(post), session:
                yield session

    @contextmanager
    def _watching(self, post: Callable[[dict[str, Any]], None]) -> Iterator[None]:
        done = threading.Event()

        def watch() -> None:
            while not done.wait(WATCH_S):
                try:
                    self.desk.tick(post)
                except Exception as error:  # the watch must continue after any error
                    _log.exception("the desk's watch failed")
                    self.arm.guard.halt(f"the desk's watch failed: {error}")

        thread = threading.Thread(target=watch, name="desk", daemon=True)
        thread.start()
        try:
            yield
        finally:
            done.set()
            thread.join()
