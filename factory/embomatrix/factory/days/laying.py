"""Scene for the needs of a day: their wishes become one BDDL problem, for which the base scene is furnished."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from embomatrix.factory.admission import TaskRefusal
from embomatrix.factory.social.day import NeedOfDay
from embomatrix.factory.social.wish import Wish, problem_of
from embomatrix.factory.task_import.sources import SourceText
from embomatrix.factory.task_import.task import import_problem
from embomatrix.world.bddl import render_problem
from embomatrix.world.scene import Scene

SOURCE: Final = "society"
"""Source of the tasks of a simulated society."""
MAX_LAYOUTS: Final = 6
"""Maximum number of layouts tried for a day. After each failure, the need drawn last but one goes."""
SEEDS: Final = 2**31


@dataclass(frozen=True, slots=True)
class DayScene:
    """Scene laid out for the needs of a day, with the scene names of each need's objects by label."""

    scene: Scene
    needs: tuple[NeedOfDay, ...]
    members: tuple[Mapping[str, tuple[str, ...]], ...]
    notes: tuple[str, ...] = ()


def lay_out(
    name: str, needs: Sequence[NeedOfDay], base: Scene, rng: np.random.Generator
) -> DayScene | TaskRefusal:
    """Lay out the base scene for all needs, or for as many as find their place. A refusal is that of the last layout."""
    left = list(needs)
    refusal: TaskRefusal | None = None
    for _ in range(MAX_LAYOUTS):
        problem, labels = problem_of(name, [need.wish for need in left])
        source = SourceText(name, render_problem(problem), SOURCE)
        imported = import_problem(source, base, seed=int(rng.integers(SEEDS)))
        if not isinstance(imported, TaskRefusal):
            there = dict(zip(imported.instances, imported.about, strict=True))
            members = tuple(
                {
                    label: tuple(there[each] for each in names if each in there)
                    for label, names in group.items()
                }
                for group in labels
            )
            return DayScene(imported.scene, tuple(left), members, imported.notes)
        refusal = imported
        if len(left) == 1:
            break
        del left[int(rng.integers(len(left)))]
    assert refusal is not None
    return refusal


def wishes_of(day: DayScene) -> tuple[Wish, ...]:
    """Return the wishes of a day in order."""
    return tuple(need.wish for need in day.needs)
