"""Sources that may become views: live cameras, and recordings."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fingerpost.capture import Frame, Source, SourceKind, is_url, list_cameras, open_source
from fingerpost.errors import FingerpostError
from fingerpost.live.moment import encoded
from fingerpost.setting_up import view_names

FILMS = frozenset({".avi", ".m4v", ".mkv", ".mov", ".mp4", ".mpg", ".mts", ".webm"})
"""Suffixes of recordings."""

MOST_OFFERS = 12

KEPT_FRAMES = 2
"""Number of frames kept of each source, to assess it: their difference shows the noise."""

_FIRST_FRAMES = 25  # of which some must be intact
_SHOWN_EVERY_S = 0.2
_END_S = 2.0


@dataclass(eq=False, slots=True)
class Offer:
    """A source that may become a view.

    Attributes
    ----------
    name
        Name of the future view.
    source
        Source as in a rig file.
    frames
        The newest frames of a camera, the first of a recording.
    problem
        Why it cannot be used; empty if it can.
    is_live
        Whether it is a camera.
    """

    name: str
    source: str | int
    frames: deque[Frame] = field(default_factory=lambda: deque(maxlen=KEPT_FRAMES))
    problem: str = ""
    is_live: bool = False

    @property
    def image(self) -> NDArray[np.uint8] | None:
        """Its newest picture; None without one."""
        return self.frames[-1].image if self.frames else None

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height of its frames; 0 without one."""
        image = self.image
        return (0, 0) if image is None else (image.shape[1], image.shape[0])

    def as_dict(self) -> dict[str, Any]:
        """Return it as JSON values, without pictures."""
        return {
            "name": self.name,
            "source": str(self.source),
            "size": self.size_px,
            "problem": self.problem,
            "live": self.is_live,
        }


class Offers:
    """The offered sources, in a list that only grows; cameras stay open during its lifetime.

    Parameters
    ----------
    show
        Called with an offer's index and a JPEG of it, whenever there is a new one.
    """

    def __init__(self, show: Callable[[int, bytes], None]) -> None:
        self.each: list[Offer] = []
        self._show = show
        self._ends = threading.Event()
        self._threads: list[threading.Thread] = []

    def __getitem__(self, place: int) -> Offer:
        return self.each[place]

    def __len__(self) -> int:
        return len(self.each)

    def add(self, sources: Iterable[str | int]) -> list[int]:
        """Offer sources, and show a picture of each; return their indices.

        An unreadable source is offered with its problem. Sources that are already offered keep
        their index.
        """
        places = []
        for source in sources:
            known = [k for k, offer in enumerate(self.each) if offer.source == source]
            if known:
                places.append(known[0])
            elif len(self.each) < MOST_OFFERS:
                places.append(len(self.each))
                self._add(Offer(self._name(source), source))
        return places

    def _name(self, source: str | int) -> str:
        """Return a name that no other offer has."""
        stem = _stem(source)
        taken = {offer.name for offer in self.each}
        if stem not in taken and stem.isprintable():
            return stem
        return next(name for k in range(2, 99) if (name := f"{stem}-{k}") not in taken)

    def _add(self, offer: Offer) -> None:
        self.each.append(offer)
        place = len(self.each) - 1
        try:
            opened = open_source(offer.source)
        except FingerpostError as error:
            offer.problem = _problem(error, offer)
            return
        offer.is_live = opened.kind is SourceKind.LIVE
        if offer.is_live:
            self._begin(place, opened)
            return
        with opened:
            self._take(place, opened)

    def _take(self, place: int, opened: Source) -> None:
        """Store the first intact frames of a recording."""
        offer = self.each[place]
        try:
            for frame in islice(opened, _FIRST_FRAMES):
                if isinstance(frame, Frame):
                    offer.frames.append(frame)
                if len(offer.frames) == KEPT_FRAMES:
                    break
        except FingerpostError as error:
            offer.problem = _problem(error, offer)
        if not offer.frames:
            offer.problem = offer.problem or "no picture of it is sound"
            return
        self._show(place, encoded(offer.frames[-1].image))

    def _watch(self, place: int, opened: Source) -> None:
        """Show the pictures of a camera: the body of a thread."""
        offer, shown_s = self.each[place], 0.0
        try:
            with opened:
                for frame in opened:
                    if self._ends.is_set():
                        return
                    if not isinstance(frame, Frame):
                        continue
                    offer.frames.append(frame)
                    if time.monotonic() - shown_s >= _SHOWN_EVERY_S:
                        shown_s = time.monotonic()
                        self._show(place, encoded(frame.image))
        except FingerpostError as error:
            offer.problem = _problem(error, offer)

    def pause(self) -> None:
        """Release all cameras, so that others can open them."""
        self._ends.set()
        for thread in self._threads:
            thread.join(_END_S)
        self._threads.clear()

    def resume(self) -> None:
        """Open the cameras again."""
        self._ends.clear()
        for place, offer in enumerate(self.each):
            if offer.is_live:
                try:
                    self._begin(place, open_source(offer.source))
                except FingerpostError as error:
                    offer.problem = _problem(error, offer)

    def _begin(self, place: int, opened: Source) -> None:
        thread = threading.Thread(
            target=self._watch, args=(place, opened), name=f"view {place} shown", daemon=True
        )
        self._threads.append(thread)
        thread.start()


def _stem(source: str | int) -> str:
    """Return a name by a source's file, or by its folder if that is a pattern of names."""
    if isinstance(source, int):
        return f"camera{source}"
    if is_url(source):
        return Path(source).stem or "view"
    (name,) = view_names([source])
    return name


def _problem(error: FingerpostError, offer: Offer) -> str:
    return str(error).removeprefix(f"{offer.source}: ")


def sources_in(folder: Path) -> list[str | int]:
    """Return the machine's cameras, then the recordings of a folder by name."""
    films = sorted(path for path in folder.iterdir() if path.suffix.lower() in FILMS)
    cameras: list[str | int] = [camera.number for camera in list_cameras()]
    return [*cameras, *(str(path.absolute()) for path in films)]
