"""The pages of docs/ speak of everything that there is."""

import re
import shlex
from pathlib import Path

import click
import msgspec
import pytest

from fingerpost.cli import main
from fingerpost.config import Rig, rig_tables

DOCS = Path(__file__).resolve().parents[1] / "docs"


@pytest.mark.parametrize(("table", "kind"), rig_tables().items())
def test_every_key_of_a_rig_file_is_on_its_page(table, kind):
    page = "".join((DOCS / name).read_text(encoding="utf-8") for name in ("rig.md", "cameras.md"))
    documented = set(re.findall(r"`(?:\[+)?([\w.]+)(?:\]+)?`", page))
    for field in msgspec.structs.fields(kind):
        assert {field.encode_name, f"{table}.{field.encode_name}"} & documented, field.encode_name


def test_every_line_of_the_page_that_is_toml_is_read(tmp_path):
    page = (DOCS / "rig.md").read_text(encoding="utf-8")
    lines = [line.strip() for line in page.splitlines() if re.match(r"    (\w+ = |\[\[)", line)]
    assert len(lines) >= 6
    (tmp_path / "rig.toml").write_text(
        '[plane]\nunit = "mm"\npoints = [[0, 0], [400, 0], [400, 400], [0, 400]]\n'
        '[[view]]\nname = "left"\nsource = 0\n'
        "reference_points_px = [[234, 452], [567, 359], [422, 161], [126, 231]]\n"
        + "\n".join(lines),
        encoding="utf-8",
    )
    rig = Rig.load(tmp_path / "rig.toml")
    assert rig.views[0].lens is not None
    assert [target.name for target in rig.targets] == ["cup"]


def test_no_page_links_to_one_that_is_not_there():
    for page in [*DOCS.rglob("*.md"), DOCS.parent / "README.md"]:
        for link in re.findall(r"\]\(([^)#:\s]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
            assert (page.parent / link).exists(), f"{page}: {link}"


def commands(page: str) -> list[list[str]]:
    """Every command line of fingerpost that a page shows, as its words."""
    text = (DOCS / page).read_text(encoding="utf-8")
    lines = re.findall(r"^    fingerpost (.*)$", text, re.MULTILINE)
    return [shlex.split(line, comments=True) for line in lines]


@pytest.mark.parametrize("page", ["publishing.md", "recordings.md", "cameras.md"])
def test_the_commands_of_a_page_are_understood(page):
    assert commands(page)
    for name, *words in commands(page):
        command = main.get_command(click.Context(main), name)
        assert command is not None, name
        command.make_context(name, words)  # parses, and does nothing
