"""Serve an emulated controller from a shell: `python -m fingerpost.robot.emulator acl`.

Prints the port on standard output; a line of standard input that names a fault has it happen.
"""

from __future__ import annotations

import argparse
import sys
import threading
from collections.abc import Sequence

from fingerpost.errors import InvalidInputError
from fingerpost.robot.emulator.serve import EMULATED, make_emulator, serve


def main(arguments: Sequence[str] | None = None) -> int:
    """Serve until Ctrl-C; return the exit code: 130 then, 2 on bad usage."""
    parser = argparse.ArgumentParser(prog="fingerpost robot emulate", description=__doc__)
    parser.add_argument("controller", choices=EMULATED)
    parser.add_argument("--link", help="where to put the link to the pseudo-terminal")
    parser.add_argument("--tcp-port", type=int, help="serve a TCP port of the loopback instead")
    parser.add_argument("--time-scale", type=float, default=1.0, help="seconds of the arm per s")
    parser.add_argument("--homing-s", type=float, default=60.0, help="how long homing takes [s]")
    parser.add_argument("--no-echo", action="store_true", help="ACL without echo")
    parser.add_argument("--faults-per-s", type=float, default=0.0, help="faults at random")
    parser.add_argument("--seed", type=int, default=0, help="of noise and random faults")
    given = parser.parse_args(arguments)
    try:
        emulator = make_emulator(
            given.controller,
            link=given.link,
            tcp_port=given.tcp_port,
            time_scale=given.time_scale,
            homing_s=given.homing_s,
            echo=not given.no_echo,
            seed=given.seed,
        )
        serve(
            emulator,
            lambda text: print(text, flush=True),
            threading.Event(),
            orders=sys.stdin,
            faults_per_s=given.faults_per_s,
            seed=given.seed,
        )
    except InvalidInputError as error:
        parser.error(str(error))
    except KeyboardInterrupt:
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
