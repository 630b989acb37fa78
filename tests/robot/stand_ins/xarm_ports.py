"""Redirects the vendor's library for xArm to the ports of a stand-in."""

import socket
from types import SimpleNamespace

CONTROL_PORT, REPORT_PORT = 502, 30002


def lead(module, control_port, report_port):
    """Make `xarm.core.comm.socket_port` connect to other ports."""
    ports = {CONTROL_PORT: control_port, REPORT_PORT: report_port}

    class Socket(socket.socket):
        def connect(self, address):
            host, port = address
            super().connect((host, ports[port]))

    module.socket = SimpleNamespace(**{**vars(socket), "socket": Socket})
