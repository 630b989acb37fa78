"""Encodes pictures as JPEG, unless they were received in this format."""

from __future__ import annotations

from fingerpost.errors import CaptureError
from fingerpost.publishing.fix import Picture

_JPEG = b"\xff\xd8"
_QUALITY = 95


def encoded(picture: Picture) -> bytes:
    """Return a picture as a JPEG file.

    Raises
    ------
    CaptureError
        It cannot be encoded.
    """
    if picture.encoded.startswith(_JPEG):
        return picture.encoded
    import cv2

    done, data = cv2.imencode(".jpg", picture.image, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    if not done:
        raise CaptureError(f"a picture of shape {picture.image.shape} cannot be encoded")
    return data.tobytes()
