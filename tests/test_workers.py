"""Worker processes: none is left behind, however the program ends."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from patience import PATIENCE_S, wait_until
from terminals import THE_END, on_a_terminal

from fingerpost.errors import FingerpostError
from fingerpost.workers import sharing

pytestmark = pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="needs /proc and POSIX")

WORKERS = 2

# Each worker creates a file named after its process id, then waits for ever.
PROGRAM = """
import os, sys, threading
from pathlib import Path
from fingerpost.cli.endings import ending_as_interrupted
from fingerpost.workers import sharing

def work(folder):
    (Path(folder) / str(os.getpid())).touch()
    threading.Event().wait()

if __name__ == "__main__":
    try:
        with ending_as_interrupted(), sharing(2) as pool:
            for future in [pool.submit(work, sys.argv[1]) for _ in range(8)]:
                future.result()
    except KeyboardInterrupt:
        sys.exit(130)
"""


def is_running(pid: int) -> bool:
    """Return whether a process exists and is not a zombie."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def children(pid: int) -> list[int]:
    """Return the existing child processes of a process."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            parent = int(path.read_text().rpartition(")")[2].split()[1])
        except (FileNotFoundError, ProcessLookupError):
            continue
        if parent == pid:
            found.append(int(path.parent.name))
    return found


@pytest.fixture
def program(tmp_path):
    """A program with busy workers, in a process group of its own, and their process ids."""
    script, folder = tmp_path / "program.py", tmp_path / "working"
    script.write_text(PROGRAM)
    folder.mkdir()
    command = [sys.executable, str(script), str(folder)]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True)
    try:
        wait_until(lambda: len(list(folder.iterdir())) == WORKERS, "the workers' beginning")
        yield process, [int(path.name) for path in folder.iterdir()]
    finally:
        process.kill()
        process.communicate()


@pytest.mark.parametrize("send", [os.kill, os.killpg])
@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT"])
def test_a_signal_ends_program_and_busy_workers(program, name, send):
    process, workers = program
    send(process.pid, getattr(signal, name))
    _, said = process.communicate(timeout=PATIENCE_S)
    assert (process.returncode, said) == (130, "")
    assert not any(map(is_running, workers))


def test_a_program_that_is_killed_leaves_no_worker(program):
    process, workers = program
    process.kill()
    process.wait(PATIENCE_S)
    wait_until(lambda: not any(map(is_running, workers)), "the workers' end")


def test_ctrl_c_ends_an_experiment():
    with on_a_terminal("experiment", "--targets", 4000, start_new_session=True) as run:
        assert "of 4000 targets" in run.read_until("of 4000 targets")
        workers = children(run.process.pid)
        assert len(workers) >= 1
        os.killpg(run.process.pid, signal.SIGINT)
        said = run.read_until(THE_END)
        assert run.end() == (130, "")
    assert said.split()[-2:] == ["fingerpost:", "stopped"]
    assert "Traceback" not in said
    wait_until(lambda: not any(map(is_running, workers)), "the workers' end")


def kill_own_process() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def lose_a_worker() -> None:
    with sharing(WORKERS) as pool:
        pool.submit(time.sleep, 3600.0)
        pool.submit(kill_own_process).result()


def test_a_worker_that_is_killed_is_an_error_and_the_others_end():
    before = set(children(os.getpid()))
    with pytest.raises(FingerpostError, match="a worker process died"):
        lose_a_worker()
    started = set(children(os.getpid())) - before
    # Only the resource tracker remains, which serves all workers that this process will have.
    assert all(b"resource_tracker" in Path(f"/proc/{p}/cmdline").read_bytes() for p in started)


def test_signals_are_unblocked_once_workers_have_started():
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ())
    with sharing(WORKERS) as pool:
        assert pool.submit(abs, -3).result() == 3
        assert signal.pthread_sigmask(signal.SIG_BLOCK, ()) == before
