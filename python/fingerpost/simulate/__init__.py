"""A simulated rig: cameras over a table, a pointing device, pictures, and their ground truth.

    rig = SimulatedRig(background=Background(clutter=50))
    pose = PoseSampler(rig).draw(rng)
    frame = rig.render(pose, rng=rng)
    frame.images                        # one uint8 picture per view
    frame.truth.indicated_mm            # indicated point on the plane

It replaces cameras in the demo, in the accuracy experiment and in tests. Geometry is exact:
outlines of sphere-swept cones are known in closed form, polygons are rasterised by area, and the
few approximations are stated where they are made (the error of an edge is at most 0.0003 px).
Lengths are in mm, times in s, angles in deg for inputs and rad in results.
"""

from fingerpost.simulate.camera import Camera, Placement, Workspace
from fingerpost.simulate.device import Body, Hand, Link, Material, PointingDevice, RodAndProng
from fingerpost.simulate.motion import Motion, Trajectory, figure_eight, pointing_session
from fingerpost.simulate.pose import DevicePose
from fingerpost.simulate.recording import write_recording
from fingerpost.simulate.render import Occluder
from fingerpost.simulate.rig import SimulatedFrame, SimulatedRig
from fingerpost.simulate.sampler import PoseLimits, PoseSampler
from fingerpost.simulate.scene import Background, LightChange, Lighting, Sensor
from fingerpost.simulate.truth import FingerTruth, FrameTruth, StartError, StartPose, ViewTruth

__all__ = [
    "Background",
    "Body",
    "Camera",
    "DevicePose",
    "FingerTruth",
    "FrameTruth",
    "Hand",
    "LightChange",
    "Lighting",
    "Link",
    "Material",
    "Motion",
    "Occluder",
    "Placement",
    "PointingDevice",
    "PoseLimits",
    "PoseSampler",
    "RodAndProng",
    "Sensor",
    "SimulatedFrame",
    "SimulatedRig",
    "StartError",
    "StartPose",
    "Trajectory",
    "ViewTruth",
    "Workspace",
    "figure_eight",
    "pointing_session",
    "write_recording",
]
