"""`fingerpost robot plane` end to end, with live views and an emulated Scorbot."""

import contextlib
import json
import signal
from types import SimpleNamespace

import click
import numpy as np
import pytest
from command_line import invoked, refused
from guidance_scene import HEIGHT_M, NAMES, REGION_M, draw_marker, pixel, table
from guided_process import STOPPED_S, EmulatedArm, Guided, JpegStreams, commands, jpeg

from fingerpost.capture import Frame, SourceKind
from fingerpost.cli.robot_plane import _asking
from fingerpost.config import Rig
from fingerpost.errors import RecordingError
from fingerpost.guidance import GivenFinder, guard_of, robot_of, spread_places
from fingerpost.pointing import PlaneView
from fingerpost.robot import SimulatedRobot

REGION = " ".join(f"{x},{y}" for x, y in REGION_M)
PLACE = ("--region", REGION, "--z", "0.005", "0.3", "--height", HEIGHT_M)
UNUSABLE_S = ("-1", "0", "nan", "inf")
BLANK = jpeg(np.full((480, 640), 60, np.uint8))


def write_cameras(folder, urls):
    """Write a rig file without a plane, the state before the robot has defined one."""
    views = [
        f'[[view]]\nname = "{name}"\nsource = "{url}"\n'
        for name, url in zip(NAMES, urls, strict=True)
    ]
    path = folder / "cameras.toml"
    path.write_text("\n".join(views))
    return path


def marker_films(arm):
    """Return pictures of the marker at the arm's present gripper position, for every view."""

    def film(view):
        return lambda: jpeg(draw_marker(arm.pose().position_m)[view])

    return [film(view) for view in range(2)]


def errors_m(rig, z_m):
    """Yield the largest error of each view's plane at the corners of the region [m]."""
    world = np.column_stack([REGION_M, np.full(4, z_m)])
    for k, view in enumerate(rig.views):
        plane_view = PlaneView.from_reference_points(
            rig.plane.points, view.reference_points_px, view.reference_covariances(1.0)
        )
        yield np.linalg.norm(plane_view.back_project(pixel(k, world)) - REGION_M, axis=1).max()


@pytest.mark.parametrize("up_m", [0.0, 0.05])
def test_a_marker_on_the_gripper_defines_the_plane(tmp_path, up_m):
    output, log = tmp_path / "plane.toml", tmp_path / "commands.csv"
    height_m = HEIGHT_M + up_m
    with EmulatedArm(5.0) as arm, JpegStreams(marker_films(arm)) as streams:
        cameras = write_cameras(tmp_path, streams.urls)
        place = ("--region", REGION, "--z", "0.005", "0.3", "--height", height_m)
        options = ("--marker", 3, "--points", 6, "--speed", 0.3, "--log", log, "--arm")
        with Guided("plane", cameras, arm.url, *place, *options, "-o", output) as guided:
            assert guided.end(60) == 0, guided.said()
        home = arm.url
    rig = Rig.load(output)
    assert rig.plane.unit == "m"
    assert len(rig.plane.points) == 6
    defined = robot_of(rig)
    assert defined.url == home
    assert defined.height_m == pytest.approx(height_m, abs=3e-4)
    assert defined.pitch_deg == -90.0
    assert np.allclose(defined.region_m, REGION_M)
    assert max(errors_m(rig, height_m)) < 0.002
    assert "6 of 6 places" in guided.out
    assert f"written to {output}" in guided.out
    assert guided.said().count("found") == 6
    visits = [row for row in commands(log) if row["command"] == "visit"]
    assert len(visits) == 18
    # The other commands can read the written file.
    guard_of(SimulatedRobot(), defined)


def test_given_pixels_define_the_plane_and_json_reports_all(tmp_path):
    output, pixels = tmp_path / "plane.toml", tmp_path / "pixels.csv"
    with EmulatedArm(5.0) as arm, JpegStreams([[BLANK]] * 2) as streams:
        cameras = write_cameras(tmp_path, streams.urls)
        write_pixels(pixels, 5)
        options = ("--finder", "pixels", "--pixels", pixels, "--points", 5, "--json", "--arm")
        with Guided("plane", cameras, arm.url, *PLACE, *options, "-o", output) as guided:
            assert guided.end(60) == 0, guided.said()
    result = json.loads(guided.out)
    assert result["left_out"] == {}
    assert [view["name"] for view in result["views"]] == list(NAMES)
    assert np.shape(result["views"][0]["entries_covariance"]) == (9, 9)
    assert max(errors_m(Rig.load(output), HEIGHT_M)) < 0.001


def write_pixels(path, count):
    """Write the gripper's pixels in the views at `count` places."""
    allowed = guard_of(SimulatedRobot(), table(z_m=(0.005, 0.3))).allowed
    places = np.column_stack([spread_places(allowed, count), np.full(count, HEIGHT_M)])
    rows = [
        f"{place + 1},{name},{u:.3f},{v:.3f}"
        for k, name in enumerate(NAMES)
        for place, (u, v) in enumerate(pixel(k, places))
    ]
    path.write_text("\n".join(["place,view,u,v", *rows]))


def test_a_missing_gripper_is_one_line_and_no_file(tmp_path):
    output = tmp_path / "plane.toml"
    with EmulatedArm(8.0) as arm, JpegStreams([[BLANK]] * 2) as streams:
        cameras = write_cameras(tmp_path, streams.urls)
        options = ("--points", 4, "--speed", 0.3, "--arm")
        with Guided("plane", cameras, arm.url, *PLACE, *options, "-o", output) as guided:
            assert guided.end(60) == 1
        assert not arm.is_moving()
    last = guided.said().splitlines()[-1]
    assert "found at 0 of 4 places" in last
    assert "no marker 0" in last
    assert not output.exists()


def test_a_signal_during_the_visits_stops_the_arm(tmp_path):
    log = tmp_path / "commands.csv"
    with EmulatedArm(2.0) as arm, JpegStreams([[BLANK]] * 2) as streams:
        cameras = write_cameras(tmp_path, streams.urls)
        options = ("--speed", 0.2, "--log", log, "--arm", "-o", tmp_path / "plane.toml")
        with Guided("plane", cameras, arm.url, *PLACE, *options) as guided:
            guided.until(lambda: log.exists() and "enter" in log.read_text() and arm.is_moving())
            aborts = arm.controller.aborts
            guided.signal(signal.SIGINT)
            arm.assert_stopped(aborts, STOPPED_S)
            assert guided.end() == 130
    halts = [row["detail"] for row in commands(log) if row["command"] == "halt"]
    assert halts[0] == "signal SIGINT"


def test_a_rig_that_cannot_be_saved_is_printed(tmp_path):
    output, pixels = tmp_path / "plane.toml", tmp_path / "pixels.csv"
    with EmulatedArm(5.0) as arm, JpegStreams([[BLANK]] * 2) as streams:
        cameras = write_cameras(tmp_path, streams.urls)
        write_pixels(pixels, 5)
        options = ("--finder", "pixels", "--pixels", pixels, "--points", 5, "--arm")
        with Guided("plane", cameras, arm.url, *PLACE, *options, "-o", output) as guided:
            guided.until_said("place  1")
            output.mkdir()
            assert guided.end(60) == 2, guided.said()
    assert "5 of 5 places" in guided.out
    assert "written to" not in guided.out
    assert "plane.toml: cannot be written" in guided.said().splitlines()[-1]


def test_a_log_error_at_the_last_stop_loses_no_plane(tmp_path, monkeypatch):
    def log(record):
        if record.command == "halt":
            raise RecordingError("commands.csv: cannot be written: No space left on device")

    rig = SimpleNamespace(save=lambda path: path.write_text("the plane"))
    found = SimpleNamespace(lines=lambda: ["9 of 9 places"], rig=lambda *_: rig)
    views = contextlib.nullcontext([SimpleNamespace(kind=SourceKind.LIVE)] * 2)
    monkeypatch.setattr("fingerpost.capture.open_views", lambda *_: views)
    monkeypatch.setattr("fingerpost.capture.read_views", lambda sources, **_: iter(sources))
    monkeypatch.setattr("fingerpost.guidance.define_plane", lambda *_, **__: found)
    monkeypatch.setattr("fingerpost.cli.robot_plane.open_log", lambda *_: log)
    cameras, output = write_cameras(tmp_path, ["a.mp4", "b.mp4"]), tmp_path / "plane.toml"
    command = ("robot", "plane", cameras, "sim://?homing_s=0", *PLACE, "--arm", "-o", output)
    ended = invoked(*command)
    assert ended.exit_code == 1
    assert "9 of 9 places" in ended.output
    assert ended.output.splitlines()[-1].endswith("No space left on device")
    assert output.read_text() == "the plane"


def test_an_unusable_picture_folder_is_refused_before_consent_is_asked(tmp_path):
    cameras = write_cameras(tmp_path, ["a.mp4", "b.mp4"])
    options = ("--finder", "pixels", "--pictures", cameras, *PLACE, "-o", tmp_path / "plane.toml")
    with Guided("plane", cameras, "sim://", *options, terminal=True) as guided:
        assert guided.end() == 2
    (line,) = guided.said().splitlines()
    assert f"--pictures {cameras}: nothing can be saved there: File exists" in line


def test_an_invalid_pixel_is_asked_for_again(tmp_path, monkeypatch, capsys):
    answers = iter(["3200 240", "nan nan", "12", "12, 13"])
    monkeypatch.setattr(click, "prompt", lambda *_, **__: next(answers))
    ask = _asking("left", tmp_path)
    sighting = GivenFinder(ask).find(0, [Frame(0, 0.0, np.zeros((48, 64), np.uint8))], [])
    assert sighting.pixel_px.tolist() == [12.0, 13.0]
    outside, not_finite, not_two = capsys.readouterr().err.splitlines()
    assert "(3200, 240), outside the image of 64 x 48 px" in outside
    assert "finite" in not_finite
    assert "two numbers" in not_two


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("--region", "0.3,0 0.4,0"), "three or more corners"),
        (("--region", "0,0 0.4,0.4 0.4,0 0,0.4"), "convex"),
        (("--points", "3"), "points"),
        (("--dictionary", "9X9"), "9X9"),
        (("--finder", "contour"), "--gripper left"),
        (("--finder", "pixels"), "--pixels"),
        (("--finder", "contour", "--gripper", "top", "1", "1", "90", "50"), "--gripper left"),
        *((("--operator-timeout", value), "--operator-timeout") for value in UNUSABLE_S),
        *((("--homing-timeout", value), "--homing-timeout") for value in UNUSABLE_S),
        *((("--offset", "0", "0", value), "'--offset': offset_m") for value in ("nan", "1e300")),
        *((("--lift", value), "'--lift': lift_m") for value in ("nan", "-1", "1e308")),
        (("--speed", "inf"), "'--speed': speed_m_s"),
        (("--max-sigma", "nan"), "'--max-sigma': max_sigma_m"),
        (("--points", 10**20), "'--points': points"),
        *((("--sigma", value), "sigma_px") for value in ("nan", "inf", "1e-300")),
        (("--tip", "1e308", "0"), "tip is"),
        (("--height", "5"), "--height 5: the places would have the gripper at Z = 5.0000 m"),
        (("--height", "nan"), "height_m"),
        (("--lift", "2"), "the way over them would have the gripper"),
        (("--region", "0.3,0 0.4,0 0.4,1e308"), "reach too far"),
        (("-o", "/"), "-o / cannot be written: it is a folder"),
        (("-o", "/dev/null"), "it is no file"),
        (("-o", "/nonexistent/plane.toml"), "No such file or directory; name a file"),
        (("-o", f"{'x' * 300}.toml"), "File name too long"),
    ],
)
def test_unusable_options_are_refused_before_anything_moves(tmp_path, change, words):
    cameras = write_cameras(tmp_path, ["a.mp4", "b.mp4"])
    options = ("-o", tmp_path / "plane.toml", "--arm", *PLACE, *change)
    assert words in refused("robot", "plane", cameras, "acl:///dev/nothing", *options)


def test_region_and_consent_are_needed(tmp_path, hand_film):
    cameras = hand_film / "rig.toml"
    output = ("-o", tmp_path / "plane.toml")
    assert "--region" in refused("robot", "plane", cameras, "sim://", *output, "--arm")
    assert "--arm" in refused("robot", "plane", cameras, "sim://", *output, *PLACE)
    assert "recording" in refused("robot", "plane", cameras, "sim://", *output, *PLACE, "--arm")
