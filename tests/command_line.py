"""The command line in the process of the tests: its results, and its one-line refusals."""

from click.testing import CliRunner, Result

from fingerpost.cli import main


def invoked(*arguments: object) -> Result:
    """Run a command."""
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


def refused(*arguments: object) -> str:
    """Run a command with bad input; return its one-line error."""
    done = invoked(*arguments)
    assert done.exit_code == 2, done.output
    assert done.stdout == ""
    (line,) = done.stderr.splitlines()
    return line
