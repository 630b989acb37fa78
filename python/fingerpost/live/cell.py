"""The simulated robot cell on the operator's page: the complete system, without hardware.

The hand is simulated. It points at the block and, once that is selected, at its new place, and
corrects its aim by the motion of the arm. The page decides whether the arm moves, and what it does.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from fingerpost.closed_loop.demo import PLANE_M, WAITING_MM, Stage, staged
from fingerpost.closed_loop.layout import Aim
from fingerpost.closed_loop.loop import ClosedLoop, Moment
from fingerpost.closed_loop.operator import Habits, Operator
from fingerpost.closed_loop.physics import BLOCK_MM
from fingerpost.closed_loop.setup import with_start
from fingerpost.closed_loop.task import block_and_place_mm
from fingerpost.live.commands import RobotCommand
from fingerpost.live.desk import Desk
from fingerpost.live.page import Page
from fingerpost.live.scene import RigScene
from fingerpost.simulate import Hand

_FOREVER_S = 1e9
_LATE_S = 0.5  # behind the wall clock, after which the world no longer catches up

Array = NDArray[np.float64]


def operate_cell(
    page: Page, *, seed: int = 0, report: Callable[[str], None] = lambda _: None
) -> None:
    """Show the simulated cell on the page, which guides its arm, until the page is closed.

    Parameters
    ----------
    page
        The page.
    seed
        Seed of all random numbers, ≥ 0.
    report
        Called with messages on the progress until the page has something to show.

    Raises
    ------
    RobotError
        An error of the simulated arm.
    FingerpostError
        The page's process has ended.
    """
    rng = np.random.default_rng(seed)
    block_mm, place_mm = block_and_place_mm(rng)
    with staged(rng, block_mm, report) as (stage, note):
        visitor = Visitor(page, stage, place_mm, rng)
        scene = RigScene.of(
            stage.name,
            "m",
            visitor.loop.plane_views,
            stage.rig.sources,
            is_live=True,
            frames=None,
        )
        page.open_rig(scene)
        if note:
            page.note(note)
        with visitor.desk.opened(visitor.loop.session), page.guiding(visitor.asked.append):
            visitor.loop.run(visitor, _FOREVER_S)


class Visitor:
    """The operator of the cell: a simulated hand, with the keys of the page.

    Parameters
    ----------
    page, stage
        The page, and the cell.
    place_mm
        (2,) First destination of the block; then back, and so on.
    rng
        Random numbers of the hand.
    """

    done = False
    hand_is_away = False
    doing = ""

    def __init__(self, page: Page, stage: Stage, place_mm: Array, rng: np.random.Generator) -> None:
        self.asked: deque[RobotCommand] = deque()
        waiting = Aim(WAITING_MM, plane_mm=1000 * PLANE_M)
        rig = with_start(stage.rig, stage.cell.cameras, Hand().body, waiting.pose(), rng)
        self._page, self._stage, self._place_mm = page, stage, place_mm
        self._origin_mm: Array = stage.cell.block_mm[:2].copy()
        self._operator = Operator(Habits(), WAITING_MM, rng, time_s=stage.world.time_s)
        self.loop = ClosedLoop(
            stage.world,
            stage.robot,
            rig,
            self._operator,
            stage.options,
            aim=waiting,
            on_moment=self._show,
            stands_by=True,
        )
        self.desk = Desk(self.loop.guard, stage.robot, carries=True, clock=stage.world.now)
        self._aim: tuple[int, int] | None = None
        self._begun_s = time.monotonic() - stage.world.time_s

    def act(self, time_s: float) -> None:
        """Wait for the wall clock, execute the page's commands, and move the hand."""
        early_s = self._begun_s + time_s - time.monotonic()
        if early_s > 0.0:
            time.sleep(early_s)
        elif early_s < -_LATE_S:
            self._begun_s -= early_s
        while self.asked:
            self.desk.obey(self.asked.popleft())
        self.desk.keep(self.loop.said)
        self.desk.tick(self._page.show_arm)
        self._point(time_s)

    def _point(self, time_s: float) -> None:
        """Point at the block, or at its place, while the arm follows."""
        session = self.loop.session
        if not self.loop.guard.armed or not session.has_hand or session.is_carrying:
            return
        aim = session.report.blocks, session.selections % 2
        if aim == self._aim:
            return
        if self._aim is not None and aim[0] != self._aim[0]:  # the block is placed: move it back
            self._place_mm = self._origin_mm
        if aim[1] == 0:
            self._origin_mm = self._stage.cell.block_mm[:2].copy()
        self._aim = aim
        self._operator.mean(self._origin_mm if aim[1] == 0 else self._place_mm, time_s)
        self._operator.corrects = True

    def _show(self, moment: Moment) -> None:
        turn = self._stage.cell.block_turn_rad
        half = BLOCK_MM / 2000
        square = half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        block = moment.block_m[:2] + square @ R.T
        self.desk.add_marks(
            {"block": block.round(4).tolist(), "place": (self._place_mm / 1000).round(4).tolist()}
        )
        self._page.show(moment.step, begun_s=time.monotonic())
