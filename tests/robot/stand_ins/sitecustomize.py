"""Redirects the vendor's library for xArm to a stand-in, in processes that a test starts.

Python imports this module automatically at its start if this folder is on its path.
"""

import os
import sys
from importlib.machinery import PathFinder

from xarm_ports import lead


class _LedLibrary:
    """Finds `xarm.core.comm.socket_port` like Python, and redirects it to the stand-in's ports."""

    def find_spec(self, name, path=None, target=None):
        if name != "xarm.core.comm.socket_port":
            return None
        spec = PathFinder.find_spec(name, path, target)
        run = spec.loader.exec_module

        def run_and_lead(module):
            run(module)
            lead(module, *map(int, os.environ["FINGERPOST_TEST_XARM_PORTS"].split(",")))

        spec.loader.exec_module = run_and_lead
        return spec


if "FINGERPOST_TEST_XARM_PORTS" in os.environ:
    sys.meta_path.insert(0, _LedLibrary())
