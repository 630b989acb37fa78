"""Images pushed into a pointer by a program, and rigs built without a file."""

import importlib.metadata
from collections.abc import Iterator
from importlib.resources import files

import cv2
import numpy as np
import pytest

import fingerpost as fp
from fingerpost.config import LensParameters, Start
from fingerpost.errors import InvalidInputError
from fingerpost.pointing import PlaneView
from fingerpost.simulate import (
    DevicePose,
    Placement,
    SimulatedRig,
    Trajectory,
    write_recording,
)
from fingerpost.simulated_rig_file import rig_from_simulation

FPS = 30.0
FRAMES = 14
SEED = 7
# As in tests/test_pipeline.py, with noise and a tapered rod.
ACCURACY_MM = 3.0
SKEW_S = 0.5 / FPS


@pytest.fixture(scope="module")
def desk() -> tuple[fp.Rig, list[tuple[fp.Frame, ...]]]:
    """The rig of the built-in clip, and its first frames in colour."""
    rig = fp.Rig.load(files("fingerpost") / "data/desk/rig.toml")
    return rig, [frames for _, frames in fp.track(rig, frames=True, max_frames=16)]


def path() -> Trajectory:
    """A rod that rests, then moves above the middle of the plane at 0.2 m/s."""
    first, last = (
        DevicePose.pointing_at(target, azimuth_deg=25.0, slant_deg=50.0, hover_mm=120.0)
        for target in ((160.0, 180.0), (230.0, 220.0))
    )
    return Trajectory.hold(first, 0.2).then(Trajectory.through([first, last], 0.2))


def rig_of(simulated: SimulatedRig) -> fp.Rig:
    """The rig as a program builds it that knows the hand's start pose."""
    truth = simulated.truth(path(), time_s=0.0)
    starts = [view.finger.start() for view in truth.views]
    return rig_from_simulation(simulated, starts=starts)


@pytest.fixture(scope="module")
def simulated() -> SimulatedRig:
    return SimulatedRig(Placement(time_skews_s=(0.0, SKEW_S)))


@pytest.fixture(scope="module")
def shots(simulated: SimulatedRig) -> list[tuple[np.ndarray, ...]]:
    """Images of both cameras, frame by frame; the second is half a frame late."""
    rng = np.random.default_rng(SEED)
    return [simulated.render(path(), time_s=k / FPS, rng=rng).images for k in range(FRAMES)]


def pushed_in_turn(pointer: fp.Pointer, shots: list[tuple[np.ndarray, ...]]) -> Iterator[fp.Fix]:
    """Push one view's image at a time, at its time; the last fixes come from `finish`."""
    names = [view.name for view in pointer.views]
    for k, images in enumerate(shots):
        for name, image, skew_s in zip(names, images, (0.0, SKEW_S), strict=True):
            yield from pointer.push({name: image}, time_s=k / FPS + skew_s)
    for step in pointer.finish():
        yield step.fix


def bits(fixes: list[fp.Fix]) -> list[object]:
    return [
        (fix.time_s, fix.status, None if fix.point is None else fix.point.tobytes())
        for fix in fixes
    ]


def rms_mm(simulated: SimulatedRig, fixes: list[fp.Fix]) -> float:
    errors = [
        fix.point - simulated.truth(path(), time_s=fix.time_s).indicated_mm
        for fix in fixes
        if fix.point is not None
    ]
    assert len(errors) >= FRAMES - 6
    return float(np.sqrt(np.mean(np.sum(np.square(errors), axis=1))))


def test_images_pushed_together_give_the_fixes_of_frames(simulated, shots):
    pushed, updated = fp.Pointer(rig_of(simulated)), fp.Pointer(rig_of(simulated))
    by_push, by_update = [], []
    for k, images in enumerate(shots):
        by_push += pushed.push(list(images), time_s=k / FPS)
        frames = [fp.Frame(k, k / FPS, image) for image in images]
        by_update += [step.fix for step in updated.update(frames)]
    assert len(by_push) == FRAMES
    assert bits(by_push) == bits(by_update)
    assert by_push[-1].status is fp.Status.OK


def test_images_pushed_in_turn_are_interpolated_to_one_time(simulated, shots):
    fixes = list(pushed_in_turn(fp.Pointer(rig_of(simulated)), shots))
    assert [fix.time_s for fix in fixes] == [k / FPS for k in range(FRAMES)]
    # The second view has no frame as early as the first view's first one.
    assert fixes[0].status is fp.Status.ACQUIRING
    assert fixes[-1].status is fp.Status.OK
    assert rms_mm(simulated, fixes) < ACCURACY_MM


def test_views_pushed_in_turn_find_a_hand_without_a_start_pose(desk):
    rig, film = desk
    views = [replaced(view, start=None) for view in rig.views]
    pointer, fixes = fp.Pointer(fp.Rig(plane=rig.plane, views=views)), []
    for frames in film:
        for view, frame in zip(rig.views, frames, strict=True):
            fixes += pointer.push({view.name: frame.image}, time_s=frame.time_s)
    assert fixes[-1].status is fp.Status.OK


def test_a_push_tracks_whether_or_not_its_fixes_are_read(simulated, shots):
    read, ignored = fp.Pointer(rig_of(simulated)), fp.Pointer(rig_of(simulated))
    for k, images in enumerate(shots[:-1]):
        list(read.push(images, time_s=k / FPS))
        ignored.push(images, time_s=k / FPS)
    last = [p.push(shots[-1], time_s=FRAMES / FPS) for p in (read, ignored)]
    assert all(isinstance(fixes, list) for fixes in last)
    assert bits(last[0]) == bits(last[1])
    assert last[1][0].status is fp.Status.OK


def test_colour_images_with_equal_channels_give_the_fixes_of_grey_ones(simulated, shots):
    grey, coloured = fp.Pointer(rig_of(simulated)), fp.Pointer(rig_of(simulated))
    for k, images in enumerate(shots):
        expected = grey.push(images, time_s=k / FPS)
        # A driver of a monochrome camera may return three equal channels.
        same = coloured.push([cv2.cvtColor(i, cv2.COLOR_GRAY2BGR) for i in images], time_s=k / FPS)
    assert bits(expected) == bits(same)


def test_a_pushed_image_may_be_overwritten_by_its_owner(simulated, shots):
    kept, reused = fp.Pointer(rig_of(simulated)), fp.Pointer(rig_of(simulated))
    names, fixes = [view.name for view in simulated.cameras], ([], [])
    buffer = np.empty_like(shots[0][0])
    for k, images in enumerate(shots):
        for name, image in zip(names, images, strict=True):
            fixes[0].extend(kept.push({name: image}, time_s=k / FPS))
            buffer[:] = image
            fixes[1].extend(reused.push({name: buffer}, time_s=k / FPS))
            buffer[:] = 0
    assert bits(fixes[0]) == bits(fixes[1])


def test_a_view_waits_for_another_for_at_most_the_limit(simulated, shots):
    pointer = fp.Pointer(rig_of(simulated))
    names = [view.name for view in pointer.views]
    for k, images in enumerate(shots):
        pointer.push(images, time_s=k / FPS)
    later = [FRAMES / FPS, (FRAMES + 1) / FPS, (FRAMES + 9) / FPS]
    pushed = [pointer.push({names[0]: shots[-1][0]}, time_s=time_s) for time_s in later]
    assert [len(fixes) for fixes in pushed] == [0, 0, 0]
    overdue = pointer.push({names[0]: shots[-1][0]}, time_s=later[-1] + 1 / FPS)
    assert [fix.status for fix in overdue] == [fp.Status.LOST] * 2
    assert "at most 0.1 s are waited for" in overdue[0].reason


def test_offsets_are_added_to_the_times_that_are_pushed(simulated, shots):
    rig = rig_of(simulated)
    left, right = rig.views
    late = fp.Rig(plane=rig.plane, views=[left, replaced(right, offset_s=SKEW_S)])
    pointer, fixes = fp.Pointer(late), []
    for k, images in enumerate(shots):
        fixes += pointer.push(images, time_s=k / FPS)
    assert rms_mm(simulated, fixes) < ACCURACY_MM


def replaced(view: fp.View, **changes: object) -> fp.View:
    known = {name: getattr(view, name) for name in view.__struct_fields__}
    return fp.View(**{**known, **changes})


GREY = np.zeros((480, 640), np.uint8)


@pytest.mark.parametrize(
    ("images", "time_s", "words"),
    [
        ({"middle": GREY}, 0.0, "'middle' is no view of the rig; its views are left, right"),
        ([GREY], 0.0, "images: 1 found; a mapping from view to image, or a list of one for each"),
        (GREY, 0.0, "images: ndarray found"),
        ({"right": GREY.astype(float)}, 0.0, 'view "right": the image of frame 0 has the shape'),
        ({"right": "right.png"}, 0.0, 'view "right": the image of frame 0 is a str'),
        ({"right": GREY}, "now", "view \"right\": time_s of frame 0 is 'now'"),
        ({"right": GREY}, np.nan, 'view "right": time_s of frame 0 is nan'),
    ],
)
def test_invalid_images_are_refused_by_push_itself(simulated, images, time_s, words):
    pointer = fp.Pointer(rig_of(simulated))
    with pytest.raises(InvalidInputError) as raised:
        pointer.push(images, time_s=time_s)
    assert words in str(raised.value)
    assert pointer.push([GREY + 70, GREY + 71], time_s=0.0)[0].status is fp.Status.ACQUIRING


def test_track_returns_frames_with_their_fixes(tmp_path, simulated):
    rig_file = write_recording(tmp_path, simulated, path(), frames=4, fps=FPS, rng=SEED)
    rig = fp.Rig.load(rig_file)
    seen = list(fp.track(rig, frames=True))
    assert bits([fix for fix, _ in seen]) == bits(list(fp.track(rig)))
    for k, (_, frames) in enumerate(seen):
        for view, frame in zip(rig.views, frames, strict=True):
            assert frame.index == k
            shown = cv2.imread(str(tmp_path / view.name / f"{k:05d}.png"), cv2.IMREAD_UNCHANGED)
            np.testing.assert_array_equal(frame.image, shown)


# --- rigs without a file ----------------------------------------------------------------------

T = np.array([[0.9, 0.2, 120.0], [-0.1, 0.7, 110.0], [1e-4, -2e-4, 1.0]])
SQUARE = [[0, 0], [400, 0], [400, 400], [0, 400]]


def test_a_rig_built_from_lists_and_arrays_loads_as_it_was_saved(tmp_path):
    plane = fp.Plane(unit="mm", points=np.array(SQUARE))
    left = fp.View(name="left", reference_points_px=[[10, 20], [300, 25], [290, 310], [12, 300]])
    right = fp.View.from_homography("right", T, plane)
    rig = fp.Rig(plane=plane, views=[left, right])
    rig.save(tmp_path / "rig.toml")
    assert fp.Rig.load(tmp_path / "rig.toml") == rig
    assert left.reference_points_px[3] == (12.0, 300.0)


def seen_by(view: fp.View, plane: fp.Plane) -> PlaneView:
    return PlaneView.from_reference_points(
        plane.points, view.reference_points_px, view.reference_covariances(0.5), view.lens
    )


@pytest.mark.parametrize("scale", [1.0, -3.0, 1e-6])
@pytest.mark.parametrize("lens", [None, LensParameters(fx=600, fy=600, cx=320, cy=240, k1=-0.2)])
def test_a_given_homography_is_reproduced(scale, lens):
    plane = fp.Plane(unit="mm", points=[*SQUARE, [200, 100]])
    view = fp.View.from_homography("own", scale * T, plane, lens_parameters=lens)
    found = seen_by(view, plane).image_from_plane
    np.testing.assert_allclose(found / found[2, 2], T, rtol=1e-7)


@pytest.mark.parametrize(
    ("matrix", "words"),
    [
        (np.eye(2), "image_from_plane: shape (2, 2) found; (3, 3) is needed"),
        (np.full((3, 3), np.nan), "image_from_plane[0, 0] is nan"),
        ([[1, 0, 0], [0, 1, 0], [0, -0.004, 1]], "plane.points[2] on the horizon or beyond"),
    ],
)
def test_invalid_homographies_are_refused(matrix, words):
    with pytest.raises(InvalidInputError) as raised:
        fp.View.from_homography("own", matrix, fp.Plane(unit="mm", points=SQUARE))
    assert words in str(raised.value)


def test_a_singular_homography_is_refused_by_the_rig():
    plane = fp.Plane(unit="mm", points=SQUARE)
    flat = fp.View.from_homography("flat", [[1, 0, 0], [0, 0, 50], [0, 0, 1]], plane)
    with pytest.raises(InvalidInputError, match='view "flat"'):
        fp.Rig(plane=plane, views=[flat])


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: fp.View(name=3, reference_points_px=SQUARE), "name is 3; needed: a short name"),
        (lambda: fp.View(name="a", reference_points_px=3), "reference_points_px is 3; needed: one"),
        (lambda: fp.Plane(unit="mm", points=[[0, "a"]]), "needed: at least 4 points"),
        (lambda: fp.Rig(plane=3, views=[]), "plane is 3; needed: one [plane] table"),
        (lambda: Start(tip_px=1, angle_deg=0, length_px=9, thumb="left"), "tip_px is 1; needed"),
    ],
)
def test_values_of_another_type_are_refused_by_name(make, words):
    with pytest.raises(InvalidInputError) as raised:
        make()
    assert words in str(raised.value)
    assert str(raised.value).isprintable()


def test_tracking_a_rig_without_sources_is_refused():
    plane = fp.Plane(unit="mm", points=SQUARE)
    views = [fp.View.from_homography(name, T, plane) for name in ("left", "right")]
    with pytest.raises(InvalidInputError, match='view "left" has no source; needed: a file'):
        next(fp.track(fp.Rig(plane=plane, views=views)))


# --- one view ---------------------------------------------------------------------------------


def waiting_tracker(rig: fp.Rig) -> fp.ContourTracker:
    start = rig.views[0].start
    pose = fp.StartPose(start.tip_px, np.radians(start.angle_deg), start.length_px)
    return fp.ContourTracker(fp.Template.pistol(start.thumb), pose)


def test_a_colour_image_alone_is_tracked_as_with_its_grey_levels(desk):
    rig, film = desk
    alone, both = waiting_tracker(rig), waiting_tracker(rig)
    for frame, _ in film:
        a = alone.update(frame.image, frame.time_s)
        grey = cv2.cvtColor(frame.image, cv2.COLOR_BGR2GRAY)
        b = both.update(grey, frame.time_s, frame.image)
        assert a.status == b.status
    assert a.finger_line is not None
    np.testing.assert_array_equal(a.shape_vector, b.shape_vector)
    np.testing.assert_array_equal(a.finger_line.covariance, b.finger_line.covariance)


def test_a_grey_image_of_three_channels_is_tracked_as_a_grey_one(simulated, shots):
    one, three = (waiting_tracker(rig_of(simulated)) for _ in range(2))
    for k, (image, _) in enumerate(shots):
        a = one.update(image, k / FPS)
        b = three.update(np.stack([image] * 3, axis=2), k / FPS)
    assert a.finger_line is not None
    np.testing.assert_array_equal(a.shape_vector, b.shape_vector)


def test_the_version_is_the_package_s():
    assert fp.__version__ == importlib.metadata.version("fingerpost")
