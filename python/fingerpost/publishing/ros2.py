"""`zenoh+ros2://`: fixes as messages of ROS 2, for rmw_zenoh and zenoh-bridge-ros2dds.

Three topics below a name: `point` (geometry_msgs/PointStamped), `pose`
(geometry_msgs/PoseWithCovarianceStamped) and `ellipse` (visualization_msgs/MarkerArray, the 95 %
ellipse), in metres. rmw_zenoh uses keys `DOMAIN/TOPIC/TYPE/HASH` with sequence number, time and
sender attached, and discovers a publisher by a liveliness token; the bridge uses the topic's name.
Both receive the same bytes, which cost nothing without a subscriber.
"""

from __future__ import annotations

import hashlib
import struct
from typing import TYPE_CHECKING

from fingerpost.errors import InvalidInputError
from fingerpost.publishing import cdr
from fingerpost.publishing.address import Address
from fingerpost.publishing.fix import Extent, Pictures, PublishedFix
from fingerpost.publishing.over_zenoh import Link, congestion_control, refuse_wild

if TYPE_CHECKING:
    import zenoh

_LARGEST_DOMAIN = 232
_NODE = "fingerpost"
_NO_HASH = "TypeHashNotSupported"
"""Placeholder of a type's hash in Humble, which has none."""

_TYPES = {
    "point": (
        "geometry_msgs::msg::dds_::PointStamped_",
        "RIHS01_4c0296af86e01e562e9e0405d138a01537247580076c58ea38d7923ac1045897",
    ),
    "pose": (
        "geometry_msgs::msg::dds_::PoseWithCovarianceStamped_",
        "RIHS01_26432f9803e43727d3c8f668d1fdb3c630f548af631e2f4e31382371bfea3b6e",
    ),
    "ellipse": (
        "visualization_msgs::msg::dds_::MarkerArray_",
        "RIHS01_86cb8800b6fb05b5eff1abd7a56f62a5641d3ae9a1c29e78e67e704f1d067dcf",
    ),
}
"""Type of each topic, and the hash of its definition (REP 2016): `test_publishing` computes it."""

_ATTACHMENT = struct.Struct("<qqB16s")
_DEFAULT_QOS = "::,:,:,:,,"
"""Reliable, volatile, and defaults otherwise, in the format of a liveliness token."""


class Ros2:
    """Publishes fixes to ROS 2; parameters as `registry.Opener`."""

    wants_pictures = False

    def __init__(self, address: Address, extent: Extent) -> None:
        address.refuse_others(["domain", "distro", "frame_id"], has_path=True)
        if extent.unit_m is None:
            raise InvalidInputError(
                f'{address.url}: the plane\'s unit is "{extent.unit}", of no known length; ROS has '
                "metres: a rig in mm, cm, m or in is right"
            )
        self._unit_m = extent.unit_m
        self._name = address.path or _NODE
        refuse_wild(address, self._name)
        self._frame_id = address.options.get("frame_id", "plane")
        self._domain = _domain(address)
        self._has_hashes = address.choice("distro", ("jazzy", "kilted", "humble")) != "humble"
        self._link = Link(address, listens=False)
        self._announced: zenoh.Session | None = None
        self._tokens: list[zenoh.LivelinessToken] = []
        self._gids: dict[str, bytes] = {}
        self._sequence = 0

    def send(self, fix: PublishedFix, _pictures: Pictures) -> None:
        """Send a point and its ellipse; remove the ellipse without a point."""
        session = self._link.session()
        if session is not self._announced:
            self._announce(session)
        self._sequence += 1
        for topic, data in cdr.messages(fix, self._unit_m, self._frame_id):
            self._put(session, topic, data, fix)

    def key(self, topic: str) -> str:
        """Return the key of a topic for rmw_zenoh."""
        kind, known_hash = _TYPES[topic]
        known_hash = known_hash if self._has_hashes else _NO_HASH
        return f"{self._domain}/{self._name}/{topic}/{kind}/{known_hash}"

    def _put(self, session: zenoh.Session, topic: str, data: bytes, fix: PublishedFix) -> None:
        attached = _ATTACHMENT.pack(self._sequence, fix.stamp_ns, 16, self._gids[topic])
        for key in (self.key(topic), f"{self._name}/{topic}"):
            session.put(
                key,
                data,
                attachment=attached,
                congestion_control=congestion_control(waits=fix.is_recorded),
                express=True,
            )

    def _announce(self, session: zenoh.Session) -> None:
        """Announce node and topics, for `ros2 node list` and `ros2 topic list`."""
        start = f"@ros2_lv/{self._domain}/{session.zid()}/0"
        tokens = [f"{start}/0/NN/%/%/{_NODE}"]
        for number, (topic, (kind, known_hash)) in enumerate(_TYPES.items(), start=1):
            known_hash = known_hash if self._has_hashes else _NO_HASH
            name = f"/{self._name}/{topic}".replace("/", "%")
            token = f"{start}/{number}/MP/%/%/{_NODE}/{name}/{kind}/{known_hash}/{_DEFAULT_QOS}"
            self._gids[topic] = hashlib.blake2b(token.encode(), digest_size=16).digest()
            tokens.append(token)
        self._tokens = [session.liveliness().declare_token(token) for token in tokens]
        self._announced = session

    def close(self) -> None:
        """Close the session."""
        self._link.close()


def _domain(address: Address) -> int:
    given = address.options.get("domain", "0")
    if not (given.isdecimal() and int(given) <= _LARGEST_DOMAIN):
        raise InvalidInputError(
            f"{address.url}: domain is {given!r}; 0 to {_LARGEST_DOMAIN} is right"
        )
    return int(given)
