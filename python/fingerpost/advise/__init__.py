r"""The placement advisor: predicts the accuracy of a rig before it is used.

    rig = Rig.load("rig.toml")
    advice = advise(rig, sizes_px=[(640, 480), (640, 480)])
    print("\n".join(advice.table()))
    advice.draw("advice.png")

It only uses the reference points: they give the pose of each camera (`camera`); the expected hand
poses (`poses`) are projected into the cameras, and `fingerpost.pointing.indicated_point` gives the
resulting points (`forecast`). Trial moves of every camera show which one is badly placed (`moves`).
"""

from fingerpost.advise.advice import (
    Advice,
    Cell,
    Concern,
    Direction,
    Flag,
    ViewAdvice,
    advise,
    reference_weakness,
)
from fingerpost.advise.camera import PlaneCamera, recover_camera
from fingerpost.advise.forecast import Doubt, Figures
from fingerpost.advise.moves import Move, Way
from fingerpost.advise.options import AdviceOptions

__all__ = [
    "Advice",
    "AdviceOptions",
    "Cell",
    "Concern",
    "Direction",
    "Doubt",
    "Figures",
    "Flag",
    "Move",
    "PlaneCamera",
    "ViewAdvice",
    "Way",
    "advise",
    "recover_camera",
    "reference_weakness",
]
