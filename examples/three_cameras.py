"""Point with three cameras, or more, and see which of them each point is made of.

    python three_cameras.py RIG.TOML

Two views are enough for a point; every further one makes it surer, and one may lose the hand.
"""

import sys

import fingerpost as fp


def main(rig_file: str) -> None:
    rig = fp.Rig.load(rig_file)
    for fix, frames in fp.track(rig, frames=True):
        if fix.point is None:
            print(frames[0].index, fix.status, fix.reason)
            continue
        lines = zip(rig.views, fix.constraint_lines, strict=True)
        seen_by = [view.name for view, line in lines if line is not None]
        (x, y), ellipse = fix.point, fix.ellipse(confidence=0.95)
        print(frames[0].index, f"({x:.1f}, {y:.1f}) ± {ellipse.semi_axes[0]:.1f}", "by", *seen_by)


if __name__ == "__main__":
    main(*sys.argv[1:])
