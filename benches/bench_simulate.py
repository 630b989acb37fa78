"""Time of the simulated rig for a stereo pair, on one core.

    python benches/bench_simulate.py

Each scene is rendered over a path of poses. The figures are medians over the frames, in ms for both
views, truth and noise included: processor time, and wall time, which is longer when the machine has
other work. The table is painted before the clock starts. "2 per sigma" are scenes with
`Sensor(cells_per_sigma=2)`; "all on" is wood, sheet, sleeve, shading and shadow.
"""

import statistics
import time

import cv2

from fingerpost.simulate import (
    Background,
    Hand,
    Lighting,
    Placement,
    Sensor,
    SimulatedRig,
    Trajectory,
    figure_eight,
)

FRAMES = 60
WARM_UP = 5
SHADED = Lighting(side_light=0.3, limb_darkening=0.3)
SCENES: dict[str, SimulatedRig] = {
    "rod and prong, plain": SimulatedRig(),
    "rod and prong, shaded": SimulatedRig(lighting=SHADED),
    "rod and prong, clutter": SimulatedRig(background=Background(clutter=50)),
    "rod and prong, lens": SimulatedRig(Placement(k1=(-0.2,))),
    "rod and prong, 10 ms exposure": SimulatedRig(sensor=Sensor(exposure_s=0.01)),
    "rod and prong, 1280 × 720": SimulatedRig(Placement(width_px=1280, height_px=720)),
    "hand, plain": SimulatedRig(device=Hand()),
    "hand, plain, 2 per sigma": SimulatedRig(device=Hand(), sensor=Sensor(cells_per_sigma=2)),
    "hand, shaded": SimulatedRig(device=Hand(), lighting=SHADED),
    "hand, colour, all on, 2 per sigma": SimulatedRig(
        device=Hand(sleeve=True),
        background=Background(texture="wood", sheet=60),
        lighting=Lighting(side_light=0.3, limb_darkening=0.3, shadow=0.4),
        sensor=Sensor(channels="bgr", cells_per_sigma=2),
    ),
}


def median_ms(rig: SimulatedRig) -> tuple[float, float]:
    """Return the median processor and wall time of a frame of all views [ms]."""
    path = Trajectory.through(figure_eight(rig.workspace), 0.35)
    processor, wall = [], []
    for index in range(WARM_UP + FRAMES):
        began = time.process_time(), time.perf_counter()
        rig.render(path, time_s=index / 30, rng=index)
        processor.append(time.process_time() - began[0])
        wall.append(time.perf_counter() - began[1])
    return (
        1000 * statistics.median(processor[WARM_UP:]),
        1000 * statistics.median(wall[WARM_UP:]),
    )


def main() -> None:
    """Print one line per scene."""
    cv2.setNumThreads(1)
    for name, rig in SCENES.items():
        size = f"{rig.cameras[0].width_px} × {rig.cameras[0].height_px}"
        processor, wall = median_ms(rig)
        print(f"{name:36} {size:>12} {processor:7.2f} ms/pair (wall {wall:.2f})")


if __name__ == "__main__":
    main()
