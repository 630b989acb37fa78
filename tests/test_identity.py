"""Identity of the hand: recognition, rejection of other appearances, and new numbers."""

from types import SimpleNamespace

import numpy as np
import pytest

from fingerpost import config
from fingerpost._core import StartPose
from fingerpost.capture import Frame
from fingerpost.finding.body import Body, distinguish_body_from_hands, meeting_point
from fingerpost.finding.identity import (
    MEMORY_S,
    PRESENTED_FRAMES,
    Appearance,
    Identity,
    Memory,
)
from fingerpost.finding.pairs import Viewpoint
from fingerpost.pipeline import Pointer
from fingerpost.pointing import PlaneView
from fingerpost.silhouette import Capsule
from fingerpost.simulate import DevicePose, Hand, RodAndProng, Sensor, SimulatedRig

HAND_COLOUR = (130.0, 158.0, 219.0)
STEEL = (148.0, 140.0, 133.0)
HALF_WIDTH_PX = 8.0


def appearance(
    levels=HAND_COLOUR, *, gain=1.0, half_width_px=HALF_WIDTH_PX, angle_rad=0.3, tip=(320.0, 240.0)
):
    """Return the appearance of a finger with these levels in a picture of that colour."""
    image = np.zeros((480, 640, 3), np.uint8)
    image[:] = np.clip(gain * np.array(levels), 0, 255)
    line = SimpleNamespace(tip_px=tip, angle_rad=angle_rad)
    return Appearance.of(Frame(0, 0.0, image), line, half_width_px)


def test_a_hand_is_recognised_in_other_light_and_at_another_distance():
    memory = Memory()
    memory.learn(appearance(), 1.0)
    changed = ({"gain": 0.6}, {"gain": 1.15}, {"half_width_px": 10.0}, {"angle_rad": 0.8})
    for other in (appearance(**change) for change in changed):
        assert memory.is_compatible(other, 2.0)
        assert memory.recognises(other, 2.0)


@pytest.mark.parametrize(
    "other", [appearance(STEEL), appearance((200.0, 60.0, 40.0)), appearance(half_width_px=24.0)]
)
def test_another_appearance_is_not_accepted_until_the_hand_is_forgotten(other):
    memory = Memory()
    memory.learn(appearance(), 1.0)
    assert not memory.is_compatible(other, 2.0)
    assert not memory.recognises(other, 2.0)
    assert memory.is_compatible(other, 1.1 + MEMORY_S)  # by then the hand is forgotten


def test_what_may_be_no_hand_is_not_remembered_in_place_of_a_forgotten_one():
    memory = Memory()
    memory.learn(appearance(), 1.0)
    forearm = appearance(half_width_px=30.0)
    memory.learn(appearance(), 2.0 + MEMORY_S / 2, is_certain=False)
    assert not memory.is_compatible(forearm, 1.1 + MEMORY_S)  # what is remembered is refreshed
    after_s = 3.0 + 2 * MEMORY_S
    memory.learn(forearm, after_s, is_certain=False)
    assert memory.is_compatible(appearance(), after_s)
    memory.learn(forearm, after_s)
    assert not memory.is_compatible(appearance(), after_s)


def test_a_hand_from_another_side_is_not_recognised():
    memory = Memory()
    memory.learn(appearance(angle_rad=0.3), 1.0)
    opposite = appearance(angle_rad=0.3 + np.pi)
    assert memory.is_compatible(opposite, 2.0)
    assert not memory.recognises(opposite, 2.0)


def test_an_incompatible_appearance_is_not_learned():
    memory = Memory()
    memory.learn(appearance(), 0.0)
    for k in range(100):
        memory.learn(appearance(STEEL), 0.03 * k)
    assert not memory.is_compatible(appearance(STEEL), 3.0)
    assert memory.recognises(appearance(), 3.0)


def test_grey_hands_are_compared_by_brightness_and_width():
    grey = np.full((480, 640), 150, np.uint8)
    line = SimpleNamespace(tip_px=(320.0, 240.0), angle_rad=0.0)
    seen = Appearance.of(Frame(0, 0.0, grey), line, HALF_WIDTH_PX)
    dark = Appearance.of(Frame(0, 0.0, grey // 12), line, HALF_WIDTH_PX)
    memory = Memory()
    memory.learn(seen, 0.0)
    assert memory.recognises(seen, 1.0)
    assert not memory.is_compatible(dark, 1.0)
    at_the_rim = SimpleNamespace(tip_px=(5.0, 5.0), angle_rad=0.8)
    assert Appearance.of(Frame(0, 0.0, grey), at_the_rim, HALF_WIDTH_PX) is None


def a_view(*, shows=True, sure=True, recognised=False, presented=None):
    return SimpleNamespace(
        shows_finger=shows, is_validated=sure, is_recognised=recognised, is_presented=presented
    )


def test_a_hand_keeps_its_number_while_any_view_follows_it():
    identity = Identity()
    identity.update([a_view(shows=False), a_view(shows=False)], 0.0)
    assert identity.hand.number == 0
    for time_s in (0.1, 0.2):
        identity.update([a_view(), a_view(shows=False)], time_s)
    identity.update([a_view(shows=False), a_view()], 0.3)
    assert identity.hand.number == 1


@pytest.mark.parametrize(
    ("recognised", "gap_s", "number"),
    [(True, 1.0, 1), (False, 1.0, 2), (True, MEMORY_S + 1.0, 2)],
)
def test_a_returning_hand_keeps_its_number_if_recognised_in_time(recognised, gap_s, number):
    identity = Identity()
    identity.update([a_view()], 0.0)
    identity.update([a_view(shows=False)], 0.1)
    identity.update([a_view(recognised=recognised)], 0.1 + gap_s)
    assert identity.hand.number == number


def test_a_validated_hand_held_at_its_template_is_presented():
    identity = Identity()
    for k in range(PRESENTED_FRAMES - 1):
        identity.update([a_view(presented=True), a_view(presented=True)], 0.03 * k)
    identity.update([a_view(presented=True), a_view(presented=False)], 0.2)
    assert not identity.hand.is_presented
    for k in range(PRESENTED_FRAMES):
        identity.update([a_view(presented=True, sure=False)], 0.3 + 0.03 * k)
    assert not identity.hand.is_presented  # it may be the table
    identity.update([a_view(presented=False)], 0.6)
    assert identity.hand.is_presented
    identity.update([a_view(shows=False)], 0.7)
    identity.update([a_view(presented=False)], 0.8)
    assert identity.hand == (2, False)


# --- moving bodies of the system -------------------------------------------------------------

RIG = SimulatedRig()
PLANE = np.array([[0.0, 0.0], [400.0, 0.0], [400.0, 400.0], [0.0, 400.0]])
ARM = [Capsule((200.0, 200.0, 20.0), (200.0, 200.0, 300.0), 40.0)]


class Shown:
    """A view stub that follows a finger with its tip at `tip_mm` in the world."""

    def __init__(self, camera, tip_mm, *, covered=True):
        on_table = np.pad(PLANE, ((0, 0), (0, 1)))
        view = PlaneView.from_reference_points(PLANE, camera.project(on_table), None)
        self.viewpoint = Viewpoint.of(view, (camera.width_px, camera.height_px))
        tip = None if tip_mm is None else camera.project(np.array(tip_mm, dtype=float))
        self.tip_px = None if tip is None else tuple(tip.ravel())
        self.may_show_body = covered and tip is not None
        self.decision = "not judged"

    def judge_body(self, *, is_hand):
        self.decision = is_hand


def is_hand_of(*tips_mm):
    views = [Shown(camera, tip) for camera, tip in zip(RIG.cameras, tips_mm, strict=True)]
    distinguish_body_from_hands(views, ARM)
    return [view.decision for view in views]


def test_the_tip_is_triangulated_from_two_views():
    tip_mm = (150.0, 120.0, 90.0)
    views = [Shown(camera, tip_mm) for camera in RIG.cameras]
    np.testing.assert_allclose(meeting_point(*views), tip_mm, atol=1e-6)


def test_a_hand_in_front_of_the_arm_is_distinguished_from_it():
    in_front, on_arm = (200.0, 60.0, 90.0), (200.0, 170.0, 100.0)
    assert is_hand_of(in_front, in_front) == [True, True]
    assert is_hand_of(on_arm, on_arm) == [False, False]
    assert is_hand_of(in_front, None) == [None, "not judged"]


def test_a_gripper_jaw_belongs_to_the_body_and_a_hand_pointing_past_it_does_not():
    view = Shown(RIG.cameras[0], (0.0, 0.0, 0.0)).viewpoint
    body = Body(view.silhouette(ARM))
    jaw, behind = RIG.cameras[0].project(np.array([(200.0, 190.0, 60.0), (200.0, 190.0, 160.0)]))
    line = SimpleNamespace(tip_px=tuple(jaw), anchor_px=tuple((jaw + behind) / 2))
    assert body.shows_as(line)
    away = np.array([jaw[0] + 90.0, jaw[1]])
    past = SimpleNamespace(tip_px=tuple(jaw), anchor_px=tuple((jaw + away) / 2))
    assert not body.shows_as(past)
    angle_rad = float(np.arctan2(*(jaw - behind)[::-1]))
    assert body.shows_at(StartPose(tuple(jaw), angle_rad, float(np.linalg.norm(jaw - behind))))
    assert not Body.none().shows_as(line)
    assert not body.shows_as(None)


def test_a_stick_does_not_replace_a_hand_that_has_left():
    rig = SimulatedRig(device=Hand(), sensor=Sensor(channels="bgr"))
    stick = RodAndProng(length_mm=200.0, diameter_mm=16.0, prong_length_mm=0.0)
    on_table = np.pad(PLANE, ((0, 0), (0, 1)))
    views = tuple(
        config.View(
            name=camera.name,
            source=camera.name,
            reference_points_px=tuple(map(tuple, camera.project(on_table).tolist())),
        )
        for camera in rig.cameras
    )
    plane = config.Plane(unit="mm", points=tuple(map(tuple, PLANE.tolist())))
    pointer, rng = Pointer(config.Rig(plane=plane, views=views)), np.random.default_rng(3)

    def ok_frames(first, count, device):
        """Return the number of frames with a point while a device, if any, is pointing."""
        fixes = []
        for k in range(first, first + count):
            pose = DevicePose.pointing_at(
                (150 + 60 * np.sin(k / 30), 150 + k), hover_mm=80, azimuth_deg=20, slant_deg=40
            )
            images = rig.render(pose if device else None, device=device, rng=rng).images
            frames = [Frame(k, k / 30, image) for image in images]
            fixes += [step.fix.status for step in pointer.update(frames)]
        return fixes.count("ok")

    assert ok_frames(0, 12, None) == 0
    assert ok_frames(12, 40, rig.device) > 30
    assert ok_frames(52, 8, None) == 0
    assert ok_frames(60, 40, stick) == 0
    assert ok_frames(100, 40, rig.device) > 20
