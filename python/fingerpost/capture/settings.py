"""Settings of a view's source in a rig: camera settings, time offset, rotation and crop.

Drivers silently ignore or change requested values. All settings are therefore read back, and
differences are reported.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from fingerpost.errors import InvalidInputError

QUARTER_TURNS = (0, 90, 180, 270)

# Tolerance of values: frame rates and drivers' controls are integers or close to one.
_SAME = 0.5
_V4L2_MANUAL_EXPOSURE, _OTHER_MANUAL_EXPOSURE = 1.0, 0.25


@runtime_checkable
class Control(Protocol):
    """The part of `cv2.VideoCapture` that settings need."""

    def set(self, prop: int, value: float, /) -> bool:
        """Request a value; False if there is no such property."""

    def get(self, prop: int, /) -> float:
        """Return the present value."""

    def getBackendName(self) -> str:  # noqa: N802 - OpenCV's name
        """Return the name of the backend that accesses the camera."""


@dataclass(frozen=True, slots=True)
class CameraSettings:
    """Requested camera settings; None leaves a setting unchanged.

    Parameters
    ----------
    width, height
        Size of the picture [px].
    fps
        Frame rate [1/s].
    fourcc
        Pixel format, in four letters: "MJPG" by default, "YUYV", ....
    exposure
        Fixed exposure, in the driver's unit (V4L2: 100 µs; DirectShow: log2 of seconds).
    gain
        Gain, in the driver's unit.
    focus
        Fixed focus, in the driver's unit.
    white_balance_k
        Fixed colour temperature [K].
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
        """Width and height, if both are requested."""
        return None if self.width is None or self.height is None else (self.width, self.height)

    @property
    def asked(self) -> list[str]:
        """Names of the requested settings."""
        return [field.name for field in fields(self) if getattr(self, field.name) is not None]

    def apply(self, camera: Control) -> list[str]:
        """Apply the settings to a camera and read them back.

        Returns
        -------
        list of str
            Differences between requested and actual values, for the user; empty if there are none.
        """
        import cv2

        wanted: list[tuple[str, int, float | None]] = [
            # The pixel format comes first: it determines the available sizes and rates.
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
        # Each may change the others: all are read after all have been set.
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
    """Rotation, then reflection, then crop of a camera's picture.

    Parameters
    ----------
    rotate_deg
        Clockwise rotation: 0, 90, 180 or 270.
    mirror
        Whether to exchange left and right after the rotation.
    crop
        Region (x, y, width, height) of the result to keep [px]; None keeps all.

    Raises
    ------
    InvalidInputError
        Another angle, or a crop without pixels or with a negative position.
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
        """Rotate, mirror and crop a picture; the result is C-contiguous.

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
    """Settings for reading one view's source.

    Parameters
    ----------
    offset_s
        Added to the times of its frames [s].
    arrangement
        Rotation, reflection and crop of its pictures.
    camera
        Requested camera settings; None requests nothing.
    """

    offset_s: float = 0.0
    arrangement: Arrangement = AS_IT_IS
    camera: CameraSettings | None = None
