"""`fingerpost robot follow` and `fingerpost robot pick`: the arm goes where the hand points."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from fingerpost.cli.arming import (
    LONGEST_ABSENCE_S,
    arming_options,
    grouped,
    has_terminal,
    home,
    laid_over,
    need_consent,
    open_log,
    say,
    seconds,
    show_homing,
    stopping_signals,
)
from fingerpost.cli.endings import ending_orderly
from fingerpost.cli.live_views import give_up_option, hush_streams
from fingerpost.cli.outputs import keep_apart, rig_files
from fingerpost.cli.publishing import publish_option
from fingerpost.cli.recorder import record_options
from fingerpost.cli.session_outputs import SessionOutputs
from fingerpost.errors import CaptureError

if TYPE_CHECKING:
    from fingerpost.capture import Frame, Loss
    from fingerpost.config import RobotTable
    from fingerpost.guidance import Attendance, GuidedArm, Session
    from fingerpost.pointing import Fix
    from fingerpost.robot import FollowReport, PickPlaceOptions

MOST_FRAMES = 2**31 - 1
"""Largest number of frames to accept: years of them."""

_IN = click.Path(path_type=Path)
Command = TypeVar("Command", bound=Callable[..., Any])


following_options = grouped(
    [
        click.option("--url", help="The arm, if another than the rig's [robot] names."),
        click.option("--above", "above_m", type=float, help="Height over the plane, m."),
        click.option("--speed", "speed_m_s", type=float, help="Of the arm, m/s."),
        click.option("--stride", "stride_s", type=float, help="Time of one at that speed, s."),
        click.option(
            "--tolerance",
            "tolerance_m",
            type=float,
            default=0.02,
            show_default=True,
            help="Largest semi-axis of the 95 % ellipse to move on, m.",
        ),
        click.option(
            "--max-age",
            "max_fix_age_s",
            type=float,
            callback=seconds(LONGEST_ABSENCE_S),
            help="Of a fix to move on, s.",
        ),
        click.option("--min-cutoff", "min_cutoff_hz", type=float, help="Of the smoothing, Hz."),
        click.option(
            "--slope", "slope_hz_m", type=float, help="Of its cutoff with speed, Hz per m/s."
        ),
    ]
)
"""Adds the options of following to a command."""

carrying_options = grouped(
    [
        click.option("--dwell", "dwell_s", type=float, default=1.0, show_default=True, metavar="S"),
        click.option(
            "--radius", "radius_m", type=float, default=0.01, show_default=True, metavar="M"
        ),
        click.option("--travel", "travel_m", type=float, help="Height of the way, m."),
        click.option("--grip-height", "grip_m", type=float, help="Where the block is gripped, m."),
        click.option("--release-height", "release_m", type=float, help="Where it is let go, m."),
        click.option("--grip-width", "grip", type=float, help="Grip to a width, m, not closed."),
    ]
)
"""Adds the options of picking and placing to a command."""

_guiding_options = grouped(
    [
        click.argument("rig_file", metavar="RIG.TOML", type=_IN),
        following_options,
        click.option(
            "--attendance",
            type=click.Choice(["hand", "key"]),
            default="key",
            show_default=True,
            help="What shows the operator is there: a key held down, or his tracked hand.",
        ),
        click.option("--max-frames", metavar="N", type=click.IntRange(1, MOST_FRAMES)),
        give_up_option,
        publish_option,
        record_options,
        click.option("--json", "as_json", is_flag=True, help="Print JSON lines."),
        arming_options,
    ]
)


@click.command()
@_guiding_options
def follow(**given: Any) -> None:
    """Let the arm follow the pointing hand.

    RIG.TOML is one that `fingerpost robot plane` has written. The arm homes, goes to the middle of
    the safe region, then follows the hand that was held up to its template (or confirmed by the
    key h), within the region and only on fixes that are sure enough. It moves only while you hold
    the space bar down. On a terminal: x or Esc stops, c arms again, w held down has the arm make
    way for a hand that it hides, q quits.
    """
    _guide(given, None)


@click.command()
@_guiding_options
@click.option(
    "--select",
    type=click.Choice(["dwell", "key"]),
    default="dwell",
    show_default=True,
    help="How the hand chooses block and place: by staying there, or by the key s.",
)
@carrying_options
@click.option("--blocks", type=click.IntRange(min=1), default=1, show_default=True)
@click.option("--step", "step_by_step", is_flag=True, help="Wait for the key c before each step.")
def pick(**given: Any) -> None:
    """Pick blocks up and place them where the hand points.

    The arm follows the hand; point at a block and stay there once the arm is there (or press s),
    then at its new place. On a terminal: x or Esc stops at once, c arms again and continues, u
    undoes the last step, w held down has the arm make way for a hand that it hides, q quits. Views
    that end before the last block is placed make the command fail.
    """
    carry = carrying(given)
    if (given["select"] == "key" or given["step_by_step"]) and not has_terminal():
        raise click.UsageError("--select key and --step need a terminal as standard input")
    _guide(given, carry)


def carrying(given: Mapping[str, Any]) -> PickPlaceOptions:
    """Return the options of picking and placing from `carrying_options`."""
    from fingerpost.robot import PickPlaceOptions

    names = ("travel_m", "grip_m", "release_m", "grip", "speed_m_s")
    return laid_over(PickPlaceOptions, given, **{name: name for name in names})


def guided_arm(
    table: RobotTable, given: Mapping[str, Any], carry: PickPlaceOptions | None, *, dwells: bool
) -> GuidedArm:
    """Return the arm of a rig, configured by a command's options; nothing moves.

    Parameters
    ----------
    table
        The rig's [robot].
    given
        The command's options: `following_options`, `operator_timeout_s`, and `carrying_options` if
        the hand selects by dwelling.
    carry
        Options of picking and placing; None only follows.
    dwells
        Whether the hand selects by dwelling.
    """
    from fingerpost.guidance import GuidedArm, GuidingOptions
    from fingerpost.robot import DwellSelector, FollowOptions, GuardOptions, open_robot

    guard_options = laid_over(
        GuardOptions,
        given,
        tolerance_m="tolerance_m",
        max_fix_age_s="max_fix_age_s",
        operator_timeout_s="operator_timeout_s",
        max_speed_m_s="speed_m_s",
    )
    names = ("above_m", "speed_m_s", "stride_s", "min_cutoff_hz", "slope_hz_m")
    options = GuidingOptions(
        guard=guard_options,
        follow=laid_over(FollowOptions, given, **{name: name for name in names}),
        carry=carry,
        selector=(
            lambda guard: laid_over(
                partial(DwellSelector, guard), given, dwell_s="dwell_s", radius_m="radius_m"
            )
        )
        if dwells
        else None,
    )
    return GuidedArm(open_robot(given["url"] or table.url), table, options)


def _guide(given: Mapping[str, Any], carry: PickPlaceOptions | None) -> None:
    from fingerpost.capture import SourceKind, at_speed, open_views, read_views
    from fingerpost.config import Rig
    from fingerpost.guidance import (
        Attendance,
        Keys,
        attended_at_first,
        guided,
        robot_of,
    )
    from fingerpost.pipeline import Pointer, at_most, steps

    rig = Rig.load(given["rig_file"])
    written = {"--log": given["log"], "--record": given["record"]}
    keep_apart(written, rig_files(given["rig_file"], rig))
    table = robot_of(rig)
    attendance = Attendance(given["attendance"])
    has_keys = has_terminal()
    if attendance is Attendance.KEY and not has_keys:
        raise click.UsageError(
            "--attendance key needs a terminal as standard input; without one, --attendance hand "
            "takes your tracked hand for it"
        )
    if not has_keys and all(view.start is None for view in rig.views):
        raise click.UsageError(
            "no view has a [view.start] to hold the hand up to, and without a terminal as standard "
            "input no key can confirm it"
        )
    # An invalid region, and options that do not fit it, are refused first.
    arm = guided_arm(table, given, carry, dwells=given.get("select") == "dwell")
    pointer = Pointer(rig, moving=arm.guard.body)
    need_consent(given["arm"], "robot follow" if carry is None else "robot pick")
    with ExitStack() as stack:
        outputs = SessionOutputs(
            publish=given["publish"],
            record=given["record"],
            images=given["images"],
            log=open_log(stack, given["log"]),
        )
        stack.enter_context(ending_orderly())
        hush_streams(rig.sources)
        sources = stack.enter_context(open_views(rig.sources, rig.readings))
        # Recordings are played as if live, with times of the machine's clock.
        stack.enter_context(outputs.opened(rig, sources, is_live=True, arm=arm))
        give_up_after_s = given["give_up_after_s"]
        frames: Iterator[Sequence[Frame | Loss | None]]
        frames = read_views(sources, give_up_after_s=give_up_after_s)
        timeout_s = given["homing_timeout"]
        connected = arm.connected(
            on_record=outputs.on_record,
            home=lambda robot: home(robot, timeout_s),
            signals=stopping_signals(),
        )
        with connected:
            session = _session(arm, attendance, given)
            if has_keys:
                stack.enter_context(Keys(session.press, session.leave))
            if sources[0].kind is SourceKind.RECORDED:
                frames = at_speed(frames, stamped=True)
            frames = outputs.watch(at_most(frames, given["max_frames"]))
            taken = steps(pointer, frames)
            if attendance is Attendance.HAND:
                taken = attended_at_first(arm.guard, taken)
            try:
                with session:
                    session.begin()
                    for step in guided(session, taken):
                        outputs.take(step)
            finally:
                _report(session, as_json=given["as_json"])
                for note in outputs.notes():
                    say(note)
    if carry is not None and not session.done:
        blocks = f"{session.report.blocks} of {given['blocks']} blocks"
        raise CaptureError(f"the views ended with {blocks} picked and placed")


def _session(arm: GuidedArm, attendance: Attendance, given: Mapping[str, Any]) -> Session:
    def home_again() -> None:
        arm.robot.home(show_homing, timeout_s=given["homing_timeout"])

    return arm.session(
        attendance=attendance,
        step_by_step=given.get("step_by_step", False),
        blocks=given.get("blocks", 1),
        keys=has_terminal(),
        home=home_again if has_terminal() else None,
        say=say,
        on_report=_print_report if given["as_json"] else lambda _fix, _report: None,
    )


def _print_report(fix: Fix, report: FollowReport) -> None:
    goal = report.goal
    line = {
        "time_s": fix.time_s,
        "status": fix.status.value,
        "state": report.state.value,
        "reason": report.reason,
        "target": None if report.target is None else report.target.tolist(),
        "lag_s": report.lag_s,
        "goal_m": None if goal is None else goal.position_m.tolist(),
    }
    click.echo(json.dumps(line))


def _report(session: Session, *, as_json: bool) -> None:
    report = session.report
    click.echo(json.dumps(report.as_dict()) if as_json else "\n".join(report.lines()))
