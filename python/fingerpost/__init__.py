"""Tell where on a plane a hand points, and how sure that is.

Two or more ordinary cameras, four reference points on the plane, a pointing hand. Nothing is
calibrated. See `track` for the whole path and `ContourTracker` for one view.

What stands here is imported when it is first used, so that the command line answers at once.
"""

from importlib import import_module

TYPE_CHECKING = False  # checkers know the name; to import `typing` would take longer than all else

if TYPE_CHECKING:
    from fingerpost._core import ContourTracker, StartPose, Template
    from fingerpost.config import Rig
    from fingerpost.errors import FingerpostError
    from fingerpost.pipeline import Pointer, track
    from fingerpost.pointing import Fix, Status

__all__ = [
    "ContourTracker",
    "FingerpostError",
    "Fix",
    "Pointer",
    "Rig",
    "StartPose",
    "Status",
    "Template",
    "track",
]

_HOMES = {
    "ContourTracker": "_core",
    "FingerpostError": "errors",
    "Fix": "pointing",
    "Pointer": "pipeline",
    "Rig": "config",
    "StartPose": "_core",
    "Status": "pointing",
    "Template": "_core",
    "track": "pipeline",
}


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
