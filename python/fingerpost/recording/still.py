"""A picture as a file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fingerpost.errors import InvalidInputError


def write_picture(path: Path, image: NDArray[np.uint8]) -> None:
    """Write an image into a file; the name's ending says how.

    Parameters
    ----------
    path
        In an existing folder; one that exists is replaced.
    image : (H, W) or (H, W, 3)
        Grey levels, or blue, green and red.

    Raises
    ------
    InvalidInputError
        A name whose ending OpenCV does not know, or a file that cannot be written.
    """
    import cv2

    try:
        encoded, data = cv2.imencode(path.suffix, image)
    except cv2.error:
        encoded = False
    if not encoded:
        raise InvalidInputError(
            f"{path}: OpenCV cannot write such images; a name that ends in .png is right"
        )
    try:
        path.write_bytes(data.tobytes())
    except OSError as error:
        raise InvalidInputError(
            f"{path}: cannot be written: {error.strerror}; name a file in an existing folder"
        ) from error
