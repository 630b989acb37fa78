"""The arm guided from the operator's page: seen at the emulated controller's end.

The command runs as a process of its own; the page is a real WebSocket client here, which is killed,
falls silent, lets go, or never had the control.
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
"""After a page has gone, the arm stands within this."""
LATE_BEATS = ("not armed: the page is silent", "the operator is gone")
"""Why an arm stands that was held, where a crowded machine has let beats come late."""

KNOWN_S = 2.0
"""Why an arm stands is on every page within this."""

TRIES = 3
"""A crowded machine may let a test wait longer than the arm: the best of so many counts."""


class RawPage:
    """A page without a browser: commands go out, and a thread hears what comes back."""

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
        self._order = threading.Lock()  # no beat after what ends them
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
        """As a process that is killed: its connection is reset, without a word."""
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
    """The page's server, with an arm that is not homed yet, and a hand that stays in one place."""
    folder = tmp_path_factory.mktemp("live")
    still = [*range(HOLD_FRAMES), *([HOLD_FRAMES - 1] * 3000)]
    rig = write_rig(folder, hand_film, cut_film(folder / "film", hand_film, still))
    with EmulatedArm(homing_s=3.0) as arm:
        options = ("--arm", "--url", arm.url, "--speed", "0.02", "--max-age", "3")
        with served(rig, *options, "--log", folder / "log.csv") as server:
            yield arm, server


def set_moving(arm, watcher, begin):
    """Begin a motion; again where late beats have ended it, for no other reason."""
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
    """What stops the arm does so soon, for good, and is given as the reason."""
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
        # A crowded machine lets beats come late as well, which stops the arm before.
        assert k < TRIES - 1, (took_s, given)


def test_the_page_is_the_dead_man_and_watchers_may_only_stop(guided):
    arm, server = guided
    page, watcher = RawPage(server), RawPage(server)
    wait_until(lambda: page.arm, "the arm's state")
    assert not page.arm["homed"]
    assert page.arm["why"] == "not armed"

    # Held but not armed, or armed by nobody who has the control: nothing moves.
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

    # Homing ends when it is let go, and is done when it is held to its end.
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

    # A hand that lets go; a page that falls silent; one that is killed; STOP from a watcher.
    def go():
        page.ask("arm", "follow")
        page.hold()

    assert_stops(arm, watcher, go, page.let_go, "not held")
    assert_stops(arm, watcher, go, page.fall_silent, "not armed: the page is silent")
    moves = len(arm.controller.moves)
    page.hold()  # armed anew it must be, after that
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
        # A container's root may not use Chromium's sandbox.
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield browser
        browser.close()


def until(page, condition):
    """Wait for what an expression gives; the page's own policy lets no string be evaluated."""
    wait_until(lambda: page.evaluate(f"() => Boolean({condition})"), condition)


def test_an_operator_holds_a_key_or_the_button_and_the_arm_moves_meanwhile(guided, browser):
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
        page.keyboard.up("m")  # where a crowded machine has let beats come late
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

    # A page is closed while its button is held down.
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
