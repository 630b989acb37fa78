"""Import of vendors' optional libraries, without their output."""

from __future__ import annotations

import io
import logging
import sys
from contextlib import redirect_stdout
from types import ModuleType

from fingerpost.installation import require

logger = logging.getLogger(__name__)


def require_silently(module: str, extra: str) -> ModuleType:
    """Import a vendor's library without its messages on standard output.

    Anything that it prints or logs there, now and later, is passed to this module's logger.

    Parameters
    ----------
    module, extra : str
        As for `fingerpost.installation.require`.

    Raises
    ------
    MissingExtraError
        As `fingerpost.installation.require`.
    """
    output = _LoggedOutput()
    with redirect_stdout(output):
        library = require(module, extra)
    _silence(module.partition(".")[0], output)
    return library


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
        """As `print`, but with this stream in place of standard output."""
        to_stdout = file is None or file is sys.stdout
        print(*values, sep=sep, end=end, file=self if to_stdout else file, flush=flush)  # type: ignore[call-overload]


def _silence(package: str, output: _LoggedOutput) -> None:
    """Redirect the output and logs of a package's modules from standard output to a stream."""
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
