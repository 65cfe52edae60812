"""Options that several commands of the factory have in common."""

from __future__ import annotations

import os
from typing import Annotated, Final

import typer

Physical = Annotated[
    bool | None,
    typer.Option(
        "--physical/--no-physical",
        help="Have a robot carry each plan out in stepped physics before its task is admitted. Default: with --look-ahead.",
    ),
]
MOST_JOBS: Final = 8
"""Each holds some scenes: a few hundred MB."""
Jobs = Annotated[
    int | None,
    typer.Option(
        min=1,
        help="Processes; what comes of it is the same for any number. Default: one for each core, at most 8.",
    ),
]


def processes(jobs: int | None) -> int:
    """How many processes: as was said, else one for each core that this process may use, at most eight."""
    return jobs or min(MOST_JOBS, len(os.sched_getaffinity(0)))


def is_proved(physical: bool | None, *, look_ahead: bool) -> bool:
    """Whether a robot proves the tasks: as was said, else with look-ahead."""
    return look_ahead if physical is None else physical
