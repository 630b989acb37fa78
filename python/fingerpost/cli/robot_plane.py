"""`fingerpost robot plane`: the gripper visits a plane, which ties the cameras to the robot."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fingerpost.cli.arming import (
    arming_options,
    guarded,
    has_terminal,
    home,
    laid_over,
    need_consent,
    open_log,
    say,
)
from fingerpost.cli.endings import ending_orderly
from fingerpost.cli.live_views import give_up_option, hush_streams
from fingerpost.cli.outputs import keep_apart, rig_files
from fingerpost.errors import CaptureError, InvalidInputError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from fingerpost.capture import Frame
    from fingerpost.config import Rig, RobotTable
    from fingerpost.guidance import GripperFinder, PlaneByRobot, Visit

_IN = click.Path(path_type=Path)
Start = tuple[str, float, float, float, float]


def _corners(
    context: click.Context, parameter: click.Parameter, value: str
) -> tuple[tuple[float, float], ...]:
    """Parse the corners of a region: `x,y x,y x,y ...`."""
    try:
        corners = [tuple(float(number) for number in pair.split(",")) for pair in value.split()]
    except ValueError:
        corners = []
    if len(corners) < 3 or any(len(corner) != 2 for corner in corners):
        raise click.BadParameter(
            f"{value!r}; three or more corners 'x,y x,y x,y' in m are right", context, parameter
        )
    return tuple((x, y) for x, y in corners)


@click.command()
@click.argument("rig_file", metavar="RIG.TOML", type=_IN)
@click.argument("url")
@click.option(
    "--region", callback=_corners, required=True, help="Safe region: 'x,y x,y x,y ...' in m."
)
@click.option(
    "--z", "z_m", type=(float, float), required=True, metavar="LOW HIGH", help="Its Z, m."
)
@click.option("--height", "height_m", type=float, required=True, help="The plane's Z, m.")
@click.option("--points", type=int, help="Places to visit, 4 to 50.  [default: 9]")
@click.option("-o", "--output", metavar="PLANE.TOML", type=_IN, required=True, help="The new rig.")
@click.option(
    "--finder",
    "kind",
    type=click.Choice(["marker", "contour", "motion", "pixels"]),
    default="marker",
    show_default=True,
    help="What finds the gripper in the views.",
)
@click.option("--sigma", "sigma_px", type=float, help="How well, standard deviation, px.")
@click.option("--marker", "marker_id", type=int, default=0, show_default=True, help="Its number.")
@click.option("--dictionary", default="4X4_50", show_default=True, help="Its ArUco dictionary.")
@click.option(
    "--tip",
    type=(float, float),
    default=(0.0, 0.0),
    metavar="X Y",
    help="The gripper's tip in the marker's plane, from its centre, in sides: right, down.",
)
@click.option("--outline", type=_IN, help="The gripper's traced outline (contour); else a rod.")
@click.option(
    "--gripper",
    "grippers",
    type=(str, float, float, float, float),
    multiple=True,
    metavar="VIEW U V DEG PX",
    help="Where it waits (contour): tip, direction, length; once a view.",
)
@click.option(
    "--polarity",
    type=click.Choice(["bright", "dark", "unknown"]),
    default="unknown",
    show_default=True,
    help="The gripper against what is behind it (contour).",
)
@click.option("--towards", type=float, default=90.0, help="Tip is furthest this way (motion), deg.")
@click.option("--threshold", type=float, default=25.0, help="Least change (motion), grey levels.")
@click.option("--pixels", type=_IN, help="CSV place,view,u,v (pixels); without it you are asked.")
@click.option(
    "--pictures",
    type=_IN,
    metavar="DIR",
    help="Save what you are asked about here (pixels); else in the working folder.",
)
@click.option("--offset", "offset_m", type=(float, float, float), help="Found point from tip, m.")
@click.option("--lift", "lift_m", type=float, help="Height of the way between places, m.")
@click.option("--speed", "speed_m_s", type=float, help="Of the gripper, m/s.")
@click.option("--max-sigma", "max_sigma_m", type=float, help="Uncertainty that will do, m.")
@give_up_option
@click.option("--keep-pose", is_flag=True, help="Hold the gripper as after homing, not down.")
@click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
@arming_options
def plane(
    rig_file: Path,
    url: str,
    region: tuple[tuple[float, float], ...],
    z_m: tuple[float, float],
    height_m: float,
    output: Path,
    give_up_after_s: float | None,
    keep_pose: bool,
    as_json: bool,
    arm: bool,
    log: Path | None,
    homing_timeout: float,
    operator_timeout_s: float,
    **given: Any,
) -> None:
    """Let the arm at URL define the working plane, and write the rig that follows from it.

    The gripper visits places of the plane at the given height, inside the safe region, and is found
    in every view of RIG.TOML, which needs no [plane]. The new rig has the robot's own X and Y in
    metres as its plane. Run it again with another height for another plane.
    """
    from fingerpost.capture import Loss, SourceKind, open_views, read_views
    from fingerpost.config import Rig, RobotTable
    from fingerpost.guidance import (
        PlaneOptions,
        define_plane,
        guard_of,
        held_down,
        places_to_visit,
    )
    from fingerpost.robot import GuardOptions, OutOfReachError, open_robot

    cameras = Rig.load_cameras(rig_file)
    keep_apart({"--log": log, "--output": output}, [])
    keep_apart({"--log": log}, rig_files(rig_file, cameras))
    table = RobotTable(url=url, height_m=height_m, region_m=region, z_m=z_m)
    names = ("points", "offset_m", "lift_m", "speed_m_s", "max_sigma_m")
    options = laid_over(PlaneOptions, given, **{name: name for name in names})
    guard_options = GuardOptions(operator_timeout_s=operator_timeout_s)
    finders = _finders(cameras, given)
    robot = open_robot(url)
    # An invalid region, and places outside it, are refused first.
    guard = guard_of(robot, table, guard_options)
    try:
        places_to_visit(guard, options)
    except OutOfReachError as error:
        raise InvalidInputError(f"--height {height_m:g}: {error}") from error
    _need_file(output)  # else the results would be lost after the visits
    with ExitStack() as stack:
        need_consent(arm, "robot plane")
        on_record = open_log(stack, log)
        stack.enter_context(ending_orderly())
        hush_streams(cameras.sources)
        sources = stack.enter_context(open_views(cameras.sources, cameras.readings))
        for source in sources:
            if source.kind is not SourceKind.LIVE:
                raise InvalidInputError(f"{source.name} is a recording; live views are needed")
        stream = read_views(sources, give_up_after_s=give_up_after_s)

        def frames() -> Sequence[Frame | None]:
            together = next(stream, None)
            if together is None:
                raise CaptureError("the views ended")
            return [None if isinstance(seen, Loss) else seen for seen in together]

        stack.enter_context(robot)
        guard.check_limits(speed_m_s=options.speed_m_s)
        home(robot, homing_timeout)
        if not keep_pose:
            table = _replaced(table, held_down(robot, robot.pose()))
        guard = guard_of(robot, table, guard_options, on_record=on_record)
        with guarded(guard), guard.attended():
            guard.arm()
            found = define_plane(
                guard, cameras, frames, finders, options, progress=_progress(options.points)
            )
            # Inside the block, because leaving it raises if the log fails with the last stop.
            _report(found, as_json)
            found.rig(cameras, table).save(output)
    if not as_json:
        click.echo(f"written to {output}")


def _need_file(path: Path) -> None:
    """Check that the new rig can be written, by writing the temporary file of `Rig.save`."""
    from fingerpost.checks import part_of

    problem = ""
    try:
        if path.is_dir():
            problem = "it is a folder"
        elif path.exists() and not path.is_file():
            problem = "it is no file"
        else:
            part = part_of(path)
            part.touch()
            part.unlink()
    except OSError as error:
        problem = str(error.strerror)
    if problem:
        raise InvalidInputError(
            f"-o {path} cannot be written: {problem}; name a file in an existing folder"
        )


def _need_folder(path: Path) -> None:
    """Check that pictures can be saved in a folder, which is created if it does not exist."""
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as error:
        raise InvalidInputError(
            f"--pictures {path}: nothing can be saved there: {error.strerror}; name a folder"
        ) from error


def _replaced(table: RobotTable, changes: Mapping[str, Any]) -> RobotTable:
    import msgspec

    return msgspec.structs.replace(table, **changes)


def _finders(cameras: Rig, given: Mapping[str, Any]) -> list[GripperFinder]:
    """Return one finder for every view."""
    from fingerpost.guidance import MarkerFinder, MotionFinder

    sigma = {} if given["sigma_px"] is None else {"sigma_px": given["sigma_px"]}
    names = [view.name for view in cameras.views]
    if given["kind"] == "contour":
        return _contour_finders(names, given)
    if given["kind"] == "pixels":
        return _given_finders(names, given, sigma)
    if given["kind"] == "motion":
        towards = {"towards_deg": given["towards"], "threshold": given["threshold"]}
        return [MotionFinder(**towards, **sigma) for _ in names]
    marker = {"dictionary": given["dictionary"], "tip": given["tip"]}
    return [MarkerFinder(given["marker_id"], **marker, **sigma) for _ in names]


def _contour_finders(names: Sequence[str], given: Mapping[str, Any]) -> list[GripperFinder]:
    import math

    from fingerpost import StartPose, Template
    from fingerpost.guidance import ContourFinder, load_outline

    starts: dict[str, Start] = {start[0]: start for start in given["grippers"]}
    for name in names:
        if name not in starts:
            raise click.UsageError(f"--finder contour needs --gripper {name} U V DEG PX")
    if unknown := sorted(set(starts) - set(names)):
        raise click.UsageError(f"--gripper {unknown[0]}: the views are {', '.join(names)}")
    template = (
        Template.pistol("none") if given["outline"] is None else load_outline(given["outline"])
    )
    sigma = {} if given["sigma_px"] is None else {"along_sigma_px": given["sigma_px"]}
    return [
        ContourFinder(
            template,
            StartPose((u, v), math.radians(deg), length),
            polarity=given["polarity"],
            **sigma,
        )
        for _, u, v, deg, length in (starts[name] for name in names)
    ]


def _given_finders(
    names: Sequence[str], given: Mapping[str, Any], sigma: Mapping[str, float]
) -> list[GripperFinder]:
    from fingerpost.guidance import GivenFinder, load_pixels

    if given["pixels"] is None:
        if not has_terminal():
            raise click.UsageError("--finder pixels needs --pixels, or a terminal to ask on")
        pictures = given["pictures"] or Path()
        _need_folder(pictures)
        return [GivenFinder(_asking(name, pictures), **sigma) for name in names]
    pixels = load_pixels(given["pixels"])
    for name in names:
        if name not in pixels:
            raise click.UsageError(f"{given['pixels']} has no pixel of view {name}")
    return [GivenFinder(_looking_up(pixels[name]), **sigma) for name in names]


def _looking_up(
    pixels: Mapping[int, tuple[float, float]],
) -> Callable[[int, Frame], tuple[float, float] | None]:
    return lambda place, _frame: pixels.get(place)


def _asking(name: str, pictures: Path) -> Callable[[int, Frame], NDArray[np.float64] | None]:
    """Return a function that saves a picture and asks for a pixel of it on the terminal."""

    def ask(place: int, frame: Frame) -> NDArray[np.float64] | None:
        from fingerpost.guidance.finders import pixel_of
        from fingerpost.recording import write_picture

        path = pictures / f"place-{place + 1:02d}-{name}.png"
        write_picture(path, frame.image)
        while True:
            answer = click.prompt(
                f"{path}: pixel 'u v' of the gripper, or nothing",
                default="",
                err=True,
                show_default=False,
            )
            if not answer.strip():
                return None
            try:
                u, v = (float(number) for number in answer.replace(",", " ").split())
                return pixel_of((u, v), frame, "the pixel")
            except InvalidInputError as error:
                say(str(error))
            except ValueError:
                say("two numbers are needed")

    return ask


def _progress(points: int) -> Callable[[Visit], None]:
    def show(visit: Visit) -> None:
        x, y, z = visit.position_m
        say(
            f"place {visit.place + 1:2d} of {points}   ({x:.4f}, {y:.4f}, {z:.4f}) m   "
            f"{visit.problem or 'found'}"
        )

    return show


def _report(found: PlaneByRobot, as_json: bool) -> None:
    click.echo(json.dumps(found.as_dict()) if as_json else "\n".join(found.lines()))
