"""`run --events`: what the hand does with the targets of a rig, one JSON object a line."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

import click

from fingerpost.cli.keys import TAKE_KEY, pressed_keys

if TYPE_CHECKING:
    from fingerpost.config import Rig
    from fingerpost.pipeline import Step

STDOUT = Path("-")

EVENT_OPTIONS = (
    click.option(
        "--events",
        metavar="[E.JSONL]",
        is_flag=False,
        flag_value="-",
        type=click.Path(path_type=Path, allow_dash=True),
        help="Write what the hand does with targets, one JSON object a line; alone, print it.",
    ),
    click.option(
        "--dwell",
        "dwell_s",
        metavar="S",
        type=click.FloatRange(1e-3, 3600.0),
        default=1.0,
        show_default=True,
        help="Staying so long on a target selects it; so does the space bar.",
    ),
)


def event_taker(stack: ExitStack, rig: Rig, path: Path, dwell_s: float) -> Callable[[Step], None]:
    """Write the events of the hand and the targets; on a terminal, a key may select as well."""
    from fingerpost.selection import Selector

    selector = Selector(rig.things, dwell_s=dwell_s)
    try:
        file = None if path == STDOUT else stack.enter_context(path.open("w", encoding="utf-8"))
    except OSError as error:
        raise click.UsageError(f"--events {path}: cannot be written: {error.strerror}") from error
    pressed = stack.enter_context(pressed_keys())

    def take(step: Step) -> None:
        happened = selector.update(step.fix)
        while pressed:
            if pressed.popleft() == TAKE_KEY:
                happened += selector.press(step.fix.time_s)
        for event in happened:
            click.echo(json.dumps(event.as_dict()), file=file)

    return take
