"""Stores all displayed moments of a recording, for display from any position.

Trackers only run forwards. Their result for each frame is stored with the picture in a temporary
file, which is deleted with the process, so that going back in a recording shows the original
result.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, field
from typing import IO

from fingerpost.pointing import Fix, Status


@dataclass(frozen=True, slots=True)
class Indicated:
    """Compact form of a fix, because a long recording has many.

    Attributes
    ----------
    frame
        Index of the first view's frame.
    time_s, status
        Time and status of the fix.
    point
        The point (x, y) [plane units]; None without one.
    covariance
        Its entries xx, xy and yy [plane units²]; None without a point.
    """

    frame: int
    time_s: float
    status: Status
    point: tuple[float, float] | None = None
    covariance: tuple[float, float, float] | None = None

    @classmethod
    def of(cls, frame: int, fix: Fix) -> Indicated:
        """Return the compact form of a fix."""
        if fix.point is None or fix.covariance is None:
            return cls(frame, fix.time_s, fix.status)
        (x, y), ((xx, xy), (_, yy)) = fix.point.tolist(), fix.covariance.tolist()
        return cls(frame, fix.time_s, fix.status, (x, y), (xx, xy, yy))


@dataclass(frozen=True, slots=True)
class Message:
    """An encoded moment.

    Attributes
    ----------
    number
        Number of the moment.
    time_s
        Time of its fix.
    begun_s
        Monotonic time at which processing began.
    codes
        A letter for the status of the fix and of each view, and a digit: see `Strip`.
    data
        Bytes to send: the length of the scene, the scene as JSON, and the pictures.
    indicated
        The fix in compact form.
    """

    number: int
    time_s: float
    begun_s: float
    codes: str
    data: bytes
    indicated: Indicated | None = None


class Reel:
    """Messages on disk, numbered from 0."""

    def __init__(self) -> None:
        self._file: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115 - lives as long as the reel
        self._places: list[tuple[int, int]] = []
        self._times_s: list[float] = []
        self._indicated: list[Indicated | None] = []
        self._end = 0

    def __len__(self) -> int:
        return len(self._places)

    def append(self, message: Message) -> None:
        """Store the next message."""
        self._file.seek(self._end)
        self._file.write(message.data)
        self._places.append((self._end, len(message.data)))
        self._times_s.append(message.time_s)
        self._indicated.append(message.indicated)
        self._end += len(message.data)

    def time_s(self, number: int) -> float:
        """Return the time of a message's fix."""
        return self._times_s[number]

    def indicated(self, number: int) -> Indicated | None:
        """Return the fix of a message in compact form."""
        return self._indicated[number]

    def data(self, number: int) -> bytes:
        """Return the bytes to send of a message."""
        begin, length = self._places[number]
        self._file.seek(begin)
        return self._file.read(length)

    def close(self) -> None:
        """Delete all messages."""
        self._file.close()


@dataclass(slots=True)
class Strip:
    """The status of every moment, of the fix and of each view, and the uncertainty of the point.

    Letters are o (ok or tracking), a (acquiring), l (lost), i (ill-conditioned) and m (moved). The
    last row has digits: the larger semi-axis of the 95 % ellipse on a logarithmic scale, or - .

    Attributes
    ----------
    longest
        Number of moments that are kept; None keeps all.
    first
        Number of the first moment that is kept.
    codes
        The letters of each moment.
    """

    longest: int | None = None
    first: int = 0
    codes: list[str] = field(default_factory=list)

    def append(self, codes: str) -> None:
        """Add a moment's letters."""
        self.codes.append(codes)
        # Half of them at a time, so that it is rarely copied.
        if self.longest is not None and len(self.codes) >= 2 * self.longest:
            gone = len(self.codes) - self.longest
            del self.codes[:gone]
            self.first += gone

    @property
    def end(self) -> int:
        """Number of the next moment."""
        return self.first + len(self.codes)

    def since(self, number: int) -> dict[str, object]:
        """Return the moments from a number on as JSON values: one string per row."""
        begin = max(number, self.first, self.end - (self.longest or self.end))
        codes = self.codes[begin - self.first :]
        return {"from": begin, "rows": ["".join(row) for row in zip(*codes, strict=True)]}
