"""Build a rig in Python and push NumPy images, those of each view when they come.

    python pushed_frames.py

Two simulated cameras stand in for yours; the second takes its pictures 10 ms later.
"""

import numpy as np

import fingerpost as fp
from fingerpost.simulate import DevicePose, Placement, SimulatedRig, Trajectory

LATE_S = 0.01


def main() -> None:
    cameras = SimulatedRig(Placement(time_skews_s=(0.0, LATE_S)))
    poses = [
        DevicePose.pointing_at(target, azimuth_deg=20, slant_deg=50, hover_mm=120)
        for target in ((150, 200), (250, 200))
    ]
    motion = Trajectory.hold(poses[0], 0.5).then(Trajectory.through(poses, 0.2))

    plane = fp.Plane(unit="mm", points=[[0, 0], [400, 0], [400, 400], [0, 400]])
    left, right = (camera.image_from_plane for camera in cameras.cameras)
    views = [
        fp.View.from_homography("left", left, plane),
        fp.View.from_homography("right", right, plane),
    ]
    pointer = fp.Pointer(fp.Rig(plane=plane, views=views))

    rng = np.random.default_rng(1)
    for frame in range(20):
        time_s = frame / 25
        images = cameras.render(motion, time_s=time_s, rng=rng).images
        fixes = pointer.push({"left": images[0]}, time_s)
        fixes += pointer.push({"right": images[1]}, time_s + LATE_S)
        for fix in fixes:
            true = motion.pose_at(fix.time_s).indicated_mm
            print(f"{fix.time_s:.2f} s", fix.status, fix.point, "true:", true.round(1))


if __name__ == "__main__":
    main()
