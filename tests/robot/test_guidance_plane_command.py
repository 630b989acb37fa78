"""`fingerpost robot plane` as a user meets it: live views and an emulated Scorbot."""

import json
import signal

import numpy as np
import pytest
from guidance_scene import HEIGHT_M, NAMES, REGION_M, draw_marker, pixel
from guided_process import STOPPED_S, EmulatedArm, Guided, JpegStreams, commands, jpeg

from fingerpost.config import Rig
from fingerpost.guidance import guard_of, robot_of, spread_places
from fingerpost.pointing import PlaneView
from fingerpost.robot import SimulatedRobot

REGION = " ".join(f"{x},{y}" for x, y in REGION_M)
PLACE = ("--region", REGION, "--z", "0.005", "0.3", "--height", HEIGHT_M)
BLANK = jpeg(np.full((480, 640), 60, np.uint8))


def write_cameras(folder, urls):
    """A rig file without a plane, as one has it before the robot has defined one."""
    views = [
        f'[[view]]\nname = "{name}"\nsource = "{url}"\n'
        for name, url in zip(NAMES, urls, strict=True)
    ]
    path = folder / "cameras.toml"
    path.write_text("\n".join(views))
    return path


def marker_films(arm):
    """Films of the marker on the gripper of an arm, wherever it is."""

    def film(view):
        return lambda: jpeg(draw_marker(arm.pose().position_m)[view])

    return [film(view) for view in range(2)]


def errors_m(rig, z_m):
    """How far the views' planes are from the truth at the corners of the region."""
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
    table = robot_of(rig)
    assert table.url == home
    assert table.height_m == pytest.approx(height_m, abs=3e-4)
    assert table.pitch_deg == -90.0
    assert np.allclose(table.region_m, REGION_M)
    assert max(errors_m(rig, height_m)) < 0.002
    assert "6 of 6 places" in guided.out
    assert f"written to {output}" in guided.out
    assert guided.said().count("found") == 6
    visits = [row for row in commands(log) if row["command"] == "visit"]
    assert len(visits) == 18
    # What was written is what the other commands read.
    guard_of(SimulatedRobot(), table)


def test_given_pixels_define_it_too_and_json_tells_all(tmp_path):
    output, pixels = tmp_path / "plane.toml", tmp_path / "pixels.csv"
    with EmulatedArm(5.0) as arm, JpegStreams([[BLANK]] * 2) as streams:
        cameras = write_cameras(tmp_path, streams.urls)
        places = spread_places(_allowed(), 5)
        rows = [
            f"{place + 1},{name},{u:.3f},{v:.3f}"
            for k, name in enumerate(NAMES)
            for place, (u, v) in enumerate(
                pixel(k, np.column_stack([places, np.full(5, HEIGHT_M)]))
            )
        ]
        pixels.write_text("\n".join(["place,view,u,v", *rows]))
        options = ("--finder", "pixels", "--pixels", pixels, "--points", 5, "--json", "--arm")
        with Guided("plane", cameras, arm.url, *PLACE, *options, "-o", output) as guided:
            assert guided.end(60) == 0, guided.said()
    told = json.loads(guided.out)
    assert told["left_out"] == {}
    assert [view["name"] for view in told["views"]] == list(NAMES)
    assert np.shape(told["views"][0]["entries_covariance"]) == (9, 9)
    assert max(errors_m(Rig.load(output), HEIGHT_M)) < 0.001


def _allowed():
    from guidance_scene import table

    return guard_of(SimulatedRobot(), table(z_m=(0.005, 0.3))).allowed


def test_a_gripper_that_is_not_there_is_one_line_and_no_file(tmp_path):
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


def test_a_signal_in_the_middle_of_the_visits_stops_the_arm(tmp_path):
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


def refused(*arguments):
    with Guided(*arguments) as guided:
        assert guided.end() == 2, guided.said()
    (line,) = guided.said().splitlines()
    return line


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
    ],
)
def test_what_cannot_be_used_is_refused_before_anything_moves(tmp_path, change, words):
    cameras = write_cameras(tmp_path, ["a.mp4", "b.mp4"])
    options = ("-o", tmp_path / "plane.toml", "--arm", *PLACE, *change)
    assert words in refused("plane", cameras, "acl:///dev/nothing", *options)


def test_region_and_consent_are_needed(tmp_path, hand_film):
    cameras = hand_film / "rig.toml"
    output = ("-o", tmp_path / "plane.toml")
    assert "--region" in refused("plane", cameras, "sim://", *output, "--arm")
    assert "--arm" in refused("plane", cameras, "sim://", *output, *PLACE)
    assert "recording" in refused("plane", cameras, "sim://", *output, *PLACE, "--arm")
