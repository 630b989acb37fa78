"""A whole session in one file: frames, results and the rig (`fingerpost.mcap_file`).

It requires the extra `mcap`, so it is not imported with `fingerpost.recording`.
"""

from fingerpost.mcap_file import About  # first: its error names the missing extra
from fingerpost.recording.session.recorder import Images, Recorder

__all__ = ["About", "Images", "Recorder"]
