"""`fingerpost live --arm`: the arm that the operator's page guides."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, TypeVar

import click
from click.core import ParameterSource

from fingerpost.cli.arming import grouped, moving_options, stopping_signals
from fingerpost.cli.robot_guide import carrying, carrying_options, following_options, guided_arm

if TYPE_CHECKING:
    from fingerpost.config import Rig
    from fingerpost.live import GuidingDesk

Command = TypeVar("Command", bound=Callable[..., Any])

_OPTIONS = (
    moving_options,
    following_options,
    carrying_options,
    click.option("--follow-only", is_flag=True, help="No picking and placing."),
)

page_arm_options = grouped(_OPTIONS)
"""Adds the options of an arm that is guided from the page."""


def refuse_without_arm(given: Mapping[str, Any]) -> None:
    """Refuse options of an arm without --arm.

    Raises
    ------
    click.UsageError
        One is given without --arm.
    """
    context = click.get_current_context()
    for parameter in context.command.get_params(context):
        name = parameter.name or ""
        if name in given and context.get_parameter_source(name) is ParameterSource.COMMANDLINE:
            raise click.UsageError(
                f"{parameter.opts[-1]} moves nothing by itself: see that the arm's way is clear "
                "and give --arm as well"
            )


def desk_of(rig: Rig, given: Mapping[str, Any]) -> GuidingDesk:
    """Return the desk from which the page guides the arm of a rig; nothing moves.

    Parameters
    ----------
    rig
        With a [robot] table.
    given
        The values of `page_arm_options`.

    Raises
    ------
    FingerpostError
        The rig has no robot, or the given values are invalid.
    """
    from fingerpost.guidance import robot_of
    from fingerpost.live import OPERATOR_TIMEOUT_S, GuidingDesk

    given = {**given, "operator_timeout_s": OPERATOR_TIMEOUT_S}
    carry = None if given["follow_only"] else carrying(given)
    arm = guided_arm(robot_of(rig), given, carry, dwells=carry is not None)
    return GuidingDesk(
        arm,
        lambda: arm.robot.home(timeout_s=given["homing_timeout"]),
        signals=stopping_signals(),
    )
