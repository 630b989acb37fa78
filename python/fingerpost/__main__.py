"""The command `fingerpost`, which is also `python -m fingerpost`."""

import signal

from fingerpost.signals import ending_at_once


def main() -> None:
    """Load the command line and run it; Ctrl-C is heard from here on, until the program is gone."""
    with ending_at_once():
        from fingerpost.cli import main as run_command
    try:
        run_command()
    finally:
        # Everything is closed and said: one more Ctrl-C need not wait for Python to tidy up.
        signal.signal(signal.SIGINT, signal.SIG_DFL)


if __name__ == "__main__":
    main()
