"""Films and pictures for tests of what is read: no two of their frames are alike."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

Picture = NDArray[np.uint8]

SIZE_PX = (160, 128)


def textured(count: int, *, seed: int = 0) -> list[Picture]:
    """Pictures of a textured table under which a bright square moves, no two alike."""
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
    """Write a film; its name says in which container."""
    height, width = pictures[0].shape[:2]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*fourcc), fps, (width, height))
    assert writer.isOpened()
    for picture in pictures:
        writer.write(picture)
    writer.release()
    return path
