"""Exclusive use of a port: a serial device is locked while it is open, and its user is named.

Two programs that read one port lose each other's answers. While a device is open, `flock` excludes
every program that locks as well, and `TIOCEXCL` all programs except root's. A program that opened
the device before, without a lock, is found in `/proc`, which also names the holder of a lock;
without `/proc` the other program is not named.
"""

from __future__ import annotations

import errno
import os
import stat
import textwrap
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from fingerpost.robot.errors import PortInUseError

PROC = Path("/proc")

PSEUDO_TERMINAL_MAJORS = range(136, 144)
"""Major device numbers of pseudo-terminals in Linux."""

MEMORY_MAJOR = 1
"""Major device number of `/dev/null` and similar devices, which many programs have open."""

MASTERS = ("/dev/ptmx", "/dev/pts/ptmx")
"""Devices by which a program makes and serves a pseudo-terminal."""

COMMAND_WIDTH = 80
"""Longest command line that is shown, in characters: a message is one line."""

HELD_BY_ANOTHER = frozenset({errno.EAGAIN, errno.EBUSY})
"""Errors of opening and locking that mean that another program uses the device."""


def need_free(device: str) -> None:
    """Refuse a device that another program has open, with or without a lock.

    A program that serves a pseudo-terminal, such as an emulator, may have both of its ends open.

    Parameters
    ----------
    device : str
        Path of the device; it need not exist.

    Raises
    ------
    PortInUseError
        Another program has it open; the message names it.
    """
    for process in _users(device):
        raise _in_use(device, process)


def in_use(device: str) -> PortInUseError:
    """Return the error for a device that could not be opened or locked, naming its user.

    Parameters
    ----------
    device : str
        Path of the device.
    """
    return _in_use(device, _lock_holder(device) or next(_users(device), None))


def keep_others_out(descriptor: int) -> None:
    """Prevent others, except root, from opening a device until `let_others_in`.

    Pseudo-terminals are excepted: there the lock would outlive a killed program, because the
    emulator at the other end has the device open as well.

    Parameters
    ----------
    descriptor : int
        File descriptor of the open device.
    """
    import termios  # not on Windows, where devices are never shared

    if not _is_pseudo_terminal(os.fstat(descriptor)):
        _request(descriptor, termios.TIOCEXCL)


def let_others_in(descriptor: int) -> None:
    """Undo `keep_others_out`.

    Parameters
    ----------
    descriptor : int
        File descriptor of the open device.
    """
    import termios

    _request(descriptor, termios.TIOCNXCL)


def _request(descriptor: int, request: int) -> None:
    import fcntl

    with suppress(OSError):  # not a terminal, or disconnected
        fcntl.ioctl(descriptor, request)


def _in_use(device: str, process: int | None) -> PortInUseError:
    if process is None:
        holder = "another program"
    elif process == os.getpid():
        holder = "another robot of this program"
    else:
        holder = f"process {process} ({_command(process)})"
    return PortInUseError(
        f"{device} is in use by {holder}: one program at a time can talk to a controller; end that "
        "one first"
    )


def _command(process: int) -> str:
    """Return a process's command line, shortened."""
    try:
        words = (PROC / str(process) / "cmdline").read_bytes().decode(errors="replace").split("\0")
    except OSError:  # it has ended
        return "ended just now"
    return textwrap.shorten(" ".join(words), COMMAND_WIDTH, placeholder=" ...") or "unnamed"


def _users(device: str) -> Iterator[int]:
    """Yield the other processes that have a device open, except those that serve it."""
    try:
        wanted = Path(device).stat()
    except OSError:
        return
    if not stat.S_ISCHR(wanted.st_mode) or os.major(wanted.st_rdev) == MEMORY_MAJOR:
        return
    with suppress(OSError):
        for process in PROC.iterdir():
            if not process.name.isdecimal() or int(process.name) == os.getpid():
                continue
            if _uses(process, wanted):
                yield int(process.name)


def _uses(process: Path, device: os.stat_result) -> bool:
    """Whether a process has a device open without serving it; False without permission to know."""
    opened = False
    with suppress(OSError):
        for descriptor in (process / "fd").iterdir():
            with suppress(OSError):  # closed meanwhile
                if _is_pseudo_terminal(device) and _serves(descriptor, device):
                    return False
                opened |= descriptor.stat().st_rdev == device.st_rdev
    return opened


def _serves(descriptor: Path, device: os.stat_result) -> bool:
    """Whether a descriptor is the other end of a pseudo-terminal."""
    if str(descriptor.readlink()) not in MASTERS:
        return False
    facts = (descriptor.parents[1] / "fdinfo" / descriptor.name).read_text()
    return f"tty-index:\t{os.minor(device.st_rdev)}\n" in facts


def _lock_holder(device: str) -> int | None:
    """Return the process that has locked a device by `flock`."""
    with suppress(OSError, ValueError):
        found = Path(device).stat()
        place = f"{os.major(found.st_dev):02x}:{os.minor(found.st_dev):02x}:{found.st_ino}"
        for line in (PROC / "locks").read_text().splitlines():
            words = line.split()
            if place in words and "FLOCK" in words:
                return int(words[words.index(place) - 1])
    return None


def _is_pseudo_terminal(device: os.stat_result) -> bool:
    return os.major(device.st_rdev) in PSEUDO_TERMINAL_MAJORS
