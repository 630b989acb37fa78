"""Parts of a release: its notes, and the tests of the installed package."""

import runpy
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
notes = runpy.run_path(str(ROOT / ".github" / "release_notes.py"))["notes"]

CHANGELOG = """# Changelog

## [Unreleased]

## [1.10.0] - 2027-01-02

### Added

- A thing. See [0.1].

## [1.1.0]

- The first.
"""


def test_the_notes_of_a_release_are_its_section():
    assert notes("1.10.0", CHANGELOG) == "### Added\n\n- A thing. See [0.1].\n"
    assert notes("1.1.0", CHANGELOG) == "- The first.\n"


@pytest.mark.parametrize("version", ["Unreleased", "1.1", "1x10.0", "2.0.0"])
def test_a_version_without_notes_is_refused(version):
    with pytest.raises(ValueError, match=r"no section \["):
        notes(version, CHANGELOG)


def test_our_own_changelog_has_notes_for_the_next_release():
    assert notes("Unreleased", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"))


def test_every_test_of_the_installed_package_exists():
    for name in (ROOT / "tests" / "installed.txt").read_text(encoding="utf-8").split():
        assert (ROOT / name).is_file(), name
