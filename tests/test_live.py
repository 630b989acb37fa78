"""The operator's page without a browser: headline, scene, player, reel, control, main loop."""

import asyncio
import contextlib
import dataclasses
import itertools
import json
import math
import os
import signal
import sys
import threading
import time

import msgspec
import numpy as np
import pytest
from live_server import RIG, pictures_in, scene_in
from patience import wait_until
from websockets.sync.client import connect

from fingerpost.capture import Loss, open_views, read_views
from fingerpost.cli.session_outputs import SessionOutputs
from fingerpost.config import Rig
from fingerpost.errors import FingerpostError, MissingExtraError
from fingerpost.live import commands
from fingerpost.live.composer import Composer
from fingerpost.live.hub import Hub
from fingerpost.live.moment import LARGEST_PX, Moment, encoded
from fingerpost.live.operate import operate
from fingerpost.live.page import Page
from fingerpost.live.player import Player
from fingerpost.live.reel import Message, Reel, Strip
from fingerpost.live.scene import RigScene, scene_of
from fingerpost.live.words import headline
from fingerpost.pipeline import Pointer
from fingerpost.targets import Target, Targets

# --- headline and scene ----------------------------------------------------------------------

FRAMES = 40


@pytest.fixture(scope="module")
def run():
    """The clip's first frames: its steps, the pointer after them, and the rig."""
    rig = Rig.load(RIG)
    pointer = Pointer(rig)
    steps = []
    with open_views(rig.sources) as sources:
        for k, frames in enumerate(read_views(sources)):
            if k == FRAMES:
                break
            steps += pointer.update(frames)
    return rig, pointer, steps


def rig_scene(run, *, is_live=False, frames=None, **fields):
    rig, pointer, _ = run
    fields.update(is_live=is_live, frames=frames)
    return RigScene.of("clip", "mm", pointer.plane_views, rig.sources, **fields)


def moment(run, k=FRAMES - 1):
    return Moment.of(run[2][k], k, 1.0, 1.004)


def shown(run, k=FRAMES - 1, trail=()):
    return scene_of(moment(run, k), rig_scene(run), trail)


def test_the_headline_of_a_point_is_its_numbers(run):
    fix = run[2][-1].fix
    summary = headline(moment(run), 1)
    sigma = np.sqrt(np.diag(fix.covariance))
    assert summary.status == "ok"
    assert summary.said == ""
    assert [float(n) for n in summary.point] == pytest.approx([*fix.point, *sigma], abs=0.05)
    assert f"{math.degrees(fix.crossing_angle_rad):.0f}°" in summary.detail


def test_the_headline_without_a_point_says_which_view_and_why(run):
    summary = headline(moment(run, 0), 1)
    assert summary.point is None
    assert summary.status == "acquiring"
    assert "left" in summary.said
    assert summary.detail


def test_a_lost_picture_is_reported_for_its_view_only(run):
    rig = run[0]
    pointer = Pointer(rig)
    with open_views(rig.sources) as sources:
        frames = list(read_views(sources))[: FRAMES + 1]
    for together in frames[:-1]:
        list(pointer.update(together))
    lost = Loss(frames[-1][0].index, frames[-1][0].time_s, "its picture is damaged")
    (step,) = pointer.update([lost, frames[-1][1]])
    summary = headline(Moment.of(step, 0, 0.0, 0.0), 1)
    assert summary.said == "left has no picture"
    assert summary.detail == "its picture is damaged"
    scene = scene_of(Moment.of(step, 0, 0.0, 0.0), rig_scene(run), ())
    assert scene["pictures"][0] == 0
    assert "contour" not in scene["views"][0]
    assert scene["views"][1]["contour"]


def test_targets_are_on_the_plan_with_the_probability_of_each(run):
    rig, pointer, steps = run
    fix = steps[-1].fix
    targets = [
        Target("cup", fix.point[None], 20.0),
        Target("home", [[390, 390], [400, 390], [400, 400]], rest=True),
    ]
    answers = Targets(targets).probabilities(fix.point, fix.covariance)
    step = dataclasses.replace(steps[-1], fix=dataclasses.replace(fix, targets=answers))
    scene = RigScene.of(
        "clip", "mm", pointer.plane_views, rig.sources, targets=targets, is_live=False, frames=None
    )
    listed = scene.as_dict()["targets"]
    assert [target["name"] for target in listed] == ["cup", "home"]
    assert listed[0]["corners"] == [fix.point.tolist()]
    assert [(target["radius"], target["rest"]) for target in listed] == [(20.0, False), (0.0, True)]
    plan = scene_of(Moment.of(step, 0, 0.0, 0.0), scene, ())["plan"]
    assert plan["targets"] == pytest.approx([answers["cup"], answers["home"]], abs=1e-3)
    assert "targets" not in shown(run, 0)["plan"]  # no point yet


def test_point_and_ellipse_are_projected_back_where_the_plane_view_shows_them(run):
    step = run[2][-1]
    scene = shown(run)
    ellipse = step.fix.ellipse(0.95)
    for seen, view in zip(scene["views"], step.observations, strict=True):
        assert seen["point"] == pytest.approx(view.plane_view.project(step.fix.point), abs=0.06)
        ring = np.reshape(seen["ellipse"], (-1, 2))
        back = view.plane_view.back_project(ring)
        assert ellipse.contains(ellipse.centre + 0.98 * (back - ellipse.centre)).all()
        assert not ellipse.contains(ellipse.centre + 1.02 * (back - ellipse.centre)).any()


def test_finger_lines_and_references_are_drawn_where_they_were_seen(run):
    step = run[2][-1]
    rig = run[0]
    scene = shown(run)
    for k, (seen, view) in enumerate(zip(scene["views"], step.observations, strict=True)):
        finger = view.finger
        points = np.reshape(seen["finger"], (-1, 2))
        normal = np.array([-math.sin(finger.angle_rad), math.cos(finger.angle_rad)])
        assert np.abs((points - finger.anchor_px) @ normal).max() < 0.1
        assert seen["references"] == pytest.approx(
            [pytest.approx(p, abs=1.0) for p in rig.views[k].reference_points_px]
        )
        assert np.concatenate([np.reshape(p, (-1, 2)) for p in seen["contour"]]) == pytest.approx(
            view.contour_px, abs=0.06
        )


def test_constraint_lines_on_the_plan_are_those_of_the_fix(run):
    step = run[2][-1]
    for drawn, line in zip(shown(run)["plan"]["lines"], step.fix.constraint_lines, strict=True):
        ends = np.reshape(drawn["ends"], (2, 2))
        assert np.abs(np.column_stack([ends, [1, 1]]) @ line.line).max() < 0.01
        band = np.reshape(drawn["band"], (-1, 2))
        half = len(band) // 2
        middle = (band[:half] + band[half:][::-1]) / 2
        assert np.abs(np.column_stack([middle, np.ones(half)]) @ line.line).max() < 0.01


def test_a_frame_without_a_point_has_no_point_and_no_ellipse(run):
    scene = shown(run, 0)
    assert "point" not in scene["plan"]
    assert "ellipse" not in scene["views"][0]
    json.dumps(scene, allow_nan=False)


def test_a_message_carries_the_pictures_under_its_drawings(run):
    import cv2

    message = Composer(rig_scene(run)).message(moment(run))
    for data, view in zip(pictures_in(message.data), run[2][-1].observations, strict=True):
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        away = image.astype(int) - view.frame.image
        assert np.abs(away).mean() < 4.0  # JPEG of quality 80
    assert scene_in(message.data)["frame"] == run[2][-1].index


def test_the_trail_holds_the_points_before_and_no_more(run):
    composer = Composer(rig_scene(run))
    messages = [composer.message(moment(run, k)) for k in range(FRAMES)]
    before = [step.fix.point for step in run[2][:-1] if step.fix.point is not None]
    trail = np.reshape(scene_in(messages[-1].data)["plan"]["trail"], (-1, 2))
    assert trail == pytest.approx(np.array(before), abs=1e-3)


def test_large_pictures_are_reduced_and_small_ones_are_not():
    import cv2

    def size(shape):
        data = encoded(np.zeros(shape, np.uint8))
        return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED).shape[:2]

    assert size((480, 640, 3)) == (480, 640)
    assert size((2000, 2 * LARGEST_PX)) == (1000, LARGEST_PX)
    assert size((1, 30000)) == (1, LARGEST_PX)


def test_codes_are_letters_for_the_fix_and_each_view_and_a_digit_for_the_ellipse(run):
    composer = Composer(rig_scene(run))
    assert composer.message(moment(run, 0)).codes[0] == "a"
    codes = composer.message(moment(run)).codes
    assert codes[:3] == "ooo"
    assert codes[3].isdigit()


# --- recordings ------------------------------------------------------------------------------


class Clock:
    """A clock that only the timeouts of `asyncio.wait_for` advance."""

    def __init__(self, monkeypatch):
        self.now_s = 100.0

        async def wait_for(waiting, timeout):
            task = asyncio.ensure_future(waiting)
            await asyncio.sleep(0)
            if not task.done():
                task.cancel()
                self.now_s += timeout
                raise TimeoutError
            return task.result()

        monkeypatch.setattr("fingerpost.live.player.asyncio.wait_for", wait_for)

    def __call__(self):
        return self.now_s


def message(number, interval_s=0.04):
    data = f"moment {number}".encode()
    return Message(number, number * interval_s, 0.0, "ooo", data)


class Recording:
    """A player, a main loop that makes the moments it asks for, and the moments shown."""

    def __init__(self, monkeypatch, frames=50, announced=50):
        self.clock = Clock(monkeypatch)
        self.frames, self.made, self.allowed = frames, 0, 0
        self.shown = []
        self.loop = asyncio.new_event_loop()
        self.player = Player(self.ask, self.show, announced, self.clock)

    def ask(self, steps):
        self.allowed = max(self.allowed, steps)

    def show(self, number, data):
        assert data == f"moment {number}".encode()
        self.shown.append((number, self.clock.now_s))

    def run(self, turns, script=()):
        """Run the player and the main loop for `turns` iterations of the event loop."""
        script = dict(script)

        async def together():
            task = asyncio.create_task(self.player.run())
            await asyncio.sleep(0)
            for turn in range(turns):
                if turn in script:
                    script[turn]()
                while self.made < min(self.allowed, self.frames):
                    self.player.arrived(message(self.made))
                    self.made += 1
                if self.made == self.frames and not self.player.has_ended:
                    self.player.end()
                await asyncio.sleep(0)
            task.cancel()

        self.loop.run_until_complete(together())

    @property
    def numbers(self):
        return [number for number, _ in self.shown]


@pytest.fixture
def recorded(monkeypatch):
    made = []

    def make(**given):
        made.append(Recording(monkeypatch, **given))
        return made[-1]

    yield make
    for recording in made:
        recording.player.reel.close()
        recording.loop.close()


def test_a_recording_is_played_at_its_own_pace_to_its_end(recorded):
    recording = recorded()
    recording.run(2000)
    assert recording.numbers == list(range(50))
    times_s = np.array([when for _, when in recording.shown])
    assert np.diff(times_s) == pytest.approx(np.full(49, 0.04), abs=1e-9)
    assert not recording.player.is_playing


def test_frames_are_tracked_shortly_before_they_are_shown(recorded):
    recording = recorded()
    recording.run(60, {20: lambda: recording.player.stop()})
    assert recording.made <= recording.player.shown + 5


def test_a_stopped_player_shows_nothing_and_resumes_where_it_stopped(recorded):
    recording = recorded()
    recording.run(30, {10: lambda: recording.player.stop()})
    stood = list(recording.numbers)
    recording.run(30)
    assert recording.numbers == stood
    recording.run(2000, {0: recording.player.play})
    assert recording.numbers == list(range(50))


def test_steps_back_and_forward_do_not_track_again(recorded):
    recording = recorded()
    recording.run(40, {12: lambda: recording.player.step(-2)})
    at, made = recording.player.shown, recording.made
    assert recording.numbers[-2] - at == 2
    recording.run(10, {0: lambda: recording.player.step(1)})
    assert recording.player.shown == at + 1
    assert recording.made == made


def test_a_jump_ahead_tracks_up_to_its_frame_and_shows_it(recorded):
    recording = recorded()
    recording.player.stop()
    recording.run(20, {0: lambda: recording.player.go_to(33)})
    assert recording.player.shown == 33
    assert recording.made == 34


@pytest.mark.parametrize(("number", "shown"), [(-5, 0), (10**9, 49)])
def test_jumps_are_clamped_to_the_recording(recorded, number, shown):
    recording = recorded()
    recording.player.stop()
    recording.run(60, {0: lambda: recording.player.go_to(number)})
    assert recording.player.shown == shown


def test_a_recording_shorter_than_announced_ends_at_its_last_frame(recorded):
    recording = recorded(frames=20, announced=50)
    recording.player.stop()
    recording.run(60, {0: lambda: recording.player.go_to(45)})
    assert recording.player.shown == 19
    assert recording.player.total == 20


def test_play_at_the_end_starts_from_the_first_frame(recorded):
    recording = recorded(frames=5, announced=5)
    recording.run(300)
    recording.run(300, {0: recording.player.play})
    assert recording.numbers == [*range(5), *range(5)]


def test_a_reel_returns_the_messages_it_stores():
    reel = Reel()
    for k in range(100):
        reel.append(message(k))
    assert len(reel) == 100
    assert [reel.data(k) for k in (99, 0, 50)] == [b"moment 99", b"moment 0", b"moment 50"]
    assert reel.time_s(50) == pytest.approx(2.0)
    reel.close()


def test_a_strip_keeps_the_newest_codes_and_returns_those_since_a_number():
    strip = Strip(longest=10)
    for k in range(100):
        strip.append("ol" if k % 2 else "ao")
    assert strip.end == 100
    assert strip.since(97) == {"from": 97, "rows": ["oao", "lol"]}
    assert strip.since(0) == {"from": 90, "rows": ["ao" * 5, "ol" * 5]}
    assert len(strip.codes) < 20


# --- control ---------------------------------------------------------------------------------


class Watcher:
    def __init__(self):
        self.offered = []

    def offer(self, data, _begun_s):
        self.offered.append(data)

    def send_state(self):
        pass


def live_hub(run):
    asked = []
    hub = Hub(asked.append, clock=lambda: 0.0)
    hub.open_rig(rig_scene(run, is_live=True))
    return hub, asked


@pytest.mark.parametrize("awaits_page", [False, True])
def test_a_recording_of_the_page_alone_begins_with_the_first_page(run, awaits_page):
    async def asked_before_and_after():
        asked = []
        hub = Hub(asked.append)
        hub.open_rig(rig_scene(run, frames=50, awaits_page=awaits_page))
        await asyncio.sleep(0.01)
        before = len(asked)
        hub.add(Watcher())
        await asyncio.sleep(0.01)
        hub.close_rig()
        return before, len(asked)

    before, after = asyncio.run(asked_before_and_after())
    assert (before == 0) == awaits_page
    assert after > 0


class UnopenedPage:
    """A page that lets no frame pass."""

    def open_rig(self, scene):
        self.scene = scene

    def allowed(self, _frames):
        return iter(())

    def end(self, words):
        pass


@pytest.mark.parametrize("is_published", [False, True])
def test_a_recording_awaits_a_page_unless_it_is_published(is_published):
    publish = ["ndjson:"] if is_published else []
    page = UnopenedPage()
    outputs = SessionOutputs(publish=publish, record=None, images=None)
    operate(page, Rig.load(RIG), "clip", outputs=outputs)
    assert page.scene.awaits_page != is_published


def test_any_page_can_stop_but_only_one_has_control(run):
    hub, asked = live_hub(run)
    first, second = Watcher(), Watcher()
    hub.add(first)
    hub.add(second)
    assert hub.obey(commands.Play(), first) == ""
    assert "control" in hub.obey(commands.Play(), second)
    assert hub.obey(commands.Stop(), second) == ""
    assert asked == [math.inf, math.inf, 0.0]
    assert not hub.state(second, (None, 0))["playing"]
    assert "control" in hub.obey(commands.Play(), second)
    assert hub.obey(commands.Take(), second) == ""
    assert hub.obey(commands.Play(), second) == ""
    assert hub.state(second, (None, 0))["controls"]
    assert not hub.state(first, (None, 0))["controls"]


def test_control_is_released_when_its_page_closes(run):
    hub, _ = live_hub(run)
    first, second = Watcher(), Watcher()
    hub.add(first)
    hub.obey(commands.Play(), first)
    hub.add(second)
    hub.remove(first)
    assert hub.obey(commands.Play(), second) == ""


def test_a_page_that_opens_later_gets_the_newest_moment_at_once(run):
    hub, _ = live_hub(run)
    hub.arrived(message(7))
    late = Watcher()
    hub.add(late)
    assert late.offered == [b"moment 7"]


def test_the_rig_is_sent_once_and_the_strip_as_it_grows(run):
    hub, _ = live_hub(run)
    watcher = Watcher()
    hub.add(watcher)
    hub.arrived(message(0))
    state = hub.state(watcher, (None, 0))
    assert state["rig"]["views"] == ["left", "right"]
    assert state["strip"] == {"from": 0, "rows": ["o", "o", "o"]}
    hub.arrived(message(1))
    state = hub.state(watcher, (hub.strip, 1))
    assert "rig" not in state
    assert state["strip"] == {"from": 1, "rows": ["o", "o", "o"]}


@pytest.mark.parametrize(
    "text",
    ['{"do":', "[]", "null", '{"do":"rm"}', '{"do":"seek"}', '{"do":"seek","number":1.5}',
     '{"do":"seek","number":"1"}', '{"do":"stop","now":true}', '{"do":"step","by":1e99}'],
)  # fmt: skip
def test_invalid_commands_are_refused(text):
    with pytest.raises(msgspec.MsgspecError):
        commands.decode(text)


# --- the process of the page -----------------------------------------------------------------


@pytest.fixture
def page():
    with Page("127.0.0.1", 0) as page:
        yield page


def test_with_live_cameras_the_loop_never_waits_for_the_page(run, page):
    *_, steps = run
    page.open_rig(rig_scene(run, is_live=True))
    os.kill(page._process.pid, signal.SIGSTOP)
    try:
        for _ in range(50):
            for step in steps:
                page.show(step)
        assert page._unanswered <= 2
    finally:
        os.kill(page._process.pid, signal.SIGCONT)


def test_while_stopped_no_frame_of_a_camera_is_processed(run, page):
    base, token = page.address.split("/?token=")
    cookie = {"Cookie": f"fingerpost-{base.rpartition(':')[2]}={token}"}
    processed = []

    def process_frames():
        with contextlib.suppress(FingerpostError):
            for frame in page.allowed(itertools.count()):
                processed.append(frame)
                time.sleep(0.001)

    thread = threading.Thread(target=process_frames)
    url = f"{base.replace('http', 'ws')}/socket"
    with connect(url, additional_headers=cookie, origin=base, close_timeout=0.2) as socket:
        page.open_rig(rig_scene(run, is_live=True))
        thread.start()
        wait_until(lambda: len(processed) > 5)
        socket.send('{"do":"stop"}')
        wait_until(lambda: page._allowed == 0.0)
        time.sleep(0.01)
        stood = len(processed)
        time.sleep(0.05)
        assert len(processed) == stood
        socket.send('{"do":"play"}')
        wait_until(lambda: len(processed) > stood + 5)
    page.close()
    thread.join()


def test_a_page_whose_process_is_gone_ends_the_loop_in_one_line(run, page):
    page.open_rig(rig_scene(run))
    page._process.kill()
    with pytest.raises(FingerpostError, match="page's process has ended"):
        list(page.allowed(iter([()])))


def test_a_port_that_is_taken_is_refused_in_one_line(page):
    port = int(page.address.rpartition(":")[2].partition("/")[0])
    with pytest.raises(ValueError, match=f"127.0.0.1:{port}: .*another --port is right"):
        Page("127.0.0.1", port)


def test_without_the_extra_one_line_names_the_command(monkeypatch):
    monkeypatch.setitem(sys.modules, "uvicorn", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'fingerpost\[page\]'"):
        Page("127.0.0.1", 0)
