"""Length of a video as its container states it.

Only MP4 and AVI store a frame count. For others FFmpeg derives one from the duration, which sound,
chapters and rounding extend: an intact Matroska or FLV file may hold fewer frames. Truncation of
such a file is detected by the sizes stored in its parts.
"""

from __future__ import annotations

from pathlib import Path

_EBML, _EBML_SEGMENT = b"\x1a\x45\xdf\xa3", b"\x18\x53\x80\x67"
_FLV, _FLV_TAG_HEAD = b"FLV", 11


def is_avi(path: Path) -> bool:
    """Return whether a file is an AVI."""
    head = _head(path)
    return head[:4] == b"RIFF" and head[8:12] == b"AVI "


def states_frame_count(path: Path) -> bool:
    """Return whether the container of a file stores its frame count, as MP4 and AVI do."""
    return is_avi(path) or _head(path)[4:8] == b"ftyp"


def is_cut_off(path: Path) -> bool:
    """Return whether a Matroska or FLV file is shorter than it states; False for all others."""
    head, size = _head(path), path.stat().st_size
    if head.startswith(_EBML):
        return size < _matroska_size(head)
    if head.startswith(_FLV):
        return _flv_lacks_end(path, size)
    return False


def _head(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(4096)


def _matroska_size(head: bytes) -> int:
    """Return the size of a Matroska file by its header; 0 if unstated, as in live recordings."""
    place = head.find(_EBML_SEGMENT)
    if place < 0 or place + 12 > len(head):
        return 0
    first = head[place + 4]
    length = 9 - first.bit_length()
    if length > 8:
        return 0
    size = int.from_bytes(head[place + 4 : place + 4 + length], "big") & ~(1 << (7 * length))
    is_unknown = size == (1 << (7 * length)) - 1
    return 0 if is_unknown else place + 4 + length + size


def _flv_lacks_end(path: Path, size: int) -> bool:
    """Return whether an FLV file is truncated: an intact one ends with the size of its last tag."""
    with path.open("rb") as file:
        file.seek(size - 4)
        last = int.from_bytes(file.read(4), "big")
        if not _FLV_TAG_HEAD <= last <= size - 4:
            return True
        file.seek(size - 4 - last)
        head = file.read(_FLV_TAG_HEAD)
    return int.from_bytes(head[1:4], "big") + _FLV_TAG_HEAD != last
