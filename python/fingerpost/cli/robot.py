"""`fingerpost robot`: arms, and controllers to try them on."""

from __future__ import annotations

import io
import sys
import threading
from collections.abc import Iterable
from typing import TYPE_CHECKING

import click

from fingerpost.cli.arming import LONGEST_HOMING_S, seconds, show_homing, stopped_by_signals
from fingerpost.cli.endings import ending_orderly
from fingerpost.cli.robot_guide import follow, pick
from fingerpost.cli.robot_plane import plane

if TYPE_CHECKING:
    from fingerpost.robot import Pose


@click.group()
def robot() -> None:
    """Define the plane by an arm, follow the hand, pick and place; or emulate a controller.

    URL names an arm: acl:///dev/ttyUSB0, acl+socket://host:4001, marlin://COM3, ur://10.0.0.5,
    sim:// ...; `fingerpost robot list` prints the names.
    """


@robot.command("list")
def list_robots() -> None:
    """Print the names of all arms that can be opened, plug-ins included."""
    from fingerpost.robot import robot_names

    click.echo("\n".join(robot_names()))


@robot.command()
@click.argument("url")
@click.option(
    "--timeout",
    type=float,
    callback=seconds(LONGEST_HOMING_S),
    default=180.0,
    show_default=True,
    help="Give up after, s.",
)
def home(url: str, timeout: float) -> None:
    """Home an arm and print where its gripper is. The arm moves; Ctrl-C stops it."""
    from fingerpost.robot import open_robot

    with ending_orderly(), open_robot(url) as arm, stopped_by_signals(arm):
        arm.home(show_homing, timeout_s=timeout)
        click.echo(_described(arm.pose()))


@robot.command()
@click.argument("url")
def stop(url: str) -> None:
    """Stop an arm at once."""
    from fingerpost.robot import open_robot

    with open_robot(url) as arm:
        arm.stop()


def _described(pose: Pose) -> str:
    return f"x {pose.x_m:.4f} m   y {pose.y_m:.4f} m   z {pose.z_m:.4f} m"


@robot.command()
@click.argument("controller")
@click.option("--link", metavar="PATH", help="Where to put the link to the pseudo-terminal.")
@click.option("--tcp-port", type=int, help="Serve a TCP port of the loopback instead.")
@click.option("--time-scale", type=float, default=1.0, show_default=True, help="Arm's s per s.")
@click.option("--homing-s", type=float, default=60.0, show_default=True, help="Homing takes, s.")
@click.option("--echo/--no-echo", default=True, show_default=True, help="ACL's echo.")
@click.option("--faults-per-s", type=float, default=0.0, help="Faults at random.")
@click.option("--seed", type=int, default=0, show_default=True, help="Of noise and faults.")
def emulate(
    controller: str,
    link: str | None,
    tcp_port: int | None,
    time_scale: float,
    homing_s: float,
    echo: bool,
    faults_per_s: float,
    seed: int,
) -> None:
    """Serve an emulated CONTROLLER (acl, uarm, marlin, ...) until Ctrl-C.

    Prints the port; a line of standard input that names a fault has it happen.
    """
    from fingerpost.robot.emulator import make_emulator, serve

    emulator = make_emulator(
        controller,
        link=link,
        tcp_port=tcp_port,
        time_scale=time_scale,
        homing_s=homing_s,
        echo=echo,
        seed=seed,
    )
    # click.echo flushes: a program that waits for the port must not wait for a full buffer.
    serve(
        emulator,
        click.echo,
        threading.Event(),
        orders=_typed(),
        faults_per_s=faults_per_s,
        seed=seed,
    )


def _typed() -> Iterable[str]:
    """Return the lines of standard input, which may be closed or contain invalid text."""
    if isinstance(sys.stdin, io.TextIOWrapper):
        sys.stdin.reconfigure(errors="replace")
    return sys.stdin or ()


for _command in (plane, follow, pick):
    robot.add_command(_command)
