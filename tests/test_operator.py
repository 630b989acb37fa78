"""Calibration of an operator by dwelling, keys or times, and correction of fixes for his habit."""

import re
from collections import deque
from types import SimpleNamespace

import numpy as np
import pytest
from command_line import invoked

import fingerpost as fp
from fingerpost.calibration import (
    Calibration,
    Place,
    Stay,
    places_in,
    places_of,
    read_stays,
    visits_of,
)
from fingerpost.cli.calibrate_operator import _Prompt, _prompted
from fingerpost.errors import InvalidInputError
from fingerpost.habit import Habit
from fingerpost.operators import Operator, operator_file, operators_folder
from fingerpost.recording import PointRow, write_points
from fingerpost.simulate import DevicePose, SimulatedRig, Trajectory, write_recording

FIVE = np.array([[120, 120], [280, 120], [280, 280], [120, 280], [200, 200]], np.float64)
HABIT = np.array([24.0, -18.0])
STEP_S = 1 / 30
JITTER = 2.0
TARGETS = "".join(
    f'[[target]]\nname = "t{k}"\npoint = {point}\nradius = 20\n'
    for k, point in enumerate(FIVE.tolist())
)
RIG = f"""\
[plane]
unit = "mm"
points = [[0, 0], [400, 0], [400, 400], [0, 400]]

{TARGETS}
[[target]]
name = "home"
point = [390, 390]
radius = 9
rest = true

[[view]]
name = "left"
reference_points_px = [[234, 452], [567, 359], [422, 161], [126, 231]]

[[view]]
name = "right"
reference_points_px = [[128, 387], [471, 446], [533, 212], [232, 170]]
"""


@pytest.fixture(autouse=True)
def _own_settings(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "settings"))
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("APPDATA", str(tmp_path))


def places(points=FIVE):
    return [Place(f"t{k}", point) for k, point in enumerate(points)]


def session(stops, *, stay_s=1.3, way_s=0.7, seed=0):
    """Times and points of a hand that dwells at stops and moves uniformly between them."""
    rng = np.random.default_rng(seed)
    knots = np.repeat(np.asarray(stops, np.float64), 2, axis=0)
    ends_s = np.cumsum([0.0, *([stay_s, way_s] * len(stops))[:-1]])
    times_s = np.arange(0.0, ends_s[-1], STEP_S)
    points = np.stack([np.interp(times_s, ends_s, column) for column in knots.T], axis=1)
    return list(zip(times_s.tolist(), points + rng.normal(0, JITTER, points.shape), strict=True))


def rig_file(folder):
    (folder / "rig.toml").write_text(RIG, encoding="utf-8")
    return folder / "rig.toml"


def table_of(path, fixes):
    with write_points(path) as table:
        for frame, (time_s, point) in enumerate(fixes):
            x, y = point.tolist()
            table.write(PointRow(frame=frame, time_s=time_s, status="ok", x=x, y=y))


def operator(habit=HABIT, name="anna", scatter=0.0):
    noise = np.random.default_rng(4).normal(0, scatter, FIVE.shape) if scatter else 0.0
    return Operator(name, "mm", Habit.of(FIVE, FIVE + habit + noise))


# --- pointing at places -----------------------------------------------------------------------


def taken(calibration, fixes):
    return [visit.place.name for fix in fixes if (visit := calibration.take(*fix))]


def test_each_place_is_taken_once_when_the_hand_stays_there():
    calibration = Calibration(places(), 1.0)
    assert taken(calibration, session(FIVE + HABIT)) == ["t0", "t1", "t2", "t3", "t4"]
    assert calibration.next is None
    found = np.array([visit.point for visit in calibration.visits])
    assert found == pytest.approx(FIVE + HABIT, abs=JITTER)


def test_a_long_dwell_counts_once():
    calibration = Calibration(places(), 0.5)
    assert taken(calibration, session(FIVE[:2], stay_s=5.0)) == ["t0", "t1"]
    assert calibration.next.name == "t2"


def test_a_moving_hand_takes_no_place():
    calibration = Calibration(places(), 1.0)
    assert taken(calibration, session(FIVE, stay_s=0.05, way_s=1.2)) == []


def test_a_lost_hand_restarts_its_dwell():
    calibration = Calibration(places(), 1.0)
    hidden = [(time_s, None if time_s > 0.8 else point) for time_s, point in session(FIVE[:1])]
    late = [(time_s + 2.0, point) for time_s, point in session(FIVE[:1], stay_s=0.9)]
    assert taken(calibration, hidden + late) == []


def test_a_key_takes_the_latest_points():
    calibration = Calibration(places(), 60.0)
    assert calibration.press() is None
    for time_s, point in session([FIVE[0] - 50, FIVE[0]], stay_s=0.5):
        calibration.take(time_s, point)
    assert calibration.press().point == pytest.approx(FIVE[0], abs=2 * JITTER)
    assert calibration.press() is None  # nothing new yet
    assert calibration.next.name == "t1"


def test_each_prompt_is_printed_once_and_keys_take_places(capsys):
    calibration = Calibration(places(), 1.0)
    steps = [
        SimpleNamespace(fix=SimpleNamespace(time_s=time_s, point=point))
        for time_s, point in session(FIVE)
    ]
    pressed = deque(" x")
    followed = _prompted(steps, calibration, _Prompt(calibration, None, takes_key=True), pressed)
    for count, fix in enumerate(followed):
        calibration.take(*fix)
        if count == 10:
            pressed.append(" ")
    said = capsys.readouterr().err.splitlines()
    assert said[0] == '1: point at "t0" (120, 120) and stay there, or press the space bar'
    assert said[1] == "no point just now: hold the hand so that two views follow it"
    assert [line[0] for line in said[2:]] == ["2", "3", "4", "5"]
    assert calibration.next is None


@pytest.mark.parametrize(
    ("points", "words"),
    [
        (FIVE[:4], "4 places to point at; 5 different ones or more are needed"),
        ([*FIVE, FIVE[4]], "the place after 't4' is the same one"),
    ],
)
def test_unsuitable_places_are_refused(points, words):
    with pytest.raises(InvalidInputError) as raised:
        Calibration(places(points), 1.0)
    assert words in str(raised.value)


def test_places_come_from_the_rig_or_are_given(tmp_path):
    found = places_of(fp.Rig.load(rig_file(tmp_path)))
    assert [place.name for place in found] == ["t0", "t1", "t2", "t3", "t4"]  # without the rest
    given = places_in("1,2; -3.5 , 4e1;")
    assert [place.point.tolist() for place in given] == [[1.0, 2.0], [-3.5, 40.0]]
    for wrong in ("1,2;3", "1,2,3", "a,b", "1,nan"):
        with pytest.raises(InvalidInputError, match="is no place"):
            places_in(wrong)


def test_times_assign_points_to_places(tmp_path):
    table = tmp_path / "visits.csv"
    table.write_text("begin_s,end_s,target\n0,1,t0\n2,3,t1\n", encoding="utf-8")
    visits = visits_of(places(), read_stays(table), session(FIVE[:2]))
    assert [visit.place.name for visit in visits] == ["t0", "t1"]
    assert np.array([v.point for v in visits]) == pytest.approx(FIVE[:2], abs=JITTER)
    for stay, words in (
        (Stay("t9", 0.0, 1.0), "there is no target 't9'; known: t0, t1"),
        (Stay("t0", 8.0, 9.0), "target 't0': 0 fixes from 8 to 9 s; 3 with a point"),
    ):
        with pytest.raises(InvalidInputError) as raised:
            visits_of(places(), [stay], session(FIVE[:2]))
        assert words in str(raised.value)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("target,begin_s\nt0,1\n", "no column end_s; target,begin_s,end_s is needed"),
        ("target,begin_s,end_s\nt0,1\n", "line 2: begin_s is '1' and end_s ''"),
        ("target,begin_s,end_s\nt0,2,1\n", "line 2: end_s is to be later than begin_s"),
        ("target,begin_s,end_s\nt0,nan,1\n", "line 2: end_s is to be later than begin_s"),
    ],
)
def test_an_invalid_table_of_visits_is_refused(tmp_path, text, words):
    (tmp_path / "visits.csv").write_text(text, encoding="utf-8")
    with pytest.raises(InvalidInputError) as raised:
        read_stays(tmp_path / "visits.csv")
    assert words in str(raised.value)


# --- files ------------------------------------------------------------------------------------


def test_an_operator_is_read_as_it_was_written():
    before = operator(scatter=6.0)
    path = operator_file("anna")
    assert path == operators_folder() / "anna.toml"
    before.save(path)
    for name in ("anna", path):
        after = Operator.load(name)
        assert (after.name, after.unit) == ("anna", "mm")
        point, covariance = np.array([200.0, 200.0]), np.eye(2)
        meant = [one.habit.meant(point, covariance) for one in (before, after)]
        assert (meant[0].point == meant[1].point).all()
        assert (meant[0].covariance == meant[1].covariance).all()
    assert [file.name for file in path.parent.iterdir()] == ["anna.toml"]


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("bob", None, 'there is no operator "bob" in '),
        ("none.toml", None, "none.toml: there is no such file"),
        ("a/b", None, "operator 'a/b': a name, such as anna, or a file that ends in .toml"),
        ("", None, "operator ''"),
        ("x.toml", "unit = 3", "Expected `str`, got `int` - at `$.unit`"),
        ("x.toml", "unit = 'mm'\nvisits = []", "unknown field `visits`"),
        ("x.toml", "unit = 'mm'\nvisit = []", "0 different targets; a habit is estimated from 5"),
        ("x.toml", "what is this", "a file that `fingerpost calibrate-operator` wrote is needed"),
    ],
)
def test_an_invalid_operator_is_refused(tmp_path, monkeypatch, name, text, words):
    monkeypatch.chdir(tmp_path)
    operator().save(operator_file("anna"))
    if text is not None:
        (tmp_path / name).write_text(text, encoding="utf-8")
    with pytest.raises(InvalidInputError) as raised:
        Operator.load(name)
    assert words in str(raised.value)
    assert name != "bob" or "known: anna" in str(raised.value)


def test_an_operator_of_another_unit_or_type_is_refused(tmp_path):
    rig = fp.Rig.load(rig_file(tmp_path))
    metres = Operator("anna", "m", operator().habit)
    with pytest.raises(InvalidInputError, match="was calibrated in m, and the plane's unit is mm"):
        fp.Pointer(rig, operator=metres)
    with pytest.raises(InvalidInputError, match=r"Operator.load\(\) reads one"):
        fp.Pointer(rig, operator="anna")


# --- correction -------------------------------------------------------------------------------


def fix(point, reason=""):
    return fp.Fix(0.0, fp.Status.OK, (), np.array(point), 4.0 * np.eye(2), 0.5, reason)


def test_the_habit_is_subtracted_from_a_fix_and_its_covariance_added():
    anna = operator(scatter=6.0)
    after = anna.meant(fix([224.0, 182.0], "right is lost"), 80.0)
    assert after.status is fp.Status.OK
    assert after.point == pytest.approx([200.0, 200.0], abs=6.0)
    assert np.linalg.eigvalsh(after.covariance)[0] > 4.0 + anna.habit.scatter**2
    assert (after.reason, after.crossing_angle_rad) == ("right is lost", 0.5)


def test_a_fix_beyond_the_targets_says_so_and_is_refused_if_too_far():
    anna = operator(scatter=6.0)
    inside, near, far = (anna.meant(fix([x, 182.0]), 80.0) for x in (224.0, 420.0, 1200.0))
    assert inside.reason == ""
    assert near.status is fp.Status.OK
    assert near.reason.endswith(' mm beyond the targets of operator "anna"')
    assert np.linalg.det(near.covariance) > np.linalg.det(inside.covariance)
    assert (far.status, far.point) == (fp.Status.ILL_CONDITIONED, None)
    assert "beyond the targets" in far.reason
    assert 'with the habit of operator "anna"; at most 80 is accepted' in far.reason
    assert np.isfinite(far.covariance).all()


def test_a_fix_without_a_point_is_returned_unchanged():
    lost = fp.Fix(0.0, fp.Status.LOST, ())
    assert operator().meant(lost, 80.0) is lost


# --- the command line -------------------------------------------------------------------------


def test_the_command_learns_from_a_table_of_fixes(tmp_path):
    table_of(tmp_path / "points.csv", session(FIVE + HABIT))
    arguments = ["calibrate-operator", rig_file(tmp_path), "--points", tmp_path / "points.csv"]
    done = invoked(*arguments, "--operator", "anna")
    assert done.exit_code == 0, done.output
    assert re.search(r"habit +(29|30)\.?\d* mm, \w+; scatter", done.output)
    assert re.search(r"t4 +\+2[345][.\d]*, +-1[789][.\d]* ", done.output)
    assert f"saved          {operators_folder() / 'anna.toml'}" in done.output
    habit = Operator.load("anna").habit
    assert habit.error([[200, 200]])[0] == pytest.approx(HABIT, abs=JITTER)

    (tmp_path / "visits.csv").write_text(
        "target,begin_s,end_s\n" + "".join(f"t{k},{2 * k},{2 * k + 1}\n" for k in range(5)),
        encoding="utf-8",
    )
    other = tmp_path / "here" / "bob.toml"
    done = invoked(*arguments, "--visits", tmp_path / "visits.csv", "--operator", other)
    assert done.exit_code == 0, done.output
    assert Operator.load(other).habit.error([[200, 200]])[0] == pytest.approx(HABIT, abs=JITTER)


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (["--targets", "1,2;3,4"], "2 places to point at; 5 different ones"),
        (
            ["--dwell", "5"],
            "0 of 5 targets were pointed at, in their order; none was stayed on for 5",
        ),
        (["--operator", "points.csv/"], "a name, such as anna, or a file that ends in .toml"),
        (["--operator", "rig.toml"], "would overwrite rig.toml, the rig file"),
        (
            ["--targets", "280,280;120,120;280,120;200,200;120,280"],
            "points do not go with the targe",
        ),
    ],
)
def test_unsuitable_calibration_data_is_refused_in_one_line(tmp_path, monkeypatch, more, words):
    monkeypatch.chdir(tmp_path)
    rig_file(tmp_path)
    table_of(tmp_path / "points.csv", session(FIVE + HABIT))
    done = invoked(
        "calibrate-operator", "rig.toml", "--operator", "anna", "--points", "points.csv", *more
    )
    assert done.exit_code == 2, done.output
    assert words in done.output
    assert len(done.output.strip().splitlines()) == 1
    assert not operators_folder().exists()


def test_a_calibration_from_a_film_corrects_a_run_of_it(tmp_path):
    """A simulated hand dwells 30 mm beside each target; a run with its habit corrects that."""
    stops = [
        DevicePose.pointing_at(point, azimuth_deg=20.0, slant_deg=50.0, hover_mm=120.0)
        for point in (FIVE + HABIT)
    ]
    stay_s, way_s = 0.4, 0.4
    samples = np.repeat([Trajectory.hold(stop, 1.0).samples[0] for stop in stops], 2, axis=0)
    times_s = np.cumsum([0.0, *([stay_s, way_s] * 5)[:-1]])
    film = write_recording(
        tmp_path, SimulatedRig(), Trajectory(times_s, samples), frames=54, fps=15.0, rng=3
    )
    film.write_text(film.read_text(encoding="utf-8") + TARGETS, encoding="utf-8")
    done = invoked("calibrate-operator", film, "--operator", "anna", "--dwell", "0.2")
    assert done.exit_code == 0, done.output

    found = {}
    for name, more in (("raw", []), ("meant", ["--operator", "anna"])):
        done = invoked("run", film, "--points", tmp_path / f"{name}.csv", "--max-frames", 6, *more)
        assert done.exit_code == 0, done.output
        (*_, last) = (tmp_path / f"{name}.csv").read_text(encoding="utf-8").splitlines()
        found[name] = np.array(last.split(",")[3:7], np.float64)
    assert found["raw"][:2] - FIVE[0] == pytest.approx(HABIT, abs=8.0)
    assert found["meant"][:2] == pytest.approx(FIVE[0], abs=8.0)
    assert found["meant"][2] > found["raw"][2]
    fixes = list(fp.track(fp.Rig.load(film), max_frames=6, operator=fp.Operator.load("anna")))
    assert fixes[-1].point == pytest.approx(found["meant"][:2])
    assert fixes[-1].target == "t0"
