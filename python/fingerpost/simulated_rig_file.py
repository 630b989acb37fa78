"""Description of a simulated rig as a `Rig`, for experiments, the demo and tests."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from numpy.typing import ArrayLike

from fingerpost import checks
from fingerpost.config import LensParameters, Pair, Plane, Rig, Start, View
from fingerpost.simulate import SimulatedRig, StartPose


def rig_from_simulation(
    simulated: SimulatedRig,
    *,
    reference_points_px: Sequence[ArrayLike] | None = None,
    starts: Sequence[StartPose | None] | None = None,
    lenses: Sequence[LensParameters | None] | None = None,
    sources: Sequence[str | int] | None = None,
) -> Rig:
    """Describe a simulated rig as if it had been measured.

    Parameters
    ----------
    simulated : SimulatedRig
        The simulation. Its plane is given exactly, in mm, and its views have the cameras' names.
    reference_points_px : sequence of array_like (N, 2), optional
        Measured reference points in each view [px]; the exact ones by default.
    starts : sequence of StartPose or None, optional
        Start poses of the templates; none by default: the hand has to be found.
    lenses : sequence of LensParameters or None, optional
        Known lenses; none by default.
    sources : sequence of str or int, optional
        Sources of the streams; by default the cameras' names, which cannot be opened.

    Returns
    -------
    Rig
        As if read from a file.

    Raises
    ------
    InvalidInputError
        Reference points that are not finite, or whose number is not that of the plane's.
    ValueError
        A sequence whose length is not the number of cameras.
    """
    cameras = simulated.cameras
    nothing = [None] * len(cameras)
    views = zip(
        cameras,
        simulated.reference_points_px if reference_points_px is None else reference_points_px,
        nothing if starts is None else starts,
        nothing if lenses is None else lenses,
        [camera.name for camera in cameras] if sources is None else sources,
        strict=True,
    )
    return Rig(
        plane=Plane(unit="mm", points=_pairs(simulated.plane_points, "plane_points")),
        views=tuple(
            View(
                name=camera.name,
                source=source,
                reference_points_px=_pairs(points_px, "reference_points_px"),
                size_px=(camera.width_px, camera.height_px),
                lens_parameters=lens,
                start=None if start is None else Start(**dataclasses.asdict(start)),
            )
            for camera, points_px, start, lens, source in views
        ),
    )


def _pairs(points: ArrayLike, name: str) -> tuple[Pair, ...]:
    return tuple((float(u), float(v)) for u, v in checks.finite_array(points, name, ("N", 2)))
