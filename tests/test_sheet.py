"""Lines, areas, marks and text are drawn in their places only, for any input."""

import math
from itertools import pairwise

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fingerpost.errors import InvalidInputError
from fingerpost.recording import sheet as module
from fingerpost.recording.sheet import CASING, LARGEST_PX, Sheet

GROUND = (10, 20, 30)
COLOUR = (200, 100, 50)
WIDTH, HEIGHT = 60, 40
COLUMNS, ROWS = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
PIXELS = np.stack([COLUMNS, ROWS], axis=-1).astype(float)

# Distance up to which OpenCV's filter blurs an edge [px].
SOFT_PX = 2.4
# Width of the casing on each side of a line [px].
CASING_PX = 1.0

# Near the sheet, around its border, and far away.
COORDINATE = st.one_of(
    st.floats(-20.0, 80.0),
    st.sampled_from([-8.0, 0.0, HEIGHT + 8.0, WIDTH + 8.0]),
    st.floats(-1e5, 1e5),
)
ANYTHING = st.one_of(COORDINATE, st.floats())


def blank() -> Sheet:
    return Sheet.blank((WIDTH, HEIGHT), GROUND)


def drawn(sheet: Sheet) -> np.ndarray:
    return (sheet.pixels != GROUND).any(axis=-1)


def distance_to_segment(a, b) -> np.ndarray:
    a, b = np.asarray(a, float), np.asarray(b, float)
    along = b - a
    length2 = along @ along
    share = (
        np.clip((PIXELS - a) @ along / length2, 0.0, 1.0) if length2 else np.zeros(PIXELS.shape[:2])
    )
    return np.linalg.norm(PIXELS - a - share[..., None] * along, axis=-1)


@given(st.tuples(*[COORDINATE] * 4))
def test_a_line_is_drawn_between_its_ends(ends):
    a, b = np.array(ends[:2]), np.array(ends[2:])
    sheet = blank()
    sheet.line(np.array([a, b]), COLOUR, 2)
    away = distance_to_segment(a, b)
    assert not drawn(sheet)[away > 1.0 + SOFT_PX].any()
    if math.dist(a, b) > 0.0:
        assert drawn(sheet)[away < 0.4].all()


@given(st.lists(st.tuples(ANYTHING, ANYTHING), max_size=8), st.booleans())
def test_a_polyline_is_drawn_along_its_finite_segments_only(points, cased):
    sheet = blank()
    sheet.line(np.array(points).reshape(-1, 2), COLOUR, 2, cased=cased)
    allowed = np.zeros((HEIGHT, WIDTH), bool)
    for a, b in pairwise(points):
        if (np.abs([*a, *b]) < 1e7).all():
            allowed |= distance_to_segment(a, b) <= 1.0 + CASING_PX + SOFT_PX
    assert not (drawn(sheet) & ~allowed).any()


def test_a_line_has_sub_pixel_precision():
    rows = []
    for row in np.arange(10.0, 11.01, 0.125):
        sheet = blank()
        sheet.line(np.array([[-5.0, row], [70.0, row]]), COLOUR, 2)
        weight = (sheet.pixels - np.array(GROUND, float))[:, 30, 0]
        rows.append((weight @ np.arange(HEIGHT)) / weight.sum())
    assert np.allclose(rows, np.arange(10.0, 11.01, 0.125), atol=0.2)


def test_nan_breaks_a_line():
    sheet = blank()
    sheet.line(np.array([[5, 20], [20, 20], [np.nan, np.nan], [40, 20], [55, 20]]), COLOUR, 2)
    assert drawn(sheet)[20, 6:20].all()
    assert not drawn(sheet)[20, 24:37].any()
    assert drawn(sheet)[20, 41:55].all()


@pytest.mark.parametrize(("dash", "gap"), [(6.0, 4.0), (3.0, 9.0)])
def test_dashes_have_their_period_and_share(dash, gap):
    sheet = Sheet.blank((1200, 9), GROUND)
    sheet.line(np.array([[0.0, 4.0], [1199.0, 4.0]]), COLOUR, 1, dash=(dash, gap))
    on = drawn(sheet)[4]
    starts = np.flatnonzero(np.diff(on.astype(int)) == 1)
    assert np.allclose(np.diff(starts), dash + gap, atol=1.0)
    assert on.mean() == pytest.approx((dash + 2.0) / (dash + gap), abs=0.05)  # round ends


def test_a_cased_line_has_a_dark_edge():
    sheet = blank()
    sheet.line(np.array([[0.0, 20.0], [59.0, 20.0]]), COLOUR, 2, cased=True)
    column = sheet.pixels[:, 30]
    assert tuple(column[20]) == COLOUR
    for beside in (18, 22):
        assert (
            np.abs(column[beside].astype(int) - CASING) < np.abs(np.subtract(GROUND, CASING))
        ).any()


@given(st.lists(st.tuples(COORDINATE, COORDINATE), min_size=3, max_size=3))
def test_an_area_is_the_inside_of_its_polygon(corners):
    a, b, c = np.array(corners)
    double = float(np.cross(np.append(b - a, 0), np.append(c - a, 0))[2])
    sheet = blank()
    sheet.area(np.array(corners), COLOUR)
    to_edges = np.min([distance_to_segment(p, q) for p, q in ((a, b), (b, c), (c, a))], axis=0)
    inside = np.ones((HEIGHT, WIDTH), bool)
    for p, q in ((a, b), (b, c), (c, a)):
        normal = np.array([-(q - p)[1], (q - p)[0]])
        inside &= (PIXELS - p) @ normal * np.sign(double) > 0.0
    clear = to_edges > SOFT_PX
    assert (drawn(sheet)[clear] == (inside & (double != 0.0))[clear]).all()


@given(st.lists(st.tuples(ANYTHING, ANYTHING), max_size=6))
def test_an_area_with_a_nan_corner_is_not_drawn(corners):
    corners = [*corners, (math.nan, 3.0)]
    sheet = blank()
    sheet.area(np.array(corners), COLOUR)
    assert not drawn(sheet).any()


def test_opacity_mixes_colours():
    sheet = blank()
    sheet.area(np.array([[-9.0, -9.0], [99.0, -9.0], [99.0, 99.0], [-9.0, 99.0]]), COLOUR, 0.25)
    expected = 0.25 * np.array(COLOUR) + 0.75 * np.array(GROUND)
    assert (np.abs(sheet.pixels - expected) <= 1.0).all()


@given(ANYTHING, ANYTHING)
def test_marks_are_drawn_in_their_place_or_not_at_all(x, y):
    place = np.array([x, y])
    dot, cross = blank(), blank()
    dot.dot(place, 4.0, COLOUR)
    cross.cross(place, 7.0, COLOUR)
    if not (np.abs(place) < 1e6).all():
        assert not drawn(dot).any()
        assert not drawn(cross).any()
        return
    away = np.linalg.norm(PIXELS - place, axis=-1)
    assert not drawn(dot)[away > 4.0 + SOFT_PX].any()
    assert drawn(dot)[away < 3.0].all()
    assert not drawn(cross)[away > 8.0 + CASING_PX + SOFT_PX].any()
    beside = np.abs(PIXELS - place)
    assert drawn(cross)[(beside.max(axis=-1) < 6.0) & (beside.min(axis=-1) < 0.4)].all()


# --- images -----------------------------------------------------------------------------------


@pytest.mark.parametrize("given_px", [(64, 48), (30, 90), (9, 7), (1280, 960)])
@pytest.mark.parametrize("sheet_px", [(320, 240), (200, 300)])
def test_places_on_an_image_are_given_in_its_pixels(given_px, sheet_px):
    width, height = given_px
    mark = np.array([width // 3, height // 2])
    image = np.zeros((height, width), np.uint8)
    side = max(1, width // 64)
    image[mark[1] : mark[1] + side, mark[0] : mark[0] + side] = 255
    mark = mark + (side - 1) / 2

    sheet = Sheet.blank(sheet_px, (0, 0, 0)).with_image(image)
    weight = sheet.pixels[..., 1].astype(float)
    v, u = np.indices(weight.shape)
    found = np.array([(weight * u).sum(), (weight * v).sum()]) / weight.sum()
    scale = min(sheet_px[0] / width, sheet_px[1] / height)
    assert np.allclose(sheet.place(mark), found, atol=0.05 * max(scale, 1.0))
    assert np.allclose(sheet.corners(), [[-0.5, -0.5], np.array(given_px) - 0.5], atol=200 / scale)


def test_an_image_is_scaled_to_fit_and_centred():
    sheet = Sheet.blank((100, 80), GROUND).with_image(np.full((10, 25, 3), COLOUR, np.uint8))
    rows, columns = np.nonzero(drawn(sheet))
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (20, 59, 0, 99)
    assert (sheet.pixels[20:60] == COLOUR).all()


def test_places_on_a_part_of_an_image_are_given_in_pixels_of_the_whole():
    image = np.zeros((90, 120), np.uint8)
    image[50, 70] = 255
    sheet = Sheet.blank((80, 80), GROUND).with_image(image[40:60, 60:80], (60, 40))
    column, row = sheet.place(np.array([70.0, 50.0]))
    rows, columns = np.nonzero(sheet.pixels[..., 0])
    weights = sheet.pixels[rows, columns, 0].astype(float)
    assert [column, row] == pytest.approx(
        [np.average(columns, weights=weights), np.average(rows, weights=weights)], abs=0.05
    )


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((4, 4), np.float32),
        np.zeros((4, 4, 4), np.uint8),
        np.zeros((4, 4, 1), np.uint8),
        np.zeros(4, np.uint8),
    ],
)
def test_invalid_images_are_refused(image):
    with pytest.raises(InvalidInputError, match="uint8 is needed"):
        blank().with_image(image)


@pytest.mark.parametrize("size", [(0, 5), (5, -1), (LARGEST_PX + 1, 5), (math.nan, 5)])
def test_a_sheet_without_a_sensible_size_is_refused(size):
    with pytest.raises(InvalidInputError, match="size_px"):
        Sheet.blank(size, GROUND)


# --- lettering --------------------------------------------------------------------------------


@pytest.fixture(params=["typeface", "stroke letters"])
def lettering(request, monkeypatch):
    """Both kinds of letters, if this OpenCV has them."""
    if request.param == "typeface" and not hasattr(cv2, "FontFace"):
        pytest.skip("this OpenCV has no typeface")
    if request.param == "stroke letters":
        monkeypatch.setattr(module, "_typeface", lambda: None)


@pytest.mark.usefixtures("lettering")
@pytest.mark.parametrize("anchor", [0.0, 0.5, 1.0])
def test_text_is_aligned_at_its_anchor(anchor):
    sheet = Sheet.blank((800, 60), GROUND)
    begin, end = sheet.text("X 12.3 ± 0.4 mm", (400.0, 40.0), 20, COLOUR, anchor=anchor)
    assert begin == pytest.approx(400.0 - anchor * (end - begin))
    columns = np.flatnonzero(drawn(sheet).any(axis=0))
    rows = np.flatnonzero(drawn(sheet).any(axis=1))
    assert abs(columns.min() - begin) <= 4
    assert abs(columns.max() - end) <= 4
    assert 40 - 20 <= rows.min() < rows.max() <= 40 + 8


@pytest.mark.usefixtures("lettering")
@pytest.mark.parametrize("bold", [False, True])
def test_text_is_truncated_to_its_room(bold):
    words = "the standard deviation along the constraint lines is too large"
    _, whole = blank().text(words, (0.0, 30.0), 20, COLOUR, bold=bold)
    widths = []
    for room in (-5.0, 0.0, 3.0, 40.0, 200.0, whole, math.inf):
        _, end = blank().text(words, (0.0, 30.0), 20, COLOUR, bold=bold, room=room)
        assert end <= max(room, 0.0)
        widths.append(end)
    assert widths == sorted(widths)
    assert widths[4] > 150.0
    assert widths[5] == widths[6] == whole


@pytest.mark.usefixtures("lettering")
@settings(max_examples=50)
@given(st.text(max_size=30), ANYTHING, ANYTHING, st.integers(1, 60))
def test_any_text_can_be_written_anywhere(words, x, y, height):
    begin, end = blank().text(words, (x, y), height, COLOUR)
    assert (begin <= end) or math.isnan(begin)


def test_symbols_are_spelled_out_in_stroke_letters(monkeypatch):
    monkeypatch.setattr(module, "_typeface", lambda: None)
    pictures = []
    for words in ("1 ± 2 µm at 3°…", "1 +- 2 um at 3 deg..."):
        sheet = Sheet.blank((400, 40), GROUND)
        sheet.text(words, (2.0, 30.0), 20, COLOUR)
        pictures.append(sheet.pixels)
    assert (pictures[0] == pictures[1]).all()
