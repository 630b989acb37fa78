"""What the containers of videos say of their own length.

Only MP4 and AVI count their frames. For others FFmpeg makes a count of the duration, which sound,
chapters and rounding stretch: a whole Matroska or FLV file may hold fewer frames than that. That
its end is missing is known by the sizes that its parts have in writing.
"""

from __future__ import annotations

from pathlib import Path

_EBML, _EBML_SEGMENT = b"\x1a\x45\xdf\xa3", b"\x18\x53\x80\x67"
_FLV, _FLV_TAG_HEAD = b"FLV", 11


def is_avi(path: Path) -> bool:
    """Tell whether a file is an AVI."""
    head = _head(path)
    return head[:4] == b"RIFF" and head[8:12] == b"AVI "


def states_frame_count(path: Path) -> bool:
    """Tell whether the container of a file counts its frames, as MP4 and AVI do."""
    return is_avi(path) or _head(path)[4:8] == b"ftyp"


def is_cut_off(path: Path) -> bool:
    """Tell whether a Matroska or FLV file is shorter than it says; False for all others."""
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
    """Size of a Matroska file by its head; 0 where it says none, as live recordings do."""
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
    """Every tag is followed by its size: at the end of a whole file that leads back to a tag."""
    with path.open("rb") as file:
        file.seek(size - 4)
        last = int.from_bytes(file.read(4), "big")
        if not _FLV_TAG_HEAD <= last <= size - 4:
            return True
        file.seek(size - 4 - last)
        head = file.read(_FLV_TAG_HEAD)
    return int.from_bytes(head[1:4], "big") + _FLV_TAG_HEAD != last
