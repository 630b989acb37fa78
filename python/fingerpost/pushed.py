"""Groups images that a program pushes, view by view or together, into rounds of frames.

A hand is found and verified in frames of several views at about the same time. An image that is
pushed for one view therefore waits for the others: a round is complete when every view has a frame,
or when a view receives its next frame before another view has any.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fingerpost.admission import Admission
from fingerpost.capture import AS_IT_IS, Frame
from fingerpost.config import View
from fingerpost.errors import InvalidInputError

Images = Mapping[str, NDArray[np.uint8]] | Sequence[NDArray[np.uint8] | None]
"""Images by view name; or one entry per view in the rig's order, None where there is no image."""

Round = tuple[Frame | None, ...]


class PushedViews:
    """Groups pushed images into rounds of frames.

    Parameters
    ----------
    views
        Views of the rig.
    admission
        Checks images before any is stored: the push that brings an unusable image raises the error.
    """

    def __init__(self, views: Sequence[View], admission: Admission) -> None:
        self._views = views
        self._admission = admission
        self._counts = [0] * len(views)
        self._waiting: list[Frame | None] = [None] * len(views)

    def take(self, images: Images, time_s: float) -> list[Round]:
        """Take images of one time; return the rounds that they complete, the oldest first.

        Raises
        ------
        InvalidInputError
            As `Pointer.push`. No image of the push is kept.
        """
        frames = self._frames(images, time_s)
        self._admission.admit(frames)
        rounds = []
        if any(frame and waiting for frame, waiting in zip(frames, self._waiting, strict=True)):
            rounds += self.rest()
        for k, frame in enumerate(frames):
            if frame is not None:
                self._counts[k] += 1
                self._waiting[k] = _own(frame, self._views[k])
        if None not in self._waiting:
            rounds += self.rest()
        return rounds

    def rest(self) -> list[Round]:
        """Return the waiting frames as the last round, if there are any."""
        waiting = tuple(self._waiting)
        self._waiting = [None] * len(self._views)
        return [waiting] if any(waiting) else []

    def _frames(self, images: Images, time_s: float) -> list[Frame | None]:
        given: Sequence[Any]
        if isinstance(images, Mapping):
            self._refuse_strange(images)
            given = [images.get(view.name) for view in self._views]
        elif isinstance(images, Sequence) and len(images) == len(self._views):
            given = images
        else:
            found = len(images) if isinstance(images, Sequence) else type(images).__name__
            raise InvalidInputError(
                f"images: {found} found; a mapping from view to image, or a list of one for each "
                f"of the {len(self._views)} views, is needed"
            )
        return [
            None if image is None else Frame(count, time_s, _arranged(image, view))
            for image, count, view in zip(given, self._counts, self._views, strict=True)
        ]

    def _refuse_strange(self, images: Mapping[str, Any]) -> None:
        names = [view.name for view in self._views]
        for name in images:
            if name not in names:
                raise InvalidInputError(
                    f"images: {name!r} is no view of the rig; its views are {', '.join(names)}"
                )


def _arranged(image: Any, view: View) -> Any:
    """Rotate and flip an image as the rig says; other objects pass, to be refused later."""
    if view.arrangement == AS_IT_IS or np.ndim(image) < 2 or not isinstance(image, np.ndarray):
        return image
    try:
        return view.arrangement.of(image)
    except InvalidInputError as error:
        raise InvalidInputError(f'view "{view.name}": {error}') from error


def _own(frame: Frame, view: View) -> Frame:
    """Copy a frame, with the view's time offset: the caller may reuse the image's buffer."""
    image = np.array(frame.image, order="C")
    return replace(frame, image=image, time_s=float(frame.time_s) + view.offset_s)
