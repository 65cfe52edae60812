"""Binding: the objects of a BDDL problem are found in a base scene, or refused for a reason.

``inroom`` names the scene's own objects; they are found by backtracking over room instances and categories. What the
problem puts on, in, under or beside something is added later by the editor. Substances have no place: they are what things
are covered, filled or soaked with. Objects that are still to come are the halves of things that can be sliced.
"""

from __future__ import annotations

import difflib
from collections import defaultdict
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from embomatrix.factory.refusal import RefusalReason, RefusedError
from embomatrix.factory.task_import.reach import FUTURE, HELD, INSOURCE, Horizon, pieces_of
from embomatrix.factory.writer.view import SceneView, is_liftable
from embomatrix.world.bddl import is_room_instance
from embomatrix.world.catalog import Catalog, CatalogError
from embomatrix.world.evaluate import atoms_of, render
from embomatrix.world.state import Relation, State
from embomatrix.world.substances import is_substance

if TYPE_CHECKING:
    from collections.abc import Container, Iterable, Iterator, Mapping

    import numpy as np

    from embomatrix.world.bddl import Problem
    from embomatrix.world.goal import Atom
    from embomatrix.world.scene import Scene

FLOORS: Final = frozenset({"floor.n.01"})
AGENT: Final = "agent.n.01"
PLACING: Final = (Relation.INSIDE, Relation.ONTOP, Relation.UNDER, Relation.NEXTTO)
"""Relations by which ``:init`` places an object, the most telling first."""
MAX_STEPS: Final = 20_000
"""Assignments that are looked at before a scene counts as lacking the objects."""


@dataclass(frozen=True, slots=True)
class Addition:
    """An object that the editor must add. ``host`` is another object of the problem, or empty: the floor of ``room``."""

    name: str
    type: str
    relation: Relation | None
    host: str
    room: str


@dataclass(frozen=True, slots=True)
class Binding:
    """``found`` maps objects of the problem to scene objects, ``floors`` to rooms; ``additions`` are in order of need.

    ``problem`` is the one that was bound, with its wildcards spelt out.
    """

    problem: Problem
    found: Mapping[str, str]
    floors: Mapping[str, str]
    additions: tuple[Addition, ...]
    rooms: Mapping[str, str]
    """The problem's words for rooms, and the rooms of the scene that they stand for."""
    robot_room: str


def bind(problem: Problem, scene: Scene, rng: np.random.Generator) -> Binding:
    """Find the problem's objects in the scene. Raises RefusedError with the first thing that can't be bound."""
    check_expressible(problem)
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
    rooms, found = _search(problem, view, inroom, fixtures, rng)
    problem = _spelt_out(problem, view, rooms, found)
    floors = {name: rooms[room] for name, room in inroom.items() if problem.objects.get(name) in FLOORS}
    loose = {name: rooms[inroom[name]] for name in fixtures if name not in found}
    additions = _in_order(problem, placed, found, floors, loose)
    return Binding(problem, found, floors, additions, rooms, _robot_room(problem, placed, floors, scene))


def check_expressible(problem: Problem) -> None:
    """Raise RefusedError for what no scene could hold and no skill could reach, whatever the scene."""
    _check_types(problem)
    _check_goal(problem)
    _check_start(problem)


def _spelt_out(problem: Problem, view: SceneView, rooms: Mapping[str, str], found: dict[str, str]) -> Problem:
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


def _check_types(problem: Problem) -> None:
    catalog = Catalog.load()
    for name, type_name in problem.objects.items():
        if type_name == AGENT or type_name in FLOORS:
            continue
        if not catalog.has_synset(type_name):
            raise RefusedError(
                RefusalReason.UNKNOWN_TYPE,
                f"type {type_name!r} of {name!r} is in no catalog{_close_synsets(type_name)}",
            )
        if not is_substance(type_name) and not catalog.categories_of(type_name):
            raise RefusedError(RefusalReason.UNKNOWN_TYPE, f"no category has a model of type {type_name!r}")


def _close_synsets(type_name: str) -> str:
    catalog = Catalog.load()
    synsets = sorted({catalog.synset_of(category) for category in catalog.category_names})
    close = difflib.get_close_matches(type_name, synsets, n=3, cutoff=0.6)
    return f": did you mean {', '.join(close)}?" if close else ""


def _check_goal(problem: Problem) -> None:
    obstacle = Horizon(problem).obstacle(problem.goal)
    if obstacle is not None:
        solid = not any(
            is_substance(_type(problem, arg)) for atom in atoms_of(obstacle) for arg in atom.args[:1]
        )
        raise RefusedError(
            RefusalReason.INEXPRESSIBLE if solid else RefusalReason.SUBSTANCE,
            f"the goal asks for {render(obstacle)}, which no skill brings about",
        )
    for atom in atoms_of(problem.goal):
        _check_goal_args(problem, atom)


def _check_start(problem: Problem) -> None:
    pieces = {half for halves in pieces_of(problem).values() for half in halves}
    for item in problem.init:
        predicate, args = item.atom.predicate, item.atom.args
        if item.positive and predicate not in HELD | {INSOURCE}:
            raise RefusedError(
                RefusalReason.INEXPRESSIBLE,
                f"the start asks for {predicate!r}, which the world does not hold",
            )
        if predicate in set(Relation) and any(is_substance(_type(problem, arg)) for arg in args):
            raise RefusedError(
                RefusalReason.SUBSTANCE, f"the start asks for {render(item.atom)}: a substance has no place"
            )
        if predicate == FUTURE and args[0] not in pieces and not is_substance(_type(problem, args[0])):
            raise RefusedError(
                RefusalReason.INEXPRESSIBLE,
                f"{args[0]!r} is to come, and no skill makes it: only halves are made",
            )
        for arg in args[: 1 if predicate == Relation.INROOM else 2]:
            _check_no_room(problem, arg)


def _type(problem: Problem, arg: str) -> str:
    """Type of an object, or of a bound variable that is called by it, ``?water.n.06``."""
    return problem.objects.get(arg, arg.lstrip("?"))


def _check_goal_args(problem: Problem, atom: Atom) -> None:
    objects = atom.args[:1] if atom.predicate == Relation.INROOM else atom.args
    for arg in objects:
        if arg.startswith("?"):
            continue
        _check_no_room(problem, arg)
        if problem.objects[arg] == AGENT:
            raise RefusedError(RefusalReason.AGENT_IN_GOAL, "the goal is about where the robot stands")


def _check_no_room(problem: Problem, arg: str) -> None:
    if arg not in problem.objects and is_room_instance(arg):
        raise RefusedError(
            RefusalReason.ROOM_AS_OBJECT, f"{arg!r} is a room and stands where an object should"
        )


def _placements(problem: Problem) -> dict[str, tuple[Relation, str]]:
    """How ``:init`` places each object that it places."""
    placed: dict[str, tuple[Relation, str]] = {}
    for relation in PLACING:
        for item in problem.init:
            if item.positive and item.atom.predicate == relation:
                placed.setdefault(item.atom.args[0], (relation, item.atom.args[1]))
    return placed


def _search(
    problem: Problem,
    view: SceneView,
    inroom: Mapping[str, str],
    fixtures: list[str],
    rng: np.random.Generator,
) -> tuple[dict[str, str], dict[str, str]]:
    """Rooms for the problem's rooms, and scene objects for its fixtures. All objects of one word are in one room."""
    words = sorted(set(inroom.values()))
    options = {word: _rooms_for(view.scene, word, rng) for word in words}
    needs = _needs(problem)
    lacking = ""
    for rooms in _room_choices(words, options):
        found, missing = _assign(problem, view, {name: rooms[inroom[name]] for name in fixtures}, needs, rng)
        if not missing:
            return rooms, found
        lacking = lacking or f"{missing} of type {problem.objects[missing]!r} in {rooms[inroom[missing]]}"
    raise RefusedError(
        RefusalReason.NO_SCENE_OBJECT, f"{view.scene.base} has no free object for {lacking or 'the rooms'}"
    )


def _rooms_for(scene: Scene, word: str, rng: np.random.Generator) -> list[str]:
    if is_room_instance(word):
        names = [room.name for room in scene.rooms if room.name == word]
    else:
        names = [room.name for room in scene.rooms if room.type == word]
    if not names:
        raise RefusedError(
            RefusalReason.ROOM_MISSING,
            f"{scene.base} has no {word!r}: its rooms are {', '.join(room.name for room in scene.rooms)}",
        )
    return [str(name) for name in rng.permutation(names)]


def _room_choices(words: list[str], options: Mapping[str, list[str]]) -> Iterator[dict[str, str]]:
    if not words:
        yield {}
        return
    for room in options[words[0]]:
        for rest in _room_choices(words[1:], options):
            if room not in rest.values():
                yield {words[0]: room, **rest}


def _needs(problem: Problem) -> Mapping[str, frozenset[str]]:
    """What an object, or a whole type, must be able to do for start and goal to make sense."""
    needs: defaultdict[str, set[str]] = defaultdict(set)
    for atom in (*atoms_of(problem.goal), *(item.atom for item in problem.init if item.positive)):
        if atom.predicate == State.OPEN:
            needs[atom.args[0]].add("openable")
        elif atom.predicate == State.TOGGLED_ON:
            needs[atom.args[0]].add("toggleable")
        elif atom.predicate == Relation.INSIDE:
            needs[atom.args[1]].add("container")
    return {name: frozenset(values) for name, values in needs.items()}


def _assign(
    problem: Problem,
    view: SceneView,
    wanted: Mapping[str, str],
    needs: Mapping[str, frozenset[str]],
    rng: np.random.Generator,
) -> tuple[dict[str, str], str]:
    """A scene object of its own for each name; the second value is a name for which none is left.

    Small things that the scene lacks are left for the editor to add.
    """
    catalog = Catalog.load()
    domains: dict[str, list[str]] = {}
    for name, room in wanted.items():
        categories = set(catalog.categories_of(problem.objects[name]))
        fits = [
            other
            for other in view.in_room.get(room, ())
            if view.category(other) in categories and _serves(view, other, needs.get(name, frozenset()))
        ]
        if fits:
            domains[name] = [str(other) for other in rng.permutation(fits)]
        elif not any(_liftable(category) for category in categories):
            return {}, name
    order = sorted(domains, key=lambda name: len(domains[name]))
    found: dict[str, str] = {}
    failed = _backtrack(order, domains, found, [0])
    return found, failed


def _backtrack(
    order: list[str], domains: Mapping[str, list[str]], found: dict[str, str], steps: list[int]
) -> str:
    """Fill ``found``; returns the name that could not be served, or empty."""
    if len(found) == len(order):
        return ""
    name = order[len(found)]
    failed = name
    for other in domains[name]:
        steps[0] += 1
        if other in found.values() or steps[0] > MAX_STEPS:
            continue
        found[name] = other
        deeper = _backtrack(order, domains, found, steps)
        if not deeper:
            return ""
        failed = deeper
        del found[name]
    return failed


def _serves(view: SceneView, name: str, needs: Iterable[str]) -> bool:
    asset = view.asset(name)
    return all(bool(asset.interiors) if need == "container" else asset.can(need) for need in needs)


def _liftable(category: str) -> bool:
    catalog = Catalog.load()
    try:
        mass = catalog.category(category).mass_kg
    except CatalogError:
        return False
    return any(is_liftable(model.size_m, mass) for model in catalog.models_of(category))


def _in_order(
    problem: Problem,
    placed: Mapping[str, tuple[Relation, str]],
    found: Mapping[str, str],
    floors: Mapping[str, str],
    loose: Mapping[str, str],
) -> tuple[Addition, ...]:
    """Additions such that each host is there before its guest."""
    additions: list[Addition] = []
    ready = {*found, *floors}
    waiting = _to_add(problem, ready)
    while waiting:
        name = next(
            (name for name in waiting if name in loose or placed.get(name, (None, ""))[1] in ready), None
        )
        if name is None:
            raise RefusedError(
                RefusalReason.NO_PLACE_GIVEN,
                f"the start does not say where {waiting[0]!r} is, in a room or at an object",
            )
        waiting.remove(name)
        ready.add(name)
        where = (None, "", loose[name]) if name in loose else _place_of(placed[name], floors)
        additions.append(Addition(name, problem.objects[name], *where))
    return tuple(additions)


def _to_add(problem: Problem, ready: Container[str]) -> list[str]:
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
    """Relation, host and room of an addition; what the start puts on a floor only has a room."""
    relation, host = at
    return (None, "", floors[host]) if host in floors else (relation, host, "")


def _robot_room(
    problem: Problem, placed: Mapping[str, tuple[Relation, str]], floors: Mapping[str, str], scene: Scene
) -> str:
    for name, type_name in problem.objects.items():
        if type_name == AGENT and name in placed:
            return floors.get(placed[name][1], scene.robot.room)
    return scene.robot.room
