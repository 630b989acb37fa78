"""The page in a browser: projected plan, experiments, bookmarks, notebook."""

import http.server
import socket
import subprocess
import sys
import threading

import cv2
import numpy as np
import pytest
from live_server import RIG, served
from patience import PATIENCE_S, wait_until
from test_live_page import STANDS, Open, browser, playwright, pytestmark  # noqa: F401

import fingerpost
from fingerpost.homography import estimate_image_from_plane
from fingerpost.live.composer import uncertainty_code
from fingerpost.pointing import Fix, Status
from fingerpost.recording import read_targets

SEED = 20
FRAMES, COVERED = 48, range(30, 42)


def fix_of(sigma):
    """A fix whose X has standard deviation `sigma`; without a point if None."""
    if sigma is None:
        return Fix(0.0, Status.LOST, ())
    return Fix(0.0, Status.OK, (), np.zeros(2), sigma**2 * np.diag([1.0, 0.25]))


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
    """Bounding box of the plane's outline in the window: left, top, right, bottom [px]."""
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


@pytest.fixture(scope="module")
def lossy(tmp_path_factory):
    """The clip as picture files; in some frames the left view's hand is covered."""
    folder = tmp_path_factory.mktemp("lossy")
    text = RIG.read_text(encoding="utf-8")
    for name in ("left", "right"):
        (folder / name).mkdir()
        text = text.replace(f"{name}.mp4", f"{name}/*.jpg")
        film = cv2.VideoCapture(str(RIG.with_name(f"{name}.mp4")))
        for frame in range(FRAMES):
            _, image = film.read()
            if name == "left" and frame in COVERED:
                image[:330, :330] = 90
            cv2.imwrite(str(folder / name / f"{frame:03d}.jpg"), image)
        film.release()
    (folder / "rig.toml").write_text(text, encoding="utf-8")
    with served(folder / "rig.toml", folder=folder) as running:
        yield running


def test_a_click_shows_why_a_frame_was_lost_and_bookmarks_return_to_it(browser, lossy):  # noqa: F811
    page = Open(browser, lossy)
    page.at(FRAMES - 1)
    page.until("document.documentElement.dataset.status === 'ok'")
    strip, lost = page.box("#strip"), COVERED[len(COVERED) // 2]
    page.page.mouse.click(strip["x"] + (lost + 0.5) / FRAMES * strip["width"], strip["y"] + 25)
    page.until(f"document.querySelector('#clock').textContent.endsWith('frame {lost}')")
    page.until("document.querySelector('.why li')")
    left, right = page.page.locator(".view").all()
    assert left.locator(".why").is_visible()
    assert not right.locator(".why").is_visible()
    words = left.locator(".why").inner_text()
    assert "refused" in words
    assert "59 no edge" in words
    assert left.locator("path.search-lines").get_attribute("d").count("M") == 59
    assert left.locator("path.chosen").get_attribute("d") == ""
    assert right.locator("path.search-lines").get_attribute("d") == ""

    # A click on the other view's picture shows the edges that it chose and rejected.
    right.locator(".body").click(position={"x": 20, "y": 20})
    assert right.locator(".why").is_visible()
    assert right.locator("path.chosen").get_attribute("d").count("M") > 30
    page.press("i")
    assert not left.locator(".why").is_visible()

    page.press("n")
    mark = page.page.locator(".bookmark").bounding_box()
    at = strip["x"] + (lost + 0.5) / FRAMES * strip["width"]
    assert mark["x"] + mark["width"] / 2 == pytest.approx(at, abs=1.5)
    page.press("Home")
    page.until("document.querySelector('#clock').textContent.endsWith('frame 0')")
    page.page.reload()
    page.until("document.querySelector('.bookmark')")
    page.press(".")
    page.until(f"document.querySelector('#clock').textContent.endsWith('frame {lost}')")
    page.press("n")
    page.until("!document.querySelector('.bookmark')")
    page.close()


def test_the_strip_shows_how_uncertain_the_point_is():
    codes = [uncertainty_code(fix_of(sigma), 400.0) for sigma in (1e-9, 0.5, 5.0, 20.0, 1e4)]
    assert codes[0] == "0"
    assert codes[-1] == "9"
    assert codes == sorted(codes)
    # The 95 % ellipse's semi-axis is 2.448 sigma: from 0.1 % to 20 % of the plane in ten steps.
    assert codes[2] == str(round(9 * np.log(2.448 * 5.0 / 0.4) / np.log(200)))
    assert uncertainty_code(fix_of(None), 400.0) == "-"


class Notebook(http.server.BaseHTTPRequestHandler):
    """A page of another site that shows the output of a cell."""

    cell = ""

    def do_GET(self):
        self.send_response(200)
        self.send_header("Content-Type", "text/html")
        self.end_headers()
        self.wfile.write(f"<!doctype html><title>notebook</title>{self.cell}".encode())

    def log_message(self, *args):
        pass


def test_a_notebook_shows_the_page_in_a_frame_until_it_is_closed(browser):  # noqa: F811
    with fingerpost.show(RIG, height_px=640) as view:
        Notebook.cell = view._repr_html_()
        server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Notebook)
        thread = threading.Thread(target=server.serve_forever, args=[0.02])
        thread.start()
        page = Open.__new__(Open)
        page.context = browser.new_context(viewport={"width": 1100, "height": 700})
        shown = page.context.new_page()
        # Another site: no strict cookie is sent to the frame.
        shown.goto(f"http://localhost:{server.server_port}/")
        page.page = shown.frames[1]
        page.page.wait_for_selector(".view canvas")
        wait_until(
            lambda: page.page.evaluate("() => document.documentElement.dataset.status") == "ok"
        )
        assert page.page.title() == "rig.toml – fingerpost"
        assert shown.locator("iframe").bounding_box()["height"] == 640
        view.close()
        page.until("document.documentElement.classList.contains('cut-off')")
        page.context.close()
        server.shutdown()
        thread.join()
        server.server_close()


def test_a_kernel_that_ends_takes_its_page_along():
    code = f"import fingerpost; view = fingerpost.show({str(RIG)!r}); print(view.address)"
    ended = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=PATIENCE_S, check=True
    )
    port = int(ended.stdout.split(":")[2].partition("/")[0])
    assert ended.stderr == ""
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", port), 5.0)


def test_a_framed_address_needs_the_token_and_the_page_s_own_host(server):
    framed = f"/framed/{server.token}"
    status, text, headers = server.ask("GET", f"{framed}/")
    assert status == 200
    assert "main.js" in text
    policy = headers["content-security-policy"]
    assert "frame-ancestors" not in policy
    assert "default-src 'none'" in policy
    assert server.ask("GET", f"{framed}/main.js")[0] == 200
    for path in ("/framed/", "/framed/guess/", f"/framed/{server.token[:-1]}/main.js"):
        assert server.ask("GET", path)[0] == 403
    assert server.ask("GET", f"{framed}/", Host="evil.example")[0] == 400
    assert server.ask("POST", f"{framed}/", Origin="http://evil.example")[0] == 403
    assert server.ask("GET", f"{framed}/../../client.py")[0] == 404
