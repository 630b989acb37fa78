"""`fingerpost demo`: the main job with nothing plugged in."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click
from click.core import ParameterSource

from fingerpost.cli.endings import ending_as_interrupted
from fingerpost.cli.progress import reporting, watched
from fingerpost.installation import need_opencv
from fingerpost.signals import ending_at_once

if TYPE_CHECKING:
    from fingerpost.closed_loop import RobotDemoSummary
    from fingerpost.demo import DemoSummary


@click.command()
@click.option(
    "--output",
    metavar="DIR",
    type=click.Path(path_type=Path),
    default=Path("out"),
    show_default=True,
    help="Where tables, picture and video go.",
)
@click.option("--simulate", is_flag=True, help="Play the simulated rig instead of the clip.")
@click.option("--robot", is_flag=True, help="Have a robot go there, in a simulated world.")
@click.option("--live", is_flag=True, help="Show the clip in a browser; nothing is written.")
@click.option(
    "--seed",
    type=click.IntRange(min=0),
    default=0,
    show_default=True,
    help="Of the simulation, with --simulate or --robot.",
)
@click.option("--max-frames", metavar="N", type=click.IntRange(min=1), help="Stop after N frames.")
@click.option("--json", "as_json", is_flag=True, help="Print the summary as JSON.")
@click.pass_context
def demo(
    context: click.Context,
    output: Path,
    simulate: bool,
    robot: bool,
    live: bool,
    seed: int,
    max_frames: int | None,
    as_json: bool,
) -> None:
    """Play the built-in clip: fixes, a summary, a picture and a video, nothing plugged in.

    With --robot, an operator points at a block and at a place, corrects by what he sees the robot
    do, and the robot carries the block there: under physics if fingerpost[mujoco] is installed.
    Exits with 1 if it does not get there.

    With --live, the address that is printed shows the clip on the page of `fingerpost live`. With
    --live --robot it shows the simulated robot cell: a hand that points by itself, and an arm that
    you arm there, and that moves while you hold.
    """
    if live:
        _refuse_others(context)
        _show_cell(seed) if robot else _show_clip()
        return
    if not (simulate or robot) and _is_given(context, "seed"):
        raise click.UsageError("the clip has no --seed; --simulate and --robot have one")
    summary: DemoSummary | RobotDemoSummary
    failed = False
    if robot:
        if simulate:
            raise click.UsageError("--robot and --simulate do not go together")
        with ending_at_once():
            from fingerpost.closed_loop import run_robot_demo

        with reporting() as report:
            summary = run_robot_demo(output, seed=seed, max_frames=max_frames, report=report)
        failed = bool(summary.problem)
    else:
        with ending_at_once():
            need_opencv()
            from fingerpost.demo import run_demo

        summary = run_demo(
            output,
            simulate=simulate,
            seed=seed,
            max_frames=max_frames,
            watch=lambda frames, count: watched(frames, count, "tracking"),
        )
    click.echo(json.dumps(summary.as_dict()) if as_json else "\n".join(summary.lines()))
    if failed:
        sys.exit(1)


def _is_given(context: click.Context, name: str) -> bool:
    return context.get_parameter_source(name) is ParameterSource.COMMANDLINE


def _refuse_others(context: click.Context) -> None:
    """Refuse options that have no effect with --live."""
    allowed = {"live", "robot", "seed"} if context.params["robot"] else {"live"}
    for parameter in context.command.get_params(context):
        name = parameter.name or ""
        if _is_given(context, name) and name not in allowed:
            raise click.UsageError(f"--live and {parameter.opts[-1]} do not go together")


def _show_clip() -> None:
    with ending_at_once():
        need_opencv()
        from fingerpost.demo import clip_rig
        from fingerpost.live import Page, operate

    with ending_as_interrupted(), Page("127.0.0.1", 0) as page:
        click.echo(page.address)
        operate(page, clip_rig(), "the built-in clip")
        page.wait()


def _show_cell(seed: int) -> None:
    with ending_at_once():
        need_opencv()
        from fingerpost.live import Page
        from fingerpost.live.cell import operate_cell

    with ending_as_interrupted(), Page("127.0.0.1", 0) as page:
        click.echo(page.address)
        with reporting() as report:
            operate_cell(page, seed=seed, report=report)
