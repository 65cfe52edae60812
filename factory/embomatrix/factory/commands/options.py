"""Options shared by commands of the factory."""

import os
from pathlib import Path
from typing import Annotated, Final

import typer

Seed = Annotated[int, typer.Option(min=0, help="Random seed. Equal seeds give equal results.")]
Scenes = Annotated[
    list[str] | None,
    typer.Option(
        "--scenes",
        "--scene",
        help="Base scene, 'all', or a .json file of `scene build`. Repeat the option for more scenes.",
    ),
]
ArmReachability = Annotated[
    bool,
    typer.Option(
        help="Analyse which objects the robot's arm can reach in each scene, and store it for rollouts. "
        "Takes most of the time."
    ),
]
Physical = Annotated[
    bool | None,
    typer.Option(
        "--physical/--no-physical",
        help="Admit a task only if a robot carries its plan out in stepped physics. Default: same as --reachability.",
    ),
]
PlacesLearnedFrom = Annotated[
    Path | None,
    typer.Option(
        "--training",
        help="Dataset whose training tasks tell where things usually are, as a folder or by its name if it ships. "
        "Default: the dataset itself.",
    ),
]
ScriptsLearnFrom = Annotated[
    Path | None,
    typer.Option(
        "--training",
        help="Dataset whose training tasks the scripts learn from, as a folder or by its name if it ships. "
        "Default: the dataset itself.",
    ),
]
MOST_JOBS: Final = 8
"""Upper limit of the default: each process holds some hundred MB of scenes."""
Jobs = Annotated[
    int | None,
    typer.Option(
        min=1,
        help="Number of processes. The result does not depend on it. Default: one for each core, at most 8.",
    ),
]


def in_physics(physical: bool | None, *, reachability: bool) -> bool:
    """Return whether plans are checked in stepped physics: ``--physical``, or ``--reachability`` if it is not given."""
    return reachability if physical is None else physical


def processes(jobs: int | None) -> int:
    """Return the number of processes to use: ``jobs``, or the usable cores up to eight."""
    return jobs or min(MOST_JOBS, len(os.sched_getaffinity(0)))
