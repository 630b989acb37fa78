"""Options that keep to their ranges, whoever makes them.

The range of every option stands once, in the annotation of its field. `msgspec` reads it when it
converts text; a struct's constructor does not, so `CheckedOptions` does: the origin of an
option makes no difference, be it a command line, a URL, or a program.
"""

from __future__ import annotations

import numbers
import operator
import sys
from collections.abc import Callable
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import msgspec

from fingerpost.errors import InvalidInputError

_BOUNDS: dict[str, tuple[Callable[[Any, Any], bool], str]] = {
    "gt": (operator.gt, "above"),
    "ge": (operator.ge, "from"),
    "lt": (operator.lt, "to below"),
    "le": (operator.le, "to"),
}
"""The bounds of `msgspec.Meta`: what a value must satisfy, and how that is said,
the lower one first."""


class CheckedOptions(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base of all options: refuses what the annotations of its fields do not allow.

    A number is finite, whatever its bounds.

    Raises
    ------
    InvalidInputError
        A field is of another type or out of its range; the message names it, its value and what
        would be right.
    """

    def __post_init__(self) -> None:
        for field in msgspec.structs.fields(self):
            value = getattr(self, field.name)
            if not _fits(value, field.type):
                shown = value if isinstance(value, numbers.Real) else repr(value)
                raise InvalidInputError(f"{field.name} is {shown}; {_words(field.type)} is right")


def _fits(value: Any, kind: Any) -> bool:
    """Whether a value is what an annotation allows."""
    arguments = get_args(kind)
    match get_origin(kind):
        case origin if origin in (Union, UnionType):
            return any(_fits(value, one) for one in arguments)
        case origin if origin is Annotated:
            return _fits(value, arguments[0]) and all(
                fulfils(value, bound)
                for meta in arguments[1:]
                for name, (fulfils, _) in _BOUNDS.items()
                if (bound := getattr(meta, name)) is not None
            )
        case origin if origin is Literal:
            return value in arguments
        case origin if origin is tuple:
            return (
                isinstance(value, tuple | list)
                and len(value) == len(arguments)
                and all(map(_fits, value, arguments))
            )
    if kind not in (float, int):
        return isinstance(value, kind)
    number: type[Any] = numbers.Real if kind is float else numbers.Integral
    if not isinstance(value, number) or isinstance(value, bool):
        return False
    # NaN fails the comparison; so do infinity and whole numbers beyond any float.
    return bool(-sys.float_info.max <= value <= sys.float_info.max)


def _words(kind: Any) -> str:
    """Say what an annotation allows."""
    arguments = get_args(kind)
    match get_origin(kind):
        case origin if origin in (Union, UnionType):
            return " or ".join(_words(one) for one in arguments)
        case origin if origin is Annotated:
            bounds = [
                f"{word} {bound:g}"
                for meta in arguments[1:]
                for name, (_, word) in _BOUNDS.items()
                if (bound := getattr(meta, name)) is not None
            ]
            return f"{_words(arguments[0])} {' '.join(bounds)}"
        case origin if origin is Literal:
            return " or ".join(map(repr, arguments))
        case origin if origin is tuple:
            return f"{len(arguments)} values, each {_words(arguments[0])},"
    names = {float: "a finite number", int: "a whole number", str: "text", type(None): "None"}
    return names.get(kind) or f"a {kind.__name__}"
