r"""Diagnosis of a set-up from some frames of every view.

    rig = Rig.load("rig.toml")
    diagnosis = examine(rig, frames)        # a sequence of `fingerpost.capture.Frame` per view
    print("\n".join(diagnosis.table()))

Each finding states the problem, its place and the remedy. Limits are constants, with their origin,
in the module that applies them: `pictures` (exposure, noise, focus), `hand` (contrast, size),
`references` and `together` (points, lens, clocks: `fingerpost.consistency`), and `examine` (sizes,
rates, times).
"""

from fingerpost.doctor.examine import DEFAULT_FRAMES, examine, look, reduced
from fingerpost.doctor.findings import Check, Diagnosis, Finding, Severity, ViewReadings

__all__ = [
    "DEFAULT_FRAMES",
    "Check",
    "Diagnosis",
    "Finding",
    "Severity",
    "ViewReadings",
    "examine",
    "look",
    "reduced",
]
