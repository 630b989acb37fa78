"""The serial line between driver and controller inside a simulated world, and the time it takes.

The driver is the one that drives real arms; it opens a pseudo-terminal and knows nothing of the
simulation. But nothing here waits for a clock on the wall. The world's time goes on only where the
driver waits: for the bytes of an answer to come over the line, for a controller that is silent, or
because it sleeps. So a session is the same to the last bit every time, and as fast as it can be
computed.
"""

from __future__ import annotations

from collections.abc import Callable
from types import TracebackType
from typing import Self

from fingerpost.robot.emulator.acl import AclController
from fingerpost.robot.emulator.ports import PluggedController, PtyPort
from fingerpost.robot.scorbot import Scorbot, ScorbotOptions

BITS_PER_BYTE = 10
"""A start bit, eight of data, a stop bit."""

IDLE_CALLS = 8
"""Who asks for the time more often than this, and neither sleeps nor hears anything, is waiting."""

IDLE_S = 0.02
"""How long it waits each time [s]: the driver listens in spells of about this length."""


class LineTime:
    """The world's time as a driver sees it: a clock, a sleep and a tap of its line.

    Parameters
    ----------
    now : callable
        The world's time [s].
    advance : callable
        Lets so many seconds of it pass.
    serve : callable
        Has the controller at the other end take and answer what was sent.
    baud : int
        Bits per second of the line.
    """

    def __init__(
        self,
        now: Callable[[], float],
        advance: Callable[[float], None],
        serve: Callable[[], None],
        baud: int,
    ) -> None:
        self._now = now
        self._advance = advance
        self._serve = serve
        self._byte_s = BITS_PER_BYTE / baud
        self._calls = 0

    def __call__(self) -> float:
        """Return the time [s]."""
        self._calls += 1
        if self._calls > IDLE_CALLS:
            self._advance(IDLE_S)
            self._serve()
        return self._now()

    def sleep(self, span_s: float) -> None:
        """Let a span of time pass [s]."""
        self._calls = 0
        self._advance(span_s)
        self._serve()

    def tap(self, way: str, data: bytes) -> None:
        """See a transfer; what comes back holds the echo of what went out, and takes its time."""
        self._calls = 0
        if way == "out":
            self._serve()
        else:
            self._advance(len(data) * self._byte_s)


class LineToScorbot:
    """An emulated controller on a pseudo-terminal, and the driver that talks to it.

    Parameters
    ----------
    controller : AclController
        The controller.
    now, advance : callable
        The world's time [s], and what lets it pass.
    options : ScorbotOptions
        The driver's.

    Attributes
    ----------
    robot : Scorbot
        Not yet connected; a `with` block plugs the controller in, connects and homes it.
    """

    def __init__(
        self,
        controller: AclController,
        now: Callable[[], float],
        advance: Callable[[float], None],
        options: ScorbotOptions,
    ) -> None:
        self._plugged = PluggedController(controller, PtyPort(), clock=now)
        self._now = now
        self._advance = advance
        self._options = options
        self.robot: Scorbot

    @property
    def transfers(self) -> list[tuple[bool, bytes]]:
        """Every transfer so far: whether the controller sent it, and its bytes."""
        return [(event.sent, event.data) for event in self._plugged.wire]

    @property
    def answered_bytes(self) -> int:
        """How many bytes the controller has sent; the echo of every command is among them."""
        return sum(len(data) for sent, data in self.transfers if sent)

    def __enter__(self) -> Self:
        self._plugged.__enter__()
        time = LineTime(self._now, self._advance, self._plugged.serve, self._options.baud)
        self.robot = Scorbot(
            self._plugged.address, self._options, tap=time.tap, clock=time, sleep=time.sleep
        )
        try:
            self.robot.connect()
            self.robot.home()
        except BaseException:
            self._plugged.__exit__(None, None, None)
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.robot.close()
        self._plugged.__exit__(kind, error, trace)
