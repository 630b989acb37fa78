"""Whether a rig, its pictures and its views fit together.

Nothing here knows a hand from a table: pictures, times, points and tips come in, and what belies
them comes out. `Monitor` watches while a rig runs; the doctor asks the same questions before.
"""

from fingerpost.consistency.contradiction import Contradiction
from fingerpost.consistency.freshness import Freshness
from fingerpost.consistency.monitor import FROZEN, Monitor
from fingerpost.consistency.offset import Offset, Track, offset_between
from fingerpost.consistency.scenery import Mistake, Scenery
from fingerpost.consistency.straightness import Bend
from fingerpost.consistency.synchrony import Lag, Tips, lag_between

__all__ = [
    "FROZEN",
    "Bend",
    "Contradiction",
    "Freshness",
    "Lag",
    "Mistake",
    "Monitor",
    "Offset",
    "Scenery",
    "Tips",
    "Track",
    "lag_between",
    "offset_between",
]
