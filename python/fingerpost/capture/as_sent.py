"""Compressed pictures of cameras and streams, so that a recording can store a JPEG unchanged.

OpenCV decodes pictures and discards the JPEG. Its FFmpeg and V4L2 backends can return packets
instead, which are decoded here. All other backends return decoded pictures.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import cv2

_JPEG_START, _JPEG_END = b"\xff\xd8\xff", b"\xff\xd9"
_FORMAT_PACKETS = -1


def as_sent(capture: cv2.VideoCapture) -> cv2.VideoCapture:
    """Make a camera or stream that sends JPEG return it undecoded; return the capture."""
    import cv2

    if not capture.isOpened() or int(capture.get(cv2.CAP_PROP_FOURCC)) != cv2.VideoWriter.fourcc(
        *"MJPG"
    ):
        return capture
    backend = capture.getBackendName()
    if backend == "FFMPEG":
        capture.set(cv2.CAP_PROP_FORMAT, _FORMAT_PACKETS)
    elif backend == "V4L2":
        capture.set(cv2.CAP_PROP_CONVERT_RGB, 0)
    return capture


def picture_of(sent: NDArray[Any]) -> tuple[NDArray[np.uint8] | None, bytes]:
    """Return a picture and the JPEG it was sent as; the latter is empty if it came decoded.

    Parameters
    ----------
    sent
        Result of OpenCV's `retrieve`: a picture, or the bytes of a JPEG in one row, zero-padded.

    Returns
    -------
    tuple
        The picture is None if the JPEG cannot be decoded or is truncated.
    """
    if sent.shape[0] > 1 or sent[0, :3].tobytes() != _JPEG_START:
        return np.ascontiguousarray(sent, dtype=np.uint8), b""
    data = sent.tobytes()
    data = data[: data.rfind(_JPEG_END) + len(_JPEG_END)]
    return decoded(data), data


def decoded(data: bytes) -> NDArray[np.uint8] | None:
    """Decode a JPEG or PNG of 8 bits to the captured pixels; None if that fails."""
    import cv2

    try:
        image = cv2.imdecode(
            np.frombuffer(data, np.uint8), cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH
        )
    except cv2.error:
        return None
    return None if image is None else np.asarray(image, np.uint8)
