"""Hands as they are: what is at the tip, or along the finger, and unlike it."""

import csv
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

import fingerpost as fp
from fingerpost._core import Background
from fingerpost.capture import Frame, open_views, read_views
from fingerpost.config import Rig
from fingerpost.finding.foreground import foreground_ahead
from fingerpost.finding.pixel_tests import is_stripe
from fingerpost.finding.tip import SHORT_SIGMA, TipTest
from fingerpost.pipeline import Pointer

CLIP = Path(fp.__file__).parent / "data" / "desk"
TABLE, SKIN, NAIL = 90, 170, 30
HALF_WIDTH_PX = 8.0
RIGHTWARDS = SimpleNamespace(tip_px=(200.0, 120.0), angle_rad=0.0)


def band(ends_at=200, half_width_px=HALF_WIDTH_PX, middle=120.0, of=SKIN, on=None):
    """Grey levels of a band along u that ends at a column."""
    v, u = np.mgrid[0:240, 0:320].astype(float)
    grey = np.full(v.shape, TABLE, np.uint8) if on is None else on.copy()
    grey[(np.abs(v - middle) < half_width_px) & (u < ends_at)] = of
    return grey


def frame(grey, seed=0):
    noise = np.random.default_rng(seed).normal(0.0, 2.0, grey.shape)
    return Frame(0, 0.0, np.clip(grey + noise, 0, 255).round().astype(np.uint8))


STRIPES = band(of=TABLE)
for row in range(-5, 6):
    light = 200 if row % 2 == 0 else 60
    STRIPES = band(middle=120.0 + 2 * HALF_WIDTH_PX * row, of=light, on=STRIPES)


@pytest.mark.parametrize(
    ("grey", "expected"),
    [
        (STRIPES, True),
        (band(), False),
        (band(middle=100.0, on=band()), False),
        (band(ends_at=170, half_width_px=40.0, of=SKIN - 30, on=band()), False),
        (np.full((240, 320), TABLE, np.uint8), False),
    ],
    ids=["stripes", "one finger", "two fingers", "before the palm", "nothing"],
)
def test_a_stripe_among_stripes_is_told_from_a_finger(grey, expected):
    assert is_stripe(frame(grey), RIGHTWARDS, HALF_WIDTH_PX) is expected


def learned():
    background = Background()
    for seed in range(12):
        background.observe(frame(band(ends_at=0), seed).grey())
    return background


def test_a_finger_that_goes_on_ahead_of_its_tip_is_surer_of_its_axis_once_it_does_not():
    background, test = learned(), TipTest()
    nail = frame(band(ends_at=200, on=band(ends_at=218, of=NAIL)))
    whole = frame(band())
    for seen, likely, sigma in ((nail, 1.0, SHORT_SIGMA), (whole, 0.0, 0.0)):
        background.look(seen.grey())
        assert foreground_ahead(background, seen, RIGHTWARDS, HALF_WIDTH_PX) == pytest.approx(
            likely, abs=0.1
        )
        for _ in range(10):
            test.update(background, seen, RIGHTWARDS, HALF_WIDTH_PX)
        assert test.sigma == sigma


def test_an_unknown_background_changes_nothing():
    test = TipTest()
    for _ in range(10):
        test.update(Background(), frame(band()), RIGHTWARDS, HALF_WIDTH_PX)
    assert test.sigma == 0.0


def followed(rig, frames):
    """Points, covariances, and the tips and angles of both views, by frame."""
    pointer, fixes, tips = Pointer(rig), [], []
    for seen in frames:
        (step,) = pointer.update(seen)
        fixes.append(step.fix)
        tips.append([one.finger for one in step.observations])
    return fixes, tips


def test_ellipses_hold_for_dark_nails():
    rig = Rig.load(CLIP / "rig.toml")
    with (CLIP / "truth.csv").open(newline="") as file:
        truth = np.array([(float(row["x"]), float(row["y"])) for row in csv.DictReader(file)])
    with open_views(rig.sources, rig.readings) as sources:
        frames = [list(seen) for seen in read_views(sources)]
    _, tips = followed(rig, frames)
    painted = []
    for seen, fingers in zip(frames, tips, strict=True):
        views = []
        for one, finger in zip(seen, fingers, strict=True):
            image = one.image.copy()
            if isinstance(finger, fp.pointing.FingerLine):
                ahead = np.array([np.cos(finger.angle_rad), np.sin(finger.angle_rad)])
                nail_px = finger.tip_px - 0.35 * finger.half_width_px * ahead
                axes_px = 0.9 * finger.half_width_px, 0.75 * finger.half_width_px
                turn_deg = np.degrees(finger.angle_rad)
                cv2.ellipse(image, (nail_px, 2.0 * np.array(axes_px), turn_deg), (50, 20, 60), -1)
            views.append(Frame(one.index, one.time_s, image))
        painted.append(views)
    fixes, _ = followed(rig, painted)
    ok = [(fix, true) for fix, true in zip(fixes, truth, strict=True) if fix.point is not None]
    held = [
        (fix.point - true) @ np.linalg.solve(fix.covariance, fix.point - true) < 5.99
        for fix, true in ok
    ]
    assert len(ok) >= 70
    assert np.mean(held) >= 0.85
