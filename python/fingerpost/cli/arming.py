"""What every command that moves a robot shares: consent, signals, homing, keys, the log."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click
import msgspec

from fingerpost.cli.endings import ENDING_SIGNALS, ending_orderly
from fingerpost.errors import InvalidInputError

if TYPE_CHECKING:
    from fingerpost.robot import Guard, HomingProgress, Robot
    from fingerpost.robot.guard import RecordCallback

Command = TypeVar("Command", bound=Callable[..., Any])
Options = TypeVar("Options", bound=msgspec.Struct)

LONGEST_HOMING_S = 3600.0
"""Nobody watches an arm home for longer [s]."""


def homing_seconds(context: click.Context, parameter: click.Parameter, value: float) -> float:
    """Check a time-out of homing; `click.FloatRange` would let NaN pass."""
    if not 0 < value <= LONGEST_HOMING_S:
        raise click.BadParameter(
            f"{value:g} s; above 0, at most {LONGEST_HOMING_S:g} s is right", context, parameter
        )
    return value


def arming_options(command: Command) -> Command:
    """Give a command the options of everything that moves a robot."""
    for option in reversed(
        [
            click.option("--arm", is_flag=True, help="The arm may move: the explicit command."),
            click.option(
                "--log",
                metavar="C.CSV",
                type=click.Path(path_type=Path),
                help="Write every command with the fix that caused it.",
            ),
            click.option(
                "--homing-timeout",
                type=float,
                callback=homing_seconds,
                default=180.0,
                show_default=True,
                metavar="S",
            ),
            click.option(
                "--operator-timeout",
                type=float,
                default=1.0,
                show_default=True,
                metavar="S",
                help="The arm stops so long after the operator was last there.",
            ),
        ]
    ):
        command = option(command)
    return command


def laid_over(kind: type[Options], given: Mapping[str, Any], what: str) -> Options:
    """Lay what was given over the defaults, which stand where the options are defined.

    Raises
    ------
    InvalidInputError
        A value that the options do not take: their constructor would not check it.
    """
    named = {name: value for name, value in given.items() if value is not None}
    try:
        return msgspec.convert(named, kind)
    except msgspec.ValidationError as error:
        raise InvalidInputError(f"options {what}: {error}") from error


def need_consent(arm: bool, what: str) -> None:
    """See that somebody wants the arm to move: by --arm, or by typing so on a terminal.

    Raises
    ------
    click.UsageError
        Neither.
    click.Abort
        The answer is another.
    """
    if arm:
        return
    if not sys.stdin.isatty():
        raise click.UsageError(f"{what} moves the arm: see that its way is clear and give --arm")
    answer = click.prompt(
        f"{what} moves the arm. Is its way clear? Type 'arm' to go on", default="", err=True
    )
    if answer.strip().lower() != "arm":
        raise click.Abort


def open_log(stack: ExitStack, path: Path | None) -> RecordCallback | None:
    """Open the log of commands, if one is wanted."""
    from fingerpost.guidance import CommandLog

    return None if path is None else stack.enter_context(CommandLog(path))


def show_homing(progress: HomingProgress) -> None:
    """Tell on a terminal how far homing has come."""
    if sys.stderr.isatty():
        line = f"homing {progress.elapsed_s:5.1f} s of at most {progress.timeout_s:.0f} s"
        click.echo(f"\r{line}  {progress.message}", nl=False, err=True)


def home(robot: Robot, timeout_s: float) -> None:
    """Home an arm that has just been connected."""
    tell("homing; the arm moves")
    robot.home(show_homing, timeout_s=timeout_s)


def tell(line: str) -> None:
    """Say something to the operator, on stderr."""
    click.echo(line, err=True)


@contextmanager
def guarded(guard: Guard) -> Iterator[None]:
    """Halt the arm on every signal that ends or suspends the program, and watch it meanwhile."""
    stopping = [signal.SIGINT, *ENDING_SIGNALS]
    if hasattr(signal, "SIGTSTP"):
        stopping.append(signal.SIGTSTP)
    with ending_orderly(), guard.signals(*stopping), guard.watching():
        yield
