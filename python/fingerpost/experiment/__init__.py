r"""The accuracy experiment of the paper's section 3.3, and beyond.

    options = ExperimentOptions(targets=400, tracker={"model": "paper"})
    result = run_experiment(options, progress=lambda done, of: print(done, "of", of))
    print("\n".join(result.table()))
    result.draw("experiment.png")

A device at a random pose points at a random target. The views are rendered a few times with fresh
noise. One tracker per view starts from a start pose with an error of some pixels, degrees and
percent and converges; the reference points have errors as well. The result of the pointer
(`fingerpost.Pointer`, the same as for real cameras) for the last images is compared with the exact
truth. `run_recording` does the same on footage with known truth.

`summary` defines each figure, `bound` gives the theoretical limit.
"""

from fingerpost.experiment.footage import run_recording, score_points
from fingerpost.experiment.options import ExperimentOptions
from fingerpost.experiment.result import ExperimentResult
from fingerpost.experiment.run import Progress, run_experiment
from fingerpost.experiment.summary import Summary
from fingerpost.experiment.trial import LineTrial, Trial

__all__ = [
    "ExperimentOptions",
    "ExperimentResult",
    "LineTrial",
    "Progress",
    "Summary",
    "Trial",
    "run_experiment",
    "run_recording",
    "score_points",
]
