"""Set-up on the page by a new user: without typing, and every step without axe violations."""

import shutil

import numpy as np
import pytest
from live_server import RIG, served, unclean
from test_live_page import CHROMIUM, PHONE, Open, browser  # noqa: F401 - a fixture

from fingerpost.config import Rig

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="needs chromium, Debian's package")

RESTS = "document.querySelector('#doing').textContent.startsWith('rig.toml goes to')"
KNOWN = "document.querySelector('#words').textContent === 'the table is known'"
MOST_CLICKS = 8


@pytest.fixture
def films(tmp_path):
    """A folder with the clip's films and one file that is not a film."""
    for name in ("left.mp4", "right.mp4"):
        shutil.copy(RIG.with_name(name), tmp_path)
    (tmp_path / "broken.mp4").write_bytes(b"no film at all")
    return tmp_path


class NewUser:
    """A user who has only a mouse; counts clicks."""

    def __init__(self, page):
        self.page, self.clicks = page, 0

    def click(self, selector):
        self.page.page.click(selector)
        self.clicks += 1


def click_corners(page, k, points_px):
    for u, v in points_px:
        x, y = page.page.evaluate(
            """([k, u, v]) => {
              const svg = document.querySelectorAll('.pane svg')[k];
              const point = new DOMPoint(u, v).matrixTransform(svg.getScreenCTM());
              return [point.x, point.y];
            }""",
            [k, u, v],
        )
        page.page.mouse.click(x, y)


def set_sides(page, mm):
    for side in page.page.locator(".slide input[type=number]").all():
        side.fill(str(mm))


def turns(saved, true):
    """Cyclic shift of each view's reference points relative to the true ones [corners]."""
    found = []
    for view, known in zip(saved.views, true.views, strict=True):
        off_px = [
            np.abs(np.roll(view.reference_points_px, k, axis=0) - known.reference_points_px).max()
            for k in range(4)
        ]
        assert min(off_px) < 1.5, view.name
        found.append(int(np.argmin(off_px)))
    return found


def test_from_two_films_to_a_rig_and_a_point_without_typing(browser, films):  # noqa: F811
    with served("left.mp4", "right.mp4", folder=films) as running:
        page = Open(browser, running, color_scheme="dark")
        user = NewUser(page)
        page.until(f"{KNOWN} && {RESTS}")
        assert "found" in page.text(".pane .left >> nth=0")
        assert page.page.locator(".cells path").count() > 10
        assert "mm" in page.text("#legend")
        assert unclean(page.page) == []

        page.page.reload()  # the corners found are kept
        page.until(f"{KNOWN} && document.querySelectorAll('.pane .handle').length === 8")

        user.click("#next")
        page.until("document.querySelector('#words').textContent === 'the hand is found'")
        page.until(RESTS)
        assert page.page.locator(".pane .contour.tracking[d^=M]").count() == 2
        assert unclean(page.page) == []

        user.click("text=Hold it up to a template")
        page.until(f"{RESTS} && document.querySelectorAll('.template-line[d]').length === 2")
        assert unclean(page.page) == []
        user.click("text=Hold it up to a template")
        page.until(RESTS)

        for step, mark in (("4", ".ask >> text=Begin"), ("5", "#summary dd >> nth=0")):
            user.click(f".step >> nth={int(step) - 1}")
            assert page.page.is_visible(mark)
            assert unclean(page.page) == [], step
        user.click("#begin")
        page.until("document.querySelector('#point').offsetParent")
        assert user.clicks <= MOST_CLICKS
        assert page.page.title() == "rig.toml – fingerpost"
        page.close()
    saved = Rig.load(films / "rig.toml")
    assert [view.name for view in saved.views] == ["left", "right"]
    assert all(view.size_px == (640, 480) for view in saved.views)
    # Both views begin at the same corner, and corners that were found have a covariance.
    assert len(set(turns(saved, Rig.load(RIG)))) == 1
    assert all(view.reference_covariances_px2 is not None for view in saved.views)


def test_corners_can_be_clicked_and_a_wrong_order_is_named(browser, films):  # noqa: F811
    truth = Rig.load(RIG)
    with served(folder=films) as running:
        page = Open(browser, running, color_scheme="light")
        page.until("document.querySelectorAll('.offer:enabled').length === 3")  # 2 films, drop area
        assert "decode" in page.text(".offer:disabled small")
        assert page.text("#words") == "pick two views, or more"
        assert unclean(page.page) == []
        page.press("3")
        assert page.page.locator(".step:enabled").count() == 1
        assert page.text(".step[aria-current=step] b") == "Views"
        for name in ("left", "right"):
            page.page.click(f".offer:has-text('{name}')")
        page.press("n")
        page.until(KNOWN)
        page.page.select_option("select", "markers")
        assert page.page.locator(".pane .handle").count() == 0
        page.until(f"{RESTS} && document.querySelector('#words').textContent.startsWith('not')")
        assert page.text("#words") == "not found in left"
        assert "no marker of sheet 1 is found" in page.text("#detail")
        assert page.page.locator(".step:enabled").count() == 2
        assert page.page.is_disabled("#next")
        page.page.select_option("select", "other")
        set_sides(page, 400)
        page.until(f"{KNOWN} && {RESTS} && document.querySelectorAll('.pane .handle').length === 8")
        assert "found" in page.text(".pane .left >> nth=0")
        page.page.click("text=Click corners myself")
        assert page.text("#words") == "click corner 1 in left"
        click_corners(page, 0, truth.views[0].reference_points_px)
        page.until("document.querySelector('#words').textContent === 'click corner 1 in right'")
        wrong = list(truth.views[1].reference_points_px)
        click_corners(page, 1, [wrong[0], wrong[3], wrong[2], wrong[1]])
        page.until("document.querySelector('#words').textContent === 'that cannot be'")
        assert len(page.text("#detail")) > 20
        assert page.page.is_disabled("#begin")
        assert not (films / "rig.toml").exists()
        page.page.click("text=Click corners myself")
        for k in range(2):
            click_corners(page, k, truth.views[k].reference_points_px)
        page.until(f"{KNOWN} && {RESTS}")
        set_sides(page, 40)
        page.until("document.querySelector('#words').textContent.startsWith('no hand would')")
        assert "does it measure 40 × 40 mm?" in page.text("#detail")
        set_sides(page, 400)
        page.until(f"{KNOWN} && {RESTS}")
        page.page.locator(".pane:nth-of-type(2) .handle").first.focus()
        page.press("ArrowLeft")
        assert page.page.is_visible("#loupe")
        page.until(
            f"{RESTS} && document.querySelector('.pane:nth-of-type(2) .left')"
            ".textContent.startsWith('by hand')"
        )
        assert unclean(page.page) == []
        page.page.click("#begin")
        page.until("document.querySelector('#stage').offsetParent")
        page.close()
    saved = Rig.load(films / "rig.toml")
    assert turns(saved, truth) == [0, 0]
    assert saved.views[1].reference_covariances_px2 is None


def test_recordings_are_dropped_onto_the_page(browser, films, tmp_path):  # noqa: F811
    (tmp_path / "empty").mkdir()
    with served(folder=tmp_path / "empty") as running:
        page = Open(browser, running, size=PHONE)
        page.until("document.querySelector('#words').textContent.startsWith('no camera')")
        assert "recordings" in page.text("#detail")
        assert page.page.is_disabled("#begin")
        page.page.evaluate(
            """() => {
              const carried = new DataTransfer();
              carried.items.add(new File(['words'], 'notes.txt'));
              const dropped = { dataTransfer: carried, bubbles: true };
              document.body.dispatchEvent(new DragEvent('drop', dropped));
            }"""
        )
        page.until("document.querySelector('#doing').textContent.includes('no recording')")
        page.complaints.clear()  # the browser notes the refusal
        page.page.set_input_files("#films", [films / "left.mp4", films / "right.mp4"])
        page.until("document.querySelectorAll('.offer[aria-pressed=true]').length === 2")
        page.page.click("#next")
        assert page.page.locator(".pane").count() == 2
        # On a phone, what a step asks for is above its pictures.
        assert page.box("select")["y"] < page.box(".pane")["y"]
        assert page.page.evaluate("document.documentElement.scrollWidth") <= PHONE[0]
        assert unclean(page.page) == []
        assert page.complaints == []
        running.process.terminate()
        running.end()
        page.until("document.querySelector('#words').textContent.startsWith('no connection')")
        assert page.page.is_disabled("#begin")
        page.context.close()
    for name in ("left.mp4", "right.mp4"):
        assert (tmp_path / "empty" / name).read_bytes() == (films / name).read_bytes()
