"""The command `fingerpost`, which is also `python -m fingerpost`."""

import logging
import os
import signal
import sys

from fingerpost.signals import ending_at_once, is_anything_stuck


def main() -> None:
    """Load the command line and run it; Ctrl-C is handled until the process ends."""
    # Matrices are small here: threads of BLAS would only spin, and take a quarter of the time.
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
        # Everything is closed and reported: another Ctrl-C need not wait for Python's clean-up.
        signal.signal(signal.SIGINT, signal.SIG_DFL)


def _end_before_threads(code: object) -> None:
    """End the process at once if a thread is stuck in a device; return otherwise.

    If a thread returns from native code during the interpreter's shutdown, it is unwound through
    frames that allow no unwinding: the process aborts and loses its exit code.
    """
    if not is_anything_stuck():
        return
    logging.shutdown()
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except (OSError, ValueError):  # closed, or nobody reads it: reported by its writer
            code = code or 1
    os._exit(code if isinstance(code, int) else int(code is not None))


if __name__ == "__main__":
    main()
