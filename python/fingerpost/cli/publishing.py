"""`--publish`: fixes of a command for other programs."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import ExitStack
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from fingerpost.config import Rig
    from fingerpost.pipeline import Step
    from fingerpost.publishing import Pictures, PublishedFix, Publisher

_PRINTS = "ndjson:"


def _known(_context: click.Context, _parameter: click.Parameter, urls: Sequence[str]) -> list[str]:
    """Refuse invalid addresses before anything is opened."""
    if urls:
        from fingerpost.publishing.registry import refuse_unknown

        for url in urls:
            refuse_unknown(url)
    return list(urls)


publish_option = click.option(
    "--publish",
    "publish",
    metavar="URL",
    multiple=True,
    callback=_known,
    help="Send every fix there: ndjson: (standard output), osc://, tuio://, ws://, zenoh:// or "
    "zenoh+ros2://HOST:PORT.  May be repeated.",
)
"""Adds the parameter `publish` to a command."""


def prints_fixes(urls: Sequence[str]) -> bool:
    """Whether fixes are published on standard output."""
    return any(url.startswith(_PRINTS) for url in urls)


class Publishing:
    """Publishes the fixes of steps.

    Parameters
    ----------
    stack
        Closes the connections.
    urls
        Destinations.
    rig
        Rig of the fixes.
    is_live
        Whether their times are the machine's clock's; then slow receivers are not waited for.
    """

    def __init__(
        self,
        stack: ExitStack,
        urls: Sequence[str],
        rig: Rig,
        *,
        is_live: bool,
    ) -> None:
        from fingerpost.publishing import Extent, open_publisher

        extent = Extent.of(rig.plane.points, rig.plane.unit)
        self._unit = rig.plane.unit
        self._epoch_s = time.time() - time.monotonic() if is_live else None
        self._publishers: list[Publisher] = [
            stack.enter_context(open_publisher(url, extent, waits=not is_live)) for url in urls
        ]

    def take(self, step: Step) -> None:
        """Publish a step's fix."""
        if not self._publishers:
            return
        fix = self._published(step)
        for publisher in self._publishers:
            publisher.put(fix, _pictures(step) if publisher.wants_pictures else ())

    def notes(self) -> list[str]:
        """Return the final remarks for people."""
        return [note for publisher in self._publishers for note in publisher.notes()]

    def _published(self, step: Step) -> PublishedFix:
        from fingerpost.publishing import PublishedFix

        row = step.point_row()
        return PublishedFix(
            frame=row.frame,
            time_s=row.time_s,
            unix_time_s=None if self._epoch_s is None else self._epoch_s + row.time_s,
            status=row.status,
            unit=self._unit,
            x=row.x,
            y=row.y,
            cov_xx=row.cov_xx,
            cov_xy=row.cov_xy,
            cov_yy=row.cov_yy,
            crossing_angle_deg=row.crossing_angle_deg,
            target=step.fix.target,
            reason=row.reason,
        )


def _pictures(step: Step) -> Pictures:
    from fingerpost.capture import Frame

    views = (observation.view for observation in step.observations)
    return [
        (view, seen)
        for view, seen in zip(views, step.frames, strict=False)
        if isinstance(seen, Frame)
    ]
