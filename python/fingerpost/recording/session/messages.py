"""Messages of a recording, in schemas that viewers know (Foxglove).

Annotations are for display: their coordinates are rounded to 1/64 px, so that they compress well.
Exact data are in `/frames`, from which all others can be recomputed. In Foxglove the origin is the
corner of the first pixel, in fingerpost its centre.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.Point2_pb2 import Point2
from foxglove_schemas_protobuf.Point3_pb2 import Point3
from foxglove_schemas_protobuf.PointsAnnotation_pb2 import PointsAnnotation
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.TextAnnotation_pb2 import TextAnnotation
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.timestamp_pb2 import Timestamp
from numpy.typing import NDArray

from fingerpost.lens import Lens
from fingerpost.pointing import FingerLine, Fix, PlaneView
from fingerpost.recording.picture.marks import Observed, status_of
from fingerpost.recording.picture.palette import INK, NORMAL, POINT, REJECTED, STATUSES, colour_of
from fingerpost.recording.sheet import Colour

Points = NDArray[np.float64]

PLANE_FRAME = "plane"
_GRAIN_PX = 64.0
_TYPE_PX = 14.0
# One point as protobuf writes it as an element of `PointsAnnotation.points`: field 3 of 18 bytes
# with the doubles x and y. A contour has hundreds; built one by one they would cost 0.3 ms a view.
_POINT = np.dtype(
    [("field", "u1"), ("size", "u1"), ("of_x", "u1"), ("x", "<f8"), ("of_y", "u1"), ("y", "<f8")]
)
_POINT_HEADS = {"field": 0x1A, "size": 18, "of_x": 0x09, "of_y": 0x11}


def stamp(time_ns: int) -> Timestamp:
    """Convert a time [ns] to protobuf."""
    seconds, nanos = divmod(time_ns, 10**9)
    return Timestamp(seconds=seconds, nanos=nanos)


def compressed_image(view: str, time_ns: int, data: bytes, image_format: str) -> CompressedImage:
    """Return an image; `image_format` is "jpeg" or "png"."""
    return CompressedImage(timestamp=stamp(time_ns), frame_id=view, data=data, format=image_format)


def pose_in(
    frame: str,
    time_ns: int,
    position_m: Iterable[float],
    orientation: Iterable[float],
) -> PoseInFrame:
    """Return a pose in a frame: position x, y, z [m] and quaternion x, y, z, w."""
    (x, y, z), (qx, qy, qz, qw) = position_m, orientation
    return PoseInFrame(
        timestamp=stamp(time_ns),
        frame_id=frame,
        pose=Pose(position=Vector3(x=x, y=y, z=z), orientation=Quaternion(x=qx, y=qy, z=qz, w=qw)),
    )


def calibration(
    view: str, time_ns: int, size_px: tuple[int, int], lens: Lens | None
) -> CameraCalibration:
    """Return a view's lens; an unknown one has a zero matrix, as viewers expect."""
    message = CameraCalibration(
        timestamp=stamp(time_ns), frame_id=view, width=size_px[0], height=size_px[1]
    )
    if lens is None:
        matrix = np.zeros((3, 3))
    else:
        matrix = np.array([[lens.fx, 0.0, lens.cx], [0.0, lens.fy, lens.cy], [0.0, 0.0, 1.0]])
        message.distortion_model = "plumb_bob"
        message.D.extend([lens.k1, lens.k2, 0.0, 0.0, 0.0])
    message.K.extend(matrix.ravel())
    message.R.extend(np.eye(3).ravel())
    message.P.extend(np.column_stack([matrix, np.zeros(3)]).ravel())
    return message


def drawn_over(
    observed: Observed, index: int, time_ns: int, plane_view: PlaneView, whole_from_seen: Points
) -> ImageAnnotations:
    """Return the annotations of a view's image: contour, search, finger line, reference points.

    Parameters
    ----------
    observed
        Result of the view.
    index
        Its index in the rig, which determines its colour.
    time_ns
        Time of the image [ns].
    plane_view
        Homography of the view.
    whole_from_seen : (3, 3)
        Transform from pixels of `observed` to those of the image, if it was reduced.
    """
    status, colour = status_of(observed), colour_of(index)
    message = ImageAnnotations(timestamp=stamp(time_ns))

    def add(kind: Any, points_px: Points, colour: Colour, thickness: float) -> None:
        points = np.asarray(points_px, np.float64).reshape(-1, 2)
        if len(points):
            part = _points(points @ whole_from_seen[:2, :2].T + whole_from_seen[:2, 2])
            part.timestamp.CopyFrom(message.timestamp)
            part.type = kind
            part.outline_color.CopyFrom(_color(colour))
            part.thickness = thickness
            message.points.append(part)

    search = observed.search
    found = np.isfinite(search.edges_px).all(axis=1)
    add(PointsAnnotation.LINE_LIST, search.lines_px, NORMAL, 0.5)
    add(PointsAnnotation.POINTS, search.edges_px[found & search.agrees], colour, 2.0)
    add(PointsAnnotation.POINTS, search.edges_px[found & ~search.agrees], REJECTED, 2.0)
    add(PointsAnnotation.LINE_LOOP, observed.contour_px, colour, 1.5)
    if isinstance(observed.finger, FingerLine):
        line = observed.finger
        along = line.tip_px - line.anchor_px
        add(
            PointsAnnotation.LINE_LIST,
            np.array([line.anchor_px - along, line.tip_px + 2 * along]),
            INK,
            1.0,
        )
    add(PointsAnnotation.LINE_LOOP, plane_view.project(plane_view.plane_points), NORMAL, 1.0)
    words = "\n".join([status, *observed.reasons])
    message.texts.append(
        TextAnnotation(
            timestamp=message.timestamp,
            position=Point2(x=4.0, y=4.0 + _TYPE_PX),
            text=words,
            font_size=_TYPE_PX,
            text_color=_color(STATUSES[status]),
        )
    )
    return message


def plane_scene(fix: Fix, plane_view: PlaneView, time_ns: int) -> SceneUpdate:
    """Return the plane: its reference points, constraint lines, indicated point and 95 % ellipse.

    Coordinates are plane units, in the frame "plane".
    """
    size = plane_view.plane_size
    middle = plane_view.plane_points.mean(axis=0)
    entity = SceneEntity(timestamp=stamp(time_ns), frame_id=PLANE_FRAME, id="fix")
    lines = entity.lines
    lines.append(_line(LinePrimitive.LINE_LOOP, plane_view.plane_points, NORMAL))
    for k, constraint in enumerate(fix.constraint_lines):
        if constraint is not None:
            normal = constraint.line[:2]
            foot = middle - (constraint.line @ [*middle, 1.0]) * normal
            along = size * np.array([-normal[1], normal[0]])
            ends = np.array([foot - along, foot + along])
            lines.append(_line(LinePrimitive.LINE_LIST, ends, colour_of(k)))
    if fix.point is not None:
        x, y = fix.point.tolist()
        reach = 0.02 * size
        cross = [[x - reach, y], [x + reach, y], [x, y - reach], [x, y + reach]]
        lines.append(_line(LinePrimitive.LINE_LIST, cross, POINT))
    ellipse = fix.ellipse()
    if ellipse is not None:
        lines.append(_line(LinePrimitive.LINE_LOOP, ellipse.polygon(), POINT))
    return SceneUpdate(entities=[entity])


def _line(kind: Any, points: Points | Sequence[Sequence[float]], colour: Colour) -> LinePrimitive:
    corners = [Point3(x=x, y=y) for x, y in np.asarray(points).tolist()]
    return LinePrimitive(
        type=kind, points=corners, color=_color(colour), thickness=2.0, scale_invariant=True
    )


def _points(points_px: Points) -> PointsAnnotation:
    rows = np.empty(len(points_px), _POINT)
    for name, value in _POINT_HEADS.items():
        rows[name] = value
    rows["x"], rows["y"] = np.rint((points_px + 0.5).T * _GRAIN_PX) / _GRAIN_PX
    return PointsAnnotation.FromString(rows.tobytes())


def _color(colour: Colour) -> Color:
    blue, green, red = colour
    return Color(r=red / 255, g=green / 255, b=blue / 255, a=1.0)
