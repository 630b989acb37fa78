"""Options whose ranges are checked in every constructor.

The range of every option is defined once, in the annotation of its field. `msgspec` checks it when
it converts text, but not in a struct's constructor, so `CheckedOptions` does. Options from a
command line, a URL or a program are thus treated equally.
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
"""The bounds of `msgspec.Meta`: the condition and its text, the lower bound first."""


class CheckedOptions(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base class of all options: refuses values that the annotations of its fields exclude.

    A number must be finite, regardless of its bounds.

    Raises
    ------
    InvalidInputError
        A field has another type or is out of range; the message names it, its value and what would
        be right.
    """

    def __post_init__(self) -> None:
        for field in msgspec.structs.fields(self):
            value = getattr(self, field.name)
            if not _fits(value, field.type):
                shown = value if isinstance(value, numbers.Real) else repr(value)
                raise InvalidInputError(f"{field.name} is {shown}; {_words(field.type)} is right")


def _fits(value: Any, kind: Any) -> bool:
    """Whether a value satisfies an annotation."""
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
    # NaN fails the comparison; so do infinity and integers beyond the range of floats.
    return bool(-sys.float_info.max <= value <= sys.float_info.max)


def _words(kind: Any) -> str:
    """Describe the values that satisfy an annotation."""
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
