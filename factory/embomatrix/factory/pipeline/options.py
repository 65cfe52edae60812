"""Options that several commands of the pipeline have in common."""

from __future__ import annotations

from typing import Annotated

import typer

Physical = Annotated[
    bool | None,
    typer.Option(
        "--physical/--no-physical",
        help="Have a robot carry each plan out in stepped physics before its task is admitted. Default: with --look-ahead.",
    ),
]


def is_proved(physical: bool | None, *, look_ahead: bool) -> bool:
    """Whether a robot proves the tasks: as was said, else with look-ahead."""
    return look_ahead if physical is None else physical
