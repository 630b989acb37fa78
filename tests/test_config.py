"""The rig file: loading, saving, and a one-line error for every mistake."""

import math
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fingerpost.config import FixedReference, LensParameters, Plane, Rig, Start, View
from fingerpost.errors import DegenerateReferencePointsError, InvalidInputError, RigError

PLANE = """\
[plane]
unit = "mm"
points = [[0, 0], [400, 0], [400, 400], [0, 400]]
"""

LEFT = """
[[view]]
name = "left"
source = "left/*.jpg"
reference_points_px = [[234.2, 452.8], [567.7, 359.2], [422.3, 161.3], [126.2, 231.3]]
reference = { kind = "fixed" }
lens = { fx = 1692, fy = 1692, cx = 319.5, cy = 239.5, k1 = -0.1 }
[view.start]
tip_px = [194.6, 211.9]
angle_deg = 43.7
length_px = 71.1
thumb = "left"
"""

RIGHT = """
[[view]]
name = "right"
source = 1
reference_points_px = [[128.1, 387.0], [470.9, 445.7], [533.4, 211.5], [231.5, 169.6]]
"""

RIG = PLANE + LEFT + RIGHT

SQUARE = ((0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0))
SQUARE_PX = ((10.0, 10.0), (90.0, 12.0), (88.0, 95.0), (9.0, 91.0))


def rig_of(*views: View) -> Rig:
    return Rig(plane=Plane(unit="m", points=SQUARE), views=views)


def view(name: str = "only", **changes: object) -> View:
    whole = View(name=name, source="a.mp4", reference_points_px=SQUARE_PX)
    return msgspec.structs.replace(whole, **changes)


@pytest.fixture
def load(tmp_path: Path):
    def load(text: str) -> Rig:
        path = tmp_path / "rig.toml"
        path.write_text(text, encoding="utf-8")
        return Rig.load(path)

    return load


def test_a_rig_file_is_loaded(load, tmp_path):
    rig = load(RIG)

    assert rig.plane.unit == "mm"
    assert rig.plane.points == ((0, 0), (400, 0), (400, 400), (0, 400))
    left, right = rig.views
    assert (left.name, left.source) == ("left", str(tmp_path / "left/*.jpg"))
    assert left.reference_points_px[3] == (126.2, 231.3)
    assert left.reference == FixedReference()
    assert left.start == Start(tip_px=(194.6, 211.9), angle_deg=43.7, length_px=71.1, thumb="left")
    assert (left.lens.fx, left.lens.cy, left.lens.k1, left.lens.k2) == (1692, 239.5, -0.1, 0)
    assert (right.name, right.source) == ("right", 1)
    assert right.start is None
    assert right.lens is None


@pytest.mark.parametrize("source", ["http://host/a.mjpg", "rtsp://host:554/1", "/data/a.mp4"])
def test_urls_and_absolute_paths_are_not_relative_to_the_file(load, source):
    assert load(RIG.replace("left/*.jpg", source)).views[0].source == source


def test_a_byte_order_mark_and_windows_line_ends_are_accepted(tmp_path):
    path = tmp_path / "rig.toml"
    path.write_bytes(b"\xef\xbb\xbf" + RIG.replace("\n", "\r\n").encode())
    assert Rig.load(path).plane.unit == "mm"


def test_one_view_and_more_than_four_points_are_valid(load):
    text = (PLANE + LEFT).replace("[0, 400]]", "[0, 400], [200, 200]]")
    text = text.replace("[126.2, 231.3]]", "[126.2, 231.3], [327.7, 267.8]]")
    rig = load(text)
    assert [view.name for view in rig.views] == ["left"]
    assert len(rig.plane.points) == 5


SQUARE_TEXT = "[[0, 0], [400, 0], [400, 400], [0, 400]]"


def spread(side: str) -> str:
    return SQUARE_TEXT.replace("400", side)


MISTAKES = {
    "unknown key": ('unit = "mm"', 'unit = "mm"\nscale = 2', "plane.scale is not a key"),
    "typing slip": ("angle_deg", "angle_dge", "view[0].start.angle_dge is not a key"),
    "slip is named": ("angle_deg", "angle_dge", "did you mean angle_deg?"),
    "unknown table": ("[plane]", "[camera]\n[plane]", "camera is not a key"),
    "unknown lens key": ("k1 = -0.1", "k1 = -0.1, k3 = 0", "view[0].lens.k3 is not a key"),
    "odd key": ("unit", '"a\\nb" = 1\nunit', 'plane."a\\nb" is not a key'),
    "missing key": ('unit = "mm"\n', "", "plane.unit is missing"),
    "missing table": (PLANE, "", "plane is missing"),
    "missing deep": ("length_px = 71.1\n", "", "view[0].start.length_px is missing"),
    "text for number": ("43.7", '"steep"', 'view[0].start.angle_deg is "steep"; needed: the dir'),
    "number for text": ('"right"', "7", "view[1].name is 7; needed:"),
    "bool for camera": ("source = 1", "source = true", "view[1].source is true; needed:"),
    "half a camera": ("source = 1", "source = 1.5", "view[1].source is 1.5; needed:"),
    "negative camera": ("source = 1", "source = -1", "view[1]: source is -1; needed:"),
    "empty source": ("left/*.jpg", "", 'view[0]: source is ""; needed:'),
    "date": ('unit = "mm"', "unit = 2026-01-01", 'plane.unit is "2026-01-01"; needed:'),
    "three numbers": ("[400, 0]", "[400, 0, 1]", "plane.points[1] is [400, 0, 1]; needed:"),
    "not a pair": ("[194.6, 211.9]", "194.6", "view[0].start.tip_px is 194.6; needed:"),
    "word in a list": ("[400, 0]", '[400, "x"]', 'plane.points[1][1] is "x"; needed:'),
    "huge number": ("[400, 0]", f"[1{'0' * 400}, 0]", "plane.points[1][0] is 1000"),
    "nan": ("[400, 0]", "[400, nan]", "plane: points[1, 1] is nan"),
    "infinite": ("angle_deg = 43.7", "angle_deg = inf", "view[0].start: angle_deg is inf"),
    "infinite pixel": ("234.2", "-inf", "view[0]: reference_points_px[0, 0] is -inf"),
    "no length": ("71.1", "0", "view[0].start: length_px is 0.0; from 0.1 to 100000 is right"),
    "length beyond all": ("71.1", "1e300", "view[0].start: length_px is 1e+300; from 0.1 to"),
    "length of nothing": ("71.1", "1e-300", "view[0].start: length_px is 1e-300; from 0.1 to"),
    "camera beyond all": ("source = 1", "source = 2147483648", "source is 2147483648; needed:"),
    "digits beyond all": ("71.1", "9" * 5000, "a number has too many digits"),
    "focal length of nothing": ("fx = 1692", "fx = 1e-300", "view[0].lens: lens fx is 1e-300"),
    "far principal point": ("319.5", "1e300", "view[0].lens: lens cx is 1e+300"),
    "wide plane": (SQUARE_TEXT, spread("4e150"), 'view "left": plane.points spread over 5.66e+150'),
    "wider plane": (
        SQUARE_TEXT,
        spread("4e300"),
        'view "left": plane.points spread over 5.66e+300',
    ),
    "tiny plane": (
        SQUARE_TEXT,
        spread("4e-150"),
        'view "left": plane.points spread over 5.66e-150',
    ),
    "tinier plane": (SQUARE_TEXT, spread("4e-300"), "plane.points spread over 5.66e-300"),
    "no such thumb": ('thumb = "left"', 'thumb = "up"', 'view[0].start.thumb is "up"; needed:'),
    "no focal length": ("fx = 1692", "fx = 0", "view[0].lens: "),
    "lens folds": ("k1 = -0.1", "k1 = -80", "reference_points_px[0] is where the lens model"),
    "later kind": ('"fixed"', '"aruco"', 'view[0].reference.kind is "aruco"; needed:'),
    "three points": (", [0, 400]]", "]", "plane: points: 3 found; at least 4 are needed"),
    "point missing": (", [126.2, 231.3]", "", 'view "left": reference_points_px: 3 found'),
    "one name twice": ('"right"', '"left"', '2 views are called "left"'),
    "empty name": ('name = "right"', 'name = ""', 'view[1]: name is ""'),
    "name of two lines": ('"right"', '"a\\nb"', 'view[1]: name is "a\\nb"'),
    "one view table": (LEFT + RIGHT, "[view]\n", "view is {}; needed: one [[view]]"),
    "no view": (RIG, f"view = []\n{PLANE}", "view: none found; needed: one [[view]]"),
    "points on a line": ("[400, 400]", "[800, 0]", 'view "left": plane.points [0, 1, 2] lie on'),
    "same pixel twice": ("[567.7, 359.2]", "[234.2, 452.8]", "are the same point"),
    "crossed order": (
        "[[234.2, 452.8], [567.7, 359.2]",
        "[[567.7, 359.2], [234.2, 452.8]",
        'view "left": ',
    ),
    "toml": ("[plane]", "[plane", "not valid TOML"),
    "nested": ("[plane]", f"a = {'[' * 5000}\n[plane]", "nested too deeply"),
}


@pytest.mark.parametrize(("found", "instead", "said"), MISTAKES.values(), ids=MISTAKES.keys())
def test_every_mistake_is_one_line_with_file_key_and_value(load, tmp_path, found, instead, said):
    assert found in RIG
    with pytest.raises(RigError) as raised:
        load(RIG.replace(found, instead, 1))
    message = str(raised.value)
    assert message.startswith(f"{tmp_path / 'rig.toml'}: ")
    assert said in message
    assert "\n" not in message
    assert len(message) < len(str(tmp_path)) + 260


def test_a_file_that_cannot_be_read_is_named(tmp_path):
    with pytest.raises(RigError, match=r"none\.toml: No such file"):
        Rig.load(tmp_path / "none.toml")
    with pytest.raises(RigError, match="Is a directory"):
        Rig.load(tmp_path)
    picture = tmp_path / "picture.toml"
    picture.write_bytes(b"\x89PNG\r\n")
    with pytest.raises(RigError, match="not a text file in UTF-8"):
        Rig.load(picture)


def test_rigs_made_in_python_are_validated():
    with pytest.raises(InvalidInputError, match="none found"):
        rig_of()
    with pytest.raises(InvalidInputError, match="2 views are called"):
        rig_of(view(), view())
    with pytest.raises(DegenerateReferencePointsError, match='view "only"'):
        rig_of(view(reference_points_px=((0, 0), (1, 1), (2, 2), (3, 3))))
    with pytest.raises(InvalidInputError, match="reference_points_px"):
        view(reference_points_px=((0, math.nan), (1, 0), (1, 1), (0, 1)))


def test_a_saved_rig_is_loaded_unchanged_and_its_folder_may_be_moved(load, tmp_path):
    rig = load(RIG)
    rig.save(tmp_path / "copy.toml")
    assert Rig.load(tmp_path / "copy.toml") == rig

    (tmp_path / "moved").mkdir()
    (tmp_path / "copy.toml").rename(tmp_path / "moved" / "copy.toml")
    moved = Rig.load(tmp_path / "moved" / "copy.toml")
    assert moved.views[0].source == str(tmp_path / "moved" / "left/*.jpg")


def test_sources_outside_the_new_folder_are_saved_as_absolute_paths(load, tmp_path, monkeypatch):
    rig = load(RIG)
    (tmp_path / "other").mkdir()
    monkeypatch.chdir(tmp_path)
    rig.save(Path("other/rig.toml"))
    assert Rig.load("other/rig.toml").views[0].source == str(tmp_path / "left/*.jpg")


def test_a_folder_named_like_a_glob_is_saved_and_loaded(tmp_path):
    folder = tmp_path / "set [1]"
    folder.mkdir()
    (folder / "a.mp4").touch()
    rig = rig_of(view(source=str(folder / "a.mp4")))
    rig.save(folder / "rig.toml")
    assert 'source = "a.mp4"' in (folder / "rig.toml").read_text()
    assert Rig.load(folder / "rig.toml") == rig

    (folder / "rig.toml").write_text((folder / "rig.toml").read_text().replace("a.mp4", "*.png"))
    source = Rig.load(folder / "rig.toml").views[0].source
    assert source == str(tmp_path / "set [[]1]" / "*.png")


def test_a_file_that_cannot_be_written_is_named(tmp_path):
    with pytest.raises(RigError, match=r"none/rig\.toml: cannot be written"):
        rig_of(view()).save(tmp_path / "none" / "rig.toml")


@pytest.mark.parametrize("name", ["\0", "x" * 5000])
def test_an_invalid_file_name_is_refused(tmp_path, name):
    for use in (Rig.load, Rig.load_cameras, rig_of(view()).save):
        with pytest.raises(RigError) as raised:
            use(tmp_path / name)
        assert str(raised.value).isprintable()


@pytest.mark.parametrize("name", [".", ""])
def test_a_directory_is_no_rig_file(tmp_path, name):
    with pytest.raises(RigError, match=r"a rig file \(TOML\) is needed"):
        Rig.load(tmp_path / name)


def test_a_source_that_is_not_utf8_is_not_saved(tmp_path):
    with pytest.raises(RigError, match="a source is no text in UTF-8"):
        rig_of(view(source="a\udcff.mp4")).save(tmp_path / "rig.toml")
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_leaves_the_previous_rig(tmp_path):
    path, other = tmp_path / "rig.toml", tmp_path / "rig.toml.part"
    rig_of(view()).save(path)
    old = path.read_bytes()
    other.write_text("somebody's own", encoding="utf-8")
    program = """
import resource, sys
from fingerpost import Rig
rig = Rig.load(sys.argv[1])
resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))
rig.save(sys.argv[1])
"""
    done = subprocess.run(
        [sys.executable, "-c", program, path], check=False, capture_output=True, text=True
    )
    assert f"{path}: cannot be written: File too large" in done.stderr
    assert path.read_bytes() == old
    assert other.read_text(encoding="utf-8") == "somebody's own"
    assert sorted(tmp_path.iterdir()) == [path, other]


def test_a_rig_is_not_written_to_a_directory(tmp_path):
    for place in (tmp_path, Path()):
        with pytest.raises(RigError, match="cannot be written: it is a directory"):
            rig_of(view()).save(place)
    assert list(tmp_path.parent.glob("*.part")) == list(tmp_path.iterdir()) == []


finite = st.floats(allow_nan=False, allow_infinity=False)
text = st.text(st.characters(exclude_categories=["Cs"]), min_size=1)
starts = st.builds(
    Start,
    tip_px=st.tuples(finite, finite),
    angle_deg=finite,
    length_px=st.floats(0.1, 1e5),
    thumb=st.sampled_from(["left", "right", "none"]),
)
# Focal length and distortion for which the lens model is valid at the reference points.
lenses = st.builds(
    LensParameters,
    fx=st.floats(1e3, 1e5),
    fy=st.floats(1e3, 1e5),
    cx=st.floats(0, 100),
    cy=st.floats(0, 100),
    k1=st.floats(-1, 1),
    k2=st.floats(-1, 1),
)


@given(
    unit=text.filter(str.isprintable),
    names=st.lists(text.filter(str.isprintable), min_size=1, max_size=3, unique=True),
    source=text | st.integers(0, 2**31 - 1),
    lens=lenses | st.none(),
    start=starts | st.none(),
)
def test_any_rig_is_unchanged_by_writing_and_reading(unit, names, source, lens, start):
    views = (view(name, source=source, lens_parameters=lens, start=start) for name in names)
    rig = Rig(plane=Plane(unit=unit, points=SQUARE), views=tuple(views))
    assert msgspec.convert(tomllib.loads(rig.dumps()), Rig) == rig


def test_a_written_rig_has_the_layout_of_a_hand_written_one(load):
    text = load(RIG).dumps()
    assert re.sub(r'source = ".*/left', 'source = "left', text) == RIG.replace(
        "[[0, 0], [400, 0], [400, 400], [0, 400]]",
        "[[0.0, 0.0], [400.0, 0.0], [400.0, 400.0], [0.0, 400.0]]",
    ).replace("fx = 1692, fy = 1692", "fx = 1692.0, fy = 1692.0")
