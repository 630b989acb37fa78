"""Writes a picture to a file."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fingerpost.checks import opencv_path
from fingerpost.errors import InvalidInputError


def check_picture(path: Path) -> None:
    """Refuse a file that `write_picture` could not write, before the picture is computed.

    Raises
    ------
    InvalidInputError
        A name that cannot be passed to OpenCV or has an unknown suffix, a folder that does not
        exist, or the name of a folder.
    """
    _encoded(path, np.zeros((2, 2, 3), np.uint8))
    # Path.is_dir would raise for a name that is too long.
    if not os.path.isdir(path.parent):  # noqa: PTH112
        raise InvalidInputError(
            f"{path}: the folder {path.parent} does not exist; name a file in an existing folder"
        )
    if os.path.isdir(path):  # noqa: PTH112
        raise InvalidInputError(f"{path}: is a folder; the name of a picture is needed")


def write_picture(path: Path, image: NDArray[np.uint8]) -> None:
    """Write an image to a file; the name's suffix determines the format.

    Parameters
    ----------
    path
        The file, in an existing folder; an existing file is replaced.
    image : (H, W) or (H, W, 3)
        Grey levels, or blue, green and red.

    Raises
    ------
    InvalidInputError
        A name with a suffix unknown to OpenCV or that cannot be passed to it, or a file that cannot
        be written.
    """
    data = _encoded(path, image)
    try:
        path.write_bytes(data)
    except OSError as error:
        raise InvalidInputError(
            f"{path}: cannot be written: {error.strerror}; name a file in an existing folder"
        ) from error


def _encoded(path: Path, image: NDArray[np.uint8]) -> bytes:
    """Return the content of an image file; the name's suffix determines the format."""
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
