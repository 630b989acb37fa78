"""Operators by name: one file for each person's habit, and the correction of fixes by it.

The file contains the targets and the points indicated for them; the habit is estimated again when
the file is read. It is in the plane's coordinates, and therefore valid for one plane and for an
operator who stands at the same side of it as during the calibration.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, replace
from pathlib import Path

import click
import msgspec
import numpy as np

from fingerpost.checks import part_of
from fingerpost.errors import InvalidInputError
from fingerpost.habit import Habit
from fingerpost.pointing import Fix, Status
from fingerpost.uncertainty import largest_sigma

SUFFIX = ".toml"

Pair = tuple[float, float]


class _Visit(msgspec.Struct, forbid_unknown_fields=True):
    target: Pair
    point: Pair


class _File(msgspec.Struct, forbid_unknown_fields=True):
    unit: str
    visits: list[_Visit] = msgspec.field(name="visit")


def operators_folder() -> Path:
    """Return the folder of the operators' files: in the platform's folder for settings."""
    return Path(click.get_app_dir("fingerpost")) / "operators"


def operator_file(name: str) -> Path:
    """Return the file of an operator.

    Parameters
    ----------
    name
        The name of a file in `operators_folder` without suffix; or a path, which ends in .toml.

    Raises
    ------
    InvalidInputError
        It is neither.
    """
    if name.endswith(SUFFIX):
        return Path(name)
    if not name.isprintable() or name.strip(". ") != name or not name or set(name) & set('/\\:*?"'):
        raise InvalidInputError(
            f"operator {name!r}: a name, such as anna, or a file that ends in .toml is right"
        )
    return operators_folder() / f"{name}{SUFFIX}"


@dataclass(frozen=True, eq=False)
class Operator:
    """A person who points, with an estimated habit.

    Attributes
    ----------
    name
        Name of the person.
    unit
        Unit of the plane of the calibration.
    habit
        Habit of pointing.
    """

    name: str
    unit: str
    habit: Habit

    @classmethod
    def load(cls, name: str | Path) -> Operator:
        """Read an operator.

        Parameters
        ----------
        name
            As for `operator_file`.

        Raises
        ------
        InvalidInputError
            There is no operator of that name, or the file does not describe one.
        """
        path = operator_file(str(name))
        try:
            found = msgspec.convert(tomllib.loads(path.read_text(encoding="utf-8")), _File)
            habit = Habit.of(
                np.array([visit.target for visit in found.visits]).reshape(-1, 2),
                np.array([visit.point for visit in found.visits]).reshape(-1, 2),
            )
        except FileNotFoundError as error:
            raise InvalidInputError(_unknown(str(name), path)) from error
        except OSError as error:
            raise InvalidInputError(f"{path}: cannot be read: {error.strerror}") from error
        except (ValueError, msgspec.ValidationError) as error:  # invalid TOML, UTF-8 or habit
            raise InvalidInputError(
                f"{path}: {error}; a file that `fingerpost calibrate-operator` wrote is needed"
            ) from error
        return cls(path.stem, found.unit, habit)

    def save(self, path: Path) -> None:
        """Write a file that `load` reads back as the same operator.

        Raises
        ------
        InvalidInputError
            The file cannot be written.
        """
        pairs = zip(self.habit.targets.tolist(), self.habit.points.tolist(), strict=True)
        visits = [f"\n[[visit]]\ntarget = {target}\npoint = {point}\n" for target, point in pairs]
        head = (
            "# What was pointed at, and what was indicated, by `fingerpost calibrate-operator`.\n"
        )
        unit = msgspec.json.encode(self.unit).decode()
        part = part_of(path)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            part.write_text(f"{head}unit = {unit}\n{''.join(visits)}", encoding="utf-8")
            part.replace(path)
        except OSError as error:
            part.unlink(missing_ok=True)
            raise InvalidInputError(f"{path}: cannot be written: {error.strerror}") from error

    def refuse_other_unit(self, unit: str) -> None:
        """Refuse a plane of another unit than that of the calibration.

        Raises
        ------
        InvalidInputError
        """
        if unit != self.unit:
            raise InvalidInputError(
                f'operator "{self.name}" was calibrated in {self.unit}, and the plane\'s unit is '
                f"{unit}; `fingerpost calibrate-operator` on this rig is needed"
            )

    def meant(self, fix: Fix, max_sigma: float) -> Fix:
        """Return a fix with the habit subtracted from its point; one without a point is unchanged.

        Parameters
        ----------
        fix
            The fix of the pipeline.
        max_sigma
            Largest standard deviation of a point in any direction [plane units].
        """
        if fix.point is None or fix.covariance is None:
            return fix
        meant = self.habit.meant(fix.point, fix.covariance)
        # Points at the outermost targets scatter beyond the hull as well.
        words = self._beyond(meant.beyond) if meant.beyond > self.habit.scatter else ""
        sigma = largest_sigma(meant.covariance)
        if sigma > max_sigma:
            doubt = f'standard deviation {sigma:.3g} with the habit of operator "{self.name}"'
            reason = _together(words, f"{doubt}; at most {max_sigma:.3g} is accepted")
            return replace(
                fix,
                status=Status.ILL_CONDITIONED,
                point=None,
                covariance=meant.covariance,
                reason=reason,
            )
        return replace(
            fix,
            point=meant.point,
            covariance=meant.covariance,
            reason=_together(fix.reason, words),
        )

    def _beyond(self, distance: float) -> str:
        return f'{distance:.3g} {self.unit} beyond the targets of operator "{self.name}"'


def _together(*reasons: str) -> str:
    return "; ".join(filter(None, reasons))


def _unknown(name: str, path: Path) -> str:
    if name.endswith(SUFFIX):
        return f"{path}: there is no such file"
    known = sorted(file.stem for file in operators_folder().glob(f"*{SUFFIX}"))
    return (
        f'there is no operator "{name}" in {operators_folder()}; known: '
        f"{', '.join(known) or 'nobody yet'}; `fingerpost calibrate-operator` makes one"
    )
