"""Groups of commands on the command line."""

from functools import partial

import typer

command_group = partial(
    typer.Typer, no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False
)
"""Typer group that prints its help if no command is given. `failure.shown` handles exceptions."""
