"""The command line with a terminal, as a person meets it; needs POSIX terminals."""

import os
import pty
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from patience import PATIENCE_S

THE_END = r"(?!)"  # a pattern that nothing has


class Terminal:
    """A program that has a terminal as its stderr, and as its stdout too if that is wanted."""

    def __init__(self, *arguments: object, both: bool = False, **options: bool) -> None:
        self._terminal, end = pty.openpty()
        command = [sys.executable, "-m", "fingerpost", *map(str, arguments)]
        out = end if both else subprocess.PIPE
        self.process = subprocess.Popen(command, stdout=out, stderr=end, text=True, **options)
        os.close(end)

    def read_until(self, pattern: str) -> str:
        """What the program says until the pattern is found, or until it ends."""
        said = ""
        while not re.search(pattern, said):
            try:
                data = os.read(self._terminal, 4096)
            except OSError:  # Linux says so where nobody writes any more
                data = b""
            if not data:
                break
            said += data.decode()
        return said

    def end(self) -> tuple[int, str]:
        """Exit code and stdout of the program, once it has ended."""
        out, _ = self.process.communicate(timeout=PATIENCE_S)
        return self.process.returncode, out

    def close(self) -> None:
        self.process.kill()
        self.process.communicate()
        os.close(self._terminal)


@contextmanager
def on_a_terminal(*arguments: object, **options: bool) -> Iterator[Terminal]:
    """Run `fingerpost` with arguments on a terminal, and see to it that it ends."""
    terminal = Terminal(*arguments, **options)
    try:
        yield terminal
    finally:
        terminal.close()
