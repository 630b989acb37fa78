"""A bent finger is reported as such and not fitted.

`benches/photographs.py` shows this for a real finger.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import pytest

from fingerpost._core import ContourTracker, StartPose, Template, Track
from fingerpost.simulate import Background, Camera, DevicePose, Hand, SimulatedRig

FRAME_S = 1 / 30
SEED = 20
POSE = DevicePose.pointing_at((200, 200), hover_mm=120, slant_deg=40)
STRAIGHT_FRAMES = 24
STRAIGHT_AGAIN_FRAMES = 6
BENDING_FRAMES = 12


@dataclass(frozen=True)
class Seen:
    """True bend and tip direction of the finger in a frame, and the tracker's result."""

    bend_rad: float
    angle_rad: float
    track: Track


def directions(camera: Camera, hand: Hand, pose: DevicePose) -> tuple[float, float]:
    """Image directions of the finger's first segment, from the knuckle, and of its last."""
    links, world_from_device = hand.body.links, pose.world_from_device
    last = links[hand.body.finger]
    first = next((link for link in links if link.end_mm == last.start_mm), last)

    def angle_rad(link) -> float:
        ends = np.array([link.start_mm, link.end_mm])
        start, end = camera.project(ends @ world_from_device[:, :3].T + world_from_device[:, 3])
        return math.atan2(end[1] - start[1], end[0] - start[0])

    return angle_rad(first), angle_rad(last)


def turn(a: float, b: float) -> float:
    return math.remainder(b - a, math.tau)


def bending(thumb: str, most_deg: float, rig: SimulatedRig, view: int) -> Iterator[Seen]:
    """Yield frames of a finger that is straight, bends to `most_deg`, and is straight again."""
    ramp = np.linspace(0.0, most_deg, BENDING_FRAMES)
    still = np.zeros(STRAIGHT_FRAMES)
    held = np.full(6, most_deg)
    bends_deg = np.concatenate([still, ramp, held, ramp[::-1], still[:STRAIGHT_AGAIN_FRAMES]])
    rng = np.random.default_rng(SEED)
    tracker = None
    for k, bend_deg in enumerate(bends_deg):
        hand = Hand(thumb=thumb, bend_deg=float(bend_deg))
        frame = rig.render(POSE, rng=rng, device=hand)
        if tracker is None:
            start = frame.truth.views[view].finger.start()
            at = StartPose(start.tip_px, math.radians(start.angle_deg), start.length_px)
            tracker = ContourTracker(Template.pistol(start.thumb), at)
        from_rad, to_rad = directions(rig.cameras[view], hand, POSE)
        track = tracker.update(frame.images[view], k * FRAME_S)
        yield Seen(turn(from_rad, to_rad), to_rad, track)


@pytest.mark.parametrize("thumb", ["up", "folded"])
@pytest.mark.parametrize("view", [0, 1])
def test_a_bent_finger_has_no_line_until_it_is_straight_again(thumb, view):
    seen = list(bending(thumb, 60.0, SimulatedRig(), view))
    assert max(abs(s.bend_rad) for s in seen) > math.radians(35)
    for k, s in enumerate(seen[4:], 4):
        result, bend_deg = s.track.diagnostics, abs(math.degrees(s.bend_rad))
        if bend_deg < 10:
            assert s.track.finger_line is not None, (k, bend_deg, result)
        if bend_deg < 1:
            assert abs(turn(s.angle_rad, s.track.finger_line.angle_rad)) < 0.02, k
        if bend_deg > 25:
            assert s.track.finger_line is None, (k, bend_deg)
            assert result.refusal == "misfit", (k, bend_deg, result)
        if result.bend_rad is not None:
            assert result.bend_rad == pytest.approx(s.bend_rad, abs=math.radians(8)), k
    assert all(s.track.status == "tracking" for s in seen[4:])


@pytest.mark.parametrize("clutter", [0.0, 50.0])
@pytest.mark.parametrize("taper", [0.0, 0.28])
def test_a_straight_finger_is_no_misfit(clutter, taper):
    rig = SimulatedRig(background=Background(clutter=clutter, seed=3))
    rng = np.random.default_rng(SEED)
    trackers = None
    for k in range(20):
        pose = replace(POSE, azimuth_deg=2.0 * k - 20.0)
        frame = rig.render(pose, rng=rng, device=Hand(taper=taper))
        if trackers is None:
            starts = [view.finger.start() for view in frame.truth.views]
            trackers = [
                ContourTracker(
                    Template.pistol(s.thumb),
                    StartPose(s.tip_px, math.radians(s.angle_deg), s.length_px),
                )
                for s in starts
            ]
        for tracker, image in zip(trackers, frame.images, strict=True):
            track = tracker.update(image, k * FRAME_S)
            assert track.diagnostics.refusal != "misfit", (k, track.diagnostics)
            if k > 3:
                assert track.finger_line is not None


def test_a_bend_along_the_viewing_direction_is_invisible():
    # Towards the camera, or away from it, the finger only appears shorter.
    rig = SimulatedRig()
    pose = DevicePose.pointing_at((200, 200), hover_mm=120, slant_deg=40, roll_deg=-90)
    shown = [
        abs(turn(*directions(camera, Hand(bend_deg=40.0), at)))
        for camera in rig.cameras
        for at in (POSE, pose)
    ]
    assert min(shown) < math.radians(15) < math.radians(25) < max(shown)
