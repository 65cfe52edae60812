"""Category of a task, computed from its goal alone."""

from typing import Final

from embomatrix.world.evaluate import atoms_of
from embomatrix.world.goal import Formula
from embomatrix.world.state import THERMAL, Relation, State, SubstanceRelation
from embomatrix.world.substances import MEANINGS
from embomatrix.world.task import TaskCategory

REAL: Final = "real"
"""Predicate of a piece that exists: the half of something that was cut."""
KITCHEN: Final = THERMAL | {State.SLICED, REAL}
SWITCHED: Final = frozenset({State.OPEN, State.TOGGLED_ON})
CLEANED: Final = frozenset((*MEANINGS, *SubstanceRelation))


def category_of(goal: Formula) -> TaskCategory:
    """Return the task category of a goal."""
    predicates = {atom.predicate for atom in atoms_of(goal)}
    moves = bool(predicates & set(Relation))
    switches = bool(predicates & (SWITCHED | CLEANED))
    if predicates & KITCHEN:
        outside = {Relation.ONTOP, Relation.UNDER, Relation.NEXTTO, State.OPEN} & predicates
        return TaskCategory.COMPOUND if outside else TaskCategory.KITCHEN_OPERATION
    if moves and switches:
        return TaskCategory.COMPOUND
    return TaskCategory.APPLIANCE_USE if switches else TaskCategory.PICK_AND_PLACE
