"""`fingerpost run`: a rig's views in, fixes out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from fingerpost.cli.following import Following, follow, following_options
from fingerpost.cli.live_views import give_up_option
from fingerpost.cli.outputs import keep_apart, rig_files
from fingerpost.cli.recorder import record_options
from fingerpost.installation import need_opencv
from fingerpost.signals import ending_at_once


@click.command()
@click.argument("rig_file", metavar="RIG.TOML", type=click.Path(path_type=Path))
@following_options
@give_up_option
@record_options
def run(rig_file: Path, **asked: Any) -> None:
    """Track a hand in every view of a rig and print where on the plane it points.

    RIG.TOML names the views (video files, globs of images, cameras, URLs or views of a
    recording), the plane and where the hand is first seen. A live view that sends nothing is lost
    until it comes back; a damaged picture is lost for its view. Ctrl-C ends a run; what was written
    stays, and the summary covers the frames until then.
    """
    with ending_at_once():
        need_opencv()
        from fingerpost.config import Rig
        from fingerpost.pipeline import Pointer  # noqa: F401 - the longest import

    following = Following(**asked)
    rig = Rig.load(rig_file)
    keep_apart(following.written, rig_files(rig_file, rig))
    follow(rig, following)
