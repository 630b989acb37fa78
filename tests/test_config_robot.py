"""The rig file of a robot: its table, covariances, and cameras without a plane."""

import numpy as np
import pytest
from test_config import LEFT, PLANE, RIG, RIGHT, SQUARE_PX, load, rig_of, view

from fingerpost.config import Rig, RobotTable, Start, View
from fingerpost.errors import InvalidInputError, RigError
from fingerpost.pipeline import Pointer

__all__ = ["load"]  # the fixture

ROBOT = """
[robot]
url = "acl:///dev/ttyUSB0"
height_m = 0.02
region_m = [[0.3, -0.2], [0.5, -0.2], [0.5, 0.2]]
z_m = [0.01, 0.3]
pitch_deg = -90
"""

COVARIANCES = "reference_covariances_px2 = [[0.3, 0.1, 0.2], [1, 0, 1], [2, 1, 1], [1, 0, 4]]\n"
SURE = RIG + COVARIANCES  # of the last view


def test_the_robot_table_is_read_and_written(load, tmp_path):
    rig = load(RIG + ROBOT)
    assert rig.robot == RobotTable(
        url="acl:///dev/ttyUSB0",
        height_m=0.02,
        region_m=((0.3, -0.2), (0.5, -0.2), (0.5, 0.2)),
        z_m=(0.01, 0.3),
        pitch_deg=-90.0,
    )
    rig.save(tmp_path / "again.toml")
    assert Rig.load(tmp_path / "again.toml") == rig
    assert load(RIG).robot is None


@pytest.mark.parametrize(
    ("found", "instead", "said"),
    [
        ('url = "acl:///dev/ttyUSB0"', 'url = ""', "robot: url"),
        ("height_m = 0.02\n", "", "robot.height_m is missing; needed: the plane's Z"),
        ("height_m = 0.02", "height_m = nan", "robot: height_m"),
        ("[0.5, 0.2]]", "]", "robot: region_m: 2 corners found"),
        ("[0.5, 0.2]]", "[0.5]]", "robot.region_m"),
        ("z_m = [0.01, 0.3]", "z_m = [0.3, 0.01]", "robot: z_m is [0.3, 0.01]; the lower first"),
        ("pitch_deg", "pitch_rad", "did you mean pitch_deg?"),
        ("pitch_deg = -90", "pitch_deg = inf", "robot: pitch_deg"),
    ],
)
def test_a_mistake_in_the_robot_table_is_one_line(load, found, instead, said):
    text = (RIG + ROBOT).replace(found, instead)
    with pytest.raises(RigError) as caught:
        load(text)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def test_given_covariances_replace_the_default(load, tmp_path):
    rig = load(SURE)
    left, right = rig.views
    assert left.reference_covariances_px2 is None
    np.testing.assert_array_equal(
        left.reference_covariances(0.5), np.tile(0.25 * np.eye(2), (4, 1, 1))
    )
    np.testing.assert_array_equal(right.reference_covariances(0.5)[0], [[0.3, 0.1], [0.1, 0.2]])
    rig.save(tmp_path / "again.toml")
    assert Rig.load(tmp_path / "again.toml") == rig


def test_the_main_loop_uses_given_covariances():
    start = Start(tip_px=(50, 50), angle_deg=90.0, length_px=20.0, thumb="left")
    sure = tuple((0.01, 0.0, 0.01) for _ in SQUARE_PX)
    rigs = [
        rig_of(*(view(name, start=start, reference_covariances_px2=given) for name in "ab"))
        for given in (None, sure)
    ]
    assumed, exact = (Pointer(rig).plane_views[0].entries_covariance for rig in rigs)
    np.testing.assert_allclose(assumed, exact * (0.5 / 0.1) ** 2, rtol=1e-6)


@pytest.mark.parametrize(
    ("covariances", "said"),
    [
        (((1.0, 0.0, 1.0),), "1 found; one for each of the 4"),
        (((1.0, 0.0, 1.0),) * 3 + ((1.0, 1.0, 1.0),), r"px2\[3\] is \[1.0, 1.0, 1.0\]"),
        (((0.0, 0.0, 1.0),) * 4, r"px2\[0\]"),
        (((1.0, 0.0, float("nan")),) * 4, "nan"),
    ],
)
def test_invalid_covariances_are_refused(covariances, said):
    with pytest.raises(InvalidInputError, match=said):
        View(
            name="only",
            source="a.mp4",
            reference_points_px=SQUARE_PX,
            reference_covariances_px2=covariances,
        )


def test_cameras_without_a_plane_load_only_where_none_is_needed(tmp_path):
    bare = (LEFT + RIGHT).splitlines()
    text = "\n".join(line for line in bare if not line.startswith("reference_points_px"))
    path = tmp_path / "cameras.toml"
    path.write_text(text, encoding="utf-8")
    rig = Rig.load_cameras(path)
    assert rig.plane.unit == "undefined"
    assert [one.name for one in rig.views] == ["left", "right"]
    assert rig.views[0].source == str(tmp_path / "left" / "*.jpg")
    assert rig.views[0].lens is not None
    with pytest.raises(RigError, match="is missing"):
        Rig.load(path)
    path.write_text(RIG, encoding="utf-8")
    assert Rig.load_cameras(path) == Rig.load(path)
    path.write_text(PLANE + text, encoding="utf-8")
    with pytest.raises(RigError, match="reference_points_px is missing"):
        Rig.load_cameras(path)
    for broken in ("view = 3", "view = [3]", "[[view]]\nname = 3"):
        path.write_text(broken, encoding="utf-8")
        with pytest.raises(RigError):
            Rig.load_cameras(path)
