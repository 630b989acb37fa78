"""What a command writes never lies on what it reads, nor on what else it writes."""

from __future__ import annotations

import os
from collections.abc import Hashable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from fingerpost.errors import InvalidInputError

if TYPE_CHECKING:
    from fingerpost.config import Rig


def keep_apart(outputs: Mapping[str, Path | None], inputs: Iterable[tuple[str, Path]]) -> None:
    """Refuse outputs that are one file, by whatever names, or are a file that is read.

    Parameters
    ----------
    outputs
        Everything that will be written, by the option that names it; None where nothing is.
    inputs
        Everything that is read: what it is, and the file.

    Raises
    ------
    InvalidInputError
        Two outputs, or an output and an input, are one file; both are named.
    """
    written = {option: path for option, path in outputs.items() if path is not None}
    nowhere = _identity(Path(os.devnull))  # where any number of outputs may go
    taken: dict[Hashable, tuple[str, Path]] = {}
    for option, path in written.items():
        identity = _identity(path)
        other, other_path = taken.setdefault(identity, (option, path))
        if other != option and identity != nowhere:
            raise InvalidInputError(
                f"{other} {other_path} and {option} {path} are one file; name two"
            )
    read = {_identity(path): (what, path) for what, path in inputs} if written else {}
    for option, path in written.items():
        if (found := read.get(_identity(path))) is not None:
            what, source = found
            raise InvalidInputError(
                f"{option} {path} would overwrite {source}, {what}; name another file"
            )


def rig_files(rig_file: Path, rig: Rig) -> Iterator[tuple[str, Path]]:
    """Give every file that a rig is read from: its own, and the footage of its views."""
    from fingerpost.capture import source_files

    yield "the rig file", rig_file
    for name, source in rig.sources.items():
        for path in source_files(source):
            yield f'footage of view "{name}"', path


def _identity(path: Path) -> Hashable:
    """Return what two names of one file share: the file itself, or the place where it will be."""
    try:
        found = path.stat()
    except OSError:
        return os.path.normcase(os.path.realpath(path))
    except ValueError:  # a name that no file can have
        return path
    return found.st_dev, found.st_ino
