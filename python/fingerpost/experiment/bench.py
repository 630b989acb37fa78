"""The simulated test bench: a device points at a target, a pointer estimates it, truth is exact."""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from fingerpost.admission import check_tracker_options
from fingerpost.capture import Frame
from fingerpost.config import LensParameters, Rig
from fingerpost.experiment.bound import LineBound, edge_information, line_bound, point_bound
from fingerpost.experiment.options import ExperimentOptions
from fingerpost.experiment.trial import LineTrial, Trial, line_error, trial_of
from fingerpost.pipeline import Observation, Pointer, steps
from fingerpost.pointing import FingerLine, PlaneView, Status
from fingerpost.simulate import (
    Camera,
    DevicePose,
    FingerTruth,
    Hand,
    PointingDevice,
    PoseSampler,
    RodAndProng,
    SimulatedRig,
    StartError,
    Trajectory,
)
from fingerpost.simulate.truth import finger_truth
from fingerpost.simulated_rig_file import rig_from_simulation

Array = NDArray[np.float64]

# Standard deviation of exactly known reference points [px], as the pointer requires one: far below
# any noise.
_EXACT_PX = 1e-6


class Bench:
    """Common part of all targets of an experiment.

    Parameters
    ----------
    options
        See `ExperimentOptions`.

    Raises
    ------
    InvalidInputError
        Options that contradict each other, or that the tracker refuses.
    """

    def __init__(self, options: ExperimentOptions) -> None:
        self._options = options
        self._rig = SimulatedRig(
            options.cameras,
            workspace=options.workspace,
            background=options.background,
            lighting=options.lighting,
            sensor=options.sensor,
        )
        check_tracker_options(options.tracker)  # here, not during the experiment
        self._sampler = PoseSampler(self._rig, options.limits)
        is_known = options.lens == "known"
        self._lenses = [_lens(camera) if is_known else None for camera in self._rig.cameras]
        sigma = options.reference_noise_px
        self._exact_views = tuple(
            PlaneView.from_reference_points(
                self._rig.plane_points,
                points_px,
                sigma**2 * np.eye(2) if sigma else None,
                None if lens is None else lens.lens(),
            )
            for points_px, lens in zip(self._rig.reference_points_px, self._lenses, strict=True)
        )
        self._information = None
        if options.sensor.noise > 0:
            self._information = edge_information(
                options.lighting.contrast, options.sensor.noise, options.sensor.blur_px
            )

    @property
    def plane_size(self) -> float:
        """Side of the working plane [mm]."""
        return self._exact_views[0].plane_size

    def trial(self, index: int, repeat: int = 0, *, mirrored: bool = False) -> Trial:
        """Point at one target.

        Parameters
        ----------
        index
            Number of the target, ≥ 0. Its random numbers depend only on the experiment's seed and
            this number.
        repeat
            Number ≥ 0 of a repetition with the same pose and start but other noise.
        mirrored
            Whether the noise of that repetition has the opposite sign (see `SimulatedRig.render`).
        """
        rng = np.random.default_rng([self._options.seed, index])
        device = self._device(rng)
        pose = self._sampler.draw(rng, device=device)
        motion = self._motion(pose, device, rng)
        pointer = Pointer(
            self._as_configured(self._fingers(motion.pose_at(0.0), device), rng),
            tracker_options=self._options.tracker,
            pointing_options=self._options.pointing,
            reference_sigma_px=max(self._options.reference_noise_px, _EXACT_PX),
        )
        noise = rng if repeat == 0 else np.random.default_rng([self._options.seed, index, repeat])
        # Only the fix of the last frame is used.
        *_, last = steps(pointer, self._frames(motion, device, noise, mirrored=mirrored))
        fingers = self._fingers(pose, device)
        bounds = self._line_bounds(pose, device, fingers)
        known = [bound for bound in bounds if bound is not None]
        return trial_of(
            last,
            pointer.plane_views,
            index=index,
            target=np.asarray(pose.indicated_mm),  # all sampled poses point down at the plane
            bound=point_bound(self._exact_views, known) if len(known) == len(bounds) else None,
            lines=_line_trials(last.observations, pointer.plane_views, fingers, bounds),
        )

    def _device(self, rng: np.random.Generator) -> PointingDevice:
        options = self._options
        length_mm = rng.uniform(*options.length_mm)
        thumb_angle_deg = rng.uniform(*options.thumb_angle_deg)
        side = rng.choice(["right", "left"])
        if options.device == "rod":
            return RodAndProng(
                length_mm=length_mm, prong_angle_deg=thumb_angle_deg, taper=options.taper
            )
        return Hand(
            side="right" if side == "right" else "left",
            finger_length_mm=length_mm,
            thumb_angle_deg=thumb_angle_deg,
            taper=options.taper,
        )

    def _fingers(self, pose: DevicePose, device: PointingDevice) -> list[FingerTruth]:
        return [finger_truth(camera, device.body, pose) for camera in self._rig.cameras]

    def _motion(
        self, pose: DevicePose, device: PointingDevice, rng: np.random.Generator
    ) -> DevicePose | Trajectory:
        """Stay at the pose, or move to it from the trackers' start pose."""
        options = self._options
        if options.approach_frames == 0:
            return pose
        first = self._sampler.draw(rng, device=device)
        start_s = (options.background_frames + options.frames) / options.frames_per_s
        duration_s = options.approach_frames / options.frames_per_s
        return Trajectory.hold(first, start_s).then(Trajectory.between(first, pose, duration_s))

    def _as_configured(self, fingers: Sequence[FingerTruth], rng: np.random.Generator) -> Rig:
        """Return a rig as a user would configure it, with small errors."""
        options = self._options
        points_px, starts = [], []
        for exact_px, finger in zip(self._rig.reference_points_px, fingers, strict=True):
            points_px.append(exact_px + rng.normal(0.0, options.reference_noise_px, exact_px.shape))
            error = StartError(
                offset_px=rng.uniform(*options.start_offset_px),
                angle_deg=rng.uniform(*options.start_angle_deg),
                scale=rng.uniform(*options.start_scale),
            )
            starts.append(finger.start(error, rng))
        return rig_from_simulation(
            self._rig, reference_points_px=points_px, starts=starts, lenses=self._lenses
        )

    def _frames(
        self,
        motion: DevicePose | Trajectory,
        device: PointingDevice,
        rng: np.random.Generator,
        *,
        mirrored: bool,
    ) -> Iterator[tuple[Frame, ...]]:
        options = self._options
        away, approach = options.background_frames, options.approach_frames
        before = options.frames + approach if approach else 0
        for k in range(away + before + options.frames):
            pictured = self._rig.render(
                motion if k >= away else None,
                time_s=k / options.frames_per_s,
                rng=rng,
                device=device,
                mirrored=mirrored,
            )
            yield tuple(
                Frame(k, view.time_s, image)
                for view, image in zip(pictured.truth.views, pictured.images, strict=True)
            )

    def _line_bounds(
        self, pose: DevicePose, device: PointingDevice, fingers: Sequence[FingerTruth]
    ) -> list[LineBound | None]:
        if self._information is None:
            return [None] * len(fingers)
        return [
            line_bound(camera, device.body, pose, finger, self._information)
            for camera, finger in zip(self._rig.cameras, fingers, strict=True)
        ]


def _line_trials(
    observations: Sequence[Observation],
    plane_views: Sequence[PlaneView],
    fingers: Sequence[FingerTruth],
    bounds: Sequence[LineBound | None],
) -> tuple[LineTrial, ...]:
    trials = []
    for observation, plane_view, finger, bound in zip(
        observations, plane_views, fingers, bounds, strict=True
    ):
        line = observation.finger
        if isinstance(line, FingerLine):
            line = plane_view.through_pinhole(line)
        if isinstance(line, Status):
            continue
        trials.append(
            LineTrial(
                observation.view,
                line_error(line, finger),
                line.covariance,
                None if bound is None else bound.at(line.anchor_px),
            )
        )
    return tuple(trials)


def _lens(camera: Camera) -> LensParameters | None:
    if camera.k1 == 0:
        return None
    cx, cy = camera.principal_point_px.tolist()
    return LensParameters(fx=camera.f_px, fy=camera.f_px, cx=cx, cy=cy, k1=camera.k1)
