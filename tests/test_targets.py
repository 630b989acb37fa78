"""Targets: their probabilities, their tables in the rig file, and events of selection."""

import json
import math

import numpy as np
import pytest
from click.testing import CliRunner
from geometry_rig import finger_line, plane_view, seen_rod, stereo

import fingerpost as fp
from fingerpost.cli import main
from fingerpost.config import TargetTable
from fingerpost.errors import InvalidInputError
from fingerpost.pointing import PointingOptions, indicated_point
from fingerpost.selection import Event, EventKind, Selector
from fingerpost.simulate import DevicePose, SimulatedRig, Trajectory, write_recording
from fingerpost.targets import Target, Targets

# Tolerance of a probability that is averaged over 2000 places; see NODES.
SHARE = 0.003


def disc(name: str, x: float, y: float, radius: float, *, rest: bool = False) -> Target:
    return Target(name, [[x, y]], radius, rest)


def box(name: str, x0: float, y0: float, x1: float, y1: float, radius: float = 0.0) -> Target:
    return Target(name, [[x0, y0], [x1, y0], [x1, y1], [x0, y1]], radius)


@pytest.mark.parametrize("sigma", [3.0, 8.0, 30.0])
def test_a_disc_around_the_point_has_the_probability_of_its_radius(sigma):
    found = Targets([disc("cup", 70, 90, 12)]).probabilities([70, 90], sigma**2 * np.eye(2))
    assert found["cup"] == pytest.approx(1 - math.exp(-(12**2) / (2 * sigma**2)), abs=SHARE)
    assert found["cup"] + found[None] == pytest.approx(1.0)


def normal_share(low: float, high: float) -> float:
    return (math.erf(high / math.sqrt(2)) - math.erf(low / math.sqrt(2))) / 2


def test_boxes_have_the_probabilities_of_an_elongated_normal_distribution():
    boxes = Targets([box("left", -50, -8, 0, 8), box("right", 0, -8, 50, 8)])
    found = boxes.probabilities([5.0, 2.0], np.diag([20.0**2, 6.0**2]))
    across = normal_share(-10 / 6, 6 / 6)
    assert found["left"] == pytest.approx(normal_share(-55 / 20, -5 / 20) * across, abs=2 * SHARE)
    assert found["right"] == pytest.approx(normal_share(-5 / 20, 45 / 20) * across, abs=2 * SHARE)


def test_any_shape_has_the_probability_of_random_samples():
    shape = Target("L", [[0, 0], [60, 0], [60, 20], [20, 20], [20, 60], [0, 60]], radius=5.0)
    covariance = np.array([[300.0, 180.0], [180.0, 400.0]])
    drawn = np.random.default_rng(3).multivariate_normal([30, 25], covariance, 100_000)
    # The distance from an L is the smaller of the distances from its two boxes.
    away = [
        np.hypot(*np.maximum(np.abs(drawn - middle) - half, 0.0).T)
        for middle, half in (((30, 10), (30, 10)), ((10, 30), (10, 30)))
    ]
    expected = np.mean(np.minimum(*away) <= 5.0)
    found = Targets([shape]).probabilities([30, 25], covariance)
    assert found["L"] == pytest.approx(expected, abs=2 * SHARE)


def test_a_place_on_overlapping_targets_belongs_to_one_of_them():
    targets = Targets([disc("a", 0, 0, 30), disc("b", 40, 0, 30)])
    assert targets.at([[18, 0], [22, 0], [-31, 0]]).tolist() == [0, 1, -1]
    found = targets.probabilities([20, 0], 25 * np.eye(2))
    assert found["a"] == pytest.approx(found["b"], abs=2 * SHARE)
    assert sum(found.values()) == pytest.approx(1.0)


def test_a_point_known_exactly_is_on_one_target_or_on_none():
    targets = Targets([disc("a", 0, 0, 10), box("b", 20, 0, 30, 10)])
    for point, name in (([3, 3], "a"), ([25, 5], "b"), ([15, 0], None)):
        assert targets.probabilities(point, np.zeros((2, 2)))[name] == 1.0


def test_probabilities_are_calibrated_including_that_of_no_target():
    """Nine in ten of the answers with probability 0.9 are right; likewise for other values."""
    rng = np.random.default_rng(11)
    cameras = stereo()
    views = [plane_view(camera) for camera in cameras]
    # 40 mm apart, on about two thirds of the plane; rods point anywhere, at a target or at none.
    targets = Targets(
        [disc(f"{x} {y}", x, y, 18.0) for x in range(20, 400, 40) for y in range(20, 400, 40)]
    )
    noise = np.diag([0.25**2, 0.008**2])
    stated, right = [], []
    for _ in range(2500):
        rod = seen_rod(rng, cameras)
        lines = [
            finger_line(camera, rod, noise, noise=rng.normal(0, np.sqrt(np.diag(noise))))
            for camera in cameras
        ]
        fix = indicated_point(lines, views, time_s=0.0, options=PointingOptions())
        if fix.point is None:
            continue
        answers = targets.probabilities(fix.point, fix.covariance)
        best = max(answers, key=answers.__getitem__)
        (at,) = targets.at([rod.target])
        names = [target.name for target in targets]
        stated.append(answers[best])
        right.append((names[at] if at >= 0 else None) == best)
    stated, right = np.array(stated), np.array(right)
    sure = (stated > 0.8) & (stated < 0.97)
    assert sure.sum() > 400
    assert right[sure].mean() == pytest.approx(stated[sure].mean(), abs=0.03)
    assert right.mean() == pytest.approx(stated.mean(), abs=0.03)


# --- rig file ---------------------------------------------------------------------------------

RIG = """\
[plane]
unit = "mm"
points = [[0, 0], [400, 0], [400, 400], [0, 400]]

[[target]]
name = "cup"
point = [100, 100]
radius = 20

[[target]]
name = "home"
polygon = [[300, 300], [400, 300], [400, 400]]
rest = true

[[view]]
name = "left"
reference_points_px = [[234, 452], [567, 359], [422, 161], [126, 231]]
"""


def load(folder, text: str) -> fp.Rig:
    (folder / "rig.toml").write_text(text, encoding="utf-8")
    return fp.Rig.load(folder / "rig.toml")


def test_targets_of_a_rig_are_read_as_they_were_saved(tmp_path):
    rig = load(tmp_path, RIG)
    assert [target.rest for target in rig.things] == [False, True]
    rig.save(tmp_path / "again.toml")
    assert fp.Rig.load(tmp_path / "again.toml") == rig


@pytest.mark.parametrize(
    ("found", "instead", "words"),
    [
        ("radius = 20\n", "", "target[0]: radius of target 'cup' is 0.0; from"),
        ("point = [100, 100]\n", "", 'target[0]: target "cup" has neither of point and polygon'),
        ("rest = true", "point = [1, 2]", 'target[1]: target "home" has both of point and polyg'),
        ("[400, 400]]\nrest", "[500, 300]]\nrest", "three corners or more, not on a line"),
        ('"home"', '"cup"', 'target: 2 targets are called "cup"; each needs a name of its own'),
        ("radius = 20", "radious = 20", "target[0].radious is not a key of a rig file; did you"),
        ("point = [100, 100]", "point = 3", "target[0].point is 3; needed: its middle"),
    ],
)
def test_invalid_targets_are_refused_by_name(tmp_path, found, instead, words):
    assert found in RIG
    with pytest.raises(InvalidInputError) as raised:
        load(tmp_path, RIG.replace(found, instead, 1))
    assert words in str(raised.value)


def test_targets_can_be_made_in_python():
    assert TargetTable(name="cup", point=np.array([1, 2]), radius=3).point == (1.0, 2.0)


# --- events -----------------------------------------------------------------------------------


def fix(time_s: float, **targets: float) -> fp.Fix:
    """A fix with probabilities of targets; the remainder is the probability of none."""
    answers = {None: 1.0 - sum(targets.values()), **targets}
    return fp.Fix(time_s, fp.Status.OK, (), np.zeros(2), np.eye(2), targets=answers)


def lost(time_s: float) -> fp.Fix:
    return fp.Fix(time_s, fp.Status.LOST, ())


def lines_of(events: list[Event]) -> list[str]:
    return [f"{event.time_s:g} {event.event} {event.target} {event.by}".strip() for event in events]


def played(selector: Selector, fixes: list[fp.Fix]) -> list[str]:
    return lines_of([event for one in fixes for event in selector.update(one)])


TABLE = Targets([disc("cup", 0, 0, 9), disc("jug", 40, 0, 9)])
WITH_REST = Targets([*TABLE, disc("home", 99, 99, 9, rest=True)])


def test_dwelling_selects_once_until_the_hand_has_left():
    selector = Selector(TABLE, dwell_s=0.5)
    stay = [fix(k / 10, cup=0.8) for k in range(20)]
    assert played(selector, stay) == ["0 enter cup", "0.5 select cup dwell"]
    away = [fix(2.0), *(fix(2.1 + k / 10, cup=0.9) for k in range(7))]
    assert played(selector, away) == ["2 leave cup", "2.1 enter cup", "2.6 select cup dwell"]


def test_a_passing_hand_selects_nothing():
    selector = Selector(TABLE, dwell_s=0.5)
    fixes = [fix(k / 10, **{name: 0.9}) for k, name in enumerate(["cup"] * 4 + ["jug"] * 4)]
    assert played(selector, fixes) == ["0 enter cup", "0.4 leave cup", "0.4 enter jug"]


def test_fluctuating_probabilities_cause_no_repeated_events():
    selector = Selector(TABLE, dwell_s=0.5)
    shares = [0.6, 0.45, 0.3, 0.55, 0.4, 0.35, 0.6, 0.2]
    fixes = [fix(k / 10, cup=share) for k, share in enumerate(shares)]
    assert played(selector, fixes) == ["0 enter cup", "0.5 select cup dwell", "0.7 leave cup"]


def test_a_briefly_hidden_hand_has_not_left():
    selector = Selector(TABLE, dwell_s=0.5)
    hidden = [fix(0.0, cup=0.9), lost(0.1), lost(0.2), fix(0.3, cup=0.9), fix(0.5, cup=0.9)]
    assert played(selector, hidden) == ["0 enter cup", "0.5 select cup dwell"]
    assert played(selector, [lost(0.7), lost(0.9)]) == ["0.9 leave cup"]


def test_with_a_rest_target_each_selection_needs_a_rest_before():
    selector = Selector(WITH_REST, dwell_s=0.5)

    def stay(start_s: float, name: str) -> list[str]:
        fixes = [fix(start_s + k / 10, **{name: 0.9}) for k in range(10)]
        return [line for line in played(selector, fixes) if "select" in line]

    assert stay(0.0, "cup") == []  # the hand has not been at rest yet
    assert stay(1.0, "home") == []
    assert stay(2.0, "jug") == ["2.5 select jug dwell"]
    assert stay(3.0, "cup") == []
    assert stay(4.0, "home") == []
    assert stay(5.0, "cup") == ["5.5 select cup dwell"]


def test_a_key_selects_the_target_at_the_hand():
    selector = Selector(WITH_REST, dwell_s=None)
    assert selector.press(0.0) == []
    assert played(selector, [fix(k / 10, cup=0.7) for k in range(30)]) == ["0 enter cup"]
    assert selector.press(2.9) == [Event(2.9, EventKind.SELECT, "cup", 0.7, "key")]
    selector.update(fix(3.0, home=0.9))
    assert selector.press(3.0) == []


def test_the_command_writes_events_of_a_film(tmp_path):
    pose = DevicePose.pointing_at((200.0, 180.0), azimuth_deg=20.0, slant_deg=50.0, hover_mm=120.0)
    rig_file = write_recording(
        tmp_path, SimulatedRig(), Trajectory.hold(pose, 1.0), frames=20, rng=3
    )
    runner = CliRunner()
    done = runner.invoke(main, ["run", str(rig_file), "--events"])
    assert done.exit_code == 2
    assert "has no [[target]]" in done.output
    cup = '[[target]]\nname = "cup"\npoint = [200, 180]\nradius = 25\n'
    rig_file.write_text(rig_file.read_text(encoding="utf-8") + cup, encoding="utf-8")

    done = runner.invoke(main, ["run", str(rig_file), "--dwell", "0.3", "--events"])
    assert done.exit_code == 0, done.output
    entered, selected = map(json.loads, done.output.splitlines())
    assert (entered["event"], entered["target"], entered["by"]) == ("enter", "cup", "")
    assert (selected["event"], selected["by"]) == ("select", "dwell")
    assert selected["probability"] > 0.9

    events = tmp_path / "events.jsonl"
    arguments = ["run", str(rig_file), "--dwell", "0.3", "--events", str(events)]
    assert "frames   20" in runner.invoke(main, arguments).output
    assert events.read_text(encoding="utf-8") == done.output

    fixes = list(fp.track(fp.Rig.load(rig_file)))
    assert fixes[-1].target == "cup"
    assert sum(fixes[-1].targets.values()) == pytest.approx(1.0)
    assert (fixes[0].target, fixes[0].targets) == (None, {})
