"""`fingerpost experiment`: accuracy, and coverage of the reported uncertainty."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fingerpost.cli.endings import ending_as_interrupted
from fingerpost.cli.outputs import keep_apart, rig_files
from fingerpost.cli.progress import counting
from fingerpost.installation import need_opencv
from fingerpost.signals import ending_at_once

if TYPE_CHECKING:
    from fingerpost.experiment import ExperimentOptions, ExperimentResult

_IN = click.Path(path_type=Path)


@click.command()
@click.option(
    "--tracker",
    type=click.Choice(["ribbon", "paper"]),
    default="ribbon",
    show_default=True,
    help="The hand's model: bands of their own width, or the planar template of 1994.",
)
@click.option("--targets", type=int, default=400, show_default=True, help="Indicated points.")
@click.option("--seed", type=int, default=0, show_default=True, help="Of everything random.")
@click.option("--device", type=click.Choice(["rod", "hand"]), default="rod", show_default=True)
@click.option("--noise", type=float, help="Image noise, sigma in grey levels.")
@click.option("--contrast", type=float, help="Device minus background, grey levels.")
@click.option("--blur", type=float, help="Sigma of the point spread function, px.")
@click.option("--size", type=(int, int), metavar="W H", help="Resolution, px.")
@click.option("--reference-noise", type=float, help="Sigma of the reference points, px.")
@click.option("--hover", type=(float, float), metavar="MIN MAX", help="Height of the tip, mm.")
@click.option("--slant", type=(float, float), metavar="MIN MAX", help="Below the horizontal, deg.")
@click.option("--azimuth", type=(float, float), metavar="MIN MAX", help="0: to the cameras, deg.")
@click.option("--taper", type=float, help="How much thinner the tip is than the base, 0 to 0.6.")
@click.option("--side-light", type=float, help="Flank against flank, part of the contrast.")
@click.option("--limb-darkening", type=float, help="Loss at the outline, part of the contrast.")
@click.option("--clutter", type=float, help="± grey levels of shapes behind the device.")
@click.option("--background-frames", type=int, help="Pictures of the table alone that come first.")
@click.option(
    "--approach-frames",
    metavar="N",
    type=int,
    help="Start at another pose, N pictures away, as who holds a hand up first.",
)
@click.option("--k1", type=float, help="Radial distortion of the lenses.")
@click.option("--lens", type=click.Choice(["known", "ignored"]), help="Whether it is corrected.")
@click.option("--recording", metavar="RIG.TOML", type=_IN, help="Measure on footage instead.")
@click.option("--truth", metavar="T.CSV", type=_IN, help="Its truth: frame,time_s,x,y.")
@click.option(
    "--points",
    metavar="P.CSV",
    type=_IN,
    help="Score these points, whoever found them, instead of following the footage.",
)
@click.option(
    "--guidance",
    metavar="N",
    type=click.IntRange(0, 1_000_000),
    help="Section 3.4, N times.",
)
@click.option("--draw", metavar="E.PNG", type=_IN, help="Draw scatter, ellipses and coverage.")
@click.option("--json", "as_json", is_flag=True, help="Print the table as JSON.")
def experiment(
    tracker: str,
    recording: Path | None,
    truth: Path | None,
    points: Path | None,
    guidance: int | None,
    draw: Path | None,
    as_json: bool,
    **settings: Any,
) -> None:
    """Measure accuracy and honesty, as section 3.3 of the paper does and beyond.

    A simulated device points at random targets. What is not given is the paper's rig at its
    ordinary settings.

    --recording measures on footage instead, whose truth --truth gives; it takes --tracker, --draw
    and --json. With --points it scores a table of points (frame,time_s,status,x,y,...) that any
    program found in that footage.

    --guidance repeats the robot guidance experiment of section 3.4 under physics; it takes --seed
    and --json, and needs fingerpost[mujoco].
    """
    if guidance is not None:
        _guide(guidance, settings["seed"], as_json)
        return
    from fingerpost.recording import check_picture

    if (recording is None) != (truth is None):
        raise click.UsageError("--recording and --truth go together")
    if points is not None and recording is None:
        raise click.UsageError("--points goes with --recording and --truth")
    if draw is not None:
        check_picture(draw)
    if recording is not None and truth is not None and points is not None:
        result = _scored(recording, points, truth, draw)
    elif recording is not None and truth is not None:
        result = _measured(recording, truth, tracker, draw)
    else:
        result = _simulated(_options(tracker, settings))
    _report(result, draw, as_json)


def _simulated(options: ExperimentOptions) -> ExperimentResult:
    """Run the experiment on the simulated rig."""
    from fingerpost.experiment import run_experiment

    with ending_as_interrupted(), counting("targets") as progress:
        return run_experiment(options, progress=progress)


def _measured(recording: Path, truth: Path, tracker: str, draw: Path | None) -> ExperimentResult:
    """Run the experiment on footage."""
    with ending_at_once():
        need_opencv()
        from fingerpost.config import Rig
        from fingerpost.experiment import run_recording

    _refuse_beside("recording", {"truth", "tracker", "draw", "as_json"})
    read = [("the truth", truth), *rig_files(recording, Rig.load(recording))]
    keep_apart({"--draw": draw}, read)
    with ending_as_interrupted(), counting("targets") as progress:
        return run_recording(
            recording, truth, tracker_options={"model": tracker}, progress=progress
        )


def _scored(recording: Path, points: Path, truth: Path, draw: Path | None) -> ExperimentResult:
    """Score points that were found elsewhere."""
    with ending_at_once():
        need_opencv()
        from fingerpost.experiment import score_points

    _refuse_beside("points", {"recording", "truth", "draw", "as_json"})
    keep_apart({"--draw": draw}, [("the rig", recording), ("the points", points)])
    return score_points(recording, points, truth)


def _guide(trials: int, seed: int, as_json: bool) -> None:
    """Repeat the guidance experiment and print its table."""
    _refuse_beside("guidance", {"seed", "as_json"})
    with ending_at_once():
        need_opencv()
        from fingerpost.closed_loop import GuidanceOptions, run_guidance

    with ending_as_interrupted(), counting("trials") as progress:
        result = run_guidance(trials, GuidanceOptions(seed=seed), progress=progress)
    click.echo(json.dumps(result.as_dict()) if as_json else "\n".join(result.table()))


def _refuse_beside(chosen: str, kept: set[str]) -> None:
    """Refuse every given option that would be ignored with the chosen one."""
    context = click.get_current_context()
    for name in context.params:
        given = context.get_parameter_source(name) is not click.core.ParameterSource.DEFAULT
        if given and name not in {chosen, *kept}:
            raise click.UsageError(f"--{name.replace('_', '-')} does not go with --{chosen}")


def _options(tracker: str, settings: dict[str, Any]) -> ExperimentOptions:
    """Replace defaults by the given options; the defaults are defined with the options."""
    with ending_at_once():
        need_opencv()
        from fingerpost.experiment import ExperimentOptions
        from fingerpost.simulate import Background, Lighting, Placement, PoseLimits, Sensor

    given = {name: value for name, value in settings.items() if value is not None}

    def taken(**names: str) -> dict[str, Any]:
        return {field: given.pop(name) for field, name in names.items() if name in given}

    size: dict[str, Any] = dict(zip(("width_px", "height_px"), given.pop("size", ()), strict=False))
    lenses: dict[str, Any] = {"k1": (given.pop("k1"),)} if "k1" in given else {}
    nested: dict[str, Any] = {
        "cameras": Placement(**size, **lenses),
        "limits": PoseLimits(**taken(hover_mm="hover", slant_deg="slant", azimuth_deg="azimuth")),
        "background": Background(**taken(clutter="clutter")),
        "lighting": Lighting(
            **taken(contrast="contrast", side_light="side_light", limb_darkening="limb_darkening")
        ),
        "sensor": Sensor(**taken(noise="noise", blur_px="blur")),
    }
    renamed = taken(reference_noise_px="reference_noise")
    return ExperimentOptions(tracker={"model": tracker}, **nested, **renamed, **given)


def _report(result: ExperimentResult, draw: Path | None, as_json: bool) -> None:
    click.echo(json.dumps(result.as_dict()) if as_json else "\n".join(result.table()))
    if draw is not None:
        result.draw(draw)
