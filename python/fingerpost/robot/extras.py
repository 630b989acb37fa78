"""Vendors' libraries that not everybody has, and that not everybody wants to hear."""

from __future__ import annotations

import importlib
import io
import logging
import sys
from contextlib import redirect_stdout
from types import ModuleType

from fingerpost.errors import MissingExtraError

logger = logging.getLogger(__name__)


def require(module: str, extra: str, *, silent: bool = False) -> ModuleType:
    """Import a vendor's library.

    Parameters
    ----------
    module : str
        What to import.
    extra : str
        The extra of this package that brings it.
    silent : bool
        What the library prints, now and later, or logs to standard output, goes to this module's
        logger instead: standard output is the program's.

    Raises
    ------
    MissingExtraError
        It is not installed, or cannot be imported; the message says why, and holds the command
        that installs it.
    """
    try:
        if not silent:
            return importlib.import_module(module)
        output = _LoggedOutput()
        with redirect_stdout(output):
            library = importlib.import_module(module)
        _silence(module.partition(".")[0], output)
        return library
    except Exception as error:
        command = f"pip install 'fingerpost[{extra}]'"
        name = getattr(error, "name", None)
        if isinstance(error, ModuleNotFoundError) and f"{module}.".startswith(f"{name}."):
            problem = f"is not installed; install it with: {command}"
        else:
            problem = (
                f"cannot be imported ({type(error).__name__}: {error}); see to that, or install it "
                f"anew with: {command} --force-reinstall"
            )
        raise MissingExtraError(f"{module} {problem}") from error


class _LoggedOutput(io.TextIOBase):
    """A text stream whose lines are logged."""

    def __init__(self) -> None:
        super().__init__()
        self._begun = ""

    def write(self, text: str, /) -> int:
        *lines, self._begun = f"{self._begun}{text}".split("\n")
        for line in filter(str.strip, lines):
            logger.info("%s", line)
        return len(text)

    def print(
        self,
        *values: object,
        sep: str | None = None,
        end: str | None = None,
        file: object = None,
        flush: bool = False,
    ) -> None:
        """Do what `print` does, but with this stream in place of standard output."""
        to_stdout = file is None or file is sys.stdout
        print(*values, sep=sep, end=end, file=self if to_stdout else file, flush=flush)  # type: ignore[call-overload]


def _silence(package: str, output: _LoggedOutput) -> None:
    """Have the modules of a package print, and log, to another stream than standard output."""
    for name, module in list(sys.modules.items()):
        if name.partition(".")[0] != package or module is None:
            continue
        for value in list(vars(module).values()):
            if isinstance(value, logging.Logger):
                _redirect(value, output)
        vars(module)["print"] = output.print


def _redirect(log: logging.Logger, output: _LoggedOutput) -> None:
    for handler in log.handlers:
        if not isinstance(handler, logging.StreamHandler):
            continue
        if handler.stream in (sys.stdout, sys.__stdout__):
            handler.setStream(output)
        if handler.stream is output:
            log.propagate = False  # it is logged from there, once
