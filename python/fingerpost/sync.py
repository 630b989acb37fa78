"""The offset between the clocks of a rig's views, from a film of a moving hand.

The main loop follows the hand in every view; the motions of its tip in the views determine the
offset of the clocks (`fingerpost.consistency.offset`). A large offset impairs the tracking;
therefore it is corrected, and the footage is followed again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np

from fingerpost.capture import Frame, Loss
from fingerpost.config import Rig
from fingerpost.consistency import Offset, Track, offset_between, tip_in_first_view, unannounced
from fingerpost.errors import InvalidInputError
from fingerpost.pipeline import Pointer, steps
from fingerpost.pointing import FingerLine

ROUNDS = 3
"""Largest number of times that the footage is followed."""

SETTLED_S = 0.02
"""Largest change of a converged offset [s]; so small an offset does not impair the tracking."""

Together = Sequence[Frame | Loss | None]


@dataclass(frozen=True)
class Synced:
    """A rig whose views share one clock, and the estimates of their offsets.

    Attributes
    ----------
    rig
        Rig with the `offset_s` of every view except the first set.
    offsets
        By view name: the remaining offset in the last round, and its uncertainty.
    """

    rig: Rig
    offsets: dict[str, Offset]


def synchronise(rig: Rig, footage: Callable[[Rig], Iterable[Together]]) -> Synced:
    """Synchronise the clocks of a rig's views by a hand that moves in all of them.

    Parameters
    ----------
    rig
        At least two views.
    footage
        Plays the recordings of the given rig from the beginning, with its offsets.

    Raises
    ------
    InvalidInputError
        A rig that cannot point, or an offset that cannot be estimated; the message names the view
        and the reason.
    """
    for _ in range(ROUNDS):
        with unannounced():
            tips = _tips(Pointer(rig), footage(rig))
        offsets = {}
        for view, tip in zip(rig.views[1:], tips[1:], strict=True):
            try:
                offsets[view.name] = offset_between(tips[0], tip)
            except InvalidInputError as error:
                raise InvalidInputError(
                    f'view "{view.name}" against view "{rig.views[0].name}": {error}'
                ) from error
        rig = _with_offsets(rig, offsets)
        if all(abs(offset.lag_s) < SETTLED_S for offset in offsets.values()):
            break
    return Synced(rig, offsets)


def _tips(pointer: Pointer, footage: Iterable[Together]) -> list[Track]:
    """Follow the footage; return the path of the tip in each view."""
    seen: list[list[tuple[float, ...]]] = [[] for _ in pointer.views]
    for step in steps(pointer, footage):
        first = step.observations[0].plane_view
        for entries, observed in zip(seen, step.observations, strict=True):
            finger, view = observed.finger, observed.plane_view
            if not isinstance(finger, FingerLine) or first is None or view is None:
                continue
            if (tip := tip_in_first_view(finger, view, first)) is not None:
                entries.append((finger.time_s, *tip.tolist()))
    rows = [np.array(entries, np.float64).reshape(-1, 4) for entries in seen]
    return [Track(row[:, 0], row[:, 1:]) for row in rows]


def _with_offsets(rig: Rig, offsets: dict[str, Offset]) -> Rig:
    first, *others = rig.views
    moved = (
        msgspec.structs.replace(view, offset_s=view.offset_s - offsets[view.name].lag_s)
        for view in others
    )
    return msgspec.structs.replace(rig, views=(first, *moved))
