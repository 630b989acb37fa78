"""What the operator's page costs: how late fixes are told with and without clients.

    python benches/bench_page.py [seconds]

Plays the built-in clip to and fro at 30 frames a second, as two cameras would, through the main
loop and the page: with no client, with three that keep up, and with three more that never answer.
A fix's latency counts from the frames' being there to its being told, by the clock on the wall;
"work" is the processor time of the loop's own thread for a frame, which other programs do not
lengthen. Memory is that of both processes, of which the clip's frames are most.
"""

from __future__ import annotations

import asyncio
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import websockets

from fingerpost.capture import Frame, open_views, read_views
from fingerpost.config import Rig
from fingerpost.live import Page
from fingerpost.live.scene import RigScene
from fingerpost.pipeline import Pointer, steps

FPS = 30.0
CLIP = Path(__file__).parents[1] / "python" / "fingerpost" / "data" / "desk" / "rig.toml"


def cameras(rig: Rig, seconds: float) -> Iterator[tuple[Frame, ...]]:
    """Give the clip's frames to and fro, each when a camera would."""
    with open_views(rig.sources) as sources:
        pairs = [tuple(pair) for pair in read_views(sources)]
    there_and_back = [*pairs, *pairs[-2:0:-1]]
    begun_s = time.monotonic()
    for k in range(int(seconds * FPS)):
        due_s = begun_s + k / FPS
        time.sleep(max(due_s - time.monotonic(), 0.0))
        now_s = time.monotonic()
        pair = there_and_back[k % len(there_and_back)]
        yield tuple(Frame(k, now_s, frame.image) for frame in pair)


async def client(address: str, end_s: float, answers: bool, received: list[int]) -> None:
    """Receive like a page; one that does not answer stalls."""
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
            if isinstance(message, bytes):
                received.append(len(message))
                if answers:
                    await socket.send('{"do":"ack"}')


def clients(address: str, seconds: float, quick: int, stalled: int) -> list[list[int]]:
    """Run clients in a thread."""
    received: list[list[int]] = [[] for _ in range(quick + stalled)]
    end_s = time.monotonic() + seconds

    async def run() -> None:
        await asyncio.gather(
            *(client(address, end_s, k < quick, each) for k, each in enumerate(received))
        )

    threading.Thread(target=lambda: asyncio.run(run()), daemon=True).start()
    return received


def memory_mb(pid: int | str) -> float:
    """Resident memory of a process."""
    status = Path(f"/proc/{pid}/status").read_text()
    return int(status.partition("VmRSS:")[2].split()[0]) / 1024


def cpu_s(pid: int | str) -> float:
    """Processor time that a process has had."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / 100.0


def measure(seconds: float, quick: int, stalled: int, shown: bool) -> None:
    """Run once and print a line."""
    rig = Rig.load(CLIP)
    pointer = Pointer(rig)
    with Page("127.0.0.1", 0) as page:
        names = rig.sources
        scene = RigScene.of("bench", "mm", pointer.plane_views, names, is_live=True, frames=None)
        page.open_rig(scene)
        received = clients(page.address, seconds + 2, quick, stalled)
        server = page._process.pid
        latencies = []
        before_s, work_s = cpu_s(server), time.thread_time()
        for step in steps(pointer, page.allowed(cameras(rig, seconds))):
            if shown:
                page.show(step)
            latencies.append(1e3 * (time.monotonic() - step.fix.time_s))
        work_ms = 1e3 * (time.thread_time() - work_s) / len(latencies)
        kept = latencies[60:]
        p50, p95, p99 = np.percentile(kept, [50, 95, 99])
        share = 100 * (cpu_s(server) - before_s) / seconds
        rates = [len(each) / seconds for each in received]
        print(
            f"{'page' if shown else 'none':>5} {quick} clients {stalled} stalled   "
            f"fix {p50:5.2f} {p95:5.2f} {p99:5.2f} ms (p50 p95 p99)   work {work_ms:5.2f} ms   "
            f"server {share:4.1f} % of a core   "
            f"memory {memory_mb('self'):.0f} + {memory_mb(server):.0f} MB   "
            f"messages/s {' '.join(f'{rate:.1f}' for rate in rates)}",
            flush=True,
        )


if __name__ == "__main__":
    lasts_s = float(sys.argv[1]) if len(sys.argv) > 1 else 20.0
    for quick, stalled, shown in [
        (0, 0, False),
        (0, 0, True),
        (1, 0, True),
        (3, 0, True),
        (3, 3, True),
    ]:
        measure(lasts_s, quick, stalled, shown)
