"""Slips in a rig file: the message contains the corrected line."""

import re
import tomllib

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from fingerpost.config import Rig
from fingerpost.errors import InvalidInputError, RigError
from fingerpost.rig_text import parsed

RIG = """\
[plane]
unit = "mm"
points = [[0, 0], [400, 0], [400, 400], [0, 400]]

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

[[view]]
name = "right"
source = 1
reference_points_px = [[128.1, 387.0], [470.9, 445.7], [533.4, 211.5], [231.5, 169.6]]
"""

WINDOWS = r"""source = 'C:\Users\me\left.mp4'"""
SOURCE = 'source = "left/*.jpg"'
ANGLE = "angle_deg = 43.7"
TIP = "tip_px = [194.6, 211.9]"
POINTS = "points = [[0, 0], [400, 0], [400, 400], [0, 400]]"
LENS = "lens = { fx = 1692, fy = 1692, cx = 319.5, cy = 239.5, k1 = -0.1 }"
KIND = 'reference = { kind = "fixed" }'
THUMB = 'thumb = "left"'

# A line of the rig above, the slip that replaces it, and the corrected line.
SLIPS = [
    # backslashes
    (SOURCE, r'source = "C:\Users\me\left.mp4"', WINDOWS),
    (SOURCE, r"source = C:\Users\me\left.mp4", WINDOWS),
    (SOURCE, r"source = “C:\Users\me\left.mp4”", WINDOWS),
    (SOURCE, r'source = r"C:\Users\me\left.mp4"', WINDOWS),
    (SOURCE, r'source = "\\server\share\left.mp4"', r"source = '\\server\share\left.mp4'"),
    (SOURCE, r'source = "D:\it' + r"""'s\x.mp4" """, 'source = "D:/it\'s/x.mp4"'),
    # quotes
    (SOURCE, "source = “left/*.jpg”", SOURCE),
    (SOURCE, "source = „left/*.jpg“", SOURCE),
    (SOURCE, "source = «left/*.jpg»", SOURCE),
    (SOURCE, 'source = "left/*.jpg”', SOURCE),
    (SOURCE, "source = ‘left/*.jpg’", "source = 'left/*.jpg'"),
    (SOURCE, "source = left/*.jpg", SOURCE),
    (SOURCE, 'source = "left/*.jpg', SOURCE),
    (SOURCE, 'source = left/*.jpg"', SOURCE),
    (SOURCE, "source = \"left/*.jpg'", SOURCE),
    (SOURCE, "source = `left/*.jpg`", SOURCE),
    (THUMB, "thumb = none  # of a rod", 'thumb = "none"  # of a rod'),
    (KIND, "reference = { kind = fixed }", KIND),
    (KIND, "reference = { kind = “fixed” }", KIND),
    # between key and value, and after the value
    (SOURCE, 'source "left/*.jpg"', SOURCE),
    (SOURCE, 'source: "left/*.jpg"', SOURCE),
    (SOURCE, 'source := "left/*.jpg"', SOURCE),
    (ANGLE, "angle_deg == 43.7", ANGLE),
    (ANGLE, "angle_deg 43.7", ANGLE),
    (KIND, 'reference = { kind: "fixed" }', KIND),
    (ANGLE, "angle_deg = 43.7,", ANGLE),
    (ANGLE, "angle_deg = 43.7;", ANGLE),
    (ANGLE, "angle_deg = 43.7 // down", f"{ANGLE} # down"),
    (SOURCE, f"// the left one\n{SOURCE}", "# the left one"),
    # numbers
    (ANGLE, "angle_deg = 43,7", ANGLE),
    (ANGLE, "angle_deg = −43.7", "angle_deg = -43.7"),
    (ANGLE, "angle_deg = –43,7", "angle_deg = -43.7"),
    (ANGLE, "angle_deg\u00a0=\u00a043.7", ANGLE),
    (ANGLE, "\u200bangle_deg = 43.7", ANGLE),
    (ANGLE, "angle_deg ＝ ４３.7", ANGLE),
    (ANGLE, "angle_deg = 43.7°", ANGLE),
    (ANGLE, "angle_deg = 43.7 deg", ANGLE),
    (ANGLE, "angle_deg = .7", "angle_deg = 0.7"),
    (ANGLE, "angle_deg = 43.", "angle_deg = 43.0"),
    (ANGLE, "angle_deg = 043.7", ANGLE),
    (TIP, "tip_px = [194.6 px, 211.9 px]", TIP),
    (TIP, "tip_px = [194,06, 211,9]", "tip_px = [194.06, 211.9]"),
    (TIP, "tip_px = [194,6; 211,9]", TIP),
    (LENS, LENS.replace("1692, fy", "1692,5, fy"), LENS.replace("1692, fy", "1692.5, fy")),
    (LENS, LENS.replace("-0.1", "−0,1"), LENS),
    (SOURCE, "source = True", "source = true"),
    # lists
    (TIP, "tip_px = (194.6, 211.9)", TIP),
    (TIP, "tip_px = [194.6, 211.9)", TIP),
    (TIP, "tip_px = 194.6, 211.9", TIP),
    (TIP, "tip_px = 194.6, 211.9]", TIP),
    (TIP, "tip_px = [194.6 211.9]", TIP),
    (TIP, "tip_px = [194.6, 211.9", TIP),
    (TIP, "tip_px = [194.6, 211.9  # of the finger", f"{TIP}  # of the finger"),
    (TIP, "tip_px = [194.6, 211.9]]", TIP),
    (TIP, "tip_px = [194.6， 211.9]", TIP),
    (POINTS, POINTS.replace("0], [400, 0]", "0] [400, 0]"), POINTS),
    (POINTS, POINTS.replace("0], [400, 0]", "0][400, 0]"), POINTS),
    (POINTS, POINTS.replace("0], [400, 0]", "0], 400, 0]"), POINTS),
    (POINTS, POINTS.replace("0], [400, 0]", "0, [400, 0]"), POINTS),
    (POINTS, POINTS.replace("[400, 0]", "[400 0]"), POINTS),
    (POINTS, POINTS.removesuffix("]"), POINTS),
    (POINTS, POINTS.removesuffix("]]"), POINTS),
    (POINTS, f"{POINTS}]", POINTS),
    (POINTS, POINTS.replace("[[", "["), POINTS),
    (POINTS, POINTS.replace("]", ")").replace("[", "("), POINTS),
    (POINTS, "points = [\n  [0, 0]\n  [400, 0], [400, 400], [0, 400],\n]", "[0, 0],"),
    (
        POINTS,
        "points = [\n  [0, 0], [400, 0],\n  [400, 400], [0, 400]\n",
        "[400, 400], [0, 400]]",
    ),
    # tables
    (LENS, LENS.replace("1692, fy", "1692 fy"), LENS),
    (LENS, LENS.removesuffix(" }"), LENS),
    (LENS, LENS.replace(" }", ", }"), LENS),
    (LENS, LENS.replace("{ ", "{\n  "), LENS),
    ("[plane]", "[plane", "[plane]"),
    ("[plane]", "plane]", "[plane]"),
    ("[plane]", "(plane)", "[plane]"),
    ("[view.start]", "[view.start", "[view.start]"),
    ("[[view]]", "[[view]", "[[view]]"),
    ("[[view]]", "[view]]", "[[view]]"),
]


@pytest.mark.parametrize(("line", "slip", "right"), SLIPS, ids=[slip for _, slip, _ in SLIPS])
def test_a_slip_is_answered_with_the_corrected_line(line, slip, right):
    text = RIG.replace(f"{line}\n", f"{slip}\n", 1)
    assert text != RIG
    with pytest.raises(InvalidInputError) as raised:
        parsed(text.encode())
    message = str(raised.value)
    assert message.startswith("not valid TOML: ")
    assert message.endswith(f" would be right as: {right}")
    assert message.isprintable()
    assert len(message) < 260


WITHOUT_START = RIG.replace("[view.start]\n", "").replace("\n[[view]]\n", "\n")


@pytest.mark.parametrize(
    "text",
    [
        RIG.replace("[[view]]", "[view]"),
        RIG.replace("[[view]]", "[view]", 1),
        WITHOUT_START.replace("name", "[[view]]\nname", 1),
    ],
)
def test_every_view_begins_with_its_own_table(text):
    with pytest.raises(InvalidInputError, match=r"each view begins with a \[\[view\]\] of its own"):
        parsed(text.encode())


@pytest.mark.parametrize(
    ("twice", "key"),
    [
        ('name = "left"\nname = "right"', "name"),
        ('name = "left"\n  # another\nname = "left"', "name"),
        (f"{POINTS}\n{POINTS}", "points"),
    ],
)
def test_a_key_that_stands_twice_in_a_table_is_named_with_its_lines(twice, key):
    slip = RIG.replace(twice.split("\n", 1)[0], twice, 1)
    first = slip[: slip.index(twice)].count("\n") + 1
    second = first + twice.count("\n")
    with pytest.raises(InvalidInputError) as raised:
        parsed(slip.encode())
    words = f"lines {first} and {second} both give {key}: keep one of them"
    assert str(raised.value).endswith(words)


def test_only_the_change_of_a_long_line_is_shown():
    many = ", ".join(f"[{k}, {k * k}]" for k in range(100))
    for slip, shown in (
        (f"points = [{many}", "[99, 9801]]"),
        (f"points = [{many}]".replace("], [50,", "] [50,"), "], [50, 2500]"),
    ):
        with pytest.raises(InvalidInputError) as raised:
            parsed(RIG.replace(POINTS, slip).encode())
        assert shown in str(raised.value)
        assert len(str(raised.value)) < 260


def test_a_url_is_not_shown_since_it_may_contain_secrets():
    with pytest.raises(InvalidInputError) as raised:
        parsed(RIG.replace(SOURCE, "source = rtsp://me:secret@host/1?token=secret").encode())
    assert "words stand in quotes" in str(raised.value)
    assert "line 7" in str(raised.value)
    assert "secret" not in str(raised.value)


# --- valid TOML of another meaning ------------------------------------------------------------


@pytest.mark.parametrize("path", [r"C:\temp\new.mp4", r"videos\table.mp4", r"D:\best/first.mp4"])
def test_a_path_that_loses_its_backslashes_is_refused(path):
    text = RIG.replace(SOURCE, f'source = "{path}"')
    tomllib.loads(text)
    with pytest.raises(InvalidInputError) as raised:
        parsed(text.encode())
    assert str(raised.value).startswith("view[0].source is ")
    assert str(raised.value).endswith(f"; right would be '{path}'")


@pytest.mark.parametrize("path", ["C:/temp/new.mp4", r"C:\\temp\\new.mp4", "/data/a\\tb.mp4"])
def test_other_paths_are_accepted(path):
    assert parsed(RIG.replace(SOURCE, f'source = "{path}"').encode())["view"][0]["source"]
    quoted = RIG.replace(SOURCE, r"source = 'C:\temp\new.mp4'")
    assert parsed(quoted.encode())["view"][0]["source"] == r"C:\temp\new.mp4"


@pytest.mark.parametrize(
    ("line", "slip", "place", "right"),
    [
        (TIP, "tip_px = [194,6, 211,9]", "view[0].start.tip_px", "[194.6, 211.9]"),
        (POINTS, POINTS.replace("400, 400", "400,5, 400,25"), "plane.points[2]", "[400.5, 400.25]"),
        (
            SOURCE,
            f"{SOURCE}\nreference_covariances_px2 = [[1,5, 0,0, 1,5]]",
            "view[0].reference_covariances_px2[0]",
            "[1.5, 0.0, 1.5]",
        ),
    ],
)
def test_lists_of_numbers_with_decimal_commas_are_refused(line, slip, place, right):
    with pytest.raises(InvalidInputError) as raised:
        parsed(RIG.replace(line, slip).encode())
    assert str(raised.value).startswith(f"{place} is [")
    assert str(raised.value).endswith(f"; right would be {right}")


@pytest.mark.parametrize("points", ["[[0,0], [400,0]]", "[[0.5,0,1,5]]", "[[0,-1,1,-5]]"])
def test_no_other_list_is_taken_for_one_with_decimal_commas(points):
    text = RIG.replace(POINTS, f"points = {points}\ncrop = [0,0, 640,480]")
    assert parsed(text.encode()) == tomllib.loads(text)


# --- bytes ------------------------------------------------------------------------------------


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-16-be", "utf-32"])
def test_other_encodings_are_refused_by_their_names(encoding):
    with pytest.raises(InvalidInputError) as raised:
        parsed(RIG.encode(encoding))
    assert "not a text file in UTF-8" in str(raised.value)
    assert encoding[:6].upper() in str(raised.value)
    assert "save it again with the encoding UTF-8" in str(raised.value)


def test_a_video_is_no_rig_file():
    with pytest.raises(InvalidInputError, match=r"as videos, pictures .* name a rig file"):
        parsed(bytes.fromhex("00000020 66747970 69736f6d"))  # the first bytes of an MP4 file


def test_a_byte_of_another_encoding_is_named_with_its_line():
    with pytest.raises(InvalidInputError, match="byte 0xfc in line 18 "):
        parsed(RIG.replace("right", "rücken").encode("cp1252"))


@pytest.mark.parametrize("ends", ["\r\n", "\r", "\n"])
def test_a_byte_order_mark_and_any_ends_of_lines_are_read(ends):
    assert parsed(RIG.replace("\n", ends).encode("utf-8-sig")) == tomllib.loads(RIG)


# --- arbitrary edits --------------------------------------------------------------------------


@example(place=RIG.index("fx"), length=0, instead="0\n")
@given(
    place=st.integers(0, len(RIG)),
    length=st.integers(0, 3),
    instead=st.text(max_size=3) | st.text("[]{}\"',.=#\\\t\n-0a“”", max_size=3),
)
def test_any_edit_is_answered_in_one_line_and_advice_moves_the_error_on(place, length, instead):
    text = RIG[:place] + instead + RIG[place + length :]
    try:
        parsed(text.encode(errors="replace"))
    except InvalidInputError as error:
        message = str(error)
    else:
        return
    assert "\n" not in message
    assert len(message) < 300
    advice = re.search(r"line (\d+), column .* line (\d+) would be right as: (.*)", message)
    if advice is not None and "..." not in advice[3]:
        lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
        index = int(advice[2]) - 1
        while "{" in lines[index] and "}" not in lines[index] and lines[index + 1 :]:
            lines[index] += lines.pop(index + 1)  # joined into one line
        if advice[3] == "[[view]]" and lines[index].strip("[({< ])}>") != "view":
            lines.insert(index, advice[3])
        else:
            lines[index] = advice[3]
        assert reached("\n".join(lines)) > min(int(advice[1]), index + 1)


def reached(text: str) -> float:
    """Line of the first syntax error; infinity without one."""
    try:
        tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        found = re.search(r"line (\d+)", str(error))
        return float(found[1]) if found else float("inf")
    return float("inf")


def test_a_very_large_file_is_refused_without_advice():
    with pytest.raises(InvalidInputError, match=r"Invalid value \(at line 4001, column 5\)$"):
        parsed(b"# one more line\n" * 4000 + b"a = b\n")
    with pytest.raises(InvalidInputError, match=r"\(at line 1, column \d+\)$"):
        parsed(b"a = " + b" " * 100_000 + b"b")


def test_errors_name_the_rig_file(tmp_path):
    path = tmp_path / "rig.toml"
    path.write_text(RIG.replace(SOURCE, r'source = "C:\Users\me\left.mp4"'))
    for load in (Rig.load, Rig.load_cameras):
        with pytest.raises(RigError) as raised:
            load(path)
        assert str(raised.value).startswith(f"{path}: not valid TOML: ")
        assert str(raised.value).endswith(WINDOWS)
