"""Base class of the sources of frames."""

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
        Position in the source, from 0. Unreadable frames of a damaged file, and frames of a live
        source that were not fetched, leave a gap.
    time_s
        Capture time [s]: since the start of the recording for recorded sources, on the machine's
        monotonic clock for live ones.
    image
        `uint8`, C-contiguous, shape (height, width) grey or (height, width, 3) blue-green-red.
    encoded
        The JPEG or PNG that `image` was decoded from, if OpenCV decodes it to the same pixels
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

        The result is cached: every call returns the same array.
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

        An image with three equal channels, apart from a video's rounding, counts as grey: most
        drivers and files deliver the pictures of a monochrome camera in this form.
        """
        if self._has_colours is None:
            object.__setattr__(self, "_has_colours", _is_coloured(self.image))
        return self.image if self._has_colours else None


@dataclass(frozen=True, slots=True)
class Loss:
    """Takes the place of a frame that is missing or damaged.

    Attributes
    ----------
    index, time_s
        As in `Frame`.
    why
        Reason for the user, such as "its picture is damaged".
    """

    index: int
    time_s: float
    why: str


DAMAGED = "its picture is damaged"
"""Reason for a picture whose damage the decoder has concealed."""

UNDECODABLE = "its picture cannot be decoded"
"""Reason for a picture that cannot be decoded."""

_DAMAGES = (DAMAGED, UNDECODABLE)

OTHER_SIZE = "its pictures have another size than the first"
"""Reason for a picture of a live view to which the rig's pixel coordinates do not apply."""

SAME_GREY = 3
"""Greatest difference of the channels of a grey picture after decoding a video [levels]."""


def _is_coloured(image: NDArray[np.uint8]) -> bool:
    """Return whether the channels of an image differ anywhere, starting with a few pixels."""
    import cv2

    if image.ndim == 2:
        return False
    for part in (image[::16, ::16], image):
        blue, green, red = cv2.split(np.ascontiguousarray(part))
        if any(cv2.absdiff(green, other).max() > SAME_GREY for other in (blue, red)):
            return True
    return False


_FILLED_SHARE = 8
# Mid grey, with which JPEG decoders fill; and YCbCr zeros, as a failed decoder leaves them.
_FILLINGS = ((128, 128, 128), (0, 135, 0))
_FILLING_ROUNDING = 1


def ends_filled(image: NDArray[np.uint8]) -> bool:
    """Return whether at least the lowest eighth of a picture has a fill colour of decoders.

    No camera produces one level over thousands of pixels, but a drawing may: if the first frames of
    a source end like this, it is no sign of damage.
    """
    corner = np.broadcast_to(image[-1, -1], 3).tolist()
    for filling in _FILLINGS:
        # One pixel suffices for nearly every picture.
        if max(abs(a - b) for a, b in zip(corner, filling, strict=True)) <= _FILLING_ROUNDING:
            lowest = image[-max(1, image.shape[0] // _FILLED_SHARE) :]
            return int(np.ptp(lowest, axis=(0, 1)).max()) <= _FILLING_ROUNDING
    return False


class SourceKind(enum.Enum):
    """Whether the consumer or real time sets the pace."""

    RECORDED = "recorded"
    LIVE = "live"


class Source(ABC):
    """A stream of frames of one size: close it, or use it as a context manager.

    Iteration continues where the previous one stopped and cannot go back. A `Loss` takes the place
    of a damaged picture.

    Attributes
    ----------
    name
        Name of the source in messages; passwords and tokens in URLs are masked.
    kind
        Recorded or live.
    has_own_clock
        Whether its times are those of a recording that may have begun at another time than those
        of other views.
    frame_count
        Expected number of frames of a recorded source; None if unknown. Exact for still images; for
        a video it is taken from the file's header, and only fit for a progress bar.
    offset_s
        Added to the times of all frames [s].
    arrangement
        Rotation, reflection and crop of the pictures.
    losses
        Number of damaged pictures. A replayed session may also lack frames that never came; these
        are not counted.
    recording
        The file that records which frames of several views belong to one step; None for most
        sources.
    step
        Step of the last frame in that file.
    """

    kind: SourceKind
    has_own_clock: bool = False
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
        self._detail = ""  # of the first loss: the decoder's message, or the file
        self._shape: tuple[int, int] | None = None
        self._filled = False

    @property
    def damage(self) -> str:
        """Number of damaged pictures, in words for the user; empty if there are none."""
        if not self.losses:
            return ""
        of = self.losses + self._sound
        detail = f" ({self._detail})" if self._detail else ""
        return f"{self.losses} of {of} pictures are damaged{detail}"

    @property
    def notes(self) -> tuple[str, ...]:
        """Further final remarks on the source, for people."""
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
        """Return the next (recorded) or the newest (live) frame, or the loss in its place.

        Raises
        ------
        CaptureError
            The size of a recorded frame differs from that of the first one, the source fails, or a
            recording has ended without an intact picture. A `SourceError` if the requested crop
            exceeds the picture.
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
        elif seen.why in _DAMAGES:
            self._count()
        return replace(seen, time_s=seen.time_s + self.offset_s) if self.offset_s else seen

    def refuse_unsound(self) -> None:
        """Refuse a source of which all pictures have been lost.

        Raises
        ------
        CaptureError
            There were pictures, and none of them was intact.
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
        """Return a frame of the first one's size, or the loss in place of another."""
        height, width = frame.image.shape[:2]
        shape = height, width
        if self._shape is None:
            self._shape = shape
        return frame if shape == self._shape else self._other_size(frame, self._shape)

    def _other_size(self, frame: Frame, first: tuple[int, int]) -> Loss:
        """Refuse a frame of another shape than the first."""
        height, width = frame.image.shape[:2]
        raise CaptureError(
            f"{self._place(frame.index)}: {width} x {height} pixels, "
            f"the first frame has {first[1]} x {first[0]}; all frames of a view must have one size"
        )

    def _has_been_filled(self, image: NDArray[np.uint8]) -> bool:
        """Return whether a picture ends in a fill colour, unless intact ones do as well."""
        filled = ends_filled(image)
        if filled and self._sound and not self._filled:
            return True
        self._filled = filled
        return False

    def _count(self) -> None:
        self.losses += 1

    @property
    def silent_s(self) -> float:
        """Time since a live source sent anything [s]; 0 for a recorded one."""
        return 0.0

    @property
    def period_s(self) -> float:
        """Usual time between a live source's frames [s]; infinite while unknown."""
        return math.inf

    @property
    def has_next(self) -> bool:
        """Whether the next frame or the end is available: always, for recorded sources."""
        return True

    @property
    def due_in_s(self) -> float:
        """Time until a live source's next frame is overdue [s]."""
        return math.inf

    def overdue(self) -> Loss | None:
        """Return the loss in place of a live source's overdue frame; else None."""
        return None

    @property
    def is_stale(self) -> bool:
        """Whether the waiting frame of a live source is old, and its successor will come soon."""
        return False

    def pass_over(self) -> None:  # noqa: B027 - frames of recordings are never passed over
        """Discard the waiting frame of a live source in favour of the next one."""

    def begin_at(self, start_s: float) -> None:  # noqa: B027 - of sources with a `recording` only
        """Leave out the steps up to a time after the first one's [s]; call before reading."""

    def wait(self, at_most_s: float = math.inf) -> None:  # noqa: B027 - nothing to wait for is usual
        """Return when the next frame or a loss is available; at once for recorded sources."""

    def linger(self, longest_s: float) -> None:  # noqa: B027 - as above
        """Wait at most `longest_s` for a live source that is lost."""

    @abstractmethod
    def _next_frame(self) -> Frame | Loss:
        """Return a frame of any size, or a loss; raise StopIteration at the end."""

    def _place(self, index: int) -> str:
        """Describe where a frame was found, for messages."""
        return f"{self.name}: frame {index}"

    @abstractmethod
    def close(self) -> None:
        """Release files, devices and threads; closing twice does nothing."""
