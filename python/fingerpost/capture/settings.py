"""What a rig asks of a view's source beside its name: settings of its camera, its picture turned.

Drivers take what they like of what is asked and say nothing. So everything is read back, and what
has become otherwise is reported.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from fingerpost.errors import InvalidInputError

QUARTER_TURNS = (0, 90, 180, 270)

# Rates and the controls of drivers are whole numbers or near to them.
_SAME = 0.5
_V4L2_MANUAL_EXPOSURE, _OTHER_MANUAL_EXPOSURE = 1.0, 0.25


@runtime_checkable
class Control(Protocol):
    """The part of `cv2.VideoCapture` that settings need."""

    def set(self, prop: int, value: float, /) -> bool:
        """Ask for a value; False where there is no such thing."""

    def get(self, prop: int, /) -> float:
        """Return what is in force."""

    def getBackendName(self) -> str:  # noqa: N802 - OpenCV's name
        """Return the name of the system that the camera is reached by."""


@dataclass(frozen=True, slots=True)
class CameraSettings:
    """What a camera is asked for; None leaves it as it is.

    Parameters
    ----------
    width, height
        Size of the picture [px].
    fps
        Frames a second.
    fourcc
        How pixels are sent, in four letters: "MJPG" where nothing is said, "YUYV", ....
    exposure
        Held still at this, in the driver's unit (V4L2: 100 µs; DirectShow: log2 of seconds).
    gain
        In the driver's unit.
    focus
        Held still at this, in the driver's unit.
    white_balance_k
        Held still at this colour temperature [K].
    """

    width: int | None = None
    height: int | None = None
    fps: float | None = None
    fourcc: str | None = None
    exposure: float | None = None
    gain: float | None = None
    focus: float | None = None
    white_balance_k: float | None = None

    @property
    def size_px(self) -> tuple[int, int] | None:
        """Width and height, where both are asked for."""
        return None if self.width is None or self.height is None else (self.width, self.height)

    @property
    def asked(self) -> list[str]:
        """Names of what is asked for."""
        return [field.name for field in fields(self) if getattr(self, field.name) is not None]

    def apply(self, camera: Control) -> list[str]:
        """Ask a camera for all of it, and read back what it has made of that.

        Returns
        -------
        list of str
            What differs from what was asked, for people; empty if nothing does.
        """
        import cv2

        wanted: list[tuple[str, int, float | None]] = [
            # The way of sending comes first: it decides which sizes and rates there are.
            ("fourcc", cv2.CAP_PROP_FOURCC, None if self.fourcc is None else _number(self.fourcc)),
            ("width", cv2.CAP_PROP_FRAME_WIDTH, self.width),
            ("height", cv2.CAP_PROP_FRAME_HEIGHT, self.height),
            ("fps", cv2.CAP_PROP_FPS, self.fps),
            ("exposure", cv2.CAP_PROP_EXPOSURE, self.exposure),
            ("gain", cv2.CAP_PROP_GAIN, self.gain),
            ("focus", cv2.CAP_PROP_FOCUS, self.focus),
            ("white_balance_k", cv2.CAP_PROP_WB_TEMPERATURE, self.white_balance_k),
        ]
        asked = [(name, prop, value) for name, prop, value in wanted if value is not None]
        for prop, value in self._automatics_off(camera):
            camera.set(prop, value)
        taken = {name: camera.set(prop, value) for name, prop, value in asked}
        # Each may change the others: all are read when all have been set.
        return [
            _difference(name, value, camera.get(prop))
            for name, prop, value in asked
            if not taken[name] or abs(camera.get(prop) - value) > _SAME
        ]

    def _automatics_off(self, camera: Control) -> Iterator[tuple[int, float]]:
        import cv2

        if self.exposure is not None:
            is_v4l2 = camera.getBackendName() == "V4L2"
            manual = _V4L2_MANUAL_EXPOSURE if is_v4l2 else _OTHER_MANUAL_EXPOSURE
            yield cv2.CAP_PROP_AUTO_EXPOSURE, manual
        if self.focus is not None:
            yield cv2.CAP_PROP_AUTOFOCUS, 0.0
        if self.white_balance_k is not None:
            yield cv2.CAP_PROP_AUTO_WB, 0.0


def _number(fourcc: str) -> int:
    return int.from_bytes(fourcc.encode("ascii"), "little")


def _letters(number: float) -> str:
    letters = (int(number) & 0xFFFFFFFF).to_bytes(4, "little").decode("latin-1").strip("\0 ")
    return letters if letters and letters.isprintable() else "unknown"


def _difference(name: str, asked: float, found: float) -> str:
    if name == "fourcc":
        return f"fourcc is {_letters(found)}, {_letters(asked)} was asked for"
    if found < 0.0 and asked >= 0.0:  # OpenCV's answer for what a camera does not have
        return f"{name} cannot be set, {asked:g} was asked for"
    return f"{name} is {found:g}, {asked:g} was asked for"


@dataclass(frozen=True, slots=True)
class Arrangement:
    """How a camera's picture becomes its view's: turned, then mirrored, then cropped.

    Parameters
    ----------
    rotate_deg
        Turned clockwise: 0, 90, 180 or 270.
    mirror
        Whether left and right are exchanged then.
    crop
        (x, y, width, height) of what is kept of that [px]; None keeps all.

    Raises
    ------
    InvalidInputError
        Another angle, or a crop without a pixel or with a negative place.
    """

    rotate_deg: int = 0
    mirror: bool = False
    crop: tuple[int, int, int, int] | None = None

    def __post_init__(self) -> None:
        if self.rotate_deg not in QUARTER_TURNS:
            raise InvalidInputError(
                f"rotate_deg is {self.rotate_deg}; 0, 90, 180 or 270, clockwise, is right"
            )
        if self.crop is not None and (min(self.crop[:2]) < 0 or min(self.crop[2:]) < 1):
            raise InvalidInputError(
                f"crop is {list(self.crop)}; [x, y, width, height] with x and y from 0 and sides "
                "from 1 px is right"
            )

    def of(self, picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return a picture as the view has it, C-contiguous.

        Parameters
        ----------
        picture : (height, width) or (height, width, 3)

        Raises
        ------
        InvalidInputError
            The crop reaches beyond the picture.
        """
        turned = np.rot90(picture, -self.rotate_deg // 90)
        arranged = turned[:, ::-1] if self.mirror else turned
        if self.crop is not None:
            x, y, width, height = self.crop
            if x + width > arranged.shape[1] or y + height > arranged.shape[0]:
                raise InvalidInputError(
                    f"crop {list(self.crop)} reaches beyond the picture of {arranged.shape[1]} × "
                    f"{arranged.shape[0]} px"
                )
            arranged = arranged[y : y + height, x : x + width]
        return np.ascontiguousarray(arranged)


AS_IT_IS = Arrangement()


@dataclass(frozen=True, slots=True)
class Reading:
    """How one view's source is read.

    Parameters
    ----------
    offset_s
        Added to the times of its frames [s].
    arrangement
        How its pictures are turned.
    camera
        What its camera is asked for; None asks for nothing.
    """

    offset_s: float = 0.0
    arrangement: Arrangement = AS_IT_IS
    camera: CameraSettings | None = None
