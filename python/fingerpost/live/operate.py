"""The main loop with the operator's page beside it."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from fingerpost.capture import Frame, Loss, SourceKind, at_speed, open_views, read_views
from fingerpost.config import Rig
from fingerpost.errors import FingerpostError
from fingerpost.guidance import guided
from fingerpost.live.desk import GuidingDesk
from fingerpost.live.page import Page
from fingerpost.live.scene import RigScene
from fingerpost.operators import Operator
from fingerpost.pipeline import Pointer, Step, steps
from fingerpost.silhouette import Capsule

Frames = Iterator[Sequence[Frame | Loss | None]]


def operate(
    page: Page,
    rig: Rig,
    title: str,
    operator: Operator | None = None,
    begin: Callable[[bool], Callable[[Step], None]] | None = None,
    desk: GuidingDesk | None = None,
) -> None:
    """Show a rig's run on the page, to the end of its sources.

    Parameters
    ----------
    page
        The page.
    rig
        At least two views.
    title
        What the page calls the rig.
    operator
        Whose habit of pointing is subtracted from the points.
    begin
        Called before the first step with whether times are the machine's, as those of cameras are;
        what it returns takes every step as well.
    desk
        Of an arm that the page guides; recordings are then played as if live.

    Raises
    ------
    InvalidInputError
        As `pipeline.track`.
    CaptureError
        As `pipeline.track`.
    RobotError
        The arm's; it has been stopped.
    """
    moving = tuple[Capsule, ...] if desk is None else desk.arm.guard.body
    with _noting(page):
        try:
            pointer = Pointer(rig, operator=operator, moving=moving)
            with open_views(rig.sources, rig.readings) as sources:
                counts = [source.frame_count for source in sources if source.frame_count]
                is_recorded = sources[0].kind is SourceKind.RECORDED
                is_live = desk is not None or not is_recorded
                scene = RigScene.of(
                    title,
                    rig.plane.unit,
                    pointer.plane_views,
                    rig.sources,
                    targets=rig.things,
                    is_live=is_live,
                    frames=min(counts, default=None),
                )
                page.open_rig(scene)
                take = None if begin is None else begin(is_live)
                frames: Frames = page.allowed(iter(read_views(sources)))
                if desk is not None and is_recorded:
                    frames = at_speed(frames, stamped=True)
                with _guided(page, steps(pointer, frames), desk) as taken:
                    for step in taken:
                        page.show(step)
                        if take is not None:
                            take(step)
                for note in [*pointer.notes(), *(s.damage for s in sources if s.damage)]:
                    page.note(note)
        except FingerpostError as error:
            page.end(str(error))
            raise
    page.end("the recording has ended")


@contextmanager
def _guided(
    page: Page, taken: Iterator[Step], desk: GuidingDesk | None
) -> Iterator[Iterator[Step]]:
    """Have the steps guide an arm, where there is one, before they are shown."""
    if desk is None:
        yield taken
        return
    with desk.guiding(page.show_arm) as session, page.guiding(desk.desk.obey):
        yield guided(session, taken)


@contextmanager
def _noting(page: Page) -> Iterator[None]:
    """Show on the page what is logged as a warning."""
    handler = _Notes(page)
    logging.getLogger("fingerpost").addHandler(handler)
    try:
        yield
    finally:
        logging.getLogger("fingerpost").removeHandler(handler)


class _Notes(logging.Handler):
    """Hands warnings to the page."""

    def __init__(self, page: Page) -> None:
        super().__init__(logging.WARNING)
        self._page = page

    def emit(self, record: logging.LogRecord) -> None:
        """Show a warning's words."""
        self._page.note(record.getMessage())
