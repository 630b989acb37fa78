"""Writes recordings that are dropped onto the page to the folder in which a rig is set up."""

from __future__ import annotations

import filecmp
from collections.abc import AsyncIterator
from pathlib import Path, PurePosixPath

from starlette.requests import ClientDisconnect, Request
from starlette.responses import PlainTextResponse, Response

from fingerpost.live.hub import Hub
from fingerpost.live.setup.offers import FILMS

LARGEST_BYTES = 4 << 30
"""Longest recording that is accepted."""

CONTENT_TYPE = "application/octet-stream"
"""Content type that forms of other sites cannot send."""


async def take(request: Request, hub: Hub) -> Response:
    """Write an upload to a file and offer it as a view; refuse files that are not recordings."""
    folder = hub.drop_folder
    name = PurePosixPath(request.path_params["name"]).name
    if folder is None:
        return _refused(409, "a rig is not being set up")
    if request.headers.get("content-type") != CONTENT_TYPE:
        return _refused(415, f"content-type is to be {CONTENT_TYPE}")
    if not name.isprintable() or name.startswith(".") or Path(name).suffix.lower() not in FILMS:
        return _refused(415, f"{name[:80]!r} is no recording; {', '.join(sorted(FILMS))} are")
    path = folder / name
    part = path.with_name(f".{name}.part")
    try:
        if not await _written(request.stream(), part):
            return _refused(413, f"{name[:80]!r} is longer than {LARGEST_BYTES >> 30} GiB")
        path = _kept(part, path)
    except ClientDisconnect:
        return _refused(400, f"{name[:80]!r} has not come whole")
    except OSError as error:
        return _refused(507, f"{name[:80]!r} cannot be written: {error.strerror}")
    finally:
        part.unlink(missing_ok=True)
    hub.dropped(path.absolute())
    return PlainTextResponse(str(path.absolute()))


async def _written(chunks: AsyncIterator[bytes], part: Path) -> bool:
    """Write chunks to a file; return whether they are within the size limit."""
    length = 0
    with part.open("wb") as file:
        async for chunk in chunks:
            length += len(chunk)
            if length > LARGEST_BYTES:
                return False
            file.write(chunk)
    return True


def _kept(part: Path, path: Path) -> Path:
    """Rename the written file, with another name if its own is taken by another file."""
    number = 1
    free = path
    while free.exists():
        if filecmp.cmp(part, free, shallow=False):
            return free  # it was dropped from this folder, or a second time
        number += 1
        free = path.with_stem(f"{path.stem}-{number}")
    part.replace(free)
    return free


def _refused(status: int, words: str) -> Response:
    return PlainTextResponse(f"{words}\n", status)
