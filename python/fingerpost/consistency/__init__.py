"""Consistency of a rig with its images and of its views with each other.

The tests use images, times, points and tips alone, and return contradictions. `Monitor` applies
them while a rig runs; the doctor does before.
"""

from fingerpost.consistency.contradiction import Contradiction
from fingerpost.consistency.disagreement import Disagreement
from fingerpost.consistency.freshness import Freshness
from fingerpost.consistency.monitor import FROZEN, Monitor, unannounced
from fingerpost.consistency.offset import Offset, Track, offset_between
from fingerpost.consistency.scenery import Mistake, Scenery
from fingerpost.consistency.straightness import Bend
from fingerpost.consistency.synchrony import (
    Lag,
    Tips,
    clocks_agree,
    lag_between,
    tip_in_first_view,
)

__all__ = [
    "FROZEN",
    "Bend",
    "Contradiction",
    "Disagreement",
    "Freshness",
    "Lag",
    "Mistake",
    "Monitor",
    "Offset",
    "Scenery",
    "Tips",
    "Track",
    "clocks_agree",
    "lag_between",
    "offset_between",
    "tip_in_first_view",
    "unannounced",
]
