"""Invalid input to `track` and `Pointer`: refused with a message that names value and place."""

import math
from pathlib import Path

import numpy as np
import pytest

import fingerpost
from fingerpost import Pointer, Rig
from fingerpost.capture import Frame
from fingerpost.errors import InvalidInputError
from fingerpost.simulate import DevicePose, Placement, SimulatedRig, Trajectory, write_recording

SIZE = (320, 240)
GREY = np.zeros(SIZE[::-1], np.uint8)


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Rig:
    pose = DevicePose.pointing_at((200.0, 200.0), azimuth_deg=20.0, slant_deg=50.0, hover_mm=120.0)
    simulated = SimulatedRig(Placement(width_px=SIZE[0], height_px=SIZE[1]))
    folder: Path = tmp_path_factory.mktemp("recording")
    return Rig.load(write_recording(folder, simulated, Trajectory.hold(pose, 1.0), frames=3))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"reference_sigma_px": -1}, "reference_sigma_px is -1; from"),
        ({"reference_sigma_px": 0.0}, "reference_sigma_px is 0.0; from"),
        ({"reference_sigma_px": math.nan}, "reference_sigma_px is nan"),
        ({"reference_sigma_px": math.inf}, "reference_sigma_px is inf"),
        ({"reference_sigma_px": 1e-300}, "reference_sigma_px is 1e-300"),
        ({"reference_sigma_px": "1"}, "reference_sigma_px: '1' found"),
        ({"max_frames": -1}, "max_frames is -1; a whole number from 0"),
        ({"max_frames": 2.5}, "max_frames is 2.5"),
        ({"max_frames": True}, "max_frames is True"),
        ({"max_frames": "2"}, "max_frames is '2'"),
        ({"pointing_options": None}, "pointing_options is None; PointingOptions are needed"),
        ({"pointing_options": {"nsigma": 3.0}}, "pointing_options is {'nsigma': 3.0}"),
        ({"tracker_options": "paper"}, "tracker_options is 'paper'; a mapping"),
        ({"tracker_options": {"modell": 1}}, 'tracker_options has no option "modell"'),
        ({"tracker_options": {"search": {"x": 1}}}, 'tracker_options.search has no option "x"'),
        ({"tracker_options": {"model": 3}}, "tracker_options.model is 3"),
    ],
)
def test_invalid_options_are_refused_by_name(rig, options, words):
    with pytest.raises(InvalidInputError) as raised:
        list(fingerpost.track(rig, **options))
    assert words in str(raised.value)
    assert str(raised.value).isprintable()


def test_the_name_of_a_rig_file_is_refused():
    with pytest.raises(InvalidInputError, match=r"rig is 'rig.toml'; a Rig is needed"):
        list(fingerpost.track("rig.toml"))


@pytest.mark.parametrize(("count", "fixes"), [(0, 0), (2, 2), (np.int64(2), 2), (10**20, 3)])
def test_max_frames_limits_the_number_of_fixes(rig, count, fixes):
    assert len(list(fingerpost.track(rig, max_frames=count))) == fixes


@pytest.mark.parametrize(
    ("image", "words"),
    [
        (GREY.astype(np.float64), "has the shape (240, 320) and type float64"),
        (GREY.astype(bool), "type bool"),
        (GREY[..., None], "has the shape (240, 320, 1)"),
        (np.zeros((240, 320, 4), np.uint8), "has the shape (240, 320, 4)"),
        (np.zeros(5, np.uint8), "has the shape (5,)"),
        (np.zeros((0, 0), np.uint8), "has the shape (0, 0); one pixel at least"),
        (np.zeros((240, 0, 3), np.uint8), "has the shape (240, 0, 3); one pixel at least"),
        (GREY.tolist(), "is a list"),
        (None, "is a NoneType"),
    ],
)
def test_invalid_images_are_refused_with_view_and_frame(rig, image, words):
    with pytest.raises(InvalidInputError) as raised:
        list(Pointer(rig).update([Frame(7, 0.0, GREY), Frame(7, 0.0, image)]))
    assert str(raised.value).startswith('view "right": the image of frame 7')
    assert words in str(raised.value)
    assert str(raised.value).isprintable()


@pytest.mark.parametrize("time_s", [math.nan, math.inf, "now", None])
def test_invalid_times_are_refused_with_view_and_frame(rig, time_s):
    with pytest.raises(InvalidInputError, match='view "left": time_s of frame 7 is'):
        list(Pointer(rig).update([Frame(7, time_s, GREY), None]))


@pytest.mark.parametrize(
    ("frames", "words"),
    [
        ([], "frames: 0 found; one for each of the 2 views"),
        ([None] * 3, "frames: 3 found"),
        (None, "frames: NoneType found"),
        (GREY, "frames: ndarray found"),
        ([GREY, GREY], 'view "left": ndarray found; a Frame is needed, or None'),
        ([None, "right.png"], 'view "right": str found'),
    ],
)
def test_invalid_sets_of_frames_are_refused(rig, frames, words):
    pointer = Pointer(rig)
    with pytest.raises(InvalidInputError) as raised:
        list(pointer.update(frames))
    assert words in str(raised.value)
    assert str(raised.value).isprintable()
    # It has not changed the pointer: the next frames are accepted.
    assert len(list(pointer.update([Frame(0, 0.0, GREY), Frame(0, 0.0, GREY)]))) == 1
