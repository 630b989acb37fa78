"""Import of MuJoCo, an optional dependency, and its rendering without a screen."""

from __future__ import annotations

import importlib
import os
import sys
from types import ModuleType
from typing import Any

from fingerpost.errors import MissingExtraError

EXTRA = "mujoco"

_NOTHING_DRAWS = (
    "nothing can be drawn off the screen: EGL is missing; install it with: "
    "apt install libegl1 libgl1 libgl1-mesa-dri"
)

OFFSCREEN = "egl"
"""Rendering on Linux without a screen or a graphics card: EGL on Mesa's software rasteriser. The
Debian packages are libegl1, libgl1 and libgl1-mesa-dri."""


def require_mujoco() -> ModuleType:
    """Import MuJoCo, configured for off-screen rendering.

    MuJoCo reads the variable ``MUJOCO_GL`` once, when it is imported; it is set here unless the
    user has set it.

    Raises
    ------
    MissingExtraError
        MuJoCo, or its renderer, is not installed; the message contains the command to install it.
    """
    if sys.platform == "linux" and "mujoco" not in sys.modules:
        os.environ.setdefault("MUJOCO_GL", OFFSCREEN)
    try:
        engine = importlib.import_module("mujoco")
        importlib.import_module("mujoco.gl_context")
    except ImportError as error:
        raise MissingExtraError(
            f"MuJoCo is not installed; install it with: pip install 'fingerpost[{EXTRA}]'"
        ) from error
    except (AttributeError, OSError) as error:  # PyOpenGL's errors without EGL
        raise MissingExtraError(_NOTHING_DRAWS) from error
    return engine


def new_renderer(model: Any, width_px: int, height_px: int) -> Any:
    """Return a `mujoco.Renderer` for pictures of this size.

    Raises
    ------
    MissingExtraError
        EGL has no driver; the message contains the command to install one.
    """
    try:
        return require_mujoco().Renderer(model, height_px, width_px)
    except (ImportError, RuntimeError) as error:
        raise MissingExtraError(_NOTHING_DRAWS) from error
