"""`ContourTracker` from Python, on drawn hands with a known axis."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fingerpost._core import Background, ContourTracker, FingerLine, StartPose, Template, Track
from fingerpost.errors import InvalidInputError

FRAME_S = 1 / 30
NOISE_GREY = 2.0


@dataclass(frozen=True)
class Hand:
    """A finger and a thumb, each a band with round ends, on a uniform background."""

    tip: tuple[float, float] = (320.0, 240.0)
    angle_rad: float = 0.5
    half_width_px: float = 10.0
    thumb: str = "left"
    thumb_angle_rad: float = 1.25
    grey: tuple[int, int] = (170, 90)

    @property
    def direction(self) -> np.ndarray:
        return np.array([np.cos(self.angle_rad), np.sin(self.angle_rad)])

    def draw(self, rng: np.random.Generator | None = None) -> np.ndarray:
        """Draw 640 × 480 px with area-sampled edges, blurred by 1 px."""
        tip, e, w = np.array(self.tip), self.direction, self.half_width_px
        outside = _beyond_band(tip - 130 * e, tip - w * e, w)
        if self.thumb != "none":
            side = {"left": -1.0, "right": 1.0}[self.thumb]
            angle = self.angle_rad + side * self.thumb_angle_rad
            root, along = tip - 90 * e, np.array([np.cos(angle), np.sin(angle)])
            outside = np.minimum(outside, _beyond_band(root, root + 66 * along, 0.9 * w))
        hand, background = self.grey
        image = background + (hand - background) * np.clip(0.5 - outside, 0.0, 1.0)
        image = cv2.GaussianBlur(image, (0, 0), 1.0)
        if rng is not None:
            image += rng.normal(0, NOISE_GREY, image.shape)
        return np.clip(np.round(image), 0, 255).astype(np.uint8)

    def error(self, line: FingerLine) -> np.ndarray:
        """Offset [px] at the line's anchor, and angle [rad], from the true axis to a line."""
        normal = np.array([-self.direction[1], self.direction[0]])
        offset = (np.array(line.anchor_px) - self.tip) @ normal
        turn = line.angle_rad - self.angle_rad
        return np.array([offset, np.arctan2(np.sin(turn), np.cos(turn))])


def _beyond_band(start: np.ndarray, end: np.ndarray, half_width_px: float) -> np.ndarray:
    """Distance of every pixel from a band with round ends; negative inside."""
    spine = end - start
    u, v = np.arange(640.0)[None, :] - start[0], np.arange(480.0)[:, None] - start[1]
    part = np.clip((u * spine[0] + v * spine[1]) / (spine @ spine), 0.0, 1.0)
    return np.sqrt((u - part * spine[0]) ** 2 + (v - part * spine[1]) ** 2) - half_width_px


def waving(hand: Hand, frames: int) -> list[Hand]:
    """Return a hand that oscillates at 0.3 Hz, by up to 3 px and 0.6° per frame."""
    times = FRAME_S * np.arange(frames)
    return [
        replace(
            hand,
            tip=(hand.tip[0] + 40 * np.sin(2 * t), hand.tip[1] + 30 * np.sin(1.5 * t)),
            angle_rad=hand.angle_rad + 0.15 * np.sin(2 * t),
        )
        for t in times
    ]


def waiting_for(hand: Hand, **options: object) -> ContourTracker:
    start = StartPose(hand.tip, hand.angle_rad, 90)
    return ContourTracker(Template.pistol(hand.thumb), start, options)


def follow(tracker: ContourTracker, images: list[np.ndarray], **more: object) -> list[Track]:
    return [tracker.update(image, FRAME_S * i, **more) for i, image in enumerate(images)]


def contents(track: Track) -> tuple[object, ...]:
    """Return a track's contents, for comparison bit by bit."""
    line, d = track.finger_line, track.diagnostics
    return (
        track.time_s,
        track.status,
        track.shape_names,
        None if track.shape_vector is None else track.shape_vector.tobytes(),
        None if track.shape_covariance is None else track.shape_covariance.tobytes(),
        line and (line.anchor_px, line.tip_px, line.angle_rad, line.covariance.tobytes()),
        (d.visible, d.hits, d.inliers, d.residual_rms_px, d.rank, d.iterations, d.accepted),
    )


HANDS = [
    Hand(),
    Hand(thumb="right", angle_rad=2.4),
    Hand(thumb="none", angle_rad=-1.0),
    Hand(grey=(60, 140), angle_rad=-2.9),
    Hand(half_width_px=13.0, thumb_angle_rad=1.0, angle_rad=3.1),
]


@pytest.mark.parametrize("model", ["ribbon", "paper"])
@pytest.mark.parametrize("hand", HANDS)
def test_the_axis_of_a_waving_hand_is_tracked(hand, model):
    rng = np.random.default_rng(HANDS.index(hand))
    truth = waving(hand, 36)
    tracks = follow(waiting_for(hand, model=model), [h.draw(rng) for h in truth])
    statuses = [track.status for track in tracks]
    acquired = statuses.index("tracking")
    assert acquired <= 6
    assert set(statuses[:acquired]) <= {"acquiring"}
    assert set(statuses[acquired:]) == {"tracking"}
    assert all(track.finger_line is None for track in tracks[:acquired])

    nees = []
    for h, track in zip(truth[acquired:], tracks[acquired:], strict=True):
        error = h.error(track.finger_line)
        assert abs(error[0]) < 0.08  # of 20 px width
        assert abs(error[1]) < np.radians(0.3)
        along = (np.array(track.finger_line.tip_px) - h.tip) @ h.direction
        assert abs(along) < 0.6
        nees.append(error @ np.linalg.solve(track.finger_line.covariance, error))
    if model == "ribbon":  # the paper's planar template does not fit this hand exactly
        assert 0.3 < np.mean(nees) < 3.0  # 2 for an exact covariance


def test_colour_and_grey_give_the_same_line():
    hand = Hand()
    images = [h.draw(np.random.default_rng(7)) for h in waving(hand, 20)]
    plain, coloured = waiting_for(hand), waiting_for(hand)
    for i, image in enumerate(images):
        colour = np.stack([image // 2, image, 255 - image], axis=2)
        a = plain.update(image, i * FRAME_S).finger_line
        b = coloured.update(image, i * FRAME_S, colour).finger_line
        assert (a is None) == (b is None)
    assert a is not None
    assert b.angle_rad == pytest.approx(a.angle_rad, abs=np.radians(0.1))
    assert b.tip_px == pytest.approx(a.tip_px, abs=0.3)


def over_cloth(hand: Hand | None, rng: np.random.Generator) -> np.ndarray:
    """A reddish hand over a cloth with waves in every channel, BGR."""
    v, u = np.mgrid[:480, :640]
    cover = np.zeros((480, 640)) if hand is None else replace(hand, grey=(255, 0)).draw() / 255
    planes = []
    for phase, level in enumerate((110, 130, 160)):
        cloth = 115 + 35 * np.sin(u / 6 + phase) * np.cos(v / 7 - 2 * phase)
        planes.append(cloth * (1 - cover) + level * cover)
    image = np.stack(planes, axis=2) + rng.normal(0, NOISE_GREY, (480, 640, 3))
    return np.clip(np.round(image), 0, 255).astype(np.uint8)


def test_a_known_background_reduces_the_error_of_the_line():
    # The errors in the frames of one film are correlated, so several films are averaged.
    errors: tuple[list[np.ndarray], list[np.ndarray]] = ([], [])
    films = range(17, 21)
    for film in films:
        rng = np.random.default_rng(film)
        background, trackers = Background(), [waiting_for(Hand()), waiting_for(Hand())]
        for _ in range(12):
            image = over_cloth(None, rng)
            background.observe(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), image)
        for i, hand in enumerate(waving(Hand(), 24)):
            image = over_cloth(hand, rng)
            grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
            background.look(grey, image)
            for tracker, behind, measured in zip(trackers, [background, None], errors, strict=True):
                line = tracker.update(grey, FRAME_S * i, image, background=behind).finger_line
                if line is not None:
                    measured.append(hand.error(line))
    known, unknown = (np.sqrt(np.mean(np.square(e), axis=0)) for e in errors)
    assert len(errors[0]) >= 18 * len(films)
    assert len(errors[1]) >= 12 * len(films)
    assert np.all(known < 0.75 * unknown)
    assert known[1] < np.radians(0.1)


CURVATURE_PER_PX = 1 / 800
"""Curvature of a finger as bent as straight ones may be: the arc rises 1 px over 80 px."""


def bent_finger(tip: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A bright finger 20 px wide along +u, its medial line a circular arc."""
    v, u = np.mgrid[:480, :640]
    radius_px = 1 / CURVATURE_PER_PX
    middle = tip + np.array([-55.0, radius_px])
    beside = np.abs(np.hypot(u - middle[0], v - middle[1]) - radius_px) - 10
    end = tip - np.array([10.0, -0.5 * CURVATURE_PER_PX * 45**2])
    ahead = np.where(u > end[0], np.hypot(u - end[0], v - end[1]) - 10, beside)
    cover = np.clip(0.5 - np.where(v < middle[1], ahead, 1.0), 0.0, 1.0)
    image = cv2.GaussianBlur(90 + 80 * cover, (0, 0), 1.0) + rng.normal(0, NOISE_GREY, v.shape)
    return np.clip(np.round(image), 0, 255).astype(np.uint8)


def moving(frames: int) -> Iterator[tuple[float, np.ndarray]]:
    """Yield the time and the tip position of a finger that oscillates."""
    for k in range(frames):
        yield FRAME_S * k, np.array([320.0 + 60 * np.sin(0.1 * k), 240.0 + 40 * np.sin(0.07 * k)])


JOINT_PX = 52.0
"""Distance from the tip to the joint of `knuckled_finger`."""


def knuckled_finger(tip: np.ndarray, turn_rad: float, rng: np.random.Generator) -> np.ndarray:
    """A finger 20 px wide along +u, in colour; behind its joint it turns and widens a little."""
    v, u = np.mgrid[:480, :640]
    end, joint = tip - (10.0, 0.0), tip - (JOINT_PX, 0.0)
    root = joint - 45.0 * np.array([np.cos(turn_rad), np.sin(turn_rad)])
    inside_px = np.full(v.shape, -np.inf)
    for first, last, half_width_px in [(end, joint, 10.0), (joint, root, 11.0)]:
        way = last - first
        part = ((u - first[0]) * way[0] + (v - first[1]) * way[1]) / (way @ way)
        part = np.clip(part, 0.0, 1.0)
        off_px = np.hypot(u - first[0] - part * way[0], v - first[1] - part * way[1])
        inside_px = np.maximum(inside_px, 10.0 + (half_width_px - 10.0) * part - off_px)
    cover = np.clip(0.5 + inside_px, 0.0, 1.0)[..., None]
    table, finger = np.array([70.0, 80.0, 60.0]), np.array([120.0, 140.0, 190.0])
    image = cv2.GaussianBlur(table + (finger - table) * cover, (0, 0), 1.0)
    noise = rng.normal(0, NOISE_GREY, image.shape)
    return np.clip(np.round(image + noise), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("turn_rad", [0.15, -0.15, 0.0])
def test_the_line_is_that_of_the_front_of_a_finger_bent_at_its_joint(turn_rad):
    rng = np.random.default_rng(5)
    start = StartPose((320.0, 240.0), 0.0, 90)
    tracker = ContourTracker(Template.pistol("none"), start)
    angles_rad = []
    for time_s, tip in moving(25):
        colour = knuckled_finger(tip, turn_rad, rng)
        grey = cv2.cvtColor(colour, cv2.COLOR_BGR2GRAY)
        line = tracker.update(grey, time_s, colour).finger_line
        angles_rad.append(np.nan if line is None else line.angle_rad)
    # Least-squares line through the medial line of the front, 0.76 to 5.6 half-widths behind the
    # tip.
    behind_px = np.linspace(7.6, 56.0, 1001)
    medial_px = -np.tan(turn_rad) * np.clip(behind_px - JOINT_PX, 0.0, None)
    front_rad = -np.polyfit(behind_px, medial_px, 1)[0]
    # A parabola through the whole finger would give it to a degree only.
    np.testing.assert_allclose(angles_rad[5:], front_rad, atol=np.radians(0.4))


def test_the_variance_of_a_bent_finger_does_not_vanish_with_more_frames():
    rng = np.random.default_rng(3)
    start = StartPose((320.0, 240.0), 0.0, 90)
    tracker = ContourTracker(Template.pistol("none"), start)
    sigmas_rad = []
    for time_s, tip in moving(60):
        line = tracker.update(bent_finger(tip, rng), time_s).finger_line
        sigmas_rad.append(np.nan if line is None else np.sqrt(line.covariance[1, 1]))
    # The end of a line of half-length h may be off by 0.32 of the bend κ h² / 3, which is the
    # spread of lines through other stretches of the finger. Here h is about 40 px.
    open_rad = np.sqrt(3) * 0.32 * CURVATURE_PER_PX * 40 / 3
    assert np.isfinite(sigmas_rad[5:]).all()
    np.testing.assert_allclose(sigmas_rad[-20:], open_rad, rtol=0.2)


def angle_sigmas_rad(grey: tuple[int, int], texture_grey: float) -> np.ndarray:
    """Standard deviation of the angle after many frames, with `grey` levels of hand and table.

    `texture_grey` is the standard deviation of the image's texture.
    """
    rng = np.random.default_rng(11)
    texture = cv2.GaussianBlur(rng.normal(0, 1, (480, 640)), (0, 0), 2.0)
    texture *= texture_grey / texture.std()
    hand = Hand(thumb="none", grey=grey)
    tracker, sigmas_rad = waiting_for(hand), []
    for i, there in enumerate(waving(hand, 50)):
        image = np.clip(np.round(there.draw(rng) + texture), 0, 255).astype(np.uint8)
        line = tracker.update(image, FRAME_S * i).finger_line
        sigmas_rad.append(np.nan if line is None else np.sqrt(line.covariance[1, 1]))
    return np.array(sigmas_rad[-20:])


def test_the_variance_of_a_finger_of_low_contrast_does_not_vanish_with_more_frames():
    # Each end may be off by 0.007 of the half-length.
    open_rad = np.sqrt(3) * 0.007
    np.testing.assert_allclose(angle_sigmas_rad((110, 80), 6.0), open_rad, rtol=0.15)
    assert np.all(angle_sigmas_rad((210, 80), 3.0) < 0.1 * open_rad)


def test_the_variance_of_a_finger_in_noise_alone_becomes_small():
    assert np.all(angle_sigmas_rad((104, 80), 0.0) < 0.1 * np.sqrt(3) * 0.007)


@pytest.mark.parametrize("way_rad", [0.3, 1.5, 2.6, -1.2])
def test_a_hand_that_returns_in_fast_motion_is_followed(way_rad: float):
    hand, empty = Hand(), np.full((480, 640), 90, np.uint8)
    # Per frame: beyond the range of any edge search.
    way_px = 60 * np.array([np.cos(way_rad), np.sin(way_rad)])
    passing = [replace(hand, tip=tuple(hand.tip + k * way_px)) for k in range(4)]
    tracker = waiting_for(hand, track={"lose_after_frames": 4})
    follow(tracker, [hand.draw()] * 8 + [empty] * 8)
    for k, seen in enumerate(passing):
        line = tracker.update(seen.draw(), FRAME_S * (16 + k)).finger_line
        assert line is not None
        assert abs(seen.error(line)[0]) < 0.3


def test_a_hand_that_leaves_is_lost_and_found_where_it_returns():
    hand, empty = Hand(), np.full((480, 640), 90, np.uint8)
    tracker = waiting_for(hand, track={"lose_after_frames": 4})
    image = hand.draw()
    tracks = follow(tracker, [image] * 8 + [empty] * 10 + [image] * 8)
    statuses = [track.status for track in tracks]
    assert statuses[7:12] == ["tracking"] * 4 + ["lost"]
    assert statuses[17] == "lost"
    assert statuses[-1] == "tracking"
    assert "acquiring" not in statuses[8:]
    for track in tracks[8:18]:
        assert track.finger_line is None
        assert track.shape_vector is None
        assert not track.diagnostics.accepted
    assert np.abs(hand.error(tracks[-1].finger_line)) == pytest.approx([0, 0], abs=0.02)


@pytest.mark.parametrize("model", ["ribbon", "paper"])
def test_the_same_frames_give_the_same_bits(model):
    hand = Hand()
    rng = np.random.default_rng(31)
    images = [h.draw(rng) for h in waving(hand, 15)]
    padded = [np.pad(image, ((0, 0), (13, 51)), mode="reflect")[:, 13:-51] for image in images]
    once = follow(waiting_for(hand, model=model), images)
    assert once[-1].status == "tracking"
    for again in [images, padded]:
        tracks = follow(waiting_for(hand, model=model), again)
        assert [contents(track) for track in tracks] == [contents(track) for track in once]


def test_the_shape_is_that_of_the_hand():
    hand = Hand(half_width_px=12.0)
    track = follow(waiting_for(hand), [hand.draw()] * 8)[-1]
    shape = dict(zip(track.shape_names, track.shape_vector, strict=True))
    assert shape["theta [rad]"] == pytest.approx(hand.angle_rad, abs=1e-3)
    assert shape["half_width [px]"] == pytest.approx(12.0, abs=0.15)
    assert shape["taper [1]"] == pytest.approx(0.0, abs=0.01)
    assert shape["thumb_half_width [px]"] == pytest.approx(0.9 * 12.0, abs=0.3)
    thumb = np.arctan2(shape["thumb_v [px]"], shape["thumb_u [px]"])
    assert thumb == pytest.approx(hand.angle_rad - hand.thumb_angle_rad, abs=0.02)
    covariance = track.shape_covariance
    assert covariance.shape == (9, 9)
    assert covariance == pytest.approx(covariance.T)
    assert (np.linalg.eigvalsh(covariance) > 0).all()


def test_contour_and_search_lines_lie_on_the_hand():
    hand = Hand()
    tracker = waiting_for(hand)
    waiting = tracker.contour()
    assert len(tracker.search_lines()) == 0
    assert np.linalg.norm(waiting - np.array(hand.tip), axis=1).min() < 3
    follow(tracker, [hand.draw()] * 8)
    tip, e, w = np.array(hand.tip), hand.direction, hand.half_width_px
    d = tracker.contour() - tip
    on_finger = (np.abs(d @ [-e[1], e[0]]) < 2 * w) & (d @ e > -60)
    assert on_finger.sum() > 20
    centre = np.minimum(d[on_finger] @ e, -w)[:, None] * e
    assert np.linalg.norm(d[on_finger] - centre, axis=1) == pytest.approx(w, abs=0.15)
    lines = tracker.search_lines()
    hits = lines.miss == ""
    assert hits.mean() > 0.9
    assert np.array_equal(hits, np.isfinite(lines.offset_px))
    assert np.median(lines.contrast_grey[hits]) == pytest.approx(80, rel=0.01)
    assert (lines.separation[hits] > 0).all()
    assert lines.agrees.dtype == bool
    assert not lines.agrees[~hits].any()
    assert lines.agrees.mean() > 0.9
    assert np.linalg.norm(lines.normal, axis=1) == pytest.approx(1)


def test_a_traced_template_is_tracked_by_the_papers_model():
    hand = Hand(thumb="none")
    pq = Template.pistol("none").outline(200)
    traced = Template.from_outline(pq, knuckle=(-0.5, 0), tip=(0.5, 0), hand="right")
    start = StartPose(hand.tip, hand.angle_rad, 90)
    tracker = ContourTracker(traced, start, {"model": "paper"})
    track = follow(tracker, [hand.draw()] * 8)[-1]
    assert track.status == "tracking"
    assert np.abs(hand.error(track.finger_line)) == pytest.approx([0, 0], abs=0.05)
    with pytest.raises(InvalidInputError, match="needs a pistol template"):
        ContourTracker(traced, start)


def test_foreshortening_is_limited_to_its_range():
    tracker = waiting_for(Hand())
    assert tracker.foreshortening == 1.0
    tracker.foreshortening = 0.7
    for wrong in (0.0, -0.5, 1.01, np.nan, np.inf):
        with pytest.raises(InvalidInputError, match=r"foreshortening is .*above 0 and at most 1"):
            tracker.foreshortening = wrong
    for wrong in ("1", None, True):
        with pytest.raises(InvalidInputError, match=r"foreshortening is .*a real number"):
            tracker.foreshortening = wrong
    assert tracker.foreshortening == 0.7


def test_times_must_not_decrease():
    hand = Hand()
    image, tracker = hand.draw(), waiting_for(hand)
    before = [contents(track) for track in follow(tracker, [image] * 8)]
    spoiled = waiting_for(hand)
    after = []
    for i in range(8):
        for wrong, complaint in [
            (np.nan, "frame time .* is NaN; it must be finite"),
            (np.inf, "frame time .* is inf"),
            ("0", "time_s is '0'; it must be a real number"),
            (FRAME_S * (i - 1.5), "frame time .*; it must be at or after the last frame's"),
        ]:
            if i == 0 and wrong == FRAME_S * -1.5:
                continue  # the first frame may have any time
            with pytest.raises(InvalidInputError, match=complaint):
                spoiled.update(image, wrong)
        after.append(contents(spoiled.update(image, FRAME_S * i)))
    assert after == before
    assert tracker.update(image, FRAME_S * 7).status == "tracking"  # equal times are allowed


SOUND: dict[str, Callable[[Track], bool]] = {
    "status": lambda t: t.status in {"acquiring", "tracking", "lost"},
    "line": lambda t: t.finger_line is None or t.status == "tracking",
    "shape": lambda t: (t.shape_vector is None) == (not t.diagnostics.accepted),
    "finite": lambda t: t.shape_vector is None or bool(np.isfinite(t.shape_vector).all()),
    "counts": lambda t: t.diagnostics.inliers <= t.diagnostics.visible,
}


@settings(max_examples=100)
@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from([(1, 1), (1, 300), (300, 1), (2, 2), (7, 9), (120, 160), (240, 320)]),
    st.sampled_from(["noise", "blocks", "flat", "lines"]),
    st.sampled_from(["ribbon", "paper"]),
    st.sampled_from(["left", "right", "none"]),
    st.booleans(),
)
def test_arbitrary_images_give_valid_tracks(seed, shape, kind, model, thumb, coloured):
    rng = np.random.default_rng(seed)
    start = StartPose(rng.uniform(-50, 350, 2), rng.uniform(-10, 10), 10 ** rng.uniform(-1, 3))
    options = {"model": model, "acquire": {"settle_frames": 1, "accept": {"min_inliers": 0.1}}}
    tracker = ContourTracker(Template.pistol(thumb), start, options)
    for i in range(4):
        if kind == "noise":
            image = rng.integers(0, 256, shape, dtype=np.uint8)
        elif kind == "blocks":
            blocks = rng.integers(0, 2, (shape[0] // 8 + 1, shape[1] // 8 + 1), dtype=np.uint8)
            image = np.kron(255 * blocks, np.ones((8, 8), np.uint8))[: shape[0], : shape[1]]
        elif kind == "flat":
            image = np.full(shape, rng.integers(0, 256), np.uint8)
        else:
            image = np.tile(rng.integers(0, 256, shape[1], dtype=np.uint8), (shape[0], 1))
        colour = rng.integers(0, 256, (*shape, 3), dtype=np.uint8) if coloured else None
        track = tracker.update(image, i * FRAME_S, colour)
        assert [name for name, sound in SOUND.items() if not sound(track)] == []
        if track.finger_line is not None:
            covariance = track.finger_line.covariance
            assert np.isfinite(covariance).all()
            assert (np.linalg.eigvalsh(covariance) > 0).all()
        assert np.isfinite(tracker.contour()).all()
        assert repr(track)


def before_its_shadow(shade: float, seed: int) -> np.ndarray:
    """A finger along +u with its tip at (200, 120), shaded on one side, and its shadow ahead."""
    v, u = np.indices((240, 320), dtype=float)
    away2 = ((u - 245.0) / 60.0) ** 2 + ((v - 120.0) / 45.0) ** 2
    table = (1.0 - 0.3 * np.exp(-1.5 * away2))[..., None] * [120.0, 140.0, 150.0]
    across, ahead = (v - 120.0) / 9.0, (u - 191.0) / 9.0
    is_finger = np.where(ahead <= 0.0, np.abs(across) <= 1.0, across**2 + ahead**2 <= 1.0)
    finger = (1.0 - 0.5 * shade * (across + 1.0))[..., None] * [95.0, 120.0, 160.0]
    covered = cv2.GaussianBlur(is_finger.astype(float), (0, 0), 1.0)[..., None]
    noise = np.random.default_rng(seed).normal(0.0, 2.5, (240, 320, 3))
    return np.clip(table + covered * (finger - table) + noise, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("shade", [0.2, 0.35])
@pytest.mark.parametrize("seed", range(3))
def test_a_finger_is_acquired_in_front_of_its_own_shadow(shade: float, seed: int):
    # The shadow resembles the finger's shaded side; a band of a pattern would resemble all of it.
    image = before_its_shadow(shade, seed)
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    tracker = ContourTracker(Template.pistol("none"), StartPose((200.0, 120.0), 0.0, 85.0))
    for k in range(3):
        track = tracker.update(grey, k / 30.0, image)
    assert track.finger_line is not None
    assert track.finger_line.tip_px == pytest.approx((200.0, 120.0), abs=2.0)
    assert abs(np.degrees(track.finger_line.angle_rad)) < 2.0
