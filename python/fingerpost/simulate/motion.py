"""Motion of a pointing device: any object with `pose_at`, and smooth paths of the tip."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fingerpost.checks import finite_array
from fingerpost.errors import InvalidInputError
from fingerpost.simulate import checks
from fingerpost.simulate.camera import Workspace
from fingerpost.simulate.pose import DevicePose

Array = NDArray[np.float64]

# Paths are laid down at this step and interpolated linearly: at 10 m/s² that is 1 µm.
STEP_S = 1e-3
SAMPLES_PER_PIECE = 100


class Motion(Protocol):
    """A pose for every time; a `DevicePose` is a static one."""

    def pose_at(self, time_s: float) -> DevicePose | None:
        """Pose at a time [s]; None while the device is away."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """A path in time; before its start and after its end the device waits at the respective end.

    Parameters
    ----------
    times_s
        (T,) ascending times [s] that start at 0, T ≥ 2.
    samples
        (T, 6) tip X, Y, Z [mm], azimuth, slant and roll [deg], interpolated linearly.
    """

    times_s: Array
    samples: Array

    def __post_init__(self) -> None:
        times = finite_array(self.times_s, "times_s", ("T",)).copy()
        samples = finite_array(self.samples, "samples", (len(times), 6)).copy()
        if len(times) < 2 or times[0] != 0 or (np.diff(times) <= 0).any():
            raise InvalidInputError("times_s must be two or more ascending times that start at 0")
        object.__setattr__(self, "times_s", times)
        object.__setattr__(self, "samples", samples)

    @classmethod
    def hold(cls, pose: DevicePose, duration_s: float) -> "Trajectory":
        """Return a static trajectory of a given duration."""
        return cls.between(pose, pose, duration_s)

    @classmethod
    def between(cls, first: DevicePose, last: DevicePose, duration_s: float) -> "Trajectory":
        """Return the linear interpolation from one pose to another.

        Azimuths are not wrapped here: the path from −170° to 170° passes 0°.
        """
        duration = checks.number("duration_s", duration_s, STEP_S, 1e6)
        return cls(np.array([0.0, duration]), np.stack([_vector(first), _vector(last)]))

    @classmethod
    def through(
        cls, poses: Sequence[DevicePose], speed_m_s: float, *, ease_s: float = 0.15
    ) -> "Trajectory":
        """Return a smooth path whose tip passes through poses at constant speed.

        The path is a Catmull–Rom spline over the tips' distances (centripetal, so it makes no
        loops), traversed at constant speed of the tip, with constant acceleration at both ends.

        Parameters
        ----------
        poses
            Two or more; consecutive tips at least 1 mm apart.
        speed_m_s
            Speed of the tip [m/s], 0.001 to 10.
        ease_s
            Duration of acceleration and of deceleration [s], 0 to 5.
        """
        speed = 1000 * checks.number("speed_m_s", speed_m_s, 0.001, 10)
        ease = checks.number("ease_s", ease_s, 0, 5)
        if len(poses) < 2:
            raise InvalidInputError(f"poses has {len(poses)}; a path needs two or more")
        knots = np.stack([_vector(pose) for pose in poses])
        knots[:, 3] = np.unwrap(knots[:, 3], period=360)
        gaps = np.linalg.norm(np.diff(knots[:, :3], axis=0), axis=1)
        if (gaps < 1).any():
            place = int(np.argmax(gaps < 1))
            raise InvalidInputError(
                f"poses[{place}] and poses[{place + 1}] have tips {gaps[place]:.3g} mm apart; "
                "a path needs 1 mm or more"
            )
        curve = _catmull_rom(knots, gaps)
        run = np.linalg.norm(np.diff(curve[:, :3], axis=0), axis=1)
        travelled = np.concatenate([[0.0], np.cumsum(run)])
        total = travelled[-1]
        ease = min(ease, total / speed)
        duration = total / speed + ease
        times = np.linspace(0, duration, max(int(np.ceil(duration / STEP_S)), 1) + 1)
        distance = _eased_distance(times, speed, ease, duration)
        samples = np.stack([np.interp(distance, travelled, column) for column in curve.T], axis=1)
        return cls(times, samples)

    @property
    def duration_s(self) -> float:
        """Length of the trajectory [s]."""
        return float(self.times_s[-1])

    def then(self, following: "Trajectory") -> "Trajectory":
        """Return this trajectory followed by another, which starts where this one ends."""
        if not np.allclose(self.samples[-1, :3], following.samples[0, :3], atol=1e-6):
            raise InvalidInputError(
                f"the next trajectory starts at {following.samples[0, :3]} mm; it must start where "
                f"this one ends, at {self.samples[-1, :3]} mm"
            )
        # Whole turns may differ between two parts of one motion.
        turns = np.round((self.samples[-1, 3] - following.samples[0, 3]) / 360) * 360
        rest = following.samples[1:] + np.array([0, 0, 0, turns, 0, 0])
        times = np.concatenate([self.times_s, self.duration_s + following.times_s[1:]])
        return Trajectory(times, np.concatenate([self.samples, rest]))

    def pose_at(self, time_s: float) -> DevicePose:
        """Pose at a time [s]."""
        time = checks.number("time_s", time_s, -1e9, 1e9)
        row = [float(np.interp(time, self.times_s, column)) for column in self.samples.T]
        azimuth = (row[3] + 180) % 360 - 180
        return DevicePose((row[0], row[1], row[2]), azimuth, row[4], row[5])


def pointing_session(
    poses: Sequence[DevicePose],
    *,
    speed_m_s: float = 0.2,
    entry_speed_m_s: float = 0.6,
    wait_s: float = 0.6,
    away_s: float = 0.5,
    entry_mm: float = 900.0,
) -> Trajectory:
    """Hand enters, waits, points along a path, leaves, stays away, returns, and waits again.

    Parameters
    ----------
    poses
        The path, as for `Trajectory.through`.
    speed_m_s, entry_speed_m_s
        Speed of the tip along the path, and of entry and exit [m/s].
    wait_s, away_s
        Time of waiting before and after, and time away [s].
    entry_mm
        Distance of withdrawal along the finger when it is away [mm]; large enough for it to be
        outside every view.
    """
    if len(poses) < 2:
        raise InvalidInputError(f"poses has {len(poses)}; a path needs two or more")
    first, last = poses[0], poses[-1]
    outside, gone = first.retreated(entry_mm), last.retreated(entry_mm)
    return (
        Trajectory.through([outside, first], entry_speed_m_s)
        .then(Trajectory.hold(first, wait_s))
        .then(Trajectory.through(poses, speed_m_s))
        .then(Trajectory.through([last, gone], entry_speed_m_s))
        .then(Trajectory.hold(gone, away_s))
        .then(Trajectory.through([gone, last], entry_speed_m_s))
        .then(Trajectory.hold(last, wait_s))
    )


def figure_eight(
    workspace: Workspace,
    *,
    size: float = 0.5,
    hover_mm: float = 80.0,
    azimuth_deg: float = 35.0,
    slant_deg: float = 45.0,
    sway_deg: float = 12.0,
    points: int = 24,
) -> list[DevicePose]:
    """Return poses that point along a lying figure eight in the workspace.

    Parameters
    ----------
    workspace
        The workspace.
    size
        Width of the eight over the workspace's side, 0.05 to 1.
    hover_mm
        Height of the tip [mm], 10 to 500.
    azimuth_deg, slant_deg
        Middle of the orientation, which sways by `sway_deg` in azimuth, a third of it in slant.
    sway_deg
        0 to 30.
    points
        Number of poses, 8 to 1000; the figure is closed, so the first would follow the last.
    """
    checks.number("size", size, 0.05, 1)
    checks.number("sway_deg", sway_deg, 0, 30)
    checks.whole("points", points, 8, 1000)
    phase = np.linspace(0, 2 * np.pi, points, endpoint=False)
    middle, reach = workspace.side_mm / 2, size * workspace.side_mm / 2
    targets = np.stack([middle + reach * np.sin(phase), middle + reach * np.sin(2 * phase) / 2], -1)
    return [
        DevicePose.pointing_at(
            target,
            hover_mm=hover_mm,
            azimuth_deg=azimuth_deg + sway_deg * float(np.sin(angle)),
            slant_deg=slant_deg + sway_deg / 3 * float(np.cos(angle)),
        )
        for target, angle in zip(targets, phase, strict=True)
    ]


def _vector(pose: DevicePose) -> Array:
    return np.array([*pose.tip_mm, pose.azimuth_deg, pose.slant_deg, pose.roll_deg])


def _catmull_rom(knots: Array, gaps: ArrayLike) -> Array:
    """Dense samples of a centripetal Catmull–Rom spline through (K, 6) knots."""
    span = np.sqrt(np.asarray(gaps))
    slopes = np.diff(knots, axis=0) / span[:, None]
    inner = (slopes[:-1] * span[1:, None] + slopes[1:] * span[:-1, None]) / (span[:-1] + span[1:])[
        :, None
    ]
    tangents = np.concatenate([slopes[:1], inner, slopes[-1:]])
    part = np.linspace(0, 1, SAMPLES_PER_PIECE, endpoint=False)[:, None]
    hermite = np.stack(
        [
            2 * part**3 - 3 * part**2 + 1,
            part**3 - 2 * part**2 + part,
            -2 * part**3 + 3 * part**2,
            part**3 - part**2,
        ]
    )
    pieces = [
        hermite[0] * knots[i]
        + hermite[1] * tangents[i] * span[i]
        + hermite[2] * knots[i + 1]
        + hermite[3] * tangents[i + 1] * span[i]
        for i in range(len(span))
    ]
    return np.concatenate([*pieces, knots[-1:]])


def _eased_distance(times: Array, speed: float, ease: float, duration: float) -> Array:
    """Distance run after each time, with constant acceleration over `ease` at both ends."""
    if ease == 0:
        return times * speed
    remaining = duration - times
    total = speed * (duration - ease)
    return np.where(
        times < ease,
        speed * times**2 / (2 * ease),
        np.where(
            remaining < ease, total - speed * remaining**2 / (2 * ease), speed * (times - ease / 2)
        ),
    )
