"""Clauses of a goal, comparable with those of an intent."""

from collections.abc import Iterator, Mapping

from embomatrix.world.evaluate import instance, scored_atoms
from embomatrix.world.goal import Atom, Formula, Not, Quantified, Quantifier
from embomatrix.world.intent import IntentClause
from embomatrix.world.state import THERMAL, Relation, State

WISHED = {Relation.ONTOP, Relation.INSIDE, State.OPEN, State.TOGGLED_ON, *THERMAL}
"""Predicates of clauses."""


def goal_clauses(goal: Formula, types: Mapping[str, tuple[str, ...]]) -> tuple[IntentClause, ...]:
    """Return the scored sub-goals that are clauses. Other formulas, such as a disjunction, are left out."""
    return tuple(clause for atom in scored_atoms(goal, types) for clause in _clauses(atom, types))


def _clauses(atom: Formula, types: Mapping[str, tuple[str, ...]]) -> Iterator[IntentClause]:
    match atom:
        case Atom(predicate, (thing, *places)) if predicate in WISHED:
            yield IntentClause(predicate, (thing,), tuple(places))
        case Not(Atom(predicate, (thing, *places))) if predicate in WISHED:
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
