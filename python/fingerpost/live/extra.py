"""What the page needs beside fingerpost itself."""

from __future__ import annotations

import importlib

from fingerpost.errors import MissingExtraError

EXTRA = "page"

_MODULES = ("starlette", "uvicorn", "websockets")


def need_extra() -> None:
    """Import what serves the page.

    Raises
    ------
    MissingExtraError
        It is not installed; the message holds the command that installs it.
    """
    for module in _MODULES:
        try:
            importlib.import_module(module)
        except ImportError as error:
            raise MissingExtraError(
                f"{module} cannot be imported ({error}); the page needs: "
                f"pip install 'fingerpost[{EXTRA}]'"
            ) from error
