"""Films and pictures for tests of sources; all their frames differ."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

Picture = NDArray[np.uint8]

SIZE_PX = (160, 128)


def textured(count: int, *, seed: int = 0) -> list[Picture]:
    """Return different pictures of a textured table with a bright square that moves over it."""
    width, height = SIZE_PX
    rng = np.random.default_rng(seed)
    table = cv2.GaussianBlur(rng.integers(0, 256, (height, width, 3), np.uint8), (0, 0), 2)
    pictures = []
    for number in range(count):
        picture = np.asarray(table, np.uint8).copy()
        left = 4 + 2 * number % (width - 40)
        picture[40:70, left : left + 30] = (210, 220, 230)
        pictures.append(picture)
    return pictures


def write_film(path: Path, pictures: list[Picture], fourcc: str, *, fps: float = 25.0) -> Path:
    """Write a film; the suffix of its name determines the container."""
    height, width = pictures[0].shape[:2]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*fourcc), fps, (width, height))
    assert writer.isOpened()
    for picture in pictures:
        writer.write(picture)
    writer.release()
    return path
