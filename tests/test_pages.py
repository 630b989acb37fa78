"""Every command in README and docs/ exists, and the tutorials run."""

import re
import shlex
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from fingerpost.cli import main
from fingerpost.simulate import DevicePose, SimulatedRig, Trajectory, write_recording

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
TUTORIALS = [page for page in PAGES if "run as they stand" in page.read_text(encoding="utf-8")]
COMMAND = re.compile(r"^(?:    )?(?:[^|\n`]*\| *)?(fingerpost [^#|\n]*)", re.MULTILINE)


def fenced(page: Path) -> list[tuple[str, str]]:
    """Language and content of every block between fences."""
    text = page.read_text(encoding="utf-8")
    return re.findall(r"^```(\w*)\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)


def commands(page: Path) -> list[str]:
    """Lines of a page's blocks that call the program or pipe into it."""
    shell = "".join(block for language, block in fenced(page) if language in {"", "sh", "text"})
    indented = re.findall(r"^    .*\n", page.read_text(encoding="utf-8"), re.MULTILINE)
    text = re.sub(r"\\\n\s*", "", shell + "".join(indented))
    return [line.strip() for line in COMMAND.findall(text)]


def parse_words(group: click.Group, words: list[str], path: str) -> None:
    """Parse the words as the program does, command by command, without running anything."""
    with group.make_context(path, list(words), resilient_parsing=False) as context:
        name, command, rest = group.resolve_command(context, context._protected_args + context.args)
        assert name is not None
        assert command is not None
        if isinstance(command, click.Group):
            parse_words(command, rest, f"{path} {name}")
        else:
            command.make_parser(click.Context(command, info_name=name)).parse_args(list(rest))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_command_of_a_page_parses(page):
    for line in commands(page):
        words = [word for word in shlex.split(line)[1:] if word not in {"...", "…", "\\"}]
        if words and words != ["--version"]:
            try:
                parse_words(main, words, "fingerpost")
            except click.ClickException as error:
                pytest.fail(f"{line}: {error.format_message()}")


def test_commands_are_extracted_and_wrong_ones_refused():
    assert len(commands(ROOT / "README.md")) >= 10
    assert any(line.startswith("fingerpost run") for line in commands(ROOT / "docs" / "cameras.md"))
    with pytest.raises(click.ClickException):
        parse_words(main, ["run", "rig.toml", "--point", "x"], "fingerpost")
    with pytest.raises(click.ClickException):
        parse_words(main, ["robot", "fly"], "fingerpost")


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pose = DevicePose.pointing_at((200.0, 180.0), azimuth_deg=20.0, slant_deg=50.0, hover_mm=120.0)
    folder = tmp_path_factory.mktemp("recording")
    hold = Trajectory.hold(pose, 1.0)
    return write_recording(folder, SimulatedRig(), hold, frames=24, rng=3, picture_format="mp4")


@pytest.mark.parametrize("page", TUTORIALS, ids=lambda page: page.stem)
def test_the_tutorials_run(page, recording, tmp_path, monkeypatch, capsys):
    for file in recording.parent.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    monkeypatch.chdir(tmp_path)
    for language, block in fenced(page):
        if language == "toml":
            with (tmp_path / "rig.toml").open("a", encoding="utf-8") as rig:
                rig.write(f"\n{block}")
        elif language == "python":
            exec(compile(block, page.name, "exec"), {})
            assert "cup" in capsys.readouterr().out
        elif language == "sh":
            for line in block.splitlines():
                done = CliRunner().invoke(main, shlex.split(line)[1:])
                assert done.exit_code == 0, f"{line}: {done.output}"
    if page.stem == "recordings":
        assert Path("points.csv").read_text() == Path("again.csv").read_text()
        assert Path("found.csv").read_text() == Path("points.csv").read_text()
        assert len(list(Path("results").rglob("points.csv"))) == 2
    else:
        assert '"select"' in Path("events.jsonl").read_text()


def test_the_program_of_two_webcams_prints_points(recording, monkeypatch, capsys):
    """The commands of that page need cameras."""
    monkeypatch.chdir(recording.parent)
    blocks = fenced(ROOT / "docs/tutorials/two-webcams.md")
    (program,) = [block for language, block in blocks if language == "python"]
    exec(compile(program, "two-webcams.md", "exec"), {})
    assert "Ellipse(" in capsys.readouterr().out


def test_there_are_tutorials_to_run():
    assert {page.stem for page in TUTORIALS} == {"recordings", "targets"}
