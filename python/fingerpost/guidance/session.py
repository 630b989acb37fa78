"""A session of guidance: by fixes and keys the arm follows, picks and places.

Three threads are involved. The caller's thread reads the views and passes every step to
`Session.take`, which never waits for the arm. A `Worker` executes the jobs that wait for the arm,
one at a time, always with the newest fix. The guard's watch stops the arm when one of its
conditions fails. Keys may come from a fourth thread; the stop key takes effect in that thread.
"""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from enum import StrEnum
from types import TracebackType
from typing import Self

import numpy as np

from fingerpost.errors import InvalidInputError
from fingerpost.guidance.attendance import Attendance
from fingerpost.guidance.worker import Jobs, Worker
from fingerpost.pipeline import Step
from fingerpost.pointing import FingerLine, Fix, Status
from fingerpost.robot import (
    DwellSelector,
    Follower,
    FollowReport,
    FollowState,
    Guard,
    NotArmedError,
    NotHomedError,
    NotReadyError,
    PickPlace,
    PickPlaceOptions,
    RefusedError,
    Selection,
    StoppedError,
)

STOP_KEYS = "x\x1b"
SELECT_KEYS = "s\r\n"
CONTINUE_KEY, UNDO_KEY, QUIT_KEY = "c", "u", "q"
AWAY_KEY = "w"
HAND_KEY = "h"

KEY_HELP = (
    "space (held) keep the arm live   x or Esc stop   c arm again and continue   h this is my hand"
    "   s select   u undo   w (held) make way   q quit"
)

HIDDEN_S = 2.0
"""Time without a fix after which a hand may be hidden, and the key is shown to the operator [s]."""

HALTED = (NotArmedError, NotHomedError, StoppedError)
"""Errors of a command that the guard has halted meanwhile, or that the arm cannot execute before
it is homed again, such as one without encoders after a stop in motion."""

POLL_S = 0.02
"""Interval at which keys are polled while nothing else happens [s]."""

STRANGER = "nothing shows that this hand is the operator's"
"""Reason for ignoring the fix of a hand that has not been confirmed as the operator's."""


class Activity(StrEnum):
    """Activity of the arm while the guard is armed."""

    STAY = "stay"
    """It stands still."""
    FOLLOW = "follow"
    """It moves to the indicated point."""
    CARRY = "carry"
    """It follows, and picks and places selected blocks."""
    HOME = "home"
    """It homes, then stands still."""


@dataclass
class SessionReport:
    """Statistics of a session.

    Attributes
    ----------
    fixes
        Number of fixes by status.
    states
        Number of fixes given to the follower, by its resulting state.
    lags_s
        Delay of each target by the smoothing [s].
    blocks
        Number of blocks picked and placed.
    """

    fixes: Counter[str] = field(default_factory=Counter)
    states: Counter[str] = field(default_factory=Counter)
    lags_s: list[float] = field(default_factory=list)
    blocks: int = 0

    def add(self, report: FollowReport) -> None:
        """Count a report of the follower."""
        self.states[report.state.value] += 1
        if report.target is not None:
            self.lags_s.append(report.lag_s)

    def lag_ms(self) -> dict[str, float] | None:
        """Return least, median and largest lag of the smoothing [ms]; None without any."""
        lags_s = [lag_s for lag_s in self.lags_s if lag_s > 0]  # the first point is not smoothed
        if not lags_s:
            return None
        least, median, largest = 1000 * np.percentile(lags_s, [0, 50, 100])
        return {"least": float(least), "median": float(median), "largest": float(largest)}

    def lines(self) -> list[str]:
        """Return the summary, line by line."""
        said = ["fixes    " + _counts(self.fixes)]
        if self.states:
            said.append("arm      " + _counts(self.states))
        if (lag := self.lag_ms()) is not None:
            said.append(
                f"lag      smoothing makes the target late by {lag['least']:.0f} ms for a quick "
                f"hand, {lag['largest']:.0f} ms for one at rest (median {lag['median']:.0f} ms)"
            )
        if self.blocks:
            said.append(f"blocks   {self.blocks} picked and placed")
        return said

    def as_dict(self) -> dict[str, object]:
        """Return the summary for programs."""
        return {
            "fixes": dict(self.fixes),
            "states": dict(self.states),
            "lag_ms": self.lag_ms(),
            "blocks": self.blocks,
        }


class Session:
    """Following, with optional picking and placing; a context manager.

    The last error of the arm is raised on exit, unless another exception ends the block.

    Parameters
    ----------
    guard
        Armed guard, with the gripper in the safe region.
    follower
        Follows between selections.
    attendance
        Evidence of the operator's presence. A hand is evidence once it is confirmed as the
        operator's.
    selector
        Selects by dwelling, in addition to the key; None selects by key alone.
    carry
        Heights and grip of picking and placing; None only follows.
    step_by_step
        Whether every step of picking and placing waits for the key to continue.
    blocks
        Number of blocks to carry until the session is done.
    keys
        Whether there are keys: without them, a halted guard ends the session.
    home
        Homes an arm that has lost its position, on the key to continue; None ends the session.
    activity
        Initial activity; by default `CARRY` with `carry`, else `FOLLOW`.
    key_help
        Text appended to messages that request a key.
    worker
        Executes the jobs that wait for the arm.
    sleep
        Waits for a time on the guard's clock [s].
    say
        Called with messages for the operator, one line each.
    on_report
        Called with every report of the follower and its fix, in the worker's thread.
    """

    def __init__(
        self,
        guard: Guard,
        follower: Follower,
        *,
        attendance: Attendance = Attendance.KEY,
        selector: DwellSelector | None = None,
        carry: PickPlaceOptions | None = None,
        step_by_step: bool = False,
        blocks: int = 1,
        keys: bool = False,
        home: Callable[[], None] | None = None,
        activity: Activity | None = None,
        key_help: str = KEY_HELP,
        worker: Jobs | None = None,
        sleep: Callable[[float], None] = time.sleep,
        say: Callable[[str], None] = lambda _: None,
        on_report: Callable[[Fix, FollowReport], None] = lambda _fix, _report: None,
    ) -> None:
        self.report = SessionReport()
        self._guard = guard
        self._follower = follower
        self._attendance = attendance
        self._dwell = selector
        self._select = selector or DwellSelector(guard)
        self._carry = carry
        self._step_by_step = step_by_step
        self._blocks = blocks
        self._keys = keys
        self._say = say
        self._on_report = on_report
        self._worker = worker or Worker()
        self._home = home
        self._activity = activity or (Activity.FOLLOW if carry is None else Activity.CARRY)
        self._key_help = f"   {key_help}" if key_help else ""
        self._is_homing = False
        self._sleep = sleep
        self._pressed: deque[tuple[str | Activity, int]] = deque()
        self._selections: list[Selection] = []
        self._machine: PickPlace | None = None
        self._paused = False
        self._quit = False
        self._reported_stop: str | None = None
        self._last: FollowReport | None = None
        self._making_way = False
        self._is_out_of_the_way = False
        self._usable_s: float | None = None
        self._hand: int | None = None
        self._reported_hand: int | None = None
        self._sees_stranger = False

    @property
    def has_hand(self) -> bool:
        """Whether a hand has been confirmed as the operator's."""
        return self._hand is not None

    @property
    def is_out_of_the_way(self) -> bool:
        """Whether the arm has retreated and stands there."""
        return self._is_out_of_the_way

    @property
    def activity(self) -> Activity:
        """Activity of the arm while the guard is armed."""
        return self._activity

    @property
    def is_homing(self) -> bool:
        """Whether the arm is being homed, or is about to be."""
        return self._is_homing

    @property
    def next_step(self) -> str:
        """Next step of picking and placing, while it waits for the key; else empty."""
        step = None if self._machine is None or not self._paused else self._machine.next_step
        return "" if step is None else str(step)

    @property
    def waits_for(self) -> str:
        """Why the arm holds while it follows; empty if it does not."""
        last = self._last
        return last.reason if last is not None and last.state is FollowState.HOLDING else ""

    @property
    def dwell_progress(self) -> float:
        """Fraction of the dwell time that has passed, 0 to 1."""
        return 0.0 if self._dwell is None or not self._carries else self._dwell.progress

    @property
    def sees_stranger(self) -> bool:
        """Whether a hand points that has not been confirmed as the operator's."""
        return self._sees_stranger

    @property
    def is_carrying(self) -> bool:
        """Whether a block is being picked and placed."""
        return self._machine is not None

    @property
    def selections(self) -> int:
        """Number of points that the operator has selected, including completed ones."""
        under_way = 2 if self._machine is not None else len(self._selections)
        return 2 * self.report.blocks + under_way

    @property
    def done(self) -> bool:
        """Whether the operator has quit, or all blocks have been carried."""
        return self._quit or (self._carry is not None and self.report.blocks >= self._blocks)

    def __enter__(self) -> Self:
        self._worker.__enter__()
        if self._carries:
            self._say("point at the block")
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        # Stop the arm first: the worker may be waiting for it.
        try:
            self._guard.__exit__(kind, error, trace)
        finally:
            self._worker.__exit__(kind, error, trace)
        if kind is None:
            self._worker.check()  # for an error since the last step

    def begin(self) -> None:
        """Arm the guard, move the gripper into the safe region, and return when it is there.

        If a key proves the operator's presence, one must be held down first. With keys, a stop on
        the way does not end the session: the key to continue arms the guard again.

        Raises
        ------
        NotArmedError
            Stopped on the way, and there are no keys.
        RobotError
            An error of the arm, which has been stopped.
        """
        holds_key = self._attendance is Attendance.KEY
        if holds_key:
            self._say(f"hold the space bar down: the arm moves only while you do{self._key_help}")
            self._wait_for_key()
        while not self._quit:
            try:
                self._guard.arm()
                with nullcontext() if holds_key else self._guard.attended():
                    self._guard.enter()
                self._reported_stop = None
                return
            except (NotArmedError, StoppedError):
                self._say_stopped()
                self._wait_for_key(CONTINUE_KEY)

    def _wait_for_key(self, wanted: str = "") -> None:
        """Wait for one of these keys, or for any if none is given, or for the key that quits."""
        while not self._quit:
            while self._pressed:
                key, _ = self._pressed.popleft()
                if key == QUIT_KEY:
                    self._quit = True
                elif not wanted or str(key) in wanted:
                    return
            self._sleep(POLL_S)

    def press(self, key: str) -> None:
        """Process a key, from any thread; the stop key takes effect at once."""
        if self._attendance is Attendance.KEY or key == AWAY_KEY:
            self._guard.heartbeat()
        if key in STOP_KEYS:
            self._guard.halt("stopped by key")
        else:
            self._pressed.append((key, self._guard.disarmings))

    def take_up(self, activity: Activity) -> None:
        """Change the activity from the next step on, from any thread.

        If the arm follows next, picking and placing is abandoned, wherever the block is by then.

        Parameters
        ----------
        activity
            `Activity.CARRY` requires `carry`, and `Activity.HOME` requires `home`.

        Raises
        ------
        InvalidInputError
            The session has no such activity.
        """
        if (activity is Activity.CARRY and self._carry is None) or (
            activity is Activity.HOME and self._home is None
        ):
            raise InvalidInputError(f"the activity is {activity}; this session has none such")
        self._pressed.append((activity, self._guard.disarmings))

    def leave(self) -> None:
        """Handle the loss of the operator's terminal, from any thread."""
        self._guard.halt("the terminal is gone")
        self._quit = True

    def take(self, step: Step) -> None:
        """Process a step of the views.

        Raises
        ------
        NotArmedError
            The guard has been halted and there are no keys to arm it again.
        RobotError
            An error of the arm, which has been stopped.
        """
        self.report.fixes[step.fix.status.value] += 1
        fix = self._own(step)
        self._guard.observe(fix)
        moving = self._guard.busy or self._making_way
        if self._attendance is Attendance.HAND and (self._sees_hand(step) or not moving):
            self._guard.heartbeat()
        self._worker.check()
        self._obey(step, fix)
        if not self._guard.armed:
            self._wait_for_arming()
        elif self._activity in (Activity.STAY, Activity.HOME):
            self._stay()
        elif self._machine is not None and self._carries:
            self._go_on_carrying(self._machine)
        elif not self._making_way:
            self._worker.offer(lambda: self._follow(fix))
            self._report_hidden_hand(fix)
            if self._dwell is not None and self._carries and self._machine is None:
                self._selected(self._dwell.update(fix, self._last))

    # Identity of the hand.

    def _own(self, step: Step) -> Fix:
        """Return the fix if it is of the operator's hand; else one without a point."""
        hand, fix = step.hand, step.fix
        if hand.is_presented:
            self._accept_hand(hand.number)
        self._sees_stranger = fix.status is Status.OK and hand.number != self._hand
        if not self._sees_stranger:
            return fix
        if self._reported_hand != hand.number:
            self._reported_hand = hand.number
            key = f", or press {HAND_KEY} if it is yours" if self._keys else ""
            self._say(f"{STRANGER}: bring it to its template and hold it there{key}")
        return replace(fix, status=Status.LOST, point=None, covariance=None, reason=STRANGER)

    def _accept_hand(self, number: int) -> None:
        if self._hand != number:
            self._hand = number
            self._say("following this hand")

    def _sees_hand(self, step: Step) -> bool:
        """Whether the operator's hand is tracked in a view."""
        is_tracked = any(isinstance(one.finger, FingerLine) for one in step.observations)
        return is_tracked and step.hand.number == self._hand

    # The operator's commands.

    @property
    def _carries(self) -> bool:
        return self._activity is Activity.CARRY

    def _obey(self, step: Step, fix: Fix) -> None:
        while self._pressed:
            key, disarmings = self._pressed.popleft()
            if isinstance(key, Activity):
                self._change_activity(key, disarmings)
            elif key == QUIT_KEY:
                self._quit = True
            elif key in SELECT_KEYS:
                self._select_now(fix)
            elif key == HAND_KEY and step.fix.status is Status.OK:
                self._accept_hand(step.hand.number)
            elif key == AWAY_KEY:
                self._start_making_way()
            elif key in (CONTINUE_KEY, UNDO_KEY):
                self._continue(disarmings, undo=key == UNDO_KEY)

    def _change_activity(self, activity: Activity, disarmings: int) -> None:
        self._last = None
        if activity is Activity.HOME:
            self._start_homing(disarmings)
        elif (
            activity is Activity.CARRY
            and self._activity is not Activity.CARRY
            and self._machine is None
        ):
            self._selections = []
            self._say("point at the block")
        elif activity is Activity.FOLLOW and self._machine is not None:
            self._machine = None
            self._follower.reset()
        self._activity = activity

    def _start_homing(self, disarmings: int) -> None:
        is_void = disarmings != self._guard.disarmings
        if self._home is None or self._is_homing or is_void:
            return
        if self._guard.armed:
            self._guard.halt("homing")
        self._is_homing = True
        home = self._home
        self._worker.offer(lambda: self._do_home(home, None))

    def _stay(self) -> None:
        if self._guard.busy and self._worker.idle:
            self._guard.hold("nothing to do")

    def _select_now(self, fix: Fix) -> None:
        if not self._carries or self._machine is not None or not self._guard.armed:
            return
        try:
            self._selected(self._select.select(fix))
        except RefusedError as error:
            self._say(f"not selected: {error}")

    def _selected(self, selection: Selection | None) -> None:
        if selection is None or self._carry is None:
            return
        x, y = selection.point
        what = ("block", "place")[len(self._selections)]
        try:
            PickPlace(self._guard, selection, selection, self._carry)
        except InvalidInputError as error:
            self._say(f"{what} not taken: {error}")
            return
        self._say(f"{what} at ({x:.4f}, {y:.4f})")
        self._selections.append(selection)
        if len(self._selections) < 2:
            self._say("point at its new place")
            return
        pick, place = self._selections
        self._selections = []
        self._machine = PickPlace(self._guard, pick, place, self._carry)
        self._paused = self._step_by_step
        if self._paused:
            self._say(f"next: {self._machine.next_step}{self._key_help}")

    def _continue(self, disarmings: int, *, undo: bool) -> None:
        if self._is_homing or (not self._worker.idle and self._machine is not None):
            return  # a step is in progress: only a stop may interrupt it
        machine = self._machine
        if undo and machine is None:
            self._say("nothing to undo")
            return
        if not (self._guard.armed or self._arm_again(disarmings)):
            return
        if machine is None:
            return
        if undo:
            self._paused = True
            self._worker.offer(lambda: self._undo(machine))
        else:
            self._paused = self._step_by_step
            self._worker.offer(lambda: self._advance(machine))

    def _arm_again(self, disarmings: int) -> bool:
        """Arm after a stop; home the arm first if necessary; report why if that is impossible.

        A command that was given before the last stop is void.
        """
        try:
            self._guard.arm(disarmings)
        except NotHomedError:
            if self._home is None:
                raise
            home, self._is_homing = self._home, True
            self._worker.offer(lambda: self._do_home(home, disarmings))
            return False
        except (NotReadyError, StoppedError) as error:
            self._say(f"not armed: {error}")
            return False
        self._reported_stop = None
        self._say("armed")
        return True

    def _start_making_way(self) -> None:
        """Start one retreat for a key that is held down and repeats."""
        idle = self._machine is None and not self._making_way and not self._is_out_of_the_way
        if idle and self._guard.armed:
            self._making_way = True
            self._worker.offer(self._make_way)

    def _report_hidden_hand(self, fix: Fix) -> None:
        """Report once that a hand without a usable fix for a long time may be hidden."""
        if not self._guard.doubt(fix):
            self._usable_s = fix.time_s
        elif self._keys and self._usable_s is not None and fix.time_s - self._usable_s > HIDDEN_S:
            self._usable_s = None
            self._say(
                f"no usable fix for {HIDDEN_S:g} s: if the arm hides the hand, "
                f"hold {AWAY_KEY} down to have it make way"
            )

    def _wait_for_arming(self) -> None:
        self._last = None
        if self._quit:
            return
        self._paused = True
        if self._why_stopped != self._reported_stop:  # a stop may turn out to have failed
            self._say_stopped()

    def _say_stopped(self) -> None:
        """Report why the arm has been stopped.

        Raises
        ------
        NotArmedError
            There are no keys to arm it again.
        """
        why = self._reported_stop = self._why_stopped
        if not self._keys:
            raise NotArmedError(f"stopped: {why}")
        self._say(f"stopped: {why}{self._key_help}")

    @property
    def _why_stopped(self) -> str:
        return self._guard.why_stopped or "never armed"

    # Jobs of the worker.

    def _follow(self, fix: Fix) -> None:
        before = self._last
        try:
            if not self._guard.is_inside():
                self._say("entering the safe region")
                self._guard.enter()
                return
            self._last = report = self._follower.update(fix)
            if report.state is FollowState.HOLDING:
                self._guard.locate()  # for its silhouette in the views
        except HALTED:
            self._last = None  # the next step reports it
            return
        self.report.add(report)
        held = before is not None and before.state is FollowState.HOLDING
        if report.state is FollowState.HOLDING and not held:
            self._say(f"holding: {report.reason}")
        self._is_out_of_the_way = self._is_out_of_the_way and report.state is not FollowState.MOVING
        self._on_report(report.fix or fix, report)

    def _do_home(self, home: Callable[[], None], disarmings: int | None) -> None:
        """Home the arm; then arm it, if `disarmings` is still the guard's count; not with None."""
        self._say("homing; the arm moves")
        try:
            home()
            if disarmings is not None:
                self._guard.arm(disarmings)
                self._guard.enter()
        except HALTED:
            return  # the next step reports it
        finally:
            self._is_homing = False
        self._reported_stop = None
        self._say("homed" if disarmings is None else f"armed   {CONTINUE_KEY} continues")

    def _make_way(self) -> None:
        self._say("making way ...")
        self._last = None
        try:
            self._guard.make_way()
        except HALTED:
            pass  # the next step reports it
        except RefusedError as error:
            self._say(f"not out of the way: {error}")
        else:
            self._is_out_of_the_way = True
            self._say("out of the way")
        finally:
            self._follower.reset()
            self._making_way = False

    def _go_on_carrying(self, machine: PickPlace) -> None:
        if not self._worker.idle:
            return
        if machine.done:
            self._machine = None
            self._last, self._is_out_of_the_way = None, False
            self._follower.reset()
            self.report.blocks += 1
            self._say("placed")
            if not self.done:
                self._say("point at the block")
        elif not self._paused:
            self._worker.offer(lambda: self._advance(machine))

    def _advance(self, machine: PickPlace) -> None:
        step = machine.next_step
        if step is None:
            return
        self._say(f"{step} ...")
        try:
            machine.advance()
        except HALTED:
            self._paused = True
            return
        self._paused = self._step_by_step
        if self._paused and machine.next_step is not None:
            self._say(f"next: {machine.next_step}{self._key_help}")

    def _undo(self, machine: PickPlace) -> None:
        try:
            step = machine.undo()
        except HALTED:
            return
        except NotReadyError as error:
            self._say(str(error))
            return
        self._say(f"{step} undone{self._key_help}")


def _counts(counter: Counter[str]) -> str:
    return ", ".join(f"{count} {name}" for name, count in counter.most_common()) or "none"
