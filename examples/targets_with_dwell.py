"""Select things on the table by pointing at them for a second.

    python targets_with_dwell.py RIG.TOML

The rig file names them: [[target]] with name, and point and radius or polygon. Where it has one
with rest = true, the hand comes from there before each selection.
"""

import sys

import fingerpost as fp


def main(rig_file: str) -> None:
    rig = fp.Rig.load(rig_file)
    selector = fp.Selector(rig.things, dwell_s=1.0)
    for fix in fp.track(rig):
        for event in selector.update(fix):
            print(f"{event.time_s:.2f} s", event.event, event.target, f"{event.probability:.0%}")


if __name__ == "__main__":
    main(*sys.argv[1:])
