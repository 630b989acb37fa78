"""State shared by all clients: the rig, the newest moment, the player, and who has control."""

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
"""Greatest number of open pages."""

_STATE_S = 0.2
_LIVE_STRIP = 3600  # moments in the strip of a live run: two minutes at 30 a second
_MOST_NOTES = 50


class Watcher(Protocol):
    """A client's interface to the hub."""

    def offer(self, message: bytes, begun_s: float | None) -> None:
        """Queue the newest moment; `begun_s` is None for one that is shown again."""

    def send_state(self) -> None:
        """Send the state."""


class Hub:
    """The displayed state and the clients; for use in one thread only.

    Parameters
    ----------
    ask
        Called with the total number of steps that the loop may make; infinity for a live one.
    hand
        Called with the commands while a rig is set up.
    guide
        Called with the commands to the arm, if there is one.
    clock
        Returns the time [s].
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
        self._stopped = self._awaits_page = False
        self._ended = ""
        self._notes: list[str] = []
        self._tasks: list[asyncio.Task[None]] = []

    def start(self) -> None:
        """Begin to send the state to clients regularly, in the running event loop."""
        self._tasks.append(asyncio.create_task(self._send_state_regularly()))

    def open_rig(self, rig: RigScene) -> None:
        """Set the rig of the following moments, in place of a previous one."""
        self.close_rig()
        self._end_experiment()
        self.rig, self.newest, self._shown, self._ended = rig, None, -1, ""
        self._stopped, self._setup, self._arm = False, None, None
        self.strip = Strip(_LIVE_STRIP if rig.is_live else None)
        if rig.is_live:
            self._ask(math.inf)
        else:
            self._awaits_page = rig.awaits_page and not self.watchers
            self._player = Player(
                self._ask, self._show, rig.frames, self._clock, is_playing=not self._awaits_page
            )
            self._tasks.append(asyncio.create_task(self._player.run()))
        self.send_state()

    def open_setup(self, state: dict[str, Any]) -> None:
        """Show the state of a rig's set-up."""
        self._setup = state
        self.send_state()

    def show_still(self, place: int, jpeg: bytes) -> None:
        """Show the newest picture of an offered source, by its index."""
        while len(self.stills) <= place:
            self.stills.append(b"")
            self._stills_shown.append(0)
        self.stills[place] = jpeg
        self._stills_shown[place] += 1

    @property
    def drop_folder(self) -> Path | None:
        """Folder for recordings that are dropped onto the page; None unless a rig is set up."""
        return None if self._setup is None else Path(self._setup["folder"])

    def dropped(self, path: Path) -> None:
        """Report that a recording has been dropped onto the page."""
        self._hand(Dropped(path))

    def close_rig(self) -> None:
        """Discard the rig's stored moments."""
        if self._player is not None:
            self._tasks.pop().cancel()
            self._player.reel.close()
            self._player = None

    def arrived(self, message: Message) -> None:
        """Add the next moment of the loop."""
        self.strip.append(message.codes)
        if self._player is not None:
            self._player.arrived(message)
            return
        self._shown, self.newest = message.number, message.data
        for watcher in self.watchers:
            watcher.offer(message.data, message.begun_s)
        self._try_with(message.indicated)

    def show_arm(self, state: dict[str, Any]) -> None:
        """Show the state of an arm, which the page may command from now on."""
        self._arm = state
        self.send_state()

    def note(self, words: str) -> None:
        """Show a message to the user, one line."""
        self._notes = [*self._notes, words][-_MOST_NOTES:]
        self.send_state()

    def end(self, words: str) -> None:
        """Report the end of the moments, with the reason."""
        self._ended, self._arm = words, None
        if self._player is not None:
            self._player.end()
        self.send_state()

    def add(self, watcher: Watcher) -> None:
        """Add a client; a recording that awaits the first one begins."""
        if self._player is not None and self._awaits_page:
            self._player.play()
        self._awaits_page = False
        self.watchers.add(watcher)
        if self.newest is not None:
            watcher.offer(self.newest, None)
        self.send_state()

    def remove(self, watcher: Watcher) -> None:
        """Remove a client."""
        self.watchers.discard(watcher)
        if self.controller is watcher:
            self._hand_over(None)
        self.send_state()

    def obey(self, command: Command, watcher: Watcher) -> str:
        """Execute a client's command; return the reason if it is refused, else an empty string.

        Any client may stop. All other commands are reserved to the client in control; if there is
        none, a command takes control.
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
        """Give control to a client; an arm controlled by another one stops."""
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
        if self._arm is not None:  # the arm stops, the display continues
            self._guide(Stop())
            return
        self._stopped = True
        self._player.stop() if self._player else self._ask(0.0)

    def state(self, watcher: Watcher, known: tuple[object, int]) -> dict[str, Any]:
        """Return the state for a client as JSON values, with the changes since its last one.

        Parameters
        ----------
        watcher
            The client.
        known
            The client's strip and its length; if the strip has changed, the rig is sent as well.
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
        """Send the state to every client."""
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
        """Execute a command in an experiment; return the reason for a refusal, else ""."""
        if what is Try.START and self.rig is not None:
            from fingerpost.live.trials import OperatorExperiment, new_table  # rarely needed

            self._end_experiment()
            try:
                self._experiment = OperatorExperiment(
                    self.rig, new_table(Path.cwd()), np.random.default_rng()
                )
            except InvalidInputError as error:
                return str(error)
            if self._player is not None and self._shown >= 0:  # a stopped one shows no more
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
