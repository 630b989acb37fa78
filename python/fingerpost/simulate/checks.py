"""Checks of the options of the simulated rig, except arrays.

Each returns the value in the type that the package uses, or raises `InvalidInputError` with the
value's name, the value, and what would be right. Arrays are checked by
`fingerpost.checks.finite_array`.
"""

import math
import numbers
from collections.abc import Sequence
from typing import TypeVar

import numpy as np

from fingerpost.errors import InvalidInputError

Kind = TypeVar("Kind")


def number(name: str, value: object, low: float, high: float) -> float:
    """Return a finite real number that lies in [low, high]."""
    if isinstance(value, numbers.Real) and not isinstance(value, bool):
        real = float(value)
        if math.isfinite(real) and low <= real <= high:
            return real
    raise InvalidInputError(f"{name} is {value!r}; it must be a number from {low:g} to {high:g}")


def number_or_zero(name: str, value: object, low: float, high: float) -> float:
    """Return 0 or a finite real number that lies in [low, high], with 0 < low."""
    if isinstance(value, numbers.Real) and not isinstance(value, bool):
        real = float(value)
        if real == 0 or low <= real <= high:
            return real
    raise InvalidInputError(
        f"{name} is {value!r}; it must be 0 or a number from {low:g} to {high:g}"
    )


def whole(name: str, value: object, low: int, high: int) -> int:
    """Return a whole number that lies in [low, high]."""
    if isinstance(value, numbers.Integral) and not isinstance(value, bool):
        integer = int(value)
        if low <= integer <= high:
            return integer
    raise InvalidInputError(f"{name} is {value!r}; it must be a whole number from {low} to {high}")


def interval(name: str, value: object, low: float, high: float) -> tuple[float, float]:
    """Return an ordered pair of numbers in [low, high]; the two may be equal."""
    if isinstance(value, Sequence | np.ndarray) and len(value) == 2:
        first = number(f"{name}[0]", value[0], low, high)
        last = number(f"{name}[1]", value[1], low, high)
        if first <= last:
            return first, last
    raise InvalidInputError(
        f"{name} is {value!r}; it must be two numbers from {low:g} to {high:g}, the smaller first"
    )


def choice(name: str, value: object, allowed: Sequence[str]) -> str:
    """Return a string that is one of `allowed`."""
    if isinstance(value, str) and value in allowed:
        return value
    raise InvalidInputError(f"{name} is {value!r}; it must be one of {', '.join(allowed)}")


def instance(name: str, value: object, kind: type[Kind]) -> Kind:
    """Return a value of the given class."""
    if isinstance(value, kind):
        return value
    raise InvalidInputError(f"{name} is {value!r}; it must be a {kind.__name__}")


def generator(name: str, value: object) -> np.random.Generator:
    """Return a random generator from a generator or from a seed ≥ 0."""
    if isinstance(value, np.random.Generator):
        return value
    if isinstance(value, numbers.Integral) and not isinstance(value, bool) and int(value) >= 0:
        return np.random.default_rng(int(value))
    raise InvalidInputError(
        f"{name} is {value!r}; it must be a numpy.random.Generator or a seed, a whole number ≥ 0"
    )
