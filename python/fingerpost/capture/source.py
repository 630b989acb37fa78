"""What every source of frames has in common."""

from __future__ import annotations

import enum
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, field
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import NDArray

from fingerpost.errors import CaptureError


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One image of one view.

    Attributes
    ----------
    index
        Position in the source, from 0. Frames of a damaged file that cannot be read, and frames
        of a live source that nobody fetched, leave a gap.
    time_s
        Capture time in seconds. Recorded sources count from the start of the recording; live
        sources give the machine's monotonic clock, the same for all of them.
    image
        `uint8`, C-contiguous, shape (height, width) grey or (height, width, 3) blue-green-red.
    """

    index: int
    time_s: float
    image: NDArray[np.uint8]
    _grey: NDArray[np.uint8] | None = field(default=None, init=False, repr=False)
    _has_colours: bool | None = field(default=None, init=False, repr=False)

    def grey(self) -> NDArray[np.uint8]:
        """Return the image in grey (ITU-R BT.601 luma); a grey image is returned as it is.

        Converted once: every stage that asks gets the same array.
        """
        if self.image.ndim == 2:
            return self.image
        if self._grey is None:
            import cv2

            grey = np.asarray(cv2.cvtColor(self.image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
            object.__setattr__(self, "_grey", grey)
            return grey
        return self._grey

    def colour(self) -> NDArray[np.uint8] | None:
        """Return the image if it is in colour; None for a grey one.

        One whose three channels are the same everywhere, but for how videos round, is grey: so
        most drivers and files hand over what a monochrome camera sees.
        """
        if self._has_colours is None:
            object.__setattr__(self, "_has_colours", _is_coloured(self.image))
        return self.image if self._has_colours else None


SAME_GREY = 3
"""A grey picture's channels differ by no more than this once a video has been decoded [levels]."""


def _is_coloured(image: NDArray[np.uint8]) -> bool:
    """Tell whether the channels of an image differ anywhere; most coloured ones show it at once."""
    import cv2

    if image.ndim == 2:
        return False
    for part in (image[::16, ::16], image):
        blue, green, red = cv2.split(np.ascontiguousarray(part))
        if any(cv2.absdiff(green, other).max() > SAME_GREY for other in (blue, red)):
            return True
    return False


class SourceKind(enum.Enum):
    """Who sets the pace: the consumer, or the world."""

    RECORDED = "recorded"
    LIVE = "live"


class Source(ABC):
    """A stream of frames of one size: close it, or use it as a context manager.

    Iterating goes on where the last iteration stopped; there is no way back.

    Attributes
    ----------
    name
        What the source is called in messages; passwords in URLs are masked.
    kind
        Recorded or live.
    frame_count
        How many frames a recorded source should have; None if unknown. Exact for still images;
        for a video it is the claim of the file's header, fit for a progress bar and no more.
    offset_s
        Added to the times of all frames [s].
    """

    kind: SourceKind
    name: str
    frame_count: int | None = None
    offset_s: float = 0.0

    def __init__(self, name: str) -> None:
        self.name = name
        self._shape: tuple[int, ...] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def __iter__(self) -> Iterator[Frame]:
        return self

    def __next__(self) -> Frame:
        """Return the next (recorded) or the newest (live) frame.

        Raises
        ------
        CaptureError
            The frame cannot be read, or its size differs from the first one's.
        """
        frame = self._next_frame()
        shape = frame.image.shape[:2]
        if self._shape is None:
            self._shape = shape
        elif shape != self._shape:
            raise CaptureError(
                f"{self._place(frame.index)}: {shape[1]} x {shape[0]} pixels, "
                f"the first frame has {self._shape[1]} x {self._shape[0]}; "
                "all frames of a view must have one size"
            )
        if self.offset_s:
            return Frame(frame.index, frame.time_s + self.offset_s, frame.image)
        return frame

    def wait(self) -> None:  # noqa: B027 - nothing to wait for is the usual case
        """Return when the next frame can be had at once; a recorded source is always ready.

        Raises
        ------
        CaptureError
            A live source sent nothing new within its time limit: the camera is lost.
        """

    @abstractmethod
    def _next_frame(self) -> Frame:
        """Deliver a frame, whatever its size; raise StopIteration at the end."""

    def _place(self, index: int) -> str:
        """Say where a frame was found."""
        return f"{self.name}: frame {index}"

    @abstractmethod
    def close(self) -> None:
        """Release files, devices and threads; closing twice does nothing."""
