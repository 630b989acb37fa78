"""A hand before patterned cloth: edges everywhere, and most of them not the hand's."""

import numpy as np
import pytest
from numpy.typing import NDArray

from fingerpost._core import ContourTracker, StartPose, Template, Track

SIZE = (240, 320)
FRAME_S = 1 / 30
NOISE_GREY = 2.0
FRAMES = 8
"""Enough for the template to settle in."""
TIP = np.array([190.0, 130.0])
ANGLE_RAD = 0.6
HALF_WIDTH_PX = 7.5
LENGTH_PX = 66.0
SKIN = np.array([120.0, 140.0, 190.0])
CLOTH = np.array([[110, 105, 95], [140, 70, 65], [60, 50, 130]], dtype=float)
LINE = np.array([200.0, 205.0, 210.0])


def cloth(angle_rad: float, check_px: float) -> NDArray[np.float64]:
    """Checked cloth: bands both ways, and light lines where they begin."""
    v, u = np.mgrid[: SIZE[0], : SIZE[1]].astype(float)
    e = np.array([np.cos(angle_rad), np.sin(angle_rad)])
    along, across = e[0] * u + e[1] * v, -e[1] * u + e[0] * v
    colour = np.broadcast_to(CLOTH[0], (*SIZE, 3)).copy()
    for places, band in ((along, CLOTH[1]), (across, CLOTH[2])):
        colour[places % check_px < 0.4 * check_px] = band
    colour[(along % check_px < 3) | (across % check_px < 3)] = LINE
    return colour


def picture(
    table: NDArray[np.float64], tip: NDArray[np.float64] | None, seed: int
) -> NDArray[np.uint8]:
    """The table, before it a finger and the hand that it is of, blurred by its area, and noise."""
    shown = table.copy()
    if tip is not None:
        v, u = np.mgrid[: SIZE[0], : SIZE[1]].astype(float)
        e = np.array([np.cos(ANGLE_RAD), np.sin(ANGLE_RAD)])
        along = (u - tip[0]) * e[0] + (v - tip[1]) * e[1] + HALF_WIDTH_PX
        across = -(u - tip[0]) * e[1] + (v - tip[1]) * e[0]
        finger = HALF_WIDTH_PX - np.hypot(np.maximum(along, 0.0), across)
        palm = 38.0 - np.hypot(along + LENGTH_PX + 26.0, across - 22.0)
        part = np.clip(np.maximum(finger, palm) / 1.5 + 0.5, 0.0, 1.0)[..., None]
        shown = (1.0 - part) * shown + part * (SKIN - 15.0 * (across[..., None] > 0.0))
    noise = np.random.default_rng([20, seed]).normal(0.0, NOISE_GREY, shown.shape)
    return np.clip(np.rint(shown + noise), 0, 255).astype(np.uint8)


def waiting(off_px: tuple[float, float], off_rad: float) -> ContourTracker:
    tip = tuple(TIP + off_px)
    return ContourTracker(
        Template.pistol("none"), StartPose(tip, ANGLE_RAD + off_rad, 0.9 * LENGTH_PX)
    )


def watch(
    tracker: ContourTracker, table: NDArray[np.float64], tip: NDArray[np.float64] | None
) -> list[Track]:
    tracks: list[Track] = []
    for k in range(FRAMES):
        colour = picture(table, tip, k)
        grey = np.rint(colour @ [0.114, 0.587, 0.299]).astype(np.uint8)
        tracks.append(tracker.update(grey, k * FRAME_S, colour=colour))
    return tracks


STARTS = [((3.0, 6.0), 0.05), ((-7.0, 4.0), -0.1), ((5.0, -8.0), 0.12)]
COARSE = [(angle_rad, 40.0) for angle_rad in (0.2, 1.1)]
"""Checks whose bands are about as wide as the finger, and none of them runs along it."""
CLEAR = [(0.6, 28.0), (1.1, 40.0)]
"""Cloth whose lines do not lead a waiting template away from the finger."""


@pytest.mark.parametrize("start", STARTS)
@pytest.mark.parametrize("pattern", COARSE)
def test_what_is_followed_is_the_hand(start, pattern):
    for track in watch(waiting(*start), cloth(*pattern), TIP):
        line = track.finger_line
        assert line is None or np.hypot(*(np.array(line.tip_px) - TIP)) < 2.0
        assert line is None or abs(line.angle_rad - ANGLE_RAD) < 0.05


@pytest.mark.parametrize("start", STARTS)
@pytest.mark.parametrize("pattern", CLEAR)
def test_the_hand_is_found_before_cloth(start, pattern):
    last = watch(waiting(*start), cloth(*pattern), TIP)[-1].finger_line
    assert last is not None


@pytest.mark.parametrize("start", STARTS)
@pytest.mark.parametrize("pattern", COARSE)
def test_no_band_of_the_cloth_is_a_hand(start, pattern):
    tracks = watch(waiting(*start), cloth(*pattern), None)
    assert all(t.status == "acquiring" for t in tracks)
