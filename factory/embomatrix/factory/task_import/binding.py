"""Binding: the objects of a BDDL problem are found in a base scene, or refused for a reason.

``inroom`` names the scene's own objects; they are found by backtracking over room instances and categories. What the
problem puts on, in, under or beside something is added later by the editor. Substances have no place: they are what things
are covered, filled or soaked with. Objects that are still to come are the halves of things that can be sliced.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from embomatrix.factory.admission import RefusalReason, RefusedError
from embomatrix.factory.scenes.view import SceneView
from embomatrix.factory.task_import.expressible import AGENT, FLOORS, check_evaluable, check_expressible
from embomatrix.factory.task_import.reach import pieces_of
from embomatrix.factory.task_import.search import abilities_needed, search
from embomatrix.world.catalog import Catalog
from embomatrix.world.state import Relation
from embomatrix.world.substances import is_substance

if TYPE_CHECKING:
    from collections.abc import Container, Mapping

    import numpy as np

    from embomatrix.world.bddl import BddlProblem
    from embomatrix.world.scene import Scene

PLACING: Final = (Relation.INSIDE, Relation.ONTOP, Relation.UNDER, Relation.NEXTTO)
"""Relations by which ``:init`` places an object, the most telling first."""


@dataclass(frozen=True, slots=True)
class Addition:
    """An object that must be added.

    ``host`` is another object of the problem; on top of none is on the floor of ``room``. Without a relation it may be anywhere
    in ``room``, without a room anywhere in the problem's rooms. ``beside`` are objects that it is next to, besides; ``needs``
    are what it must be able to do.
    """

    name: str
    type: str
    relation: Relation | None
    host: str
    room: str
    beside: tuple[str, ...] = ()
    needs: frozenset[str] = frozenset()


@dataclass(frozen=True, slots=True)
class Binding:
    """``found`` maps objects of the problem to scene objects, ``floors`` to rooms; ``additions`` are in order of need.

    ``problem`` is the one that was bound, with its wildcards spelt out.
    """

    problem: BddlProblem
    found: Mapping[str, str]
    floors: Mapping[str, str]
    additions: tuple[Addition, ...]
    rooms: Mapping[str, str]
    """The problem's words for rooms, and the rooms of the scene that they stand for."""
    robot_room: str


def bind(
    problem: BddlProblem,
    scene: Scene,
    rng: np.random.Generator,
    *,
    furnishing: bool = True,
    reachable: bool = True,
    renumbering: bool = False,
    shunned: Container[str] = (),
) -> Binding:
    """Find the problem's objects in the scene. Raises RefusedError with the first thing that can't be bound.

    Furniture that its rooms lack is to be added when ``furnishing``, as the paper's factory does; else that is a refusal.
    A goal that no skill reaches is a refusal when it is to be ``reachable``; a room's number counts unless ``renumbering``.
    Scene objects that are ``shunned`` are left.
    """
    (check_expressible if reachable else check_evaluable)(problem)
    inroom = {
        item.atom.args[0]: item.atom.args[1]
        for item in problem.init
        if item.positive and item.atom.predicate == Relation.INROOM
    }
    placed = _placements(problem)
    view = SceneView(scene)
    fixtures = [
        name
        for name in inroom
        if problem.objects[name] not in FLOORS
        and problem.objects[name] != AGENT
        and name not in placed
        and name not in problem.wildcards
    ]
    rooms, found = search(
        problem, view, inroom, fixtures, rng, furnishing=furnishing, renumbering=renumbering, shunned=shunned
    )
    problem = _with_wildcards_expanded(problem, view, rooms, found)
    floors = {name: rooms[room] for name, room in inroom.items() if problem.objects.get(name) in FLOORS}
    loose = {name: rooms[inroom[name]] for name in fixtures if name not in found}
    additions = _in_order(problem, placed, found, floors, loose)
    return Binding(problem, found, floors, additions, rooms, _robot_room(problem, placed, floors, scene))


def _with_wildcards_expanded(
    problem: BddlProblem, view: SceneView, rooms: Mapping[str, str], found: dict[str, str]
) -> BddlProblem:
    """The problem with wildcards replaced by all further objects of the type in the room, which are added to ``found``."""
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
    """How ``:init`` places each object that it places."""
    placed: dict[str, tuple[Relation, str]] = {}
    for relation in PLACING:
        for item in problem.init:
            if item.positive and item.atom.predicate == relation:
                placed.setdefault(item.atom.args[0], (relation, item.atom.args[1]))
    return placed


def _in_order(
    problem: BddlProblem,
    placed: Mapping[str, tuple[Relation, str]],
    found: Mapping[str, str],
    floors: Mapping[str, str],
    loose: Mapping[str, str],
) -> tuple[Addition, ...]:
    """Additions such that each host is there before its guest. What the start places nowhere may be anywhere."""
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
                f"the start puts {waiting[0]!r} at {placed[waiting[0]][1]!r}, and says of neither where it is",
            )
        waiting.remove(name)
        ready.add(name)
        at = placed.get(name) if name not in loose else None
        where = _place_of(at, floors) if at else (None, "", loose.get(name, ""))
        beside = _neighbours(problem, name, ready)
        additions.append(Addition(name, problem.objects[name], *where, beside, needs.get(name, frozenset())))
    return tuple(additions)


def _neighbours(problem: BddlProblem, name: str, ready: Container[str]) -> tuple[str, ...]:
    """Objects that are there before and that the start puts next to one, in either order."""
    pairs = (
        item.atom.args for item in problem.init if item.positive and item.atom.predicate == Relation.NEXTTO
    )
    others = (b if a == name else a for a, b in pairs if name in (a, b))
    return tuple(dict.fromkeys(other for other in others if other in ready))


def _to_add(problem: BddlProblem, ready: Container[str]) -> list[str]:
    """The problem's objects that the scene lacks: no halves, which come of slicing, and nothing without a body."""
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
    """Relation, host and room of an addition; what the start puts on a floor is on top of no object."""
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
