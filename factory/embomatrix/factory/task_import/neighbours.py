"""What a goal wants next to one another, and which of the two is carried there."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

from embomatrix.factory.task_import.reach import literals
from embomatrix.world.state import Relation

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from embomatrix.world.goal import Formula


def neighbours_of(
    goal: Formula, types: Mapping[str, tuple[str, ...]], can_carry: Callable[[str], bool]
) -> tuple[tuple[str, str], ...]:
    """Pairs of which the goal wants the first next to the second, which stays where it is.

    Of a statement about all or some of a type there are pairs for each of them. Where nothing of a pair can be carried, or
    what would stay is to be carried elsewhere, there is none.
    """
    wanted = tuple(_grounded(goal, types))
    pairs = dict.fromkeys(args for predicate, args in wanted if predicate == Relation.NEXTTO)
    placed = {args[0] for predicate, args in wanted if predicate in (Relation.ONTOP, Relation.INSIDE)}
    found: dict[tuple[str, str], None] = {}
    for one, other in pairs:
        for mover, neighbour in ((one, other), (other, one)):
            if mover != neighbour and can_carry(mover) and not (neighbour in placed and can_carry(neighbour)):
                found[mover, neighbour] = None
                break
    return tuple(found)


def _grounded(goal: Formula, types: Mapping[str, tuple[str, ...]]) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Predicates and arguments of all that is to hold."""
    for atom, positive, scope in literals(goal, True, {}):
        if positive:
            for names in itertools.product(*(types[kind] for kind in scope.values())):
                told = dict(zip(scope, names, strict=True))
                yield atom.predicate, tuple(told.get(arg, arg) for arg in atom.args)
