"""Sheets of markers: written in true size, found in pictures, their corners without a bias."""

import math
import re

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from sheets import SIZE, corners_of_view, noisy

from fingerpost.cli import main
from fingerpost.config import Rig
from fingerpost.errors import InvalidInputError
from fingerpost.locating import ReferenceSearch
from fingerpost.references import MarkersMeter, marker_cells, sheet_markers

A4 = (210.0, 297.0)
PLANE = np.array([[0, 0], [210, 0], [210, 297], [0, 297]], float)
CHI2_95 = -2.0 * math.log(0.05)


def shown(corners, sheet=1, oversampling=8, sigma_px=0.7):
    """Render the sheet: grey levels by `oversampling`² samples a pixel, then blurred."""
    image_from_plane = cv2.getPerspectiveTransform(
        PLANE.astype(np.float32), np.asarray(corners, np.float32)
    )
    levels = np.full(SIZE[::-1], 220.0)
    offsets = (np.arange(oversampling) + 0.5) / oversampling - 0.5
    for number, at in sheet_markers(A4, sheet).items():
        cells = np.pad(marker_cells(number), 1)
        around = cv2.perspectiveTransform(at[None], image_from_plane)[0]
        low = np.maximum(np.floor(around.min(axis=0)).astype(int) - 2, 0)
        high = np.minimum(np.ceil(around.max(axis=0)).astype(int) + 3, SIZE)
        if (low >= high).any():
            continue
        v, u = np.mgrid[low[1] : high[1], low[0] : high[0]]
        u = u[..., None, None] + offsets
        v = v[..., None, None] + offsets[:, None]
        u, v = np.broadcast_arrays(u, v)
        plane = np.stack([u, v, np.ones_like(u)]).reshape(3, -1)
        X, Y, W = np.linalg.inv(image_from_plane) @ plane
        side = (at[1, 0] - at[0, 0]) / (len(cells) - 2)
        column = np.clip(np.floor((X / W - at[0, 0]) / side).astype(int) + 1, 0, len(cells) - 1)
        row = np.clip(np.floor((at[0, 1] - Y / W) / side).astype(int) + 1, 0, len(cells) - 1)
        black = cells[row, column].reshape(u.shape).mean(axis=(2, 3))
        levels[low[1] : high[1], low[0] : high[0]] -= 190.0 * black
    return cv2.GaussianBlur(levels, (0, 0), sigma_px)


def exact(corners):
    """The corners as rendered: rounded to the 32 bits of `getPerspectiveTransform`."""
    T = cv2.getPerspectiveTransform(PLANE.astype(np.float32), np.asarray(corners, np.float32))
    y = np.column_stack([PLANE, np.ones(4)]) @ T.T
    return y[:, :2] / y[:, 2:]


@pytest.fixture(scope="module")
def pictures():
    """Pictures of the sheet from ten cameras: grey levels and true corners."""
    found = []
    for seed in range(10):
        corners = corners_of_view(np.random.default_rng(seed), distance=(1.5, 2.0))
        found.append((shown(corners), exact(corners)))
    return found


def test_corners_are_exact_and_have_no_bias(pictures):
    meter = MarkersMeter(A4, 1, PLANE)
    offs = []
    for k, (levels, corners) in enumerate(pictures):
        measured = meter.search(noisy(levels, np.random.default_rng(k), 2))
        offs.append(measured.points_px - corners)
    offs = np.array(offs)
    assert np.sqrt(np.mean(offs**2)) < 0.05
    assert np.abs(offs.mean(axis=(0, 1))).max() < 0.02


def test_covariances_contain_the_errors(pictures):
    meter = MarkersMeter(A4, 1, PLANE)
    squares = []
    for k, (levels, corners) in enumerate(pictures):
        for again in range(2):
            picture = noisy(levels, np.random.default_rng(100 * k + again), 4)
            measured = meter.search(picture)
            off = measured.points_px - corners
            inverse = np.linalg.inv(measured.covariances_px2)
            squares.append(np.einsum("ki,kij,kj->k", off, inverse, off))
    assert 0.9 <= np.mean(np.array(squares) < CHI2_95) <= 0.995


def test_one_marker_is_enough(pictures):
    levels, corners = pictures[0]
    meter = MarkersMeter(A4, 1, PLANE)
    T = cv2.getPerspectiveTransform(PLANE.astype(np.float32), corners.astype(np.float32))
    keep = np.array([*sheet_markers(A4, 1).values()][9]) + 6.0 * np.array(
        [[-1, 1], [1, 1], [1, -1], [-1, -1]]
    )
    around = cv2.perspectiveTransform(keep[None], T)[0]
    mask = cv2.fillConvexPoly(np.zeros(SIZE[::-1], np.uint8), np.round(around).astype(int), 1)
    alone = np.where(mask > 0, levels, 120.0)
    measured = meter.search(noisy(alone, np.random.default_rng(0), 1))
    off = measured.points_px - corners
    assert np.abs(off).max() < 6.0
    inverse = np.linalg.inv(measured.covariances_px2)
    assert np.einsum("ki,kij,kj->k", off, inverse, off).max() < 30.0
    # Its covariance shows that the sheet's corners are extrapolated.
    whole = meter.search(noisy(levels, np.random.default_rng(0), 1))
    assert np.trace(measured.covariance) > 20 * np.trace(whole.covariance)


def test_another_sheet_is_not_detected(pictures):
    picture = noisy(pictures[0][0], np.random.default_rng(0), 2)
    assert MarkersMeter(A4, 2, PLANE).search(picture) is None
    assert MarkersMeter(A4, 1, PLANE).search(np.full((60, 80, 3), 90, np.uint8)) is None


def rig_text(reference):
    return "".join(
        f'[[view]]\nname = "{name}"\nsource = "{name}.mp4"\nreference = {reference}\n'
        for name in "ab"
    )


def test_a_rig_finds_its_markers(tmp_path, pictures):
    (tmp_path / "rig.toml").write_text(rig_text('{ kind = "markers" }'))
    rig = Rig.load(tmp_path / "rig.toml")
    assert rig.plane.points == tuple(map(tuple, PLANE.tolist()))
    search = ReferenceSearch(rig)
    seen = {k: noisy(pictures[k][0], np.random.default_rng(k), 2) for k in range(2)}
    assert search.look({0: seen[0]}) is None
    assert 'view "b": no marker of sheet 1 is found' in search.missing[1]
    found = search.look(seen)
    for k, view in enumerate(found.views):
        assert np.abs(np.array(view.reference_points_px) - pictures[k][1]).max() < 0.3
    found.save(tmp_path / "found.toml")
    assert Rig.load(tmp_path / "found.toml") == found
    assert not ReferenceSearch.is_needed(found)


@pytest.mark.parametrize(
    ("reference", "line"),
    [
        ('{ kind = "markers", sheet = 7 }', "sheet is 7; 1 to 6 are right"),
        ('{ kind = "markers", size = "A9" }', 'size is "A9"; needed: "A4"'),
        ('{ kind = "markers", near_px = [1, 2] }', "near_px is not a key"),
        ('{ kind = "screen" }', "reference.size is missing"),
        ('{ kind = "marker" }', 'needed: { kind = "fixed" }'),
    ],
)
def test_rigs_are_refused_in_one_line(tmp_path, reference, line):
    text = '[plane]\nunit = "mm"\npoints = [[0, 0], [210, 0], [210, 297], [0, 297]]\n'
    (tmp_path / "rig.toml").write_text(text + rig_text(reference))
    with pytest.raises(InvalidInputError, match=re.escape(line)):
        Rig.load(tmp_path / "rig.toml")


def test_a_printed_sheet_has_true_size(tmp_path):
    path = tmp_path / "sheet.pdf"
    done = CliRunner().invoke(main, ["markers", str(path), "--size", "letter"])
    assert done.exit_code == 0, done.output
    text = path.read_text("latin-1")
    box = re.search(r"/MediaBox \[0 0 ([\d.]+) ([\d.]+)\]", text)
    assert [float(v) for v in box.groups()] == pytest.approx([612, 792], abs=0.01)
    # The ruler: 100 mm in 1/72 inch.
    assert any(
        abs(float(width) - 100 / 25.4 * 72) < 0.01
        for width in re.findall(r"([\d.]+) [\d.]+ re", text)
    )
    for place in re.findall(r"^(\d{10}) 00000 n", text, re.MULTILINE):
        assert re.match(r"\d+ 0 obj", text[int(place) :])
    assert text[int(re.search(r"startxref\n(\d+)", text)[1]) :].startswith("xref")


def test_a_screen_shows_the_sheet_of_its_shape(tmp_path):
    path = tmp_path / "screen.png"
    done = CliRunner().invoke(main, ["markers", str(path), "--screen", "1280x800"])
    assert done.exit_code == 0, done.output
    picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    assert picture.shape == (800, 1280)
    # 320 × 200 mm, seen from straight above; pixel (0, 0) is centred at the origin.
    points = np.array([[0, 0], [320, 0], [320, 200], [0, 200]], float)
    measured = MarkersMeter((320.0, 200.0), 1, points).search(picture)
    right = [[-0.5, 799.5], [1279.5, 799.5], [1279.5, -0.5], [-0.5, -0.5]]
    assert np.abs(measured.points_px - right).max() < 0.7


def test_markers_refuses_in_one_line(tmp_path):
    for arguments, line in (
        (["s.png"], "s.png: a name that ends in .pdf is right"),
        (["s.pdf", "--size", "A9"], 'plane is "A9"'),
        (["s.png", "--screen", "9x9"], "--screen 9x9: width and height in px"),
        (["s.pdf", "--size", "100x900"], "is too long"),
    ):
        done = CliRunner().invoke(main, ["markers", *arguments])
        assert done.exit_code == 2
        assert len(done.output.splitlines()) == 1
        assert line in done.output
