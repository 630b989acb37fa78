"""`fingerpost info`, `recover` and `export`: description, recovery and export of recordings."""

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
    """Describe what a recording holds: views, frames, topics, and whether it is whole.

    MCAP files of other programs are described as well.
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


@click.command()
@click.argument("recording", metavar="X.MCAP", type=_FILE)
@click.option(
    "--points",
    metavar="P.CSV",
    type=_FILE,
    help="Write the fixes, one row a frame; as Parquet if it ends in .parquet.",
)
@click.option(
    "--tracks",
    metavar="T.CSV",
    type=_FILE,
    help="Write the finger lines of every view, likewise.",
)
@click.option("--video", metavar="V.WEBM", type=_FILE, help="Write the views with what was found.")
def export(recording: Path, points: Path | None, tracks: Path | None, video: Path | None) -> None:
    """Write what stands in a recording as tables and as a video.

    Nothing is followed again: `fingerpost replay` does that.
    """
    from fingerpost.recording import PointRow, TrackRow
    from fingerpost.recording.session.export import (
        export_table,
        export_video,
        recorded_points,
        recorded_tracks,
    )

    outputs = {"--points": points, "--tracks": tracks, "--video": video}
    if not any(outputs.values()):
        raise click.UsageError(f"nothing to write; name one of {', '.join(outputs)}")
    keep_apart(outputs, [("the recording itself", recording)])
    if points:
        count = export_table(recording, points, recorded_points(recording), PointRow)
        click.echo(f"{points}: {count} fixes")
    if tracks:
        count = export_table(recording, tracks, recorded_tracks(recording), TrackRow)
        click.echo(f"{tracks}: {count} finger lines")
    if video:
        click.echo(f"{video}: {export_video(recording, video)} pictures")
