"""Check of the installed dependencies, above all OpenCV.

OpenCV comes in four packages that write the same folder, `cv2`: with or without windows, each with
or without its extra modules. `pip` does not know this: it installs one over another, the last one
is in use, and removing any of them removes the folder. fingerpost requires one without windows,
which works on every machine, and accepts all four.
"""

from __future__ import annotations

import importlib
import importlib.util
import platform
import re
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from types import ModuleType
from typing import Any

from fingerpost.errors import FingerpostError, MissingExtraError

OPENCV_PACKAGES = (
    "opencv-contrib-python",
    "opencv-python",
    "opencv-contrib-python-headless",
    "opencv-python-headless",
)
"""The packages that write `cv2`, the most complete first."""

OPENCV_VERSIONS = ((4, 10), (6, 0))
"""The oldest version of OpenCV that works, and the first that is untested."""

_EXTRAS = {
    "cluster": "distributed",
    "mcap": "mcap",
    "mujoco": "mujoco",
    "net": "zenoh",
    "parquet": "pyarrow",
    "page": "uvicorn",
    "plot": "matplotlib",
    "ros": "websockets",
    "so101": "scservo_sdk",
    "ur": "rtde_control",
    "xarm": "xarm",
}


@dataclass(frozen=True, slots=True)
class OpenCv:
    """State of OpenCV as Python imports it.

    Attributes
    ----------
    version
        Its version, or empty where it cannot be imported.
    has_windows
        Whether it can show windows.
    error
        Why it cannot be imported; empty if it can.
    """

    version: str
    has_windows: bool
    error: str = ""


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault of an installation.

    Attributes
    ----------
    severity
        "error" if tracking is impossible, else "warning".
    what
        Description of the fault.
    right
        Remedy.
    """

    severity: str
    what: str
    right: str

    def __str__(self) -> str:
        return f"{self.severity}: {self.what}; {self.right}"


@dataclass(frozen=True, slots=True)
class Installation:
    """Installed software and its faults.

    Attributes
    ----------
    versions
        Versions of Python, the system and the relevant packages, by name.
    opencv
        State of OpenCV.
    extras
        Installed extras.
    findings
        Faults; empty if there are none.
    surroundings
        Results of other checks, such as that for cameras, by name.
    """

    versions: Mapping[str, str]
    opencv: OpenCv
    extras: tuple[str, ...]
    findings: tuple[Fault, ...]
    surroundings: Mapping[str, str] = field(default_factory=dict)

    @property
    def serious(self) -> bool:
        """Whether tracking is impossible with it."""
        return any(fault.severity == "error" for fault in self.findings)

    def table(self) -> list[str]:
        """Return everything as lines of text."""
        windows = "with windows" if self.opencv.has_windows else "without windows"
        used = f"{self.opencv.version}, {windows}" if self.opencv.version else "cannot be imported"
        rows = {**self.versions, "cv2": used, "extras": ", ".join(self.extras) or "none"}
        rows |= self.surroundings
        lines = [f"{name:<32}{value}" for name, value in rows.items()]
        return [*lines, "", *(map(str, self.findings) if self.findings else ["nothing is wrong"])]

    def as_dict(self) -> dict[str, Any]:
        """Return everything for JSON."""
        return {"serious": self.serious, **asdict(self)}


def examine_installation(surroundings: Mapping[str, str] | None = None) -> Installation:
    """Examine the installed packages, and report faults.

    Parameters
    ----------
    surroundings
        Results of other checks, by name; included unchanged.
    """
    versions = installed_versions()
    opencv = _read_opencv()
    packages = {name: versions[name] for name in OPENCV_PACKAGES if name in versions}
    findings = tuple(judge_opencv(opencv, packages))
    return Installation(versions, opencv, installed_extras(), findings, surroundings or {})


def installed_versions() -> dict[str, str]:
    """Return the versions of Python, the system and relevant packages, without importing any."""
    from importlib.metadata import distributions  # slow, and needed by few commands

    found = {
        name: distribution.version
        for distribution in distributions()
        if (name := _normalized(distribution.metadata["Name"] or ""))
        in {"fingerpost", "numpy", *OPENCV_PACKAGES}
    }
    # Python without a global interpreter lock is a separate build.
    unlocked = "" if getattr(sys, "_is_gil_enabled", lambda: True)() else ", free-threaded"
    python = f"{platform.python_version()} ({platform.python_implementation()}{unlocked})"
    return {"python": python, "system": platform.platform(), **dict(sorted(found.items()))}


def installed_extras() -> tuple[str, ...]:
    """Return the installed extras of this package without importing them."""
    return tuple(name for name, module in _EXTRAS.items() if importlib.util.find_spec(module))


def need_opencv() -> None:
    """Import OpenCV.

    Raises
    ------
    FingerpostError
        It cannot be imported, or is incomplete.
    """
    opencv = _read_opencv()
    if opencv.error:
        raise FingerpostError(
            f"OpenCV cannot be used: {opencv.error}; `fingerpost doctor` says what to do"
        )


def judge_opencv(opencv: OpenCv, packages: Mapping[str, str]) -> list[Fault]:
    """Return the faults of OpenCV.

    Parameters
    ----------
    opencv
        State of OpenCV.
    packages
        Versions of the packages of OpenCV that are installed, by name, in the order of
        `OPENCV_PACKAGES`.
    """
    shown = " and ".join(f"{name} {version}" for name, version in packages.items())
    least, limit = (".".join(map(str, version)) for version in OPENCV_VERSIONS)
    if opencv.error:
        what = f"OpenCV cannot be used: {opencv.error}"
        if len(packages) == 1:
            what += f", though {shown} is installed"
        # The packages with windows need system libraries, which a server may lack.
        needs_system = ".so" in opencv.error
        return [Fault("error", what, f"run {_install({} if needs_system else packages)}")]
    faults = []
    if not OPENCV_VERSIONS[0] <= _numbers(opencv.version) < OPENCV_VERSIONS[1]:
        what = f"OpenCV {opencv.version} is in use; from {least} to below {limit} is needed"
        faults.append(Fault("error", what, f"run {_install(packages)}"))
    elif len(packages) > 1:
        faults.append(_judge_several(opencv, packages, shown))
    return faults


def _judge_several(opencv: OpenCv, packages: Mapping[str, str], shown: str) -> Fault:
    what = f"{shown} are installed, and write the same folder cv2"
    again = f"run {_install(packages)}"
    if any(_shows_windows(name) for name in packages) and not opencv.has_windows:
        return Fault(
            "warning",
            f"{what}; the one in use has no windows, so that cv2.imshow fails in other programs",
            f"{again}, which fingerpost works with as well, "
            "or give fingerpost an environment of its own",
        )
    return Fault(
        "warning",
        what,
        f"fingerpost works with the one in use; to remove either removes that too: then {again}",
    )


def _install(packages: Mapping[str, str]) -> str:
    """Return the command by which the most complete installed package writes `cv2` again."""
    name, version = next(iter(packages.items()), ("opencv-python-headless", ""))
    if version and OPENCV_VERSIONS[0] <= _numbers(version) < OPENCV_VERSIONS[1]:
        wanted = f"{name}=={version}"
    else:
        least, limit = (".".join(map(str, numbers)) for numbers in OPENCV_VERSIONS)
        wanted = f"'{name}>={least},<{limit}'"
    return f"`pip install --force-reinstall --no-deps {wanted}`"


def _shows_windows(package: str) -> bool:
    return not package.endswith("-headless")


def _read_opencv() -> OpenCv:
    try:
        cv2 = importlib.import_module("cv2")
        build = cv2.getBuildInformation()
    except ImportError as error:
        return OpenCv("", has_windows=False, error=str(error))
    except AttributeError:  # Python imports any folder of that name as a package
        return OpenCv("", has_windows=False, error="the folder cv2 is there, but OpenCV is not")
    toolkit = re.search(r"^\s*GUI:\s*(\S+)", build, re.MULTILINE)
    has_windows = toolkit is not None and toolkit[1] != "NONE"
    return OpenCv(str(cv2.__version__), has_windows)


def _normalized(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def _numbers(version: str) -> tuple[int, int]:
    """Return the first two numbers of a version; a missing one is 0."""
    major, minor, *_ = (*map(int, re.findall(r"\d+", version)), 0, 0)
    return major, minor


def require(module: str, extra: str) -> ModuleType:
    """Import a module that an extra of this package provides.

    Parameters
    ----------
    module
        Name of the module.
    extra
        Name of the extra.

    Raises
    ------
    MissingExtraError
        It is not installed, or cannot be imported; the message contains the reason and the command
        that installs it.
    """
    try:
        return importlib.import_module(module)
    except Exception as error:
        command = f"pip install 'fingerpost[{extra}]'"
        name = getattr(error, "name", None)
        if isinstance(error, ModuleNotFoundError) and f"{module}.".startswith(f"{name}."):
            problem = f"is not installed; install it with: {command}"
        else:
            problem = (
                f"cannot be imported ({type(error).__name__}: {error}); see to that, or install it "
                f"anew with: {command} --force-reinstall"
            )
        raise MissingExtraError(f"{module} {problem}") from error
