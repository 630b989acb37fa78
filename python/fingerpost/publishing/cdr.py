"""Three messages of ROS 2 in CDR (XCDR 1, little-endian), the format of its middlewares."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator

import numpy as np

from fingerpost.publishing.fix import PublishedFix
from fingerpost.uncertainty import confidence_ellipse

_HEAD = b"\x00\x01\x00\x00"
"""Plain CDR, little-endian; alignment is relative to the end of this header."""

_UNKNOWN_RAD2 = 1e6
"""Variance of unknown angles: a point has no direction."""

_CYLINDER, _ADD, _DELETE = 3, 0, 2
_THICKNESS_M = 0.001
_COLOUR = (0.1, 0.6, 1.0, 0.5)
_LIFETIME_S = 1


class Stream:
    """Writes CDR: each number is aligned to its size."""

    def __init__(self) -> None:
        self._data = bytearray()

    def add(self, form: str, *values: float) -> None:
        """Add numbers of one type, by its letter of `struct`."""
        size = struct.calcsize(f"<{form}")
        self._data += bytes(-len(self._data) % size)
        self._data += struct.pack(f"<{len(values)}{form}", *values)

    def text(self, text: str) -> None:
        """Add a string: its length including the terminating zero, its bytes, and the zero."""
        data = text.encode() + b"\0"
        self.add("I", len(data))
        self._data += data

    def header(self, stamp_ns: int, frame_id: str) -> None:
        """Add a std_msgs/Header."""
        seconds, nanoseconds = divmod(stamp_ns, 10**9)
        self.add("i", seconds)
        self.add("I", nanoseconds)
        self.text(frame_id)

    def done(self) -> bytes:
        """Return the message."""
        return _HEAD + bytes(self._data)


def messages(fix: PublishedFix, unit_m: float, frame_id: str) -> Iterator[tuple[str, bytes]]:
    """Yield the messages of a fix: topic and content.

    Parameters
    ----------
    fix
        The fix.
    unit_m
        Length of the plane's unit [m].
    frame_id
        Frame of the plane: X and Y as in the rig, Z by the right-hand rule.
    """
    stamp_ns = fix.stamp_ns
    if fix.status == "ok" and fix.point is not None and fix.covariance is not None:
        point_m = np.multiply(fix.point, unit_m)
        covariance_m2 = fix.covariance * unit_m**2
        yield "point", _point(stamp_ns, frame_id, point_m[0], point_m[1])
        yield "pose", _pose(stamp_ns, frame_id, point_m, covariance_m2)
        yield "ellipse", _ellipse(stamp_ns, frame_id, point_m, covariance_m2)
    else:
        yield "ellipse", _no_ellipse(stamp_ns, frame_id)


def _point(stamp_ns: int, frame_id: str, x_m: float, y_m: float) -> bytes:
    stream = Stream()
    stream.header(stamp_ns, frame_id)
    stream.add("d", x_m, y_m, 0.0)
    return stream.done()


def _pose(stamp_ns: int, frame_id: str, point_m: np.ndarray, covariance_m2: np.ndarray) -> bytes:
    stream = Stream()
    stream.header(stamp_ns, frame_id)
    stream.add("d", *point_m, 0.0, 0.0, 0.0, 0.0, 1.0)  # the identity quaternion
    covariance = np.diag([0.0, 0.0, 0.0, _UNKNOWN_RAD2, _UNKNOWN_RAD2, _UNKNOWN_RAD2])
    covariance[:2, :2] = covariance_m2
    stream.add("d", *covariance.ravel())
    return stream.done()


def _ellipse(stamp_ns: int, frame_id: str, point_m: np.ndarray, covariance_m2: np.ndarray) -> bytes:
    ellipse = confidence_ellipse(point_m, covariance_m2, 0.95)
    half_rad = ellipse.angle_rad / 2.0
    stream = Stream()
    _begin_marker(stream, stamp_ns, frame_id, _ADD)
    stream.add("d", *point_m, 0.0, 0.0, 0.0, math.sin(half_rad), math.cos(half_rad))
    stream.add("d", *(2.0 * ellipse.semi_axes), _THICKNESS_M)
    _end_marker(stream)
    return stream.done()


def _no_ellipse(stamp_ns: int, frame_id: str) -> bytes:
    stream = Stream()
    _begin_marker(stream, stamp_ns, frame_id, _DELETE)
    stream.add("d", 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    stream.add("d", 0.0, 0.0, 0.0)
    _end_marker(stream)
    return stream.done()


def _begin_marker(stream: Stream, stamp_ns: int, frame_id: str, action: int) -> None:
    """Begin an array of one marker."""
    stream.add("I", 1)
    stream.header(stamp_ns, frame_id)
    stream.text("fingerpost")
    stream.add("i", 0, _CYLINDER, action)


def _end_marker(stream: Stream) -> None:
    """Add the fields after pose and scale: colour, lifetime, and fields unused by a cylinder."""
    stream.add("f", *_COLOUR)
    stream.add("i", _LIFETIME_S)
    stream.add("I", 0)
    stream.add("B", 0)  # frame_locked
    stream.add("I", 0, 0)  # points, colors
    stream.text("")  # texture_resource
    stream.header(0, "")  # texture
    stream.text("")
    stream.add("I", 0)
    stream.add("I", 0)  # uv_coordinates
    stream.text("")  # text
    stream.text("")  # mesh_resource
    stream.text("")  # mesh_file
    stream.add("I", 0)
    stream.add("B", 0)  # mesh_use_embedded_materials
