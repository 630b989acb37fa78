"""Options of background, lighting and sensor."""

from dataclasses import dataclass
from typing import Literal

from fingerpost.errors import InvalidInputError
from fingerpost.simulate import checks

Tint = tuple[float, float, float]


def tint(blue: float, green: float, red: float) -> Tint:
    """Return the colour of a grey level of 1, from a colour in any scale: it has a luma of 1."""
    luma = 0.114 * blue + 0.587 * green + 0.299 * red  # ITU-R BT.601, as OpenCV converts to grey
    return blue / luma, green / luma, red / luma


@dataclass(frozen=True)
class Background:
    """The table: its brightness, and the objects on it. It is static and reproducible.

    All objects lie on the working plane and are seen through the camera and its lens, so the views
    are consistent. Grey levels are from 0 to 255.
    """

    level: float = 70.0  # grey level, 0…255; the lighting's contrast is relative to it
    texture: Literal["uniform", "wood"] = "uniform"
    texture_amplitude: float = 12.0  # grey levels, peak of the wood's grain, 0…100
    clutter: float = 0.0  # ± grey levels of randomly placed shapes with sharp edges, 0…127
    sheet: float = 0.0  # grey levels by which a sheet differs, −255…255; 0: no sheet
    seed: int = 0  # of texture and clutter, ≥ 0

    def __post_init__(self) -> None:
        checks.number("level", self.level, 0, 255)
        checks.choice("texture", self.texture, ("uniform", "wood"))
        checks.number("texture_amplitude", self.texture_amplitude, 0, 100)
        checks.number("clutter", self.clutter, 0, 127)
        checks.number("sheet", self.sheet, -255, 255)
        checks.whole("seed", self.seed, 0, 2**63)
        _check_level("level − clutter", self.level - self.clutter)
        _check_level("level + clutter", self.level + self.clutter)
        _check_level("level + sheet", self.level + self.sheet)

    @property
    def is_uniform(self) -> bool:
        """Whether every pixel has the same level."""
        return self.texture == "uniform" and self.clutter == 0 and self.sheet == 0


@dataclass(frozen=True)
class LightChange:
    """A change of the light: its gain goes from 1 to `gain`, at once or over `duration_s`."""

    start_s: float  # s, time of its start
    gain: float  # light after the change over light before, 0…4
    duration_s: float = 0.0  # s, 0…3600; 0 is a step

    def __post_init__(self) -> None:
        checks.number("start_s", self.start_s, -1e6, 1e6)
        checks.number("gain", self.gain, 0, 4)
        checks.number("duration_s", self.duration_s, 0, 3600)

    def gain_at(self, time_s: float) -> float:
        """Gain of the light at a time [s]."""
        elapsed = time_s - self.start_s
        done = float(elapsed >= 0) if self.duration_s == 0 else elapsed / self.duration_s
        return 1 + (self.gain - 1) * min(max(done, 0.0), 1.0)


@dataclass(frozen=True)
class Lighting:
    """Contrast of the device against the background, and its shading."""

    contrast: float = 80.0  # grey levels, device minus background, −255…255, at least 1 in size
    side_light: float = 0.0  # difference between the flanks, lit − dark, of the contrast, 0…1
    limb_darkening: float = 0.0  # u of 1 − u·(1 − cos ϑ), loss of contrast at the outline, 0…1
    shadow: float = 0.0  # light missing in the middle of the shadow cast on the table, 0…1
    change: LightChange | None = None

    def __post_init__(self) -> None:
        if abs(checks.number("contrast", self.contrast, -255, 255)) < 1:
            raise InvalidInputError(
                f"contrast is {self.contrast!r}; it must be −255 to −1 or 1 to 255 grey levels"
            )
        checks.number("side_light", self.side_light, 0, 1)
        checks.number("limb_darkening", self.limb_darkening, 0, 1)
        checks.number("shadow", self.shadow, 0, 1)
        if self.change is not None and not isinstance(self.change, LightChange):
            raise InvalidInputError(f"change is {self.change!r}; it must be a LightChange or None")


# Smaller blur or noise is invisible in any picture; its square is far above the least float.
_LEAST = 1e-6


@dataclass(frozen=True)
class Sensor:
    """Conversion of light to grey levels: square pixels, Gaussian blur, white noise, 8 bit."""

    blur_px: float = 1.0  # px, sigma of the Gaussian point spread function, 0 or 1e-6…5
    noise: float = 2.0  # grey levels, sigma of white Gaussian noise, 0 or 1e-6…60
    exposure_s: float = 0.0  # s, how long the shutter is open, 0…0.2; frame times are mid-exposure
    channels: Literal["grey", "bgr"] = "grey"
    # Cells of the fine grid per sigma of the blur, 1…6: with 3 the error of an edge is 0.0003 px,
    # with 2 it is 0.001 px in half the time, which is sufficient for live display.
    cells_per_sigma: int = 3

    def __post_init__(self) -> None:
        checks.number_or_zero("blur_px", self.blur_px, _LEAST, 5)
        checks.number_or_zero("noise", self.noise, _LEAST, 60)
        checks.number("exposure_s", self.exposure_s, 0, 0.2)
        checks.choice("channels", self.channels, ("grey", "bgr"))
        checks.whole("cells_per_sigma", self.cells_per_sigma, 1, 6)


def check_contrast(background: Background, lighting: Lighting) -> None:
    """Refuse a contrast over a background beyond the range of grey levels."""
    _check_level("background level + lighting contrast", background.level + lighting.contrast)


def _check_level(name: str, level: float) -> None:
    if not 0 <= level <= 255:
        raise InvalidInputError(f"{name} is {level:g}; it must be a grey level from 0 to 255")
