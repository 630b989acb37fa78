"""Choice of the operator whose habit of pointing a command subtracts."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from fingerpost.operators import Operator

operator_option = click.option(
    "--operator",
    metavar="NAME",
    help="Subtract the habit of NAME, as `fingerpost calibrate-operator` has estimated it; or a "
    ".toml file of it.",
)
"""Adds the parameter `operator` to a command."""


def operator_called(name: str | None) -> Operator | None:
    """Return the requested operator.

    Raises
    ------
    InvalidInputError
        There is no operator of that name.
    """
    from fingerpost.operators import Operator

    return None if name is None else Operator.load(name)
