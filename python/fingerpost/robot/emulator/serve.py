"""Connects and serves an emulated controller, with faults on demand and at random."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterable

import numpy as np

from fingerpost.checks import in_range
from fingerpost.errors import InvalidInputError
from fingerpost.robot.emulator.acl import AclController, AclStyle
from fingerpost.robot.emulator.faults import Fault
from fingerpost.robot.emulator.feetech import FeetechBus
from fingerpost.robot.emulator.gcode import MarlinController, UarmController, make_dexarm
from fingerpost.robot.emulator.ports import (
    ArmTime,
    Controller,
    Emulator,
    HostPort,
    Port,
    PtyPort,
    TcpPort,
)
from fingerpost.robot.emulator.rosbridge import RosbridgeServer

EMULATED = ("acl", "dexarm", "marlin", "rosbridge", "so101", "uarm")
"""Controllers that can be emulated, by the names of their drivers."""

HOMING_S = (1e-3, 3600.0)
"""Range of the duration of homing [s of the arm]."""

FAULTS_PER_S = (1e-6, 1000.0)
"""Range of the rate of random faults, if any [1/s]."""

UNPLUGGED_S = 0.5
"""Duration of a random disconnection [s]."""


def make_emulator(
    name: str,
    *,
    link: str | os.PathLike[str] | None = None,
    tcp_port: int | None = None,
    time_scale: float = 1.0,
    homing_s: float = 60.0,
    echo: bool = True,
    seed: int = 0,
) -> Emulator:
    """Make an emulated controller, to be connected by a `with` block.

    Parameters
    ----------
    name : str
        One of `EMULATED`.
    link : path, optional
        Path of the link to the pseudo-terminal; in a new directory by default.
    tcp_port : int, optional
        TCP port on the loopback to serve instead, 0 for a free one; `rosbridge` always uses TCP.
    time_scale : float
        Seconds of the arm per second of real time, as in `ArmTime`.
    homing_s : float
        Duration of homing [s of the arm], in `HOMING_S`.
    echo : bool
        Whether an ACL controller echoes.
    seed : int
        Seed of the faults' noise, ≥ 0.

    Returns
    -------
    Emulator
        Its `address` is what a driver opens.

    Raises
    ------
    InvalidInputError
        An unknown controller, a value out of range, or a link to a controller without a serial
        line.
    """
    homing_s = in_range(homing_s, "homing_s", *HOMING_S)
    controllers: dict[str, Callable[[], Controller]] = {
        "acl": lambda: AclController(AclStyle(echo=echo, homing_s=homing_s)),
        "dexarm": lambda: make_dexarm(homing_s),
        "marlin": lambda: MarlinController(homing_s=homing_s),
        "rosbridge": RosbridgeServer,
        "so101": FeetechBus,
        "uarm": UarmController,
    }
    if name not in controllers:
        raise InvalidInputError(f"{name!r} is not emulated; {', '.join(EMULATED)} are")
    port: Port
    if name == "rosbridge":
        if link is not None:
            raise InvalidInputError(f"{link}: rosbridge has no serial line; tcp_port is right")
        port = HostPort(port=tcp_port or 0)
    else:
        port = PtyPort(link) if tcp_port is None else TcpPort(port=tcp_port)
    return Emulator(
        controllers[name](),
        port,
        clock=ArmTime(time_scale),
        rng=_seeded(seed),
    )


def serve(
    emulator: Emulator,
    announce: Callable[[str], None],
    stop: threading.Event,
    *,
    orders: Iterable[str] = (),
    faults_per_s: float = 0.0,
    seed: int = 0,
) -> None:
    """Serve a controller until stopped.

    Parameters
    ----------
    emulator : Emulator
        The emulator, not yet connected.
    announce : callable
        Called with the address once a driver can open it, and with every fault.
    stop : threading.Event
        Set to end it.
    orders : iterable of str
        Names of faults to simulate as they arrive, such as lines of a terminal. Read in a thread.
    faults_per_s : float
        Mean rate of random faults [1/s of real time], 0 or in `FAULTS_PER_S`.
    seed : int
        Seed of these, ≥ 0.

    Raises
    ------
    InvalidInputError
        A value out of range.
    """
    if faults_per_s != 0:
        faults_per_s = in_range(faults_per_s, "faults_per_s", *FAULTS_PER_S)
    rng = _seeded(seed)
    with emulator:
        announce(emulator.address)
        reader = threading.Thread(target=_obey, args=(emulator, orders, announce), daemon=True)
        reader.start()
        while not stop.wait(rng.exponential(1 / faults_per_s) if faults_per_s else None):
            fault = Fault(rng.choice([one.value for one in Fault if one is not Fault.PLUG]))
            announce(fault.value)
            emulator.inject(fault)
            if fault is Fault.UNPLUG:
                stop.wait(UNPLUGGED_S)
                emulator.inject(Fault.PLUG)


def _seeded(seed: int) -> np.random.Generator:
    if seed < 0:
        raise InvalidInputError(f"seed is {seed}; a whole number from 0 is right")
    return np.random.default_rng(seed)


def _obey(emulator: Emulator, orders: Iterable[str], announce: Callable[[str], None]) -> None:
    for order in orders:
        word = order.strip().lower()
        if word in set(Fault):
            emulator.inject(Fault(word))
            announce(word)
        elif word:
            announce(f"{word!r} is no fault; there are {', '.join(Fault)}")
