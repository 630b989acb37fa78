"""Records of the commands that a guard passes, refuses or stops, with a log that may fail."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

from fingerpost.pointing import Fix
from fingerpost.robot.protocol import Pose

logger = logging.getLogger(__name__)

RECORDS_KEPT = 10_000
"""Number of records that a guard keeps; `on_record` receives all."""


@dataclass(frozen=True, slots=True)
class CommandRecord:
    """One line of the log.

    Attributes
    ----------
    time_s : float
        Time on the guard's clock [s].
    command : str
        `arm`, `disarm`, `enter`, `visit`, `move`, `gripper`, `hold` or `halt`.
    detail : str
        The goal, or the reason.
    pose : Pose or None
        The goal of a motion.
    fix : Fix or None
        The fix that caused it.
    outcome : str
        `sent`, or why not. A stop that failed at first has a second record once it has succeeded.
    """

    time_s: float
    command: str
    detail: str
    pose: Pose | None
    fix: Fix | None
    outcome: str

    def __str__(self) -> str:
        cause = "no fix"
        if self.fix is not None:
            at = (
                "" if self.fix.point is None else f" ({self.fix.point[0]:g}, {self.fix.point[1]:g})"
            )
            cause = f"fix of {self.fix.time_s:.3f} s, {self.fix.status}{at}"
        return f"{self.time_s:.3f} s {self.command} {self.detail}: {self.outcome} [{cause}]"


RecordCallback: TypeAlias = Callable[[CommandRecord], None]


class Records:
    """The last records, each passed to a callback, whose failure is stored until requested.

    Parameters
    ----------
    on_record : callable, optional
        Called with every record.
    """

    def __init__(self, on_record: RecordCallback | None = None) -> None:
        self._on_record = on_record or (lambda _: None)
        self._kept: deque[CommandRecord] = deque(maxlen=RECORDS_KEPT)
        self._error: Exception | None = None

    @property
    def kept(self) -> tuple[CommandRecord, ...]:
        """The last records, oldest first."""
        return tuple(self._kept)

    @property
    def error(self) -> Exception | None:
        """The first failure of the callback since the last `forget_error`."""
        return self._error

    def add(self, record: CommandRecord) -> None:
        """Store a record and pass it on; never raises, because that would prevent a stop."""
        self._kept.append(record)
        logger.info("%s", record)
        try:
            self._on_record(record)
        except Exception as error:
            if self._error is None:
                logger.warning("the log failed: %s", error)
                self._error = error

    def forget_error(self) -> None:
        """Clear the stored failure."""
        self._error = None
