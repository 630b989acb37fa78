"""Set-up as a dialogue with the page, which requests one step after another.

The page may go to any step at any time, and return; results are kept.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from itertools import islice
from pathlib import Path
from typing import Any

from fingerpost.capture import Frame, Loss, SourceKind, open_views, read_views
from fingerpost.checks import unused
from fingerpost.config import Rig
from fingerpost.consistency import Scenery
from fingerpost.errors import FingerpostError, InvalidInputError
from fingerpost.live.moment import encoded
from fingerpost.live.page import Page
from fingerpost.live.setup.aim import OPERATOR, learn
from fingerpost.live.setup.asked import Aim, Arrange, Begin, Chosen, Dropped, Leave, LookForHand
from fingerpost.live.setup.hand import look_for_hand, templates
from fingerpost.live.setup.offers import MOST_OFFERS, Offers, sources_in
from fingerpost.live.setup.table import Table, judged, planes, scene_of_plane
from fingerpost.live.setup.wording import page_words
from fingerpost.operators import Operator
from fingerpost.pipeline import Step
from fingerpost.setting_up import DEFAULT_FRAMES

RIG_FILE = "rig.toml"

_SHOWN_EVERY_S = 0.2

Asked = Arrange | LookForHand | Aim | Leave | Begin | Dropped


def set_up(
    page: Page, folder: Path, sources: Sequence[str | int] = ()
) -> tuple[Path, Operator | None]:
    """Set up a rig on the page.

    Parameters
    ----------
    page
        The page.
    folder
        Folder for the rig file, and for recordings that are dropped onto the page.
    sources
        Sources that may become views; by default the machine's cameras and the folder's recordings.

    Returns
    -------
    path
        The rig file.
    operator
        The calibrated operator, who is also written beside the rig file; None without one.

    Raises
    ------
    InvalidInputError
        A named source cannot be read.
    """
    offers = Offers(page.show_still)
    try:
        return Dialogue(page, folder, offers).run(sources)
    finally:
        offers.pause()


class Dialogue:
    """Executes the page's commands until a rig is written.

    Parameters
    ----------
    page
        The page.
    folder
        Folder for files.
    offers
        Sources that may become views.
    """

    def __init__(self, page: Page, folder: Path, offers: Offers) -> None:
        self._page, self._folder, self._offers = page, folder, offers
        self._table = Table()
        self._operator: Operator | None = None
        self._state: dict[str, Any] = {
            "folder": str(folder.absolute()),
            "planes": planes(),
            "templates": templates(),
            "advice": None,
            "scene": None,
            "words": [],
            "hand": None,
            "aim": None,
            "busy": "looking at the views",
            "problem": "",
        }

    def run(self, sources: Sequence[str | int]) -> tuple[Path, Operator | None]:
        """Run until a rig is written; see `set_up`."""
        self._publish()
        places = self._offers.add(sources or sources_in(self._folder))
        for place in places if sources else ():
            if problem := self._offers[place].problem:
                raise InvalidInputError(f"{self._offers[place].source}: {problem}")
        if sources:
            chosen = tuple(Chosen(offer=place) for place in places)
            self._answer(Arrange(views=chosen, finds=len(chosen) >= 2))
        self._publish(busy="")
        while True:
            path = self._answer(self._page.asked())
            if path is not None:
                return path, self._operator

    def _answer(self, asked: Asked) -> Path | None:
        """Execute a command; return the rig file once it is written."""
        self._publish(problem="")
        try:
            match asked:
                case Arrange():
                    self._arrange(asked)
                case LookForHand():
                    self._look_for_hand()
                case Aim(learns=True):
                    self._learn()
                case Aim():
                    self._operator = None
                    self._publish(aim=None)
                case Dropped(path=path):
                    if not self._offers.add([str(path)]):
                        raise InvalidInputError(f"{MOST_OFFERS} views are offered already")
                case Begin():
                    return self._saved()
                case Leave():
                    pass
        except FingerpostError as error:
            self._publish(problem=page_words(str(error)))
        finally:
            self._publish(busy="")
        return None

    def _publish(self, **changed: Any) -> None:
        self._state |= changed
        table = self._table
        self._page.show_setup(
            {
                **self._state,
                "offers": [offer.as_dict() for offer in self._offers.each],
                "table": table.as_dict(),
            }
        )

    def _arrange(self, wanted: Arrange) -> None:
        before = {**self._table.as_dict(), "number": wanted.number}
        self._publish(busy="looking for the table" if wanted.finds else "judging")
        self._table.arrange(wanted, self._offers)
        if self._table.as_dict() == before:
            self._publish(hand=None)  # only templates have moved
            return
        self._publish(hand=None, aim=None, advice=None, words=[], scene=None)
        self._operator = None
        if not self._table.is_complete:
            return
        self._publish(busy="judging")
        chosen = [self._offers[view.offer] for view in self._table.chosen]
        rig = self._table.rig(self._offers)
        self._publish(scene=scene_of_plane(rig))
        advice, words = judged(rig, chosen)
        self._publish(advice=advice, words=[asdict(word) for word in words])

    def _look_for_hand(self) -> None:
        self._publish(busy="looking for the hand", hand=None)
        with self._frames() as (rig, frames):
            search = look_for_hand(rig, frames, self._page.is_asked, self._shown("hand"))
        self._publish(hand=None if search is None else search.state)

    def _learn(self) -> None:
        self._publish(busy="learning", aim=None)
        with self._frames(most=None) as (rig, frames):
            aimed = learn(rig, frames, self._page.is_asked, self._shown("aim"))
        self._operator = aimed.operator
        self._publish(aim=aimed.state)

    @contextmanager
    def _frames(
        self, most: int | None = DEFAULT_FRAMES
    ) -> Iterator[tuple[Rig, Iterator[Sequence[Frame | Loss | None]]]]:
        """Yield the rig and frames of its views, a limited number for recordings."""
        rig = self._table.rig(self._offers)
        self._offers.pause()
        try:
            with open_views(rig.sources, rig.readings) as sources:
                is_live = sources[0].kind is SourceKind.LIVE
                frames = iter(read_views(sources))
                yield rig, frames if is_live or most is None else islice(frames, most)
        finally:
            self._offers.resume()

    def _shown(self, key: str) -> Callable[[dict[str, Any], Step], None]:
        """Return a callback that shows a step's state and pictures, a few times a second."""
        shown_s = -1.0

        def show(state: dict[str, Any], step: Step) -> None:
            nonlocal shown_s
            now_s = time.monotonic()
            if now_s - shown_s < _SHOWN_EVERY_S and not state.get("found"):
                return
            shown_s = now_s
            for view, frame in zip(self._table.chosen, step.frames, strict=False):
                if isinstance(frame, Frame):
                    self._page.show_still(view.offer, encoded(frame.image))
            self._publish(**{key: state})

        return show

    def _saved(self) -> Path:
        """Write the rig file, and the operator beside it; return the rig file."""
        self._publish(busy="beginning")
        rig = self._table.rig(self._offers)
        self._refuse_belied(rig)
        path = unused(self._folder / RIG_FILE)
        rig.save(path)
        if self._operator is not None:
            self._operator.save(unused(path.with_name(f"{path.stem}-{OPERATOR}.toml")))
        return path

    def _refuse_belied(self, rig: Rig) -> None:
        """Refuse a rig that contradicts its pictures: one film twice, corners out of order."""
        images = [self._offers[view.offer].image for view in self._table.chosen]
        scenery = Scenery(rig, [image for image in images if image is not None])
        if (same := scenery.same_pictures()) is not None:
            raise InvalidInputError(f"{same.what}; {same.right}")
        mistake = scenery.mistake()
        if mistake is not None and mistake.is_certain:
            raise InvalidInputError(mistake.what)
