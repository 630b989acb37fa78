"""The file of a recording: complete data are kept, and every failure is reported.

`flush` writes all data to the disk itself, so that a crash of the machine or a removed memory stick
only costs later data. If writing fails, the file is truncated to the last flush.
"""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

from fingerpost.errors import InvalidInputError, RecordingError

_KEPT = "what was recorded until the last second is there, `fingerpost recover` makes it whole"


class RecordingStream:
    """A new file for a recording; an existing file is not touched.

    Parameters
    ----------
    path
        The file.

    Raises
    ------
    InvalidInputError
        The file exists or cannot be created.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._place = self._whole = 0
        try:
            self._file = path.open("xb", buffering=0)
        except FileExistsError as error:
            raise InvalidInputError(
                f"{path}: is there already; a recording replaces no file, name a new one"
            ) from error
        except (OSError, ValueError) as error:  # ValueError: a name that no file can have
            reason = error.strerror if isinstance(error, OSError) else error
            raise InvalidInputError(
                f"{path}: cannot be written: {reason}; name a file in an existing folder"
            ) from error

    def write(self, data: bytes) -> int:
        """Write all of the data.

        Raises
        ------
        RecordingError
            The disk is full or has been removed.
        """
        left = memoryview(data)
        try:
            while left:
                left = left[self._file.write(left) or 0 :]
        except OSError as error:
            raise self._failed(error) from error
        self._place += len(data)
        return len(data)

    def position(self) -> int:
        """Return the number of bytes written."""
        return self._place

    tell = position  # name in Python's file protocol, which the MCAP writer uses

    def flush(self) -> None:
        """Write all data to the disk.

        Raises
        ------
        RecordingError
            As `write`; or the file has been removed.
        """
        try:
            os.fsync(self._file.fileno())
            links = os.fstat(self._file.fileno()).st_nlink
        except OSError as error:
            raise self._failed(error) from error
        if not links:
            raise RecordingError(f"{self.path}: was removed while it was written; nothing is left")
        self._whole = self._place

    def close(self) -> None:
        """Close the file; closing twice does nothing."""
        self._file.close()

    def discard(self) -> None:
        """Close and remove the file."""
        self.close()
        self.path.unlink(missing_ok=True)

    def _failed(self, error: OSError) -> RecordingError:
        with contextlib.suppress(OSError):
            self._file.truncate(self._whole)
        rest = _KEPT if self._whole else "nothing is left"
        return RecordingError(f"{self.path}: cannot be written any more: {error.strerror}; {rest}")
