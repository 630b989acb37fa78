"""Stands in for the module of this name of `ur_rtde`."""

from ur_line import Part


class RTDEIOInterface(Part):
    """As its namesake."""

    def __init__(self, hostname):
        super().__init__("rtde_io", hostname)
