"""Commands, files and links of `docs/robots`.

The pages of arms that can be emulated are run from cable to pick and place, command by command,
with the emulated port in place of the device.
"""

import math
import os
import re
import shlex
import signal
import time
import tomllib
from pathlib import Path

import click
import guidance_scene
import numpy as np
import pytest
import rosbridge_rig
import so101_rig
from guidance_scene import NAMES, draw_marker
from guided_process import (
    BY_HAND,
    EMPTY_FRAMES,
    FPS,
    EmulatedArm,
    Guided,
    JpegStreams,
    jpeg,
    write_hand,
)
from ur_stand_in import Program, UrController, serve
from xarm_stand_in import ControlBox

from fingerpost.cli import main
from fingerpost.config import Rig
from fingerpost.robot import Pose, Robot, open_robot, registry
from fingerpost.robot.emulator.feetech import calibration_file
from fingerpost.robot.emulator.gcode import MarlinController, UarmController, make_dexarm
from fingerpost.robot.emulator.ports import ArmTime, Emulator, PtyPort

PAGES = sorted((Path(__file__).resolve().parents[2] / "docs" / "robots").glob("*.md"))
TEXTS = {page.stem: page.read_text(encoding="utf-8") for page in PAGES}


def shell_commands(page):
    """Return the command lines of a page in order."""
    text = TEXTS[page].replace("\\\n", " ")
    lines = re.findall(r"^    (fingerpost .*)$", text, re.MULTILINE)
    return [shlex.split(line)[1:] for line in lines]


def snippet(page, language):
    (found,) = re.findall(rf"^```{language}\n(.*?)^```", TEXTS[page], re.DOTALL | re.MULTILINE)
    return found


EVERY_COMMAND = [(page, line) for page in TEXTS for line in shell_commands(page)]


@pytest.mark.parametrize(("page", "line"), EVERY_COMMAND)
def test_every_command_line_can_be_parsed(page, line):
    command: click.Command = main
    names = []
    while isinstance(command, click.Group):
        names.append(line[len(names)])
        command = command.commands[names[-1]]
    command.make_context(" ".join(names), line[len(names) :])


def test_every_page_leads_from_cable_to_pick_and_place():
    for page in ("scorbot", "so101", "uarm-and-marlin", "ur", "xarm", "ros"):
        kinds = [line[1] for line in shell_commands(page)]
        assert kinds[-3:] == ["plane", "follow", "pick"]
        assert "home" in kinds
        assert "## Cable" in TEXTS[page]


@pytest.mark.parametrize("page", TEXTS)
def test_every_link_has_a_target(page):
    for target in re.findall(r"\]\(([^)#]+)", TEXTS[page]):
        assert (PAGES[0].parent / target).exists(), target
    if page != "index":
        assert f"({page}.md)" in TEXTS["index"]


@pytest.mark.parametrize("option", ["acl", "rosbridge", "so101", "ur", "xarm"])
def test_the_tables_options_are_the_drivers(option, tmp_path):
    (tmp_path / "arm.json").write_bytes(calibration_file())
    always = {"so101": f"calibration={tmp_path}/arm.json&"}.get(option, "")
    page = {"acl": "scorbot", "rosbridge": "ros"}.get(option, option)
    options = re.findall(r"^\| `(\w+=[^`]+)` \|", TEXTS[page], re.MULTILINE)
    assert len(options) >= 4
    for one in options:
        assert open_robot(f"{option}://somewhere?{always}{one}").status().state == "disconnected"


def test_the_cameras_of_the_page_load(tmp_path):
    (tmp_path / "cameras.toml").write_text(snippet("index", "toml"), encoding="utf-8")
    rig = Rig.load_cameras(tmp_path / "cameras.toml")
    assert [view.source for view in rig.views] == [0, 2]
    assert all(view.start is not None for view in rig.views)


def test_the_driver_of_the_page_is_a_robot(monkeypatch):
    names = {}
    exec(compile(snippet("your-own", "python"), "your-own.md", "exec"), names)
    points = tomllib.loads(snippet("your-own", "toml"))["project"]["entry-points"]
    (factory,) = points[registry.ENTRY_POINT_GROUP].values()
    monkeypatch.setitem(registry.BUILT_IN, "myarm", names[factory.partition(":")[2]])
    robot = open_robot("myarm://address?max_speed_m_s=0.05")
    assert isinstance(robot, Robot)
    assert robot.limits.max_speed_m_s == 0.05
    with robot:
        robot.home()
        robot.move_to(Pose(0.3, 0.1, 0.1))
        assert robot.pose() == Pose(0.3, 0.1, 0.1)


def test_the_emulator_of_the_page_is_an_arm(tmp_path):
    (line,) = shell_commands("index")
    with Guided(*line[1:], "--time-scale", 50, cwd=tmp_path) as emulator:
        emulator.until((tmp_path / "scorbot").exists)
        url = re.search(r"give `(acl://\w+)`", TEXTS["index"])[1]
        with Guided("home", url, cwd=tmp_path) as guided:
            assert guided.end() == 0, guided.said()
            assert guided.out.startswith("x 0.5197 m")


# The pages of emulated arms, from cable to pick and place.

FIRST_MM, SECOND_MM = (120.0, 220.0), (160.0, 300.0)

SHOWN_FPS = 15
"""Frame rate of the cameras, half of 30 to save time."""

PATIENT = ("--operator-timeout", "5", "--max-age", "1")
"""Generous limits: a loaded machine may show no picture for a second."""


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    folder = tmp_path_factory.mktemp("film")
    write_hand(folder, 4.0, (FIRST_MM, SECOND_MM), hover_mm=90, azimuth_deg=240.0, slant_deg=40.0)
    return [[path.read_bytes() for path in sorted((folder / view).glob("*.jpg"))] for view in NAMES]


class Stage:
    """The cameras' pictures: the marker on the gripper, or the hand, whose frame the test sets."""

    def __init__(self, position_m, film):
        self.position_m = position_m
        self.film = film
        self.hand = False
        self.frames_of_hand = 0

    def film_of(self, view):
        def draw():
            if not self.hand:
                return jpeg(draw_marker(self.position_m())[view])
            return self.film[view][min(self.frames_of_hand, len(self.film[view]) - 1)]

        return draw


def go_through(page, device, port, stage, folder, options=(), *, changes=None, without=None):
    """Run every command of a page that names the device; return the output of each."""
    said = []
    with JpegStreams([stage.film_of(view) for view in range(2)], SHOWN_FPS) as streams:
        cameras = snippet("index", "toml")
        for source, url in zip(("source = 0", "source = 2"), streams.urls, strict=True):
            cameras = cameras.replace(source, f'source = "{url}"')
        (folder / "cameras.toml").write_text(cameras, encoding="utf-8")
        for line in shell_commands(page):
            scheme = device.partition(":")[0]
            if any("://" in argument and not argument.startswith(scheme) for argument in line):
                continue  # of another arm
            if line[1] == without:
                continue
            arguments = [argument.replace(device, port) for argument in line[1:]]
            arguments = [(changes or {}).get(argument, argument) for argument in arguments]
            moves = line[1] in ("plane", "follow", "pick")
            stage.hand = line[1] in ("follow", "pick")
            stage.frames_of_hand = 0
            by_hand = (*BY_HAND, *PATIENT) if line[1] in ("follow", "pick") else ()
            with Guided(
                *(*arguments, *(options if moves else ()), *(("--arm",) * moves), *by_hand),
                cwd=folder,
            ) as guided:
                if line[1] == "follow":
                    _point_about(guided, stage, folder)
                elif line[1] == "pick":
                    _point_about(guided, stage, folder, pick=True)
                    assert guided.end(60) == 0, guided.said()
                else:
                    assert guided.end(60) == 0, guided.said()
            said.append((line[1], guided.said() + guided.out))
    return said


def _point_about(guided, stage, folder, *, pick=False):
    """Show the hand as it enters and points at the first place, then at the second."""
    log = folder / "commands.csv"
    guided.until_said("acquiring")
    for frame in range(EMPTY_FRAMES + 1):
        stage.frames_of_hand = frame
        time.sleep(1 / FPS)
    guided.until(lambda: log.exists() and "\n" in log.read_text() and "move" in log.read_text())
    if pick:
        guided.until_said("block at")
    for frame in range(EMPTY_FRAMES + 1, len(stage.film[0])):
        stage.frames_of_hand = frame
        time.sleep(1 / FPS)
    if not pick:
        guided.signal(signal.SIGINT)
        assert guided.end() == 130, guided.said()


def test_the_scorbots_page(film, tmp_path):
    with EmulatedArm(6.0) as arm:
        stage = Stage(lambda: arm.pose().position_m, film)
        port = arm.emulator.address
        said = go_through("scorbot", "acl:///dev/ttyUSB0", f"acl://{port}", stage, tmp_path)
        assert [kind for kind, _ in said] == ["list", "stop", "home", "plane", "follow", "pick"]
        assert said[2][1].startswith("x 0.5197 m")
        assert "9 of 9 places" in said[3][1]
        assert "1 picked and placed" in said[5][1]


# A DexArm points along its Y, and its region begins further from its base.
SCENES = {
    "uarm": (np.array([-82.0, 221.0, 0.0]), guidance_scene.TURN_RAD),
    "marlin": (np.array([-82.0, 221.0, 0.0]), guidance_scene.TURN_RAD),
    "dexarm": (np.array([-130.0, 193.0, 0.0]), guidance_scene.TURN_RAD - math.pi / 2),
}
CONTROLLERS = {
    "uarm": UarmController,
    "dexarm": lambda: make_dexarm(2.0),
    "marlin": lambda: MarlinController(homing_s=2.0, slips=False),
}
NUMBER = r"-?\d+\.\d\d"
MOVE = rf"X{NUMBER} Y{NUMBER} Z{NUMBER} F\d+(?:\.\d\d)?"
WORDS = {
    "uarm": rf"#\d+ (?:M17|P2203|P2220|G1 X200 Y0 Z150 F10|G1 {MOVE}|M2231 V[01])|(?:\x18\x18)+|",
    "dexarm": rf"N\d+ (?:M110 N0|M11[45]|G21|G90|M1112|M400|G1 {MOVE}|M100[01])\*\d+|M410|",
    "marlin": rf"N\d+ (?:M110 N0|M11[45]|G21|G90|G28|M400|G01 {MOVE}|M280 P0 S9?0)\*\d+|M410|",
}
"""Patterns of all lines that are sent."""


def gcode_arms():
    """Return address and region of the arms in the page's table."""
    rows = re.findall(r"^\| [^|]+ \| `((\w+)://[^`]+)` \| (.+) \|$", TEXTS["uarm-and-marlin"], re.M)
    return {scheme: (address, region.strip("`")) for address, scheme, region in rows}


@pytest.mark.parametrize("name", ["uarm", "dexarm", "marlin"])
def test_the_page_of_the_gcode_arms(name, film, tmp_path, monkeypatch):
    arms = gcode_arms()
    assert set(arms) == set(CONTROLLERS)
    origin_mm, turn_rad = SCENES[name]
    monkeypatch.setattr(guidance_scene, "ROBOT_ORIGIN_MM", origin_mm)
    monkeypatch.setattr(guidance_scene, "TURN_RAD", turn_rad)
    clock, controller = ArmTime(6.0), CONTROLLERS[name]()
    with Emulator(controller, PtyPort(), clock=clock) as emulator:
        stage = Stage(lambda: controller.position_mm(clock()) / 1000.0, film)
        address, region = arms[name]
        _, _, query = address.partition("?")
        url = f"{name}://{emulator.address}" + ("?" if query else "") + query
        if name == "marlin":  # otherwise a moment without the hand would require homing
            url += "&" + re.search(r"`(keeps_steps=true)`", TEXTS["uarm-and-marlin"])[1]
        usual = arms["uarm"][1]
        changes = {usual: region} if region[0].isdecimal() or region[0] == "-" else {}
        without = None if name == "uarm" else "follow"  # the same command for all
        said = go_through(
            *("uarm-and-marlin", "uarm:///dev/ttyACM0", url, stage, tmp_path),
            changes=changes,
            without=without,
        )
        kinds = [kind for kind, _ in said]
        assert kinds == [
            kind for kind in ("stop", "home", "plane", "follow", "pick") if kind != without
        ]
        assert "9 of 9 places" in said[2][1]
        assert "1 picked and placed" in said[-1][1]
        sent = b"".join(event.data for event in emulator.wire if not event.sent).decode("ascii")
        strange = [one for one in sent.split("\n") if not re.fullmatch(WORDS[name], one)]
        assert strange == []


def test_the_so101s_page(film, tmp_path, monkeypatch):
    monkeypatch.setattr(guidance_scene, "ROBOT_ORIGIN_MM", np.array([-15.0, 213.0, 0.0]))
    with so101_rig.so101_rig(tmp_path, home=False, time_scale=1.0) as rig:
        stage = Stage(rig.true_m, film)
        device = "so101:///dev/ttyACM0?calibration=arm.json"
        # The servos share this process's interpreter with the cameras.
        port = f"so101://{rig.emulator.address}?calibration=arm.json&reply_s=1"
        said = go_through("so101", device, port, stage, tmp_path, without="follow")
        assert [kind for kind, _ in said] == ["home", "plane", "pick"]
        assert said[0][1].startswith("x 0.2104 m")
        assert "9 of 9 places" in said[1][1]
        assert "1 picked and placed" in said[2][1]


def test_the_page_of_ros(film, tmp_path):
    with rosbridge_rig.rosbridge_rig(home=False, time_scale=1.0) as rig:
        stage = Stage(rig.true_m, film)
        device = "rosbridge://10.0.0.5:9090?frame=base_link"
        services = "&".join(f"{key}={value}" for key, value in rosbridge_rig.GRIPPER.items())
        # On a busy machine a pose may be older than half a second.
        port = f"rosbridge://{rig.emulator.address}?frame=base_link&{services}&max_age_s=5"
        said = go_through("ros", device, port, stage, tmp_path, without="follow")
        assert [kind for kind, _ in said] == ["home", "plane", "pick"]
        assert said[0][1].startswith("x 0.3000 m")
        assert "9 of 9 places" in said[1][1]
        assert "1 picked and placed" in said[2][1]


@pytest.fixture
def stand_ins(monkeypatch):
    """Replace the vendors' libraries by stand-ins in processes that are started from now on."""
    folder = str(Path(__file__).parent / "stand_ins")
    paths = [folder, *filter(None, [os.environ.get("PYTHONPATH")])]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(paths))


def test_the_urs_page(film, tmp_path, monkeypatch, stand_ins):
    controller = UrController(patience=20.0)
    with serve(controller) as port:
        monkeypatch.setenv("FINGERPOST_TEST_UR_PORT", str(port))
        stage = Stage(controller.arm.position, film)
        said = go_through(
            *("ur", "ur://192.168.0.10", "ur://127.0.0.1", stage, tmp_path), without="follow"
        )
        assert [kind for kind, _ in said] == ["home", "plane", "pick"]
        assert said[0][1].splitlines()[-1].startswith("x 0.3000 m")
        assert "9 of 9 places" in said[1][1]
        assert "1 picked and placed" in said[2][1]
        assert set(controller.outputs) == {0}
        end_s = time.monotonic() + 5.0
        while controller.program is not Program.STOPPED:  # until the watchdog has ended the program
            assert time.monotonic() < end_s
            controller.look()


def test_the_xarms_page(film, tmp_path, monkeypatch, stand_ins):
    pytest.importorskip("xarm")
    with ControlBox() as box:
        monkeypatch.setenv("FINGERPOST_TEST_XARM_PORTS", ",".join(map(str, box.ports)))
        stage = Stage(box.arm.position, film)
        said = go_through(
            *("xarm", "xarm://192.168.1.200", "xarm://127.0.0.1", stage, tmp_path),
            without="follow",
        )
        assert [kind for kind, _ in said] == ["home", "plane", "pick"]
        assert said[0][1].startswith("x 0.3000 m")  # and no output of the library
        assert "9 of 9 places" in said[1][1]
        assert "1 picked and placed" in said[2][1]
        assert box.gripper.position() == 850
