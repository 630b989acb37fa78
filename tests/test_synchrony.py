"""Synchrony of views: clocks by the tip that both follow, repeated pictures, times in names."""

import logging
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from msgspec import structs

import fingerpost
from fingerpost import pipeline
from fingerpost.capture import Frame, open_source, open_views, read_views
from fingerpost.capture.numbering import taken
from fingerpost.config import Rig
from fingerpost.consistency import FROZEN, Freshness, Tips, clocks_agree, lag_between
from fingerpost.errors import CaptureError
from fingerpost.pipeline import HELD_BACK_S, Pointer, steps
from fingerpost.pointing import Status
from fingerpost.simulate import Placement, Workspace

CLIP = Path(fingerpost.__file__).parent / "data" / "desk" / "rig.toml"
STEP_S = 1 / 30
CAMERAS = Placement(azimuths_deg=(-20.0, 25.0)).cameras(Workspace())


def tip_mm(time_s):
    """Aperiodic motion of a tip above the plane."""
    t = np.asarray(time_s)
    x = 200 + 80 * np.sin(2.1 * t) + 30 * np.sin(5.3 * t + 1)
    y = 180 + 70 * np.sin(1.7 * t + 2) + 20 * np.sin(4.1 * t)
    z = 80 + 30 * np.sin(1.3 * t) + 10 * np.sin(6.1 * t)
    return np.stack([x, y, z], axis=-1)


def tips(lag_s, *, noise_px=0.4, span_s=3.0, motion=tip_mm, rng=0):
    """Tips in both cameras; the second one's clock is late by `lag_s`."""
    rng = np.random.default_rng(rng)
    first, other = CAMERAS
    both = []
    for camera, late_s in ((first, 0.0), (other, lag_s)):
        seen = Tips()
        first_from_camera = first.image_from_plane @ np.linalg.inv(camera.image_from_plane)
        for time_s in np.arange(0.0, span_s, STEP_S):
            tip_px = camera.project(motion(time_s - late_s)) + rng.normal(0, noise_px, 2)
            seen.add(time_s, first_from_camera @ [*tip_px, 1.0])
        both.append(seen)
    return both


@pytest.mark.parametrize("frames", [-20, -6.5, -2, 1.5, 3, 12, 24])
def test_a_late_clock_is_measured_to_a_fraction_of_a_frame(frames):
    lag = lag_between(*tips(frames * STEP_S))
    assert lag.lag_s == pytest.approx(frames * STEP_S, abs=0.25 * STEP_S)
    assert lag.with_px < 0.5 * lag.without_px


def tips_of_rates(*, true_fps, stated_fps, noise_px=0.4, span_s=4.0):
    """Tips in both cameras; frames of the second one are dated as of another frame rate."""
    rng = np.random.default_rng(3)
    first, other = CAMERAS
    both = []
    for camera, taken_fps, dated_fps in ((first, 30.0, 30.0), (other, true_fps, stated_fps)):
        seen = Tips()
        first_from_camera = first.image_from_plane @ np.linalg.inv(camera.image_from_plane)
        for k in range(int(span_s * dated_fps)):
            tip_px = camera.project(tip_mm(k / taken_fps)) + rng.normal(0, noise_px, 2)
            seen.add(k / dated_fps, first_from_camera @ [*tip_px, 1.0])
        both.append(seen)
    return both


@pytest.mark.parametrize("true_fps", [25.0, 36.0])
@pytest.mark.parametrize("stated_fps", [25.0, 30.0, 60.0])
def test_a_wrong_frame_rate_is_measured(true_fps, stated_fps):
    first, other = tips_of_rates(true_fps=true_fps, stated_fps=stated_fps)
    lag = lag_between(first, other, 0.0)
    if true_fps == stated_fps:
        assert lag is None
        assert clocks_agree(first, other)
        return
    assert lag.rate == pytest.approx(true_fps / stated_fps, rel=0.03)
    latest_s = first.latest()[0][-4]  # the last one whose speed is known
    assert lag.lag_s == pytest.approx((lag.rate - 1.0) * latest_s, abs=0.15)


def test_clocks_agree_only_where_the_motion_excludes_a_lag():
    def along(time_s):
        base = CAMERAS[1].centre_mm - CAMERAS[0].centre_mm
        return np.array([200.0, 200.0, 60.0]) + 0.08 * np.sin(4 * time_s) * base

    assert clocks_agree(*tips(0.0))
    assert not clocks_agree(*tips(0.2))
    assert not clocks_agree(*tips(0.0, motion=lambda _: np.array([200.0, 180.0, 80.0])))
    assert not clocks_agree(*tips(0.0, motion=along))


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("frames", [0.0, 0.3, -0.4])
def test_clocks_that_agree_to_a_fraction_of_a_frame_have_no_lag(frames, seed):
    assert lag_between(*tips(frames * STEP_S, noise_px=1.0, rng=seed)) is None


class Dwells:
    """A tip that rests at random places and moves between them with minimum jerk."""

    def __init__(self, rng):
        self.places = rng.uniform((80, 60, 50), (320, 300, 130), (12, 3))
        rests_s, moves_s = rng.uniform(0.6, 2.5, 12), rng.uniform(0.4, 0.8, 12)
        self.ends_s = np.cumsum(rests_s + moves_s)
        self.moves_s = moves_s

    def __call__(self, time_s):
        k = min(int(np.searchsorted(self.ends_s, time_s)), len(self.places) - 2)
        part = np.clip(1.0 - (self.ends_s[k] - time_s) / self.moves_s[k], 0.0, 1.0)
        way = part**3 * (10.0 - 15.0 * part + 6.0 * part**2)
        return (1.0 - way) * self.places[k] + way * self.places[k + 1]


def lags_while(seed, lag_s):
    """All lags that are found every half second, of contours whose tips are biased by place."""
    rng = np.random.default_rng(seed)
    first, other = tips(lag_s, span_s=0.0)
    motion, found = Dwells(rng), []
    biases = [(rng.normal(0, 2.0, 2), rng.normal(0, 1 / 60, (2, 2))) for _ in CAMERAS]
    for k, time_s in enumerate(np.arange(3.0, 23.0, STEP_S)):
        for seen, camera, late_s, (offset_px, slope) in zip(
            (first, other), CAMERAS, (0.0, lag_s), biases, strict=True
        ):
            tip_px = camera.project(motion(time_s - late_s))
            tip_px = tip_px + offset_px + slope @ (tip_px - 300.0) + rng.normal(0, 0.4, 2)
            first_from_camera = CAMERAS[0].image_from_plane @ np.linalg.inv(camera.image_from_plane)
            seen.add(time_s, first_from_camera @ [*tip_px, 1.0])
        if k % 15 == 14:
            found.append(lag_between(first, other))
    return [lag.lag_s for lag in found if lag is not None]


@pytest.mark.parametrize("seed", range(6))
def test_a_hand_that_rests_often_shows_a_lag_by_its_moves(seed):
    # While a tip rests, its contours' biases are all that differ, and any lag may fit them better.
    assert lags_while(seed, 0.0) == []
    lags_s = lags_while(seed, 0.2)
    assert len(lags_s) >= 3
    assert np.median(lags_s) == pytest.approx(0.2, abs=0.5 * STEP_S)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("speed_mm_s", [0.0, 4.0])
def test_a_tip_that_hardly_moves_gives_no_lag(speed_mm_s, seed):
    def motion(time_s):
        return np.array([200.0 + speed_mm_s * time_s, 180.0, 80.0])

    assert lag_between(*tips(0.0, noise_px=1.0, span_s=6.0, motion=motion, rng=seed)) is None


def test_a_tip_that_moves_along_the_base_line_gives_no_lag():
    along = CAMERAS[1].centre_mm - CAMERAS[0].centre_mm
    along /= np.linalg.norm(along)

    def motion(time_s):
        return np.array([200.0, 200.0, 60.0]) + 40.0 * np.sin(4 * time_s) * along

    assert lag_between(*tips(0.2, motion=motion)) is None


def test_too_few_tips_give_no_lag():
    assert lag_between(*tips(0.2, span_s=0.5)) is None


@pytest.fixture(scope="module")
def clip():
    """The rig of the built-in clip, and its frames."""
    rig = Rig.load(CLIP)
    with open_views(rig.sources) as sources:
        return rig, list(read_views(sources))


def run(rig, frames):
    pointer = Pointer(rig)
    return pointer, list(steps(pointer, frames))


def test_views_with_an_offset_are_detected_and_give_no_points(clip, caplog):
    rig, together = clip
    late = [
        (left, Frame(left.index, left.time_s, right.image))
        for (left, _), (_, right) in zip(together[:-5], together[5:], strict=True)
    ]
    with caplog.at_level(logging.WARNING):
        pointer, reported = run(rig, late)
    (note,) = pointer.notes()
    assert "offset_s = 0.20" in note
    assert note in caplog.text
    assert all(step.fix.status is not Status.OK for step in reported[-30:])
    assert "lags by -0.20 s" in reported[-1].fix.reason


@pytest.mark.parametrize("stated_fps", [20.0, 30.0, 60.0])
def test_a_wrong_frame_rate_is_reported_and_gives_no_points(clip, stated_fps):
    rig, together = clip
    dated = [frame for left, right in together for frame in ((left, None), (None, right))]
    dated = [
        (left, right and Frame(right.index, right.index / stated_fps, right.image))
        for left, right in dated
    ]
    dated.sort(key=lambda pair: (pair[0] or pair[1]).time_s)
    pointer = Pointer(rig)
    pointer.hold_back([SimpleNamespace(has_own_clock=True)] * 2)
    reported = list(steps(pointer, dated))
    (note,) = pointer.notes()
    assert "25 a second for" in note
    assert f"in place of {stated_fps:g}" in note
    assert all(step.fix.status is not Status.OK for step in reported)


@pytest.mark.parametrize("late_by", [-8, 4, 6])
def test_recordings_begun_apart_give_no_point_from_the_first_frame_on(clip, tmp_path, late_by):
    rig, together = clip
    views = []
    for k, view in enumerate(rig.views):
        (tmp_path / view.name).mkdir()
        begun = max(0, late_by * (2 * k - 1))
        for n, frames in enumerate(together[begun:70]):
            cv2.imwrite(str(tmp_path / view.name / f"{n:03d}.png"), frames[k].image)
        views.append(structs.replace(view, source=str(tmp_path / view.name / "*.png")))
    fixes = list(fingerpost.track(structs.replace(rig, views=tuple(views))))
    assert len(fixes) >= 60
    assert not any(fix.status is Status.OK for fix in fixes)


def test_the_points_of_recordings_in_step_are_held_back_and_unchanged(clip):
    rig, together = clip
    _, plain = run(rig, together)
    pointer = Pointer(rig)
    pointer.hold_back([SimpleNamespace(has_own_clock=True)] * 2)
    came = [(k, step) for k, seen in enumerate(together) for step in pointer.update(seen)]
    waited = {step.index: k - step.index for k, step in came}
    assert max(waited.values()) * together[1][0].time_s <= HELD_BACK_S
    assert max(waited.values()) > 20  # the hand has to move first
    assert waited[len(together) - 5] == 0
    held = [*(step for _, step in came), *pointer.finish()]
    assert [repr(step.fix) for step in held] == [repr(step.fix) for step in plain]


def test_large_pictures_do_not_wait_in_memory(clip, monkeypatch):
    rig, together = clip
    monkeypatch.setattr(pipeline, "HELD_BACK_BYTES", 5 * 2 * together[0][0].image.nbytes)
    pointer = Pointer(rig)
    pointer.hold_back([SimpleNamespace(has_own_clock=True)] * 2)
    waited = {s.index: k - s.index for k, seen in enumerate(together) for s in pointer.update(seen)}
    assert max(waited.values()) == 4


@pytest.mark.parametrize("error", [CaptureError("the second film is damaged"), KeyboardInterrupt()])
@pytest.mark.parametrize("is_recorded", [True, False])
def test_points_come_before_an_error_only_if_they_were_held_back(clip, error, is_recorded):
    rig, together = clip

    def damaged():
        # The second view has not reached the time of the last frame.
        yield from [*together[:20], (together[20][0], None)]
        raise error

    pointer = Pointer(rig)
    pointer.hold_back([SimpleNamespace(has_own_clock=is_recorded)] * 2)
    reported = []
    with pytest.raises(type(error)):
        reported.extend(step.index for step in steps(pointer, damaged()))
    assert reported == list(range(21 if is_recorded else 20))


def test_an_offset_in_the_rig_synchronises_the_views(clip, tmp_path):
    rig, together = clip
    late_by = 5
    views = []
    for k, view in enumerate(rig.views):
        (tmp_path / view.name).mkdir()
        for n, frames in enumerate(together[late_by * k :]):
            cv2.imwrite(str(tmp_path / view.name / f"{n:03d}.png"), frames[k].image)
        offset_s = late_by / 25.0 * k
        source = str(tmp_path / view.name / "*.png")
        views.append(structs.replace(view, source=source, offset_s=offset_s))
    moved = structs.replace(rig, views=tuple(views))
    with open_views(moved.sources, moved.readings) as sources:
        pointer, reported = run(moved, read_views(sources))
    assert pointer.notes() == []
    _, plain = run(rig, together)
    expected = {round(s.fix.time_s, 3): s.fix.point for s in plain if s.fix.status is Status.OK}
    ok = [step.fix for step in reported if step.fix.status is Status.OK]
    assert len(ok) > 60
    off = [np.hypot(*(f.point - expected[round(f.time_s, 3)])) for f in ok[10:]]
    assert np.median(off) < 1.0


def noisy(rng, centre, level=90):
    image = np.full((240, 320), level, np.uint8)
    cv2.circle(image, centre, 20, 200, -1)
    return np.clip(image + rng.normal(0, 2.0, image.shape), 0, 255).astype(np.uint8)


def freshness_of(pairs):
    freshness = Freshness(2)
    old = []
    for k, images in enumerate(pairs):
        frames = [Frame(k, k / 30.0, image) for image in images]
        old.append(freshness.look(frames))
    return freshness, np.array(old)


def test_a_picture_repeated_by_a_driver_is_old():
    rng = np.random.default_rng(1)
    moving = [noisy(rng, (60 + 3 * k, 120)) for k in range(40)]
    slow = [moving[k - k % 2] for k in range(40)]
    freshness, old = freshness_of(zip(moving, slow, strict=True))
    assert not old[:, 0].any()
    assert old[18:, 1].tolist() == [k % 2 == 1 for k in range(18, 40)]
    assert freshness.repeats[1] == old[:, 1].sum()


@pytest.mark.parametrize("held", [2, 40])
def test_a_video_codec_does_not_make_a_repeated_picture_new(tmp_path, held):
    """A slow sensor, and a view that has stood still from the beginning."""
    rng = np.random.default_rng(1)
    moving = [noisy(rng, (60 + 3 * k, 120)) for k in range(40)]
    writer = cv2.VideoWriter(
        str(tmp_path / "a.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 30.0, (320, 240)
    )
    for k in range(40):
        writer.write(cv2.cvtColor(moving[k - k % held], cv2.COLOR_GRAY2BGR))
    writer.release()
    with open_source(str(tmp_path / "a.mp4")) as source:
        decoded = [frame.grey() for frame in source]
    _, old = freshness_of(zip(moving, decoded, strict=True))
    assert not old[:, 0].any()
    assert old[18:, 1].tolist() == [k % held > 0 for k in range(18, 40)]


def test_repeats_of_two_slow_sensors_are_detected():
    rng = np.random.default_rng(1)
    moving = [noisy(rng, (60 + 3 * k, 120)) for k in range(40)]
    slow = [moving[k - k % 2] for k in range(40)]
    _, old = freshness_of(zip(slow, slow, strict=True))
    assert old[18:].tolist() == [[k % 2 == 1] * 2 for k in range(18, 40)]


def test_pictures_of_a_still_hand_are_new():
    rng = np.random.default_rng(1)
    moving = [noisy(rng, (60 + 3 * min(k, 15), 120)) for k in range(60)]
    still = [noisy(rng, (60, 120)) for _ in range(60)]
    _, old = freshness_of(zip(moving, still, strict=True))
    assert not old.any()


def test_pictures_without_noise_are_not_old():
    rng = np.random.default_rng(1)
    one = noisy(rng, (60, 120))
    _, old = freshness_of([(one, one)] * 40)
    assert not old.any()


@pytest.mark.parametrize("view", [0, 1])
def test_a_frozen_view_is_lost_and_returns(clip, view, caplog):
    rig, together = clip
    frames = []
    for k, pair in enumerate(together):
        images = [frame.image for frame in pair]
        if 35 <= k < 70:
            images[view] = together[35][view].image
        frames.append([Frame(k, k / 25.0, image) for image in images])
    pointer, reported = run(rig, frames)
    by_time = {round(25 * step.fix.time_s): step.fix for step in reported}
    frozen = [by_time[k] for k in range(50, 70)]
    assert {fix.status for fix in frozen} == {Status.LOST}
    assert all(f'view "{rig.views[view].name}": {FROZEN}' in fix.reason for fix in frozen)
    assert all(by_time[k].status is not Status.OK for k in range(41, 70) if k in by_time)
    assert any(by_time[k].status is Status.OK for k in range(72, 90))
    assert "were old ones" in pointer.notes()[-1]
    assert caplog.text.count("stands still") == 1


def paths(*names):
    return [Path(name) for name in names]


def test_missing_numbers_are_lost_frames(caplog):
    numbered = taken(paths("a1.png", "a2.png", "a5.png", "a6.png"), 10.0, "a*.png")
    assert [one.place for one in numbered] == [0, 1, 4, 5]
    assert [one.time_s for one in numbered] == [0.0, 0.1, 0.4, 0.5]
    assert "a*.png: 2 numbers are missing, the first of them after a2.png" in caplog.text


@pytest.mark.parametrize(
    ("names", "times_s"),
    [
        (["0.png", "10.png", "20.png", "30.png"], [0, 0.1, 0.2, 0.3]),  # every tenth was kept
        (["7.png", "12.png", "13.png", "31.png"], [0, 0.1, 0.2, 0.3]),  # chosen ones
        (["a.png", "b.png", "c.png", "d.png"], [0, 0.1, 0.2, 0.3]),
        (["x.png"] * 4, [0, 0.1, 0.2, 0.3]),
        (
            ["1700000000000.png", "1700000000033.png", "1700000000150.png", "1700000000200.png"],
            [1.7e9, 1.7e9 + 0.033, 1.7e9 + 0.15, 1.7e9 + 0.2],
        ),
        (
            [f"l_{1_700_000_000 + k}.{k}5.png" for k in range(4)],
            [1.7e9 + k + k / 10 + 0.05 for k in range(4)],
        ),
        ([f"{1_700_000_000_000_000_000 + k * 10**8}.png" for k in range(4)], None),
    ],
)
def test_file_names_give_the_times_of_images(names, times_s, caplog):
    expected = times_s or [1.7e9 + k / 10 for k in range(4)]
    numbered = taken(paths(*names), 10.0, "*.png")
    assert [one.time_s for one in numbered] == pytest.approx(expected, abs=1e-6)
    assert caplog.text == ""


@pytest.mark.parametrize(
    "name",
    [
        "2026-11-30T18-22-2{k}.{k}25.png",
        "left_2026-11-30 18_22_2{k},{k}25.jpg",
        "20261130_18222{k}_{k}25.png",
        "2026-11-30T18-22-2{k}.{k}25Z.png",
    ],
)
def test_dates_and_times_of_day_in_names_are_times(name, caplog):
    numbered = taken(paths(*(name.format(k=k) for k in range(4))), 10.0, "*.png")
    times_s = [one.time_s - numbered[0].time_s for one in numbered]
    assert times_s == pytest.approx([1.1 * k for k in range(4)], abs=1e-6)
    assert numbered[0].time_s == pytest.approx(1_796_062_940.025, abs=1e-3)
    assert caplog.text == ""


@pytest.mark.parametrize(
    "names",
    [
        ["2026-11-30T18-22-27.png"] * 2 + ["2026-11-30T18-22-28.png"],  # two in a second
        ["2026-13-30T18-22-27.png", "2026-13-30T18-22-28.png"],  # no such month
    ],
)
def test_dates_that_are_no_times_are_not_used(names):
    numbered = taken(paths(*names), 10.0, "*.png")
    assert [one.time_s for one in numbered][1] == pytest.approx(0.1)


def test_numbered_images_keep_their_places(tmp_path):
    for k in (0, 1, 4):
        cv2.imwrite(str(tmp_path / f"{k}.png"), np.full((8, 8), k, np.uint8))
    with open_source(str(tmp_path / "*.png"), fps=10.0) as source:
        frames = list(source)
    assert [(frame.index, frame.time_s) for frame in frames] == [(0, 0.0), (1, 0.1), (4, 0.4)]
