"""Draw where a hand has pointed, with 95 % ellipses.

    python plot.py RIG.TOML PICTURE.PNG

Needs matplotlib: pip install 'fingerpost[plot]'
"""

import sys

import matplotlib.pyplot as plt
import numpy as np

import fingerpost as fp


def main(rig_file: str, picture: str) -> None:
    rig = fp.Rig.load(rig_file)
    fixes = [fix for fix in fp.track(rig) if fix.point is not None]
    figure, axes = plt.subplots()
    axes.fill(*np.transpose(rig.plane.points), facecolor="none", edgecolor="grey")
    for fix in fixes[::5]:
        axes.fill(*fix.ellipse(confidence=0.95).polygon().T, facecolor="tab:blue", alpha=0.15)
    axes.plot(*np.transpose([fix.point for fix in fixes]), ".-")
    axes.set(xlabel=f"X in {rig.plane.unit}", ylabel=f"Y in {rig.plane.unit}", aspect="equal")
    figure.savefig(picture)
    print(f"{picture}: {len(fixes)} points")


if __name__ == "__main__":
    main(*sys.argv[1:])
