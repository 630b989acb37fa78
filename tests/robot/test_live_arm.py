"""An arm guided from the operator's page, as measured at the emulated controller.

The command runs in a subprocess. The page is a WebSocket client that is killed, falls silent,
releases the key, or never had the control.
"""

import contextlib
import json
import math
import shutil
import socket
import threading
import time
from functools import partial

import pytest
from guided_process import HOLD_FRAMES, EmulatedArm, cut_film, write_rig
from live_server import served
from patience import wait_until
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

playwright = pytest.importorskip("playwright.sync_api")
CHROMIUM = shutil.which("chromium")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="needs chromium, Debian's package")

BEAT_S = 0.05
STOPPED_S = 0.5
"""Limit from the loss of the page to the standstill."""
LATE_BEATS = ("not armed: the page is silent", "the operator is gone")
"""Reasons of a stop due to late beats on a loaded machine."""

KNOWN_S = 2.0
"""Limit from a stop to its reason's appearance on every page."""

TRIES = 3
"""Attempts, of which the best counts: on a loaded machine a test may wait longer than the arm."""


class RawPage:
    """A page without a browser; a thread receives the server's messages."""

    def __init__(self, server):
        self.socket = connect(
            f"ws://{server.host}/socket",
            additional_headers={"Cookie": server.cookie},
            origin=server.base,
            max_size=None,
            close_timeout=0.2,
            ping_interval=None,
        ).__enter__()
        self.state, self.refused = {}, []
        self._beating = threading.Event()
        self._order = threading.Lock()  # no beat after the release that ends them
        self._closing = threading.Event()
        self._threads = [
            threading.Thread(target=each, daemon=True) for each in (self._listen, self._beat)
        ]
        for thread in self._threads:
            thread.start()

    def _listen(self):
        with contextlib.suppress(ConnectionClosed):
            for message in self.socket:
                if isinstance(message, bytes):
                    self.send(do="ack")
                    continue
                said = json.loads(message)
                self.state = said.get("state", self.state)
                self.refused += [said["refused"]] if "refused" in said else []

    def _beat(self):
        with contextlib.suppress(ConnectionClosed, OSError):
            while not self._closing.wait(BEAT_S):
                with self._order:
                    if self._beating.is_set():
                        self.send(do="beat")

    def send(self, **command):
        self.socket.send(json.dumps(command))

    def ask(self, *wishes):
        for what in wishes:
            self.send(do="robot", what=what)

    def hold(self):
        self._beating.set()

    def fall_silent(self):
        self._beating.clear()

    def let_go(self):
        with self._order:
            self._beating.clear()
            self.send(do="release")

    def die(self):
        """End like a killed process: the connection closes without a message."""
        self._closing.set()
        self.socket.socket.shutdown(socket.SHUT_RDWR)
        self.join()

    def close(self):
        self._closing.set()
        self.socket.close()
        self.join()

    def join(self):
        for thread in self._threads:
            thread.join()

    @property
    def arm(self):
        return self.state.get("arm") or {}


@pytest.fixture(scope="module")
def guided(hand_film, tmp_path_factory):
    """Serve the page, with an arm that is not homed and a hand at rest."""
    folder = tmp_path_factory.mktemp("live")
    still = [*range(HOLD_FRAMES), *([HOLD_FRAMES - 1] * 3000)]
    rig = write_rig(folder, hand_film, cut_film(folder / "film", hand_film, still))
    with EmulatedArm(homing_s=3.0) as arm:
        options = ("--arm", "--url", arm.url, "--speed", "0.02", "--max-age", "3")
        with served(rig, *options, "--log", folder / "log.csv") as server:
            yield arm, server


def set_moving(arm, watcher, begin):
    """Start a motion; retry if late beats, and nothing else, have ended it."""
    known_s = math.inf

    def moves_or_is_late():
        is_late = time.monotonic() > known_s and watcher.arm["why"] in LATE_BEATS
        return arm.is_moving() or is_late

    for _ in range(TRIES):
        begin()
        known_s = time.monotonic() + KNOWN_S
        wait_until(moves_or_is_late, "a motion")
        if arm.is_moving():
            return
    raise AssertionError(f"no motion in {TRIES} attempts: {watcher.arm['why']}")


def assert_stops(arm, watcher, begin, stop, why):
    """Assert that `stop` stops the arm soon and permanently, with the reason `why`."""
    for k in range(TRIES):
        set_moving(arm, watcher, begin)
        stop()
        stopped_s = time.monotonic()
        wait_until(lambda: not arm.is_moving(), "a stop")
        took_s = time.monotonic() - stopped_s
        moves = len(arm.controller.moves)
        time.sleep(0.3)
        assert not arm.is_moving()
        assert len(arm.controller.moves) == moves
        wait_until(lambda: not watcher.arm["holds"], "the page's state")
        given = watcher.arm["why"]
        if took_s < STOPPED_S and given == why:
            return
        # On a loaded machine, late beats may have stopped the arm before.
        assert k < TRIES - 1, (took_s, given)


def test_the_page_is_the_dead_man_and_watchers_may_only_stop(guided):
    arm, server = guided
    page, watcher = RawPage(server), RawPage(server)
    wait_until(lambda: page.arm, "the arm's state")
    assert not page.arm["homed"]
    assert page.arm["why"] == "not armed"

    # Without arming, or armed without the control, nothing moves.
    page.send(do="take")
    page.hold()
    watcher.ask("arm", "home")
    watcher.hold()
    wait_until(lambda: watcher.refused, "a refusal")
    assert "another page has the control" in watcher.refused[0]
    page.let_go()
    watcher.fall_silent()
    assert not page.arm["armed"]
    assert arm.controller.moves == []
    assert not arm.controller.homed

    # Homing stops when the key is released, and completes when it is held.
    page.ask("arm", "home")
    aborts = arm.controller.aborts
    page.hold()
    wait_until(lambda: page.arm["moves"], "homing")
    page.let_go()
    wait_until(lambda: arm.controller.aborts > aborts, "a stop")
    assert not page.arm["homed"]
    page.hold()
    wait_until(lambda: page.arm["homed"], "the end of homing")
    page.let_go()

    # A released key, a silent page, a killed page, STOP from a watcher.
    def go():
        page.ask("arm", "follow")
        page.hold()

    assert_stops(arm, watcher, go, page.let_go, "not held")
    assert_stops(arm, watcher, go, page.fall_silent, "not armed: the page is silent")
    moves = len(arm.controller.moves)
    page.hold()  # only arming again makes it move
    time.sleep(0.3)
    assert len(arm.controller.moves) == moves

    def press_stop():
        watcher.send(do="stop")

    assert_stops(arm, watcher, go, press_stop, "not armed: STOP was pressed")
    page.let_go()

    def die():
        nonlocal page
        page.die()
        page = RawPage(server)

    assert_stops(arm, watcher, go, die, "not armed: the page is gone")
    page.close()
    watcher.close()


@pytest.fixture(scope="module")
def browser():
    with playwright.sync_playwright() as driver:
        # Root in a container cannot use Chromium's sandbox.
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield browser
        browser.close()


def until(page, condition):
    """Wait until an expression is true; the page's policy forbids the evaluation of strings."""
    wait_until(lambda: page.evaluate(f"() => Boolean({condition})"), condition)


def test_an_operator_holds_key_or_button_and_the_arm_moves_meanwhile(guided, browser):
    arm, server = guided
    context = browser.new_context(viewport={"width": 1280, "height": 800})
    complaints = []

    def opened():
        page = context.new_page()
        page.on("console", lambda said: complaints.append(said.text))
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.goto(server.address)
        until(page, "!document.querySelector('#robot').hidden")
        return page

    page = opened()
    arms = "document.querySelector('.arm-armed').ariaPressed === 'true'"

    page.keyboard.down("m")
    until(page, "document.querySelector('#message').textContent.includes('not armed')")
    page.keyboard.up("m")
    assert not arm.is_moving()

    def arm_it():
        page.keyboard.press("c")
        if not page.evaluate(f"() => {arms}"):
            page.keyboard.press("a")
        until(page, arms)

    def hold_key():
        page.keyboard.up("m")  # still down if late beats have ended the last motion
        arm_it()
        page.keyboard.down("m")

    def hold_button():
        page.mouse.up()
        arm_it()
        box = page.locator(".arm-hold").bounding_box()
        page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
        page.mouse.down()

    watcher = RawPage(server)
    wait_until(lambda: watcher.arm, "the arm's state")
    while not watcher.arm["homed"]:
        page.keyboard.press("o")
        hold_key()
        wait_until(lambda: watcher.arm["homed"] or watcher.arm["why"], "the end of homing")
    page.keyboard.up("m")
    page.keyboard.press("f")

    def drawn_while_it_moves():
        hold_key()
        until(page, "document.querySelector('.arm-body path')?.getAttribute('d')")

    assert_stops(arm, watcher, drawn_while_it_moves, lambda: page.keyboard.up("m"), "not held")
    assert_stops(arm, watcher, hold_button, page.mouse.up, "not held")
    escape = partial(page.keyboard.press, "Escape")
    assert_stops(arm, watcher, hold_button, escape, "not armed: STOP was pressed")
    until(page, "document.querySelector('#robot .doing').textContent.includes('STOP')")

    touches = []
    devtools = context.new_cdp_session(page)

    def touch(*points):
        kind = "touchEnd" if not points else "touchMove" if touches else "touchStart"
        touches[:] = [{"x": x, "y": y} for x, y in points]
        devtools.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": touches})

    def hold_by_touch():
        if touches:
            touch()
        arm_it()
        box = page.locator(".arm-hold").bounding_box()
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        touch((x, y))
        touch((x + 60, y - 120))  # a finger that slides scrolls nothing, and still holds

    assert_stops(arm, watcher, hold_by_touch, touch, "not held")

    # Closing a page whose button is held down.
    def hold_button_of_a_new_page():
        nonlocal page
        page.close()
        page = opened()
        hold_button()

    assert_stops(
        arm, watcher, hold_button_of_a_new_page, lambda: page.close(), "not armed: the page is gone"
    )
    context.close()
    watcher.close()
    assert complaints == []
