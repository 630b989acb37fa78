"""Vendors' libraries that not everybody has."""

from __future__ import annotations

import importlib
from types import ModuleType

from fingerpost.errors import MissingExtraError


def require(module: str, extra: str) -> ModuleType:
    """Import a vendor's library.

    Parameters
    ----------
    module : str
        What to import.
    extra : str
        The extra of this package that brings it.

    Raises
    ------
    MissingExtraError
        It is not installed; the message holds the command that installs it.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise MissingExtraError(
            f"{module} is not installed; install it with: pip install 'fingerpost[{extra}]'"
        ) from error
