"""What every source of frames has in common."""

from __future__ import annotations

import enum
import math
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import NDArray

from fingerpost.capture.settings import AS_IT_IS, Arrangement
from fingerpost.errors import CaptureError, InvalidInputError, SourceError


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
    encoded
        The JPEG or PNG that `image` was decoded from, where OpenCV decodes it to the same pixels
        again; else empty.
    """

    index: int
    time_s: float
    image: NDArray[np.uint8]
    encoded: bytes = field(default=b"", repr=False)
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


@dataclass(frozen=True, slots=True)
class Loss:
    """What a view has in place of a frame: there is no picture of that time, or a damaged one.

    Attributes
    ----------
    index, time_s
        As a `Frame`'s.
    why
        What is wrong, for people: "its picture is damaged".
    """

    index: int
    time_s: float
    why: str


DAMAGED = "its picture is damaged"
"""What is said of a picture that its decoder has mended by guess."""

UNDECODABLE = "its picture cannot be decoded"
"""What is said of a picture that its decoder makes nothing of."""

OTHER_SIZE = "its pictures have another size than the first"
"""What is said of a live view's picture that the rig's pixels do not fit."""

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


_FILLED_SHARE = 8
# YCbCr of mid grey, with which JPEG decoders fill, and of all zeros, as a failed decoder leaves it.
_FILLINGS = ((128, 128, 128), (0, 135, 0))
_FILLING_ROUNDING = 1


def ends_filled(image: NDArray[np.uint8]) -> bool:
    """Tell whether the lowest eighth of a picture, or more, is what decoders fill in for pictures.

    No camera shows one level over thousands of pixels, but a drawing may: what a source has shown
    from its first frame on proves nothing.
    """
    corner = np.broadcast_to(image[-1, -1], 3).tolist()
    for filling in _FILLINGS:
        # One pixel is enough for nearly every picture.
        if max(abs(a - b) for a, b in zip(corner, filling, strict=True)) <= _FILLING_ROUNDING:
            lowest = image[-max(1, image.shape[0] // _FILLED_SHARE) :]
            return int(np.ptp(lowest, axis=(0, 1)).max()) <= _FILLING_ROUNDING
    return False


class SourceKind(enum.Enum):
    """Who sets the pace: the consumer, or the world."""

    RECORDED = "recorded"
    LIVE = "live"


class Source(ABC):
    """A stream of frames of one size: close it, or use it as a context manager.

    Iterating goes on where the last iteration stopped; there is no way back. Where a picture cannot
    be believed, a `Loss` stands in its place.

    Attributes
    ----------
    name
        What the source is called in messages; passwords and tokens in URLs are masked.
    kind
        Recorded or live.
    frame_count
        How many frames a recorded source should have; None if unknown. Exact for still images;
        for a video it is the claim of the file's header, fit for a progress bar and no more.
    offset_s
        Added to the times of all frames [s].
    arrangement
        How pictures are turned before they are handed out.
    losses
        How many pictures so far were lost.
    recording
        The file that also knows which frames of several views came together; None of most sources.
    step
        In which step the last frame came there.
    """

    kind: SourceKind
    name: str
    recording: Path | None = None
    step: int = -1
    frame_count: int | None = None
    offset_s: float = 0.0
    arrangement: Arrangement = AS_IT_IS

    def __init__(self, name: str) -> None:
        self.name = name
        self.losses = 0
        self._sound = 0
        self._detail = ""  # of the first loss: what its decoder says, or which file it is
        self._shape: tuple[int, int] | None = None
        self._filled = False

    @property
    def damage(self) -> str:
        """How many pictures are damaged, for people; empty if none is."""
        if not self.losses:
            return ""
        of = self.losses + self._sound
        detail = f" ({self._detail})" if self._detail else ""
        return f"{self.losses} of {of} pictures are damaged{detail}"

    @property
    def notes(self) -> tuple[str, ...]:
        """What else is to be said of the source in the end, for people."""
        return ()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def __iter__(self) -> Iterator[Frame | Loss]:
        return self

    def __next__(self) -> Frame | Loss:
        """Return the next (recorded) or the newest (live) frame, or what is there in its place.

        Raises
        ------
        CaptureError
            The size of a recorded frame differs from the first one's, the source fails, or a
            recording has ended without a single picture that is sound. A `SourceError` if the crop
            that was asked for reaches beyond the picture.
        """
        try:
            seen = self._next_frame()
        except StopIteration:
            self.refuse_unsound()
            raise
        if isinstance(seen, Frame):
            seen = self._of_one_size(seen)
        if isinstance(seen, Frame) and self._has_been_filled(seen.image):
            seen = Loss(seen.index, seen.time_s, DAMAGED)
        if isinstance(seen, Frame):
            self._sound += 1
            seen = self._arranged(seen)
        else:
            self._count()
        return replace(seen, time_s=seen.time_s + self.offset_s) if self.offset_s else seen

    def refuse_unsound(self) -> None:
        """Refuse a source of which every picture so far was lost.

        Raises
        ------
        CaptureError
            There were pictures, and none of them was sound.
        """
        if self.losses and not self._sound:
            raise CaptureError(f"{self.name}: no picture is sound: {self.damage}")

    def _arranged(self, frame: Frame) -> Frame:
        if self.arrangement == AS_IT_IS:
            return frame
        try:
            return Frame(frame.index, frame.time_s, self.arrangement.of(frame.image))
        except InvalidInputError as error:
            raise SourceError(f"{self.name}: {error}") from error

    def _of_one_size(self, frame: Frame) -> Frame | Loss:
        """Return a frame of the first one's size, or what is there in place of another one."""
        height, width = frame.image.shape[:2]
        shape = height, width
        if self._shape is None:
            self._shape = shape
        return frame if shape == self._shape else self._other_size(frame, self._shape)

    def _other_size(self, frame: Frame, first: tuple[int, int]) -> Loss:
        """Refuse a frame of another shape than the first one's."""
        height, width = frame.image.shape[:2]
        raise CaptureError(
            f"{self._place(frame.index)}: {width} x {height} pixels, "
            f"the first frame has {first[1]} x {first[0]}; all frames of a view must have one size"
        )

    def _has_been_filled(self, image: NDArray[np.uint8]) -> bool:
        """Tell whether a picture ends in what decoders fill in, where sound ones do not."""
        filled = ends_filled(image)
        if filled and self._sound and not self._filled:
            return True
        self._filled = filled
        return False

    def _count(self) -> None:
        self.losses += 1

    @property
    def silent_s(self) -> float:
        """How long a live source has sent nothing; a recorded one is never silent."""
        return 0.0

    @property
    def period_s(self) -> float:
        """Usual time between a live source's frames [s]; infinite while it is not known."""
        return math.inf

    @property
    def has_next(self) -> bool:
        """Whether the next frame, or the end, is there at once: always, of recorded sources."""
        return True

    @property
    def due_in_s(self) -> float:
        """How long a live source's next frame may take before it is overdue."""
        return math.inf

    def overdue(self) -> Loss | None:
        """Return what is there in place of a live source's frame that is overdue; else None."""
        return None

    @property
    def is_stale(self) -> bool:
        """Whether a live source's frame has waited for long, and its successor comes soon."""
        return False

    def pass_over(self) -> None:  # noqa: B027 - frames of recordings are never passed over
        """Give up a live source's frame that waits, for the next one."""

    def wait(self, at_most_s: float = math.inf) -> None:  # noqa: B027 - nothing to wait for is usual
        """Return when the next frame, or a loss, can be had at once; recorded ones always can."""

    def linger(self, longest_s: float) -> None:  # noqa: B027 - as above
        """Wait so long at most for a live source that is lost."""

    @abstractmethod
    def _next_frame(self) -> Frame | Loss:
        """Deliver a frame, whatever its size, or a loss; raise StopIteration at the end."""

    def _place(self, index: int) -> str:
        """Say where a frame was found."""
        return f"{self.name}: frame {index}"

    @abstractmethod
    def close(self) -> None:
        """Release files, devices and threads; closing twice does nothing."""
