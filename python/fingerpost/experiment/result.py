"""The outcome of an experiment: as a table, as data, as a picture."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, is_dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fingerpost.errors import InvalidInputError
from fingerpost.experiment.summary import Summary, summarise
from fingerpost.experiment.table import table_lines
from fingerpost.experiment.trial import Trial


@dataclass(frozen=True, eq=False)
class ExperimentResult:
    """Outcome of an experiment.

    Attributes
    ----------
    title
        The experiment and its conditions: lines of text.
    settings
        The same, complete, as JSON values.
    unit
        Name of the plane's unit.
    plane_size
        Side of the working plane [plane units].
    plane_points : (N, 2)
        Its reference points.
    trials
        One per target, in order; at least one.
    """

    title: tuple[str, ...]
    settings: Mapping[str, Any]
    unit: str
    plane_size: float
    plane_points: NDArray[np.float64]
    trials: tuple[Trial, ...]

    @cached_property
    def summary(self) -> Summary:
        """The figures; `fingerpost.experiment.summary` defines each."""
        return summarise(self.trials, self.plane_size)

    def table(self) -> list[str]:
        """Return title and figures as lines of text."""
        return [*self.title, "", *table_lines(self.summary, self.unit, self.plane_size)]

    def as_dict(self) -> dict[str, Any]:
        """Return settings and figures, as JSON values: None where there is no number."""
        return {
            "settings": _for_json(self.settings),
            "unit": self.unit,
            "plane_size": self.plane_size,
            "figures": _for_json(self.summary),
        }

    def draw(self, path: str | Path) -> None:
        """Draw the points with their ellipses over the workspace, and the coverage.

        Parameters
        ----------
        path
            An image file; its suffix, such as ``.png``, determines the format.

        Raises
        ------
        InvalidInputError
            The file or its format cannot be written; or points have no covariance, and so no
            ellipses.
        """
        if self.summary.points is not None and not self.summary.points.coverages:
            raise InvalidInputError(f"{path}: points without cov_xx, cov_xy, cov_yy are not drawn")
        from fingerpost.experiment.drawing import draw_result  # OpenCV is slow to load

        draw_result(self, Path(path))


def _for_json(value: Any) -> Any:
    if is_dataclass(value) and not isinstance(value, type):
        return _for_json(asdict(value))
    if isinstance(value, Mapping):
        return {str(key): _for_json(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_for_json(entry) for entry in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
