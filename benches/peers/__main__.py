"""Other trackers on the same footage, with the same homographies and truth, in one run.

    python benches/peers [RIG.TOML TRUTH.CSV] [--only NAME ...] [--markdown TABLE.MD]

Without footage, two clips: the built-in one, which is rendered, and `mat`, a real hand. Each
tracker runs in a process of its own, one after the other, and a peer in an environment of its own
under build/peers, which is made when it is missing; what is in C++ is compiled there. A peer that
cannot be had is named and skipped, with the reason. Every tracker gives a finger line per view and
frame, two views' lines are taken to a point by the same reference points, and `score_points`
compares it with the truth. fingerpost gives its point itself, with a covariance; the peers have
none.

- *available*: frames with a truth that have a point
- *held*: 95 % ellipses that hold the true point
- *a pair*: processor time of all threads for both views' decoded frames, median over the frames;
  unlike time on a clock, other work on the machine changes it little
- *memory*: the most that the process used; libraries and models included
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import venv
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fingerpost.config import Rig
from fingerpost.experiment import score_points
from fingerpost.homography import estimate_image_from_plane
from fingerpost.lines import constraint_line

HERE = Path(__file__).resolve().parent
CLIP = HERE.parents[1] / "python" / "fingerpost" / "data" / "desk"
FOOTAGE = (CLIP, HERE / "mat")
BUILD = HERE.parents[1] / "build" / "peers"


class UnavailableError(Exception):
    """A peer cannot be run here; the message says what would change that."""


@dataclass(frozen=True)
class Native:
    """A C++ program that a peer starts, and the command that installs what compiling it takes."""

    source: str
    flags: tuple[str, ...]
    install: str

    def built(self) -> Path:
        """Compile the program and return it."""
        source = HERE / self.source
        program = BUILD / source.stem
        command = ["c++", "-O2", str(source), *self.flags, "-o", str(program)]
        try:
            subprocess.run(command, check=True, capture_output=True, text=True)
        except OSError as error:
            raise UnavailableError(f"no compiler ({error}); `{self.install}`") from error
        except subprocess.CalledProcessError as error:
            said = [line for line in error.stderr.splitlines() if "error" in line]
            reason = said[0].rpartition("error: ")[2] if said else "no reason given"
            message = f"{source.name} does not compile ({reason}); `{self.install}`"
            raise UnavailableError(message) from error
        return program


@dataclass(frozen=True)
class Peer:
    """A tracker: the program that runs it, its arguments, and what it needs.

    The program is in Python; `packages` are in its environment, and the path of what is built of
    `native` is its last argument.
    """

    name: str
    program: str
    arguments: tuple[str, ...] = ()
    packages: tuple[str, ...] = ()
    native: Native | None = None

    def command(self, job: Path) -> list[str]:
        """Return the command that runs this peer on a job; make first what it needs."""
        built = [] if self.native is None else [str(self.native.built())]
        program = str(HERE / self.program)
        return [str(self.python()), program, str(job), *self.arguments, *built]

    def python(self) -> Path:
        """Return an interpreter with the packages of this peer; make one if there is none."""
        if not self.packages:
            return Path(sys.executable)
        folder = BUILD / "-".join(self.packages).replace("=", "")
        python = folder / ("Scripts" if sys.platform == "win32" else "bin") / "python"
        done = folder / "installed"
        if not done.exists():
            venv.create(folder, with_pip=True, clear=True)
            command = [str(python), "-m", "pip", "install", "--quiet", *self.packages]
            subprocess.run(command, check=True, capture_output=True, text=True)
            done.touch()
        return python


MEDIAPIPE = ("mediapipe==0.10.21",)
VISP = Native(
    "visp_moving_edges.cpp",
    # Headers of ViSP include those of OpenCV, which Debian has one folder down.
    ("-I/usr/include/opencv4", "-lvisp_me", "-lvisp_core"),
    "apt install --no-install-recommends g++ libvisp-me-dev",
)
PEERS = (
    Peer("fingerpost", "ours.py", ("ribbon",)),
    Peer("fingerpost, the paper's model", "ours.py", ("paper",)),
    Peer("MediaPipe Hands, lite", "mediapipe_hands.py", ("0",), MEDIAPIPE),
    Peer("MediaPipe Hands, full", "mediapipe_hands.py", ("1",), MEDIAPIPE),
    # The package of MediaPipe brings OpenCV with its extra modules.
    Peer("OpenCV rapid", "opencv_rapid.py", (), MEDIAPIPE),
    Peer("ViSP moving edges", "visp.py", native=VISP),
)


def main() -> None:
    """Run every peer and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("footage", nargs="*", type=Path, metavar="RIG.TOML TRUTH.CSV")
    parser.add_argument("--only", nargs="+", default=[peer.name for peer in PEERS])
    parser.add_argument("--markdown", type=Path, help="also write the table there")
    given = parser.parse_args()
    if len(given.footage) not in {0, 2}:
        parser.error("RIG.TOML and TRUTH.CSV go together")
    travelling = [(folder / "rig.toml", folder / "truth.csv") for folder in FOOTAGE]
    footage = [tuple(given.footage)] if given.footage else travelling
    BUILD.mkdir(parents=True, exist_ok=True)
    lines = []
    for rig_file, truth in footage:
        for line in table_of(rig_file, truth, given.only):
            print(line, flush=True)
            lines.append(line)
    if given.markdown is not None:
        given.markdown.write_text("\n".join(lines) + "\n", encoding="utf-8")


def table_of(rig_file: Path, truth: Path, names: Collection[str]) -> Iterator[str]:
    """Yield the lines of the table of one footage, each as soon as its peer has run."""
    yield f"\n{rig_file.resolve().parent.name}\n"
    yield "| tracker | version | available | RMS | median | 95 % | held | a pair | memory |"
    yield "|---|---|---|---|---|---|---|---|---|"
    for peer in PEERS:
        if peer.name in names:
            yield row_of(peer, rig_file, truth)


def row_of(peer: Peer, rig_file: Path, truth: Path) -> str:
    """Run a peer and return its row of the table, or one that says why there is none."""
    rig = Rig.load(rig_file)
    job = BUILD / "job.json"
    job.write_text(json.dumps(job_of(rig_file, rig)), encoding="utf-8")
    try:
        done = subprocess.run(peer.command(job), check=True, capture_output=True, text=True)
    except UnavailableError as error:
        return skipped(peer, str(error))
    except subprocess.CalledProcessError as error:
        return skipped(peer, (error.stderr.strip().splitlines() or ["no reason given"])[-1])
    said = json.loads(done.stdout.strip().splitlines()[-1])
    points = BUILD / "points.csv"
    write_points(points, said, rig)
    summary = score_points(rig_file, points, truth).summary
    if summary.points is None:
        return f"| {peer.name} | {said['version']} | 0 of {summary.targets} |" + " |" * 6
    found, unit = summary.points, rig.plane.unit
    held = [f"{100 * c.held:.0f} %" for c in found.coverages if c.nominal == 0.95] or ["no ellipse"]
    return (
        f"| {peer.name} | {said['version']} | {summary.available} of {summary.targets} | "
        f"{found.rms_of_all:.3g} {unit} | {found.median:.3g} | {found.percentile_95:.3g} | "
        f"{held[0]} | {1e3 * said['pair_s']:.1f} ms | {said['memory_mb']:.0f} MB |"
    )


def skipped(peer: Peer, reason: str) -> str:
    """Return the row of a peer that has no figures."""
    return f"| {peer.name} | skipped: {reason.replace('|', '/')} |" + " |" * 7


def job_of(rig_file: Path, rig: Rig) -> dict[str, Any]:
    """Say what a peer needs of a rig, in plain values."""
    return {
        "rig": str(rig_file.resolve()),
        "views": [
            {
                "source": str(rig.sources[view.name]),
                "start": None
                if view.start is None
                else {
                    "tip_px": list(view.start.tip_px),
                    "angle_deg": view.start.angle_deg,
                    "length_px": view.start.length_px,
                },
            }
            for view in rig.views
        ],
    }


def write_points(path: Path, said: dict[str, Any], rig: Rig) -> None:
    """Write the points of a peer, or those where its finger lines meet, as a `points.csv`."""
    rows = ["frame,time_s,status,x,y,cov_xx,cov_xy,cov_yy,crossing_angle_deg"]
    rows += said.get("points", [])
    plane = np.asarray(rig.plane.points, float)
    views = [
        estimate_image_from_plane(plane, np.asarray(view.reference_points_px, float))
        for view in rig.views
    ]
    for frame, time_s, lines in said.get("lines", []):
        point = meeting_point(views, lines)
        if point is not None:
            rows.append(f"{frame},{time_s!r},ok,{point[0]!r},{point[1]!r},,,,")
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")


def meeting_point(views: list[Any], lines: list[Any]) -> list[float] | None:
    """Intersect the constraint lines of the first two views that have a finger line."""
    constraints = []
    for image_from_plane, line in zip(views, lines, strict=True):
        if line is not None:
            (u0, v0), (u1, v1) = line
            image_line = np.cross([u0, v0, 1.0], [u1, v1, 1.0])
            constraints.append(constraint_line(image_from_plane, image_line))
    if len(constraints) < 2:
        return None
    x, y, w = np.cross(constraints[0], constraints[1])
    return [float(x / w), float(y / w)] if w else None


if __name__ == "__main__":
    main()
