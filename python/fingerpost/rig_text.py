"""Parser of rig files: TOML, with suggestions for common typing mistakes.

The message about invalid TOML contains the line that would be right. Each repair below covers one
kind of mistake and yields suggestions for a line. A suggestion is accepted only if the file can
then be read beyond that line, so that advice is never worse than the mistake.
"""

from __future__ import annotations

import json
import re
import tomllib
import unicodedata
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

from fingerpost.errors import InvalidInputError

_BYTE_ORDER_MARKS = {
    b"\xff\xfe\x00\x00": "UTF-32",
    b"\x00\x00\xfe\xff": "UTF-32",
    b"\xff\xfe": "UTF-16",
    b"\xfe\xff": "UTF-16",
}
_SLIPS_A_LINE = 4  # a line with more mistakes is not a typing mistake
_LONGEST = 20_000  # characters of a rig file; it is read once for every suggestion
_LONGEST_LINE = 2_000
_SHOWN = 80  # longest part of a line in a message [characters]

# Number of entries in the innermost brackets of a key.
_COORDINATES = {
    "points": 2,
    "reference_points_px": 2,
    "corners_px": 2,
    "near_px": 2,
    "tip_px": 2,
    "size_px": 2,
    "region_m": 2,
    "z_m": 2,
    "reference_covariances_px2": 3,
}


def parsed(data: bytes) -> dict[str, Any]:
    """Parse the text of a rig file.

    Parameters
    ----------
    data
        TOML in UTF-8, with or without a byte order mark.

    Raises
    ------
    InvalidInputError
        The text is not TOML, or it is TOML with an unintended meaning; the message is one line with
        the place and, if known, what would be right.
    """
    text = _decoded(data)
    try:
        tables = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InvalidInputError(f"not valid TOML: {error}{_advice(text, error)}") from error
    except ValueError as error:  # Python reads no integer of thousands of digits
        raise InvalidInputError("not a rig file: a number has too many digits") from error
    except RecursionError as error:
        raise InvalidInputError("not a rig file: nested too deeply") from error
    _refuse_unmeant(tables, "", "")
    return tables


# --- bytes ------------------------------------------------------------------------------------


def _decoded(data: bytes) -> str:
    for mark, encoding in _BYTE_ORDER_MARKS.items():
        if data.startswith(mark):
            raise InvalidInputError(
                f"not a text file in UTF-8 but in {encoding}; save it again with the encoding UTF-8"
            )
    if b"\0" in data:
        raise InvalidInputError(
            "not a text file in UTF-8: it holds zeros, as videos, pictures and UTF-16 do; "
            "name a rig file (TOML), or save it again with the encoding UTF-8"
        )
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise InvalidInputError(
            f"not a text file in UTF-8: byte 0x{data[error.start]:02x} in line {line} "
            f"({error.reason}); save it again with the encoding UTF-8"
        ) from error
    return text.replace("\r\n", "\n").replace("\r", "\n")


# --- TOML of unintended meaning ---------------------------------------------------------------

_ESCAPES = {"\b": r"\b", "\t": r"\t", "\n": r"\n", "\f": r"\f", "\r": r"\r"}


def _refuse_unmeant(value: object, place: str, key: str) -> None:
    """Search all values for paths that lost their backslashes, and for decimal commas."""
    if isinstance(value, dict):
        for name, inner in value.items():
            _refuse_unmeant(inner, f"{place}.{name}".lstrip("."), name)
    elif isinstance(value, list):
        _refuse_decimal_commas(value, place, key)
        for k, inner in enumerate(value):
            _refuse_unmeant(inner, f"{place}[{k}]", key)
    elif key == "source" and isinstance(value, str):
        _refuse_escapes(value, place)


def _refuse_escapes(source: str, place: str) -> None:
    is_path_of_windows = "/" not in source or re.match("[A-Za-z]:", source)
    if is_path_of_windows and any(character in _ESCAPES for character in source):
        meant = "".join(_ESCAPES.get(character, character) for character in source)
        raise InvalidInputError(
            f"{place} is {_in_quotes(source)}: {_BACKSLASHES}; right would be '{meant}'"
        )


def _refuse_decimal_commas(values: list[Any], place: str, key: str) -> None:
    count = _COORDINATES.get(key, 0)
    if len(values) != 2 * count or not all(type(value) is int for value in values):
        return
    whole, fractions = values[::2], values[1::2]
    if count and min(fractions) >= 0:
        meant = ", ".join(f"{a}.{b}" for a, b in zip(whole, fractions, strict=True))
        raise InvalidInputError(f"{place} is {values}: {_DECIMAL_POINT}; right would be [{meant}]")


def _in_quotes(text: str) -> str:
    return json.dumps(text, ensure_ascii=False)


# --- invalid TOML -----------------------------------------------------------------------------

_BACKSLASHES = "in double quotes a backslash begins an escape"
_DECIMAL_POINT = "a number has a decimal point, and commas stand between numbers"
_COMMENTS = "a comment begins with #"
_EQUALS = "between a key and its value stands ="
_COMMAS = "a comma stands between two values"
_QUOTES = "words stand in quotes, of one kind at both ends"
_BRACKETS = "every bracket is opened and closed once"
_POINTS = "a number has digits before and behind its point"
_OWN_TABLE = "each view begins with a [[view]] of its own, in two brackets"

_KEY_AND_VALUE = re.compile(r"(\s*[\w.-]+\s*=\s*)(.*?)(\s*(?:#.*)?)")
_KEYBOARD = str.maketrans(
    dict.fromkeys("“”„‟«»″〝〞", '"')
    | dict.fromkeys("‘’‚‛′", "'")
    | dict.fromkeys("‐‑‒–—−", "-")
    | dict.fromkeys("\ufeff\u200b\u200c\u200d\u2060", "")
)

Repair = Callable[[str], Iterator[str]]
"""Yields corrections of a line, the likeliest first."""


def _instead(pattern: str, instead: str) -> Repair:
    """Return a repair that replaces all matches of a pattern."""

    def repair(line: str) -> Iterator[str]:
        yield re.sub(pattern, instead, line)

    return repair


def _backslashes(line: str) -> Iterator[str]:
    yield re.sub(r'"([^"\']*\\[^"\']*)"', r"'\1'", line)
    yield re.sub(r'"[^"]*"', lambda found: found[0].replace("\\", "/"), line)


def _typed(line: str) -> Iterator[str]:
    typed = line.translate(_KEYBOARD)
    yield typed
    yield re.sub("'([^'\"]*)'", r'"\1"', typed)
    yield unicodedata.normalize("NFKC", typed)  # wide letters, spaces that do not break


def _header(line: str) -> Iterator[str]:
    found = re.fullmatch(r"\s*[\[({<]*\s*([A-Za-z_.]+)\s*[\])}>]*(\s*(?:#.*)?)", line)
    if found and found[0].strip() != found[1]:
        name = f"[{found[1]}]"
        yield f"[{name}]{found[2]}" if name == "[view]" else f"{name}{found[2]}"


def _parentheses(line: str) -> Iterator[str]:
    yield re.sub(r"\(([^()]*)\)", r"[\1]", line)
    yield line.replace("(", "[").replace(")", "]")


def _lower_case(line: str) -> Iterator[str]:
    yield re.sub(r"\b(?:true|false)\b", lambda found: found[0].lower(), line, flags=re.IGNORECASE)


def _semicolons(line: str) -> Iterator[str]:
    """Replace semicolons by commas, and decimal commas between them by points."""
    if ";" in line:
        yield re.sub(r"\s*;\s*", ", ", re.sub(r"(?<=\d),(?=\d)", ".", line))


def _quoted(line: str) -> Iterator[str]:
    found = _KEY_AND_VALUE.fullmatch(line)
    if found and found[2][:1] not in tuple("[{") and re.search(r"[^\W\d_]", found[2]):
        words = found[2].strip("\"'`")
        if not set(words.translate(_KEYBOARD)) & set("\"'"):
            quote = "'" if "\\" in words else '"'
            yield f"{found[1]}{quote}{words}{quote}{found[3]}"


def _closed(line: str) -> Iterator[str]:
    yield re.sub(r"(?<=\d)(,\s*)\[", r"]\1[", line)
    for brackets in ("]", "]]", "]]]", " }", "] }"):
        yield re.sub(r"(\s*(?:#[^\"']*)?)$", rf"{brackets}\1", line, count=1)


def _opened(line: str) -> Iterator[str]:
    yield re.sub(r"(\],\s*)(?=[-+.\d])", r"\1[", line)
    found = _KEY_AND_VALUE.fullmatch(line)
    if found and found[2]:
        key, value, comment = found.groups()
        has_rows = re.search(r"\]\s*,\s*\[", value)
        for whole in (
            value if value.startswith("[[") or not has_rows else f"[{value}",
            value if value.startswith("[") else f"[{value}",
            value if value.startswith("[") else f"[{value}]",
        ):
            excess = whole.count("]") - whole.count("[")
            if excess in (0, 1) and "[" in whole:
                yield f"{key}{whole[:-1] if excess else whole}{comment}"


def _with_comma(line: str) -> Iterator[str]:
    yield re.sub(r"(\s*(?:#.*)?)$", r",\1", line, count=1)


# The rule that a mistake breaks, and its repair; the most obvious mistakes come first.
_REPAIRS: tuple[tuple[str, Repair], ...] = (
    (_BACKSLASHES, _backslashes),
    ("quotes, dashes and spaces are the plain ones of a keyboard", _typed),
    ("a table's name stands in brackets, that of a view in two", _header),
    (_COMMENTS, _instead(r"(^|\s)(?://|;|--|%)(?=\s|\w|$)", r"\1#")),
    (_EQUALS, _instead(r"^(\s*[\w.-]+)\s*(?::=|==|=>|:)\s*", r"\1 = ")),
    (_EQUALS, _instead(r"^(\s*[\w.-]+)\s+(?=[^\s=])", r"\1 = ")),
    ("nothing stands behind a value", _instead(r"\s*[;,]\s*(#.*)?$", r"  \1")),
    ("nothing stands behind the last value", _instead(r",\s*([}])", r" \1")),
    ("true and false are written small", _lower_case),
    ("a number does not begin with a zero", _instead(r"(?<![\w.,])0+(?=\d)", "")),
    (_DECIMAL_POINT, _instead(r"(?<=\d),(?=\d)", ".")),
    (_POINTS, _instead(r"(?<![\w.])\.(?=\d)", "0.")),
    (_POINTS, _instead(r"(?<=\d)\.(?!\d)", ".0")),
    (
        "the unit is part of the key, not of the number",
        _instead(r"(?<=\d)\s*(?:px|mm|cm|m|deg|rad|s|°|%)(?=\s*(?:[,\]}#]|$))", ""),
    ),
    ("a list stands in square brackets", _parentheses),
    (_COMMAS, _semicolons),
    (_COMMAS, _instead(r"(?<=[\d\]])\s+(?=[-+.\d\[])|(?<=\])(?=\[)", ", ")),
    (_COMMAS, _instead(r"(?<=[^\s,{])\s+(?=[A-Za-z]\w*\s*=)", ", ")),
    (_EQUALS, _instead(r"(?<=[{,])(\s*\w+)\s*:\s*", r"\1 = ")),
    (_QUOTES, _instead(r"(?<==)\s*[rRbBfFuU]+(?=[\"'])", " ")),
    (_QUOTES, _instead(r"(?<==)\s*([A-Za-z][\w./-]*)(?=\s*[,}])", r' "\1"')),
    (_QUOTES, _quoted),
    (_BRACKETS, _closed),
    (_BRACKETS, _opened),
)
# Repairs of the previous line: a list continues over line ends until its bracket is closed.
_REPAIRS_BEFORE: tuple[tuple[str, Repair], ...] = ((_BRACKETS, _closed), (_COMMAS, _with_comma))


@dataclass(frozen=True, slots=True)
class _Suggestion:
    """A replacement for a range of lines, and the rule that those lines break."""

    rule: str
    begin: int
    end: int
    line: str

    def taken(self, lines: list[str]) -> list[str]:
        return [*lines[: self.begin], self.line, *lines[self.end :]]


def _advice(text: str, error: tomllib.TOMLDecodeError) -> str:
    """Return the end of a message: the broken rule and the line that would be right."""
    lines = text.split("\n")
    if len(text) > _LONGEST or max(map(len, lines)) > _LONGEST_LINE:
        return ""
    left = _distance(lines, error)
    in_two = [re.sub(r"^\s*\[\s*view\s*\]", "[[view]]", line) for line in lines]
    if in_two != lines and _is_beyond(_unread(in_two), left[0]):
        return f": {_OWN_TABLE}"
    if (repeated := _repeated_key(lines, len(lines) - 1 - left[0])) is not None:
        return f": {repeated}"
    found = _repaired(lines, left)
    if found is None or not found.line.replace("\t", " ").isprintable():
        return ""
    if "://" in found.line:  # may contain a password
        return f": {found.rule}; so it is to be in line {found.begin + 1}"
    old = lines[found.begin] if found.begin < found.end else ""
    right = _shown(found.line, old)
    return f": {found.rule}; line {found.begin + 1} would be right as: {right}"


def _repeated_key(lines: list[str], index: int) -> str | None:
    """Return the words for a line that repeats a key of its table; None for any other.

    None as well behind a whole view: there the header of the next one is missing.
    """
    keys: dict[str, int] = {}
    for k, line in enumerate(lines[: index + 1]):
        if re.match(r"\s*\[+\s*[A-Za-z_]", line):
            keys = {}
        elif found := _KEY_AND_VALUE.fullmatch(line):
            key = found[1].strip(" \t=")
            if k == index and key in keys and not {"source", "reference_points_px"} <= keys.keys():
                return f"lines {keys[key] + 1} and {k + 1} both give {key}: keep one of them"
            keys.setdefault(key, k)
    return None


def _repaired(lines: list[str], left: tuple[int, int]) -> _Suggestion | None:
    """Find a correction with which a file can be read beyond the line of an error.

    Parameters
    ----------
    lines
        Lines of the file.
    left
        Numbers of lines and characters after the error.
    """
    first: _Suggestion | None = None
    for _ in range(_SLIPS_A_LINE):
        nearest: tuple[tuple[int, int], _Suggestion] | None = None
        for suggestion in _suggestions(lines, len(lines) - 1 - left[0]):
            if first is not None and suggestion.begin != first.begin:
                continue
            remains = _unread(suggestion.taken(lines))
            if _is_beyond(remains, min(left[0], len(lines) - suggestion.end)):
                return replace(suggestion, rule=(first or suggestion).rule)
            if nearest is None and remains is not None and remains < left:
                nearest = remains, suggestion
        if nearest is None:
            return None
        left, suggestion = nearest
        first = first or suggestion
        lines = suggestion.taken(lines)
    return None


def _suggestions(lines: list[str], index: int) -> Iterator[_Suggestion]:
    """Yield corrections of a line and the lines around it."""
    before = index - 1
    while before >= 0 and not lines[before].partition("#")[0].strip():
        before -= 1
    if "{" in lines[index] and "}" not in lines[index]:
        end = next((k + 1 for k in range(index, len(lines)) if "}" in lines[k]), index + 1)
        joined = " ".join(line.strip() for line in lines[index:end])
        yield _Suggestion("what stands in braces stands in one line", index, end, joined)
    for k, repairs in ((index, _REPAIRS), (before, _REPAIRS_BEFORE)):
        for rule, repair in repairs if k >= 0 else ():
            for line in repair(lines[k]):
                if line != lines[k]:
                    yield _Suggestion(rule, k, k + 1, line)
    yield _Suggestion(_OWN_TABLE, index, index, "[[view]]")


def _is_beyond(remains: tuple[int, int] | None, lines_left: int) -> bool:
    """Whether there is no error left, or only one in the remaining lines."""
    return remains is None or remains[0] < lines_left


def _unread(lines: list[str]) -> tuple[int, int] | None:
    """Return the numbers of lines and characters after the first error; None without one."""
    try:
        tomllib.loads("\n".join(lines))
    except tomllib.TOMLDecodeError as error:
        return _distance(lines, error)
    except (ValueError, RecursionError):
        return len(lines), 0  # no better than any other error
    return None


def _distance(lines: list[str], error: tomllib.TOMLDecodeError) -> tuple[int, int]:
    """Return the numbers of lines after an error's line, and of characters after it in its line."""
    place = re.search(r"\(at line (\d+), column (\d+)\)$", str(error))
    if place is not None:
        index, column = int(place[1]) - 1, int(place[2]) - 1
        return len(lines) - 1 - index, len(lines[index]) - column
    end = next((k for k in reversed(range(len(lines))) if lines[k].strip()), 0)
    return len(lines) - 1 - end, 0


def _shown(line: str, old: str) -> str:
    """Return a line for a message; a long one is reduced to the part around the change."""
    line, old = (text.strip().replace("\t", " ") for text in (line, old))
    if len(line) <= _SHOWN:
        return line
    shorter = min(len(line), len(old))
    change = next((k for k in range(shorter) if line[k] != old[k]), shorter)
    begin = max(0, min(change - _SHOWN // 2, len(line) - _SHOWN))
    end = begin + _SHOWN
    return f"{'...' if begin else ''}{line[begin:end]}{'...' if end < len(line) else ''}"
