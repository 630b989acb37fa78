"""Cost of recording beside tracking: latency of fixes, processor time, memory, size of the file.

    python benches/bench_record.py [seconds]    # ten minutes, unless given

Plays the built-in clip to and fro at 30 frames a second, as from two cameras that send JPEG,
through the main loop, first without and then with a recorder, in a process each. The latency of a
fix is the wall-clock time from the arrival of its frames to the fix. Memory is resident, after a
sixth of the time and at the end.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
from bench_page import CLIP, memory_mb, to_and_fro

from fingerpost.capture import Frame, open_views, read_views
from fingerpost.cli.recorder import open_recorder
from fingerpost.config import Rig
from fingerpost.pipeline import Pointer, steps

SECONDS = 600.0
Sent = list[tuple[bytes, np.ndarray]]


def images_of(rig: Rig) -> list[Sent]:
    """Return the clip's images as JPEG and decoded."""
    with open_views(rig.sources) as sources:
        together = [[frame.image for frame in frames] for frames in read_views(sources)]
    return [
        [
            (jpeg.tobytes(), cv2.imdecode(jpeg, cv2.IMREAD_COLOR))
            for jpeg in (cv2.imencode(".jpg", image)[1] for image in images)
        ]
        for images in together
    ]


def cameras(sent: Sequence[Sent], seconds: float) -> Iterator[tuple[Frame, ...]]:
    """Yield frames to and fro, at the rate of a camera."""
    for k, now_s, images in to_and_fro(sent, seconds):
        yield tuple(Frame(k, now_s, image, jpeg) for jpeg, image in images)


def measure(seconds: float, path: Path | None) -> dict[str, float]:
    """Follow the clip, and record it if a path is given; return the figures."""
    cv2.setNumThreads(1)
    rig = Rig.load(CLIP)
    sent = images_of(rig)
    frames = cameras(sent, seconds)
    recorder = None
    if path is not None:
        with open_views(rig.sources) as sources:
            recorder = open_recorder(path, rig, sources, None, is_live=True)
        frames = recorder.watch(frames)
    latencies_ms: list[float] = []
    jpeg_bytes, early_mb = 0, 0.0
    begun_s, used_s = time.monotonic(), time.process_time()
    for step in steps(Pointer(rig), frames):
        if recorder is not None:
            recorder.take(step)
        latencies_ms.append(1e3 * (time.monotonic() - step.fix.time_s))
        jpeg_bytes += sum(len(seen.frame.encoded) for seen in step.observations if seen.frame)
        if not early_mb and time.monotonic() - begun_s > seconds / 6.0:
            early_mb = memory_mb("self")
    figures = {
        "frames": len(latencies_ms),
        "p50_ms": float(np.percentile(latencies_ms, 50)),
        "p95_ms": float(np.percentile(latencies_ms, 95)),
        "early_mb": early_mb,
        "late_mb": memory_mb("self"),
    }
    if recorder is not None:
        recorder.close()
        print(*recorder.notes(), file=sys.stderr)
        figures["file_per_jpeg"] = path.stat().st_size / jpeg_bytes
    # Per frame, as fewer frames are fetched while other programs need the processor.
    figures["work_ms"] = 1e3 * (time.process_time() - used_s) / len(latencies_ms)
    figures["peak_mb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return figures


def main() -> None:
    """Print a line for each of: tracking alone, and recording beside it."""
    if sys.argv[1:2] == ["--measure"]:
        path = Path(sys.argv[3]) if len(sys.argv) > 3 else None
        print(json.dumps(measure(float(sys.argv[2]), path)))
        return
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else SECONDS
    with tempfile.TemporaryDirectory() as folder:
        for path in ([], [str(Path(folder) / "session.mcap")]):
            command = [sys.executable, __file__, "--measure", str(seconds), *path]
            done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
            figures = json.loads(done.stdout)
            words = "   ".join(f"{name} {value:.2f}" for name, value in figures.items())
            print(f"{'recorded' if path else 'alone':>8}   {words}   load {os.getloadavg()[0]:.1f}")


if __name__ == "__main__":
    main()
