"""What a goal wants next to one another, and which of the two is carried there."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

from embomatrix.factory.pipeline.task_poses import NeighbourPair
from embomatrix.factory.task_import.reach import literals
from embomatrix.world.state import Relation

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

    from embomatrix.world.goal import Formula

    Atoms = Iterable[tuple[str, tuple[str, ...]]]
    """Predicates and arguments."""

BORNE = (Relation.ONTOP, Relation.INSIDE, Relation.TOUCHING)


def neighbours_of(
    goal: Formula, types: Mapping[str, tuple[str, ...]], can_carry: Callable[[str], bool]
) -> tuple[NeighbourPair, ...]:
    """Pairs of which the goal wants the first next to the second, which stays where it is, or goes where the first goes.

    Of a statement about all or some of a type there are pairs for each of them. Where nothing of a pair can be carried, or
    both are, to different places, there is none.
    """
    wanted = tuple(_grounded(goal, types))
    places = _places(wanted, can_carry)
    found: dict[NeighbourPair, None] = {}
    for pair in dict.fromkeys(args for predicate, args in wanted if predicate == Relation.NEXTTO):
        if pair[0] != pair[1]:
            found.update(dict.fromkeys(_ways(pair, places, can_carry)[:1]))
    return tuple(found)


def _ways(
    pair: tuple[str, ...], places: Mapping[str, Mapping[str, None]], can_carry: Callable[[str], bool]
) -> list[NeighbourPair]:
    """Ways in which two things come to be neighbours: where one of them is carried to first, before where one stays."""
    orders = [(mover, neighbour) for mover, neighbour in (pair, pair[::-1]) if can_carry(mover)]
    going = [
        NeighbourPair(mover, neighbour, host)
        for mover, neighbour in orders
        for host in places.get(neighbour, {})
        if host != mover and host in places.get(mover, {host: None})
    ]
    return going + [NeighbourPair(mover, neighbour) for mover, neighbour in orders if neighbour not in places]


def _places(wanted: Atoms, can_carry: Callable[[str], bool]) -> dict[str, dict[str, None]]:
    """What things are to be carried to."""
    places: dict[str, dict[str, None]] = {}
    for predicate, args in wanted:
        if predicate in BORNE and can_carry(args[0]):
            places.setdefault(args[0], {})[args[1]] = None
    return places


def _grounded(goal: Formula, types: Mapping[str, tuple[str, ...]]) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Predicates and arguments of all that is to hold."""
    for atom, positive, scope in literals(goal, True, {}):
        if positive:
            for names in itertools.product(*(types[kind] for kind in scope.values())):
                told = dict(zip(scope, names, strict=True))
                yield atom.predicate, tuple(told.get(arg, arg) for arg in atom.args)
