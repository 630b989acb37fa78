"""Imports run one way: the rules of ARCHITECTURE, as data, and their checks.

A module that is in no table fails: a new one must be assigned to a group.
"""

import ast
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from house import (
    CORE,
    circles,
    function_lengths,
    private_names,
    public_items,
    retired_words,
    rust_files,
    rust_imports,
    rust_paths,
    type_names,
)

# --- the rules -------------------------------------------------------------------------------

# Group of every module and subpackage of python/fingerpost. Modules inside a subpackage may import
# each other freely.
PYTHON_GROUPS = {
    "errors": "errors",
    "checks": "checks",
    "contours": "core",
    "homography": "geometry",
    "lens": "geometry",
    "silhouette": "geometry",
    "lines": "geometry",
    "habit": "geometry",
    "uncertainty": "geometry",
    "targets": "geometry",
    "pointing": "pointing",
    "references": "references",
    "capture": "capture",
    "simulate": "simulate",
    "recording": "recording",
    "robot": "robot",
    "publishing": "publishing",
    "config": "config",
    "admission": "pipeline",
    "consistency": "pipeline",
    "finding": "pipeline",
    "pipeline": "pipeline",
    "operators": "pipeline",
    "pushed": "pipeline",
    "selection": "pipeline",
    "experiment": "application",
    "guidance": "application",
    "live": "application",
    "calibration": "application",
    "closed_loop": "application",
    "advise": "application",
    "demo": "application",
    "doctor": "application",
    "simulated_rig_file": "application",
    "sync": "application",
    "setting_up": "application",
    "workers": "application",
    "cluster": "application",
    "batch": "application",
    "installation": "checks",
    "signals": "errors",
    "rig_text": "checks",
    "mcap_file": "mcap_file",
    "zenoh_link": "zenoh_link",
    "formats": "checks",
    "locating": "pipeline",
    "recognition": "application",
    "cli": "cli",
    "__main__": "cli",
    "_core": "core",
    "__init__": "front",
}

_BASE = {"errors", "checks"}
_GEOMETRY = _BASE | {"geometry"}
_POINTING = _GEOMETRY | {"pointing", "core"}
_EDGES = {"references", "capture", "simulate", "recording", "robot", "publishing"}
_FORMATS = {"mcap_file", "zenoh_link"}
_PIPELINE = _POINTING | _EDGES | _FORMATS | {"config", "pipeline"}

# Other groups that each group may import. The edges never import each other, and only the command
# line's own modules import it.
PYTHON_RULES = {
    "errors": set(),
    "checks": {"errors"},
    "geometry": _GEOMETRY,
    "pointing": _GEOMETRY | {"core"},
    "mcap_file": {"errors"},
    "zenoh_link": _BASE,
    **dict.fromkeys(_EDGES, _POINTING | _FORMATS),
    "config": _GEOMETRY | {"capture", "mcap_file"},
    "pipeline": _PIPELINE,
    "application": _PIPELINE | {"application"},
    "cli": _PIPELINE | {"application", "cli", "front"},
    "core": {"core", "errors"},
    "front": _PIPELINE | {"application"},
}

# The only third-party packages that these groups may use; other groups may use any.
THIRD_PARTY_RULES = {
    "errors": set(),
    "checks": {"numpy"},
    "geometry": {"numpy"},
    "pointing": {"numpy"},
}

# Other rooms that each room of fingerpost-core may import: `geometry` does not know images, `image`
# no shapes, and `solve` measurements only. Imports inside a room have no circles. `numeric` is
# independent.
RUST_RULES = {
    "error": set(),
    "numeric": set(),
    "geometry": {"error"},
    "image": {"error"},
    "appearance": {"error", "image", "numeric"},
    "detect": {"error", "image", "appearance", "geometry", "numeric"},
    "plane": {"error", "image", "numeric"},
    "solve": {"error", "geometry", "numeric"},
    "measure": {"error", "geometry", "image", "appearance", "numeric"},
    "axis": {"error", "geometry", "image", "appearance", "measure", "solve", "numeric"},
    "track": {"error", "geometry", "image", "appearance", "measure", "solve", "axis", "numeric"},
}

# Packages that the core must not depend on, so that it can be embedded anywhere.
FOREIGN_TO_THE_CORE = {"pyo3", "numpy"}

# --- modules and their imports ---------------------------------------------------------------

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "python" / "fingerpost"


def python_modules() -> dict[str, Path]:
    """Return the file of every module by its dotted name below `fingerpost`, and `__init__`."""
    modules = {}
    for path in sorted([*PACKAGE.rglob("*.py"), *PACKAGE.glob("*.pyi")]):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        modules[".".join(parts[:-1] if parts[1:] and parts[-1] == "__init__" else parts)] = path
    return modules


def imported(source: str, module: str, *, is_package: bool) -> Iterator[str]:
    """Yield the absolute names that a module imports: modules, or names in modules."""
    package = f"fingerpost.{module}".removesuffix(".__init__").split(".")
    if not is_package:
        package.pop()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) + 1 - node.level] if node.level else []
            base = [*base, *([node.module] if node.module else [])]
            yield from (".".join([*base, alias.name]) for alias in node.names)


def python_imports() -> Iterator[tuple[str, str]]:
    """Yield every pair of a module and a name that it imports."""
    for module, path in python_modules().items():
        for name in imported(path.read_text(), module, is_package=path.stem == "__init__"):
            yield module, name


def group_of(name: str) -> str:
    """Return the group of a dotted name of this project; names that are no module are `front`."""
    return PYTHON_GROUPS.get((name + ".").split(".")[1], "front")


def may_import(module: str, name: str) -> bool:
    """Return whether the rules let a module of this project import a name."""
    if name.partition(".")[0] != "fingerpost":
        return True
    same_package = module.split(".")[1] == (name + ".").split(".")[1]
    return same_package or group_of(name) in PYTHON_RULES[group_of(module)]


# --- the checks ------------------------------------------------------------------------------


def test_every_python_module_has_a_group():
    tops = {name.partition(".")[0] for name in python_modules()}
    assert tops - set(PYTHON_GROUPS) == set(), "say in PYTHON_GROUPS where it belongs"
    assert set(PYTHON_GROUPS) - tops == set(), "PYTHON_GROUPS names a module that does not exist"
    assert set(PYTHON_GROUPS.values()) == set(PYTHON_RULES)


def test_python_imports_run_one_way():
    wrong = [
        f"{module} ({group_of(f'fingerpost.{module}')}) must not import {name}"
        for module, name in python_imports()
        if not may_import(f"fingerpost.{module}", name)
    ]
    assert wrong == []


def test_geometry_needs_numpy_only():
    at_home = {"fingerpost", *sys.stdlib_module_names}
    for module, name in python_imports():
        group = group_of(f"fingerpost.{module}")
        package = name.partition(".")[0]
        if group in THIRD_PARTY_RULES and package not in at_home:
            assert package in THIRD_PARTY_RULES[group], f"{module} must do without {name}"


def test_rust_rooms_import_one_way():
    imports = rust_imports(rust_files())
    rooms = {module.partition("::")[0] for module in imports} - {"lib"}
    assert rooms - set(RUST_RULES) == set(), "say in RUST_RULES what the room may import"
    assert set(RUST_RULES) - rooms == set(), "RUST_RULES names a room that does not exist"
    for module, names in imports.items():
        room = module.partition("::")[0]
        if room != "lib":
            wrong = {name.partition("::")[0] for name in names} - RUST_RULES[room] - {room, "lib"}
            assert not wrong, f"{module} must not use {', '.join(sorted(wrong))}"


def test_no_files_of_the_core_import_each_other():
    assert circles(rust_imports(rust_files())) == []


def test_names_are_terms_of_the_field_and_unique():
    assert private_names() == []
    assert retired_words() == []
    assert [name for name, count in type_names().items() if count > 1] == []


def test_the_crate_exports_names_at_its_root_and_hides_its_rooms():
    assert 40 <= len(public_items()) <= 80
    assert len(set(public_items())) == len(public_items())
    crate = (CORE / "lib.rs").read_text(encoding="utf-8")
    shown = re.findall(r"(#\[doc\(hidden\)\]\n)?pub mod (\w+);", crate)
    assert {room for _, room in shown} == set(RUST_RULES) - {"error"}
    assert [room for hidden, room in shown if not hidden] == []


def test_the_crate_contains_the_licence_of_the_project():
    licences = [(folder / "LICENSE").read_text(encoding="utf-8") for folder in (ROOT, CORE.parent)]
    assert licences[0] == licences[1]


def test_files_and_functions_of_the_core_are_short():
    sizes = {name: len(path.read_text().splitlines()) for name, path in rust_files().items()}
    assert [name for name, size in sizes.items() if size > 600] == []
    lengths = function_lengths()
    assert lengths[0][0] <= 80, lengths[0]
    assert sorted(length for length, _ in lengths)[len(lengths) // 2] <= 8


def test_the_core_does_not_depend_on_python():
    cargo = shutil.which("cargo")
    if cargo is None:
        pytest.skip("needs cargo")
    command = [cargo, "tree", "--package", "fingerpost-core", "--edges", "no-dev"]
    command += ["--prefix", "none", "--format", "{p}", "--all-features", "--target", "all"]
    tree = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout
    crates = {line.split()[0] for line in tree.splitlines()}
    assert "nalgebra" in crates
    assert not [name for name in crates if name.partition("-")[0] in FOREIGN_TO_THE_CORE]


# --- the checks themselves -------------------------------------------------------------------


@pytest.mark.parametrize(
    ("source", "names"),
    [
        ("import cv2.aruco", {"cv2.aruco"}),
        ("def f():\n    import cv2", {"cv2"}),
        ("from fingerpost.lines import a, b", {"fingerpost.lines.a", "fingerpost.lines.b"}),
        ("from fingerpost import cli", {"fingerpost.cli"}),
        ("from . import views", {"fingerpost.capture.views"}),
        ("from .. import robot", {"fingerpost.robot"}),
        ("from ..robot.acl import Acl", {"fingerpost.robot.acl.Acl"}),
        ("from .live import x", {"fingerpost.capture.live.x"}),
    ],
)
def test_python_imports_are_parsed(source, names):
    assert set(imported(source, "capture.views", is_package=False)) == names
    assert set(imported(source, "capture", is_package=True)) == names


@pytest.mark.parametrize(
    ("module", "name", "allowed"),
    [
        ("robot.acl", "robot.errors.RobotError", True),
        ("robot.acl", "capture.open_source", False),
        ("robot.acl", "pointing.Fix", True),
        ("pointing", "robot.acl.Acl", False),
        ("lines", "homography", True),
        ("lines", "pointing.Fix", False),
        ("pipeline", "cli.main", False),
        ("pipeline", "__version__", False),
        ("cli", "__version__", True),
    ],
)
def test_the_rules_allow_and_refuse_imports(module, name, allowed):
    assert may_import(f"fingerpost.{module}", f"fingerpost.{name}") is allowed
    assert may_import(f"fingerpost.{module}", "numpy.typing")


@pytest.mark.parametrize(
    ("source", "paths"),
    [
        ("use crate::image::GrayView;", ["crate::image::GrayView"]),
        ("use super::{a::{B, c::D}, e};", ["super::a::B", "super::a::c::D", "super::e"]),
        ("let x = crate::contour::sample(1);", ["crate::contour::sample"]),
        ("/// see [`crate::search`]\n// crate::fit\nfn f() {}", []),
        ("fn f() {}\n#[cfg(test)]\nmod tests { use crate::image; }", []),
        ("use crate::{\n    fit,\n    b::{C},\n};", ["crate::fit", "crate::b::C"]),
    ],
)
def test_rust_paths_are_parsed(source, paths):
    assert ["::".join(path) for path in rust_paths(source)] == paths


def test_circles_are_detected():
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"a", "d"}, "d": set()}) == [["a", "b", "c"]]
    assert circles({"a": {"b"}, "b": set()}) == []
