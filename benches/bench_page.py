"""Cost of the operator's page: latency of fixes and pictures, with and without clients.

    python benches/bench_page.py [seconds]           # fixes, processor and memory, by clients
    python benches/bench_page.py --glass [seconds]   # from a frame to the page's canvas
    python benches/bench_page.py --memory [seconds]  # memory of both processes, over time
    python benches/bench_page.py --trial             # steps of a new user to the first point

Plays the built-in clip to and fro at 30 frames a second, as from two cameras, through the main loop
and the page: with no client, with three that keep up, and with three more that never answer. The
latency of a fix is the wall-clock time from the arrival of its frames to the fix. "Work" is the
processor time of the loop's own thread per frame, which other programs do not lengthen. Memory is
that of both processes; most of it is the clip's frames.

Glass to glass: the wall-clock time is painted into each frame of the first view as it is handed to
the loop, as 24 black or white squares. It is read in headless Chromium from the canvas right after
the page has drawn it, while the tracker runs and with the overlay.
"""

from __future__ import annotations

import asyncio
import json
import math
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

import numpy as np
import websockets
from numpy.typing import NDArray

from fingerpost.capture import Frame, open_views, read_views
from fingerpost.config import Rig
from fingerpost.live import Page
from fingerpost.live.scene import RigScene
from fingerpost.pipeline import Pointer, steps

T = TypeVar("T")

FPS = 30.0
CLIP = Path(__file__).parents[1] / "python" / "fingerpost" / "data" / "desk" / "rig.toml"


STAMP_BITS, STAMP_PX, STAMPS_PER_MS = 24, 8, 4

READS_STAMPS = """(() => {
  const draw = CanvasRenderingContext2D.prototype.drawImage;
  window.latencies = [];
  CanvasRenderingContext2D.prototype.drawImage = function (...given) {
    draw.apply(this, given);
    if (this.canvas !== document.querySelector('.view canvas')) return;
    const row = this.getImageData(0, 4, BITS * SIDE, 1).data;
    let stamp = 0;
    for (let k = 0; k < BITS; k++) stamp = 2 * stamp + (row[4 * (k * SIDE + SIDE / 2)] > 127);
    const now = PER_MS * (performance.timeOrigin + performance.now());
    const late = (((now - stamp) % 2 ** BITS) + 2 ** BITS) % 2 ** BITS;
    window.latencies.push(late / PER_MS);
  };
})()"""
for name, value in (("BITS", STAMP_BITS), ("SIDE", STAMP_PX), ("PER_MS", STAMPS_PER_MS)):
    READS_STAMPS = READS_STAMPS.replace(name, str(value))


def stamped(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a copy of a picture with the time painted into its upper left corner."""
    stamp = int(1e3 * STAMPS_PER_MS * time.time()) % 2**STAMP_BITS
    bits = [stamp >> k & 1 for k in reversed(range(STAMP_BITS))]
    picture = image.copy()
    row = np.repeat(np.array(bits, np.uint8) * 255, STAMP_PX)
    picture[:STAMP_PX, : len(row)] = row[None, :, None]
    return picture


def cameras(rig: Rig, seconds: float, *, stamps: bool = False) -> Iterator[tuple[Frame, ...]]:
    """Yield the clip's frames to and fro, at the rate of a camera."""
    with open_views(rig.sources) as sources:
        pairs = [[frame.image for frame in pair] for pair in read_views(sources)]
    for k, now_s, images in to_and_fro(pairs, seconds):
        shown = [stamped(images[0]), *images[1:]] if stamps else images
        yield tuple(Frame(k, now_s, image) for image in shown)


def to_and_fro(items: Sequence[T], seconds: float) -> Iterator[tuple[int, float, T]]:
    """Yield the number of a frame, the time, and an item for it, at the rate of a camera."""
    there_and_back = [*items, *items[-2:0:-1]]
    begun_s, k = time.monotonic(), 0
    while k < seconds * FPS:
        time.sleep(max(begun_s + k / FPS - time.monotonic(), 0.0))
        yield k, time.monotonic(), there_and_back[k % len(there_and_back)]
        # Frames that a camera sends while the loop is busy are lost.
        k = max(k + 1, math.ceil((time.monotonic() - begun_s) * FPS))


async def client(address: str, end_s: float, answers: bool, received: list[int]) -> None:
    """Receive messages as a page does; without answers the client stalls."""
    base, token = address.split("/?token=")
    cookie = {"Cookie": f"fingerpost-{base.rsplit(':', 1)[1]}={token}"}
    url = f"{base.replace('http', 'ws')}/socket"
    async with websockets.connect(
        url, additional_headers=cookie, origin=base, max_size=None
    ) as socket:
        while time.monotonic() < end_s:
            try:
                message = await asyncio.wait_for(socket.recv(), 0.5)
            except TimeoutError:
                continue
            except websockets.ConnectionClosed:  # the page has ended
                return
            if isinstance(message, bytes):
                received.append(len(message))
                if answers:
                    await socket.send('{"do":"ack"}')


def clients(address: str, seconds: float, quick: int, stalled: int) -> list[list[int]]:
    """Run clients in a thread; return the sizes of the messages that each receives."""
    received: list[list[int]] = [[] for _ in range(quick + stalled)]
    end_s = time.monotonic() + seconds

    async def run() -> None:
        await asyncio.gather(
            *(client(address, end_s, k < quick, each) for k, each in enumerate(received))
        )

    threading.Thread(target=lambda: asyncio.run(run()), daemon=True).start()
    return received


def memory_mb(pid: int | str) -> float:
    """Return the resident memory of a process."""
    status = Path(f"/proc/{pid}/status").read_text()
    return int(status.partition("VmRSS:")[2].split()[0]) / 1024


def cpu_s(pid: int | str) -> float:
    """Return the processor time of a process."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / 100.0


def measure(seconds: float, quick: int, stalled: int, *, shows: bool) -> None:
    """Run once with quick and stalled clients, and print a line."""
    rig = Rig.load(CLIP)
    with shown(rig) as (page, pointer):
        received = clients(page.address, seconds + 2, quick, stalled)
        server = page._process.pid
        latencies = []
        before_s, work_s = cpu_s(server), time.thread_time()
        for step in steps(pointer, page.allowed(cameras(rig, seconds))):
            if shows:
                page.show(step)
            latencies.append(1e3 * (time.monotonic() - step.fix.time_s))
        work_ms = 1e3 * (time.thread_time() - work_s) / len(latencies)
        kept = latencies[60:]
        p50, p95, p99 = np.percentile(kept, [50, 95, 99])
        share = 100 * (cpu_s(server) - before_s) / seconds
        rates = [len(each) / seconds for each in received]
        print(
            f"{'page' if shows else 'none':>5} {quick} clients {stalled} stalled   "
            f"fix {p50:5.2f} {p95:5.2f} {p99:5.2f} ms (p50 p95 p99)   work {work_ms:5.2f} ms   "
            f"server {share:4.1f} % of a core   "
            f"memory {memory_mb('self'):.0f} + {memory_mb(server):.0f} MB   "
            f"messages/s {' '.join(f'{rate:.1f}' for rate in rates)}   "
            f"load {os.getloadavg()[0]:.1f}",
            flush=True,
        )


@contextmanager
def shown(rig: Rig) -> Iterator[tuple[Page, Pointer]]:
    """Serve a rig's page."""
    pointer = Pointer(rig)
    with Page("127.0.0.1", 0) as page:
        views = pointer.plane_views
        page.open_rig(RigScene.of("bench", "mm", views, rig.sources, is_live=True, frames=None))
        yield page, pointer


def glass(seconds: float) -> None:
    """Measure the latency from a frame to the page's canvas, and print a line."""
    rig = Rig.load(CLIP)
    with shown(rig) as (page, pointer):
        command = [sys.executable, __file__, "--watch", page.address, str(seconds)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as watching:
            for step in steps(pointer, page.allowed(cameras(rig, seconds + 8.0, stamps=True))):
                page.show(step)
            out, _ = watching.communicate()
    latencies = json.loads(out)
    p50, p95, p99 = np.percentile(latencies, [50, 95, 99])
    print(
        f"glass to glass {p50:.1f} {p95:.1f} {p99:.1f} ms (p50 p95 p99)   "
        f"{len(latencies) / seconds:.1f} pictures/s   load {os.getloadavg()[0]:.1f}",
        flush=True,
    )


def watch(address: str, seconds: float) -> None:
    """Open the page in a browser, and print the latencies of its pictures [ms]."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        browser = driver.chromium.launch(
            executable_path=shutil.which("chromium"), args=["--no-sandbox"]
        )
        page = browser.new_page(viewport={"width": 1280, "height": 800})
        page.add_init_script(READS_STAMPS)
        page.goto(address)
        page.wait_for_selector(".view canvas")
        page.wait_for_timeout(2000)
        page.evaluate("() => { window.latencies = []; }")
        page.wait_for_timeout(1e3 * seconds)
        print(json.dumps(page.evaluate("() => window.latencies")))
        browser.close()


def memory(seconds: float) -> None:
    """Print both processes' memory ten times, with one client that keeps up and one stalled."""
    rig = Rig.load(CLIP)
    with shown(rig) as (page, pointer):
        clients(page.address, seconds, 1, 1)
        begun_s, printed = time.monotonic(), 0
        for step in steps(pointer, page.allowed(cameras(rig, seconds))):
            page.show(step)
            lasts_s = time.monotonic() - begun_s
            if lasts_s > (printed + 1) * seconds / 11:
                printed += 1
                own, theirs = memory_mb("self"), memory_mb(page._process.pid)
                print(f"{lasts_s:6.0f} s   {own:.1f} + {theirs:.1f} MB", flush=True)


def trial() -> None:
    """Follow a new user's steps from two films to a first point; print clicks and time."""
    from page_pictures import at_rest, served, until
    from playwright.sync_api import sync_playwright

    clicks = 0
    with tempfile.TemporaryDirectory() as made, sync_playwright() as driver:
        for name in ("left.mp4", "right.mp4"):
            shutil.copy(CLIP.with_name(name), made)
        browser = driver.chromium.launch(
            executable_path=shutil.which("chromium"), args=["--no-sandbox"]
        )
        begun_s = time.monotonic()
        with served(Path(made), "left.mp4", "right.mp4") as address:
            page = browser.new_page(viewport={"width": 1280, "height": 800})
            page.goto(address)
            until(page, "!document.querySelector('#begin').disabled")
            at_rest(page)
            for button, then in (
                ("#next", "document.querySelector('#words').textContent === 'the hand is found'"),
                ("#begin", "document.querySelector('#point').offsetParent"),
            ):
                page.click(button)
                clicks += 1
                until(page, then)
            lasts_s = time.monotonic() - begun_s
        browser.close()
    print(f"first point: {clicks} clicks, {lasts_s:.0f} s   load {os.getloadavg()[0]:.1f}")


def main() -> None:
    """Run the measurement that the command line names."""
    kind, *given = sys.argv[1:] if sys.argv[1:] and "-" in sys.argv[1] else ["", *sys.argv[1:]]
    if kind == "--watch":
        watch(given[0], float(given[1]))
        return
    lasts_s = float(given[0]) if given else 20.0
    if kind == "--glass":
        glass(lasts_s)
    elif kind == "--memory":
        memory(lasts_s)
    elif kind == "--trial":
        trial()
    else:
        by_clients(lasts_s)


def by_clients(lasts_s: float) -> None:
    """Measure with increasing numbers of clients."""
    for quick, stalled, shows in [
        (0, 0, False),
        (0, 0, True),
        (1, 0, True),
        (3, 0, True),
        (3, 3, True),
    ]:
        measure(lasts_s, quick, stalled, shows=shows)


if __name__ == "__main__":
    main()
