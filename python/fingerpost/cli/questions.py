"""Questions on a terminal, which are repeated until an answer is valid."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import click

from fingerpost.errors import FingerpostError


def is_terminal() -> bool:
    """Return whether a person can be asked."""
    return all(stream is not None and stream.isatty() for stream in (sys.stdin, sys.stderr))


def answered(question: str, check: Callable[[str], object], **options: Any) -> str:
    """Ask until an answer passes its check.

    Parameters
    ----------
    question
        The question.
    check
        Raises a FingerpostError for an invalid answer, whose message is shown.
    options
        Of `click.prompt`.
    """

    def checked(answer: str) -> str:
        answer = _unquoted(answer.strip())
        try:
            check(answer)
        except FingerpostError as error:
            # Makes click ask again.
            raise click.UsageError(str(error)) from error
        return answer

    with _ended_line():
        return str(click.prompt(question, value_proc=checked, err=True, **options))


def confirmed(question: str, *, default: bool) -> bool:
    """Ask a question that is answered by yes or no."""
    with _ended_line():
        return click.confirm(question, default=default, err=True)


def _unquoted(answer: str) -> str:
    """Remove quotes around an answer: terminals paste the names of dropped files with them."""
    is_quoted = len(answer) > 1 and answer[0] == answer[-1] and answer[0] in "'\""
    return answer[1:-1] if is_quoted else answer


@contextmanager
def _ended_line() -> Iterator[None]:
    """Begin a new line if a prompt is not answered because of Ctrl-C or the end of input."""
    try:
        yield
    except click.Abort:
        click.echo(err=True)
        raise
