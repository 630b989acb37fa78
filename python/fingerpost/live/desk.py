"""The operator's page as the place from which an arm is guided.

Two things must come together before the arm moves. It is armed by an explicit command, which lasts
until a stop; and a button or a key is held down, of which the page sends beats. A beat that stays
out, a page that goes away and a hand that lets go stop the arm. A stop never waits: it goes to the
guard from the thread that reads the page's commands, while everything else is taken up by the
session on the next step of the views.
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
"""A page that holds and has sent no beat for so long has gone [s]."""

OPERATOR_TIMEOUT_S = 0.45
"""For the guard, should the watch of the beats fail itself [s]."""

MOST_BLOCKS = 2**31 - 1
"""A session on the page ends by no number of blocks."""

_POST_S = 0.1
_UNDO, _WAY = Wish.UNDO, Wish.WAY
_ACTIVITIES = {Wish.FOLLOW: Activity.FOLLOW, Wish.CARRY: Activity.CARRY, Wish.HOME: Activity.HOME}
_KEYS = {Wish.SELECT: "s", Wish.HAND: "h"}


class Desk:
    """What an operator at the page has an arm do.

    Parameters
    ----------
    guard, robot
        The arm's.
    carries
        Whether it can pick and place.
    clock
        Gives the time in seconds.
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
        self._heard_s = -math.inf
        self._said = ""
        self._marks: dict[str, Any] = {}
        self._posted: dict[str, Any] = {}
        self._posted_s = -math.inf

    def add_marks(self, marks: dict[str, Any]) -> None:
        """Show on the plan what else is known to be there: a block, and where it goes."""
        self._marks = marks

    def keep(self, words: str) -> None:
        """Keep what the session says, to be shown."""
        self._said = words.strip()

    @contextmanager
    def opened(self, session: Session) -> Iterator[Session]:
        """Guide the arm by a session, which does nothing at first, as long as the block lasts."""
        self._session = session
        try:
            yield session
        finally:
            self._session = None

    def obey(self, command: RobotCommand) -> None:
        """Take a command of the page, from any thread; what stops does so at once."""
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

    # What stops.

    def _stop(self, why: str) -> None:
        self._is_armed = self._holds = False
        self._guard.halt(why)

    def _let_go(self, why: str) -> None:
        if self._holds:
            self._holds = False
            self._guard.halt(why)

    # What moves.

    def _beat(self) -> None:
        self._heard_s = self._clock()
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
        """Have the arm do what was chosen, as long as it is held."""
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

    # What is watched and shown.

    def tick(self, post: Callable[[dict[str, Any]], None]) -> None:
        """Stop what nobody holds any more, and show how things stand; call it every `WATCH_S`.

        Parameters
        ----------
        post
            Called with what the page shows of the arm.
        """
        session, now_s = self._session, self._clock()
        if session is None:
            return
        if self._holds and now_s - self._heard_s > SILENT_S:
            self._stop("the page is silent")
        self._stop_homing_unheld(session)
        if now_s - self._posted_s >= _POST_S:
            state = self._state(session)
            if state != self._posted:
                post(state)
            self._posted, self._posted_s = state, now_s

    def _stop_homing_unheld(self, session: Session) -> None:
        """Homing is no motion of the guard's: a stop just before it has begun does not reach it."""
        if session.is_homing and not self._holds:
            with suppress(RobotError):
                if self._robot.status().state is RobotState.HOMING:
                    self._guard.halt("nobody holds")

    def _state(self, session: Session) -> dict[str, Any]:
        """Return what the page shows of the arm, fit for JSON."""
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
        """Say why the arm stands; empty while it does what it is to do."""
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
    """A desk with its arm, which is connected, watched and guided for a while.

    Parameters
    ----------
    arm
        The arm.
    home
        Homes it.
    signals
        That halt the arm; in the main thread only.
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
        """Connect the arm and give the session that takes the steps of the views.

        Parameters
        ----------
        post
            Called with what the page shows of the arm, from a thread.
        on_record
            Called with every command of the guard.

        Raises
        ------
        RobotError
            The arm's.
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
                except Exception as error:  # a watch that ended would watch nothing
                    _log.exception("the desk's watch failed")
                    self.arm.guard.halt(f"the desk's watch failed: {error}")

        thread = threading.Thread(target=watch, name="desk", daemon=True)
        thread.start()
        try:
            yield
        finally:
            done.set()
            thread.join()
