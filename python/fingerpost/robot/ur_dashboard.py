"""The dashboard server of a Universal Robots controller: one line of text for one line of text.

It is a second way to the controller, which no other command can hold up. It knows what the RTDE
interface does not: whether the pendant is switched to remote control (e-series), and how to stop a
program that no longer listens to us. PolyScope X has no such server.
"""

from __future__ import annotations

import socket

PORT = 29999

TIMEOUT_S = 0.5
"""Of the connection and of each answer [s]; in its own network a controller takes milliseconds."""


def ask(host: str, command: str) -> str:
    """Send one command and return the answer, a line without its end.

    Parameters
    ----------
    host : str
        The controller's address.
    command : str
        As the server's manual names it, such as ``stop``.

    Raises
    ------
    OSError
        Nobody answers.
    """
    with (
        socket.create_connection((host, PORT), timeout=TIMEOUT_S) as line,
        line.makefile("rwb") as text,
    ):
        text.readline()  # its greeting
        text.write(f"{command}\n".encode())
        text.flush()
        answer: bytes = text.readline()
    if not answer:
        raise ConnectionError("the dashboard server has closed the line")
    return answer.decode(errors="replace").strip()


def remote_control_is_off(host: str) -> bool:
    """Whether the controller says that its pendant is not switched to remote control.

    A controller that has no such switch, or cannot be asked, says nothing of the kind.
    """
    try:
        return ask(host, "is in remote control").lower() == "false"
    except OSError:
        return False


def stop_program(host: str) -> None:
    """Stop the running or paused program, and so the arm.

    Raises
    ------
    OSError
        Nobody answers, or the answer is another than that it is stopped.
    """
    answer = ask(host, "stop")
    if not answer.lower().startswith("stopped"):
        raise OSError(f"the dashboard server answers {answer!r} to stop")
