"""The command `fingerpost`, which is also `python -m fingerpost`."""

import logging
import os
import signal
import sys

from fingerpost.signals import ending_at_once, is_anything_stuck


def main() -> None:
    """Load the command line and run it; Ctrl-C is heard from here on, until the program is gone."""
    # Matrices are small here: threads of BLAS would only spin, for a quarter of all work.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    with ending_at_once():
        from fingerpost.cli import main as run_command
    try:
        run_command()
        _end_before_threads(0)
    except SystemExit as end:
        _end_before_threads(end.code)
        raise
    finally:
        # Everything is closed and said: one more Ctrl-C need not wait for Python to tidy up.
        signal.signal(signal.SIGINT, signal.SIG_DFL)


def _end_before_threads(code: object) -> None:
    """End the process at once if a thread is stuck in a device; return otherwise.

    A thread that returns from native code while the interpreter is torn down is unwound through
    frames that allow no unwinding, and the process aborts whatever its exit code was to be.
    """
    if not is_anything_stuck():
        return
    logging.shutdown()
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except (OSError, ValueError):  # closed, or nobody reads it: said by whoever wrote to it
            code = code or 1
    os._exit(code if isinstance(code, int) else int(code is not None))


if __name__ == "__main__":
    main()
