"""Leads the vendor's library for xArm to ports where a stand-in may listen."""

import socket
from types import SimpleNamespace

CONTROL_PORT, REPORT_PORT = 502, 30002


def lead(module, control_port, report_port):
    """Have `xarm.core.comm.socket_port` connect to other ports than its own."""
    ports = {CONTROL_PORT: control_port, REPORT_PORT: report_port}

    class Socket(socket.socket):
        def connect(self, address):
            host, port = address
            super().connect((host, ports[port]))

    module.socket = SimpleNamespace(**{**vars(socket), "socket": Socket})
