"""Stand-in for the module of this name in `ur_rtde`."""

from ur_line import Part


class RTDEIOInterface(Part):
    """Stand-in for the class of this name."""

    def __init__(self, hostname):
        super().__init__("rtde_io", hostname)
