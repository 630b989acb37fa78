"""The main loop on recordings whose truth is known: files in, fixes out."""

import csv
from pathlib import Path

import numpy as np
import pytest

import fingerpost as fp
from fingerpost.capture import Frame
from fingerpost.config import Rig
from fingerpost.errors import InvalidInputError
from fingerpost.pipeline import Pointer, steps
from fingerpost.pointing import PointingOptions, Status
from fingerpost.simulate import (
    DevicePose,
    Placement,
    SimulatedRig,
    StartError,
    Trajectory,
    write_recording,
)

SEED = 20
FRAMES = 24
FPS = 30.0
# One millimetre on a plane of 400 mm, with noise, a taper and references off by 0.1 px.
ACCURACY_MM = 3.0


def pointing_path() -> Trajectory:
    """A rod over the middle of the plane, its target wandering by some centimetres."""
    first = DevicePose.pointing_at((160.0, 180.0), azimuth_deg=20.0, slant_deg=50.0, hover_mm=120.0)
    last = DevicePose.pointing_at((230.0, 220.0), azimuth_deg=30.0, slant_deg=50.0, hover_mm=120.0)
    return Trajectory.hold(first, 0.3).then(Trajectory.through([first, last], 0.5))


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_recording(
        tmp_path_factory.mktemp("recording"),
        SimulatedRig(),
        pointing_path(),
        frames=FRAMES,
        fps=FPS,
        rng=SEED,
        start_error=StartError(offset_px=4.0, angle_deg=4.0, scale=1.05),
        reference_noise_px=0.1,
    )


def truth_mm(rig_file: Path) -> dict[int, np.ndarray]:
    with (rig_file.parent / "truth.csv").open(newline="") as file:
        return {
            int(row["frame"]): np.array([float(row["x"]), float(row["y"])])
            for row in csv.DictReader(file)
            if row["x"]
        }


def test_a_recording_gives_the_points_that_were_pointed_at(recording):
    truth = truth_mm(recording)
    fixes = list(fp.track(Rig.load(recording)))
    assert len(fixes) == FRAMES
    assert fixes[0].status is Status.ACQUIRING
    found = {k: fix for k, fix in enumerate(fixes) if fix.status is Status.OK}
    assert len(found) >= FRAMES - 6
    errors_mm = [np.hypot(*(fix.point - truth[k])) for k, fix in found.items()]
    assert np.sqrt(np.mean(np.square(errors_mm))) < ACCURACY_MM


def test_the_same_recording_gives_the_same_bits_twice(recording):
    rig = Rig.load(recording)
    once, again = (
        [(fix.status, None if fix.point is None else fix.point.tobytes()) for fix in fp.track(rig)]
        for _ in range(2)
    )
    assert once == again


def test_max_frames_ends_the_run(recording):
    assert len(list(fp.track(Rig.load(recording), max_frames=5))) == 5


def test_a_third_view_that_is_lost_costs_nothing():
    cameras = Placement(azimuths_deg=(-15.0, 15.0, 35.0))
    rig = SimulatedRig(cameras)
    rng = np.random.default_rng(SEED)
    motion = pointing_path()
    pointer = Pointer(as_configured(rig, motion))

    def frames():
        for k in range(12):
            images = rig.render(motion, time_s=0.0, rng=rng).images
            blind = np.full_like(images[2], 70)
            yield [Frame(k, k / FPS, image) for image in (images[0], images[1], blind)]

    *_, last = steps(pointer, frames())
    assert last.fix.status is Status.OK
    assert "view 2 is acquiring" in last.fix.reason


def as_configured(rig: SimulatedRig, motion: Trajectory) -> Rig:
    """The simulated rig as a rig file would have it."""
    from fingerpost.config import Plane, Start, View

    truth = rig.truth(motion, time_s=0.0)
    views = []
    for k, (view, points) in enumerate(zip(truth.views, rig.reference_points_px, strict=True)):
        assert view.finger is not None
        start = view.finger.start()
        views.append(
            View(
                name=str(k),
                source=k,
                reference_points_px=tuple(map(tuple, points.tolist())),
                start=Start(
                    tip_px=tuple(start.tip_px),
                    angle_deg=start.angle_deg,
                    length_px=start.length_px,
                    thumb=start.thumb,
                ),
            )
        )
    plane = Plane(unit="mm", points=tuple(map(tuple, rig.plane_points.tolist())))
    return Rig(plane=plane, views=tuple(views))


def test_views_that_are_captured_at_different_times_are_brought_to_one():
    skew_s = 0.4 / FPS
    motion = pointing_path()
    skewed = SimulatedRig(Placement(time_skews_s=(0.0, skew_s)))
    pointer = Pointer(as_configured(skewed, motion))
    rng = np.random.default_rng(SEED)
    truth, found = {}, {}
    for k in range(FRAMES):
        time_s = k / FPS
        images = skewed.render(motion, time_s=time_s, rng=rng).images
        truth[k] = np.asarray(motion.pose_at(time_s).indicated_mm)
        frames = [Frame(k, time_s + lag, i) for i, lag in zip(images, (0.0, skew_s), strict=True)]
        for step in pointer.update(frames):
            # The second view's frame of this step comes after the first view's: a frame later the
            # first view's time has neighbours on both sides.
            assert step.fix.time_s == pytest.approx(step.index / FPS)
            if step.fix.status is Status.OK:
                found[step.index] = np.hypot(*(step.fix.point - truth[step.index]))
    assert len(found) >= FRAMES - 8
    assert np.sqrt(np.mean(np.square(list(found.values())))) < ACCURACY_MM


def test_the_last_frames_are_told_even_if_no_later_one_comes():
    motion = pointing_path()
    rig = SimulatedRig()
    pointer = Pointer(as_configured(rig, motion))
    images = rig.render(motion, time_s=0.0, rng=SEED).images
    late = [Frame(0, 1.0, images[0]), Frame(0, 0.9, images[1])]
    told = list(steps(pointer, [late]))
    assert [step.index for step in told] == [0]
    assert told[0].fix.status is Status.LOST


def test_a_frame_that_cannot_be_read_is_a_lost_frame_of_that_view():
    motion = pointing_path()
    rig = SimulatedRig()
    pointer = Pointer(as_configured(rig, motion), pointing_options=PointingOptions())
    rng = np.random.default_rng(SEED)
    for k in range(8):
        images = rig.render(motion, time_s=0.0, rng=rng).images
        list(pointer.update([Frame(k, k / FPS, image) for image in images]))
    images = rig.render(motion, time_s=0.0, rng=rng).images
    gap = list(pointer.update([Frame(8, 8 / FPS, images[0]), None]))
    after = list(pointer.update([Frame(9, 9 / FPS, image) for image in images]))
    # The view without a frame has neighbours in time, so nothing is lost but one frame of delay.
    assert [step.index for step in gap + after] == [8, 9]
    assert all(step.fix.status is Status.OK for step in gap + after)


def test_a_rig_that_cannot_point_is_refused(recording):
    rig = Rig.load(recording)
    with pytest.raises(InvalidInputError, match="1 view; pointing needs two"):
        Pointer(Rig(plane=rig.plane, views=rig.views[:1]))
    with pytest.raises(InvalidInputError, match="modell"):
        Pointer(rig, tracker_options={"modell": "paper"})


def test_colour_images_are_tracked_as_well():
    motion = pointing_path()
    rig = SimulatedRig()
    pointer = Pointer(as_configured(rig, motion))
    rng = np.random.default_rng(SEED)
    frames = (
        [
            Frame(k, k / FPS, np.repeat(image[..., None], 3, axis=2))
            for image in rig.render(motion, time_s=0.0, rng=rng).images
        ]
        for k in range(8)
    )
    *_, last = steps(pointer, frames)
    assert last.fix.status is Status.OK
    assert np.hypot(*(last.fix.point - motion.pose_at(0.0).indicated_mm)) < ACCURACY_MM
