"""Point with two cameras that this program opens itself.

    python two_webcams.py RIG.TOML 0 1

Camera numbers, or films, in the order of the rig's views; their `source` is not used.
"""

import sys
import time

import cv2

import fingerpost as fp


def main(rig_file: str, *sources: str) -> None:
    pointer = fp.Pointer(fp.Rig.load(rig_file))
    cameras = [cv2.VideoCapture(int(name) if name.isdecimal() else name) for name in sources]
    while all(camera.grab() for camera in cameras):  # all at once, then decoded
        if sources[0].isdecimal():
            time_s = time.monotonic()
        else:
            time_s = cameras[0].get(cv2.CAP_PROP_POS_MSEC) / 1000
        images = [camera.retrieve()[1] for camera in cameras]
        for fix in pointer.push(images, time_s):
            print(f"{fix.time_s:.3f}", fix.status, fix.point if fix.point is not None else "")
    for camera in cameras:
        camera.release()


if __name__ == "__main__":
    main(*sys.argv[1:])
