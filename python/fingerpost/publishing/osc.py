"""`osc://` and `tuio://`: Open Sound Control by UDP, and the cursors of interactive tables.

TUIO 1.1 (Kaltenbrunner et al. 2005) is OSC with three messages per bundle: the present cursors
(`alive`), position and velocity of each (`set`), and the number of the frame (`fseq`).
"""

from __future__ import annotations

import contextlib
import math
import socket
from typing import TYPE_CHECKING

from fingerpost.errors import CaptureError, InvalidInputError
from fingerpost.installation import require
from fingerpost.publishing.address import Address
from fingerpost.publishing.fix import Extent, Pictures, PublishedFix
from fingerpost.uncertainty import confidence_ellipse

if TYPE_CHECKING:
    from pythonosc.osc_bundle_builder import OscBundleBuilder

_OSC_PORT, _TUIO_PORT = 9000, 3333
_TURNS = ("0", "90", "180", "270")
_CURSOR = "/tuio/2Dcur"
_LONGEST_STEP_S = 1.0
"""Absence of a hand after which its speed is not computed."""


class _Line:
    """UDP to one receiver.

    On most systems, a connected socket reports when there is no receiver.
    """

    def __init__(self, address: Address, port: int) -> None:
        try:
            family, kind, number, _, place = socket.getaddrinfo(
                address.host, address.port_or(port), type=socket.SOCK_DGRAM
            )[0]
        except socket.gaierror as error:
            raise InvalidInputError(f"{address.url}: unknown host {address.host!r}") from error
        self._socket = socket.socket(family, kind, number)
        self._socket.setblocking(False)
        try:
            self._socket.connect(place)
        except OSError as error:
            self._socket.close()
            raise InvalidInputError(
                f"{address.url}: cannot be reached: {error.strerror}"
            ) from error

    def send(self, bundle: OscBundleBuilder) -> None:
        try:
            self._socket.send(bundle.build().dgram)
        except ConnectionRefusedError as error:
            raise CaptureError("nobody listens there") from error

    def close(self) -> None:
        self._socket.close()


def _bundle() -> OscBundleBuilder:
    builder = require("pythonosc.osc_bundle_builder", "net")
    bundle: OscBundleBuilder = builder.OscBundleBuilder(builder.IMMEDIATELY)
    return bundle


def _add(bundle: OscBundleBuilder, path: str, *values: tuple[str, float | str | int]) -> None:
    """Add a message; each value with its type: i, f, d or s."""
    message = require("pythonosc.osc_message_builder", "net").OscMessageBuilder(path)
    for kind, value in values:
        message.add_arg(value, kind)
    bundle.add_content(message.build())


class Osc:
    """A bundle for each fix, under a prefix; parameters as `registry.Opener`."""

    wants_pictures = False

    def __init__(self, address: Address, _extent: Extent) -> None:
        address.refuse_others([], has_path=True)
        _bundle()
        self._prefix = f"/{address.path or 'fingerpost'}"
        self._line = _Line(address, _OSC_PORT)

    def send(self, fix: PublishedFix, _pictures: Pictures) -> None:
        """Send a fix, with its point and ellipse if there is one."""
        bundle, prefix = _bundle(), self._prefix
        _add(bundle, f"{prefix}/frame", ("i", fix.frame % 2**31), ("d", fix.time_s))
        _add(bundle, f"{prefix}/status", ("s", fix.status))
        if fix.status == "ok" and fix.point is not None:
            _add(bundle, f"{prefix}/point", *(("f", value) for value in fix.point))
            if fix.covariance is not None:
                ellipse = confidence_ellipse(fix.point, fix.covariance, 0.95)
                shape = (*map(float, ellipse.semi_axes), float(ellipse.angle_rad))
                _add(bundle, f"{prefix}/ellipse", *(("f", value) for value in shape))
            _add(bundle, f"{prefix}/target", ("s", fix.target or ""))
        self._line.send(bundle)

    def close(self) -> None:
        """Close the socket."""
        self._line.close()


class Tuio:
    """One cursor of TUIO 1.1 while the hand points onto the plane; parameters as `registry.Opener`.

    Positions are fractions of the rectangle about the reference points, from its upper left corner
    with X to the right and Y up; `turn` and `mirror` change this orientation.
    """

    wants_pictures = False

    def __init__(self, address: Address, extent: Extent) -> None:
        address.refuse_others(["turn", "mirror"])
        _bundle()
        self._turns = _TURNS.index(address.choice("turn", _TURNS))
        self._is_mirrored = "mirror" in address.options
        self._extent = extent
        self._line = _Line(address, _TUIO_PORT)
        self._frame = self._session = 0
        self._before: tuple[float, float, float, float, float] | None = None

    def send(self, fix: PublishedFix, _pictures: Pictures) -> None:
        """Send the state of the cursor: its position, or its absence."""
        bundle = _bundle()
        self._frame = self._frame % (2**31 - 1) + 1
        _add(bundle, _CURSOR, ("s", "source"), ("s", "fingerpost"))
        place = self._place(fix)
        if place is None:
            self._before = None
            _add(bundle, _CURSOR, ("s", "alive"))
        else:
            if self._before is None:
                self._session += 1
            motion = self._motion(fix.time_s, *place)
            _add(bundle, _CURSOR, ("s", "alive"), ("i", self._session))
            values = (("f", value) for value in (*place, *motion))
            _add(bundle, _CURSOR, ("s", "set"), ("i", self._session), *values)
        _add(bundle, _CURSOR, ("s", "fseq"), ("i", self._frame))
        self._line.send(bundle)

    def _place(self, fix: PublishedFix) -> tuple[float, float] | None:
        """Return the position from 0 to 1; None without a point, or outside the plane."""
        if fix.status != "ok" or fix.point is None:
            return None
        (x, y), (x_min, y_min), (x_max, y_max) = fix.point, self._extent.lower, self._extent.upper
        u, v = (x - x_min) / (x_max - x_min), (y_max - y) / (y_max - y_min)
        for _ in range(self._turns):  # clockwise
            u, v = 1.0 - v, u
        if self._is_mirrored:
            u = 1.0 - u
        return (u, v) if 0.0 <= min(u, v) <= max(u, v) <= 1.0 else None

    def _motion(self, time_s: float, u: float, v: float) -> tuple[float, float, float]:
        """Return velocity, in sides of the plane per second, and the rate of change of speed."""
        before, speeds = self._before, (0.0, 0.0, 0.0)
        if before is not None and 0.0 < (step_s := time_s - before[0]) <= _LONGEST_STEP_S:
            du, dv = (u - before[1]) / step_s, (v - before[2]) / step_s
            change = (math.hypot(du, dv) - math.hypot(*before[3:])) / step_s
            speeds = du, dv, change
        self._before = time_s, u, v, speeds[0], speeds[1]
        return speeds

    def close(self) -> None:
        """Remove the cursor, and close the socket."""
        if self._before is not None:
            bundle = _bundle()
            _add(bundle, _CURSOR, ("s", "source"), ("s", "fingerpost"))
            _add(bundle, _CURSOR, ("s", "alive"))
            _add(bundle, _CURSOR, ("s", "fseq"), ("i", self._frame + 1))
            with contextlib.suppress(OSError):
                self._line.send(bundle)
        self._before = None
        self._line.close()
