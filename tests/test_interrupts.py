"""What a signal handler raises waits for the end of a block, and crashes nothing."""

import signal
import subprocess
import sys
import threading

import pytest

from fingerpost.recording.interrupts import uninterrupted


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


def test_the_handler_runs_at_once_and_its_exception_at_the_end(stopping):
    seen = []

    def work():
        with uninterrupted():
            signal.raise_signal(signal.SIGINT)
            seen.extend(stopping)

    with pytest.raises(StoppedError):
        work()
    assert seen == [signal.SIGINT]


def test_the_handler_is_as_before_afterwards(stopping):
    handler = signal.getsignal(signal.SIGINT)
    with uninterrupted():
        pass
    assert signal.getsignal(signal.SIGINT) is handler
    with pytest.raises(StoppedError):
        signal.raise_signal(signal.SIGINT)


def test_an_error_of_the_block_is_kept_where_no_signal_came(stopping):
    with pytest.raises(ValueError, match="of the block"), uninterrupted():
        raise ValueError("of the block")


def test_another_thread_is_left_alone(stopping):
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
def test_writing_words_survives_interrupts():
    done = subprocess.run([sys.executable, "-c", HAMMERED], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
