"""Behaviour of the arm without a hand: no hand comes, or it vanishes while the arm follows it.

    python benches/unattended.py [--seeds 40] [--workers 2]

The simulated cell under physics, with its cameras always on and the dead man's key held down
throughout: the same session that `fingerpost robot pick` runs. Prints a line for every seed that
violates a limit, and the worst of each kind.
"""

import argparse
from concurrent.futures import as_completed

from fingerpost.closed_loop import GuidanceOptions
from fingerpost.closed_loop.setup import exact_rig
from fingerpost.closed_loop.trials import stay_away, vanish
from fingerpost.workers import sharing, worker_count

HELD_S = 0.5
"""Maximum time from the disappearance of the hand to the stop of the arm [s]."""

STILL_MM = 1.0
"""Maximum travel of an arm that was sent no goal, from the compliance of its joints [mm]."""


def main() -> None:
    """Run both kinds for every seed."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, default=40)
    parser.add_argument("--workers", type=int)
    given = parser.parse_args()
    options = GuidanceOptions()
    rig = exact_rig(options.cameras.cameras(), 0.0)
    with sharing(worker_count(given.workers)) as pool:
        kinds = {
            pool.submit(kind, seed, rig, options): kind
            for seed in range(given.seeds)
            for kind in (stay_away, vanish)
        }
        results = {stay_away: [], vanish: []}
        for future in as_completed(kinds):
            kind, result = kinds[future], future.result()
            results[kind].append(result)
            late = kind is vanish and not (result.held_s is not None and result.held_s <= HELD_S)
            moved = kind is stay_away and result.travel_mm > STILL_MM
            if result.problem or result.false_fixes or late or moved:
                print(f"{kind.__name__} {result}", flush=True)
    away, gone = results[stay_away], results[vanish]
    print(
        f"no hand: {len(away)} seeds, gripper moved by {max(r.travel_mm for r in away):.2f} mm at "
        f"most, {sum(r.false_fixes for r in away)} frames with a fix"
    )
    held = [r.held_s for r in gone if r.held_s is not None]
    print(
        f"hand vanishes: held in {len(held)} of {len(gone)}, after {max(held):.3f} s at most, "
        f"{max(r.travel_mm for r in gone):.0f} mm further at most, "
        f"{sum(r.false_fixes for r in gone)} frames with a fix"
    )


if __name__ == "__main__":
    main()
