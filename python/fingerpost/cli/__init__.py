"""The command line: `fingerpost COMMAND ...`.

Results go to stdout or to files, everything else to stderr. Exit codes: 0 done, 1 failed while
running, 2 bad usage or bad input (one line says what, where and what would be right), 130 stopped
by Ctrl-C.
"""

from __future__ import annotations

import io
import logging
import os
import sys
import traceback
from typing import Any, NoReturn

import click

from fingerpost.cli.advise import advise
from fingerpost.cli.batch import batch
from fingerpost.cli.calibrate_operator import calibrate_operator
from fingerpost.cli.cameras import cameras
from fingerpost.cli.demo import demo
from fingerpost.cli.doctor import doctor
from fingerpost.cli.experiment import experiment
from fingerpost.cli.init import init
from fingerpost.cli.live import live
from fingerpost.cli.markers import markers
from fingerpost.cli.record import record
from fingerpost.cli.recordings import export, info, recover
from fingerpost.cli.replay import replay
from fingerpost.cli.robot import robot
from fingerpost.cli.run import run
from fingerpost.cli.sync import sync
from fingerpost.errors import FingerpostError, InvalidInputError
from fingerpost.installation import installed_extras, installed_versions
from fingerpost.signals import STOPPED

FAILED = 1
BAD_INPUT = 2


class _Commands(click.Group):
    """Turns fingerpost's errors into one line and an exit code; a traceback indicates a bug."""

    def main(self, *args: Any, **kwargs: Any) -> Any:
        try:
            _show_what_can_be_shown()
            return super().main(*args, **{**kwargs, "standalone_mode": False})
        except (click.exceptions.Abort, KeyboardInterrupt):
            _stop("stopped", STOPPED)
        except click.exceptions.NoArgsIsHelpError as error:
            error.show()
            sys.exit(error.exit_code)
        except click.ClickException as error:
            context = getattr(error, "ctx", None)
            place = f"{context.command_path}: " if context else "fingerpost: "
            click.echo(f"{place}{error.format_message()}", err=True)
            sys.exit(error.exit_code)
        except InvalidInputError as error:
            _stop(str(error), BAD_INPUT)
        except FingerpostError as error:
            _stop(str(error), FAILED)
        except OSError as error:
            if not _is_of_output(error):
                raise
            # Discard the buffered output: Python would try to write it again, and complain.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            _stop(f"standard output: cannot be written: {error.strerror}", FAILED)


def _show_what_can_be_shown() -> None:
    """Make stdout replace characters that its encoding lacks, as stderr does by default."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")


def _is_of_output(error: OSError) -> bool:
    """Whether an error is of the output of all commands; the error itself names no stream."""
    *_, (frame, _) = traceback.walk_tb(error.__traceback__)
    return frame.f_code is click.echo.__code__


def _stop(message: str, code: int) -> NoReturn:
    click.echo(f"fingerpost: {message}", err=True)
    sys.exit(code)


def _show_version(context: click.Context, _option: click.Parameter, is_wanted: bool) -> None:
    """Print the data for a bug report: the version in the first line, then the dependencies."""
    if is_wanted and not context.resilient_parsing:
        versions = installed_versions()
        click.echo(f"fingerpost {versions.pop('fingerpost')}")
        for name, version in versions.items():
            click.echo(f"{name} {version}")
        click.echo(f"extras {', '.join(installed_extras()) or 'none'}")
        context.exit()


@click.group(cls=_Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.option(
    "--version",
    is_flag=True,
    expose_value=False,
    is_eager=True,
    callback=_show_version,
    help="Show the version and what it stands on, as a bug report needs it.",
)
@click.option("-v", "--verbose", is_flag=True, help="Say more on stderr.")
def main(verbose: bool) -> None:
    """Point at a table and a program knows where, and how sure that is."""
    # A damaged file is reported in one line of fingerpost's; OpenCV's messages do not help.
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
    logging.basicConfig(
        level=logging.DEBUG if verbose else logging.WARNING, format="%(levelname)s: %(message)s"
    )


_RECORDINGS = (record, replay, info, recover, export, batch)
_SETTING_UP = (init, cameras, markers, sync, advise, doctor, calibrate_operator)

for _command in (demo, *_SETTING_UP, run, live, *_RECORDINGS, experiment, robot):
    main.add_command(_command)
