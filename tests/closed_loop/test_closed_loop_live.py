"""The simulated cell on the operator's page: the page's beats permit motion, in simulated time."""

import sys
from contextlib import contextmanager

import pytest

from fingerpost.errors import FingerpostError
from fingerpost.live.cell import operate_cell
from fingerpost.live.commands import Ask, Beat, Wish

FRAMES_PER_S = 15
HELD = range(3, 75)
STOPPED_S = 0.5


class ScriptedPage:
    """Receives the page's data and sends the commands of an operator."""

    def __init__(self):
        self.frames, self.states, self.notes = 0, [], []

    def open_rig(self, scene):
        self.scene = scene

    def note(self, words):
        self.notes.append(words)

    @contextmanager
    def guiding(self, guide):
        self.guide = guide
        yield

    def show_arm(self, state):
        self.states.append((self.frames, state))

    def show(self, _step, *, begun_s):
        assert begun_s > 0.0
        self.frames += 1
        if self.frames == 1:
            self.guide(Ask(what=Wish.FOLLOW))
            self.guide(Ask(what=Wish.ARM))
        if self.frames in HELD:
            self.guide(Beat())
        if self.frames == HELD.stop + 15:
            raise FingerpostError("closed")


def test_the_arm_of_the_cell_moves_while_the_page_sends_beats(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    page = ScriptedPage()
    with pytest.raises(FingerpostError, match="closed"):
        operate_cell(page)
    assert page.scene.is_live
    assert "no physics" in page.notes[0]
    moved = [frame for frame, state in page.states if state["moves"]]
    assert moved[0] >= HELD.start
    assert moved[-1] <= HELD.stop + STOPPED_S * FRAMES_PER_S
    held = [state for frame, state in page.states if frame in HELD]
    assert any(state["said"] == "following this hand" for state in held)
    poses = {tuple(state["pose_mm"]) for state in held if state["pose_mm"]}
    assert len(poses) > 2
    assert len(page.states[-1][1]["block"]) == 4
    assert page.states[-1][1]["why"] == "not armed: the page is silent"
