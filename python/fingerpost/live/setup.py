"""Set-up on the page: pick views, click the reference points, and the rig file is written.

What is offered are the cameras of the machine and the recordings of a folder.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fingerpost.capture import Frame, list_cameras, open_source
from fingerpost.checks import unused
from fingerpost.config import Plane, Rig, View
from fingerpost.consistency import Scenery
from fingerpost.errors import FingerpostError, InvalidInputError
from fingerpost.formats import corners_of
from fingerpost.live.commands import SetUp
from fingerpost.live.moment import encoded
from fingerpost.live.page import Page
from fingerpost.pipeline import Pointer

RIG_FILE = "rig.toml"

_FILMS = {".avi", ".m4v", ".mkv", ".mov", ".mp4", ".mpg", ".mts", ".webm"}
_MOST_OFFERS = 12
_FIRST_FRAMES = 25  # of which one shall be sound


@dataclass(frozen=True, eq=False, slots=True)
class Offer:
    """A source that may become a view.

    Attributes
    ----------
    name
        What the view will be called.
    source
        As a rig file has it.
    image
        A picture of it; None where it cannot be read.
    problem
        Why it cannot be used; empty if it can.
    """

    name: str
    source: str | int
    image: NDArray[np.uint8] | None = None
    problem: str = ""

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height of its frames."""
        return (0, 0) if self.image is None else (self.image.shape[1], self.image.shape[0])

    def jpeg(self) -> bytes:
        """Return its picture as the page shows it; empty where there is none."""
        return b"" if self.image is None else encoded(self.image)

    def as_dict(self) -> dict[str, Any]:
        """Return it fit for JSON, without the picture."""
        return {
            "name": self.name,
            "source": str(self.source),
            "size": self.size_px,
            "problem": self.problem,
        }


def offers_of(folder: Path) -> list[Offer]:
    """Return what may become a view: cameras, and the recordings of a folder.

    Parameters
    ----------
    folder
        An existing one.
    """
    films = sorted(path for path in folder.iterdir() if path.suffix.lower() in _FILMS)
    stems = [path.stem for path in films]
    sources: dict[str, str | int] = {
        f"camera{camera.number}": camera.number for camera in list_cameras()
    }
    for path in films:
        name = path.stem if stems.count(path.stem) == 1 else path.name
        sources[name] = str(path.absolute())
    return [_looked_at(name, source) for name, source in islice(sources.items(), _MOST_OFFERS)]


def _looked_at(name: str, source: str | int) -> Offer:
    try:
        with open_source(source) as frames:
            for frame in islice(frames, _FIRST_FRAMES):
                if isinstance(frame, Frame):
                    return Offer(name, source, frame.image)
        problem = "no picture of it is sound"
    except FingerpostError as error:
        problem = str(error).removeprefix(f"{source}: ")
    return Offer(name, source, problem=problem)


def rig_of(wanted: SetUp, offers: list[Offer]) -> Rig:
    """Return the rig that was set up.

    Raises
    ------
    InvalidInputError
        What was set up cannot point; the message says what is wrong.
    """
    views = []
    for chosen in wanted.views:
        if not 0 <= chosen.offer < len(offers) or offers[chosen.offer].problem:
            raise InvalidInputError(f"view {chosen.offer} is none of those that are offered")
        offer = offers[chosen.offer]
        views.append(
            View(
                name=offer.name,
                source=offer.source,
                reference_points_px=chosen.points_px,
                size_px=offer.size_px,
            )
        )
    plane = Plane(unit=wanted.unit, points=corners_of((wanted.width, wanted.height)))
    rig = Rig(plane=plane, views=tuple(views))
    Pointer(rig)  # refuses what cannot point
    _refuse_belied(rig, [offers[chosen.offer] for chosen in wanted.views])
    return rig


def _refuse_belied(rig: Rig, offers: list[Offer]) -> None:
    """Refuse what the pictures belie: two views of one film, corners in another order."""
    scenery = Scenery(rig, [offer.image for offer in offers if offer.image is not None])
    if (same := scenery.same_pictures()) is not None:
        raise InvalidInputError(f"{same.what}; {same.right}")
    mistake = scenery.mistake()
    if mistake is not None and mistake.is_certain:
        raise InvalidInputError(mistake.what)


def saved(rig: Rig, folder: Path) -> Path:
    """Write a rig file into a folder, under a name that nothing has there yet; return it."""
    path = unused(folder / RIG_FILE)
    rig.save(path)
    return path


def set_up(page: Page, folder: Path) -> Path:
    """Have a rig set up on the page; return the rig file.

    Parameters
    ----------
    page
        The page.
    folder
        Whose recordings are offered, and where the rig file goes.
    """
    offers, problem = offers_of(folder), ""
    while True:
        wanted = page.set_up([offer.as_dict() for offer in offers], _stills(offers), problem)
        try:
            return saved(rig_of(wanted, offers), folder)
        except FingerpostError as error:
            problem = str(error)


def _stills(offers: list[Offer]) -> list[bytes]:
    return [offer.jpeg() for offer in offers]
