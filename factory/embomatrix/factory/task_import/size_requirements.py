"""Size requirements of a problem: contents of its objects, and objects that must be carried."""

import functools
import math
import operator
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from embomatrix.factory.scenes.view import is_liftable
from embomatrix.factory.task_import.reach import literals
from embomatrix.sim.geometry.candidates import surfaces_for
from embomatrix.world.asset import Asset, SupportSurface
from embomatrix.world.bddl import BddlProblem
from embomatrix.world.catalog import Catalog, CatalogError
from embomatrix.world.geometry import Vec3
from embomatrix.world.goal import Atom
from embomatrix.world.state import Relation

SLACK: Final = 2.2
"""Ratio of a cavity's floor to the footprints of its contents. Objects are placed loosely, not packed."""
PLACED: Final = frozenset(set(Relation) - {Relation.INROOM})
"""Relations between two objects."""


@dataclass(frozen=True, slots=True)
class Requirement:
    """Requirements on one object, or on all objects of a type.

    ``contents`` lists the types of the objects inside, one per object: those of the start or of the goal, whichever
    are more.
    """

    bears: bool = False
    """True if an object is on or in it at the start or in the goal."""
    contents: tuple[str, ...] = ()
    carried: bool = False
    """True if the goal requires a place where it is not yet."""
    places: tuple[tuple[Relation, str], ...] = ()
    """Relations and hosts at the start or in the goal, by name."""
    burden: tuple[str, ...] = ()
    """Types of the objects on top of it, one per object, like ``contents``."""


def requirements_of(problem: BddlProblem) -> Mapping[str, Requirement]:
    """Return the requirements on objects, and on the types of the goal's variables, by name."""
    fixtures = {item.atom.args[0] for item in problem.init if item.atom.predicate == Relation.INROOM}
    bears: set[str] = set()
    carried: set[str] = set()
    started: defaultdict[tuple[str, str], list[str]] = defaultdict(list)
    ended: defaultdict[tuple[str, str], list[str]] = defaultdict(list)
    places: defaultdict[str, dict[tuple[Relation, str], None]] = defaultdict(dict)
    goal = list(literals(problem.goal, True, {}))
    for atom, positive, _ in goal:
        if not positive and atom.predicate in PLACED and _holds_at_start(problem, atom):
            carried.add(atom.args[0].lstrip("?"))
    moments = (
        (started, [item.atom for item in problem.init if item.positive]),
        (ended, list(dict.fromkeys(atom for atom, positive, _ in goal if positive))),
    )
    for borne, atoms in moments:
        for atom in atoms:
            if atom.predicate not in PLACED:
                continue
            object_name, host = (name.lstrip("?") for name in atom.args)
            if borne is ended and not _holds_at_start(problem, atom):
                # of two neighbours, the one that is not in the room yet
                carried.add(
                    host if atom.predicate == Relation.NEXTTO and object_name in fixtures else object_name
                )
            if atom.predicate in (Relation.INSIDE, Relation.ONTOP):
                bears.add(host)
                places[object_name][Relation(atom.predicate), problem.types.get(host, (host,))[0]] = None
                borne[atom.predicate, host] += _share(problem, object_name, host)
    found = {}
    for name in (*problem.objects, *problem.types):
        contents, burden = (
            max(tuple(ended[relation, name]), tuple(started[relation, name]), key=len)
            for relation in (Relation.INSIDE, Relation.ONTOP)
        )
        found[name] = Requirement(name in bears, contents, name in carried, tuple(places[name]), burden)
    return found


def requirement_on(requirements: Mapping[str, Requirement], name: str, type_name: str) -> Requirement:
    """Return the requirements on an object by its name and by its type."""
    own, all_alike = requirements.get(name, Requirement()), requirements.get(type_name, Requirement())
    return Requirement(
        own.bears or all_alike.bears,
        max(own.contents, all_alike.contents, key=len),
        own.carried or all_alike.carried,
        tuple(dict.fromkeys((*own.places, *all_alike.places))),
        max(own.burden, all_alike.burden, key=len),
    )


class CavityFit(IntEnum):
    """Space of an asset for its contents, the best first."""

    FOR_ALL = 0  # floor for all objects side by side
    FOR_EACH = 1  # floor for each object, but not for all together
    FOR_SOME = 2  # at least one object does not fit


def room_for(asset: Asset, contents: tuple[str, ...], relation: Relation = Relation.INSIDE) -> CavityFit:
    """Return the space of an asset's cavities or surfaces for the smallest models of these types."""
    floors = surfaces_for(asset, relation)
    sizes_m = [size_m for size_m in map(smallest_m, contents) if size_m is not None]
    if not all(any(_fits(size_m, floor) for floor in floors) for size_m in sizes_m):
        return CavityFit.FOR_SOME
    return (
        CavityFit.FOR_ALL
        if floor_needed_m2(contents) <= sum(math.prod(floor.size_m) for floor in floors)
        else CavityFit.FOR_EACH
    )


def floor_needed_m2(contents: tuple[str, ...]) -> float:
    """Return the floor area for objects of these types side by side, by their smallest models."""
    sizes_m = [size_m for size_m in map(smallest_m, contents) if size_m is not None]
    return SLACK * sum(size_m[0] * size_m[1] for size_m in sizes_m)


def _fits(size_m: Vec3, floor: SupportSurface) -> bool:
    """True if the footprint fits on the floor in either orientation and the height fits below the ceiling of the cavity."""
    footprint = sorted(size_m[:2])
    return all(map(operator.le, footprint, sorted(floor.size_m))) and size_m[2] <= floor.clearance_m


@functools.cache
def smallest_m(type_name: str) -> Vec3 | None:
    """Return the size of the type's model with the smallest footprint, preferring liftable models."""
    catalog = Catalog.load()
    try:
        models = [
            (not is_liftable(model.size_m, catalog.category(category).mass_kg), model.size_m)
            for category in catalog.categories_of(type_name)
            for model in catalog.models_of(category)
        ]
    except CatalogError:
        return None
    if not models:
        return None
    return min(models, key=lambda pair: (pair[0], math.prod(pair[1][:2])))[1]


def _holds_at_start(problem: BddlProblem, atom: Atom) -> bool:
    """True if the atom holds at the start for everything that its names stand for."""
    first, second = (problem.types.get(name.lstrip("?"), (name.lstrip("?"),)) for name in atom.args)
    at_start = set(problem.initial_pairs(atom.predicate))
    return all(any((one, other) in at_start for other in second) for one in first)


def _share(problem: BddlProblem, object_name: str, host: str) -> list[str]:
    """Return the types of the objects for one host if the objects are distributed evenly."""
    object_names = problem.types.get(object_name, (object_name,))
    hosts = problem.types.get(host, (host,))
    type_name = problem.objects.get(object_name, object_name)
    return [type_name] * math.ceil(len(object_names) / max(1, len(hosts)))
