"""Elements of the plane that both view and plan show: reference points, fix and robot."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from fingerpost.checks import finite_array
from fingerpost.pointing import Fix
from fingerpost.recording.picture.marks import RobotMarks, as_rows
from fingerpost.recording.picture.palette import BLOCK, INK, POINT, ROBOT, TRUTH
from fingerpost.recording.picture.shapes import outline
from fingerpost.recording.sheet import CASING, Points, Sheet


def draw_references(
    sheet: Sheet, plane_points: Points, project: Callable[[Points], Points]
) -> None:
    """Draw the outline around the reference points, and their numbers, which start at 1."""
    sheet.line(project(outline(plane_points)), INK, 1, cased=True)
    places = sheet.place(project(plane_points))
    if np.isnan(places).all():
        return
    middle, to_baseline = np.nanmean(places, axis=0), np.array([1.0, 6.0])
    for number, place in enumerate(places, start=1):
        outwards = place - middle
        label = place + 16.0 * outwards / max(math.hypot(*outwards), 1.0)
        sheet.dot(place, 3.0, INK)
        sheet.dot(label, 9.0, CASING)
        sheet.text(str(number), label + to_baseline, 14, INK, anchor=0.5)


def draw_fix(
    sheet: Sheet, fix: Fix, truth: ArrayLike | None, project: Callable[[Points], Points]
) -> None:
    """Draw the 95 % ellipse, the true point, and the indicated point."""
    ellipse = fix.ellipse(0.95)
    if ellipse is not None:
        outline = project(ellipse.polygon(72))
        sheet.area(outline, POINT, 0.4)
        sheet.line(np.concatenate([outline, outline[:1]]), POINT, 1)
    if truth is not None:
        sheet.cross(sheet.place(project(finite_array(truth, "truth", (2,)))), 8.0, TRUTH)
    if fix.point is not None:
        draw_point(sheet, sheet.place(project(fix.point)))


def draw_point(sheet: Sheet, place: Points) -> None:
    """Draw the indicated point."""
    sheet.dot(place, 5.5, CASING)
    sheet.dot(place, 4.5, INK)
    sheet.dot(place, 3.0, POINT)


def draw_robot(sheet: Sheet, robot: RobotMarks, project: Callable[[Points], Points]) -> None:
    """Draw the block, its destination, and the gripper's two jaws over it."""
    if robot.place is not None:
        place = sheet.place(project(finite_array(robot.place, "place", (2,))))
        turn = np.linspace(0.0, 2.0 * np.pi, 25)
        ring = place + 9.0 * np.column_stack([np.cos(turn), np.sin(turn)])
        sheet.on_pixels().line(ring, BLOCK, 2, dash=(5.0, 4.0))
    if robot.block is not None:
        block = project(as_rows(robot.block))
        sheet.area(block, BLOCK, 0.85)
    jaws = [project(jaw) for jaw in robot.jaws()]
    for jaw in jaws:
        sheet.line(jaw, ROBOT, 4, cased=True)
    sheet.line(np.array([jaw.mean(axis=0) for jaw in jaws]), ROBOT, 1)
