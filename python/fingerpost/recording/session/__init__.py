"""A whole session in one file: frames, what was made of them, and the rig (`fingerpost.mcap_file`).

Needs the extra `mcap`; so nothing of it is imported with `fingerpost.recording`.
"""

from fingerpost.mcap_file import About  # first: it says what is missing
from fingerpost.recording.session.recorder import Images, Recorder

__all__ = ["About", "Images", "Recorder"]
