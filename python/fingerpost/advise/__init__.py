r"""The placement advisor: how well a rig will tell where hands point, before anybody points.

    rig = Rig.load("rig.toml")
    advice = advise(rig, sizes_px=[(640, 480), (640, 480)])
    print("\n".join(advice.table()))
    advice.draw("advice.png")

From the reference points alone: they tell where each camera stands (`camera`); the hand poses to
be expected (`poses`) are projected into the cameras, and `fingerpost.pointing.indicated_point`
says what would come of them (`forecast`). Moving every camera a little shows which one stands
badly (`moves`).
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
