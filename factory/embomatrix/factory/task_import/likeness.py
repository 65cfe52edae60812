"""Likeness of two problems by their goals, whatever their names: the share of conditions that both demand.

A condition is an atom of the goal with its polarity. Objects count by the last word of their type (*breakfast table* and
*coffee table* are tables), ``dusty`` and similar states as facts about substances, and numbers of objects don't count.

``python -m embomatrix.factory.task_import.likeness FOLDER`` lists the activities for ``sources.LIKE_EAI``; FOLDER is that of
the unpacked eai-eval wheel.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping
from pathlib import Path

from embomatrix.factory.task_import.sources import (
    ALIKE,
    EAI_NAMESAKES,
    SourceText,
    activity_names,
    read_activity,
    read_eai,
)
from embomatrix.world.bddl import BddlProblem, parse_problem
from embomatrix.world.evaluate import subformulas
from embomatrix.world.goal import Atom, Not, Quantified
from embomatrix.world.substances import MEANINGS

Condition = tuple[bool, str, tuple[str, ...]]
"""Polarity, predicate and words of the arguments."""

_SUBSTANCE_STATES = {state.value: fact for state, fact in MEANINGS.items()}


def conditions_of(problem: BddlProblem) -> frozenset[Condition]:
    """Return the different conditions of a problem's goal."""
    parts = list(subformulas(problem.goal))
    types = {**problem.objects}
    for part in parts:
        if isinstance(part, Quantified):
            types |= dict(part.binders)
    denied = {id(part.body) for part in parts if isinstance(part, Not)}
    return frozenset(
        _condition(part, types, id(part) not in denied) for part in parts if isinstance(part, Atom)
    )


def likeness(one: frozenset[Condition], other: frozenset[Condition]) -> float:
    """Return the shared conditions as a share of all conditions of both, from 0 to 1 (Jaccard index)."""
    return len(one & other) / len(one | other) if one | other else 0.0


def like_eai(tasks: Iterable[SourceText]) -> frozenset[str]:
    """Return the BEHAVIOR-1K activities whose goals are like that of one of EAI's tasks, without its namesakes."""
    known = [conditions_of(parse_problem(source.text)) for source in tasks]
    found = {
        name.replace("-", "_"): conditions_of(parse_problem(read_activity(name).text))
        for name in activity_names()
    }
    return frozenset(
        name
        for name, conditions in found.items()
        if name not in EAI_NAMESAKES and any(likeness(conditions, other) >= ALIKE for other in known)
    )


def _condition(atom: Atom, types: Mapping[str, str], holds: bool) -> Condition:
    words = tuple(_word(types.get(arg, arg)) for arg in atom.args)
    fact = _SUBSTANCE_STATES.get(atom.predicate)
    if fact is None:
        return holds, atom.predicate, words
    return holds, fact.relation.value, (*words, _word(fact.substance))


def _word(type_name: str) -> str:
    """Return the last word of a type: *bottle__of__apple_juice.n.01* is *juice*."""
    return type_name.partition(".n.")[0].split("_")[-1]


if __name__ == "__main__":
    sys.stdout.write(f"{' '.join(sorted(like_eai(read_eai(Path(sys.argv[1])))))}\n")
