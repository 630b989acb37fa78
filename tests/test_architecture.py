"""Imports run one way: the rules of ARCHITECTURE, as data, and the checks that hold them.

A module that stands in no table fails: whoever adds one says where it belongs.
"""

import ast
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

# --- the rules -------------------------------------------------------------------------------

# Every module or subpackage of python/fingerpost, and the group it belongs to. A subpackage's own
# modules import each other as they like.
PYTHON_GROUPS = {
    "errors": "errors",
    "checks": "checks",
    "homography": "geometry",
    "lens": "geometry",
    "silhouette": "geometry",
    "lines": "geometry",
    "uncertainty": "geometry",
    "pointing": "pointing",
    "references": "references",
    "capture": "capture",
    "simulate": "simulate",
    "recording": "recording",
    "robot": "robot",
    "config": "config",
    "admission": "pipeline",
    "consistency": "pipeline",
    "finding": "pipeline",
    "pipeline": "pipeline",
    "experiment": "application",
    "guidance": "application",
    "live": "application",
    "closed_loop": "application",
    "advise": "application",
    "demo": "application",
    "doctor": "application",
    "rehearsal": "application",
    "workers": "application",
    "installation": "checks",
    "signals": "errors",
    "rig_text": "checks",
    "cli": "cli",
    "__main__": "cli",
    "_core": "core",
    "__init__": "front",
}

_BASE = {"errors", "checks"}
_GEOMETRY = _BASE | {"geometry"}
_POINTING = _GEOMETRY | {"pointing", "core"}
_EDGES = {"references", "capture", "simulate", "recording", "robot"}
_PIPELINE = _POINTING | _EDGES | {"config", "pipeline"}

# What each group may import of the others. The edges never import each other, and nobody but the
# command line itself imports it.
PYTHON_RULES = {
    "errors": set(),
    "checks": {"errors"},
    "geometry": _GEOMETRY,
    "pointing": _GEOMETRY | {"core"},
    **dict.fromkeys(_EDGES, _POINTING),
    "config": _GEOMETRY | {"capture"},
    "pipeline": _PIPELINE,
    "application": _PIPELINE | {"application"},
    "cli": _PIPELINE | {"application", "cli", "front"},
    "core": {"errors"},
    "front": _PIPELINE | {"application"},
}

# Packages from outside the standard library that a group may use at all; others are free.
THIRD_PARTY_RULES = {
    "errors": set(),
    "checks": {"numpy"},
    "geometry": {"numpy"},
    "pointing": {"numpy"},
}

# What each module of fingerpost-core may import of the others: shapes never see a pixel, pixels
# never see a shape, and the fit sees measurements alone. Lanes of numbers are nobody's business but
# their own.
_SHAPES = {"error", "bspline", "contour", "template", "shape_space"}
_PIXELS = {"error", "image", "frame", "appearance", "discriminant"}
_LANES = {"simd", "logarithm"}
RUST_RULES = {
    "error": set(),
    "simd": set(),
    "logarithm": set(),
    "image": {"error"},
    "frame": {"error", "image"},
    "appearance": {"error", "image", "frame"} | _LANES,
    "discriminant": {"error", "image", "frame"},
    "background": {"error", "image", "frame", "simd"},
    "candidates": {"error", "image", "frame", "background", "template"},
    "bspline": {"error"},
    "contour": {"error", "bspline"},
    "template": {"error", "bspline", "contour"},
    "shape_space": _SHAPES,
    "fit": _SHAPES | {"simd"},
    "dynamics": _SHAPES,
    "search": _SHAPES | _PIXELS | _LANES,
    "refine": _SHAPES | _PIXELS | {"fit", "search", "simd", "background"},
    "tracker": _SHAPES | _PIXELS | {"fit", "dynamics", "search", "refine", "background", "simd"},
    "views": {"error", "frame", "tracker", "background"},
}

# What the core must do without, so that it can be embedded anywhere.
FOREIGN_TO_THE_CORE = {"pyo3", "numpy"}

# --- where things are ------------------------------------------------------------------------

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "python" / "fingerpost"
CORE = ROOT / "crates" / "fingerpost-core"


def python_modules() -> dict[str, Path]:
    """Dotted name below `fingerpost` and file of every module; the front is `__init__`."""
    modules = {}
    for path in sorted([*PACKAGE.rglob("*.py"), *PACKAGE.glob("*.pyi")]):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        modules[".".join(parts[:-1] if parts[1:] and parts[-1] == "__init__" else parts)] = path
    return modules


def imported(source: str, module: str, *, is_package: bool) -> Iterator[str]:
    """Absolute names that a module imports: modules, or names in modules."""
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
    """Every pair of a module and a name that it imports."""
    for module, path in python_modules().items():
        for name in imported(path.read_text(), module, is_package=path.stem == "__init__"):
            yield module, name


def group_of(name: str) -> str:
    """Group of a dotted name of this project; a name that is no module belongs to the front."""
    return PYTHON_GROUPS.get((name + ".").split(".")[1], "front")


def may_import(module: str, name: str) -> bool:
    """Tell whether the rules let a module of this project import a name."""
    if name.partition(".")[0] != "fingerpost":
        return True
    same_package = module.split(".")[1] == (name + ".").split(".")[1]
    return same_package or group_of(name) in PYTHON_RULES[group_of(module)]


def rust_imports(source: str, exports: dict[str, str]) -> set[str]:
    """Modules of the crate that a file uses outside its tests; `exports` are the root's names."""
    code = re.sub(r"//[^\n]*", "", source).partition("#[cfg(test)]")[0]
    names = set()
    for match in re.finditer(r"\bcrate::", code):
        rest = code[match.end() :]
        heads = _heads(rest) if rest.startswith("{") else re.findall(r"^\w+", rest)
        names.update(heads)
    return {exports.get(name, name) for name in names}


def _heads(group: str) -> list[str]:
    """First names of the paths in `{a::b, c::{d, e}, F}`."""
    depth, heads, expect = 0, [], False
    for token in re.findall(r"\w+|::|[{},]", group):
        if token == "{":
            depth += 1
            expect = depth == 1
        elif token == "}":
            depth -= 1
            if depth == 0:
                break
        elif token == ",":
            expect = depth == 1
        elif token != "::" and expect:
            heads.append(token)
            expect = False
    return heads


def root_exports() -> dict[str, str]:
    """Names that the crate's root hands on, and the module each comes from."""
    source = (CORE / "src" / "lib.rs").read_text()
    exports = {}
    for module, names in re.findall(r"^pub use (\w+)::(\{[^}]*\}|\w+);", source, re.MULTILINE):
        exports.update(dict.fromkeys(re.findall(r"\w+", names), module))
    return exports


# --- the checks ------------------------------------------------------------------------------


def test_every_python_module_has_its_place():
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


def test_geometry_needs_numpy_alone():
    at_home = {"fingerpost", *sys.stdlib_module_names}
    for module, name in python_imports():
        group = group_of(f"fingerpost.{module}")
        package = name.partition(".")[0]
        if group in THIRD_PARTY_RULES and package not in at_home:
            assert package in THIRD_PARTY_RULES[group], f"{module} must do without {name}"


def test_rust_imports_run_one_way():
    exports = root_exports()
    files = [path for path in (CORE / "src").rglob("*.rs") if path.name != "lib.rs"]
    assert files
    for path in files:
        module = path.relative_to(CORE / "src").with_suffix("").parts[0]
        assert module in RUST_RULES, f"say in RUST_RULES where {module} belongs"
        wrong = rust_imports(path.read_text(), exports) - RUST_RULES[module] - {module}
        assert not wrong, f"{path.name} must not use {', '.join(sorted(wrong))}"
    modules = {path.relative_to(CORE / "src").with_suffix("").parts[0] for path in files}
    assert set(RUST_RULES) - modules == set(), "RUST_RULES names a module that does not exist"


def test_the_core_depends_on_no_python():
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
def test_python_imports_are_seen(source, names):
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
def test_the_rules_decide(module, name, allowed):
    assert may_import(f"fingerpost.{module}", f"fingerpost.{name}") is allowed
    assert may_import(f"fingerpost.{module}", "numpy.typing")


@pytest.mark.parametrize(
    ("source", "modules"),
    [
        ("use crate::image::GrayView;", {"image"}),
        ("use crate::{Error, Result};", {"error"}),
        ("use crate::{fit::{self, Fitter}, search, image::GrayView};", {"fit", "search", "image"}),
        ("let x = crate::contour::sample(1);", {"contour"}),
        ("/// see [`crate::search`]\n// crate::fit\nfn f() {}", set()),
        ("fn f() {}\n#[cfg(test)]\nmod tests { use crate::image; }", set()),
        ("use crate::{\n    fit,\n    bspline::{BSpline, fit::Fit},\n};", {"fit", "bspline"}),
    ],
)
def test_rust_imports_are_seen(source, modules):
    assert rust_imports(source, {"Error": "error", "Result": "error"}) == modules
