"""Tables and videos from a recording, without tracking again."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.PointsAnnotation_pb2 import PointsAnnotation
from numpy.typing import NDArray

from fingerpost.errors import SourceError
from fingerpost.mcap_file import (
    FIX_TOPIC,
    FRAMES_TOPIC,
    About,
    Channel,
    Message,
    Records,
    Together,
    annotations_topic,
    image_topic,
    read_about,
    track_topic,
)
from fingerpost.recording.parquet import SUFFIX, write_parquet
from fingerpost.recording.sheet import Colour, Image, Sheet
from fingerpost.recording.tables import PointRow, TableWriter, TrackRow
from fingerpost.recording.tables import Row as AnyRow
from fingerpost.recording.video import VideoWriter

Row = TypeVar("Row")

_HELD = 64
"""Number of images of a view that may wait for their annotations: 2 s at 30 frames a second."""


def recorded_rows(path: Path, topics: set[str], kind: type[Row]) -> Iterator[Row]:
    """Yield the rows of a recording under some topics, in order.

    Raises
    ------
    SourceError
        The file cannot be read, is not an MCAP file, or a row cannot be parsed.
    """
    for topic, message in _messages(path):
        if topic in topics:
            try:
                yield msgspec.json.decode(message.data, type=kind)
            except msgspec.MsgspecError as error:
                raise SourceError(f"{path}: {topic} cannot be understood: {error}") from error


def recorded_points(path: Path) -> Iterator[PointRow]:
    """Yield the fixes of a recording; raises as `recorded_rows`."""
    return recorded_rows(path, {FIX_TOPIC}, PointRow)


def recorded_tracks(path: Path) -> Iterator[TrackRow]:
    """Yield the finger lines of a recording; raises as `recorded_rows`."""
    about, _ = read_about(path)
    return recorded_rows(path, {track_topic(view) for view in about.views}, TrackRow)


def export_table(path: Path, table: Path, rows: Iterator[AnyRow], row_type: type[AnyRow]) -> int:
    """Write rows of a recording as a table: Parquet or CSV, by the name's suffix.

    Parameters
    ----------
    path
        The recording.
    table
        The table.
    rows, row_type
        Its rows, and their type.

    Returns
    -------
    int
        Number of rows.

    Raises
    ------
    SourceError
        The file cannot be read, or is not a recording of fingerpost.
    InvalidInputError, RecordingError
        The table cannot be written.
    MissingExtraError
        The extra `parquet` is needed and not installed.
    """
    about, _ = read_about(path)
    read = list(rows)  # first, so that an unreadable recording does not destroy an existing table
    if table.suffix == SUFFIX:
        said = {
            "fingerpost": about.version,
            "unit": about.unit,
            "started": about.started,
            "recording": path.name,
        }
        write_parquet(table, read, row_type, unit=about.unit, about=said)
        return len(read)
    with TableWriter(table, row_type) as writer:
        for row in read:
            writer.write(row)
    return len(read)


def export_video(path: Path, video: Path) -> int:
    """Write the views of a recording side by side, with their annotations.

    Parameters
    ----------
    path
        The recording.
    video
        The video, as for `VideoWriter`.

    Returns
    -------
    int
        Number of pictures.

    Raises
    ------
    SourceError
        The file cannot be read, or is not a recording of fingerpost.
    InvalidInputError, RecordingError
        The video cannot be written.
    """
    about, _ = read_about(path)
    has_fixes = next(iter(recorded_points(path)), None) is not None
    count = 0
    with VideoWriter(video, fps=None) as writer:
        for time_s, picture in _pictures(path, about, has_fixes=has_fixes):
            writer.write(picture, time_s)
            count += 1
    return count


class _View:
    """Images of a view that wait for annotations, and the one that is shown."""

    def __init__(self) -> None:
        self._images: deque[CompressedImage] = deque(maxlen=_HELD)
        self._drawn: ImageAnnotations | None = None
        self._shown: CompressedImage | None = None

    def add(self, image: CompressedImage, *, shows: bool) -> None:
        self._images.append(image)
        if shows:
            self._shown = image

    def annotate(self, drawn: ImageAnnotations) -> None:
        at_ns = drawn.timestamp.ToNanoseconds()
        for image in self._images:
            if image.timestamp.ToNanoseconds() == at_ns:
                self._shown, self._drawn = image, drawn

    def picture(self) -> Image | None:
        """Return the image with its annotations; None before the first."""
        import cv2

        if self._shown is None:
            return None
        image = cv2.imdecode(np.frombuffer(self._shown.data, np.uint8), cv2.IMREAD_COLOR)
        if image is None:
            return None
        sheet = Sheet(np.asarray(image, np.uint8), np.eye(2, 3))
        if self._drawn is not None:
            _draw(sheet, self._drawn)
        return sheet.pixels


def _pictures(path: Path, about: About, *, has_fixes: bool) -> Iterator[tuple[float, Image]]:
    views = {view: _View() for view in about.views}
    images = {image_topic(view): view for view in about.views}
    drawings = {annotations_topic(view): view for view in about.views}
    for topic, message in _messages(path):
        if topic in images:
            views[images[topic]].add(CompressedImage.FromString(message.data), shows=not has_fixes)
        elif topic in drawings:
            views[drawings[topic]].annotate(ImageAnnotations.FromString(message.data))
        elif topic == (FIX_TOPIC if has_fixes else FRAMES_TOPIC):
            pictures = [
                picture for view in views.values() if (picture := view.picture()) is not None
            ]
            if len(pictures) == len(views):
                yield _time_s(message.data, has_fixes=has_fixes), _side_by_side(pictures)


def _time_s(data: bytes, *, has_fixes: bool) -> float:
    if has_fixes:
        return msgspec.json.decode(data, type=PointRow).time_s
    together = msgspec.json.decode(data, type=Together)
    return next(seen.time_s for seen in together.frames if seen is not None)


def _side_by_side(pictures: list[Image]) -> Image:
    height = max(picture.shape[0] for picture in pictures)
    return np.hstack(
        [np.pad(one, ((0, height - one.shape[0]), (0, 0), (0, 0))) for one in pictures]
    )


def _draw(sheet: Sheet, drawn: ImageAnnotations) -> None:
    for part in drawn.points:
        points = np.array([[point.x, point.y] for point in part.points]).reshape(-1, 2) - 0.5
        colour, width = _colour(part.outline_color), max(1, round(part.thickness))
        if part.type == PointsAnnotation.POINTS:
            for point in points:
                sheet.dot(point, max(1.0, part.thickness), colour)
        else:
            sheet.line(_joined(part.type, points), colour, width)
    for text in drawn.texts:
        for k, words in enumerate(text.text.splitlines()):
            place = text.position.x, text.position.y + 1.3 * k * text.font_size
            sheet.text(words, place, round(text.font_size), _colour(text.text_color))


def _joined(kind: int, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the points of a line, interrupted by NaN."""
    if kind == PointsAnnotation.LINE_LOOP:
        return np.concatenate([points, points[:1]])
    if kind == PointsAnnotation.LINE_LIST:
        pairs = points[: len(points) // 2 * 2].reshape(-1, 2, 2)
        gaps = np.full((len(pairs), 1, 2), np.nan)
        return np.concatenate([pairs, gaps], axis=1).reshape(-1, 2)
    return points


def _colour(colour: Any) -> Colour:
    return round(255 * colour.b), round(255 * colour.g), round(255 * colour.r)


def _messages(path: Path) -> Iterator[tuple[str, Message]]:
    topics: dict[int, str] = {}
    for record in Records(path):
        if isinstance(record, Channel):
            topics[record.id] = record.topic
        elif isinstance(record, Message) and record.channel_id in topics:
            yield topics[record.channel_id], record
