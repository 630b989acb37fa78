"""fingerpost itself: `ours.py JOB.JSON MODEL`, the band model (ribbon) or the paper's (paper)."""

from __future__ import annotations

import json
import sys
import time
from contextlib import ExitStack
from pathlib import Path

from footage import finish

import fingerpost
from fingerpost.capture import open_views, read_views
from fingerpost.config import Rig
from fingerpost.pipeline import Pointer

job = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))
rig = Rig.load(job["rig"])
pointer = Pointer(rig, tracker_options={"model": sys.argv[2]})
steps, spent_s = [], []
with ExitStack() as stack:
    sources = stack.enter_context(open_views(rig.sources, rig.readings))
    for frames in read_views(sources):
        begun = time.process_time()
        steps += pointer.update(frames)
        spent_s.append(time.process_time() - begun)
steps += pointer.finish()
points = []
for step in steps:
    fix = step.fix
    if fix.point is None or fix.covariance is None:
        continue
    (x, y), ((xx, xy), (_, yy)) = fix.point.tolist(), fix.covariance.tolist()
    points.append(f"{step.index},{fix.time_s!r},ok,{x!r},{y!r},{xx!r},{xy!r},{yy!r},")
finish({"version": fingerpost.__version__, "points": points}, spent_s)
