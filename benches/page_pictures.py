"""Takes screenshots of the operator's page in every step and mode, as docs/page.md shows them.

    python benches/page_pictures.py docs
    python benches/page_pictures.py FOLDER --all

Plays the built-in clip in headless Chromium (Debian's; driven by Playwright). With --all: every
step and mode at three sizes, light and dark, unreduced. Without: those of the documentation, small.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
from playwright.sync_api import Page, sync_playwright

CLIP = Path(__file__).parents[1] / "python" / "fingerpost" / "data" / "desk"
SIZES = {"phone": (390, 844), "desk": (1280, 800), "wall": (2560, 1440)}
DOCUMENTED = ("desk", "dark")
DOCUMENTED_WIDTH_PX, DOCUMENTED_BITS = 860, 5  # for less than 150 kB each
PATIENCE_MS = 120_000
SHOWN_FRAME = 55


@contextmanager
def served(folder: Path, *arguments: str) -> Iterator[str]:
    """Run `fingerpost live` in a folder; yield the address of its page."""
    command = [sys.executable, "-u", "-m", "fingerpost", "live", *arguments]
    process = subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        yield process.stdout.readline().strip()
    finally:
        process.terminate()
        process.wait()


def until(page: Page, condition: str) -> None:
    """Poll an expression until it is true: the page's policy forbids the evaluation of strings."""
    for _ in range(PATIENCE_MS // 50):
        if page.evaluate(f"() => Boolean({condition})"):
            return
        page.wait_for_timeout(50)
    raise TimeoutError(condition)


def at_rest(page: Page) -> None:
    """Wait until the program has no work left for the page."""
    until(page, "document.querySelector('#doing').textContent.startsWith('rig.toml goes')")


def steps(page: Page, shoot: Callable[[str], None]) -> None:
    """Take the steps of the set-up."""
    page.wait_for_selector(".step[aria-current=step]")
    at_rest(page)
    page.click(".step >> nth=0")
    until(page, "document.querySelectorAll('.offer img').length == 2")
    at_rest(page)
    shoot("views")
    page.click(".step >> nth=1")
    shoot("table")
    page.click(".step >> nth=2")
    until(page, "document.querySelector('#words').textContent.startsWith('the hand is found')")
    at_rest(page)
    shoot("hand")
    page.click("text=Hold it up")
    at_rest(page)
    shoot("template")
    page.click("text=Hold it up")
    at_rest(page)
    page.click(".step >> nth=3")
    page.click("text=Begin >> visible=true >> nth=0")
    until(page, "document.querySelector('.aim-point')")
    shoot("aim")
    page.keyboard.press("Escape")
    at_rest(page)
    page.click(".step >> nth=4")
    shoot("save")


def live(page: Page, shoot: Callable[[str], None]) -> None:
    """Show one frame of the live page: all views, edges, large, the keys."""
    until(page, "document.querySelector('.view canvas')?.width > 300")
    page.keyboard.press(" ")
    page.evaluate(
        "(frame) => { const scrub = document.querySelector('#scrub'); scrub.value = frame;"
        " scrub.dispatchEvent(new Event('input')); }",
        SHOWN_FRAME,
    )
    until(page, f"document.querySelector('#clock').textContent.endsWith('frame {SHOWN_FRAME}')")
    shoot("live")
    page.keyboard.press("e")
    page.keyboard.press("1")
    shoot("edges")
    page.keyboard.press("0")
    page.keyboard.press("e")
    page.keyboard.press("l")
    shoot("large")
    page.keyboard.press("l")
    page.keyboard.press("?")
    shoot("keys")


def keep_small(folder: Path) -> None:
    """Reduce the pictures of the documented size and scheme, and drop these from their names."""
    end = f"-{'-'.join(DOCUMENTED)}.png"
    for path in folder.glob(f"page-*{end}"):
        picture = cv2.imread(str(path))
        height, width = picture.shape[:2]
        size = DOCUMENTED_WIDTH_PX, height * DOCUMENTED_WIDTH_PX // width
        small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
        step = 256 >> DOCUMENTED_BITS
        few = np.minimum(small // step * step + step // 2, 255).astype(np.uint8)
        name = str(path).removesuffix(end) + ".png"
        cv2.imwrite(name, few, [cv2.IMWRITE_PNG_COMPRESSION, 9])
        path.unlink()


def take(folder: Path, sizes: list[str], schemes: list[str]) -> None:
    """Take all pictures of some sizes and schemes into a folder."""
    with sync_playwright() as driver:
        browser = driver.chromium.launch(
            executable_path=shutil.which("chromium"), args=["--no-sandbox"]
        )
        for size in sizes:
            for scheme in schemes:
                width, height = SIZES[size]
                for films, scenes in ((True, steps), (False, live)):
                    with tempfile.TemporaryDirectory() as made:
                        there = Path(made)
                        names = ["left.mp4", "right.mp4", "rig.toml"]
                        for name in names:
                            shutil.copy(CLIP / name, there)
                        given = names[:2] if films else names[2:]
                        page = browser.new_page(
                            viewport={"width": width, "height": height}, color_scheme=scheme
                        )
                        page.set_default_timeout(PATIENCE_MS)

                        def shoot(name: str, page: Page = page, end: str = f"{size}-{scheme}"):
                            page.wait_for_timeout(400)
                            page.screenshot(path=folder / f"page-{name}-{end}.png")

                        with served(there, *given) as address:
                            page.goto(address)
                            scenes(page, shoot)
                        page.close()
        browser.close()


if __name__ == "__main__":
    into = Path(sys.argv[1])
    into.mkdir(parents=True, exist_ok=True)
    if "--all" in sys.argv:
        take(into, list(SIZES), ["dark", "light"])
    else:
        take(into, [DOCUMENTED[0]], [DOCUMENTED[1]])
        keep_small(into)
