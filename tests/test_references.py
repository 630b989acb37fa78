"""A motion of the camera is detected from the table, and nothing else is mistaken for one."""

import cv2
import numpy as np
import pytest

from fingerpost.homography import transfer_to_image
from fingerpost.references import MOVED_PX, TEST_EVERY, ReferenceWatch
from fingerpost.references.registration import PlaneRegistration
from fingerpost.simulate import Background, DevicePose, Hand, SimulatedRig, Trajectory

REFERENCES_PX = [(100.0, 90.0), (520.0, 110.0), (540.0, 400.0), (90.0, 380.0)]
RNG_SEED = 0x72656673


def table(width_px: int = 640, height_px: int = 480) -> np.ndarray:
    """A smooth random pattern with corners everywhere."""
    rng = np.random.default_rng(RNG_SEED)
    cells = rng.uniform(40, 200, (height_px // 12, width_px // 12)).astype(np.float32)
    return cv2.resize(cells, (width_px, height_px), interpolation=cv2.INTER_CUBIC)


def taken(picture: np.ndarray, seed: int = 1) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(0, 2, picture.shape)
    return np.clip(picture + noise, 0, 255).round().astype(np.uint8)


def moved(picture: np.ndarray, by: np.ndarray) -> np.ndarray:
    height, width = picture.shape
    return cv2.warpAffine(picture, by, (width, height), borderMode=cv2.BORDER_REFLECT)


def shift(u_px: float, v_px: float) -> np.ndarray:
    return np.array([[1.0, 0.0, u_px], [0.0, 1.0, v_px]])


def shown(watch: ReferenceWatch, pictures: list[np.ndarray]) -> float:
    """Show each picture for `TEST_EVERY` frames; return the reported motion [px]."""
    for picture in pictures:
        for _ in range(TEST_EVERY):
            watch.look(picture)
    return watch.moved_px


@pytest.mark.parametrize("size_px", [(320, 240), (640, 480), (1280, 960)])
@pytest.mark.parametrize("by_px", [(3.0, 0.0), (-4.0, 5.5), (25.0, -18.0)])
def test_a_shift_is_reported_in_pixels_of_the_picture(size_px, by_px):
    picture = table(*size_px)
    watch = ReferenceWatch(REFERENCES_PX)
    reported_px = shown(watch, [taken(picture), taken(moved(picture, shift(*by_px)), 2)])
    assert reported_px == pytest.approx(np.hypot(*by_px), abs=0.3 * size_px[0] / 320)


def test_a_doubted_camera_is_adrift_until_the_plane_is_seen_in_its_place():
    picture, another = table(), table()[::-1, ::-1].copy()
    watch = ReferenceWatch(REFERENCES_PX)
    shown(watch, [taken(picture), taken(another, 2)])
    assert not watch.is_adrift  # something may cover the table
    watch.doubt()
    shown(watch, [taken(another, 3)])
    assert watch.is_adrift
    shown(watch, [taken(picture, 4)])
    assert not watch.is_adrift


@pytest.mark.parametrize(("gain", "offset"), [(0.6, 0.0), (0.4, 5.0), (0.8, 50.0)])
def test_a_camera_that_returns_in_another_light_is_recognised(gain, offset):
    picture = table()
    watch = ReferenceWatch(REFERENCES_PX)
    shown(watch, [taken(picture)])
    watch.doubt()
    shown(watch, [taken(gain * picture + offset, 2)])
    assert not watch.is_adrift


def test_doubt_is_ignored_before_a_table_without_texture():
    watch = ReferenceWatch(REFERENCES_PX)
    shown(watch, [np.full((240, 320), 90, np.uint8)])
    watch.doubt()
    assert not watch.is_adrift


def test_a_rotation_is_a_motion_and_a_return_ends_it():
    picture = table()
    turned = moved(picture, cv2.getRotationMatrix2D((100.0, 60.0), 1.0, 1.0))
    watch = ReferenceWatch(REFERENCES_PX)
    assert shown(watch, [taken(picture), taken(turned, 2)]) > MOVED_PX
    assert shown(watch, [taken(picture, 3)]) == 0.0


@pytest.mark.parametrize(
    "later",
    [
        lambda picture: moved(picture, shift(0.4, -0.3)),
        lambda picture: 0.6 * picture,
        lambda picture: picture * np.linspace(0.5, 1.0, picture.shape[1]),
        lambda picture: cv2.GaussianBlur(picture, (0, 0), 1.5),
    ],
    ids=["a nudge", "less light", "a shadow", "out of focus"],
)
def test_a_nudge_or_a_change_of_light_or_focus_is_no_motion(later):
    picture = table()
    watch = ReferenceWatch(REFERENCES_PX)
    assert shown(watch, [taken(picture), taken(later(picture), 2)]) == 0.0


def test_a_moving_hand_and_sleeve_are_no_camera_motion():
    # Everything with corners moves; the plain table does not.
    plain = np.full((480, 640), 90.0, np.float32)
    sleeve = table(240, 260)

    def at(u: int) -> np.ndarray:
        picture = plain.copy()
        picture[:260, u : u + 240] = sleeve
        return taken(picture, u)

    watch = ReferenceWatch(REFERENCES_PX)
    assert shown(watch, [at(40), at(60), at(120), at(300)]) == 0.0


def test_a_moving_pointer_with_nearly_half_of_the_corners_is_no_camera_motion(monkeypatch):
    # On a table too dark for its pixels to be informative:
    monkeypatch.setattr(PlaneRegistration, "is_static", lambda *_: False)
    # Three static objects on a plain table, and a pointer with corners in two parts of the picture,
    # which starts so slowly that one motion of the camera nearly explains all five.
    tip = np.array([250.0, 30.0])

    def with_things(*places: tuple[int, int]) -> np.ndarray:
        picture = np.full((480, 640), 60.0, np.float32)
        for u, v in places:
            picture[v : v + 60, u : u + 90] = 150.0
        return cv2.GaussianBlur(picture, (0, 0), 1.0)

    still, pointer = (
        with_things((520, 40), (30, 250), (20, 380)),
        with_things((190, 60), (370, 180)),
    )
    watch = ReferenceWatch([(150.0, 20.0), (480.0, 20.0), (480.0, 260.0), (150.0, 260.0)])
    for k, step_px in enumerate((0.0, 0.4, 0.8, 1.2, 1.6, 2.0, 4.0, 9.0, 18.0, 30.0)):
        table_and_pointer = np.maximum(still, moved(pointer, shift(step_px, 0.3 * step_px)))
        for _ in range(TEST_EVERY):
            watch.look(taken(table_and_pointer, k), (tip + step_px, tip + step_px - 20.0, 3.0))
            assert watch.moved_px == 0.0, step_px


def test_reference_points_that_are_the_only_corners_reveal_a_motion():
    picture = np.full((480, 640), 60.0, np.float32)
    cv2.fillConvexPoly(picture, np.array(REFERENCES_PX, int), 200.0, cv2.LINE_AA)
    watch = ReferenceWatch(REFERENCES_PX)
    reported_px = shown(watch, [taken(picture), taken(moved(picture, shift(6.0, -4.0)), 2)])
    assert reported_px == pytest.approx(np.hypot(6.0, 4.0), abs=0.5)


def white_table() -> np.ndarray:
    """Faint lines, and a patterned mug with most of the corners and the strongest edges."""
    picture = np.full((480, 640), 205.0, np.float32)
    rng = np.random.default_rng(RNG_SEED)
    for k in np.cumsum(rng.integers(18, 50, 18)).tolist():
        cv2.line(picture, (k, 0), (k, 479), 190.0, 2)
        cv2.line(picture, (0, k), (639, k), 190.0, 2)
    picture = cv2.GaussianBlur(picture, (0, 0), 0.8)
    picture[370:460, 520:610] = table(90, 90)
    return picture


def with_shadow(picture: np.ndarray, u_px: int) -> np.ndarray:
    """The picture with a hard shadow of an object outside it."""
    shadow = np.zeros(picture.shape, np.float32)
    cv2.ellipse(shadow, (u_px, 200), (50, 35), 20.0, 0.0, 360.0, 1.0, -1)
    return picture * (1.0 - 0.45 * cv2.GaussianBlur(shadow, (0, 0), 1.0))


def test_a_faint_lattice_reveals_a_motion_beside_a_patterned_mug():
    watch = ReferenceWatch(REFERENCES_PX)
    picture = white_table()
    reported_px = shown(watch, [taken(picture), taken(moved(picture, shift(6.0, -4.0)), 2)])
    assert reported_px == pytest.approx(np.hypot(6.0, 4.0), abs=0.5)


def test_a_moving_shadow_on_a_white_table_displaces_no_reference_point():
    # The picture shifts to the left; a shadow with most of the strong edges moves to the right.
    watch = ReferenceWatch(REFERENCES_PX)
    off_px = []
    for k in range(40):
        by_px = -0.5 * max(k - 4, 0)
        watch.look(taken(with_shadow(moved(white_table(), shift(by_px, 0.0)), 150 + 4 * k), k))
        if watch.motion is not None:
            there_px = transfer_to_image(watch.motion.now_from_first, np.array(REFERENCES_PX))
            off_px.append(np.abs(there_px - REFERENCES_PX - [by_px, 0.0]).max())
    assert len(off_px) > 25
    assert max(off_px) < 1.0


def test_the_start_of_a_camera_motion_is_detected_in_the_next_picture():
    picture = 120.0 + 0.4 * (table() - 120.0)
    watch = ReferenceWatch(REFERENCES_PX)
    for k in range(TEST_EVERY + 2):
        watch.look(taken(picture, k))
    assert watch.moved_px == 0.0
    watch.look(taken(moved(picture, shift(1.0, 0.6)), 99))
    assert watch.moved_px == pytest.approx(np.hypot(1.0, 0.6), abs=0.3)


def test_an_approaching_hand_is_no_camera_motion():
    rig = SimulatedRig(device=Hand(), background=Background(texture="wood", sheet=70.0))
    over = DevicePose.pointing_at((200, 200), azimuth_deg=20, slant_deg=50, hover_mm=120)
    path = Trajectory.through([over.retreated(500.0), over], 0.5)
    rng = np.random.default_rng(RNG_SEED)
    watches = [ReferenceWatch(v.reference_points_px) for v in rig.truth(over).views]
    for k in range(int(path.duration_s * 30)):
        for watch, image in zip(
            watches, rig.render(path, time_s=k / 30, rng=rng).images, strict=True
        ):
            watch.look(image)
            assert watch.moved_px == 0.0, k


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("far_px", [-5.0, 700.0, 1e5, 1e12, -1e300])
def test_reference_points_may_lie_anywhere_outside_the_picture(far_px):
    references_px = [(far_px, 90.0), (520.0, far_px), (far_px, 400.0), (90.0, far_px)]
    watch, picture = ReferenceWatch(references_px), table()
    assert shown(watch, [taken(picture), taken(moved(picture, shift(0.4, 0.3)), 2)]) == 0.0
    reported_px = shown(watch, [taken(moved(picture, shift(6.0, -4.0)), 3)])
    assert reported_px == pytest.approx(np.hypot(6.0, 4.0), abs=0.5)


@pytest.mark.parametrize("shape", [(1, 1), (6, 8), (480, 640), (30, 2000)])
def test_a_table_without_texture_shows_no_motion(shape):
    watch = ReferenceWatch(REFERENCES_PX)
    for level in (0, 90, 255):
        assert shown(watch, [np.full(shape, level, np.uint8)]) == 0.0


def test_pictures_of_another_size_restart_the_watch():
    picture = table()
    watch = ReferenceWatch(REFERENCES_PX)
    assert shown(watch, [taken(picture), taken(moved(picture, shift(9.0, 0.0)))]) > MOVED_PX
    assert shown(watch, [taken(table(320, 240))]) == 0.0
