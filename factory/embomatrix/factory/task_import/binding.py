"""Binding: a BDDL problem's objects are assigned to objects of a base scene, or refused with a reason.

``inroom`` names the scene's own objects, found by backtracking over rooms and categories. Objects that the problem
puts on, in, under or beside something are added later. Substances have no place: objects are covered, filled or
soaked with them. Future objects are the halves of sliceable objects.
"""

from collections.abc import Container, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from embomatrix.factory.admission import RefusalReason, RefusedError
from embomatrix.factory.scenes.view import SceneView
from embomatrix.factory.task_import.expressible import AGENT, FLOORS, check_expressible
from embomatrix.factory.task_import.reach import pieces_of
from embomatrix.factory.task_import.search import BindingOptions, abilities_needed, search
from embomatrix.world.bddl import BddlProblem
from embomatrix.world.catalog import Catalog
from embomatrix.world.scene import Scene
from embomatrix.world.state import Relation
from embomatrix.world.substances import is_substance

PLACING: Final = (Relation.INSIDE, Relation.ONTOP, Relation.UNDER, Relation.NEXTTO)
"""Relations by which ``:init`` places an object, the most specific first."""


@dataclass(frozen=True, slots=True)
class Addition:
    """Object that must be added to the scene.

    ``host`` is another object of the problem; on top of no host means the floor of ``room``. Without a relation it
    may be anywhere in ``room``, and without a room anywhere in the problem's rooms. ``beside`` lists its neighbours,
    and ``needs`` its required abilities.
    """

    name: str
    type: str
    relation: Relation | None
    host: str
    room: str
    beside: tuple[str, ...] = ()
    needs: frozenset[str] = frozenset()

    @property
    def is_missing_furniture(self) -> bool:
        """True if the start says no more than its room. If it is furniture, the scene was expected to have it."""
        return self.relation is None and not self.beside


@dataclass(frozen=True, slots=True)
class Binding:
    """Result of a binding. ``found`` maps the problem's objects to scene objects, ``floors`` to rooms.

    ``additions`` are ordered with hosts first. ``problem`` is the bound problem with its wildcards expanded.
    """

    problem: BddlProblem
    found: Mapping[str, str]
    floors: Mapping[str, str]
    additions: tuple[Addition, ...]
    rooms: Mapping[str, str]
    """Scene rooms by the problem's room names."""
    robot_room: str


def bind(
    problem: BddlProblem,
    scene: Scene,
    rng: np.random.Generator,
    options: BindingOptions,
    excluded: Container[str] = (),
) -> Binding:
    """Find the problem's objects in the scene. Raise RefusedError for the first object that can't be bound.

    Scene objects in ``excluded`` are not used.
    """
    check_expressible(problem, reachable=options.reachable)
    inroom = dict(problem.initial_pairs(Relation.INROOM))
    placed = _placements(problem)
    view = SceneView(scene)
    fixtures = fixtures_of(problem)
    rooms, found = search(problem, view, inroom, fixtures, rng, options, excluded)
    problem = _with_wildcards_expanded(problem, view, rooms, found)
    floors = {name: rooms[room] for name, room in inroom.items() if problem.objects.get(name) in FLOORS}
    unassigned = {name: rooms[inroom[name]] for name in fixtures if name not in found}
    additions = _in_order(problem, placed, found, floors, unassigned)
    return Binding(problem, found, floors, additions, rooms, _robot_room(problem, placed, floors, scene))


def fixtures_of(problem: BddlProblem) -> list[str]:
    """Return the objects that ``:init`` places only by naming their room, without floors, agents and wildcards."""
    placed = _placements(problem)
    return [
        name
        for name, _ in problem.initial_pairs(Relation.INROOM)
        if problem.objects[name] not in FLOORS
        and problem.objects[name] != AGENT
        and name not in placed
        and name not in problem.wildcards
    ]


def _with_wildcards_expanded(
    problem: BddlProblem, view: SceneView, rooms: Mapping[str, str], found: dict[str, str]
) -> BddlProblem:
    """Expand each wildcard to all further objects of its type in the room, and add them to ``found``."""
    catalog = Catalog.load()
    members: dict[str, tuple[str, ...]] = {}
    for wildcard, word in problem.wildcards.items():
        type_name = problem.objects[wildcard]
        taken = set(found.values())
        categories = () if type_name in FLOORS else catalog.categories_of(type_name)
        others = [
            name
            for name in view.in_room.get(rooms.get(word, ""), ())
            if view.category(name) in categories and name not in taken
        ]
        declared = len(problem.types[type_name])
        members[wildcard] = tuple(f"{type_name}_{declared + 1 + n}" for n in range(len(others)))
        found |= zip(members[wildcard], others, strict=True)
    return problem.spelt_out(members)


def _placements(problem: BddlProblem) -> dict[str, tuple[Relation, str]]:
    """Return the relation and host that ``:init`` gives to each object."""
    placed: dict[str, tuple[Relation, str]] = {}
    for relation in PLACING:
        for name, host in problem.initial_pairs(relation):
            placed.setdefault(name, (relation, host))
    return placed


def _in_order(
    problem: BddlProblem,
    placed: Mapping[str, tuple[Relation, str]],
    found: Mapping[str, str],
    floors: Mapping[str, str],
    loose: Mapping[str, str],
) -> tuple[Addition, ...]:
    """Return the additions with hosts first. Objects without a place in the start may be anywhere."""
    needs = abilities_needed(problem)
    additions: list[Addition] = []
    ready = {*found, *floors}
    waiting = _to_add(problem, ready)
    while waiting:
        name = next(
            (name for name in waiting if name not in placed or placed[name][1] in ready or name in loose),
            None,
        )
        if name is None:
            raise RefusedError(
                RefusalReason.NO_PLACE_GIVEN,
                f"the start puts {waiting[0]!r} at {placed[waiting[0]][1]!r}, but gives a place for neither",
            )
        waiting.remove(name)
        ready.add(name)
        at = placed.get(name) if name not in loose else None
        where = _place_of(at, floors) if at else (None, "", loose.get(name, ""))
        beside = _neighbours(problem, name, ready)
        additions.append(Addition(name, problem.objects[name], *where, beside, needs.get(name, frozenset())))
    return tuple(additions)


def _neighbours(problem: BddlProblem, name: str, ready: Container[str]) -> tuple[str, ...]:
    """Return existing neighbours that the start puts next to the object, in either order."""
    pairs = problem.initial_pairs(Relation.NEXTTO)
    others = (b if a == name else a for a, b in pairs if name in (a, b))
    return tuple(dict.fromkeys(other for other in others if other in ready))


def _to_add(problem: BddlProblem, ready: Container[str]) -> list[str]:
    """Return the problem's objects that the scene lacks, without halves, agents, floors and substances."""
    absent = {half for halves in pieces_of(problem).values() for half in halves}
    return [
        name
        for name, type_name in problem.objects.items()
        if name not in ready
        and name not in absent
        and type_name != AGENT
        and type_name not in FLOORS
        and not is_substance(type_name)
    ]


def _place_of(at: tuple[Relation, str], floors: Mapping[str, str]) -> tuple[Relation | None, str, str]:
    """Return relation, host and room of an addition. Objects on a floor have no host."""
    relation, host = at
    if host in floors:
        return Relation.ONTOP, "", floors[host]
    return (None, "", "") if relation is Relation.NEXTTO else (relation, host, "")


def _robot_room(
    problem: BddlProblem, placed: Mapping[str, tuple[Relation, str]], floors: Mapping[str, str], scene: Scene
) -> str:
    for name, type_name in problem.objects.items():
        if type_name == AGENT and name in placed:
            return floors.get(placed[name][1], scene.robot.room)
    return scene.robot.room
