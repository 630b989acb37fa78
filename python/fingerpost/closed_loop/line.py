"""The serial line between driver and controller in a simulated world, with its delays.

The driver is the one for real arms; it opens a pseudo-terminal and is unaware of the simulation.
Nothing depends on the wall clock: the world's time only advances where the driver waits, for the
bytes of an answer, for a silent controller, or in a sleep. A session is therefore reproducible to
the last bit, and as fast as it can be computed.
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
"""Number of queries of the time, without a sleep or a transfer, after which a caller is waiting."""

IDLE_S = 0.02
"""Time that passes for each such wait [s]: about the driver's read time-out."""


class LineTime:
    """The driver's interface to the world's time: a clock, a sleep and a tap of its line.

    Parameters
    ----------
    now : callable
        Returns the world's time [s].
    advance : callable
        Advances it by a time [s].
    serve : callable
        Lets the controller at the other end process and answer received bytes.
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
        """Advance the time [s]."""
        self._calls = 0
        self._advance(span_s)
        self._serve()

    def tap(self, way: str, data: bytes) -> None:
        """Account for a transfer; received bytes include the echo of those sent, and take time."""
        self._calls = 0
        if way == "out":
            self._serve()
        else:
            self._advance(len(data) * self._byte_s)


class LineToScorbot:
    """An emulated controller on a pseudo-terminal, and its driver.

    Parameters
    ----------
    controller : AclController
        The controller.
    now, advance : callable
        The world's time [s], and the function that advances it.
    options : ScorbotOptions
        Options of the driver.

    Attributes
    ----------
    robot : Scorbot
        The driver, not yet connected; a `with` block connects the controller and homes it.
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
        """All transfers: whether the controller sent it, and its bytes."""
        return [(event.sent, event.data) for event in self._plugged.wire]

    @property
    def answered_bytes(self) -> int:
        """Number of bytes sent by the controller, including the echo of every command."""
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
