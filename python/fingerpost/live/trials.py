"""An experiment with an operator, who points at targets in random order and selects each.

The errors are evaluated as in section 3.3 of the paper, by the statistics of
`fingerpost.experiment`: the target is compared with the indicated point and its covariance.
"""

from __future__ import annotations

import math
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fingerpost.checks import unused
from fingerpost.experiment.summary import summarise
from fingerpost.experiment.table import table_lines
from fingerpost.experiment.trial import Trial
from fingerpost.live.reel import Indicated
from fingerpost.live.scene import CONFIDENCE, RigScene
from fingerpost.pointing import Status
from fingerpost.recording.tables import TableWriter, TargetRow, write_targets
from fingerpost.uncertainty import confidence_ellipse

DWELL_S = 1.5
"""Dwell time to select [s]."""

RADIUS_SHARE = 0.04
"""Radius within which the point must stay while dwelling, relative to the plane's size."""

BORDER_SHARE = 0.12
"""Distance of targets from the border of the reference points, relative to their extent."""

TABLE = "experiment.csv"

_GRID = (4, 3)
_FEWEST = 4  # of the rig's own targets, below which a grid is used
_SIDES = 24  # of the polygon by which an ellipse is drawn
_DIGITS = 5

Points = NDArray[np.float64]


class Selected(StrEnum):
    """Means by which the trial of a target ended."""

    DWELL = "dwell"
    KEY = "key"
    SKIP = "skip"


class OperatorExperiment:
    """One run through all targets.

    Parameters
    ----------
    rig
        The rig: its targets are used if there are four or more, else a grid.
    path
        The table to write; an existing file is replaced.
    rng
        Random numbers of the order.

    Raises
    ------
    InvalidInputError
        The file cannot be created.
    """

    def __init__(self, rig: RigScene, path: Path, rng: np.random.Generator) -> None:
        self._rig, self._path = rig, path
        self._targets = targets_of(rig)[rng.permutation(len(targets_of(rig)))]
        self._table: TableWriter[TargetRow] = write_targets(path)
        self._trials: list[Trial] = []
        self._drawn: list[dict[str, Any]] = []
        self._newest: Indicated | None = None
        self._stay: tuple[tuple[float, float], float] | None = None
        self._left: tuple[float, float] | None = None
        self._lines: list[str] = []
        self._ended = False

    @property
    def is_over(self) -> bool:
        """Whether no target is left, or the operator has ended it."""
        return self._ended

    @property
    def trials(self) -> tuple[Trial, ...]:
        """The completed targets, in order."""
        return tuple(self._trials)

    @property
    def _current(self) -> Points | None:
        done = len(self._trials)
        return None if self._ended or done >= len(self._targets) else self._targets[done]

    def take(self, indicated: Indicated) -> None:
        """Process a fix; dwelling selects."""
        self._newest = indicated
        point, now_s = indicated.point, indicated.time_s
        if self._current is None:
            return
        radius = RADIUS_SHARE * self._rig.plane_size
        if point is None:
            self._stay = None
            return
        if self._left is not None and math.dist(point, self._left) <= radius:
            return  # still at the previously selected place
        self._left = None
        if self._stay is None or math.dist(point, self._stay[0]) > radius:
            self._stay = point, now_s
        if now_s - self._stay[1] >= DWELL_S:
            self._add(indicated, Selected.DWELL)

    def select(self) -> str:
        """Select the indicated point; return the reason if refused, else an empty string."""
        if self._newest is None or self._newest.point is None:
            return "nothing is pointed at: there is no point now"
        self._add(self._newest, Selected.KEY)
        return ""

    def skip(self) -> None:
        """Skip the target; it counts as one without a point."""
        if self._newest is not None:
            self._add(self._newest, Selected.SKIP)

    def end(self) -> None:
        """End the experiment; completed targets are kept."""
        if self._ended:
            return
        self._ended = True
        self._table.close()
        if self._trials:
            rig = self._rig
            summary = summarise(self._trials, rig.plane_size)
            self._lines = table_lines(summary, rig.unit, rig.plane_size)

    def as_dict(self) -> dict[str, Any]:
        """Return the state for the page, as JSON values."""
        current = self._current
        return {
            "total": len(self._targets),
            "target": None if current is None else current.tolist(),
            "radius": RADIUS_SHARE * self._rig.plane_size,
            "dwell": self._dwell(),
            "done": self._drawn,
            "over": self._ended,
            "lines": self._lines,
            "file": str(self._path) if self._trials else "",
        }

    def _dwell(self) -> float:
        if self._stay is None or self._newest is None:
            return 0.0
        return round(min((self._newest.time_s - self._stay[1]) / DWELL_S, 1.0), 2)

    def _add(self, indicated: Indicated, by: Selected) -> None:
        target = self._current
        if target is None:
            return
        number = len(self._trials)
        if by is Selected.SKIP or indicated.point is None or indicated.covariance is None:
            status = Status.LOST if indicated.status is Status.OK else indicated.status
            trial = Trial(number, target, status, by.value)
        else:
            xx, xy, yy = indicated.covariance
            covariance = np.array([[xx, xy], [xy, yy]])
            trial = Trial(
                number, target, Status.OK, point=np.array(indicated.point), covariance=covariance
            )
        self._trials.append(trial)
        self._table.write(_row(indicated, trial, by))
        self._drawn.append(self._scene(trial))
        self._left, self._stay = indicated.point, None
        if len(self._trials) == len(self._targets):
            self.end()

    def _scene(self, trial: Trial) -> dict[str, Any]:
        """Return a completed target as the plan draws it."""
        scene: dict[str, Any] = {"target": trial.target.tolist()}
        if trial.point is not None and trial.covariance is not None:
            ellipse = confidence_ellipse(trial.point, trial.covariance, CONFIDENCE)
            scene["point"] = np.round(trial.point, _DIGITS).tolist()
            scene["ellipse"] = np.round(ellipse.polygon(_SIDES), _DIGITS).ravel().tolist()
            scene["held"] = trial.mahalanobis2 <= -2.0 * math.log1p(-CONFIDENCE)
            scene["error"] = f"{trial.error:.{self._rig.digits}f}"
        return scene


def new_table(folder: Path) -> Path:
    """Return an unused name in a folder for an experiment's table."""
    return unused(folder / TABLE)


def targets_of(rig: RigScene) -> Points:
    """Return the positions (N, 2) of an experiment's targets, in the plane's order."""
    own = [target.corners.mean(axis=0) for target in rig.targets if not target.rest]
    if len(own) >= _FEWEST:
        return np.array(own)
    lower, upper = rig.plane_points.min(axis=0), rig.plane_points.max(axis=0)
    border = BORDER_SHARE * (upper - lower)
    axes = [
        np.linspace(low, high, count)
        for low, high, count in zip(lower + border, upper - border, _GRID, strict=True)
    ]
    return np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)


def _row(indicated: Indicated, trial: Trial, by: Selected) -> TargetRow:
    found: dict[str, float] = {}
    if trial.point is not None and trial.covariance is not None:
        (x, y), Σ = trial.point.tolist(), trial.covariance.tolist()
        found = {"x": x, "y": y, "cov_xx": Σ[0][0], "cov_xy": Σ[0][1], "cov_yy": Σ[1][1]}
        found["error"] = trial.error
    x, y = trial.target.tolist()
    return TargetRow(
        frame=indicated.frame,
        time_s=indicated.time_s,
        status=trial.status.value,
        target_x=x,
        target_y=y,
        by=by.value,
        **found,
    )
