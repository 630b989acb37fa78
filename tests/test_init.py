"""`fingerpost init`: a rig file from films only, and a one-line error for what is not found."""

import os
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from sheets import SIZE, corners_of_view, inside, noisy
from terminals import THE_END, on_a_terminal
from test_markers import shown

from fingerpost.cli import main
from fingerpost.config import Rig
from fingerpost.errors import InvalidInputError
from fingerpost.formats import sides_of
from fingerpost.pipeline import Pointer
from fingerpost.recognition import likelier_size
from fingerpost.setting_up import plane_size, view_names

SHARED = Path(__file__).resolve().parents[2] / "shared"
A4 = np.array([[0, 0], [210, 0], [210, 297], [0, 297]], np.float32)


def picture_of(corners, spots_seed=7, noise=2.0, sheet=True):
    """Return a picture of A4 paper on a table with spots; the paper has these corners in it."""
    spots = np.random.default_rng(spots_seed).normal(size=(90, 90)) * 50
    spots = cv2.resize(spots, (1000, 1000), interpolation=cv2.INTER_CUBIC)
    # One texel per millimetre, the origin of the plane at (400, 350).
    texels = A4 + np.array([400, 350], np.float32)
    shown = cv2.getPerspectiveTransform(texels, np.asarray(corners, np.float32))
    table = cv2.warpPerspective(110 + spots, shown, SIZE, borderValue=110)
    part = inside(corners) if sheet else 0.0
    return noisy(table + (215 - table) * part, np.random.default_rng(1), noise)


def film(folder, corners, frames=3, **options):
    """Write stills of a view without a hand; return their glob."""
    folder.mkdir()
    for k in range(frames):
        cv2.imwrite(str(folder / f"{k:03d}.png"), picture_of(corners, **options))
    return str(folder / "*.png")


def halved(folder):
    """Reduce the stills to half the size; return their glob."""
    for path in folder.glob("*.png"):
        cv2.imwrite(str(path), cv2.resize(cv2.imread(str(path)), None, fx=0.5, fy=0.5))
    return str(folder / "*.png")


def init(*arguments):
    return CliRunner().invoke(main, ["init", *map(str, arguments)])


def test_small_pictures_suffice(tmp_path):
    rng = np.random.default_rng(0)
    for name in "ab":
        film(tmp_path / name, corners_of_view(rng))
    films = [halved(tmp_path / name) for name in "ab"]
    done = init("--from", *films, "--plane", "A4", "-o", tmp_path / "rig.toml")
    assert done.exit_code == 0, done.output


@pytest.mark.parametrize("seed", range(2))
def test_a_sheet_is_found_in_both_views_with_the_same_first_corner(tmp_path, seed):
    rng = np.random.default_rng(seed)
    seen = [corners_of_view(rng), corners_of_view(rng)]
    films = [film(tmp_path / name, corners) for name, corners in zip("ab", seen, strict=True)]
    rig_file = tmp_path / "rig.toml"
    done = init("--from", *films, "--plane", "A4", "-o", rig_file)
    assert done.exit_code == 0, done.output
    rig = Rig.load(rig_file)
    assert [view.name for view in rig.views] == ["a", "b"]
    assert rig.plane.unit == "mm"
    assert rig.plane.points[2] == (210, 297)
    orders = []
    for view, corners in zip(rig.views, seen, strict=True):
        distances = np.linalg.norm(np.array(view.reference_points_px)[:, None] - corners, axis=2)
        assert distances.min(axis=1).max() < 0.5
        orders.append(distances.argmin(axis=1).tolist())
    # The sheet's orientation is ambiguous by half a turn, but must be the same in both views.
    assert orders[0] == orders[1]
    assert orders[0] in ([0, 1, 2, 3], [2, 3, 0, 1])
    assert 'view "a": no hand is found' in done.output
    assert (tmp_path / "rig.png").exists()


def test_a_second_sheet_is_named_with_what_takes_it(tmp_path):
    for seed, name in enumerate("ab"):
        first = corners_of_view(np.random.default_rng(seed), distance=(3.4, 3.6)).astype(np.float32)
        beside = (A4 + np.array([240, 10], np.float32))[None]
        second = cv2.perspectiveTransform(beside, cv2.getPerspectiveTransform(A4, first))[0]
        film(tmp_path / name, first)
        for path in (tmp_path / name).glob("*.png"):
            part = inside(second)
            picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) * (1.0 - part) + 205 * part
            cv2.imwrite(str(path), picture.astype(np.uint8))
    films = [str(tmp_path / name / "*.png") for name in "ab"]
    done = init("--from", *films, "--plane", "A4", "-o", tmp_path / "rig.toml")
    assert done.exit_code == 0, done.output
    other = re.findall(
        r'view "a": another such rectangle is about .*; (--near) (a=\d+,\d+) takes', done.output
    )
    assert len(other) == 1
    again = init("--from", *films, "--plane", "A4", "-o", tmp_path / "again.toml", *other[0])
    rigs = [Rig.load(tmp_path / name) for name in ("rig.toml", "again.toml")]
    middles = [np.mean(rig.views[0].reference_points_px, axis=0) for rig in rigs]
    assert again.exit_code == 0, again.output
    assert np.linalg.norm(middles[1] - middles[0]) > 100.0


def test_the_view_without_a_sheet_is_named(tmp_path):
    corners = corners_of_view(np.random.default_rng(0))
    films = [
        film(tmp_path / "a", corners),
        film(tmp_path / "b", corners, sheet=False, spots_seed=2),
    ]
    done = init("--from", *films, "--plane", "A4", "-o", tmp_path / "rig.toml")
    assert done.exit_code == 1
    (line,) = done.output.splitlines()
    assert 'view "b": no A4 rectangle is found' in line
    assert "corners_px" in line
    assert not (tmp_path / "rig.toml").exists()


def test_a_letter_sheet_is_not_taken_for_a4(tmp_path):
    rng = np.random.default_rng(0)
    seen = [corners_of_view(rng, size=sides_of("letter", "mm")) for _ in "ab"]
    # Of one image only, because its sides do not quite fit.
    films = [film(tmp_path / name, corners, 1) for name, corners in zip("ab", seen, strict=True)]
    done = init("--from", *films, "--plane", "A4", "-o", tmp_path / "rig.toml")
    assert done.exit_code == 0, done.output
    assert "the sides fit letter better than A4; --plane letter takes that size" in done.output


def test_a_size_is_preferred_only_if_the_sides_determine_it():
    shapes = [SIZE[::-1]] * 2
    for seed in range(40):
        rng = np.random.default_rng(seed)
        a4 = [corners_of_view(rng) + rng.normal(0.0, 0.3, (4, 2)) for _ in shapes]
        assert likelier_size("A4", a4, shapes) is None
        assert likelier_size("A3", a4, shapes) is None  # of the same shape
        assert likelier_size("letter", a4, shapes) in (None, "a4")


def test_a_sheet_of_markers_is_named_if_a_rectangle_was_stated(tmp_path):
    for seed, name in enumerate("ab"):
        (tmp_path / name).mkdir()
        rng = np.random.default_rng(seed)
        # The paper is as light as the table: only its markers show.
        levels = shown(corners_of_view(rng, distance=(1.5, 2.0)), oversampling=2)
        cv2.imwrite(str(tmp_path / name / "0.png"), noisy(levels, rng, 2.0))
    films = [str(tmp_path / name / "*.png") for name in "ab"]
    done = init("--from", *films, "--plane", "350x220", "-o", tmp_path / "rig.toml")
    assert "every view shows a sheet of markers; --plane markers measures by it" in done.output


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ((), "--from is missing"),
        (("--from", "a.mp4", "b.mp4"), "--plane is missing; such as --plane A4"),
        (("--from", "a.mp4", "--plane", "A4"), "1 source found"),
        (("--from", "a.mp4", "b.mp4", "--plane", "A5"), 'plane is "A5"; needed: A4'),
        (("--from", "a.mp4", "b.mp4", "--plane", "0x3"), 'plane is "0x3"'),
        (("--from", "a.mp4", "b.mp4", "--plane", "A4", "--near", "c=1,2"), "no view is called c"),
        (("--from", "a.mp4", "b.mp4", "--plane", "A4", "--near", "a=1"), "such as left=320,240"),
        (("--from", "a.mp4", "b.mp4", "--plane", "A4", "-o", "rig.png"), "such as rig.toml"),
        (("--from", "a.mp4", "b.mp4", "--plane", "A4", "-o", "."), ".: is a folder; name a file"),
    ],
)
def test_invalid_arguments_are_refused_in_one_line(tmp_path, monkeypatch, arguments, line):
    monkeypatch.chdir(tmp_path)
    done = init(*arguments)
    assert done.exit_code == 2
    assert len(done.output.splitlines()) == 1
    assert line in done.output


def test_an_existing_rig_file_is_not_overwritten(tmp_path):
    corners = corners_of_view(np.random.default_rng(0))
    films = [film(tmp_path / name, corners) for name in "ab"]
    rig_file = tmp_path / "rig.toml"
    rig_file.write_text("mine")
    done = init("--from", *films, "--plane", "A4", "-o", rig_file)
    assert done.exit_code == 2
    assert "exists already; --force writes over it" in done.output
    assert rig_file.read_text() == "mine"


@pytest.fixture(scope="module")
def two_films(tmp_path_factory):
    """A folder with stills of two views of a plain table, and an existing rig file."""
    folder, rng = tmp_path_factory.mktemp("films"), np.random.default_rng(0)
    for name in "ab":
        (folder / name).mkdir()
        picture = noisy(110.0 + 105.0 * inside(corners_of_view(rng)), rng, 2.0)
        cv2.imwrite(str(folder / name / "0.png"), picture)
    (folder / "old.toml").write_text("old\n")
    return folder


def test_questions_on_a_terminal_are_repeated_until_answers_are_valid(two_films):
    environment = {**os.environ, "HOME": str(two_films)}
    with on_a_terminal("init", both=True, asks=True, cwd=two_films, env=environment) as terminal:
        assert terminal.read_until("View 1.*: $")
        for answer, said in [
            ("c.mp4", r"c.mp4: no such file\s+View 1.*: $"),
            ("93", r"camera 93: cannot be opened; is it plugged in.*\s+View 1.*: $"),
            ("old.toml", r"old.toml: no frame can be read.*\s+View 1.*: $"),
            ("'a/*.png'", "View 2.*: $"),
            ("", "View 2.*: $"),
            ("-", r"a named pipe does\s+View 2.*: $"),
            ("a/*.png", r"each needs a source of its own\s+View 2.*: $"),
            ('"~/b/*.png"', "View 3.*: $"),
            ("", "table .*: $"),
            ("A9", r'plane is "A9"; needed: A4.*markers.*\s+.*table .*: $'),
            ("210x297", "Rig file.*: $"),
            ("a", r"a: is a folder; name a file, such as a/rig.toml\s+Rig file.*: $"),
            ("rig.png", r"ends in .toml, such as rig.toml\s+Rig file.*: $"),
            ("x/rig.toml", r"the folder x does not exist.*\s+Rig file.*: $"),
            ("old.toml", r"old.toml exists. Overwrite.*: $"),
            ("n", "Rig file.*: $"),
            ("'rig.toml'", r"corners[\s\S]*right.*: $"),
            ("n", "Pixel inside.* a=320,240.*: $"),
            ("c=1,2", r"no view is called c; they are a, b\s+Pixel.*: $"),
            ("left", r"a view and a pixel are right, such as left=320,240\s+Pixel.*: $"),
            ("", "table .*: $"),
            ("60x400", r"no rectangle is found.*\s+.*table .*: $"),
            ("A4", r"corners[\s\S]*right.*: $"),
        ]:
            terminal.answer(answer)
            assert re.search(said, terminal.read_until(said))
        terminal.answer("")
        assert "rig file  rig.toml" in terminal.read_until(THE_END)
        assert terminal.end()[0] == 0
    assert [view.name for view in Rig.load(two_films / "rig.toml").views] == ["a", "b"]


@pytest.mark.parametrize(
    ("given", "prompt"),
    [
        ([], "View 1.*: $"),
        (["--from", "a/*.png", "b/*.png", "--plane", "A4", "-o", "old.toml"], "Overwrite.*: $"),
        (["--from", "a/*.png", "b/*.png", "--plane", "A4", "-o", "new.toml"], "right.*: $"),
    ],
)
def test_ctrl_c_at_a_prompt_stops_without_writing_a_rig(two_films, given, prompt):
    with on_a_terminal("init", *given, both=True, asks=True, cwd=two_films) as terminal:
        assert re.search(prompt, terminal.read_until(prompt))
        terminal.interrupt()
        assert re.search(r"\nfingerpost: stopped\s*$", terminal.read_until(THE_END))
        assert terminal.end()[0] == 130
    assert (two_films / "old.toml").read_text() == "old\n"
    assert not (two_films / "new.toml").exists()


def test_view_names_and_sizes_of_the_plane():
    assert view_names(["x/left.mp4", "x/right.mp4"]) == ["left", "right"]
    assert view_names(["left/*.jpg", "right/*.jpg"]) == ["left", "right"]
    assert view_names([0, 2]) == ["camera 0", "camera 2"]
    assert view_names(["http://a/1", "http://b/1"]) == ["view 1", "view 2"]
    assert plane_size("350 x 220") == plane_size("35x22cm") == (350.0, 220.0)
    assert sides_of("Letter", "in") == pytest.approx((8.5, 11.0))
    with pytest.raises(InvalidInputError, match="whose length is not known"):
        sides_of("A4", "mat")


@pytest.mark.skipif(not (SHARED / "data/desk").exists(), reason="needs the shared footage")
def test_init_finds_the_reference_points_of_the_shared_footage(tmp_path):
    films = [SHARED / f"data/desk/{side}/*.jpg" for side in ("left", "right")]
    rig_file = tmp_path / "rig.toml"
    done = init("--from", *films, "--plane", "400x400", "-o", rig_file, "--frames", 8)
    assert done.exit_code == 0, done.output
    assert "fingertip at" in done.output
    given = Rig.load(SHARED / "data/desk/rig.toml")
    rig = Rig.load(rig_file)
    for view, known in zip(rig.views, given.views, strict=True):
        off_px = np.array(view.reference_points_px) - known.reference_points_px
        assert np.linalg.norm(off_px, axis=1).max() < 0.3
    Pointer(rig)


@pytest.mark.skipif(not (SHARED / "data/mat").exists(), reason="needs the shared footage")
def test_a_rounded_mat_with_a_corner_out_of_view(tmp_path):
    films = [SHARED / f"data/mat/{name}.mp4" for name in ("cam0", "cam1")]
    rig_file = tmp_path / "rig.toml"
    done = init("--from", *films, "--plane", "350x220", "-o", rig_file, "--frames", 1)
    assert done.exit_code == 0, done.output
    given = Rig.load(SHARED / "data/mat/rig.toml")
    for view, known in zip(Rig.load(rig_file).views, given.views, strict=True):
        points = np.array(view.reference_points_px)
        # In the opposite order: `init` gives axes X and Y that are right-handed from above.
        off_px = np.linalg.norm(points - np.array(known.reference_points_px)[::-1], axis=1)
        assert off_px.max() < 1.5
