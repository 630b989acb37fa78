"""Build the documentation site into site/: `python docs/build.py`, or `make docs`.

The pages of docs/ and those that stand elsewhere (README of the crate, ARCHITECTURE, CHANGELOG)
are laid together in build/docs. Links to sources lead to copies of these, the command line's
reference is asked of the commands, and Rust's is built by `cargo doc`. A warning, or a link that
leads nowhere, is an error. Needs the dependency group `docs`.
"""

from __future__ import annotations

import html.parser
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import unquote, urlsplit

import click

ROOT = Path(__file__).resolve().parents[1]
LAID, SITE = ROOT / "build" / "docs", ROOT / "site"
PAGES_ELSEWHERE = (
    "ARCHITECTURE.md",
    "BENCHMARKS.md",
    "CHANGELOG.md",
    "CONTRIBUTING.md",
    "crates/fingerpost-core/README.md",
    "examples/README.md",
)
LINK = re.compile(r"(\]\()([^)#:\s]+)((?:#[^)]*)?\))")


def main() -> int:
    """Build the site; return 1 if a link leads nowhere."""
    shutil.rmtree(LAID, ignore_errors=True)
    shutil.rmtree(SITE, ignore_errors=True)
    lay_pages()
    write_command_line(LAID / "api" / "command-line.md")
    (LAID / "api" / "rust.md").write_text(RUST, encoding="utf-8")
    subprocess.run([sys.executable, "-m", "zensical", "build", "--strict"], cwd=ROOT, check=True)
    build_rust()
    lost = sorted(lost_links())
    for page, link in lost:
        sys.stderr.write(f"{page.relative_to(SITE)}: {link} leads nowhere\n")
    return 1 if lost else 0


def lay_pages() -> None:
    """Copy every page to its place, with links that hold there."""
    pages = {path: path.relative_to(ROOT / "docs") for path in (ROOT / "docs").rglob("*.md")}
    pages |= {ROOT / name: Path(name) for name in PAGES_ELSEWHERE}
    for picture in (ROOT / "docs").rglob("*.png"):
        _copy(picture, LAID / picture.relative_to(ROOT / "docs"))
    for page, place in pages.items():
        text = page.read_text(encoding="utf-8")
        laid = LINK.sub(lambda m, here=page: f"{m[1]}{_led(m[2], here, pages)}{m[3]}", text)
        (LAID / place).parent.mkdir(parents=True, exist_ok=True)
        (LAID / place).write_text(laid, encoding="utf-8")


def _led(link: str, page: Path, pages: dict[Path, Path]) -> str:
    """Return where a page's link leads once all are laid; sources it leads to are copied."""
    up = "../" * (len(pages[page].parts) - 1)
    target = (page.parent / link).resolve()
    if target in pages:
        return up + pages[target].as_posix()
    inside = target.relative_to(ROOT)
    if inside == Path("README.md"):
        return f"{up}index.md"
    if inside.parts[0] == "docs" and target.is_file():
        return up + inside.relative_to("docs").as_posix()
    if target.is_dir():
        listing = "\n".join(sorted(path.name for path in target.iterdir()))
        name = LAID / "source" / inside / "files.txt"
        name.parent.mkdir(parents=True, exist_ok=True)
        name.write_text(listing + "\n", encoding="utf-8")
        return f"{up}source/{inside.as_posix()}/files.txt"
    # As text, so that browsers show it.
    _copy(target, LAID / "source" / f"{inside.as_posix()}.txt")
    return f"{up}source/{inside.as_posix()}.txt"


def _copy(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(source, target)


def write_command_line(page: Path) -> None:
    """Write what `--help` says of every command."""
    from fingerpost.cli import main as commands

    text = ["# The command line\n", SHELL]
    for path, command in _commands(commands, "fingerpost"):
        context = click.Context(command, info_name=path, max_content_width=96)
        text.append(f"## {path}\n\n```text\n{command.get_help(context)}\n```\n")
    page.parent.mkdir(parents=True, exist_ok=True)
    page.write_text("\n".join(text), encoding="utf-8")


SHELL = """Exit codes: 0 done, 1 failed while running, 2 bad usage or bad input, 130 stopped by
Ctrl-C. Results go to stdout or files, everything else to stderr.

The shell completes commands and options once it knows them; in `~/.bashrc`, `~/.zshrc` or
`~/.config/fish/completions/fingerpost.fish`:

    eval "$(_FINGERPOST_COMPLETE=bash_source fingerpost)"
    eval "$(_FINGERPOST_COMPLETE=zsh_source fingerpost)"
    _FINGERPOST_COMPLETE=fish_source fingerpost | source
"""


RUST = """# Rust

[The reference of `fingerpost-core`](../rust/fingerpost_core/index.html) is built from its sources;
[its README](../crates/fingerpost-core/README.md) is where to begin.
"""


def _commands(command: click.Command, path: str) -> Iterator[tuple[str, click.Command]]:
    yield path, command
    if isinstance(command, click.Group):
        for name, inner in sorted(command.commands.items()):
            yield from _commands(inner, f"{path} {name}")


def build_rust() -> None:
    """Build the crate's reference beside the pages."""
    target = ROOT / "build" / "rust"
    command = ["cargo", "doc", "--locked", "--quiet", "--no-deps", "--package", "fingerpost-core"]
    subprocess.run([*command, "--target-dir", str(target)], cwd=ROOT, check=True)
    shutil.copytree(target / "doc", SITE / "rust")


class _Links(html.parser.HTMLParser):
    """Collects where a page leads, and its anchors."""

    def __init__(self) -> None:
        super().__init__()
        self.links: set[str] = set()
        self.anchors: set[str] = set()

    def handle_starttag(self, _tag: str, attributes: list[tuple[str, str | None]]) -> None:
        for name, value in attributes:
            if name in {"href", "src"} and value:
                self.links.add(value)
            elif name in {"id", "name"} and value:
                self.anchors.add(value)


def lost_links() -> Iterator[tuple[Path, str]]:
    """Find links within the site, from our own pages, to a file or an anchor that is not there."""
    pages: dict[Path, _Links] = {}
    for page in SITE.rglob("*.html"):
        pages[page] = _Links()
        pages[page].feed(page.read_text(encoding="utf-8"))
    for page, found in pages.items():
        if page.is_relative_to(SITE / "rust") or page.name == "404.html":
            continue
        for link in found.links:
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                continue
            target = (page.parent / unquote(parts.path)).resolve() if parts.path else page
            target = target / "index.html" if target.is_dir() else target
            anchors = pages[target].anchors if target in pages else None
            if not target.exists() or (
                parts.fragment and anchors is not None and unquote(parts.fragment) not in anchors
            ):
                yield page, link


if __name__ == "__main__":
    sys.exit(main())
