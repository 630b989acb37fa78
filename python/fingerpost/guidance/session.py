"""A session of guidance: fixes and keys in, and the arm follows, picks and places.

Three threads. The caller's reads the views and hands every step to `Session.take`, which never
waits for the arm; a `Worker` does what waits for it, one thing at a time, always on the newest fix;
the guard's watch stops the arm when what it needs ends. Keys may come from a fourth, and the key
that stops does so there and then.
"""

from __future__ import annotations

import math
import threading
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from enum import StrEnum
from itertools import chain, pairwise, zip_longest
from types import TracebackType
from typing import Self

import numpy as np

from fingerpost.capture import Frame
from fingerpost.errors import InvalidInputError
from fingerpost.pipeline import Step
from fingerpost.pointing import FingerLine, Fix, Status
from fingerpost.robot import (
    DwellSelector,
    Follower,
    FollowReport,
    FollowState,
    Guard,
    NotArmedError,
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

KEY_HELP = (
    "s select   x or Esc stop   c arm again and continue   u undo   w (held) make way   q quit"
)

HIDDEN_S = 2.0
"""A hand without a fix for so long may be hidden: the operator is told of the key [s]."""


class Attendance(StrEnum):
    """What shows that the operator is there; `Guard` stops the arm when it has been missing."""

    HAND = "hand"
    """His hand is tracked in a view; while the arm stands, it may be away."""
    KEY = "key"
    """He presses keys, or holds one down: a dead-man's switch."""


class Worker:
    """Does one thing at a time in a thread; of those that wait, the newest. A context manager."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._job: Callable[[], None] | None = None
        self._busy = False
        self._closing = False
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="worker", daemon=True)

    @property
    def idle(self) -> bool:
        """Whether there is nothing to do."""
        with self._changed:
            return self._job is None and not self._busy

    def offer(self, job: Callable[[], None]) -> None:
        """Do this next, in place of whatever waits."""
        with self._changed:
            self._job = job
            self._changed.notify_all()

    def check(self) -> None:
        """Raise what a job has raised; nothing more is done after that."""
        if self._error is not None:
            raise self._error

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        with self._changed:
            self._closing = True
            self._job = None
            self._changed.notify_all()
        self._thread.join()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._job is not None or self._closing)
                job, self._job = self._job, None
                if job is None:
                    return
                self._busy = True
            try:
                job()
            except BaseException as error:  # whatever it is, the caller's thread must hear of it
                self._error = error
                return
            finally:
                with self._changed:
                    self._busy = False


@dataclass
class SessionReport:
    """What happened in a session.

    Attributes
    ----------
    fixes
        How many, by status.
    states
        What the follower did with those it took, by state.
    lags_s
        How late the smoothing made each target [s].
    blocks
        Blocks picked and placed.
    """

    fixes: Counter[str] = field(default_factory=Counter)
    states: Counter[str] = field(default_factory=Counter)
    lags_s: list[float] = field(default_factory=list)
    blocks: int = 0

    def add(self, report: FollowReport) -> None:
        """Count what the follower did."""
        self.states[report.state.value] += 1
        if report.target is not None:
            self.lags_s.append(report.lag_s)

    def lag_ms(self) -> dict[str, float] | None:
        """Return least, median and largest lag of the smoothing [ms], if there was any."""
        lags_s = [lag_s for lag_s in self.lags_s if lag_s > 0]  # the first point passes as it is
        if not lags_s:
            return None
        least, median, largest = 1000 * np.percentile(lags_s, [0, 50, 100])
        return {"least": float(least), "median": float(median), "largest": float(largest)}

    def lines(self) -> list[str]:
        """Return the summary, a line each."""
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
    """Follow mode, and on top of it picking and placing; a context manager.

    What the arm has raised last is raised on leaving, if nothing else ends the block.

    Parameters
    ----------
    guard
        Armed, the gripper in the safe region.
    follower
        Follows between selections.
    attendance
        What shows that the operator is there.
    selector
        Selects by dwelling as well as by key; None selects by key alone.
    carry
        Heights and grip of picking and placing; None only follows.
    step_by_step
        Every step of picking and placing waits for the key that continues.
    blocks
        Blocks to carry until the session is done.
    keys
        Whether there are keys: without them, a guard that has been halted ends the session.
    say
        Called with what the operator should know, a line each.
    on_report
        Called with every report of the follower and its fix, in the worker's thread.
    """

    def __init__(
        self,
        guard: Guard,
        follower: Follower,
        *,
        attendance: Attendance = Attendance.HAND,
        selector: DwellSelector | None = None,
        carry: PickPlaceOptions | None = None,
        step_by_step: bool = False,
        blocks: int = 1,
        keys: bool = False,
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
        self._worker = Worker()
        self._pressed: deque[str] = deque()
        self._selections: list[Selection] = []
        self._machine: PickPlace | None = None
        self._paused = False
        self._quit = False
        self._told_disarmed = False
        self._last: FollowReport | None = None
        self._making_way = False
        self._aside = False
        self._seen_s: float | None = None

    @property
    def done(self) -> bool:
        """Whether the operator has quit, or all blocks have been carried."""
        return self._quit or (self._carry is not None and self.report.blocks >= self._blocks)

    def __enter__(self) -> Self:
        self._worker.__enter__()
        if self._carry is not None:
            self._say("point at the block")
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        # Before the worker is waited for: what it waits for is the arm.
        try:
            self._guard.__exit__(kind, error, trace)
        finally:
            self._worker.__exit__(kind, error, trace)
        if kind is None:
            self._worker.check()  # what it did last, no step has asked about

    def press(self, key: str) -> None:
        """Take a key, from any thread; the key that stops does so at once."""
        if self._attendance is Attendance.KEY or key == AWAY_KEY:
            self._guard.heartbeat()
        if key in STOP_KEYS:
            self._guard.halt("stopped by key")
        else:
            self._pressed.append(key)

    def leave(self) -> None:
        """Take it that the operator's terminal is gone, from any thread."""
        self._guard.halt("the terminal is gone")
        self._quit = True

    def take(self, step: Step) -> None:
        """Take a step of the views.

        Raises
        ------
        NotArmedError
            The guard has been halted and there are no keys to arm it again.
        RobotError
            The arm's; it has been stopped.
        """
        fix = step.fix
        self.report.fixes[fix.status.value] += 1
        self._guard.observe(fix)
        moving = self._guard.busy or self._making_way
        if self._attendance is Attendance.HAND and (_hand_seen(step) or not moving):
            self._guard.heartbeat()
        self._worker.check()
        self._obey(fix)
        if not self._guard.armed:
            self._wait_for_arming()
        elif self._machine is not None:
            self._go_on_carrying(self._machine)
        elif not self._making_way:
            self._worker.offer(lambda: self._follow(fix))
            self._tell_of_hidden_hand(fix)
            if self._dwell is not None and self._carry is not None:
                self._selected(self._dwell.update(fix, self._last))

    # What the operator wants.

    def _obey(self, fix: Fix) -> None:
        while self._pressed:
            key = self._pressed.popleft()
            if key == QUIT_KEY:
                self._quit = True
            elif key in SELECT_KEYS:
                self._select_now(fix)
            elif key == AWAY_KEY:
                self._start_making_way()
            elif key in (CONTINUE_KEY, UNDO_KEY):
                self._continue(undo=key == UNDO_KEY)

    def _select_now(self, fix: Fix) -> None:
        if self._carry is None or self._machine is not None or not self._guard.armed:
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
            self._say(f"next: {self._machine.next_step}   {KEY_HELP}")

    def _continue(self, *, undo: bool) -> None:
        if not self._worker.idle and self._machine is not None:
            return  # a step is being taken: only a stop may come in between
        if not self._guard.armed:
            self._guard.arm()
            self._told_disarmed = False
            self._say("armed")
        machine = self._machine
        if machine is None:
            return
        if undo:
            self._paused = True
            self._worker.offer(lambda: self._undo(machine))
        else:
            self._paused = self._step_by_step
            self._worker.offer(lambda: self._advance(machine))

    def _start_making_way(self) -> None:
        """Take it that the key is held: it repeats, and one retreat answers all of it."""
        idle = self._machine is None and not self._making_way and not self._aside
        if idle and self._guard.armed:
            self._making_way = True
            self._worker.offer(self._make_way)

    def _tell_of_hidden_hand(self, fix: Fix) -> None:
        """Tell once that a hand without a fix for long may be hidden."""
        if fix.status is Status.OK:
            self._seen_s = fix.time_s
        elif self._keys and self._seen_s is not None and fix.time_s - self._seen_s > HIDDEN_S:
            self._seen_s = None
            self._say(f"no fix for {HIDDEN_S:g} s: hold {AWAY_KEY} down to have the arm make way")

    def _wait_for_arming(self) -> None:
        self._last = None
        if self._quit:
            return
        why = self._guard.why_stopped or "never armed"
        if not self._keys:
            raise NotArmedError(f"stopped: {why}")
        self._paused = True
        if not self._told_disarmed:
            self._say(f"stopped: {why}   {KEY_HELP}")
            self._told_disarmed = True

    # What the worker does.

    def _follow(self, fix: Fix) -> None:
        before = self._last
        try:
            self._last = report = self._follower.update(fix)
        except (NotArmedError, StoppedError):
            self._last = None  # halted meanwhile; the next step says so
            return
        self.report.add(report)
        held = before is not None and before.state is FollowState.HOLDING
        if report.state is FollowState.HOLDING and not held:
            self._say(f"holding: {report.reason}")
        self._aside = self._aside and report.state is not FollowState.MOVING
        self._on_report(report.fix or fix, report)

    def _make_way(self) -> None:
        self._say("making way ...")
        self._last = None
        try:
            self._guard.make_way()
        except (NotArmedError, StoppedError):
            pass  # halted meanwhile; the next step says so
        except RefusedError as error:
            self._say(f"not out of the way: {error}")
        else:
            self._aside = True
            self._say("out of the way")
        finally:
            self._follower.reset()
            self._making_way = False

    def _go_on_carrying(self, machine: PickPlace) -> None:
        if not self._worker.idle:
            return
        if machine.done:
            self._machine = None
            self._last, self._aside = None, False
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
        except (NotArmedError, StoppedError):
            self._paused = True
            return
        self._paused = self._step_by_step
        if self._paused and machine.next_step is not None:
            self._say(f"next: {machine.next_step}   {KEY_HELP}")

    def _undo(self, machine: PickPlace) -> None:
        try:
            step = machine.undo()
        except (NotArmedError, StoppedError):
            return
        except NotReadyError as error:
            self._say(str(error))
            return
        self._say(f"{step} undone   {KEY_HELP}")


@contextmanager
def attended(guard: Guard) -> Iterator[None]:
    """Take it that the operator is there as long as the block lasts, as he has just started it.

    For what a person starts and watches over; the signals that end a program end this too.
    """
    done = threading.Event()

    def beat() -> None:
        while not done.wait(guard.options.operator_timeout_s / 5):
            guard.heartbeat()

    thread = threading.Thread(target=beat, name="attended", daemon=True)
    guard.heartbeat()
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


def attended_at_first(guard: Guard, steps: Iterator[Step]) -> Iterator[Step]:
    """Give steps; until there is the first, take it that the operator is there.

    The first frames take longest, on a slow computer longer than he may be missing, and before
    them nothing moves the arm.
    """
    with attended(guard):
        first = next(steps, None)
    if first is not None:
        yield first
        yield from steps


def paced(
    frames: Iterator[Sequence[Frame | None]],
    clock: Callable[[], float],
    sleep: Callable[[float], None],
) -> Iterator[Sequence[Frame | None]]:
    """Play a recording as if it were live: each frame when it is due, and stamped with that time.

    Whoever is slower than the recording misses frames, as with cameras: of those that are due by
    the time he asks for the next, each view's newest is given. Otherwise he would see the hand ever
    later.

    Parameters
    ----------
    frames
        Of recorded views.
    clock
        The time to stamp them with [s]; the first frame is due at once.
    sleep
        Waits for so many seconds of it.
    """
    begin_s = math.nan  # nothing is before or after it: until there is a frame, none is due
    newest: Sequence[Frame | None] = ()
    for together, following in pairwise(chain(frames, [()])):
        newest = [old if new is None else new for new, old in zip_longest(together, newest)]
        if math.isnan(begin_s):
            begin_s = clock() - _last_s(newest)
        if begin_s + _last_s(following) <= clock():
            continue
        if (early_s := begin_s + _last_s(newest) - clock()) > 0:
            sleep(early_s)
        yield [
            None if frame is None else replace(frame, time_s=begin_s + frame.time_s)
            for frame in newest
        ]
        newest = ()


def _last_s(frames: Sequence[Frame | None]) -> float:
    return max((frame.time_s for frame in frames if frame is not None), default=math.nan)


def _hand_seen(step: Step) -> bool:
    return any(isinstance(one.finger, FingerLine) for one in step.observations)


def _counts(counter: Counter[str]) -> str:
    return ", ".join(f"{count} {name}" for name, count in counter.most_common()) or "none"
