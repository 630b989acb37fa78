"""Check that the outputs of a command are distinct from each other and from its inputs."""

from __future__ import annotations

import os
from collections.abc import Hashable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from fingerpost.errors import InvalidInputError

if TYPE_CHECKING:
    from fingerpost.config import Rig


def keep_apart(outputs: Mapping[str, Path | None], inputs: Iterable[tuple[str, Path]]) -> None:
    """Refuse outputs that are the same file, under any names, or that are an input.

    Parameters
    ----------
    outputs
        Files to be written, by the option that names each; None for none.
    inputs
        Files to be read, each with a description.

    Raises
    ------
    InvalidInputError
        Two outputs, or an output and an input, are the same file; the message names both.
    """
    written = {option: path for option, path in outputs.items() if path is not None}
    nowhere = _identity(Path(os.devnull))  # may be named by any number of outputs
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
    """Yield the files that a rig is read from: its own, and the footage of its views."""
    from fingerpost.capture import source_files

    yield "the rig file", rig_file
    for name, source in rig.sources.items():
        for path in source_files(source):
            yield f'footage of view "{name}"', path


def _identity(path: Path) -> Hashable:
    """Return a key that is equal for all names of one file, whether or not the file exists."""
    try:
        found = path.stat()
    except OSError:
        return os.path.normcase(os.path.realpath(path))
    except ValueError:  # not a valid file name
        return path
    return found.st_dev, found.st_ino
