"""The command line with a terminal, as a person meets it; needs POSIX terminals."""

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

THE_END = r"(?!)"  # a pattern that nothing has


class Terminal:
    """A program that has a terminal as its stderr; as its stdout and its stdin, too, if wanted."""

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

    def interrupt(self) -> None:
        """Press Ctrl-C at a prompt until it is heard.

        Python overlooks one that comes between showing a prompt and waiting for its answer.
        """
        while self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
            with suppress(subprocess.TimeoutExpired):
                self.process.wait(1.0)

    def end(self) -> tuple[int, str]:
        """Exit code and stdout of the program, once it has ended."""
        out, _ = self.process.communicate(timeout=PATIENCE_S)
        return self.process.returncode, out

    def close(self) -> None:
        self.process.kill()
        self.process.communicate()
        os.close(self._terminal)


@contextmanager
def on_a_terminal(*arguments: object, **options: Any) -> Iterator[Terminal]:
    """Run `fingerpost` with arguments on a terminal, and see to it that it ends."""
    terminal = Terminal(*arguments, **options)
    try:
        yield terminal
    finally:
        terminal.close()
