"""Estimates the point on a plane at which a hand points, with its covariance.

Two or more ordinary cameras, four reference points on the plane, a pointing hand. Nothing is
calibrated. See `track` for the whole pipeline, `Pointer` for images that a program pushes, and
`ContourTracker` for one view.

Names are imported on first use, so that the command line starts at once.
"""

from importlib import import_module

TYPE_CHECKING = False  # checkers know the name; to import `typing` would take longer than all else

if TYPE_CHECKING:
    __version__: str
    from fingerpost._core import ContourTracker, StartPose, Template
    from fingerpost.capture import Frame
    from fingerpost.config import Plane, Rig, View
    from fingerpost.errors import FingerpostError
    from fingerpost.live import show
    from fingerpost.operators import Operator
    from fingerpost.pipeline import Pointer, track
    from fingerpost.pointing import Fix, Status
    from fingerpost.selection import Selector

__all__ = [
    "ContourTracker",
    "FingerpostError",
    "Fix",
    "Frame",
    "Operator",
    "Plane",
    "Pointer",
    "Rig",
    "Selector",
    "StartPose",
    "Status",
    "Template",
    "View",
    "__version__",
    "show",
    "track",
]

_HOMES = {
    "ContourTracker": "_core",
    "FingerpostError": "errors",
    "Fix": "pointing",
    "Frame": "capture",
    "Operator": "operators",
    "Plane": "config",
    "Pointer": "pipeline",
    "Rig": "config",
    "Selector": "selection",
    "StartPose": "_core",
    "Status": "pointing",
    "Template": "_core",
    "View": "config",
    "show": "live",
    "track": "pipeline",
}


def __getattr__(name: str) -> object:
    if name == "__version__":
        return import_module("importlib.metadata").version(__name__)
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
