"""Emulated robot controllers on pseudo-terminals, with every byte of the real dialogue.

`make_emulator` connects one; `fingerpost robot emulate` does so from a shell.
"""

from fingerpost.robot.emulator.faults import Fault
from fingerpost.robot.emulator.serve import EMULATED, make_emulator, serve

__all__ = ["EMULATED", "Fault", "make_emulator", "serve"]
