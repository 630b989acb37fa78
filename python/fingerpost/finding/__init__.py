"""Find the hand by itself: candidates in every view, tried by the fit, confirmed by another view.

In one image much looks like a finger: pens, cables, other fingers. Three things tell. A fit that
starts at the candidate must hold for some frames (`trial`, `search`). The finger lines of two
views, turned into constraint lines on the plane, must meet at a point that lies ahead of both tips,
where one may point (`pairs`). And what both views show must not lie in the plane: marks, pens and
shadows on the table map to one and the same line, while a finger above it maps to two (`look`).

Of two digits of a hand, which both pass all this, the one that reaches farther from the arm points.

A template that waits for the hand takes it where it is held up to it; a hand that comes elsewhere
is found as without one.

A hand that one view has lost is looked for beside its tracker, which may still wait for it where it
was. It need be found no longer than it was, and what moves with a hand that another view follows is
believed sooner than what no view has followed.

Where a camera keeps still, what was there before is hardly the hand (`foreground`); a hand that
waits in the first frames already is believed if it is a good one, and followed for good once it
has moved (`views`). A template that waits for the hand may lock on to the table before any has come
(`first_hand`); what each view follows, and when it lets go, is its own affair (`hand_view`).
"""

from fingerpost.finding.body import tell_from_hands
from fingerpost.finding.finger import BETWEEN_EDGES, Aside, Sighting, measured_line
from fingerpost.finding.hand_view import HandView
from fingerpost.finding.identity import Hand, Identity
from fingerpost.finding.look import flatness, widening
from fingerpost.finding.one_finger import (
    Shared,
    are_one,
    are_two,
    can_be_one,
    compare_lengths,
    compare_widths,
    other_fingers,
)
from fingerpost.finding.pairs import Viewpoint, pair_scores, width_ratio
from fingerpost.finding.search import HandSearch
from fingerpost.finding.views import find_hand, how_flat

__all__ = [
    "BETWEEN_EDGES",
    "Aside",
    "Hand",
    "HandSearch",
    "HandView",
    "Identity",
    "Shared",
    "Sighting",
    "Viewpoint",
    "are_one",
    "are_two",
    "can_be_one",
    "compare_lengths",
    "compare_widths",
    "find_hand",
    "flatness",
    "how_flat",
    "measured_line",
    "other_fingers",
    "pair_scores",
    "tell_from_hands",
    "widening",
    "width_ratio",
]
