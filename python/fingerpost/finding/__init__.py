"""Automatic initialisation: find the hand in all views, and validate what each view follows.

Many structures in one image resemble a finger: pens, cables, other fingers. Three tests separate
them. A tracker initialised at the candidate must hold for several frames (`search`, `trial`). The
finger lines of two views, transferred to the plane as constraint lines, must intersect ahead of
both tips at a point near the reference points (`pairs`). The detection must not lie in the plane:
marks, pens and shadows on the table map to the same image under the homography between the views, a
finger above the table does not (`pixel_tests`).

If two digits of one hand pass all tests, the one that reaches farther from the arm is followed.

A view with an initial template accepts a hand that is held up to it; a hand that appears elsewhere
is found by the search, as in a view without one.

After a view has lost the hand, the search runs in parallel with its tracker, which may still wait
at the hand's last position. The template need not be longer than before the loss, and a trial that
moves with a hand in another view is accepted after fewer frames than one that no other view has
followed.

With a static camera, the learned background is a prior against a hand (`foreground`). A hand that
is present in the first frames is accepted if its score is high, and followed for good once it has
moved (`views`). An initial template may lock on to a pattern on the table before any hand has come
(`first_hand`). While nothing changes in any view, the search rests (`rest`). `hand_view` holds the
state of one view: what it follows, and when it rejects it.
"""

from fingerpost.finding.body import distinguish_body_from_hands
from fingerpost.finding.finger import NO_CORRECTION, AxisCorrection, FingerDetection, measured_line
from fingerpost.finding.hand_view import HandView
from fingerpost.finding.identity import Hand, Identity
from fingerpost.finding.one_finger import (
    PairTests,
    are_one,
    are_two,
    can_be_one,
    compare_lengths,
    compare_widths,
    other_fingers,
    rays_of_tips,
)
from fingerpost.finding.pairs import Viewpoint, pair_scores, width_ratio
from fingerpost.finding.pixel_tests import flatness, widening
from fingerpost.finding.rest import SearchRest
from fingerpost.finding.search import HandSearch
from fingerpost.finding.views import find_hand, flatness_of_followed

__all__ = [
    "NO_CORRECTION",
    "AxisCorrection",
    "FingerDetection",
    "Hand",
    "HandSearch",
    "HandView",
    "Identity",
    "PairTests",
    "SearchRest",
    "Viewpoint",
    "are_one",
    "are_two",
    "can_be_one",
    "compare_lengths",
    "compare_widths",
    "distinguish_body_from_hands",
    "find_hand",
    "flatness",
    "flatness_of_followed",
    "measured_line",
    "other_fingers",
    "pair_scores",
    "rays_of_tips",
    "widening",
    "width_ratio",
]
