"""Robots of other packages, installed like by a packaging tool, and their errors."""

import os
import subprocess
import sys

import pytest

from fingerpost.errors import InvalidInputError
from fingerpost.robot import open_robot, robot_names

WORKING = """
from fingerpost.robot.simulated import SimulatedRobot

def open_arm(address, options):
    return SimulatedRobot()
"""

BROKEN = {
    "missing": ("import no_such_library", "ModuleNotFoundError: No module named 'no_such_library'"),
    "syntax": ("def open_arm(:", "SyntaxError: invalid syntax"),
    "error": ("raise RuntimeError('no licence\\nfound')", "RuntimeError: no licence found"),
    "exits": ("raise SystemExit('bye')", "SystemExit: bye"),
    "name": ("open_hand = None", "AttributeError: module 'broken_package' has no attribute"),
}


def install(folder, name, text):
    """Install a package that adds a robot called `name`."""
    (folder / f"{name}_package.py").write_text(text)
    info = folder / f"{name}_package-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}-package\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        f"[fingerpost.robots]\n{name} = {name}_package:open_arm\n"
    )


@pytest.fixture
def site(tmp_path, monkeypatch):
    """A package folder on the path of this process and its subprocesses."""
    monkeypatch.syspath_prepend(tmp_path)
    paths = [str(tmp_path), *filter(None, [os.environ.get("PYTHONPATH")])]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(paths))
    yield tmp_path
    for module in ("broken_package", "working_package"):
        sys.modules.pop(module, None)


def run(*arguments):
    return subprocess.run(
        [sys.executable, "-m", "fingerpost", "robot", *arguments],
        capture_output=True,
        text=True,
        timeout=60,
    )


@pytest.mark.parametrize("kind", BROKEN)
def test_an_import_error_of_a_plug_in_is_reported_in_one_line(site, kind):
    text, why = BROKEN[kind]
    install(site, "broken", text)
    with pytest.raises(InvalidInputError) as caught:
        open_robot("broken://somewhere")
    message = str(caught.value)
    assert message.startswith(
        "the plug-in for 'broken' of the package broken-package, broken_package:open_arm, "
        "cannot be imported"
    )
    assert why in message
    assert "\n" not in message


def test_a_broken_plug_in_does_not_affect_the_others(site):
    install(site, "broken", "1 / 0")
    install(site, "working", WORKING)
    assert {"broken", "working", "sim"} <= set(robot_names())
    open_robot("working://")
    open_robot("sim://")
    with pytest.raises(InvalidInputError, match="there is no robot 'nobody'"):
        open_robot("nobody://")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("def open_arm(address, options):\n    return options['port']", "KeyError: 'port'"),
        ("def open_arm(address):\n    return None", "TypeError"),
        ("def open_arm(address, options):\n    return 1", "int, which is no Robot"),
        ("open_arm = 1", "not callable"),
    ],
)
def test_a_factory_error_of_a_plug_in_is_reported_in_one_line(site, text, words):
    install(site, "broken", text)
    with pytest.raises(InvalidInputError, match=words) as caught:
        open_robot("broken://somewhere")
    assert "the plug-in for 'broken'" in str(caught.value)


def test_the_command_line_reports_it_in_one_line_and_still_runs_others(site):
    install(site, "broken", "import no_such_library")
    failed = run("home", "broken://somewhere")
    assert failed.returncode == 2
    (line,) = failed.stderr.splitlines()
    assert "broken_package:open_arm" in line
    assert "No module named 'no_such_library'" in line
    assert run("home", "sim://?homing_s=0").returncode == 0
    assert run("list").returncode == 0
