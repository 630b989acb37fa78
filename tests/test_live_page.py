"""The operator's page in a browser."""

import re
import shutil
import time

import pytest
from live_server import RIG, served, unclean
from patience import PATIENCE_S

from fingerpost.simulate import DevicePose, Placement, SimulatedRig, Trajectory, write_recording

playwright = pytest.importorskip("playwright.sync_api")
CHROMIUM = shutil.which("chromium")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="needs chromium, Debian's package")

OVERLAPS = """() => {
          const boxes = [...document.querySelectorAll('#head, .panel:not(.away), #line, #stop')]
            .map((e) => [e.id || e.className, e.getBoundingClientRect()]);
          const wrong = [];
          for (const [name, b] of boxes) {
            if (b.left < -1 || b.top < -1 || b.right > innerWidth + 1 || b.bottom > innerHeight + 1)
              wrong.push(`${name} is cut off`);
            for (const [other, c] of boxes)
              if (other !== name && b.left < c.right - 1 && c.left < b.right - 1
                  && b.top < c.bottom - 1 && c.top < b.bottom - 1)
                wrong.push(`${name} on ${other}`);
          }
          const point = document.querySelector('#point');
          if (point.scrollWidth > point.clientWidth + 1) wrong.push('the point is cut off');
          return wrong;
        }"""
PLAYS = "document.querySelector('#play').title.startsWith('Stand')"
STANDS = "document.querySelector('#play').title.startsWith('Play')"
PHONE, DESK, WALL = (390, 844), (1280, 800), (2560, 1440)


@pytest.fixture(scope="module")
def server():
    with served() as running:
        yield running


@pytest.fixture(scope="module")
def browser():
    with playwright.sync_playwright() as driver:
        # A container's root may not use Chromium's sandbox.
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield browser
        browser.close()


class Open:
    """The page in a window of its own; an error or warning on its console fails the test."""

    def __init__(self, browser, server, size=DESK, **options):
        width, height = size
        viewport = {"width": width, "height": height}
        self.context = browser.new_context(viewport=viewport, **options)
        self.page = self.context.new_page()
        self.page.set_default_timeout(1000 * PATIENCE_S)
        self.complaints = []
        self.page.on("console", lambda said: self._log(said.type, said.text))
        self.page.on("pageerror", lambda error: self._log("error", str(error)))
        self.page.goto(server.address)
        self.until(
            "document.querySelector('.view canvas')?.width > 300"
            " || document.querySelector('.offer')"
        )

    def _log(self, kind, text):
        if kind in ("error", "warning"):
            self.complaints.append(text)

    def until(self, condition):
        """Poll until a condition is true; the page's own policy forbids evaluating strings."""
        end_s = time.monotonic() + PATIENCE_S
        while not self.page.evaluate(f"() => Boolean({condition})"):
            assert time.monotonic() < end_s, condition
            self.page.wait_for_timeout(20)

    def press(self, *keys):
        for key in keys:
            self.page.keyboard.press(key)

    def at(self, frame):
        """Stop at a frame."""
        self.press("c", " ")
        self.until(STANDS)
        self.page.evaluate(
            "(frame) => { const scrub = document.querySelector('#scrub'); scrub.value = frame;"
            " scrub.dispatchEvent(new Event('input')); }",
            frame,
        )
        self.until(f"document.querySelector('#clock').textContent.endsWith('frame {frame}')")

    def play(self):
        """Play from the first frame on."""
        self.at(0)
        self.press("p")
        self.until(PLAYS)

    def text(self, selector):
        return self.page.inner_text(selector)

    def box(self, selector):
        return self.page.locator(selector).first.bounding_box()

    def close(self):
        self.context.close()
        assert self.complaints == []


@pytest.fixture
def opened(browser, server):
    pages = []

    def open_page(**options):
        pages.append(Open(browser, server, **options))
        return pages[-1]

    yield open_page
    for page in pages:
        page.close()


def test_the_address_loses_its_token_and_the_page_plays(opened):
    page = opened()
    assert "token" not in page.page.url
    page.play()
    page.until("parseFloat(document.querySelector('#rate').textContent) > 1")
    assert page.page.title() == "rig.toml – fingerpost"


def test_a_point_is_read_in_the_headline_and_drawn_in_all_views_and_on_the_plan(opened):
    page = opened()
    page.at(50)
    page.until("document.documentElement.dataset.status === 'ok'")
    assert page.text("#badge-word") == "ok"
    assert re.fullmatch(
        r"X\s*[\d.]+\s*±\s*[\d.]+\s*Y\s*[\d.]+\s*±\s*[\d.]+\s*mm", page.text("#point")
    )
    assert page.page.locator(".point-mark:visible").count() == 3
    for shape in ("contour.tracking", "finger", "ellipse", "outline"):
        drawn = f".view path.{shape}"
        assert page.page.eval_on_selector_all(
            drawn, "all => all.every(one => one.getAttribute('d'))"
        )
    assert page.page.locator(".view .state[data-status=ok]").count() == 2
    assert "%" in page.text(".view .caption >> nth=0")


def test_targets_show_where_they_are_and_how_probable_each_is(browser, tmp_path):
    shutil.copytree(RIG.parent, tmp_path / "clip")
    rig_file = tmp_path / "clip" / "rig.toml"
    with rig_file.open("a", encoding="utf-8") as file:
        for name, x, y, radius in (("cup", 100, 100, 60), ("box", 350, 350, 25)):
            file.write(f'[[target]]\nname = "{name}"\npoint = [{x}, {y}]\nradius = {radius}\n')
    with served(rig_file) as running:
        page = Open(browser, running)
        page.at(55)  # points at (89, 97)
        page.until("document.querySelector('.target.likely')")
        words = page.page.evaluate(
            "() => [...document.querySelectorAll('.target-name')].map((e) => e.textContent)"
        )
        discs, names = (
            [box.bounding_box() for box in page.page.query_selector_all(selector)]
            for selector in (".target", ".target-name")
        )
        page.close()
    assert [re.fullmatch(r"(cup|box) (\d+) %", said)[1] for said in words] == ["cup", "box"]
    assert int(words[0].split()[1]) > 90
    assert words[1] == "box 0 %"
    for disc, name in zip(discs, names, strict=True):
        assert name["x"] + name["width"] / 2 == pytest.approx(disc["x"] + disc["width"] / 2, abs=2)


@pytest.fixture(scope="module")
def crowded(tmp_path_factory):
    """A rig file of four views and twelve targets with long names."""
    still = Trajectory.hold(
        DevicePose.pointing_at((250, 220), azimuth_deg=20.0, slant_deg=50.0, hover_mm=120.0), 1.0
    )
    cameras = Placement(azimuths_deg=(-60.0, -20.0, 20.0, 60.0))
    folder = tmp_path_factory.mktemp("crowded")
    rig_file = write_recording(folder, SimulatedRig(cameras), still, frames=4, fps=25.0, rng=3)
    with rig_file.open("a", encoding="utf-8") as file:
        for k in range(12):
            x, y = 60 + 100 * (k % 4), 70 + 130 * (k // 4)
            file.write(f'[[target]]\nname = "target number {k + 1}"\npoint = [{x}, {y}]\n')
            file.write("radius = 30\n")
    return rig_file


CUT = """() => {
  const texts = [...document.querySelectorAll('.caption, .panel h2')];
  const cut = texts.filter((e) => e.scrollWidth > e.clientWidth + 1).map((e) => e.textContent);
  const boxes = [...document.querySelectorAll('.target-name')]
    .filter((e) => e.style.visibility !== 'hidden')
    .map((e) => [e.textContent, e.getBoundingClientRect()]);
  const meet = boxes.flatMap(([name, a], k) => boxes.slice(k + 1).filter(([, b]) =>
    a.left < b.right && b.left < a.right && a.top < b.bottom && b.top < a.bottom).map(() => name));
  return [...cut, ...meet];
}"""


def test_four_views_and_twelve_targets_fit(browser, crowded):
    with served(crowded) as running:
        page = Open(browser, running)
        page.at(2)
        for width, height in ((1440, 900), (1024, 768), PHONE):
            page.page.set_viewport_size({"width": width, "height": height})
            page.page.wait_for_timeout(100)
            assert page.page.evaluate(OVERLAPS) == [], width
            assert page.page.evaluate(CUT) == [], width
            assert page.page.evaluate("document.documentElement.scrollWidth") <= width
        assert unclean(page.page) == []
        page.close()


def test_without_a_point_the_state_is_shown_in_words(opened):
    page = opened()
    page.at(0)
    page.until("document.documentElement.dataset.status === 'acquiring'")
    assert page.text("#badge-word") == "acquiring"
    assert "settle" in page.text("#words")
    assert not page.page.is_visible("#point")
    assert page.page.locator(".point-mark:visible").count() == 0


def test_the_overlay_lies_where_the_picture_shows_it(opened):
    page = opened()
    page.at(50)
    for k in (1, 2):
        view = f".view:nth-of-type({k})"
        canvas, overlay = page.box(f"{view} canvas"), page.box(f"{view} svg.overlay")
        assert canvas == pytest.approx(overlay, abs=0.5)
        assert canvas["width"] / canvas["height"] == pytest.approx(640 / 480, rel=0.01)


@pytest.mark.parametrize("key", [" ", "Escape"])
def test_space_and_escape_stop_from_anywhere(opened, key):
    page = opened()
    theme = page.page.evaluate("document.documentElement.dataset.theme")
    for focus in ("body", "#theme", "#scrub", "#help button"):
        page.play()
        if focus == "#help button":
            page.press("?")
        page.page.evaluate(f"document.querySelector('{focus}').focus()")
        page.press(key)
        page.until(STANDS)
    assert page.page.evaluate("document.documentElement.dataset.theme") == theme


def test_the_cursor_goes_with_the_picture(opened):
    page = opened()
    for frame in (60, 20):
        page.at(frame)
        strip, cursor = page.box("#strip"), page.box("#cursor")
        frames = page.page.evaluate("Number(document.querySelector('#scrub').max) + 1")
        at = strip["x"] + (frame + 0.5) / frames * strip["width"]
        assert cursor["x"] + cursor["width"] / 2 == pytest.approx(at, abs=1.0)


def test_arrow_keys_step_back_and_forward(opened):
    page = opened()
    page.at(30)
    for key, frame in [("ArrowRight", 31), ("ArrowLeft", 30), ("Shift+ArrowLeft", 5), ("Home", 0)]:
        page.press(key)
        page.until(f"document.querySelector('#clock').textContent.endsWith('frame {frame}')")


def test_the_stop_button_stops(opened):
    page = opened()
    page.play()
    page.page.click("#stop")
    page.until(STANDS)


def test_a_frame_is_the_same_when_it_is_shown_again(opened):
    page = opened()
    shown = []
    for frame in (50, 20, 50):
        page.at(frame)
        contour = page.page.get_attribute(".view path.contour.tracking", "d")
        page.until("document.documentElement.dataset.status === 'ok'")
        shown.append((contour, page.page.get_attribute(".plan path.ellipse", "d")))
    assert shown[0] == shown[2] != shown[1]


def test_one_of_two_pages_has_control_and_both_can_stop(opened):
    first, second = opened(), opened()
    first.play()
    second.until("document.querySelector('#message').textContent.includes('control')")
    second.press("Home")
    second.until("document.querySelector('#message').textContent.includes('take it over')")
    second.press(" ")
    first.until(STANDS)


@pytest.mark.parametrize("size", [PHONE, DESK, WALL], ids=["phone", "desk", "wall"])
def test_everything_fits_and_nothing_overlaps(opened, size):
    page = opened(size=size)
    page.at(50)
    page.until("document.documentElement.dataset.status === 'ok'")
    for mode in ("0", "1", "3", "l"):  # all, a view alone, the plan alone, large
        page.press("0", mode)
        assert page.page.evaluate(OVERLAPS) == [], mode
        stop = page.box("#stop")
        assert stop["width"] >= 200
        assert stop["height"] >= 64


def test_both_coordinates_are_read_at_every_width(opened):
    page = opened()
    page.at(50)
    page.until("document.documentElement.dataset.status === 'ok'")
    cut = []
    for width in (1440, 1200, 1199, 1024, 901, 900, 800, 721, 720, 640, 390, 360):
        page.page.set_viewport_size({"width": width, "height": 560})
        shown, has = page.page.evaluate(
            "(({ scrollWidth, clientWidth }) => [scrollWidth, clientWidth])"
            "(document.querySelector('#point'))"
        )
        bottom = "document.querySelector('{}').getBoundingClientRect().bottom"
        heights = [page.page.evaluate(bottom.format(one)) for one in ("#said", "#head")]
        if shown > has or heights[0] > heights[1]:
            cut.append(width)
    assert cut == []


def test_nothing_moves_while_numbers_change(opened):
    page = opened()
    places = []
    for frame in (30, 50, 70):
        page.at(frame)
        page.until("document.documentElement.dataset.status === 'ok'")
        selectors = ("#sx", "#y", "#unit", "#rate", "#stop", ".plan .body")
        places.append([page.box(selector) for selector in selectors])
    lefts = [[round(box["x"]) for box in boxes] for boxes in places]
    assert lefts[0] == lefts[1] == lefts[2]


@pytest.mark.parametrize("scheme", ["dark", "light"])
def test_text_contrasts_with_its_background(opened, scheme):
    page = opened(color_scheme=scheme)
    page.at(50)
    poor = page.page.evaluate(
        """() => {
          const rgb = (text) => text.match(/[\\d.]+/g).map(Number);
          const light = ([r, g, b]) => {
            const f = (v) => ((v /= 255) <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);
            return 0.2126 * f(r) + 0.7152 * f(g) + 0.0722 * f(b);
          };
          const ground = (e) => {
            for (; e; e = e.parentElement) {
              const colour = rgb(getComputedStyle(e).backgroundColor);
              if (colour.length === 3 || colour[3] > 0) return colour;
            }
          };
          const said = [...document.querySelectorAll('#badge-word, #point b, .sigma, #detail, dt,'
            + ' dd, .panel h2, .state span, .caption, #message, #clock, #stop')];
          return said.map((e) => {
            const [a, b] = [light(rgb(getComputedStyle(e).color)), light(ground(e))];
            const contrast = (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
            return [e.id || e.className || e.tagName, contrast];
          }).filter(([, contrast]) => contrast < 4.5);
        }"""
    )
    assert poor == []


def test_every_control_has_a_name_and_is_large_enough(opened):
    page = opened(size=PHONE)
    nameless = page.page.evaluate(
        """() => [...document.querySelectorAll('button, input')].filter((e) => e.offsetParent
          && !(e.getAttribute('aria-label') || e.textContent.trim())).map((e) => e.outerHTML)"""
    )
    assert nameless == []
    for button in page.page.locator("#tools button, #transport button").all():
        box = button.bounding_box()
        assert min(box["width"], box["height"]) >= 40


def test_keys_are_shown_and_theme_and_edges_follow_them(opened):
    page = opened(color_scheme="dark")
    page.at(50)
    assert page.page.get_attribute(".view path.search-lines", "d") == ""
    page.press("e")
    assert page.page.get_attribute(".view path.search-lines", "d").count("M") > 20
    ground = "getComputedStyle(document.body).backgroundColor"
    dark = page.page.evaluate(ground)
    page.press("t")
    assert page.page.evaluate(ground) != dark
    page.press("?")
    assert page.page.is_visible("#help")
    page.press("Escape")
    assert not page.page.is_visible("#help")


def test_when_fingerpost_ends_the_page_says_so(browser):
    with served() as running:
        page = Open(browser, running)
        page.at(50)
        page.until("document.querySelector('#point').offsetParent")
        plan = page.context.new_page()
        plan.goto(f"{running.base}/plan")
        plan.wait_for_selector(".point-mark:visible")
        running.process.terminate()
        running.end()
        page.until("document.documentElement.classList.contains('cut-off')")
        assert "No connection" in page.text("#message")
        # The last point does not stay as if it were the present one.
        assert page.text("#words") == "no connection"
        assert not page.page.is_visible("#point")
        assert page.page.locator(".point-mark:visible, .finger:visible").count() == 0
        plan.wait_for_selector("#cut:visible")
        assert plan.locator(".point-mark:visible, .constraint:visible").count() == 0
        page.context.close()


def test_the_demo_plays_the_clip_to_its_end_and_again(browser):
    with served("--live", command="demo") as running:
        page = Open(browser, running)
        assert page.page.title() == "the built-in clip – fingerpost"
        page.at(int(page.page.get_attribute("#scrub", "max")) - 5)
        page.press("p")
        page.until("document.querySelector('#message').textContent.includes('P plays it again')")
        page.page.set_viewport_size({"width": PHONE[0], "height": PHONE[1]})
        shown = "document.querySelector('#message')"
        assert page.page.evaluate(f"{shown}.scrollWidth <= {shown}.clientWidth")
        assert page.page.evaluate(f"{shown}.scrollHeight <= {shown}.clientHeight")
        page.press("p")
        page.until("Number(document.querySelector('#clock').textContent.match(/\\d+$/)[0]) < 60")
        page.close()


@pytest.mark.parametrize("scheme", ["dark", "light"])
def test_every_mode_is_clean_by_axe(opened, scheme):
    page = opened(color_scheme=scheme)
    page.at(50)
    for keys in ([], ["e"], ["e", "1"], ["3"], ["0", "l"], ["l", "?"]):
        page.press(*keys)
        assert unclean(page.page) == [], keys
