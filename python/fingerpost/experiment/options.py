"""Options of an experiment."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from fingerpost.errors import InvalidInputError
from fingerpost.pointing import PointingOptions
from fingerpost.simulate import (
    Background,
    Lighting,
    Placement,
    PoseLimits,
    Sensor,
    Workspace,
    checks,
)


@dataclass(frozen=True, kw_only=True)
class ExperimentOptions:
    """One accuracy experiment; the defaults are the paper's rig at its ordinary settings.

    The nested options are documented, with units and ranges, in their own classes: cameras,
    resolution and lens in `Placement`, contrast and shading in `Lighting`, noise and blur in
    `Sensor`, hover, slant and azimuth in `PoseLimits`.
    """

    tracker: Mapping[str, Any] = field(default_factory=dict)
    """Deviations from the defaults of `fingerpost.ContourTracker`, such as
    ``{"model": "paper"}``."""

    targets: int = 400
    """Number of indicated points, each with its own pose, 1 to 1,000,000."""

    seed: int = 0
    """Seed of all random numbers, ≥ 0. Poses, start errors and noise do not depend on the tracker,
    so runs with one seed compare trackers on the same pictures."""

    frames: int = 8
    """Number of pictures of each pose, 1 to 1000, with fresh noise. The tracker converges on them;
    only the result for the last one is used."""

    background_frames: int = 0
    """Number of preceding pictures of the table alone, 0 to 10,000: with enough of them, the
    pointer learns the background."""

    approach_frames: int = 0
    """Number of pictures of the path to the pose from another random one, 0 to 10,000. The trackers
    are started at that one, and converge on `frames` pictures of it: the paper's operator holds the
    hand up to a template before pointing. 0: they are started at the pose itself."""

    frames_per_s: float = 30.0
    """Frame rate of the pictures [1/s], 0.1 to 1000."""

    device: Literal["rod", "hand"] = "rod"
    """Pointing device: the rod and prong of section 3.3, or a hand with its thumb up."""

    taper: float = 0.10
    """Reduction of the diameter from base to tip, as a share, 0 to 0.6."""

    length_mm: tuple[float, float] = (70.0, 90.0)
    """Length of rod or index finger [mm], 50 to 130; uniform in this range."""

    thumb_angle_deg: tuple[float, float] = (70.0, 90.0)
    """Angle between prong or thumb and pointing direction [deg], 40 to 110; uniform."""

    start_offset_px: tuple[float, float] = (0.0, 8.0)
    """Error of the start pose's tip [px], 0 to 500; uniform, in any direction."""

    start_angle_deg: tuple[float, float] = (0.0, 8.0)
    """Error of its direction [deg], 0 to 180; uniform, of either sign."""

    start_scale: tuple[float, float] = (0.9, 1.1)
    """Ratio of its length to the finger's, 0.1 to 10; uniform."""

    reference_noise_px: float = 0.1
    """Standard deviation of each reference point in u and in v [px], 0 to 20; drawn for every
    target, and known to the pointer. 0: known exactly."""

    lens: Literal["known", "ignored"] = "known"
    """Whether the pointer knows the distortion `cameras.k1`."""

    cameras: Placement = field(default_factory=Placement)
    workspace: Workspace = field(default_factory=Workspace)
    limits: PoseLimits = field(default_factory=PoseLimits)
    background: Background = field(default_factory=Background)
    lighting: Lighting = field(default_factory=Lighting)
    sensor: Sensor = field(default_factory=Sensor)
    pointing: PointingOptions = field(default_factory=PointingOptions)

    def __post_init__(self) -> None:
        if not isinstance(self.tracker, Mapping):
            raise InvalidInputError(
                f"tracker is {self.tracker!r}; a mapping from option to value is right"
            )
        object.__setattr__(self, "tracker", dict(self.tracker))
        checks.whole("targets", self.targets, 1, 1_000_000)
        checks.whole("seed", self.seed, 0, 2**63)
        checks.whole("frames", self.frames, 1, 1000)
        checks.whole("background_frames", self.background_frames, 0, 10_000)
        checks.whole("approach_frames", self.approach_frames, 0, 10_000)
        checks.number("frames_per_s", self.frames_per_s, 0.1, 1000)
        checks.choice("device", self.device, ("rod", "hand"))
        checks.number("taper", self.taper, 0, 0.6)
        checks.interval("length_mm", self.length_mm, 50, 130)
        checks.interval("thumb_angle_deg", self.thumb_angle_deg, 40, 110)
        checks.interval("start_offset_px", self.start_offset_px, 0, 500)
        checks.interval("start_angle_deg", self.start_angle_deg, 0, 180)
        checks.interval("start_scale", self.start_scale, 0.1, 10)
        checks.number("reference_noise_px", self.reference_noise_px, 0, 20)
        checks.choice("lens", self.lens, ("known", "ignored"))
        checks.instance("cameras", self.cameras, Placement)
        checks.instance("workspace", self.workspace, Workspace)
        checks.instance("limits", self.limits, PoseLimits)
        checks.instance("background", self.background, Background)
        checks.instance("lighting", self.lighting, Lighting)
        checks.instance("sensor", self.sensor, Sensor)
        checks.instance("pointing", self.pointing, PointingOptions)
