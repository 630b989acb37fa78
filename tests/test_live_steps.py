"""The steps of a set-up without a browser."""

import dataclasses
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from films import SIZE_PX
from live_server import RIG, served
from patience import wait_until
from sheets import corners_of_view
from test_remote import server  # noqa: F401 - a fixture

from fingerpost.capture import open_source, open_views, read_views
from fingerpost.checks import unused
from fingerpost.config import Rig
from fingerpost.errors import InvalidInputError
from fingerpost.formats import sides_of
from fingerpost.live.setup.aim import learn, places_on
from fingerpost.live.setup.asked import Arrange, Begin, Chosen, Held
from fingerpost.live.setup.dialogue import set_up
from fingerpost.live.setup.hand import held_wrong
from fingerpost.live.setup.offers import Offers
from fingerpost.live.setup.table import Table, guessed, judged
from fingerpost.live.setup.wording import page_words
from fingerpost.operators import Operator
from fingerpost.simulate import DevicePose, SimulatedRig, Trajectory, write_recording

HABIT = np.array([22.0, -15.0])
"""Offset of the simulated operator's points from the targets [mm]."""


class ScriptedPage:
    """A page that makes scripted requests and keeps the states and pictures it is shown."""

    def __init__(self, *asked):
        self._asked = list(asked)
        self.states, self.stills = [], {}

    def show_setup(self, state):
        self.states.append(state)

    def show_still(self, place, jpeg):
        self.stills[place] = jpeg

    def asked(self):
        return self._asked.pop(0)

    def is_asked(self):
        return False


@pytest.fixture
def films(tmp_path):
    for name in ("left.mp4", "right.mp4"):
        shutil.copy(RIG.with_name(name), tmp_path)
    return [str(tmp_path / name) for name in ("left.mp4", "right.mp4")]


def test_clicked_corners_are_assessed_and_wrong_input_is_refused(films, tmp_path):
    truth = Rig.load(RIG)
    held = Held((560.0, 60.0), 45.0, 70.0, "left")  # where there is no hand
    views = tuple(Chosen(k, view.reference_points_px, held) for k, view in enumerate(truth.views))
    page = ScriptedPage(
        Arrange((Chosen(0), Chosen(9)), "A4"),
        Arrange((Chosen(0, ((1.0, 1.0),)), Chosen(1)), "A4"),
        Arrange(views, "no such sheet"),
        Arrange(views, "400x400"),
        Begin(),
    )
    path, operator = set_up(page, tmp_path, [])
    assert operator is None
    problems = list(dict.fromkeys(state["problem"] for state in page.states if state["problem"]))
    assert problems[0] == "view 9 is none of those that are offered"
    assert "four corners" in problems[1]
    assert "no such sheet" in problems[2]
    judged_state = next(state for state in page.states if state["advice"])
    assert judged_state["advice"]["unit"] == "mm"
    assert 1.0 < judged_state["advice"]["median"] < judged_state["advice"]["most"] < 50.0
    assert [view["found"] for view in judged_state["table"]["views"]] == [False, False]
    saved = Rig.load(path)
    assert saved.views[0].start.tip_px == held.tip_px
    assert set(page.stills) == {0, 1}
    with open_source(films[0]) as source:
        frame = next(iter(source))
    assert "no hand is found" in held_wrong(saved.views[0], saved.views[0].start, [frame])


def test_darkness_and_a_narrow_base_line_are_reported_in_words(films):
    """A darkened clip, and two cameras side by side."""
    truth = Rig.load(RIG)
    offers = Offers(lambda *_: None)
    offers.add(films)
    for offer in offers.each:
        dark = [
            dataclasses.replace(frame, image=(frame.image // 16).astype(np.uint8))
            for frame in offer.frames
        ]
        offer.frames.clear()
        offer.frames.extend(dark)
    _, words = judged(truth, offers.each)
    assert any("dark" in word.text for word in words)

    left = truth.views[0]
    beside = tuple((u + 6.0, v) for u, v in left.reference_points_px)
    close = (left, type(left)(name="close", source=films[1], reference_points_px=beside))
    _, words = judged(Rig(plane=truth.plane, views=close), offers.each)
    assert any("apart" in word.text or "direction" in word.text for word in words), words


def test_the_sheet_on_the_table_is_recognised(tmp_path):
    rng = np.random.default_rng(5)
    a4 = [white_sheet(corners_of_view(rng)) for _ in range(2)]
    assert guessed(a4) == "A4"
    square = [white_sheet(corners_of_view(rng, size=(300.0, 300.0))) for _ in range(2)]
    assert guessed(square) == "400x400"
    assert guessed([np.zeros((480, 640), np.uint8)]) == "A4"


def test_a_letter_sheet_that_was_found_as_a4_is_named(tmp_path):
    rng = np.random.default_rng(0)
    for name in "ab":
        corners_px = corners_of_view(rng, size=sides_of("letter", "mm"))
        cv2.imwrite(str(tmp_path / f"{name}.png"), white_sheet(corners_px))
    offers, table = Offers(lambda *_: None), Table()
    places = offers.add([str(tmp_path / f"{name}.png") for name in "ab"])
    table.arrange(Arrange(tuple(map(Chosen, places)), "A4", finds=True), offers)
    _, words = judged(table.rig(offers), offers.each)
    assert any("the sides fit letter better than A4" in word.text for word in words), words


def white_sheet(corners_px):
    """A white sheet on a grey table, with a little noise."""
    picture = np.full((480, 640), 90, np.uint8)
    cv2.fillPoly(picture, [np.round(corners_px * 16).astype(np.int32)], 225, cv2.LINE_AA, shift=4)
    noise = np.random.default_rng(1).normal(0, 2, picture.shape)
    return np.clip(cv2.GaussianBlur(picture, (0, 0), 0.8) + noise, 0, 255).astype(np.uint8)


def test_a_simulated_operator_s_habit_is_learned_from_five_places(tmp_path):
    stops = [
        DevicePose.pointing_at(
            place.point + HABIT, azimuth_deg=20.0, slant_deg=50.0, hover_mm=120.0
        )
        for place in places_on(Rig.load(RIG))
    ]
    samples = np.repeat([Trajectory.hold(stop, 1.0).samples[0] for stop in stops], 2, axis=0)
    times_s = np.cumsum([0.0, *([0.44, 0.32] * 5)[:-1]])
    film = write_recording(
        tmp_path, SimulatedRig(), Trajectory(times_s, samples), frames=88, fps=25.0, rng=3
    )
    rig, states = Rig.load(film), []
    with open_views(rig.sources, rig.readings) as sources:
        aimed = learn(
            rig,
            iter(read_views(sources)),
            lambda: False,
            lambda state, _: states.append(state),
            dwell_s=0.2,
        )
    assert aimed.operator is not None, aimed.state
    off = np.subtract(aimed.state["visits"], aimed.state["places"])
    assert off == pytest.approx(np.tile(HABIT, (5, 1)), abs=4.0)
    assert aimed.state["off"] == pytest.approx(np.hypot(*HABIT), abs=3.0)
    assert aimed.state["left"] < 4.0
    counts = [len(state["visits"]) for state in states]
    assert counts == sorted(counts)
    assert max(state["share"] for state in states) > 0.5
    aimed.operator.save(tmp_path / "rig-operator.toml")
    assert Operator.load(tmp_path / "rig-operator.toml").habit.model == aimed.operator.habit.model


def test_a_calibration_that_is_stopped_learns_nothing():
    rig = Rig.load(RIG)
    with open_views(rig.sources, rig.readings) as sources:
        aimed = learn(rig, iter(read_views(sources)), lambda: True, lambda *_: None)
    assert aimed.operator is None
    assert aimed.state["visits"] == []


@pytest.mark.parametrize(
    ("message", "words"),
    [
        ("reference_points_px[2] is 4.0 px off the corner", "corner 3 is 4.0 px off the corner"),
        ("reference_points_px [0, 3] would lie behind", "corner 1, 4 would lie behind"),
        ("points are to be taken in the order [1, 0, 3, 2]", "taken in the order 2, 1, 4, 3"),
        (
            'view "a": reference_points_px = [[1.0, 2.0], [3.0, 4.0]] would be right',
            'view "a": corners at [1.0, 2.0], [3.0, 4.0] would be right',
        ),
        ("lens = { fx = 9, k1 = 0.1 } makes them straight", "an estimated lens makes them"),
        (
            "hold the hand where the template waits, or correct tip_px, angle_deg and length_px",
            "or move, turn and scale the template",
        ),
        ("offset_s = -0.20 more in its [[view]] brings them", "-0.20 s more in its times bring"),
    ],
)
def test_messages_name_no_key_of_the_rig_file(message, words):
    assert words in page_words(message)
    assert not re.search(r"_px|_s\b|_deg|plane\.points|\[\[?view|\w = ", page_words(message))


def test_names_of_existing_files_are_not_used(tmp_path):
    (tmp_path / "rig.toml").touch()
    (tmp_path / "rig-2.toml").touch()
    assert unused(tmp_path / "rig.toml") == tmp_path / "rig-3.toml"
    assert unused(tmp_path / "other.toml") == tmp_path / "other.toml"


def test_a_named_source_that_cannot_be_read_is_refused(tmp_path):
    with pytest.raises(InvalidInputError, match="no-film"):
        set_up(ScriptedPage(), tmp_path, [str(tmp_path / "no-film.mp4")])


def test_a_camera_is_shown_live_paused_and_resumed(server):  # noqa: F811
    shown = []
    offers = Offers(lambda place, jpeg: shown.append((place, jpeg)))
    offers.add([server.url("/camera/left")])
    assert offers[0].is_live
    wait_until(lambda: len({jpeg for _, jpeg in shown}) >= 2, "a second picture")
    assert offers[0].size_px == SIZE_PX
    offers.pause()
    count = len(shown)
    offers.resume()
    wait_until(lambda: len(shown) > count, "a picture after it was resumed")
    offers.pause()


@pytest.mark.parametrize(
    ("name", "headers", "status", "words"),
    [
        ("notes.txt", {}, 415, "no recording"),
        (".hidden.mp4", {}, 415, "no recording"),
        ("film.mp4", {"Content_Type": "text/plain"}, 415, "content-type"),
        ("film.mp4", {"Origin": "http://evil.example"}, 403, "Origin"),
    ],
)
def test_uploads_that_are_not_recordings_are_refused(setting_up, name, headers, status, words):
    found, text = dropped(setting_up, name, **headers)
    assert (found, words in text) == (status, True), text
    assert not list(setting_up.folder.iterdir())


@pytest.fixture(scope="module")
def setting_up(tmp_path_factory):
    folder: Path = tmp_path_factory.mktemp("empty")
    with served(folder=folder) as running:
        running.folder = folder
        wait_until(lambda: dropped(running, "notes.txt")[0] != 409, "the set-up")
        yield running


def dropped(running, name, **headers):
    """Drop a file onto the page; return status and text of the response."""
    given = {"Origin": running.base, "Cookie": running.cookie, **headers}
    given.setdefault("Content_Type", "application/octet-stream")
    return running.ask("PUT", f"/drop/{name}", **given)[:2]
