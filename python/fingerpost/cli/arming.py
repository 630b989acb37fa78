"""Common parts of the commands that move a robot: consent, signals, homing, keys, the log."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from fingerpost.cli.endings import ending_orderly
from fingerpost.errors import InvalidInputError
from fingerpost.signals import ENDING_SIGNALS

if TYPE_CHECKING:
    from fingerpost.robot import Guard, HomingProgress, Robot
    from fingerpost.robot.guard import RecordCallback

Command = TypeVar("Command", bound=Callable[..., Any])
Made = TypeVar("Made")

Seconds = Callable[[click.Context, click.Parameter, float | None], float | None]

LONGEST_HOMING_S = 3600.0
"""Largest time-out of homing [s]; nobody watches it for longer."""

LONGEST_ABSENCE_S = 60.0
"""Largest time-out for an absent operator or missing fixes [s]."""


def seconds(longest_s: float) -> Seconds:
    """Return a check of a time-out above 0; `click.FloatRange` would let NaN pass.

    Parameters
    ----------
    longest_s
        Largest valid value [s].
    """

    def check(
        context: click.Context, parameter: click.Parameter, value: float | None
    ) -> float | None:
        if value is not None and not 0 < value <= longest_s:
            raise click.BadParameter(
                f"{value:g} s; above 0, at most {longest_s:g} s is right", context, parameter
            )
        return value

    return check


def grouped(options: Sequence[Callable[[Any], Any]]) -> Callable[[Command], Command]:
    """Return a decorator that adds options to a command, in their order."""

    def given(command: Command) -> Command:
        for option in reversed(options):
            command = option(command)
        return command

    return given


moving_options = grouped(
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
            callback=seconds(LONGEST_HOMING_S),
            default=180.0,
            show_default=True,
            metavar="S",
        ),
    ]
)
"""Adds the options of every command that moves a robot, wherever its operator is."""

arming_options = grouped(
    [
        moving_options,
        click.option(
            "--operator-timeout",
            "operator_timeout_s",
            type=float,
            callback=seconds(LONGEST_ABSENCE_S),
            default=1.0,
            show_default=True,
            metavar="S",
            help="The arm stops so long after the operator was last there.",
        ),
    ]
)
"""Adds the options of every command that moves a robot with its operator at a terminal."""


def laid_over(kind: Callable[..., Made], given: Mapping[str, Any], **fields: str) -> Made:
    """Replace defaults by the given options; the defaults are defined with the options.

    Parameters
    ----------
    kind
        Makes and checks the options.
    given
        Values of the command line by parameter name; None means not given.
    **fields
        The parameter for each field.

    Raises
    ------
    click.BadParameter
        A value that the options refuse; names the option of the command line.
    InvalidInputError
        Values that are valid separately, but not together.
    """
    named = {field: given[name] for field, name in fields.items() if given[name] is not None}
    try:
        return kind(**named)
    except InvalidInputError as error:
        if (wrong := _wrong_alone(kind, named)) is None:
            raise
        context = click.get_current_context()
        (option,) = (one for one in context.command.params if one.name == fields[wrong])
        raise click.BadParameter(str(error), context, option) from error


def _wrong_alone(kind: Callable[..., object], named: Mapping[str, Any]) -> str | None:
    """Return the first field that is invalid even with defaults for all others."""
    for field, value in named.items():
        try:
            kind(**{field: value})
        except InvalidInputError:
            return field
    return None


def has_terminal() -> bool:
    """Whether input can be typed: standard input may be closed, or not be a terminal."""
    return sys.stdin is not None and sys.stdin.isatty()


def need_consent(arm: bool, what: str) -> None:
    """Require consent to a motion of the arm: by --arm, or by an answer on a terminal.

    Raises
    ------
    click.UsageError
        There is neither --arm nor a terminal.
    click.Abort
        Consent is denied.
    """
    if arm:
        return
    if not has_terminal():
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
    """Show the progress of homing on a terminal."""
    if sys.stderr is not None and sys.stderr.isatty():
        line = f"homing {progress.elapsed_s:5.1f} s of at most {progress.timeout_s:.0f} s"
        click.echo(f"\r{line}  {progress.message}", nl=False, err=True)


def home(robot: Robot, timeout_s: float) -> None:
    """Home a newly connected arm."""
    say("homing; the arm moves")
    with stopped_by_signals(robot):
        robot.home(show_homing, timeout_s=timeout_s)


@contextmanager
def stopped_by_signals(robot: Robot) -> Iterator[None]:
    """Stop an arm without a guard on every signal that ends or suspends the program."""
    from fingerpost.robot import RobotError
    from fingerpost.robot.signals import stopping_on

    def stop(_name: str) -> None:
        with suppress(RobotError):  # the program ends, or homing reports the error
            robot.stop()

    with stopping_on(stop, *stopping_signals()):
        yield


def stopping_signals() -> list[signal.Signals]:
    """Return every signal that ends or suspends the program."""
    suspending = [signal.SIGTSTP] if hasattr(signal, "SIGTSTP") else []
    return [signal.SIGINT, *ENDING_SIGNALS, *suspending]


def say(line: str) -> None:
    """Print a message to the operator on stderr."""
    click.echo(line, err=True)


@contextmanager
def guarded(guard: Guard) -> Iterator[None]:
    """Run the guard, and halt the arm on every signal that ends or suspends the program."""
    with ending_orderly(), guard.signals(*stopping_signals()), guard.watching():
        yield
