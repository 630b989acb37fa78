"""Proxy for a module of `ur_rtde` in the test's process; a call is a line of JSON."""

import json
import os
import socket
import threading


class Part:
    """A module's class, served by the test's process on a port from the environment."""

    def __init__(self, module, *arguments):
        address = ("127.0.0.1", int(os.environ["FINGERPOST_TEST_UR_PORT"]))
        self._text = socket.create_connection(address).makefile("rwb")
        self._lock = threading.Lock()
        self._call(module, *arguments)

    def _call(self, name, *arguments):
        with self._lock:
            self._text.write(json.dumps([name, arguments]).encode() + b"\n")
            self._text.flush()
            result, error = json.loads(self._text.readline() or '[null, "the line is closed"]')
        if error is not None:
            raise RuntimeError(error)
        return result

    def __getattr__(self, name):
        return lambda *arguments: self._call(name, *arguments)
