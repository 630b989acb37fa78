"""Outputs of a run: tables of points and tracks, pictures, videos, sessions (`session`)."""

from fingerpost.recording.still import check_picture, write_picture
from fingerpost.recording.tables import (
    PointRow,
    TableWriter,
    TargetRow,
    TrackRow,
    read_points,
    read_targets,
    read_tracks,
    write_points,
    write_targets,
    write_tracks,
)
from fingerpost.recording.video import VideoWriter

__all__ = [
    "PointRow",
    "TableWriter",
    "TargetRow",
    "TrackRow",
    "VideoWriter",
    "check_picture",
    "read_points",
    "read_targets",
    "read_tracks",
    "write_picture",
    "write_points",
    "write_targets",
    "write_tracks",
]
