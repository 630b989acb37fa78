"""The offset of two recordings, from the footage itself."""

import json

import numpy as np
import pytest
from click.testing import CliRunner

import fingerpost as fp
from fingerpost.cli import main
from fingerpost.consistency import Track, offset_between
from fingerpost.errors import InvalidInputError
from fingerpost.simulate import (
    Background,
    Placement,
    SimulatedRig,
    Trajectory,
    Workspace,
    figure_eight,
    write_recording,
)

STEP_S = 1 / 30
CAMERAS = Placement(azimuths_deg=(-20.0, 25.0)).cameras(Workspace())
ACCURACY_S = 0.002


def tip_mm(time_s):
    """Aperiodic motion of a tip above the plane."""
    t = np.asarray(time_s)
    x = 200 + 80 * np.sin(2.1 * t) + 30 * np.sin(5.3 * t + 1)
    y = 180 + 70 * np.sin(1.7 * t + 2) + 20 * np.sin(4.1 * t)
    z = 80 + 30 * np.sin(1.3 * t) + 10 * np.sin(6.1 * t)
    return np.stack([x, y, z], axis=-1)


def tracks(lag_s, *, noise_px=0.2, span_s=6.0, motion=tip_mm, rng=0):
    """Tracks of the tip in both cameras; the second one's clock is late by `lag_s`."""
    draw, both = np.random.default_rng(rng), []
    first = CAMERAS[0]
    for camera, late_s in zip(CAMERAS, (0.0, lag_s), strict=True):
        first_from_camera = first.image_from_plane @ np.linalg.inv(camera.image_from_plane)
        times_s = np.arange(0.0, span_s, STEP_S)
        tips_px = camera.project(motion(times_s - late_s))
        tips_px = tips_px + draw.normal(0.0, noise_px, tips_px.shape)
        points = np.column_stack([tips_px, np.ones(len(times_s))]) @ first_from_camera.T
        both.append(Track(times_s, points))
    return both


@pytest.mark.parametrize("lag_s", [0.0, 0.004, -0.2, 0.5123, -1.37, 2.9])
def test_offsets_of_any_size_are_estimated_to_two_milliseconds(lag_s):
    found = offset_between(*tracks(lag_s))
    assert found.lag_s == pytest.approx(lag_s, abs=ACCURACY_S)
    assert found.off_px < 0.5


def test_the_sigma_of_an_offset_matches_its_errors():
    lags_s = np.linspace(-0.1, 0.1, 7)
    found = [offset_between(*tracks(lag_s, span_s=4.0, rng=k)) for k, lag_s in enumerate(lags_s)]
    share = [(f.lag_s - lag_s) / f.sigma_s for f, lag_s in zip(found, lags_s, strict=True)]
    assert 0.3 < np.sqrt(np.mean(np.square(share))) < 2.0


def circling(time_s):
    angle = 2 * np.pi * np.asarray(time_s)
    return np.stack(
        [200 + 60 * np.cos(angle), 200 + 60 * np.sin(angle), 80 + 30 * np.sin(angle)], axis=-1
    )


def along_the_base_line(time_s):
    along = CAMERAS[1].centre_mm - CAMERAS[0].centre_mm
    way = 60.0 * np.sin(3.1 * np.asarray(time_s)) + 20.0 * np.sin(1.3 * np.asarray(time_s))
    return np.array([200.0, 200.0, 60.0]) + way[..., None] * along / np.linalg.norm(along)


def still(time_s):
    return np.tile([200.0, 150.0, 60.0], (len(time_s), 1))


@pytest.mark.parametrize(
    ("motion", "more", "words"),
    [
        (still, {}, "it is to move"),
        (circling, {}, "move without repeating itself"),
        (along_the_base_line, {}, "to move|too little of them"),
        (tip_mm, {"span_s": 0.6}, "followed in 18 and 18 frames; 24 of each are needed"),
    ],
)
def test_footage_without_a_determinable_offset_is_refused_with_advice(motion, more, words):
    with pytest.raises(InvalidInputError) as raised:
        offset_between(*tracks(0.2, motion=motion, **more))
    assert any(part in str(raised.value) for part in words.split("|"))


def test_a_repetition_is_not_mistaken_for_the_offset():
    """0.4 frames late, period 34.4 frames: of whole lags, one a period off fits best."""

    def repeated(time_s):
        phase = 2 * np.pi / (34.4 * STEP_S) * np.asarray(time_s)
        return tip_mm(np.sin(phase) + 0.4 * np.cos(2 * phase))

    with pytest.raises(InvalidInputError, match=r"fits at .* and at .* without repeating itself"):
        offset_between(*tracks(0.4 * STEP_S, motion=repeated))


def test_the_command_synchronises_recordings(tmp_path):
    skew_s = 0.1234
    rig = SimulatedRig(
        Placement(time_skews_s=(0.0, skew_s)), background=Background(texture="wood", clutter=20.0)
    )
    poses = figure_eight(rig.workspace, hover_mm=90.0)
    path = Trajectory.hold(poses[0], 0.4).then(Trajectory.through(poses, 0.3))
    rig_file = write_recording(tmp_path, rig, path, frames=80, fps=25.0, rng=2)

    done = CliRunner().invoke(
        main, ["sync", str(rig_file), "--json", "-o", str(tmp_path / "s.toml")]
    )
    assert done.exit_code == 0, done.output
    found = json.loads(done.output)
    assert found["offset_s"] == pytest.approx(skew_s, abs=ACCURACY_S)
    assert found["sigma_s"] < ACCURACY_S
    left, right = fp.Rig.load(tmp_path / "s.toml").views
    assert (left.offset_s, right.offset_s) == (0.0, pytest.approx(found["offset_s"], abs=1e-6))
