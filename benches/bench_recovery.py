"""Losses of a recording that is killed or cut off, and what `recover` restores.

    python benches/bench_recovery.py [--cuts 200] [--kills 20]

Cuts the recording of a run over the built-in clip at random bytes, and kills a process that records
live views with SIGKILL; `fingerpost info` and `recover` read what is left. Prints the commands that
failed, and how much was recorded before the kill and is not restored.
"""

from __future__ import annotations

import argparse
import random
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import bench_record
from bench_page import CLIP
from mcap.reader import make_reader

BEGUN_S = (2.5, 6.0)
"""Range of the time from the start of a process to its end; it needs a second to begin."""


def fingerpost(*arguments: object) -> subprocess.CompletedProcess[str]:
    """Run a command."""
    command = [sys.executable, "-m", "fingerpost", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def restored(cut: Path) -> tuple[bool, Path]:
    """Return whether `info` and `recover` read a file without a fault, and the restored file."""
    whole = cut.with_name("restored.mcap")
    whole.unlink(missing_ok=True)
    done = [fingerpost("info", cut), fingerpost("recover", cut, whole)]
    return all(one.returncode == 0 and "Traceback" not in one.stderr for one in done), whole


def failed_cuts(folder: Path, count: int, rng: random.Random) -> list[int]:
    """Return the bytes at which a cut file could not be read."""
    path, cut = folder / "run.mcap", folder / "cut.mcap"
    fingerpost("run", CLIP, "--record", path)
    data, failed = path.read_bytes(), []
    for _ in range(count):
        size = rng.randrange(len(data))
        cut.write_bytes(data[:size])
        if not restored(cut)[0]:
            failed.append(size)
    return failed


def lost_s(folder: Path, rng: random.Random) -> float:
    """Return the time between the last restored frame and the kill [s]; infinite for a failure."""
    path = folder / "killed.mcap"
    path.unlink(missing_ok=True)
    process = subprocess.Popen([sys.executable, bench_record.__file__, "--measure", "60", path])
    time.sleep(rng.uniform(*BEGUN_S))
    process.kill()
    killed_s = time.time()
    process.wait()
    is_read, whole = restored(path)
    if not is_read:
        return float("inf")
    with whole.open("rb") as file:
        times_ns = [message.log_time for *_, message in make_reader(file).iter_messages()]
    return killed_s - 1e-9 * max(times_ns)


def main() -> None:
    """Print both."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--cuts", type=int, default=200)
    parser.add_argument("--kills", type=int, default=20)
    given = parser.parse_args()
    rng = random.Random(0)
    with tempfile.TemporaryDirectory() as name:
        failed = failed_cuts(Path(name), given.cuts, rng)
        print(f"{given.cuts} cuts at random bytes: {len(failed)} not read {failed}", flush=True)
        losses_s = [lost_s(Path(name), rng) for _ in range(given.kills)]
    words = " ".join(f"{loss_s:.2f}" for loss_s in sorted(losses_s))
    print(f"{given.kills} kills: the last {max(losses_s):.2f} s are lost at most; all: {words}")


if __name__ == "__main__":
    main()
