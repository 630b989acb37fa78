"""How the program ends: by Ctrl-C inside libraries and imports, and with a stuck device."""

import os
import signal
import subprocess
import sys
import threading
import time
import tomllib
from pathlib import Path

import pytest
from patience import PATIENCE_S

import fingerpost
from fingerpost.recording.interrupts import uninterrupted
from fingerpost.signals import ending_at_once, wait_hearing_signals

ROOT = Path(__file__).resolve().parents[1]
PIPED = {
    "capture_output": True,
    "text": True,
    "check": False,
    "env": os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
}


class StoppedError(Exception):
    pass


@pytest.fixture
def stopping(monkeypatch):
    """A handler of SIGINT that counts and raises."""
    calls = []

    def handle(number, _):
        calls.append(number)
        raise StoppedError

    before = signal.signal(signal.SIGINT, handle)
    yield calls
    signal.signal(signal.SIGINT, before)


def test_the_handler_runs_at_once_and_its_exception_is_raised_at_the_end(stopping):
    seen = []

    def work():
        with uninterrupted():
            signal.raise_signal(signal.SIGINT)
            seen.extend(stopping)

    with pytest.raises(StoppedError):
        work()
    assert seen == [signal.SIGINT]


def test_the_previous_handler_is_restored(stopping):
    handler = signal.getsignal(signal.SIGINT)
    with uninterrupted():
        pass
    assert signal.getsignal(signal.SIGINT) is handler
    with pytest.raises(StoppedError):
        signal.raise_signal(signal.SIGINT)


def test_an_error_of_the_block_is_raised_without_a_signal(stopping):
    with pytest.raises(ValueError, match="of the block"), uninterrupted():
        raise ValueError("of the block")


def test_other_threads_do_not_change_the_handler(stopping):
    passed = []

    def work():
        with uninterrupted():
            passed.append(signal.getsignal(signal.SIGINT))

    handler = signal.getsignal(signal.SIGINT)
    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert passed == [handler]


HAMMERED = """
import signal, sys
from fingerpost.recording.sheet import Sheet

class Stopped(Exception):
    pass

def stop(*_):
    raise Stopped

signal.signal(signal.SIGINT, stop)
signal.signal(signal.SIGALRM, lambda *_: signal.raise_signal(signal.SIGINT))
sheet, stopped = Sheet.blank((200, 50), (0, 0, 0)), 0
sheet.text("12.5 mm", (100.0, 20.0), 14, (255, 255, 255))  # imports what it needs
while stopped < 400:
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.0003 + 0.00001 * (stopped % 37))
        while True:
            sheet.text("12.5 mm", (100.0, 20.0), 14, (255, 255, 255), room=90.0)
    except Stopped:
        stopped += 1
"""


@pytest.mark.skipif(not hasattr(signal, "setitimer"), reason="POSIX timers")
def test_drawing_text_survives_interrupts():
    done = subprocess.run([sys.executable, "-c", HAMMERED], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


# --- while the program is loaded --------------------------------------------------------------

# Ctrl-C arrives while a module is searched for, which takes most of the time of an import.
LOADED = """
import os, signal, sys

module = sys.argv[1]

class Interrupting:
    def find_spec(self, name, path=None, target=None):
        if name == module:
            sys.meta_path.remove(self)
            os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, Interrupting())
from fingerpost.__main__ import main
sys.argv = ["fingerpost", *sys.argv[2:]]
main()
"""


def interrupted(module: str, *arguments: str) -> tuple[int, str, str]:
    """Return exit code, stdout and stderr of a command interrupted while it imports a module."""
    command = [sys.executable, "-c", LOADED, module, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=PATIENCE_S)
    return done.returncode, done.stdout, done.stderr


@pytest.mark.parametrize(
    "module",
    [
        "click",
        "fingerpost.cli",
        "fingerpost.cli.robot",
        "numpy",
        "numpy._core._multiarray_umath",
        "msgspec._core",
        "fingerpost._core",
        "fingerpost.pipeline",
        "cv2.version",
    ],
)
def test_ctrl_c_during_imports_ends_the_program_silently(module):
    assert interrupted(module, "run", "rig.toml") == (130, "", "")


def test_ctrl_c_is_handled_during_later_imports():
    assert interrupted("fingerpost.doctor", "doctor", "rig.toml") == (130, "", "")
    code, said, error = interrupted("no.such.module", "run", "no-such-rig.toml")
    assert (code, said) == (2, "")
    assert "no-such-rig.toml" in error


def test_a_background_job_ignores_ctrl_c_during_imports():
    ignoring = f"import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)\n{LOADED}"
    command = [sys.executable, "-c", ignoring, "numpy", "run", "no-such-rig.toml"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=PATIENCE_S)
    assert done.returncode == 2
    assert "no-such-rig.toml" in done.stderr


def test_the_handler_of_ctrl_c_is_restored_after_imports(stopping):
    handler = signal.getsignal(signal.SIGINT)
    with ending_at_once():
        assert signal.getsignal(signal.SIGINT) is handler  # of a program's own
    signal.signal(signal.SIGINT, signal.default_int_handler)
    with ending_at_once():
        assert signal.getsignal(signal.SIGINT) is not signal.default_int_handler
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.skipif(not hasattr(signal, "pthread_kill"), reason="signals of threads")
def test_a_signal_that_another_thread_receives_ends_a_wait(stopping):
    # The same state as after a signal just before a wait: a handler is due, and nothing wakes it.
    ended = threading.Event()

    def strike():
        time.sleep(0.3)
        signal.pthread_kill(threading.get_ident(), signal.SIGINT)
        time.sleep(10.0)
        ended.set()

    threading.Thread(target=strike, daemon=True).start()
    with pytest.raises(StoppedError):
        wait_hearing_signals(ended.wait)
    assert not ended.is_set()


def test_a_wait_ends_with_its_event():
    ended = threading.Event()
    threading.Timer(0.3, ended.set).start()
    wait_hearing_signals(ended.wait)
    assert ended.is_set()


def test_no_heavy_import_precedes_the_ctrl_c_handler():
    program = """
import sys, fingerpost.__main__
print(sorted({"click", "numpy", "cv2", "msgspec", "typing"} & set(sys.modules)))
"""
    done = subprocess.run([sys.executable, "-S", "-c", program], **PIPED)
    assert (done.stdout, done.stderr) == ("[]\n", "")


def test_the_command_and_the_module_have_one_entry_point():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert project["scripts"] == {"fingerpost": "fingerpost.__main__:main"}


def test_exported_names_are_defined_in_the_package():
    assert set(fingerpost.__all__) <= set(dir(fingerpost))
    for name in set(fingerpost.__all__) - {"__version__"}:
        offered = getattr(fingerpost, name)
        assert offered.__name__ == name
        assert offered.__module__.startswith("fingerpost")
    with pytest.raises(AttributeError, match="module 'fingerpost' has no attribute 'Pionter'"):
        fingerpost.Pionter  # noqa: B018


# Shutdown of the interpreter takes 2 s, during which the stream's time limit expires.
STUCK = """
import socket, sys, threading, time, types
import cv2
import fingerpost.__main__ as program, fingerpost.cli, fingerpost.signals

class Slow:
    def __del__(self, sleep=time.sleep):
        sleep(2.0)

sys.modules["slow"] = types.ModuleType("slow")
sys.modules["slow"].slow = Slow()
server = socket.create_server(("127.0.0.1", 0))

def read():
    url = f"http://127.0.0.1:{server.getsockname()[1]}/"
    cv2.VideoCapture(url, cv2.CAP_FFMPEG, [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, 1000])

def command():
    reader = threading.Thread(target=read, daemon=True)
    reader.start()
    fingerpost.signals.leave_behind(reader)
    time.sleep(0.5)
    print("all is said")
    sys.exit(3)

fingerpost.cli.main = command
program.main()
"""


def test_a_reader_stuck_in_its_stream_changes_neither_exit_code_nor_output():
    ended = subprocess.run([sys.executable, "-c", STUCK], timeout=PATIENCE_S, **PIPED)
    assert (ended.returncode, ended.stdout) == (3, "all is said\n")
