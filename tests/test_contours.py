"""The parts of the active contour, for use by themselves."""

import numpy as np

from fingerpost import contours


def test_the_example_converges_to_the_finger():
    lines = contours.__doc__.splitlines()
    names = {}
    exec("\n".join(line[4:] for line in lines if line.startswith((">>> ", "... "))), names)
    finger, start = names["finger"], names["start"]
    assert abs(start.angle_rad - finger.axis_angle_rad) > np.radians(2.9)
    assert abs(names["off_rad"]) < np.radians(0.05)
    tip_px = names["space"].axis(names["shape"]).tip_px
    assert np.hypot(*(tip_px - finger.apex_px)) < 0.5
    assert names["fit"].inliers > 40


def test_every_part_is_documented():
    for name in contours.__all__:
        assert len(getattr(contours, name).__doc__) > 20
