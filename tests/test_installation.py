"""The installation: two OpenCV packages, broken ones, and ones that are too old."""

import json
import os
import platform
import re
import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import numpy
import pytest
from patience import PATIENCE_S

from fingerpost.installation import (
    OPENCV_PACKAGES,
    OPENCV_VERSIONS,
    OpenCv,
    examine_installation,
    judge_opencv,
)

ROOT = Path(__file__).resolve().parents[1]
REPAIR = "pip install --force-reinstall --no-deps"
CV2 = """
__version__ = "{version}"
def getBuildInformation():
    return "General configuration\\n\\n  GUI:                           {toolkit}\\n"
"""


@pytest.fixture
def site(tmp_path):
    """Function that puts packages into a folder, the first that Python then imports from."""

    def fill(packages: dict[str, str], cv2: str | None = None) -> Path:
        for name, version in packages.items():
            folder = tmp_path / f"{name.replace('-', '_')}-{version}.dist-info"
            folder.mkdir()
            (folder / "METADATA").write_text(
                f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n"
            )
        if cv2 is not None:
            (tmp_path / "cv2").mkdir()
            (tmp_path / "cv2" / "__init__.py").write_text(cv2)
        return tmp_path

    return fill


def fingerpost(site: Path, *arguments: str) -> tuple[int, str, str]:
    """Return exit code, stdout and stderr of a command that imports from the folder first."""
    path = os.pathsep.join([str(site), *sys.path])
    done = subprocess.run(
        [sys.executable, "-m", "fingerpost", *arguments],
        capture_output=True,
        text=True,
        env=os.environ | {"PYTHONPATH": path},
        timeout=PATIENCE_S,
        check=False,
    )
    return done.returncode, done.stdout, done.stderr


def test_an_installation_with_one_opencv_has_no_findings():
    code, said, error = fingerpost(ROOT, "doctor")
    assert (code, error) == (0, "")
    assert said.endswith("nothing is wrong\n")
    rows = dict(re.split(r"\s{2,}", line, maxsplit=1) for line in said.splitlines()[:-2])
    assert list(rows)[-3:] == ["extras", "cameras", "drawing"]
    assert {"python", "system", "numpy", "opencv-python-headless", "cv2"} < set(rows)
    assert rows["drawing"] in {"EGL", "by the system"} or "install it with: " in rows["drawing"]


def test_version_lists_packages_even_without_opencv(site):
    code, said, error = fingerpost(site({}, "raise ImportError('broken')"), "--version")
    assert (code, error) == (0, "")
    first, *others = said.splitlines()
    assert first == f"fingerpost {metadata.version('fingerpost')}"
    names = [line.partition(" ")[0] for line in others]
    assert names == ["python", "system", "numpy", "opencv-python-headless", "extras"]
    assert platform.python_version() in others[0]
    assert others[2] == f"numpy {numpy.__version__}"


@pytest.mark.parametrize(
    ("typed", "offered"),
    [
        ("ex", {"experiment", "export"}),
        ("experiment --dev", {"--device"}),
        ("live --ho", {"--host", "--homing-timeout"}),
    ],
)
def test_the_shell_completes_commands_and_options(typed, offered):
    words = f"fingerpost {typed}"
    program = "import sys; from fingerpost.__main__ import main; sys.argv = ['fingerpost']; main()"
    done = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True,
        text=True,
        env=os.environ
        | {
            "_FINGERPOST_COMPLETE": "bash_complete",
            "COMP_WORDS": words,
            "COMP_CWORD": str(words.count(" ")),
        },
        timeout=PATIENCE_S,
        check=False,
    )
    assert {line.partition(",")[2] for line in done.stdout.splitlines()} == offered


@pytest.mark.parametrize("name", ["opencv-python", "opencv_contrib_python"])
def test_a_second_package_that_removed_windows_is_found(site, name):
    code, said, _ = fingerpost(site({name: "4.11.0.86"}), "doctor")
    name = name.replace("_", "-")
    warning = said.splitlines()[-1]
    assert code == 0
    assert warning.startswith(f"warning: {name} 4.11.0.86 and opencv-python-headless ")
    assert "write the same folder cv2; the one in use has no windows" in warning
    assert f"run `{REPAIR} {name}==4.11.0.86`" in warning
    assert "environment of its own" in warning


def test_two_packages_are_reported_even_after_a_repair(site):
    cv2 = CV2.format(version="4.11.0", toolkit="QT5")
    code, said, _ = fingerpost(site({"opencv-python": "4.11.0.86"}, cv2), "doctor")
    assert code == 0
    assert "cv2                             4.11.0, with windows\n" in said
    assert "fingerpost works with the one in use; to remove either removes that too" in said
    assert "imshow" not in said


def test_an_opencv_too_old_to_reinstall_is_replaced_by_a_supported_version(site):
    cv2 = CV2.format(version="4.5.5", toolkit="GTK3")
    code, said, _ = fingerpost(site({"opencv-python": "4.5.5.64"}, cv2), "doctor")
    assert code == 1
    error = said.splitlines()[-1]
    assert error.startswith("error: OpenCV 4.5.5 is in use; from 4.10 to below 6.0 is needed; ")
    assert f"{REPAIR} 'opencv-python>=4.10,<6.0'" in error


LIBRARY = "libGL.so.1: cannot open shared object file: No such file or directory"


def test_an_opencv_that_lacks_a_system_library_is_replaced_by_the_headless_one(site):
    folder = site({"opencv-python": "4.11.0.86"}, f"raise ImportError({LIBRARY!r})")
    code, said, _ = fingerpost(folder, "doctor")
    assert code == 1
    error = said.splitlines()[-1]
    assert error.startswith(f"error: OpenCV cannot be used: {LIBRARY}")
    assert f"run `{REPAIR} 'opencv-python-headless>=4.10,<6.0'`" in error


@pytest.mark.parametrize(
    "command",
    [["run"], ["doctor"], ["advise"], ["experiment"], ["experiment", "--guidance", "1"], ["demo"]],
    ids=" ".join,
)
def test_without_opencv_commands_fail_in_one_line(site, tmp_path, command):
    folder = site({}, f"raise ImportError({LIBRARY!r})")
    rig = ["rig.toml"] if command[0] in {"run", "doctor", "advise"} else []
    assert fingerpost(folder, *command, *rig) == (
        1,
        "",
        f"fingerpost: OpenCV cannot be used: {LIBRARY}; `fingerpost doctor` says what to do\n",
    )


def test_an_empty_cv2_folder_is_reported(site):
    code, said, _ = fingerpost(site({"opencv-python": "4.11.0.86"}, ""), "doctor")
    assert code == 1
    assert "the folder cv2 is there, but OpenCV is not" in said


def test_a_package_removed_by_another_is_to_be_reinstalled():
    gone = OpenCv("", has_windows=False, error="No module named 'cv2'")
    (fault,) = judge_opencv(gone, {"opencv-python-headless": "4.12.0.88"})
    assert fault.severity == "error"
    assert "though opencv-python-headless 4.12.0.88 is installed" in fault.what
    assert fault.right == f"run `{REPAIR} opencv-python-headless==4.12.0.88`"
    (fault,) = judge_opencv(gone, {})
    assert fault.right == f"run `{REPAIR} 'opencv-python-headless>=4.10,<6.0'`"


def test_an_opencv_of_the_system_has_no_fault():
    assert judge_opencv(OpenCv("4.10.0", has_windows=True), {}) == []


def test_of_several_packages_the_most_complete_is_to_be_reinstalled():
    packages = dict.fromkeys(OPENCV_PACKAGES[:3], "4.11.0.86")
    (fault,) = judge_opencv(OpenCv("4.11.0", has_windows=False), packages)
    assert f"{REPAIR} opencv-contrib-python==4.11.0.86" in fault.right


def test_findings_are_printed_as_json(site):
    code, said, _ = fingerpost(site({"opencv-python": "4.11.0.86"}), "doctor", "--json")
    printed = json.loads(said)
    assert (code, printed["serious"]) == (0, False)
    assert printed["versions"]["opencv-python"] == "4.11.0.86"
    assert [finding["severity"] for finding in printed["findings"]] == ["warning"]
    assert examine_installation().as_dict()["opencv"] == printed["opencv"]


def test_the_frames_option_needs_a_rig_file():
    code, said, error = fingerpost(ROOT, "doctor", "--frames", "3")
    assert (code, said) == (2, "")
    assert "--frames goes with a rig file; name one" in error


def test_the_supported_versions_are_those_of_the_dependency():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    (wanted,) = [line for line in project["dependencies"] if "opencv" in line]
    (least, minor), (limit, _) = OPENCV_VERSIONS
    assert wanted == f"opencv-python-headless>={least}.{minor},<{limit}"
