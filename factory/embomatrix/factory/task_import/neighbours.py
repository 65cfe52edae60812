"""Pairs of objects that a goal wants next to each other, and the object of each pair that is carried."""

import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping

from embomatrix.factory.pipeline.task_poses import NeighbourPair
from embomatrix.factory.task_import.reach import literals
from embomatrix.world.goal import Formula
from embomatrix.world.state import Relation

Atoms = Iterable[tuple[str, tuple[str, ...]]]
"""Predicates with their arguments."""

BORNE = (Relation.ONTOP, Relation.INSIDE, Relation.TOUCHING)


def neighbours_of(
    goal: Formula, types: Mapping[str, tuple[str, ...]], can_carry: Callable[[str], bool]
) -> tuple[NeighbourPair, ...]:
    """Return the pairs that the goal wants next to each other. The neighbour stays, or both are carried to one host.

    Quantified statements yield a pair for each combination. Pairs are left out if neither object can be carried, or
    if both are carried to different hosts.
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
    """Return the possible pairs. Those with a neighbour that is carried come first."""
    orders = [(mover, neighbour) for mover, neighbour in (pair, pair[::-1]) if can_carry(mover)]
    going = [
        NeighbourPair(mover, neighbour, host)
        for mover, neighbour in orders
        for host in places.get(neighbour, {})
        if host != mover and host in places.get(mover, {host: None})
    ]
    return going + [NeighbourPair(mover, neighbour) for mover, neighbour in orders if neighbour not in places]


def _places(wanted: Atoms, can_carry: Callable[[str], bool]) -> dict[str, dict[str, None]]:
    """Return the hosts that each object is carried to."""
    places: dict[str, dict[str, None]] = {}
    for predicate, args in wanted:
        if predicate in BORNE and can_carry(args[0]):
            places.setdefault(args[0], {})[args[1]] = None
    return places


def _grounded(goal: Formula, types: Mapping[str, tuple[str, ...]]) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Yield the predicates and arguments of all positive ground atoms."""
    for atom, positive, scope in literals(goal, True, {}):
        if positive:
            for names in itertools.product(*(types[kind] for kind in scope.values())):
                values = dict(zip(scope, names, strict=True))
                yield atom.predicate, tuple(values.get(arg, arg) for arg in atom.args)
