"""Processor time and latency of publishing: zenoh between two processes on loopback.

    python benches/bench_net.py [seconds]

One process publishes fixes and the built-in clip's two views, as JPEG, 30 times a second. Another
one, which uses zenoh without fingerpost, records when each arrives. Both read the same monotonic
clock. The latency of a fix starts when it is handed to the publisher. "Work" is the processor time
of the publishing process minus that of the same loop without a publisher. It excludes other
programs; the latency does not, so the load of the machine is printed as well.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np

from fingerpost.capture import Frame, open_source
from fingerpost.publishing import Extent, PublishedFix, Publisher, open_publisher

FPS = 30.0
NAMES = ("p50", "p90", "p99", "max")
CLIP = Path(__file__).parents[1] / "python" / "fingerpost" / "data" / "desk"
EXTENT = Extent((0.0, 0.0), (400.0, 300.0), "mm")
SIZE_PX = (640, 480)

RECEIVER = """
import json, sys, time, zenoh
config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("connect/endpoints", '["tcp/127.0.0.1:%s"]' % sys.argv[1])
config.insert_json5("scouting/multicast/enabled", "false")
with zenoh.open(config) as session:
    fixes = session.declare_subscriber("fingerpost/fix", zenoh.handlers.FifoChannel(10000))
    images = session.declare_subscriber("fingerpost/*/image", zenoh.handlers.FifoChannel(10000))
    print("ready", flush=True)
    late, begun = [], time.process_time()
    for sample in fixes:
        now = time.monotonic()
        fix = json.loads(sample.payload.to_bytes())
        if fix["status"] == "lost":
            break
        late.append(now - fix["time_s"])
    count = 0
    while images.try_recv() is not None:
        count += 1
    used = time.process_time() - begun
    images.undeclare()
    fixes.undeclare()
    print(json.dumps({"late": late, "images": count, "used_s": used}))
"""


def views() -> list[tuple[str, Frame]]:
    """Return a frame of each view of the clip, with its JPEG, as from a camera."""
    found = []
    for path in sorted(CLIP.glob("*.mp4")) or sorted(CLIP.glob("*.webm")):
        with open_source(str(path)) as source:
            image = cv2.resize(next(iter(source)).image, SIZE_PX)
        data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes()
        found.append((path.stem, Frame(0, 0.0, image, data)))
    return found


def loop(publisher: Publisher | None, pictures: list[tuple[str, Frame]], seconds: float) -> float:
    """Publish at 30 Hz; return the processor time used [s]."""
    begun_s, used_s = time.monotonic(), time.process_time()
    for k in range(int(seconds * FPS)):
        time.sleep(max(0.0, begun_s + k / FPS - time.monotonic()))
        now_s = time.monotonic()
        fix = PublishedFix(
            frame=k, time_s=now_s, status="ok", unit="mm", x=1.0, y=2.0, cov_xx=1.0, cov_xy=0.0,
            cov_yy=1.0,
        )  # fmt: skip
        stamped = [(view, Frame(k, now_s, one.image, one.encoded)) for view, one in pictures]
        if publisher is not None:
            publisher.put(fix, stamped)
    return time.process_time() - used_s


def measure(seconds: float, *, with_pictures: bool) -> None:
    """Print latency and work of publishing fixes, with or without pictures."""
    pictures = views()
    port = 17461
    alone_s = loop(None, pictures, seconds)
    url = f"zenoh://127.0.0.1:{port}?role=listen{'&pictures' if with_pictures else ''}"
    with open_publisher(url, EXTENT, waits=False) as publisher:
        program = [sys.executable, "-c", RECEIVER, str(port)]
        receiver = subprocess.Popen(program, stdout=subprocess.PIPE, text=True)
        assert receiver.stdout is not None
        receiver.stdout.readline()
        time.sleep(0.5)
        used_s = loop(publisher, pictures, seconds)
        while receiver.poll() is None:  # repeated: zenoh drops messages when its queue is full
            publisher.put(PublishedFix(frame=0, time_s=0.0, status="lost", unit="mm"))
            time.sleep(0.1)
        output = receiver.stdout.read()
    received = json.loads(output)
    late_ms = 1e3 * np.array(received["late"])
    sent = int(seconds * FPS)
    size_kb = sum(len(one.encoded) for _, one in pictures) / len(pictures) / 1e3
    print(f"{'fixes and two views' if with_pictures else 'fixes'}, {seconds:g} s at {FPS:g} Hz:")
    print(f"  {len(late_ms)} of {sent} fixes, {received['images']} of {2 * sent} pictures arrived")
    percentiles = np.percentile(late_ms, [50, 90, 99, 100])
    shown = (f"{name} {ms:.2f} ms" for name, ms in zip(NAMES, percentiles, strict=True))
    print(f"  latency {', '.join(shown)}")
    work = 100.0 * (used_s - alone_s) / seconds
    theirs = 100.0 * received["used_s"] / seconds
    print(f"  work {work:.1f} % of a core; the receiver's {theirs:.1f} %")
    if with_pictures:
        print(f"  pictures of {SIZE_PX[0]} x {SIZE_PX[1]} px, {size_kb:.0f} kB each")


def main() -> None:
    """Measure fixes without and with pictures."""
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 20.0
    print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    measure(seconds, with_pictures=False)
    measure(seconds, with_pictures=True)


if __name__ == "__main__":
    main()
