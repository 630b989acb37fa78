"""`fingerpost live`: the operator's page."""

from __future__ import annotations

import ipaddress
import webbrowser
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import click

from fingerpost.cli.arming import open_log
from fingerpost.cli.endings import ending_as_interrupted
from fingerpost.cli.live_arm import desk_of, page_arm_options, refuse_without_arm
from fingerpost.cli.live_views import hush_streams
from fingerpost.cli.operators import operator_called, operator_option
from fingerpost.cli.outputs import keep_apart, rig_files
from fingerpost.cli.publishing import publish_option
from fingerpost.cli.recorder import record_options
from fingerpost.cli.session_outputs import SessionOutputs
from fingerpost.installation import need_opencv
from fingerpost.signals import ending_at_once

_LARGEST_PORT = 65535


def _address(_context: click.Context, _parameter: click.Parameter, given: str) -> str:
    """Refuse anything except the address of one network interface."""
    try:
        address = ipaddress.IPv4Address(given)
    except ValueError:
        address = None
    if address is None or address.is_unspecified:
        raise click.BadParameter(
            f"{given!r}; an IPv4 address of this machine is right, such as 192.168.1.20"
        )
    return given


@click.command()
@click.argument("named", metavar="[RIG.TOML | SOURCE ...]", nargs=-1)
@click.option(
    "--port",
    type=click.IntRange(0, _LARGEST_PORT),
    default=0,
    help="Serve at this port.  [default: any that is free]",
)
@click.option(
    "--host",
    metavar="ADDRESS",
    default="127.0.0.1",
    show_default=True,
    callback=_address,
    help="Serve at this address of the machine, for a phone beside the table.",
)
@click.option("--open", "opens", is_flag=True, help="Open the page in a browser.")
@operator_option
@publish_option
@record_options
@page_arm_options
def live(
    named: tuple[str, ...],
    port: int,
    host: str,
    opens: bool,
    operator: str | None,
    publish: list[str],
    record: Path | None,
    images: str | None,
    **given: Any,
) -> None:
    """See where a hand points, in a browser, while it points.

    RIG.TOML names the views, as for `fingerpost run`: cameras are shown at their rate, recordings
    at their own pace, with pause, step and a timeline. The address that is printed holds a token;
    whoever has it may watch. Ctrl-C ends it.

    Without RIG.TOML the page begins with setting one up, and nothing is typed there: the table is
    found, the hand is found, and a rig file is written to this folder. SOURCE is a recording, a
    camera's number or a URL, two or more; if none is named, the page offers the cameras of the
    machine and the recordings of this folder, and takes recordings that are dropped onto it.

    With --arm the page guides the arm of the rig's [robot] table: arm it there, choose what it is
    to do, and hold the button or the key M down: it moves only while you do. Space, Escape or STOP
    stops it at once, and so does a page that goes away.
    """
    with ending_at_once():
        need_opencv()
        from fingerpost.config import Rig
        from fingerpost.live import Page, operate, set_up

    rig_file = Path(named[0]) if len(named) == 1 and not _is_source(named[0]) else None
    rig = None if rig_file is None else Rig.load(rig_file)
    sources = () if rig_file is not None else _sources(named)
    known = operator_called(operator)
    read = () if rig_file is None or rig is None else rig_files(rig_file, rig)
    keep_apart({"--log": given["log"], "--record": record}, read)
    with ExitStack() as stack:
        desk = None
        if not given["arm"]:
            refuse_without_arm(given)
        elif rig_file is None or rig is None:
            raise click.UsageError("--arm needs RIG.TOML: one that `fingerpost robot plane` wrote")
        else:
            desk = desk_of(rig, given)
        log = open_log(stack, given["log"])
        outputs = SessionOutputs(publish=publish, record=record, images=images, log=log)
        stack.enter_context(ending_as_interrupted())
        page = stack.enter_context(Page(host, port))
        click.echo(page.address)
        if opens:
            webbrowser.open(page.address)
        if rig_file is None or rig is None:
            rig_file, learned = set_up(page, Path.cwd(), sources)
            rig, known = Rig.load(rig_file), known or learned
        hush_streams(rig.sources)
        operate(page, rig, rig_file.name, known, outputs, desk)
        page.wait()


def _is_source(name: str) -> bool:
    """Return whether a name is that of a source rather than of a rig file."""
    from fingerpost.capture import is_url
    from fingerpost.live.setup.offers import FILMS

    return name.isdecimal() or is_url(name) or Path(name).suffix.lower() in FILMS


def _sources(names: Sequence[str]) -> list[str | int]:
    """Return sources as in a rig file; relative paths start at the current directory."""
    from fingerpost.capture import resolve_source

    return [int(name) if name.isdecimal() else resolve_source(name, Path.cwd()) for name in names]
