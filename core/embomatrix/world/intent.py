"""Intent of an instruction: what it demands, in terms of scene objects, apart from the goal that is scored."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Final

from embomatrix.world.evaluate import instance, scored_atoms
from embomatrix.world.goal import Atom, Formula, Not, Quantified, Quantifier
from embomatrix.world.state import THERMAL, Relation, State

CLAUSE_PREDICATES: Final = frozenset(
    {Relation.ONTOP, Relation.INSIDE, Relation.UNDER, Relation.NEXTTO, State.OPEN, State.TOGGLED_ON, *THERMAL,
     State.SLICED, State.SOAKED, State.DUSTY, State.STAINED}
)  # fmt: skip
"""Predicates of clauses."""


@dataclass(frozen=True, slots=True)
class IntentClause:
    """Demand that any of ``things`` has a state, or a relation to any of ``places``; or has not, if ``holds`` is False.

    ``places`` are the hosts of a relation, or the sources of a thermal state; empty if the instruction names none.
    """

    predicate: str
    things: tuple[str, ...]
    places: tuple[str, ...] = ()
    holds: bool = True


def goal_clauses(goal: Formula, types: Mapping[str, tuple[str, ...]]) -> tuple[IntentClause, ...]:
    """Return the scored sub-goals that are clauses. Other formulas, such as a disjunction, are left out."""
    return tuple(clause for atom in scored_atoms(goal, types) for clause in _clauses(atom, types))


def _clauses(atom: Formula, types: Mapping[str, tuple[str, ...]]) -> Iterator[IntentClause]:
    match atom:
        case Atom(predicate, (thing, *places)) if predicate in CLAUSE_PREDICATES:
            yield IntentClause(predicate, (thing,), tuple(places))
        case Not(Atom(predicate, (thing, *places))) if predicate in CLAUSE_PREDICATES:
            yield IntentClause(predicate, (thing,), tuple(places), holds=False)
        case Quantified(Quantifier.EXISTS, ((_, type_name),)):
            found = [clause for name in types[type_name] for clause in _clauses(instance(atom, name), types)]
            if len(found) == len(types[type_name]) and len({(c.predicate, c.holds) for c in found}) == 1:
                yield IntentClause(
                    found[0].predicate,
                    tuple(dict.fromkeys(name for clause in found for name in clause.things)),
                    tuple(dict.fromkeys(name for clause in found for name in clause.places)),
                    found[0].holds,
                )
