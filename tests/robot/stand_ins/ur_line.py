"""A part of `ur_rtde` that is in the test's process: a call is a line of JSON."""

import json
import os
import socket
import threading


class Part:
    """What a test's process serves under a module's name, on the port of its environment."""

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
