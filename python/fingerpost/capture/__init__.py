"""Frames and their times, from video files, still images, cameras and network streams.

`open_source` opens the `source` of a view in a rig file as a `Source`: a context manager that
iterates over `Frame`s. `read_views` steps through several sources together.

There are two kinds. A *recorded* source delivers every frame in order, with the times stored in
the file. A *live* source delivers the newest frame when it is asked, with the time at which that
frame was grabbed, and drops frames for which the consumer was too slow. If an image is damaged, or
a live source sends none, a `Loss` takes the place of the frame.
"""

from fingerpost.capture.devices import Camera, list_cameras
from fingerpost.capture.opening import (
    is_camera_name,
    open_source,
    open_views,
    refuse_repeated,
    resolve_source,
    source_files,
    source_relative_to,
)
from fingerpost.capture.settings import AS_IT_IS, Arrangement, CameraSettings, Reading
from fingerpost.capture.source import Frame, Loss, Source, SourceKind
from fingerpost.capture.url import is_url
from fingerpost.capture.views import at_speed, read_views

__all__ = [
    "AS_IT_IS",
    "Arrangement",
    "Camera",
    "CameraSettings",
    "Frame",
    "Loss",
    "Reading",
    "Source",
    "SourceKind",
    "at_speed",
    "is_camera_name",
    "is_url",
    "list_cameras",
    "open_source",
    "open_views",
    "read_views",
    "refuse_repeated",
    "resolve_source",
    "source_files",
    "source_relative_to",
]
