"""A picture as a file."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fingerpost.checks import opencv_path
from fingerpost.errors import InvalidInputError


def check_picture(path: Path) -> None:
    """Refuse a file that `write_picture` could not write, before the work that leads to it.

    Raises
    ------
    InvalidInputError
        A name that cannot be passed to OpenCV or has an ending it does not know, a folder that does
        not exist, or a name that is a folder's.
    """
    _encoded(path, np.zeros((2, 2, 3), np.uint8))
    # Path.is_dir would raise where a name is too long to exist.
    if not os.path.isdir(path.parent):  # noqa: PTH112
        raise InvalidInputError(
            f"{path}: the folder {path.parent} does not exist; name a file in an existing folder"
        )
    if os.path.isdir(path):  # noqa: PTH112
        raise InvalidInputError(f"{path}: is a folder; the name of a picture is needed")


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
        A name whose ending OpenCV does not know or cannot be passed, or a file that cannot be
        written.
    """
    data = _encoded(path, image)
    try:
        path.write_bytes(data)
    except OSError as error:
        raise InvalidInputError(
            f"{path}: cannot be written: {error.strerror}; name a file in an existing folder"
        ) from error


def _encoded(path: Path, image: NDArray[np.uint8]) -> bytes:
    """Return the content of an image file; the name's ending says of which kind."""
    import cv2

    ending = opencv_path(Path(path.suffix), "picture")
    try:
        encoded, data = cv2.imencode(ending, image)
    except cv2.error:
        encoded = False
    if not encoded:
        raise InvalidInputError(
            f"{path}: OpenCV cannot write such images; a name that ends in .png is right"
        )
    return data.tobytes()
