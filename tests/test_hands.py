"""Fingers beside stripes, and fingers with dark nails."""

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
from fingerpost.finding.body import Body
from fingerpost.finding.foreground import foreground_ahead, places_ahead
from fingerpost.finding.pixel_tests import is_stripe
from fingerpost.finding.tip import SHORT_SIGMA, TipTest
from fingerpost.pipeline import Pointer
from fingerpost.silhouette import Silhouette
from fingerpost.simulate import Background as Scenery
from fingerpost.simulate import Hand, SimulatedRig, figure_eight, pointing_session
from fingerpost.simulated_rig_file import rig_from_simulation

CLIP = Path(fp.__file__).parent / "data" / "desk"
TABLE, FINGER, NAIL = 90, 170, 30
HALF_WIDTH_PX = 8.0
RIGHTWARDS = SimpleNamespace(tip_px=(200.0, 120.0), angle_rad=0.0)


def band(ends_at=200, half_width_px=HALF_WIDTH_PX, middle=120.0, of=FINGER, on=None):
    """Return grey levels of a band along u that ends at column `ends_at`."""
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


EDGE = 130
"""Grey level of the table beside a striped glove, between those of its stripes."""


def at_the_edge(on=EDGE):
    """Return stripes above the axis, and below it one that is narrower and then the table."""
    grey = band(of=EDGE)
    for row in range(-6, 1):
        grey = band(middle=120.0 + 16.0 * row, of=200 if row % 2 == 0 else 60, on=grey)
    grey[128:138, :200] = 60
    grey[138:] = on
    return grey


@pytest.mark.parametrize(
    ("grey", "expected"),
    [
        (STRIPES, True),
        (band(), False),
        (band(middle=100.0, on=band()), False),
        (band(ends_at=170, half_width_px=40.0, of=FINGER - 30, on=band()), False),
        (np.full((240, 320), TABLE, np.uint8), False),
        (at_the_edge(), True),
        (at_the_edge(on=60), False),
    ],
    ids=[
        "stripes",
        "one finger",
        "two fingers",
        "before the palm",
        "nothing",
        "edge of stripes",
        "spread fingers",
    ],
)
def test_a_stripe_among_stripes_is_distinguished_from_a_finger(grey, expected):
    assert is_stripe(frame(grey), RIGHTWARDS, HALF_WIDTH_PX) is expected


def learned():
    background = Background()
    for seed in range(12):
        background.observe(frame(band(ends_at=0), seed).grey())
    return background


def test_the_axis_sigma_is_raised_while_the_finger_extends_beyond_the_tip():
    background, test = learned(), TipTest()
    nail = frame(band(ends_at=200, on=band(ends_at=218, of=NAIL)))
    whole = frame(band())
    for seen, likely, sigma in ((nail, 1.0, SHORT_SIGMA), (whole, 0.0, 0.0)):
        background.look(seen.grey())
        ahead_px = places_ahead(RIGHTWARDS, HALF_WIDTH_PX)
        assert foreground_ahead(background, seen, ahead_px) == pytest.approx(likely, abs=0.1)
        for _ in range(10):
            test.update(background, seen, RIGHTWARDS, HALF_WIDTH_PX, Body.none())
        assert test.sigma == sigma


@pytest.mark.parametrize(
    ("ahead", "sigma"),
    [
        ({"ends_at": 200}, 0.0),
        ({"ends_at": 218, "of": NAIL}, SHORT_SIGMA),
        ({"ends_at": 218, "of": 2 * FINGER - TABLE}, SHORT_SIGMA),
        ({"ends_at": 320, "of": NAIL, "half_width_px": 60.0}, 0.0),
    ],
    ids=["nothing", "a dark nail", "a bright fingertip", "a dark table"],
)
def test_contrast_ahead_of_the_tip_raises_the_sigma_before_a_background_is_known(ahead, sigma):
    test = TipTest()
    seen = frame(band(on=band(**ahead)))
    for _ in range(3):
        test.update(Background(), seen, RIGHTWARDS, HALF_WIDTH_PX, Body.none())
        assert test.sigma == sigma


@pytest.mark.parametrize("is_known", [True, False], ids=["known table", "unknown table"])
def test_a_robot_ahead_of_the_tip_is_no_part_of_the_finger(is_known):
    background, test = learned() if is_known else Background(), TipTest()
    u, v = RIGHTWARDS.tip_px
    ahead_px = np.array([[u + 1.5 * HALF_WIDTH_PX, v]])
    gripper = Body(Silhouette(ahead_px, np.array([HALF_WIDTH_PX])))
    seen = frame(band(ends_at=200, on=band(ends_at=218, of=NAIL)))
    background.look(seen.grey())
    for _ in range(10):
        test.update(background, seen, RIGHTWARDS, HALF_WIDTH_PX, gripper)
    assert test.sigma == 0.0
    test.update(background, seen, RIGHTWARDS, HALF_WIDTH_PX, Body.none())
    assert test.sigma == SHORT_SIGMA


def followed(rig, frames):
    """Return the fixes and both views' finger lines, by frame."""
    pointer, fixes, tips = Pointer(rig), [], []
    for seen in frames:
        (step,) = pointer.update(seen)
        fixes.append(step.fix)
        tips.append([one.finger for one in step.observations])
    return fixes, tips


@pytest.fixture(scope="module")
def clip():
    """Return the rig, the true points, the frames and both views' finger lines of the clip."""
    rig = Rig.load(CLIP / "rig.toml")
    with (CLIP / "truth.csv").open(newline="") as file:
        truth = np.array([(float(row["x"]), float(row["y"])) for row in csv.DictReader(file)])
    with open_views(rig.sources, rig.readings) as sources:
        frames = [list(seen) for seen in read_views(sources)]
    _, tips = followed(rig, frames)
    return rig, truth, frames, tips


def test_ellipses_have_coverage_with_dark_nails(clip):
    rig, truth, frames, tips = clip
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


STRIPE_PX = 14.0


def striped_hand(seed, count=36, fps=30.0):
    """Return a rig without a start, and the frames and true points of a hand in a striped glove."""
    rig = SimulatedRig(device=Hand(), background=Scenery(texture="wood", clutter=15, seed=seed))
    path = pointing_session(figure_eight(rig.workspace, hover_mm=90.0)[seed:], wait_s=0.2)
    frames, points = [], []
    for k in range(count):
        time_s = 0.6 + k / fps
        shot = rig.render(path, time_s=time_s, rng=k)
        table = rig.render(None, time_s=time_s, rng=k)
        views = []
        for image, empty, view in zip(shot.images, table.images, shot.truth.views, strict=True):
            tip_px = np.zeros(2) if view.finger is None else view.finger.apex_pictured_px
            views.append(Frame(k, time_s, in_stripes(image, cv2.absdiff(image, empty) > 5, tip_px)))
        frames.append(views)
        points.append(shot.truth.indicated_mm)
    return rig_from_simulation(rig), frames, points


def in_stripes(grey, is_hand, tip_px):
    """Return an image with its hand in stripes that move with the tip."""
    v, u = np.mgrid[: grey.shape[0], : grey.shape[1]]
    across = ((u - tip_px[0]) + (v - tip_px[1])) / (np.sqrt(2.0) * STRIPE_PX)
    stripes = np.where(np.floor(across) % 2 == 0, 200, 40).astype(np.uint8)
    return cv2.GaussianBlur(np.where(is_hand, stripes, grey), (0, 0), 0.7)


def test_no_stripe_of_a_glove_is_taken_for_the_finger():
    rig, frames, truth = striped_hand(seed=2)
    fixes, _ = followed(rig, frames)
    off_mm = [
        np.hypot(*(fix.point - point))
        for fix, point in zip(fixes, truth, strict=True)
        if fix.point is not None and point is not None
    ]
    assert sum(off > 50.0 for off in off_mm) <= 2
