"""The command line on a pseudo-terminal; needs POSIX."""

import os
import pty
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

from patience import PATIENCE_S

RESEND_AFTER_S = 10.0
"""A second Ctrl-C while a program ends would take its exit code, and ending takes a while."""

THE_END = r"(?!)"  # a pattern that never matches


class Terminal:
    """A program with a terminal as its stderr, and as stdout if `both` and stdin if `asks`."""

    def __init__(
        self, *arguments: object, both: bool = False, asks: bool = False, **options: Any
    ) -> None:
        self._terminal, end = pty.openpty()
        command = [sys.executable, "-m", "fingerpost", *map(str, arguments)]
        out = end if both else subprocess.PIPE
        if asks:
            options["stdin"] = end
        self.process = subprocess.Popen(command, stdout=out, stderr=end, text=True, **options)
        os.close(end)

    def answer(self, words: str) -> None:
        """Type a line."""
        os.write(self._terminal, f"{words}\n".encode())

    def read_until(self, pattern: str) -> str:
        """Return the program's output until the pattern is found, or until it ends."""
        said = ""
        while not re.search(pattern, said):
            try:
                data = os.read(self._terminal, 4096)
            except OSError:  # on Linux, the other end is closed
                data = b""
            if not data:
                break
            said += data.decode()
        return said

    def interrupt(self) -> None:
        """Press Ctrl-C at a prompt until the program ends.

        Python ignores one that comes between showing a prompt and waiting for its answer.
        """
        while self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
            with suppress(subprocess.TimeoutExpired):
                self.process.wait(RESEND_AFTER_S)

    def end(self) -> tuple[int, str]:
        """Wait for the program to end; return its exit code and stdout."""
        out, _ = self.process.communicate(timeout=PATIENCE_S)
        return self.process.returncode, out

    def close(self) -> None:
        self.process.kill()
        self.process.communicate()
        os.close(self._terminal)


@contextmanager
def on_a_terminal(*arguments: object, **options: Any) -> Iterator[Terminal]:
    """Run `fingerpost` with arguments on a terminal, and kill it in the end."""
    terminal = Terminal(*arguments, **options)
    try:
        yield terminal
    finally:
        terminal.close()
