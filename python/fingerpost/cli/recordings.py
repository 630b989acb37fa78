"""`fingerpost info` and `recover`: what a recording holds, and what is left of one that was cut."""

from __future__ import annotations

import json
from pathlib import Path

import click

from fingerpost.cli.outputs import keep_apart

_FILE = click.Path(path_type=Path)


@click.command()
@click.argument("recording", metavar="X.MCAP", type=_FILE)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
def info(recording: Path, as_json: bool) -> None:
    """Tell what a recording holds: views, frames, topics, and whether it is whole.

    MCAP files of other programs are told of as well.
    """
    from fingerpost.recording.session.contents import contents

    found = contents(recording)
    click.echo(json.dumps(found.as_dict()) if as_json else "\n".join(found.lines()))


@click.command()
@click.argument("cut", metavar="CUT.MCAP", type=_FILE)
@click.argument("whole", metavar="WHOLE.MCAP", type=_FILE)
def recover(cut: Path, whole: Path) -> None:
    """Get a whole recording back from one that was cut off by a crash or a full disk.

    Everything up to the last byte is written to WHOLE.MCAP, with the index that viewers need. MCAP
    files of other programs are recovered as well.
    """
    from fingerpost.recording.session.recovery import recover as recovered

    keep_apart({"WHOLE.MCAP": whole}, [("the file to recover", cut)])
    found = recovered(cut, whole)
    was = found.wrong or "it was whole"
    click.echo(f"{whole}: {found.messages} messages of {found.duration_s:.2f} s; {cut}: {was}")
