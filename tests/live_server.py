"""Helpers for tests of the operator's page: a command that serves it, its messages, axe-core."""

import http.client
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from patience import PATIENCE_S

RIG = Path(__file__).parents[1] / "python" / "fingerpost" / "data" / "desk" / "rig.toml"


class Served:
    """A running command that serves the page."""

    def __init__(self, *arguments: object, folder: Path | None = None) -> None:
        command = [sys.executable, "-m", "fingerpost", *map(str, arguments)]
        environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
        self.process = subprocess.Popen(
            command,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=environment,
            cwd=folder,
        )
        self.address = self.process.stdout.readline().strip()
        if not self.address:
            raise AssertionError(self.process.communicate()[1])
        self.base, _, self.token = self.address.partition("/?token=")
        self.host = self.base.removeprefix("http://")
        self.port = int(self.base.rpartition(":")[2])
        self.cookie = f"fingerpost-{self.port}={self.token}"

    def ask(self, method: str, path: str, **headers: str) -> tuple[int, str, dict[str, str]]:
        """Send a request; return status, text and headers of the response."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=PATIENCE_S)
        given = {"Host": self.host, **{k.replace("_", "-"): v for k, v in headers.items()}}
        connection.request(method, path, headers=given)
        answer = connection.getresponse()
        text = answer.read().decode()
        connection.close()
        return answer.status, text, {k.lower(): v for k, v in answer.getheaders()}

    def end(self) -> tuple[int, str]:
        """Wait for its end; return exit code and stderr."""
        _, err = self.process.communicate(timeout=PATIENCE_S)
        return self.process.returncode, err


@contextmanager
def served(
    *arguments: object, command: str = "live", folder: Path | None = None
) -> Iterator[Served]:
    """Run a command, by default `live` on the clip or in a folder; kill it on exit."""
    running = Served(command, *(arguments or (() if folder else (RIG,))), folder=folder)
    try:
        yield running
    finally:
        running.process.kill()
        running.process.communicate()


def scene_in(message: bytes) -> dict:
    """The scene in a binary message."""
    length = int.from_bytes(message[:4], "little")
    return json.loads(message[4 : 4 + length])


def pictures_in(message: bytes) -> list[bytes]:
    """The pictures in a binary message."""
    begin = 4 + int.from_bytes(message[:4], "little")
    pictures = []
    for size in scene_in(message)["pictures"]:
        pictures.append(message[begin : begin + size])
        begin += size
    assert begin == len(message)
    return pictures


def unclean(page) -> list[tuple[str, list[str], str]]:
    """Return axe-core's violations of the page as it is now: rule, elements and reason."""
    from axe_playwright_python.base import AXE_SCRIPT

    page.evaluate(AXE_SCRIPT)
    return [
        (wrong["id"], node["target"], node["failureSummary"])
        for wrong in page.evaluate("() => axe.run()")["violations"]
        for node in wrong["nodes"]
    ]
