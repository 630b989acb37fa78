"""One tree of exceptions for the whole package.

Every error that fingerpost raises on purpose is a `FingerpostError`; where a built-in class
applies as well (`ValueError`, `OSError`, `ImportError`), the class derives from both. A lost hand
is not an error but a status (`fingerpost.pointing.Status`).
"""


class FingerpostError(Exception):
    """Base of every error that fingerpost raises on purpose."""


class InvalidInputError(FingerpostError, ValueError):
    """A value given by the caller cannot be used; the message names it and a usable one."""


class DegenerateReferencePointsError(InvalidInputError):
    """Reference points that determine no homography: collinear, repeated or not finite."""


class RigError(InvalidInputError):
    """A rig file that cannot be used; the message names the key's path and what would be right."""


class CaptureError(FingerpostError, OSError):
    """A view's source cannot be opened or read."""


class SourceError(CaptureError, InvalidInputError):
    """A view's source that is missing, cannot be opened, or is of a kind that cannot be read."""


class RecordingError(FingerpostError, OSError):
    """Writing a table, a picture or a video failed: a full disk, a lost drive."""


class MissingExtraError(FingerpostError, ImportError):
    """An optional part is not installed; the message holds the command that installs it."""
