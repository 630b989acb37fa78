"""The robot cell for MuJoCo: `scene.xml`, and the parts that are easier to define in code.

These are the cameras, the pointing hand, with the shape of the simulated rig's hand
(`fingerpost.simulate.Hand`), and the pictures on the mat and on the wooden block.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from fingerpost.closed_loop.engine import require_mujoco
from fingerpost.simulate import Body, Camera, Link

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

HAND_RGBA = (0.86, 0.62, 0.51, 1.0)

# Sides of the polyhedron for a sphere-swept cone: the error of a finger's flank is at most
# r (1 − cos π/48) = 0.02 mm.
SIDES = 48
CAP_RINGS = 10

CARD_GROUP = 3
"""The group of geoms of the card in scene.xml."""

CARD_MARKER_MM = 42.0
"""Side of the card's ArUco marker, number 0 of 4X4_50."""

CARD_MARKER_UP_MM = 31.0
"""Height of its centre above the gripper's working point; beside it, on the gripper's axis."""

SPIKE_MM = 12.0
"""Extent of the card's spike below the working point; the fingers reach 10 mm below it."""

_CARD_PX_PER_MM = 8
_CARD_MM = (58, 56)  # along and across the gripper, as in scene.xml

_MAT_PX_PER_MM = 2.0
_MAT_MM = (820, 1200)  # along x and y, as in scene.xml
_BLOCK_PX = 96


def build_model(cameras: Sequence[Camera], hand: Body, *, samples: int, shadows: bool) -> Any:
    """Build the cell.

    Parameters
    ----------
    cameras
        Pinhole cameras [mm]; MuJoCo renders no lens distortion.
    hand
        The pointing hand; it follows the model's mocap body.
    samples
        Rendered samples per pixel.
    shadows
        Whether the lamp casts shadows.

    Returns
    -------
    mujoco.MjModel
    """
    mujoco = require_mujoco()
    spec = mujoco.MjSpec.from_file(str(Path(__file__).with_name("scene.xml")))
    spec.light("lamp").castshadow = shadows
    spec.visual.quality.offsamples = samples
    for camera in cameras:
        _add_camera(spec, camera)
    _add_hand(spec, hand)
    _add_picture(mujoco, spec, "mat", _mat())
    _add_picture(mujoco, spec, "card", _card())
    _add_picture(mujoco, spec, "block", _wooden_block())
    spec.visual.global_.offwidth = max(camera.width_px for camera in cameras)
    spec.visual.global_.offheight = max(camera.height_px for camera in cameras)
    return spec.compile()


def _add_camera(spec: Any, camera: Camera) -> None:
    """Add a pinhole: MuJoCo's cameras look along −z with y up, ours along +z with y down."""
    right, down, forwards = camera.camera_from_world[:, :3]
    spec.worldbody.add_camera(
        name=camera.name,
        pos=camera.centre_mm / 1000,
        quat=quaternion(np.column_stack([right, -down, -forwards])),
        fovy=math.degrees(2 * math.atan(camera.height_px / 2 / camera.f_px)),
    )


def quaternion(rotation: Array) -> Array:
    """Return the unit quaternion (w, x, y, z) of a rotation matrix (3, 3)."""
    out = np.empty(4)
    require_mujoco().mju_mat2Quat(out, np.ascontiguousarray(rotation).ravel())
    return out


# --- the hand ---------------------------------------------------------------------------------


def _add_hand(spec: Any, hand: Body) -> None:
    vertices, faces = _joined([_swept_cone(link) for link in hand.links])
    mesh = spec.add_mesh(name="hand", uservert=(vertices / 1000).ravel(), userface=faces.ravel())
    # Its parts overlap, so its volume is undefined; it is moved kinematically.
    mesh.inertia = require_mujoco().mjtMeshInertia.mjMESH_INERTIA_SHELL
    spec.body("hand").add_geom(
        name="hand",
        type=require_mujoco().mjtGeom.mjGEOM_MESH,
        meshname="hand",
        rgba=HAND_RGBA,
        contype=0,
        conaffinity=0,
    )


def _swept_cone(link: Link) -> tuple[Array, NDArray[np.int32]]:
    """Return vertices (V, 3) [mm] and triangles (F, 3) of a sphere-swept cone.

    Seen from the side, the sphere of radius r₀ at the start and that of r₁ at the end, a length L
    further on, are joined by straight lines that touch both where the radius leans back by α with
    sin α = (r₀ − r₁)/L. The surface turns that outline about the axis.
    """
    start, end = np.array(link.start_mm), np.array(link.end_mm)
    r0, r1 = link.start_radius_mm, link.end_radius_mm
    length = float(np.linalg.norm(end - start))
    lean = math.asin(max(-1.0, min(1.0, (r0 - r1) / length))) if length else 0.0
    back = np.linspace(-math.pi / 2, lean, CAP_RINGS + 1)
    front = np.linspace(lean, math.pi / 2, CAP_RINGS + 1)
    along = np.concatenate([r0 * np.sin(back), length + r1 * np.sin(front)])
    radius = np.concatenate([r0 * np.cos(back), r1 * np.cos(front)])
    axis = (end - start) / length if length else np.array([1.0, 0.0, 0.0])
    side = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    side /= np.linalg.norm(side)
    other = np.cross(axis, side)
    turn = np.linspace(0, 2 * math.pi, SIDES, endpoint=False)
    around = np.cos(turn)[:, None] * side + np.sin(turn)[:, None] * other
    rings = start + along[:, None, None] * axis + radius[:, None, None] * around
    return rings.reshape(-1, 3), _strips(len(along))


def _strips(rings: int) -> NDArray[np.int32]:
    """Triangles between consecutive rings of `SIDES` vertices, seen from outside anticlockwise."""
    ring, side = np.mgrid[: rings - 1, :SIDES]
    a, b = ring * SIDES + side, ring * SIDES + (side + 1) % SIDES
    c, d = a + SIDES, b + SIDES
    lower, upper = np.stack([a, b, d], axis=-1), np.stack([a, d, c], axis=-1)
    return np.concatenate([lower, upper]).reshape(-1, 3).astype(np.int32)


def _joined(
    parts: Sequence[tuple[Array, NDArray[np.int32]]],
) -> tuple[Array, NDArray[np.int32]]:
    first = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    return (
        np.concatenate([vertices for vertices, _ in parts]),
        np.concatenate([faces + n for (_, faces), n in zip(parts, first, strict=False)]),
    )


# --- pictures ---------------------------------------------------------------------------------


def _add_picture(mujoco: Any, spec: Any, geom: str, picture: Image) -> None:
    """Put a red-green-blue picture on a geom; six stacked pictures form a cube map."""
    cube = picture.shape[0] == 6 * picture.shape[1]
    kinds = mujoco.mjtTexture
    file = f"{geom}.png"
    _, encoded = cv2.imencode(".png", picture[..., ::-1])
    spec.assets = {**spec.assets, file: encoded.tobytes()}
    texture = spec.add_texture(
        name=geom, type=kinds.mjTEXTURE_CUBE if cube else kinds.mjTEXTURE_2D, file=file
    )
    if cube:
        texture.gridsize, texture.gridlayout = [6, 1], "RLUDFB"
    material = spec.add_material(name=geom, specular=0.05)
    textures = ["" for _ in range(int(mujoco.mjtTextureRole.mjNTEXROLE))]
    textures[int(mujoco.mjtTextureRole.mjTEXROLE_RGB)] = geom
    material.textures = textures
    spec.geom(geom).material = geom


def _mat() -> Image:
    """Draw a cutting mat: a dark ground with a faint grid of 10 mm and 50 mm, and a rim."""
    columns, rows = (round(length * _MAT_PX_PER_MM) for length in _MAT_MM)
    ground = np.array([38.0, 58.0, 62.0])
    mat = np.broadcast_to(ground, (rows, columns, 3)).copy()
    for step_mm, width_px, shade in ((10, 1, 8.0), (50, 2, 20.0)):
        step = round(step_mm * _MAT_PX_PER_MM)
        for offset in range(width_px):
            mat[offset::step] = ground + shade
            mat[:, offset::step] = ground + shade
    rim, width = round(8 * _MAT_PX_PER_MM), 4
    line = np.zeros((rows, columns), bool)
    line[rim : rows - rim, rim : columns - rim] = True
    line[rim + width : rows - rim - width, rim + width : columns - rim - width] = False
    mat[line] = ground + 55.0
    return np.asarray(mat, np.uint8)


def _card() -> Image:
    """Draw a white card with a marker in its middle, upright when the gripper points down."""
    rows, columns = (length * _CARD_PX_PER_MM for length in _CARD_MM)
    side = round(CARD_MARKER_MM * _CARD_PX_PER_MM)
    words = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    card = np.full((rows, columns), 235, np.uint8)
    top, left = (rows - side) // 2, (columns - side) // 2
    marker = np.clip(cv2.aruco.generateImageMarker(words, 0, side), 18, 235)
    card[top : top + side, left : left + side] = marker
    return np.repeat(np.rot90(card)[..., None], 3, axis=2)


def _wooden_block() -> Image:
    """Draw six faces of pale wood with a straight grain."""
    rng = np.random.default_rng(7)
    place = np.linspace(0.0, 1.0, _BLOCK_PX)
    faces = []
    for _ in range(6):
        phase, bend = rng.uniform(0, 2 * math.pi, 2)
        wave = place[:, None] * 8 + 0.35 * np.sin(3 * place[None, :] + bend)
        grain = np.sin(2 * math.pi * wave + phase) + 0.4 * np.sin(4.3 * math.pi * wave)
        fine = np.repeat(rng.normal(0, 0.5, (_BLOCK_PX, 1)), _BLOCK_PX, axis=1)
        edge = np.minimum.reduce(np.meshgrid(np.minimum(place, 1 - place), place * 0 + 1))
        edge = np.minimum(edge, np.minimum(place, 1 - place)[:, None])
        shade = 1 + 0.035 * grain + 0.03 * fine - 0.16 * np.exp(-edge / 0.02)
        faces.append(np.array([222.0, 188.0, 140.0]) * shade[..., None])
    return np.asarray(np.concatenate(faces).clip(0, 255), np.uint8)
