"""No figure moves unasked: tracks and fixes of known clips are those of golden/tracks.json."""

import math
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent / "golden"))

import generate_tracks as golden

RECORDED = golden.recorded()
SAME_POINTS = 0.98
"""Frames whose points agree where other kernels round, and a near decision may fall otherwise."""


@pytest.mark.parametrize("name", RECORDED["clips"])
def test_tracks_and_fixes_of_a_clip_are_those_recorded(name):
    if name not in golden.names():
        pytest.skip("the footage is not here")
    kept, now = RECORDED["clips"][name], golden.made(name)
    if RECORDED["made_with"] == golden.environment():
        assert now.sha256 == kept["sha256"]
    assert len(now.points) == len(kept["points"])
    agree = sum(map(_agree, now.points, kept["points"]))
    assert agree >= SAME_POINTS * len(now.points)


def _agree(now, kept):
    if now is None or kept is None:
        return now is kept
    return math.dist(now, kept) <= 1e-4 * max(1.0, *map(abs, kept))


def test_a_hash_covers_the_last_bit_of_every_number():
    clip = golden.SIMULATED["simulated-grey"]()
    first, second = next(iter(clip.frames)), None
    steps = list(golden.steps(golden.Pointer(clip.rig), [first]))
    seen = steps[0].observations[0]
    second = golden.replace(seen, moved_px=math.nextafter(seen.moved_px, math.inf))
    changed = golden.replace(steps[0], observations=(second, *steps[0].observations[1:]))
    written = [[*map(golden.written, golden.of_step(step))] for step in (steps[0], changed)]
    assert written[0] != written[1]
