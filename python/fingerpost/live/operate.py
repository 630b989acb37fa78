"""Runs the main loop with the operator's page."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from typing import Protocol

from fingerpost.capture import (
    Frame,
    Loss,
    Source,
    SourceKind,
    at_speed,
    open_views,
    read_views,
)
from fingerpost.config import Rig
from fingerpost.errors import FingerpostError
from fingerpost.guidance import GuidedArm, guided
from fingerpost.live.desk import GuidingDesk
from fingerpost.live.page import Page
from fingerpost.live.scene import RigScene
from fingerpost.operators import Operator
from fingerpost.pipeline import Pointer, Step, steps
from fingerpost.robot import CommandRecord
from fingerpost.robot.guard import RecordCallback
from fingerpost.silhouette import Capsule

Frames = Iterator[Sequence[Frame | Loss | None]]


class Outputs(Protocol):
    """Publishes and records a run; implemented by `fingerpost.cli.session_outputs`."""

    @property
    def is_idle(self) -> bool:
        """Whether nothing is to be published or recorded."""

    def opened(
        self, rig: Rig, sources: Sequence[Source], *, is_live: bool, arm: GuidedArm | None = None
    ) -> AbstractContextManager[None]:
        """Open the outputs for the duration of the block, for open views and the guided arm.

        `is_live` states whether times are on the machine's clock.
        """

    def watch(self, frames: Frames) -> Frames:
        """Pass on the frames of all views."""

    def take(self, step: Step) -> None:
        """Record or publish a step."""

    def on_record(self, record: CommandRecord) -> None:
        """Record a command to the arm."""

    def notes(self) -> list[str]:
        """Return remarks for the user at the end."""


def operate(
    page: Page,
    rig: Rig,
    title: str,
    operator: Operator | None = None,
    outputs: Outputs | None = None,
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
        Name of the rig on the page.
    operator
        Person whose habit of pointing is subtracted from the points.
    outputs
        Publish and record the run.
    desk
        Desk of an arm that the page guides; recordings are then played as if live.

    Raises
    ------
    InvalidInputError
        As `pipeline.track`.
    CaptureError
        As `pipeline.track`.
    RobotError
        An error of the arm, which has been stopped.
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
                    awaits_page=not is_live and (outputs is None or outputs.is_idle),
                )
                page.open_rig(scene)
                frames: Frames = page.allowed(iter(read_views(sources)))
                if desk is not None and is_recorded:
                    frames = at_speed(frames, stamped=True)
                with ExitStack() as stack:
                    if outputs is not None:
                        arm = None if desk is None else desk.arm
                        stack.enter_context(outputs.opened(rig, sources, is_live=is_live, arm=arm))
                        frames = outputs.watch(frames)
                    taken = steps(pointer, frames)
                    if desk is not None:
                        on_record = None if outputs is None else outputs.on_record
                        taken = stack.enter_context(_guided(page, taken, desk, on_record))
                    for step in taken:
                        page.show(step)
                        if outputs is not None:
                            outputs.take(step)
                damage = [source.damage for source in sources if source.damage]
                notes = [] if outputs is None else outputs.notes()
                for note in [*pointer.notes(), *damage, *notes]:
                    page.note(note)
        except FingerpostError as error:
            page.end(str(error))
            raise
    page.end("the recording has ended")


@contextmanager
def _guided(
    page: Page, taken: Iterator[Step], desk: GuidingDesk, on_record: RecordCallback | None
) -> Iterator[Iterator[Step]]:
    """Guide an arm by the steps before they are shown."""
    with desk.guiding(page.show_arm, on_record) as session, page.guiding(desk.desk.obey):
        yield guided(session, taken)


@contextmanager
def _noting(page: Page) -> Iterator[None]:
    """Show logged warnings on the page."""
    handler = _Notes(page)
    logging.getLogger("fingerpost").addHandler(handler)
    try:
        yield
    finally:
        logging.getLogger("fingerpost").removeHandler(handler)


class _Notes(logging.Handler):
    """Passes warnings to the page."""

    def __init__(self, page: Page) -> None:
        super().__init__(logging.WARNING)
        self._page = page

    def emit(self, record: logging.LogRecord) -> None:
        """Show the text of a warning."""
        self._page.note(record.getMessage())
