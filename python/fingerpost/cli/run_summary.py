"""Summary of a run: the number of fixes of each status, with reasons."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fingerpost.capture import Source
    from fingerpost.pointing import Fix

_REASONS = 5  # largest number of reasons to print
_NAME_OR_NUMBER = re.compile(r'"[^"]*"|[+-]?\d+(?:\.\d+)?(?:e[+-]?\d+)?')


def source_notes(views: Iterable[str], sources: Iterable[Source]) -> list[str]:
    """Return the final remarks of sources, each with its view's name.

    Parameters
    ----------
    views
        Names, in the order of the sources.
    sources
        The opened sources; none if that failed.
    """
    return [
        f"{view}: {note}"
        for view, own in zip(views, sources, strict=False)
        for note in filter(None, (own.damage, *own.notes))
    ]


class RunSummary:
    """Counts fixes by status, and their most frequent reasons."""

    def __init__(self) -> None:
        self._statuses: Counter[str] = Counter()
        self._reasons: Counter[str] = Counter()

    def add(self, fix: Fix) -> None:
        """Count a fix."""
        self._statuses[fix.status.value] += 1
        if fix.reason:
            self._reasons[_kind(fix.reason)] += 1

    @property
    def frames(self) -> int:
        """Number of counted fixes."""
        return self._statuses.total()

    def lines(self, elapsed_s: float, notes: Sequence[str] = ()) -> list[str]:
        """Return the summary as lines of text for a person.

        Parameters
        ----------
        elapsed_s
            Duration of the run.
        notes
            Remarks of the sources.
        """
        frames = self.frames
        lines = [f"frames   {frames} in {elapsed_s:.1f} s"]
        for status, count in self._statuses.most_common():
            lines.append(f"{status:<16} {count:5d}  {100 * count / frames:5.1f} %")
        frequent = self._reasons.most_common(_REASONS)
        if frequent:
            lines.append("reasons")
        lines += [f"{count:5d}   {reason}" for reason, count in frequent]
        others = self._reasons.total() - sum(count for _, count in frequent)
        if others:
            lines.append(f"{others:5d}   others")
        if frames and not self._statuses["ok"]:
            lines.append("no point at all: `fingerpost doctor` examines the views and the hand")
        return lines + (["notes", *(f"        {note}" for note in notes)] if notes else [])


def _kind(reason: str) -> str:
    """Return a reason with its figures removed, but not its names, to group equal reasons."""
    return _NAME_OR_NUMBER.sub(lambda found: found[0] if found[0][0] == '"' else "…", reason)
