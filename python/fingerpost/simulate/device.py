"""Pointing devices made of sphere-swept cones.

A *link* is what a sphere sweeps when it moves along a straight line while its radius changes
linearly: the convex hull of its two end spheres. Its silhouette under a pinhole camera is known
exactly (see `outline`), and a chain of links makes a rod, a finger or an arm.

All lengths are in the device's own frame (see `pose`): origin at the fingertip, x along the
pointing direction, z towards the thumb.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from fingerpost.errors import InvalidInputError
from fingerpost.simulate import checks
from fingerpost.simulate.scene import Tint, tint

Array = NDArray[np.float64]

Point = tuple[float, float, float]


@dataclass(frozen=True)
class Material:
    """Brightness and colour of a part."""

    contrast_ratio: float  # part minus background, in units of the lighting's contrast
    tint: Tint


PAINT_MATERIAL = Material(1.0, tint(0.97, 1.0, 1.0))
HAND_MATERIAL = Material(1.0, tint(0.60, 0.74, 1.0))
CLOTH_MATERIAL = Material(-0.45, tint(1.0, 0.86, 0.78))


@dataclass(frozen=True)
class Link:
    """One sphere-swept cone: two spheres and what lies between them."""

    start_mm: Point
    start_radius_mm: float
    end_mm: Point
    end_radius_mm: float
    material: Material


@dataclass(frozen=True, eq=False)
class Body:
    """The shape of a pointing device.

    `finger` is the index of the link whose end sphere is the fingertip and whose axis is the
    pointing axis, `thumb` that of the link that ends in the thumb's tip (None: no up-turned thumb).
    `root_mm` is the start of the index finger, which defines its visible length.
    """

    links: tuple[Link, ...]
    finger: int
    thumb: int | None
    root_mm: Point

    @cached_property
    def spheres_mm(self) -> Array:
        """(2, L, 4) centre and radius of the start and end spheres of every link."""
        return np.array(
            [
                [(*link.start_mm, link.start_radius_mm) for link in self.links],
                [(*link.end_mm, link.end_radius_mm) for link in self.links],
            ]
        )

    def placed(self, world_from_device: Array) -> Array:
        """(2, L, 4) spheres in the world, for a pose's (3, 4) matrix."""
        centres = self.spheres_mm[..., :3] @ world_from_device[:, :3].T + world_from_device[:, 3]
        return np.concatenate([centres, self.spheres_mm[..., 3:]], axis=-1)


class PointingDevice(Protocol):
    """Anything with a body."""

    @property
    def body(self) -> Body:
        """The device's shape."""


@dataclass(frozen=True)
class RodAndProng:
    """The mechanical pointing device of the 1994 experiment: a rod, and a prong for the thumb."""

    length_mm: float = 80.0  # mm from the tip to the prong's axis, 20…300
    diameter_mm: float = 16.0  # mm at the prong, 2…60
    taper: float = 0.0  # how much thinner the tip is than the base, of the diameter, −0.5…0.8
    prong_length_mm: float = 55.0  # mm from the rod's axis, 0…200; 0 is a rod alone
    prong_angle_deg: float = 80.0  # deg between prong and pointing direction, 20…160
    prong_diameter_mm: float = 14.0  # mm, 2…60

    def __post_init__(self) -> None:
        checks.number("length_mm", self.length_mm, 20, 300)
        checks.number("diameter_mm", self.diameter_mm, 2, 60)
        checks.number("taper", self.taper, -0.5, 0.8)
        checks.number("prong_length_mm", self.prong_length_mm, 0, 200)
        checks.number("prong_angle_deg", self.prong_angle_deg, 20, 160)
        checks.number("prong_diameter_mm", self.prong_diameter_mm, 2, 60)
        if self.diameter_mm > self.length_mm:
            raise InvalidInputError(
                f"diameter_mm is {self.diameter_mm:g} with length_mm {self.length_mm:g}; a rod "
                "must be longer than wide"
            )

    @cached_property
    def body(self) -> Body:
        """The device's shape: the rod, then the prong."""
        base, radius = (-self.length_mm, 0.0, 0.0), self.diameter_mm / 2
        tip_radius = radius * (1 - self.taper)
        rod = Link(base, radius, (-tip_radius, 0.0, 0.0), tip_radius, PAINT_MATERIAL)
        if self.prong_length_mm == 0:
            return Body((rod,), finger=0, thumb=None, root_mm=base)
        angle, prong_radius = math.radians(self.prong_angle_deg), self.prong_diameter_mm / 2
        reach = max(self.prong_length_mm - prong_radius, 0.0)
        end = (base[0] + reach * math.cos(angle), 0.0, reach * math.sin(angle))
        prong = Link(base, min(prong_radius, radius), end, prong_radius, PAINT_MATERIAL)
        return Body((rod, prong), finger=0, thumb=1, root_mm=base)


@dataclass(frozen=True)
class Hand:
    """A hand that points: index finger out, thumb up or folded, the other fingers curled, forearm.

    The index finger is one straight tapering cone unless it is bent at the middle joint; a bent
    finger points where its last part points.
    """

    side: Literal["right", "left"] = "right"
    thumb: Literal["up", "folded"] = "up"
    thumb_angle_deg: float = 75.0  # deg between thumb and index finger, 40…110
    bend_deg: float = 0.0  # deg at the middle joint, towards the palm, 0…80
    sleeve: bool = False
    finger_length_mm: float = 90.0  # mm from the tip to the knuckle, 50…130
    finger_diameter_mm: float = 19.0  # mm at the knuckle, 8…30
    taper: float = 0.28  # how much thinner the tip is than the knuckle, of the diameter, 0…0.6

    def __post_init__(self) -> None:
        checks.choice("side", self.side, ("right", "left"))
        checks.choice("thumb", self.thumb, ("up", "folded"))
        checks.number("thumb_angle_deg", self.thumb_angle_deg, 40, 110)
        checks.number("bend_deg", self.bend_deg, 0, 80)
        checks.number("finger_length_mm", self.finger_length_mm, 50, 130)
        checks.number("finger_diameter_mm", self.finger_diameter_mm, 8, 30)
        checks.number("taper", self.taper, 0, 0.6)

    @cached_property
    def body(self) -> Body:
        """The device's shape: the index finger's last part first, its thumb's second."""
        # Built with the knuckle of the index finger as origin, straight finger along x, right hand.
        index = self._index_finger()
        links = [index[0], *self._thumb(), *index[1:], *self._palm_and_curled_fingers()]
        links += self._forearm()
        body = Body(tuple(links), 0, 1 if self.thumb == "up" else None, (0.0, 0.0, 0.0))
        return _tip_at_origin(body, mirrored=self.side == "left")

    def _index_finger(self) -> list[Link]:
        knuckle_radius = self.finger_diameter_mm / 2
        tip_radius = knuckle_radius * (1 - self.taper)
        length = self.finger_length_mm - tip_radius
        knuckle = (0.0, 0.0, 0.0)
        if self.bend_deg == 0:
            return [Link(knuckle, knuckle_radius, (length, 0.0, 0.0), tip_radius, HAND_MATERIAL)]
        # The middle joint lies 45 % of the way to the tip.
        joint, joint_radius = (0.45 * length, 0.0, 0.0), knuckle_radius * (1 - 0.45 * self.taper)
        bend, rest = math.radians(self.bend_deg), 0.55 * length
        end = (joint[0] + rest * math.cos(bend), rest * math.sin(bend), 0.0)
        return [
            Link(joint, joint_radius, end, tip_radius, HAND_MATERIAL),
            Link(knuckle, knuckle_radius, joint, joint_radius, HAND_MATERIAL),
        ]

    def _thumb(self) -> list[Link]:
        if self.thumb == "folded":
            return _chain(
                ((-62, 4, -14, 15), (-30, 20, -4, 12), (-8, 42, -12, 10), (12, 50, -24, 8.5))
            )[::-1]
        angle = math.radians(self.thumb_angle_deg)
        c, s = math.cos(angle), math.sin(angle)
        joint = (-26, 7, 20)
        middle = (joint[0] + 30 * c, 7, joint[2] + 30 * s)
        end = (joint[0] + 54 * c, 6, joint[2] + 54 * s)
        chain = _chain(((-60, 5, -12, 16), (*joint, 12.5), (*middle, 10.5), (*end, 8.5)))
        web = _chain(((*joint, 11), (-8, 1, 2, 9)))
        return chain[::-1] + web

    def _palm_and_curled_fingers(self) -> list[Link]:
        links: list[Link] = []
        knuckles = ((0, -1, 11.5), (-3, -20, 11.5), (-8, -38, 11), (-16, -54, 9.5))
        wrist = ((-64, -20, 16), (-66, -25, 17), (-67, -31, 17), (-68, -38, 15))
        for (x, z, r), (wrist_x, wrist_z, wrist_r) in zip(knuckles, wrist, strict=True):
            links += _chain(((wrist_x, 4, wrist_z, wrist_r), (x, 0, z, r)))
        links += _chain(((-6, 20, -20, 13), (-22, 20, -54, 11)))
        for x, z, r in knuckles[1:]:
            links += _chain(
                (
                    (x, 0, z, r - 0.5),
                    (x + 9, 40, z - 2, r - 1.5),
                    (x - 18, 39, z - 3, r - 2.5),
                    (x - 26, 21, z - 3, r - 3.5),
                )
            )
        return links

    def _forearm(self) -> list[Link]:
        # The wrist is bent back a little, as it is when one points down at a table.
        drop = math.radians(14)
        wrist, back = np.array([-74.0, 4.0, -30.0]), np.array([-math.cos(drop), 0, -math.sin(drop)])
        elbow = wrist + 340 * back
        links = _chain(((*elbow, 44), (*wrist, 26)))
        if self.sleeve:
            links += _chain(((*elbow, 56), (*(wrist + 70 * back), 43)), CLOTH_MATERIAL)
        return links


def _chain(
    spheres: tuple[tuple[float, float, float, float], ...], material: Material = HAND_MATERIAL
) -> list[Link]:
    """Links between consecutive spheres (x, y, z, radius)."""
    return [
        Link(start[:3], start[3], end[:3], end[3], material) for start, end in pairwise(spheres)
    ]


def _tip_at_origin(body: Body, *, mirrored: bool) -> Body:
    """Move a body into the device's frame: the finger's tip at the origin, its axis along x."""
    finger = body.links[body.finger]
    start, end = np.array(finger.start_mm), np.array(finger.end_mm)
    x = (end - start) / np.linalg.norm(end - start)
    y = np.cross([0.0, 0.0, 1.0], x)
    rotation = np.stack([x, y, np.cross(x, y)])
    tip = end + x * finger.end_radius_mm

    def moved(point: Point) -> Point:
        forward, left, up = rotation @ (np.array(point) - tip)
        return float(forward), float(-left if mirrored else left), float(up)

    links = tuple(
        Link(
            moved(link.start_mm),
            link.start_radius_mm,
            moved(link.end_mm),
            link.end_radius_mm,
            link.material,
        )
        for link in body.links
    )
    return Body(links, body.finger, body.thumb, moved(body.root_mm))
