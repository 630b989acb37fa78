"""The dashboard server of a Universal Robots controller, which answers each line with a line.

It is an independent connection to the controller, which no other command can block. Unlike the RTDE
interface, it reports whether the pendant is switched to remote control (e-series), and can stop a
program that no longer accepts commands. PolyScope X has no such server.
"""

from __future__ import annotations

import socket

PORT = 29999

TIMEOUT_S = 0.5
"""Time limit of the connection and of each answer [s]; on a local network it takes milliseconds."""


def ask(host: str, command: str) -> str:
    """Send one command and return the answer, a line without its end.

    Parameters
    ----------
    host : str
        The controller's address.
    command : str
        A command of the server's manual, such as ``stop``.

    Raises
    ------
    OSError
        No answer.
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
    """Whether the controller reports that its pendant is not switched to remote control.

    False for a controller without such a switch, or one that does not answer.
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
        No answer, or one that does not confirm the stop.
    """
    answer = ask(host, "stop")
    if not answer.lower().startswith("stopped"):
        raise OSError(f"the dashboard server answers {answer!r} to stop")
