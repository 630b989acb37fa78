"""Emulated robot controllers on pseudo-terminals: every byte of the real dialogue, no metal.

`make_emulator` plugs one in; `fingerpost robot emulate` does it from a shell.
"""

from fingerpost.robot.emulator.faults import Fault
from fingerpost.robot.emulator.serve import EMULATED, make_emulator, serve

__all__ = ["EMULATED", "Fault", "make_emulator", "serve"]
