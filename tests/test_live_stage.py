"""The page in a browser: the projected plan, experiments, bookmarks, and in a notebook."""

import numpy as np
import pytest
from live_server import RIG, served
from test_live_page import STANDS, Open, browser, playwright, pytestmark  # noqa: F401

from fingerpost.homography import estimate_image_from_plane
from fingerpost.recording import read_targets

SEED = 20


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("stage")


@pytest.fixture(scope="module")
def server(folder):
    with served(RIG, folder=folder) as running:
        yield running


@pytest.fixture
def page(browser, server):  # noqa: F811
    opened = Open(browser, server)
    yield opened
    opened.close()


def outline(page):
    """The window's rectangle about the outline of the plane, as it is shown."""
    box = page.page.locator(".plan-outline").bounding_box()
    return [box["x"], box["y"], box["x"] + box["width"], box["y"] + box["height"]]


def corners_of(page):
    boxes = [corner.bounding_box() for corner in page.page.locator(".corner").all()]
    return np.array([(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2) for box in boxes])


def test_the_plan_is_warped_onto_four_corners_and_keeps_them(page):
    page.page.goto(page.page.url + "plan")
    page.until("document.querySelector('.plan-outline')?.getAttribute('d')")
    before = corners_of(page)
    for k, (right, down) in enumerate([(60, -40), (-160, -60), (-20, 80), (120, 20)]):
        x, y = before[k]
        page.page.mouse.move(x, y)
        page.page.mouse.down()
        page.page.mouse.move(x + right, y + down, steps=2)
        page.page.mouse.up()
        before[k] += right, down
    np.testing.assert_allclose(corners_of(page), before, atol=0.6)
    around = [*before.min(axis=0), *before.max(axis=0)]
    np.testing.assert_allclose(outline(page), around, atol=4.0)  # the width of the line

    page.press("1", "ArrowRight", "Shift+ArrowDown")
    first = page.page.locator(".corner:focus").inner_text()
    assert first == "1"
    page.page.reload()
    page.until("document.querySelector('.plan-outline')?.getAttribute('d')")
    moved = corners_of(page) - before
    assert np.sort(np.abs(moved).sum(axis=1)).round().tolist() == [0, 0, 0, 21]
    page.press("r")
    assert np.abs(corners_of(page) - before).max() > 20


def test_the_page_s_homography_is_the_package_s(page):
    rng = np.random.default_rng(SEED)
    square = np.array([[0, 0], [900, 0], [900, 600], [0, 600]], float)
    for spread in (50, 200, 290):
        to = square + rng.uniform(-spread, spread, (4, 2))
        found = page.page.evaluate(
            "async ([from, to]) => (await import('/warp.js')).homography(from, to)",
            [square.tolist(), to.tolist()],
        )
        H = estimate_image_from_plane(square, to)
        np.testing.assert_allclose(np.reshape(found, (3, 3)), H / H[2, 2], rtol=1e-6, atol=1e-9)
    on_a_line = [[0, 0], [1, 1], [2, 2], [0, 5]]
    assert (
        page.page.evaluate(
            "async ([from, to]) => (await import('/warp.js')).homography(from, to)",
            [on_a_line, square.tolist()],
        )
        is None
    )


def test_an_experiment_asks_for_targets_and_tallies_the_errors(page, folder):
    page.at(50)
    page.press("x")
    page.until("document.querySelector('#experiment .doing').textContent.startsWith('Target 1 of')")
    page.press("k")
    for number in range(2, 13):
        page.until(
            f"document.querySelector('#experiment .doing').textContent.includes(' {number} ')"
        )
        page.press("Enter")
    page.until("!document.querySelector('#experiment .figures').hidden")
    rows = read_targets(folder / "experiment.csv")
    assert [row.by for row in rows] == ["skip", *["key"] * 11]
    assert rows[0].x is None
    targets = np.array([(row.target_x, row.target_y) for row in rows])
    assert len(np.unique(targets, axis=0)) == 12
    errors = np.hypot(*(targets[1:] - [(row.x, row.y) for row in rows[1:]]).T)
    np.testing.assert_allclose([row.error for row in rows[1:]], errors)
    figures = page.text("#experiment .figures")
    assert "11 of 12" in figures
    assert f"{np.median(errors):.3g}" in figures
    drawn = page.page.get_attribute(".plan .trial-error", "d")
    assert drawn.count("M") == 11
    page.press("x")
    page.until("document.querySelector('#experiment').hidden")
