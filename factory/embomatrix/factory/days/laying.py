"""Scene for the wishes of a day: they become one BDDL problem, for which the base scene is furnished."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np

from embomatrix.factory.admission import TaskRefusal
from embomatrix.factory.layout.generator import lay
from embomatrix.factory.layout.request import LayoutAgents
from embomatrix.factory.social.wish import FLOOR, Wish, problem_of
from embomatrix.factory.task_import.sources import SourceText
from embomatrix.factory.task_import.task import ImportOptions, import_problem
from embomatrix.world.bddl import render_problem
from embomatrix.world.scene import Scene

SOURCE: Final = "society"
"""Source of the tasks of a simulated society."""
MAX_LAYOUTS: Final = 6
"""Maximum number of layouts tried for a day. After each failure, the wish whose object finds no place goes."""
SEEDS: Final = 2**31


@dataclass(frozen=True, slots=True)
class LaidOut:
    """Scene laid out for wishes. ``kept`` are the positions of the wishes that found their place.

    ``members`` are the scene names of each kept wish's objects by label.
    """

    scene: Scene
    kept: tuple[int, ...]
    members: tuple[Mapping[str, tuple[str, ...]], ...]


def lay_out(
    name: str,
    wishes: Sequence[Wish],
    base: Scene,
    rng: np.random.Generator,
    agents: LayoutAgents | None = None,
    *,
    exact: bool = False,
) -> LaidOut | TaskRefusal:
    """Lay out the base scene for all wishes, or for as many as find their place. A refusal is that of the last layout.

    If ``exact``, objects have the category that their wish names; otherwise a low cabinet may stand for a wall cabinet,
    which have one type.
    """
    kept = list(range(len(wishes)))
    while True:
        problem, labels = problem_of(name, [wishes[at] for at in kept])
        kinds = _kinds([wishes[at] for at in kept], labels) if exact else {}
        options = ImportOptions(lay=partial(lay, agents=agents), categories=kinds)
        source = SourceText(name, render_problem(problem), SOURCE)
        imported = import_problem(source, base, seed=int(rng.integers(SEEDS)), options=options)
        if not isinstance(imported, TaskRefusal):
            there = dict(zip(imported.instances, imported.about, strict=True))
            members = tuple(_found(group, there) for group in labels)
            return LaidOut(imported.scene, tuple(kept), members)
        if len(kept) == 1 or len(kept) <= len(wishes) - MAX_LAYOUTS:
            return imported
        del kept[_at_fault(imported, labels, rng)]


def _kinds(wishes: Sequence[Wish], labels: Sequence[Mapping[str, tuple[str, ...]]]) -> dict[str, str]:
    """Return the category of each object of the wishes. Floors have none."""
    return {
        name: group.kind
        for wish, names in zip(wishes, labels, strict=True)
        for group in wish.objects
        if group.kind != FLOOR
        for name in names[group.label]
    }


def _at_fault(
    refusal: TaskRefusal, labels: Sequence[Mapping[str, tuple[str, ...]]], rng: np.random.Generator
) -> int:
    """Return the position of the wish whose object finds no place; any position if the refusal names none."""
    for number, group in enumerate(labels):
        if any(refusal.about in names for names in group.values()):
            return number
    return int(rng.integers(len(labels)))


def _found(group: Mapping[str, tuple[str, ...]], there: Mapping[str, str]) -> dict[str, tuple[str, ...]]:
    """Return the scene objects of each label. Floors that no goal is about are no objects."""
    return {label: tuple(there[each] for each in names if each in there) for label, names in group.items()}
