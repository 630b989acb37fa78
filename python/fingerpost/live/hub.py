"""What all clients share: the rig, the newest moment, how a recording is played, who commands."""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from fingerpost.errors import InvalidInputError
from fingerpost.live.commands import (
    Ask,
    Beat,
    Command,
    Experiment,
    Gone,
    GoTo,
    LetGo,
    Play,
    RobotCommand,
    Step,
    Stop,
    Take,
    Try,
)
from fingerpost.live.player import Player
from fingerpost.live.reel import Indicated, Message, Strip
from fingerpost.live.scene import RigScene
from fingerpost.live.setup.asked import Dropped, SetUpCommand

if TYPE_CHECKING:
    from fingerpost.live.trials import OperatorExperiment

MOST_CLIENTS = 12
"""Pages that may be open at once."""

_STATE_S = 0.2
_LIVE_STRIP = 3600  # moments of a live run that its strip shows: two minutes at 30 a second
_MOST_NOTES = 50


class Watcher(Protocol):
    """A client, as the hub knows it."""

    def offer(self, message: bytes, begun_s: float | None) -> None:
        """Take the newest moment; None where it is shown again."""

    def send_state(self) -> None:
        """Send the state anew."""


class Hub:
    """Everything there is to be shown, and who is shown it; for one thread alone.

    Parameters
    ----------
    ask
        Called with how many steps the loop may have made in all; infinity lets a live one go on.
    hand
        Called with what is asked for while a rig is set up.
    guide
        Called with what is asked of the arm, where there is one.
    clock
        Gives the time in seconds.
    """

    def __init__(
        self,
        ask: Callable[[float], None],
        hand: Callable[[SetUpCommand | Dropped], None] = lambda _wanted: None,
        guide: Callable[[RobotCommand], None] = lambda _command: None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.watchers: set[Watcher] = set()
        self.controller: Watcher | None = None
        self.rig: RigScene | None = None
        self.newest: bytes | None = None
        self.strip = Strip()
        self.stills: list[bytes] = []
        self._stills_shown: list[int] = []
        self._ask, self._hand, self._guide, self._clock = ask, hand, guide, clock
        self._arm: dict[str, Any] | None = None
        self._experiment: OperatorExperiment | None = None
        self._setup: dict[str, Any] | None = None
        self._player: Player | None = None
        self._shown = -1
        self._stopped = False
        self._ended = ""
        self._notes: list[str] = []
        self._tasks: list[asyncio.Task[None]] = []

    def start(self) -> None:
        """Begin to tell watchers of the state, in the running event loop."""
        self._tasks.append(asyncio.create_task(self._send_state_regularly()))

    def open_rig(self, rig: RigScene) -> None:
        """Take a rig from which moments will come, in place of any before."""
        self.close_rig()
        self._end_experiment()
        self.rig, self.newest, self._shown, self._ended = rig, None, -1, ""
        self._stopped, self._setup, self._arm = False, None, None
        self.strip = Strip(_LIVE_STRIP if rig.is_live else None)
        if rig.is_live:
            self._ask(math.inf)
        else:
            self._player = Player(self._ask, self._show, rig.frames, self._clock)
            self._tasks.append(asyncio.create_task(self._player.run()))
        self.send_state()

    def open_setup(self, state: dict[str, Any]) -> None:
        """Show how far a rig is set up."""
        self._setup = state
        self.send_state()

    def show_still(self, place: int, jpeg: bytes) -> None:
        """Take the newest picture of an offered source, by its place."""
        while len(self.stills) <= place:
            self.stills.append(b"")
            self._stills_shown.append(0)
        self.stills[place] = jpeg
        self._stills_shown[place] += 1

    @property
    def drop_folder(self) -> Path | None:
        """Where recordings that are dropped onto the page go; None while nothing is set up."""
        return None if self._setup is None else Path(self._setup["folder"])

    def dropped(self, path: Path) -> None:
        """Take it that a recording has been dropped onto the page."""
        self._hand(Dropped(path))

    def close_rig(self) -> None:
        """Forget the rig's recording."""
        if self._player is not None:
            self._tasks.pop().cancel()
            self._player.reel.close()
            self._player = None

    def arrived(self, message: Message) -> None:
        """Take the next moment that the loop has made."""
        self.strip.append(message.codes)
        if self._player is not None:
            self._player.arrived(message)
            return
        self._shown, self.newest = message.number, message.data
        for watcher in self.watchers:
            watcher.offer(message.data, message.begun_s)
        self._try_with(message.indicated)

    def show_arm(self, state: dict[str, Any]) -> None:
        """Show what an arm does now, which the page may command from here on."""
        self._arm = state
        self.send_state()

    def note(self, words: str) -> None:
        """Show a line that people should know of."""
        self._notes = [*self._notes, words][-_MOST_NOTES:]
        self.send_state()

    def end(self, words: str) -> None:
        """Take it that no more moments will come, and why."""
        self._ended, self._arm = words, None
        if self._player is not None:
            self._player.end()
        self.send_state()

    def add(self, watcher: Watcher) -> None:
        """Show everything to one more client."""
        self.watchers.add(watcher)
        if self.newest is not None:
            watcher.offer(self.newest, None)
        self.send_state()

    def remove(self, watcher: Watcher) -> None:
        """Forget a client."""
        self.watchers.discard(watcher)
        if self.controller is watcher:
            self._hand_over(None)
        self.send_state()

    def obey(self, command: Command, watcher: Watcher) -> str:
        """Do what a client commands; return why not, or nothing.

        Anybody may stop; all else is for one client at a time. Whoever commands while nobody does
        takes the control.
        """
        refusal = ""
        if isinstance(command, Stop):
            self._stop()
        elif isinstance(command, Beat | LetGo):
            if self._arm is not None and self.controller is watcher:
                self._guide(command)
            return ""
        elif isinstance(command, Take) or self.controller in (None, watcher):
            self._hand_over(watcher)
            if isinstance(command, Experiment):
                refusal = self._experiment_with(command.what)
            else:
                self._do(command)
        else:
            return "another page has the control; take it over first"
        self.send_state()
        return refusal

    def _hand_over(self, watcher: Watcher | None) -> None:
        """Give the control to a client; an arm that another one had moves no further."""
        if self.controller not in (None, watcher) and self._arm is not None:
            self._guide(Gone())
        self.controller = watcher

    def _do(self, command: Command) -> None:
        player = self._player
        match command:
            case Play():
                self._stopped = False
                player.play() if player else self._ask(math.inf)
            case Step(by=by) if player:
                player.step(by)
            case GoTo(number=number) if player:
                player.go_to(number)
            case _ if isinstance(command, SetUpCommand) and self._setup is not None:
                self._hand(command)
            case Ask() if self._arm is not None:
                self._guide(command)

    def _stop(self) -> None:
        if self._arm is not None:  # it stops, and its operator goes on seeing it
            self._guide(Stop())
            return
        self._stopped = True
        self._player.stop() if self._player else self._ask(0.0)

    def state(self, watcher: Watcher, known: tuple[object, int]) -> dict[str, Any]:
        """Return the state as a client gets it, fit for JSON, with what is new to it.

        Parameters
        ----------
        watcher
            The client.
        known
            The strip that it has, and how far; with another one it gets the rig as well.
        """
        strip, strip_from = known
        is_new = strip is not self.strip
        player = self._player
        playing = not self._stopped and not self._ended if player is None else player.is_playing
        state: dict[str, Any] = {
            "playing": playing,
            "setup": self._setup and {**self._setup, "pictures": self._stills_shown},
            "ended": self._ended,
            "shown": self._shown,
            "total": self.strip.end if player is None else player.total,
            "strip": self.strip.since(0 if is_new else strip_from),
            "notes": self._notes,
            "watchers": len(self.watchers),
            "controls": self.controller in (None, watcher),
            "arm": self._arm,
            "experiment": None if self._experiment is None else self._experiment.as_dict(),
        }
        if is_new:
            state["rig"] = None if self.rig is None else self.rig.as_dict()
        return state

    def send_state(self) -> None:
        """Send every client the state."""
        for watcher in self.watchers:
            watcher.send_state()

    async def _send_state_regularly(self) -> None:
        while True:
            await asyncio.sleep(_STATE_S)
            self.send_state()

    def _show(self, number: int, data: bytes) -> None:
        self._shown, self.newest = number, data
        for watcher in self.watchers:
            watcher.offer(data, None)
        if self._player is not None:
            self._try_with(self._player.reel.indicated(number))

    def _try_with(self, indicated: Indicated | None) -> None:
        if self._experiment is not None and indicated is not None:
            self._experiment.take(indicated)

    def _experiment_with(self, what: Try) -> str:
        """Do what an operator does in an experiment; return why not, or nothing."""
        if what is Try.START and self.rig is not None:
            from fingerpost.live.trials import OperatorExperiment, new_table  # seldom wanted

            self._end_experiment()
            try:
                self._experiment = OperatorExperiment(
                    self.rig, new_table(Path.cwd()), np.random.default_rng()
                )
            except InvalidInputError as error:
                return str(error)
            if self._player is not None and self._shown >= 0:  # one that stands shows no more
                self._try_with(self._player.reel.indicated(self._shown))
        elif self._experiment is None:
            return "no experiment has been started"
        elif what is Try.SELECT:
            return self._experiment.select()
        elif what is Try.SKIP:
            self._experiment.skip()
        elif what is Try.END and not self._experiment.is_over:
            self._experiment.end()
        elif what is Try.END:
            self._experiment = None
        return ""

    def _end_experiment(self) -> None:
        if self._experiment is not None:
            self._experiment.end()
            self._experiment = None
