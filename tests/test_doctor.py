"""The doctor: every fault put into a recording is found, and a clean one has no findings."""

import json
import math
import threading
from itertools import islice
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
from click.testing import CliRunner
from patience import PATIENCE_S

import fingerpost
from fingerpost.capture import Frame, open_source, open_views
from fingerpost.capture.live import LiveSource
from fingerpost.cli import main
from fingerpost.config import FixedReference, LensParameters, Plane, Rig
from fingerpost.doctor import Check, Severity, examine, look
from fingerpost.doctor.hand import read_hand
from fingerpost.doctor.pictures import read_pictures, region_between
from fingerpost.errors import InvalidInputError
from fingerpost.simulate import (
    Background,
    DevicePose,
    Hand,
    LightChange,
    Lighting,
    Placement,
    RodAndProng,
    Sensor,
    SimulatedRig,
    Trajectory,
    Workspace,
    write_recording,
)
from fingerpost.simulated_rig_file import rig_from_simulation

CLIP = Path(fingerpost.__file__).parent / "data" / "desk" / "rig.toml"
SEED = 1994
FRAMES = 6
TABLE = Background(clutter=20.0, seed=3, sheet=-40.0, level=110.0)
LIGHT = Lighting(contrast=100.0)
POSE = DevicePose.pointing_at((180.0, 190.0), hover_mm=90.0, slant_deg=50.0, azimuth_deg=20.0)


def recording(
    *,
    placement=None,
    workspace=None,
    background=TABLE,
    lighting=LIGHT,
    sensor=None,
    motion=POSE,
    fps=(30.0, 30.0),
    late_s=0.0,
    start_pose=POSE,
    frame_count=FRAMES,
):
    """Return a rig as a user would write it, and frames of its views."""
    simulated = SimulatedRig(
        placement, workspace=workspace, background=background, lighting=lighting, sensor=sensor
    )
    rng = np.random.default_rng(SEED)
    rod = RodAndProng()
    truth = simulated.truth(start_pose, device=rod)
    frames = [[] for _ in simulated.cameras]
    for k in range(frame_count):
        pictured = simulated.render(motion, rng=rng, device=rod)
        for i, image in enumerate(pictured.images):
            frames[i].append(Frame(k, k / fps[i] + i * late_s, image))
    starts = [view.finger.start() for view in truth.views]
    sources = [f"{camera.name}.mp4" for camera in simulated.cameras]
    return rig_from_simulation(simulated, starts=starts, sources=sources), frames


def with_view(rig, index, **changes):
    views = list(rig.views)
    views[index] = msgspec.structs.replace(views[index], **changes)
    return msgspec.structs.replace(rig, views=tuple(views))


def found(diagnosis):
    return {(finding.severity, finding.check, finding.view) for finding in diagnosis.findings}


@pytest.fixture(scope="module")
def clean():
    return recording()


# --- clean recordings ------------------------------------------------------------------------


def test_a_clean_recording_has_no_findings(clean):
    rig, frames = clean
    diagnosis = examine(rig, frames)
    assert diagnosis.findings == ()
    assert not diagnosis.serious
    assert diagnosis.table()[-1] == "nothing is wrong"


def test_the_measurements_agree_with_the_rendering(clean):
    rig, frames = clean
    for reading in examine(rig, frames).readings:
        assert reading.size_px == (640, 480)
        assert reading.frames_per_s == pytest.approx(30.0)
        assert reading.noise == pytest.approx(2.0, rel=0.05)
        assert reading.blur_px == pytest.approx(1.1, abs=0.2)
        assert reading.hand_found
        # The rod is 100 levels above the table and 140 above the sheet; edges are on both.
        assert 95.0 < reading.contrast < 145.0
        assert reading.finger_px > 40.0


@pytest.mark.parametrize(
    ("sensor", "placement"),
    [
        (Sensor(channels="bgr"), None),
        (Sensor(noise=0.0), None),
        (Sensor(blur_px=0.5, noise=4.0), Placement.webcams()),
    ],
    ids=["colour", "without noise", "webcams"],
)
def test_other_clean_recordings_have_no_findings(sensor, placement):
    assert examine(*recording(sensor=sensor, placement=placement)).findings == ()


def test_the_built_in_clip_is_clean():
    rig_file = Path(__file__).parents[1] / "python" / "fingerpost" / "data" / "desk" / "rig.toml"
    done = CliRunner().invoke(main, ["doctor", str(rig_file), "--frames", "90"])
    assert done.exit_code == 0, done.output
    assert "nothing is wrong" in done.stdout


# --- pictures --------------------------------------------------------------------------------


@pytest.mark.parametrize("noise", [0.5, 1.0, 2.0, 6.0, 15.0])
@pytest.mark.parametrize("frames", [1, 3])
def test_noise_is_measured_in_one_frame_or_several(noise, frames):
    rng = np.random.default_rng(SEED)
    pictures = [
        np.clip(np.round(120 + rng.normal(0, noise, (200, 200))), 0, 255).astype(np.uint8)
        for _ in range(frames)
    ]
    measured = read_pictures(pictures, np.ones((200, 200), dtype=bool)).noise
    # Rounding to whole levels adds 1/12 to the variance, and quantises low noise coarsely.
    assert measured == pytest.approx(math.hypot(noise, 12**-0.5), rel=0.15 if noise < 1 else 0.08)


@pytest.mark.parametrize("blur_px", [0.7, 1.5, 3.0])
def test_blur_is_measured_at_the_edges(blur_px):
    picture = np.full((240, 240), 60.0)
    cv2.fillPoly(picture, [np.array([(40, 50), (200, 80), (170, 200), (60, 180)])], 180.0)
    picture = cv2.GaussianBlur(picture, (0, 0), blur_px)
    rng = np.random.default_rng(SEED)
    pictures = [
        np.round(picture + rng.normal(0, 2, picture.shape)).astype(np.uint8) for _ in range(3)
    ]
    measured = read_pictures(pictures, np.ones(picture.shape, dtype=bool)).blur_px
    assert measured == pytest.approx(blur_px, abs=0.3)


def test_a_picture_without_edges_has_no_blur():
    plain = [np.full((100, 100), 90, np.uint8)]
    assert read_pictures(plain, np.ones((100, 100), dtype=bool)).blur_px is None


def test_the_region_is_the_part_of_the_image_between_the_points():
    region = region_between(np.array([[10.0, 10], [90, 10], [90, 1e9], [10, 90]]), (80, 100))
    assert region[40, 50]
    assert not region[40, 5]
    assert region_between(np.full((4, 2), 1e9), (80, 100)).all()


@pytest.mark.parametrize(
    ("changes", "severity", "check"),
    [
        ({"lighting": Lighting(contrast=100.0, change=LightChange(-1.0, 0.25))},
         Severity.WARNING, Check.EXPOSURE),
        ({"lighting": Lighting(contrast=100.0, change=LightChange(-1.0, 0.05))},
         Severity.ERROR, Check.EXPOSURE),
        ({"lighting": Lighting(contrast=100.0, change=LightChange(-1.0, 4.0))},
         Severity.ERROR, Check.EXPOSURE),
        ({"sensor": Sensor(noise=14.0)}, Severity.WARNING, Check.NOISE),
        ({"sensor": Sensor(blur_px=3.5)}, Severity.WARNING, Check.FOCUS),
        ({"background": Background(level=80.0), "lighting": Lighting(contrast=14.0)},
         Severity.WARNING, Check.CONTRAST),
        ({"background": Background(level=80.0), "lighting": Lighting(contrast=6.0)},
         Severity.ERROR, Check.CONTRAST),
        ({"motion": None}, Severity.ERROR, Check.HAND),
        ({"placement": Placement(workspace_fill=0.2)}, Severity.WARNING, Check.HAND),
    ],
    ids=["dim", "dark", "clipped", "noisy", "blurred", "faint", "too faint", "no hand", "small"],
)  # fmt: skip
def test_picture_faults_are_found_in_every_view(changes, severity, check):
    diagnosis = examine(*recording(**changes))
    for view in ("left", "right"):
        assert (severity, check, view) in found(diagnosis)
    if severity is Severity.ERROR:
        assert diagnosis.serious


def test_a_defocused_recording_has_no_other_findings():
    diagnosis = examine(*recording(sensor=Sensor(blur_px=3.5)))
    assert {finding.check for finding in diagnosis.findings} == {Check.FOCUS}
    assert not diagnosis.serious


# --- hand and start --------------------------------------------------------------------------


def test_a_start_outside_the_image_is_found(clean):
    rig, frames = clean
    start = msgspec.structs.replace(rig.views[1].start, tip_px=(700.0, 100.0))
    diagnosis = examine(with_view(rig, 1, start=start), frames)
    what = [finding.what for finding in diagnosis.findings if finding.view == "right"]
    assert any("start.tip_px (700, 100) is outside the image of 640 × 480 px" in w for w in what)


def test_few_frames_without_a_start_are_not_judged(clean):
    rig, frames = clean
    diagnosis = examine(with_view(with_view(rig, 0, start=None), 1, start=None), frames)
    assert diagnosis.findings == ()
    assert diagnosis.readings[0].hand_found is None


def test_a_hand_is_found_without_a_start():
    rig = Rig.load(CLIP)
    rig = with_view(with_view(rig, 0, start=None), 1, start=None)
    with open_views(rig.sources, rig.readings) as sources:
        frames = [list(islice(source, 40)) for source in sources]
    diagnosis = examine(rig, frames)
    assert diagnosis.findings == ()
    assert [reading.hand_found for reading in diagnosis.readings] == [True, True]


def test_many_frames_without_a_hand_are_reported_for_every_view():
    rig, frames = recording(motion=None, frame_count=30)
    rig = with_view(with_view(rig, 0, start=None), 1, start=None)
    diagnosis = examine(rig, frames)
    assert [reading.hand_found for reading in diagnosis.readings] == [False, False]
    assert found(diagnosis) == {(Severity.WARNING, Check.HAND, name) for name in ("left", "right")}
    assert all("no hand is found in 30 frames" in f.what for f in diagnosis.findings)


# --- reference points ------------------------------------------------------------------------


def test_a_hand_that_comes_to_its_start_is_found_there():
    """The tracker follows it before it has arrived."""
    background = Background(texture="wood", clutter=20.0, seed=3)
    rig = SimulatedRig(device=Hand(), background=background)
    pose = DevicePose.pointing_at((200.0, 200.0), azimuth_deg=20.0, slant_deg=50.0, hover_mm=100.0)
    comes = Trajectory.through([pose.retreated(300.0), pose], 0.3)
    motion, rng = comes.then(Trajectory.hold(pose, 1.0)), np.random.default_rng(3)
    taken = [rig.render(motion, time_s=k / 30.0, rng=rng).images for k in range(42)]
    for view, seen in enumerate(rig.truth(pose, time_s=0.0).views):
        start = seen.finger.start()
        frames = [Frame(k, k / 30.0, images[view]) for k, images in enumerate(taken)]
        assert read_hand(frames, start).found


def reordered(rig, index, order):
    points = [rig.views[index].reference_points_px[k] for k in order]
    return with_view(rig, index, reference_points_px=tuple(points))


def test_mirrored_points_are_found(clean):
    rig, frames = clean
    diagnosis = examine(reordered(rig, 1, (0, 3, 2, 1)), frames)
    (finding,) = [f for f in diagnosis.findings if f.check is Check.REFERENCES]
    assert finding.severity is Severity.ERROR
    assert 'points are to be taken in the order [0, 3, 2, 1] in view "right"' in finding.what
    assert finding.right.endswith("would be right")


@pytest.mark.parametrize("shift", [1, 2, 3])
def test_points_in_cyclically_shifted_order_are_found_and_reordered(clean, shift):
    rig, frames = clean
    order = tuple((k - shift) % 4 for k in range(4))
    diagnosis = examine(reordered(rig, 1, order), frames)
    (finding,) = [f for f in diagnosis.findings if f.check is Check.REFERENCES]
    assert (finding.severity, finding.view) == (Severity.ERROR, "right")
    right = [(k + shift) % 4 for k in range(4)]
    assert f"in the order {right}" in finding.what


def test_two_neighbours_swapped_are_refused_by_the_rig_file(clean, tmp_path):
    rig, _ = clean
    text = msgspec.structs.replace(rig).dumps()
    first, second = (json.dumps(list(p)) for p in rig.views[0].reference_points_px[:2])
    text = text.replace(first, "?").replace(second, first).replace("?", second)
    (tmp_path / "rig.toml").write_text(text, encoding="utf-8")
    done = CliRunner().invoke(main, ["doctor", str(tmp_path / "rig.toml")])
    assert done.exit_code == 2
    assert "order of the plane points" in done.output


def test_a_displaced_reference_point_is_found(clean):
    rig, frames = clean
    points = np.array(rig.views[0].reference_points_px)
    exact = points[1].copy()
    points[1] += (-4.0, 2.5)
    diagnosis = examine(with_view(rig, 0, reference_points_px=tuple(map(tuple, points))), frames)
    (finding,) = diagnosis.findings
    assert (finding.severity, finding.check, finding.view) == (
        Severity.WARNING,
        Check.REFERENCES,
        "left",
    )
    assert finding.what.startswith("reference_points_px[1] is 4.")
    corner = [float(x) for x in finding.what.partition("at (")[2].rstrip(")").split(",")]
    assert corner == pytest.approx(exact, abs=0.5)


def test_points_nearly_on_a_line_are_found(clean):
    rig, frames = clean
    plane = ((0.0, 0.0), (400.0, 0.0), (400.0, 12.0), (190.0, 11.0))
    simulated = SimulatedRig()
    views = [
        msgspec.structs.replace(
            view,
            reference_points_px=tuple(
                map(tuple, camera.project(np.pad(np.array(plane), ((0, 0), (0, 1)))).tolist())
            ),
        )
        for view, camera in zip(rig.views, simulated.cameras, strict=True)
    ]
    weak = Rig(plane=Plane(unit="mm", points=plane), views=tuple(views))
    assert any("nearly on a line" in f.what for f in examine(weak, frames).findings)


def test_one_displaced_point_of_many_is_found():
    rig, frames = recording(workspace=Workspace(points_per_side=3))
    assert examine(rig, frames).findings == ()
    points = np.array(rig.views[1].reference_points_px)
    points[6] += (9.0, -6.0)
    diagnosis = examine(with_view(rig, 1, reference_points_px=tuple(map(tuple, points))), frames)
    assert any(
        f.what.startswith("reference_points_px[6] is") and f.view == "right"
        for f in diagnosis.findings
    )


def test_points_of_another_resolution_are_found(clean):
    rig, frames = clean
    points = 3.0 * np.array(rig.views[0].reference_points_px)
    diagnosis = examine(with_view(rig, 0, reference_points_px=tuple(map(tuple, points))), frames)
    assert any("of another size?" in f.right and f.view == "left" for f in diagnosis.findings)


def test_a_lens_of_another_resolution_is_found(clean):
    rig, frames = clean
    for factor, wrong in ((1.0, False), (2.0, True)):
        lens = LensParameters(
            fx=factor * 1690, fy=factor * 1690, cx=factor * 319.5, cy=factor * 239.5, k1=-0.01
        )
        diagnosis = examine(with_view(rig, 0, lens_parameters=lens), frames)
        assert ((Severity.WARNING, Check.LENS, "left") in found(diagnosis)) is wrong


# --- times -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "severity", "view", "words"),
    [
        ({"fps": (30.0, 24.0)}, Severity.WARNING, "", "left 30.0, right 24.0"),
        ({"fps": (9.0, 9.0)}, Severity.WARNING, "left", "9.0 frames a second"),
        ({"late_s": 3.0}, Severity.ERROR, "right", "s off those of left"),
        (
            {"fps": (8.0, 8.0), "late_s": 0.02},
            Severity.ERROR,
            "right",
            "0.02 s off those of left, and 0.125 s apart",
        ),
    ],
)
def test_clock_faults_are_found(changes, severity, view, words):
    diagnosis = examine(*recording(**changes))
    assert any(
        (f.severity, f.check, f.view) == (severity, Check.TIMING, view) and words in f.what
        for f in diagnosis.findings
    )


def test_lost_frames_and_a_stopped_clock_are_found(clean):
    rig, frames = clean
    pause = [Frame(f.index, f.time_s + 0.2 * (f.index > 3), f.image) for f in frames[0]]
    diagnosis = examine(rig, [pause, frames[1]])
    assert any("after frame 3" in f.what for f in diagnosis.findings)
    stands = [Frame(f.index, min(f.time_s, 0.1), f.image) for f in frames[0]]
    diagnosis = examine(rig, [stands, frames[1]])
    assert (Severity.ERROR, Check.TIMING, "left") in found(diagnosis)


class CamerasInStep:
    """Cameras that each take a frame per tick, 1/30 s apart; the test advances the ticks."""

    def __init__(self):
        self.ticks, self.ticked = 1, threading.Condition()
        self.cameras = []

    def tick(self):
        with self.ticked:
            # A busy machine may be late with a frame, but loses none.
            self.ticked.wait_for(lambda: all(c.taken == self.ticks for c in self.cameras), 5.0)
            self.ticks += 1
            self.ticked.notify_all()


class CameraInStep:
    def __init__(self, cameras, frames):
        self._cameras, self._frames, self.taken = cameras, frames, 0
        cameras.cameras.append(self)

    def isOpened(self):  # noqa: N802 - OpenCV's name
        return True

    def grab(self):
        with self._cameras.ticked:
            waits = self._cameras.ticked.wait_for(
                lambda: self._cameras.ticks > self.taken, timeout=0.01
            )
            self.taken = self._cameras.ticks
            self._cameras.ticked.notify_all()
            return waits

    def retrieve(self):
        return True, self._frames[self.taken % len(self._frames)].image

    def release(self):
        pass

    def time_ns(self):
        return round(self.taken * 1e9 / 30)


class LastView(LiveSource):
    """The view that is read last; after it, the cameras take their next frames."""

    def __init__(self, *, cameras, **live):
        self._cameras = cameras
        super().__init__("last", **live)

    def _next_frame(self):
        frame = super()._next_frame()
        self._cameras.tick()
        return frame


def test_live_views_read_together_have_no_timing_findings(clean):
    rig, frames = clean
    cameras = CamerasInStep()
    devices = [CameraInStep(cameras, own) for own in frames]
    options = [
        {
            "timeout_s": PATIENCE_S,
            "clock": device.time_ns,
            "connect": lambda *_, device=device: device,
        }
        for device in devices
    ]
    first, last = LiveSource("first", **options[0]), LastView(cameras=cameras, **options[1])
    with first, last:
        steps = list(look([first, last], 12))
    assert len(steps) == 12
    # On a busy machine a view may miss a step, which delays no other.
    seen = [[one for one in own if isinstance(one, Frame)] for own in zip(*steps, strict=True)]
    diagnosis = examine(rig, seen)
    assert [f for f in diagnosis.findings if f.check is Check.TIMING] == []
    assert [reading.frames_per_s for reading in diagnosis.readings] == pytest.approx([30.0, 30.0])


def test_the_rate_of_a_live_view_includes_skipped_frames(clean):
    rig, frames = clean
    # Read together with a view of half the rate.
    skipped = [Frame(2 * k, k / 15, frame.image) for k, frame in enumerate(frames[0])]
    slower = [Frame(k, k / 15, frame.image) for k, frame in enumerate(frames[1])]
    diagnosis = examine(rig, [skipped, slower])
    assert any("left 30.0, right 15.0" in finding.what for finding in diagnosis.findings)


def test_each_recording_is_read_from_its_start(tmp_path):
    for name, count in (("a", 2), ("b", 5)):
        (tmp_path / name).mkdir()
        for k in range(count):
            cv2.imwrite(str(tmp_path / name / f"{k}.png"), np.zeros((4, 4), np.uint8))
    sources = [open_source(str(tmp_path / name / "*.png")) for name in "ab"]
    indices = [[frame and frame.index for frame in step] for step in look(sources, 4)]
    assert indices == [[0, 0], [1, 1], [None, 2], [None, 3]]


# --- the boundary ----------------------------------------------------------------------------


def test_frames_that_do_not_belong_to_the_rig_are_refused(clean):
    rig, frames = clean
    with pytest.raises(InvalidInputError, match="frames of 1 views for a rig of 2"):
        examine(rig, frames[:1])
    with pytest.raises(InvalidInputError, match='view "right": no frame'):
        examine(rig, [frames[0], []])


def test_one_view_and_one_frame_are_enough(clean):
    rig, frames = clean
    alone = msgspec.structs.replace(rig, views=rig.views[:1])
    reading = examine(alone, [frames[0][:1]]).readings[0]
    assert reading.frames_per_s is None
    assert reading.noise == pytest.approx(2.0, rel=0.5)


def test_the_command_reports_faults_and_exits_with_1(tmp_path):
    simulated = SimulatedRig(
        background=TABLE, lighting=Lighting(contrast=100.0, change=LightChange(-1.0, 0.05))
    )
    rig_file = write_recording(tmp_path, simulated, POSE, frames=4)
    done = CliRunner().invoke(main, ["doctor", str(rig_file)])
    assert done.exit_code == 1
    assert "error: left: the picture is dark" in done.stdout
    done = CliRunner().invoke(main, ["doctor", str(rig_file), "--json", "--frames", "2"])
    assert done.exit_code == 1
    printed = json.loads(done.stdout)
    assert printed["serious"]
    assert printed["readings"][0]["frames"] == 2
    assert {"severity", "check", "view", "what", "right"} == set(printed["findings"][0])
    done = CliRunner().invoke(main, ["doctor", str(rig_file), "--json", "--frames", str(10**20)])
    assert json.loads(done.stdout)["readings"][0]["frames"] == 4


def test_views_of_one_source_are_refused_in_one_line(tmp_path, clean):
    rig, _ = clean
    (tmp_path / "both.mp4").touch()
    both = str(tmp_path / "both.mp4")
    with_view(with_view(rig, 0, source=both), 1, source=both).save(tmp_path / "rig.toml")
    done = CliRunner().invoke(main, ["doctor", str(tmp_path / "rig.toml")])
    assert done.exit_code == 2
    assert 'views "left" and "right" both read' in done.output


def test_a_missing_source_is_refused(tmp_path, clean):
    rig, _ = clean
    assert rig.views[0].reference == FixedReference()
    rig.save(tmp_path / "rig.toml")
    done = CliRunner().invoke(main, ["doctor", str(tmp_path / "rig.toml")])
    assert done.exit_code == 2
    assert "no such file" in done.output
