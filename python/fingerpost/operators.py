"""Operators by name: each person's habit in a file of his own, and fixes without it.

The file holds what was pointed at and what was indicated; the habit is estimated anew when it
is read. It is in the plane's coordinates, so it holds for one plane, and for who stands at the side
of it that he was calibrated at.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, replace
from pathlib import Path

import click
import msgspec
import numpy as np

from fingerpost.config import part_of
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
    """Return where operators are kept: in the platform's folder for settings of programs."""
    return Path(click.get_app_dir("fingerpost")) / "operators"


def operator_file(name: str) -> Path:
    """Return the file of an operator.

    Parameters
    ----------
    name
        A name, which stands for a file in `operators_folder`; or a file, which ends in .toml.

    Raises
    ------
    InvalidInputError
        Neither.
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
    """A person who points, and his habit.

    Attributes
    ----------
    name
        What he is called.
    unit
        Of the plane that he was calibrated on.
    habit
        By how much he points beside what he means.
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
            As of `operator_file`.

        Raises
        ------
        InvalidInputError
            There is none of that name, or the file is none of an operator.
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
        except (ValueError, msgspec.ValidationError) as error:  # no TOML, no UTF-8, no habit
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
        """Return a fix with the habit subtracted from its point; one without a point as it is.

        Parameters
        ----------
        fix
            What was indicated.
        max_sigma
            Largest standard deviation of a point in any direction [plane units].
        """
        if fix.point is None or fix.covariance is None:
            return fix
        meant = self.habit.meant(fix.point, fix.covariance)
        # Those at the outermost targets scatter as well.
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
