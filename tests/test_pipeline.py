"""The main loop on simulated recordings with known truth: from files to fixes."""

import csv
import dataclasses
import gc
import tracemalloc
from collections.abc import Callable
from itertools import islice
from pathlib import Path
from types import SimpleNamespace

import cv2
import msgspec
import numpy as np
import pytest
from click.testing import CliRunner
from numpy.typing import NDArray

import fingerpost as fp
from fingerpost.capture import Frame, Source, SourceKind, open_source, read_views
from fingerpost.cli import main
from fingerpost.config import Rig
from fingerpost.errors import InvalidInputError
from fingerpost.homography import estimate_image_from_plane, transfer_to_image
from fingerpost.pipeline import Observation, Pointer, Step, steps
from fingerpost.pointing import PointingOptions, Status
from fingerpost.simulate import (
    Background,
    DevicePose,
    Placement,
    SimulatedRig,
    StartError,
    Trajectory,
    write_recording,
)
from fingerpost.simulated_rig_file import rig_from_simulation

SEED = 20
FRAMES = 24
FPS = 30.0
# For a plane of 400 mm, with noise, a taper and a reference noise of 0.1 px.
ACCURACY_MM = 3.0


def pointing_path() -> Trajectory:
    """A rod above the middle of the plane whose target moves by some centimetres."""
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


def test_a_lost_third_view_does_not_prevent_a_fix():
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
    assert last.fix.reason == f'view "{pointer.views[2].name}" is acquiring'
    assert last.point_row().reason == last.fix.reason


def with_references(rig: Rig, plane_points: list[tuple[float, float]]) -> Rig:
    """The rig with other reference points, placed in the images by its own ones."""
    views = []
    for view in rig.views:
        T = estimate_image_from_plane(rig.plane.points, view.reference_points_px)
        points_px = [tuple(point_px) for point_px in transfer_to_image(T, plane_points).tolist()]
        views.append(msgspec.structs.replace(view, reference_points_px=tuple(points_px)))
    plane = msgspec.structs.replace(rig.plane, points=tuple(plane_points))
    return msgspec.structs.replace(rig, plane=plane, views=tuple(views))


def steps_of_a_bump(
    background: Background,
    change: Callable[[NDArray[np.uint8]], NDArray[np.uint8]],
    plane_points: list[tuple[float, float]],
) -> list[Step]:
    """Steps of a resting hand; the second camera is displaced in frames 12 to 23."""
    rig = SimulatedRig(background=background)
    rng, motion = np.random.default_rng(SEED), pointing_path()
    pointer = Pointer(with_references(as_configured(rig, motion), plane_points))
    reported = []
    for k in range(36):
        first, second = rig.render(motion, time_s=0.0, rng=rng).images
        bumped = np.roll(change(second), (-3, 5), axis=(0, 1)) if 12 <= k < 24 else change(second)
        (step,) = pointer.update([Frame(k, k / FPS, image) for image in (first, bumped)])
        reported.append(step)
    return reported


def test_a_view_whose_camera_has_moved_gives_the_same_point():
    corners = [(0.0, 0.0), (400.0, 0.0), (400.0, 400.0), (0.0, 400.0)]
    reported = steps_of_a_bump(Background(clutter=30.0, sheet=60.0), lambda image: image, corners)
    before, during, after = reported[11], reported[23], reported[35]
    assert [step.fix.status for step in reported[11:]] == 25 * [Status.OK]
    moved = during.observations[1]
    assert moved.moved_px == pytest.approx(np.hypot(5.0, 3.0), abs=0.2)
    assert moved.reasons[-1].startswith("camera moved by 6 px")
    points = before.observations[1].plane_view.plane_points
    there_px = moved.plane_view.project(points) - before.observations[1].plane_view.project(points)
    assert there_px == pytest.approx(np.tile([5.0, -3.0], (len(points), 1)), abs=0.25)
    assert np.hypot(*(during.fix.point - before.fix.point)) < 1.0
    assert after.observations[1].moved_px == 0.0
    assert after.observations[1].plane_view is before.observations[1].plane_view


def test_a_camera_moved_before_a_plain_table_gives_no_fix_until_it_is_back():
    # The bump shows only at the picture's border, where the plane is not known.
    texture = np.random.default_rng(SEED).uniform(40, 200, (40, 54)).astype(np.float32)
    texture = cv2.resize(texture, (640, 480), interpolation=cv2.INTER_CUBIC)

    def with_border(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        framed = np.clip(texture, 0, 255).astype(np.uint8)
        framed[30:-30, 30:-30] = image[30:-30, 30:-30]
        return framed

    middle = [(100.0, 100.0), (300.0, 100.0), (300.0, 300.0), (100.0, 300.0)]
    reported = steps_of_a_bump(Background(), with_border, middle)
    assert [step.fix.status for step in (reported[11], reported[23], reported[35])] == [
        Status.OK,
        Status.ILL_CONDITIONED,
        Status.OK,
    ]
    still, moved = reported[23].observations
    assert reported[23].fix.reason == (
        f'view "{moved.view}": the camera has moved the reference points by 6 px'
    )
    assert "moved" not in " ".join(still.reasons)
    assert moved.reasons[0] == "the camera has moved the reference points by 6 px"
    assert moved.track_row().status == "tracking"
    assert reported[35].observations[1].moved_px == 0.0


def as_configured(rig: SimulatedRig, motion: Trajectory) -> Rig:
    """The simulated rig as a rig file describes it."""
    fingers = [view.finger for view in rig.truth(motion, time_s=0.0).views]
    return rig_from_simulation(rig, starts=[finger.start() for finger in fingers])


def test_views_that_follow_different_fingers_give_no_point():
    rig = SimulatedRig()
    first = DevicePose.pointing_at((160.0, 180.0), azimuth_deg=20.0, slant_deg=50.0, hover_mm=60.0)
    # Off the first finger's epipolar lines; the two finger lines still intersect in a point.
    second = dataclasses.replace(first, tip_mm=(*first.tip_mm[:2], first.tip_mm[2] + 90.0))
    motions = [Trajectory.hold(pose, 1.0) for pose in (first, second)]
    views = [as_configured(rig, motion).views[k] for k, motion in enumerate(motions)]
    pointer = Pointer(msgspec.structs.replace(as_configured(rig, motions[0]), views=tuple(views)))
    rng = np.random.default_rng(SEED)
    images = [rig.render(motion, time_s=0.0, rng=rng).images[k] for k, motion in enumerate(motions)]
    fixes = []
    for k in range(15):
        pair = [Frame(k, k / FPS, image) for image in images]
        fixes += [step.fix for step in pointer.update(pair)]
    assert Status.OK not in {fix.status for fix in fixes}
    assert fixes[-1].status is Status.ILL_CONDITIONED
    assert "its fingertip is not that of the other views" in fixes[-1].reason


def test_views_captured_at_different_times_are_interpolated_to_one():
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
            # The second view's frame of a step is later than the first view's: one frame later,
            # the first view's time has neighbours on both sides.
            assert step.fix.time_s == pytest.approx(step.index / FPS)
            if step.fix.status is Status.OK:
                found[step.index] = np.hypot(*(step.fix.point - truth[step.index]))
    assert len(found) >= FRAMES - 8
    assert np.sqrt(np.mean(np.square(list(found.values())))) < ACCURACY_MM


class Rendered(Source):
    """Frames of one view of a simulated rig, as a recording with a frame rate of its own."""

    kind = SourceKind.RECORDED

    def __init__(self, rig: SimulatedRig, motion: Trajectory, view: int, fps: float, lag_s: float):
        super().__init__(f"view {view}")
        rng = np.random.default_rng(SEED + view)
        self._frames = (
            Frame(
                k, k / fps + lag_s, rig.render(motion, time_s=k / fps + lag_s, rng=rng).images[view]
            )
            for k in range(int(FRAMES / FPS * fps))
        )

    def _next_frame(self) -> Frame:
        return next(self._frames)

    def close(self) -> None:
        """There is nothing to close."""


def steps_at_rates(rates: tuple[float, float], lag_s: float = 0.0) -> list[Step]:
    """Steps of two views with the given frame rates [Hz]."""
    rig, motion = SimulatedRig(), pointing_path()
    sources = [Rendered(rig, motion, k, rates[k], (0.0, lag_s)[k]) for k in (0, 1)]
    return list(steps(Pointer(as_configured(rig, motion)), read_views(sources)))


@pytest.mark.parametrize("rates", [(FPS, FPS / 2), (FPS, 5 * FPS / 6), (FPS / 2, FPS)])
def test_views_with_different_frame_rates_give_a_fix_for_every_frame_of_the_first(rates):
    reported, motion = steps_at_rates(rates), pointing_path()
    assert [step.index for step in reported] == list(range(len(reported)))
    assert len(reported) >= int(FRAMES / FPS * rates[0]) - 2
    # Settling takes the same number of frames in every view, so the slower one decides.
    late = [step for step in reported if step.fix.time_s > 5 / min(rates)]
    found = [step for step in late if step.fix.status is Status.OK]
    assert len(found) >= 0.8 * len(late) >= 4
    misses = [step.fix.point - motion.pose_at(step.fix.time_s).indicated_mm for step in found]
    # The median, since interpolation between frames is wrong where the hand starts to move.
    assert np.median(np.hypot(*np.transpose(misses))) < ACCURACY_MM


def test_views_too_slow_for_interpolation_say_so():
    reported = steps_at_rates((8.0, 8.0), lag_s=0.02)
    reasons = {step.fix.reason for step in reported[-3:-1]}
    assert reasons == {'view "right": no finger line for 0.125 s; at most 0.1 s are bridged'}


def test_a_view_that_falls_behind_delays_the_others_by_at_most_the_limit():
    motion, rig = pointing_path(), SimulatedRig()
    pointer = Pointer(as_configured(rig, motion))
    images = rig.render(motion, time_s=0.0, rng=SEED).images
    for k in range(8):
        assert len(list(pointer.update([Frame(k, k / FPS, image) for image in images]))) == 1
    reported: list[Step] = []
    for k in range(8, 30):
        reported += pointer.update([Frame(k, k / FPS, images[0]), None])
        # 0.1 s are three frames; the next one shows that the limit is exceeded.
        assert k - 8 - 4 < len(reported) <= k - 8
    last = reported[-1]
    assert last.fix.status is Status.LOST
    assert 'view "right": no frame for 0.1' in last.fix.reason
    assert "at most 0.1 s are waited for" in last.fix.reason


def test_the_last_frames_are_reported_without_a_later_one():
    motion = pointing_path()
    rig = SimulatedRig()
    pointer = Pointer(as_configured(rig, motion))
    images = rig.render(motion, time_s=0.0, rng=SEED).images
    late = [Frame(0, 1.0, images[0]), Frame(0, 0.9, images[1])]
    reported = list(steps(pointer, [late]))
    assert [step.index for step in reported] == [0]
    assert reported[0].fix.status is Status.LOST


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
    # The view without a frame has neighbours in time: the only cost is one frame of delay.
    assert [step.index for step in gap + after] == [8, 9]
    assert all(step.fix.status is Status.OK for step in gap + after)


def test_a_frame_that_one_tracker_refuses_does_not_affect_other_views():
    motion, rig = pointing_path(), SimulatedRig()
    pointer = Pointer(as_configured(rig, motion))
    first, second = rig.render(motion, time_s=0.0, rng=SEED).images
    for k in range(8):
        list(pointer.update([Frame(k, k / FPS, first), Frame(k, k / FPS, second)]))
    with pytest.raises(InvalidInputError, match="at or after the last frame's"):
        list(pointer.update([Frame(8, 0.0, first), Frame(8, 8 / FPS, second)]))
    assert pointer.views[0].track.time_s == 7 / FPS
    assert pointer.views[1].track.time_s == 8 / FPS
    (step,) = pointer.update([Frame(9, 9 / FPS, first), Frame(9, 9 / FPS, second)])
    assert step.fix.status is Status.OK


# Memory in use while a frame is processed: finger lines, contours and search lines of two views.
# A copy of one image would take 300 kB.
MOST_BYTES_A_FRAME = 14_000
# The smallest object, if each of 200 frames kept one, would take 4,800; the test itself keeps less
# than half of that.
MOST_BYTES_KEPT = 2000


def test_a_frame_allocates_little_and_keeps_nothing():
    motion, rig = pointing_path(), SimulatedRig()
    pointer = Pointer(as_configured(rig, motion))
    rng = np.random.default_rng(SEED)
    images = [rig.render(motion, time_s=0.0, rng=rng).images for _ in range(4)]
    peak_bytes = 0

    def feed(frames: range) -> None:
        nonlocal peak_bytes
        for k in frames:
            tracemalloc.reset_peak()
            before = tracemalloc.get_traced_memory()[0]
            pair = [Frame(k, k / FPS, image) for image in images[k % 4]]
            (status,) = [step.fix.status for step in pointer.update(pair)]
            assert k < 30 or status is Status.OK
            peak_bytes = max(peak_bytes, tracemalloc.get_traced_memory()[1] - before)

    tracemalloc.start()
    try:
        feed(range(60))
        gc.collect()
        kept = tracemalloc.get_traced_memory()[0]
        # A collection empties the interpreter's free lists; the next frame refills them.
        feed(range(60, 61))
        peak_bytes = 0
        feed(range(61, 261))
        gc.collect()
        kept = tracemalloc.get_traced_memory()[0] - kept
    finally:
        tracemalloc.stop()
    assert peak_bytes < MOST_BYTES_A_FRAME
    assert kept < MOST_BYTES_KEPT


def test_an_observation_reports_search_and_reasons():
    motion = pointing_path()
    rig = SimulatedRig()
    pointer = Pointer(as_configured(rig, motion))
    rng = np.random.default_rng(SEED)
    reported = []
    for k in range(10):
        images = rig.render(motion, time_s=0.0, rng=rng).images
        gone = np.full_like(images[1], 70)
        frames = [Frame(k, k / FPS, image) for image in (images[0], gone if k > 7 else images[1])]
        reported += [step.observations for step in pointer.update(frames)]
    tracked, lost = reported[7][1], reported[9][1]
    search, diagnostics = tracked.search, tracked.track.diagnostics
    assert search.agrees.sum() == diagnostics.inliers > 50
    assert np.isfinite(search.edges_px).all(axis=1).sum() == diagnostics.hits
    # Every edge lies on its search line, and close to the contour.
    begins, ends = search.lines_px[:, 0], search.lines_px[:, 1]
    chosen = search.agrees
    detour = np.linalg.norm(search.edges_px - begins, axis=1)
    detour += np.linalg.norm(ends - search.edges_px, axis=1)
    lengths = np.linalg.norm(ends - begins, axis=1)
    assert detour[chosen] == pytest.approx(lengths[chosen])
    away = np.linalg.norm(search.edges_px[chosen, None] - tracked.contour_px, axis=-1).min(axis=1)
    assert np.median(away) < 1.0
    decision, details = tracked.reasons
    assert decision.startswith("accepted: ")
    assert f"finger agreement {100 * diagnostics.agreement:.0f} % (min 3" in decision
    assert f"residual {diagnostics.residual_rms_px:.2f} px" in decision
    assert f"{diagnostics.inliers} agree" in details
    assert f"innovation {diagnostics.innovation:.1f}" in details
    assert f"line from {tracked.track.finger_line.source}" in details
    assert any(views[1].reasons[0].startswith("settling: ") for views in reported)
    assert not lost.search.agrees.any()
    assert lost.reasons[0].startswith("refused: ")
    assert "0 agree" in lost.reasons[1]
    unread = dataclasses.replace(lost, frame=None, track=None)
    assert unread.reasons == ("no frame of this time could be read",)
    without = dataclasses.replace(lost, track=None)
    assert without.reasons == ("refused: it lies on the table",)
    assert dataclasses.replace(without, searched=None).reasons == (
        "no hand is followed: looked for everywhere",
    )


@pytest.mark.parametrize(
    ("refusal", "decision"),
    [
        ("no-fit", "refused: no fit that could be a finger"),
        ("size", "refused: not the size of the hand that was followed"),
        ("motion", "refused: no hand moves like that"),
        ("agreement", "refused: finger agreement 31 % (min 50)"),
        ("residual", "refused: residual 2.51 px (max 2.00)"),
        ("misfit", "refused: the finger is bent"),
    ],
)
def test_a_refusal_names_value_and_limit(refusal, decision):
    diagnostics = SimpleNamespace(
        accepted=False,
        refusal=refusal,
        agreement=0.31,
        min_agreement=0.5,
        residual_rms_px=2.51,
        max_residual_px=2.0,
        innovation=None,
        bend_rad=0.6,
    )
    track = SimpleNamespace(diagnostics=diagnostics, finger_line=None)
    frame = Frame(0, 0.0, np.zeros((4, 4), np.uint8))
    observed = Observation("left", frame, track, np.empty((0, 2)), None)
    assert observed.reasons[0] == decision
    assert "bend 34°" in observed.reasons[1]


def test_a_rig_that_cannot_point_is_refused(recording):
    rig = Rig.load(recording)
    with pytest.raises(InvalidInputError, match="1 view; pointing needs two"):
        Pointer(Rig(plane=rig.plane, views=rig.views[:1]))
    with pytest.raises(InvalidInputError, match="modell"):
        Pointer(rig, tracker_options={"modell": "paper"})


def said_by_run(rig: Rig, folder: Path, *options: str) -> tuple[int, str]:
    """Exit code of `fingerpost run` and its only line on stderr."""
    rig.save(folder / "rig.toml")
    done = CliRunner().invoke(main, ["run", str(folder / "rig.toml"), *options])
    (line,) = done.stderr.splitlines()
    return done.exit_code, line


def with_view(rig: Rig, index: int, **changes: object) -> Rig:
    views = list(rig.views)
    views[index] = msgspec.structs.replace(views[index], **changes)
    return msgspec.structs.replace(rig, views=tuple(views))


def stretched(rig: Rig, factor: float) -> Rig:
    """The rig as measured in images larger by a factor."""
    for k, view in enumerate(rig.views):
        points_px = factor * np.array(view.reference_points_px)
        rig = with_view(rig, k, reference_points_px=tuple(map(tuple, points_px.tolist())))
    return rig


def test_a_rig_that_was_measured_in_larger_images_is_refused_at_the_first_frame(
    recording, tmp_path
):
    rig = Rig.load(recording)
    code, line = said_by_run(stretched(rig, 2.0), tmp_path)
    assert code == 2
    assert 'view "left": ' in line
    assert "reference points lie outside the image of 640 × 480 px" in line
    with pytest.raises(InvalidInputError, match="outside the image of 640 × 480 px"):
        next(fp.track(stretched(rig, 2.0)))


def test_a_hand_with_a_start_outside_one_view_is_searched_for(recording):
    rig = Rig.load(recording)
    start = msgspec.structs.replace(rig.views[1].start, tip_px=(700.0, 100.0))
    statuses = [fix.status for fix in fp.track(with_view(rig, 1, start=start))]
    assert Status.OK in statuses


def test_reference_points_slightly_outside_the_image_are_accepted(recording):
    rig = Rig.load(recording)
    plane_points = [*rig.plane.points[:2], (400.0, 900.0), (0.0, 900.0)]
    beyond = with_references(rig, plane_points)
    assert any(v < 0 for view in beyond.views for _, v in view.reference_points_px)
    assert len(list(fp.track(beyond, max_frames=2))) == 2


def test_a_view_that_shows_the_middle_of_the_plane_alone_is_accepted(recording, caplog):
    rig = Rig.load(recording)
    beyond = with_references(
        rig, [(-900.0, -300.0), (1300.0, -300.0), (1300.0, 900.0), (0.0, 900.0)]
    )
    inside = [
        sum(0 <= u < 640 and 0 <= v < 480 for u, v in view.reference_points_px)
        for view in beyond.views
    ]
    assert max(inside) < 2
    assert len(list(fp.track(beyond, max_frames=2))) == 2
    assert "reference points lie outside the image" in caplog.text


def test_different_winding_in_two_views_is_refused_and_equal_winding_is_not(recording, tmp_path):
    rig = Rig.load(recording)

    def wound_back(rig: Rig, index: int) -> Rig:
        points_px = rig.views[index].reference_points_px
        return with_view(rig, index, reference_points_px=points_px[:1] + points_px[:0:-1])

    code, line = said_by_run(wound_back(rig, 1), tmp_path)
    assert code == 2
    assert "the views see the plane from different sides" in line
    assert "in the order of plane.points" in line
    # The plane's handedness is reversed in every view.
    mirrored = wound_back(wound_back(rig, 0), 1)
    assert len(Pointer(mirrored).views) == 2


def test_views_of_one_source_are_refused(recording, tmp_path):
    rig = Rig.load(recording)
    code, line = said_by_run(with_view(rig, 1, source=rig.views[0].source), tmp_path)
    assert code == 2
    assert 'views "left" and "right" both read' in line


def test_an_image_of_another_size_ends_the_run_and_keeps_earlier_rows(recording, tmp_path):
    rig = Rig.load(recording)
    for k, view in enumerate(rig.views):
        (tmp_path / view.name).mkdir()
        with open_source(view.source) as source:
            for frame in islice(source, 6):
                image = frame.image
                if (k, frame.index) == (1, 4):
                    image = np.ascontiguousarray(image[::2, ::2])
                cv2.imwrite(str(tmp_path / view.name / f"{frame.index}.png"), image)
        rig = with_view(rig, k, source=str(tmp_path / view.name / "*.png"))
    points = tmp_path / "points.csv"
    code, line = said_by_run(rig, tmp_path, "--points", str(points))
    assert code == 1
    assert line == (
        f"fingerpost: {tmp_path / 'right' / '4.png'}: 320 x 240 pixels, the first frame has "
        "640 x 480; all frames of a view must have one size"
    )
    assert [row.split(",")[0] for row in points.read_text().splitlines()[1:]] == [
        "0",
        "1",
        "2",
        "3",
    ]


def test_frames_that_change_their_size_are_refused_without_files():
    motion, rig = pointing_path(), SimulatedRig()
    pointer = Pointer(as_configured(rig, motion))
    images = rig.render(motion, time_s=0.0, rng=SEED).images
    list(pointer.update([Frame(0, 0.0, image) for image in images]))
    small = np.ascontiguousarray(images[1][:240])
    with pytest.raises(InvalidInputError) as raised:
        list(pointer.update([Frame(1, 0.1, images[0]), Frame(1, 0.1, small)]))
    assert str(raised.value) == (
        'view "right": frame 1 has 640 × 240 px, the first one has 640 × 480; '
        "all must have one size"
    )


def test_colour_images_are_tracked():
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
