"""Search for a problem's furniture in a scene, by backtracking over rooms and objects."""

import itertools
import math
from collections import defaultdict
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from embomatrix.factory.admission import RefusalReason, RefusedError
from embomatrix.factory.scenes.view import SceneView, is_liftable
from embomatrix.factory.task_import.size_requirements import (
    Requirement,
    requirement_on,
    requirements_of,
    room_for,
)
from embomatrix.world.asset import Asset
from embomatrix.world.bddl import BddlProblem, is_room_instance
from embomatrix.world.catalog import Catalog, CatalogError
from embomatrix.world.evaluate import atoms_of
from embomatrix.world.scene import Scene
from embomatrix.world.state import Relation, State

MAX_STEPS: Final = 20_000
"""Maximum number of assignments tried."""
SIMILAR_ROOMS: Final[Mapping[str, str]] = {
    "television_room": "living_room",
    "childs_room": "bedroom",
    "pantry_room": "storage_room",
    "utility_room": "storage_room",
    "playroom": "living_room",
}
"""Room types that replace a missing type when rooms are renumbered."""
COVER_M: Final = 0.08
"""Objects within this height above a surface cover it."""
DOORS: Final = frozenset({"openable", "container"})
"""Abilities that need doors, if there are any."""
MAX_CHOICES: Final = 200
"""Maximum number of room assignments tried."""


@dataclass(frozen=True, slots=True)
class BindingOptions:
    """Options of a binding."""

    furnishing: bool = True
    """If true, missing furniture is added, as in the paper's factory."""
    reachable: bool = True
    """If true, goals that no skill reaches are refused. Otherwise goals must only be evaluable."""
    renumbering: bool = False
    """If true, ``kitchen_0`` may be another kitchen, since other datasets number rooms differently."""
    usable: bool = False
    """If true, furniture that the goal fills or opens has doors that open, and its top is free of background objects.

    Days lay out scenes without it: what they give is frozen by digest.
    """
    categories: Mapping[str, str] = field(default_factory=dict)
    """Category of an object by its name, where the type alone leaves a choice."""

    def categories_of(self, problem: BddlProblem, name: str) -> Sequence[str]:
        """Return the categories that an object of the problem may have."""
        return (
            (self.categories[name],)
            if name in self.categories
            else (Catalog.load().categories_of(problem.objects[name]))
        )


def search(
    problem: BddlProblem,
    view: SceneView,
    inroom: Mapping[str, str],
    fixtures: list[str],
    rng: np.random.Generator,
    options: BindingOptions,
    excluded: Container[str],
) -> tuple[dict[str, str], dict[str, str]]:
    """Return scene rooms for the problem's rooms, and scene objects for its fixtures.

    All objects with one room name are in one room. If furniture is missing, the rooms that lack least are used. With
    renumbering, ``kitchen_0`` may be any kitchen, preferably another one, and a missing room type is replaced by
    a similar one. Scene objects in ``excluded`` are not used.
    """
    words = sorted(set(inroom.values()))
    find = _renumbered if options.renumbering else _rooms_for
    candidates = {word: find(view.scene, word, rng) for word in words}
    needs, requirements = abilities_needed(problem), requirements_of(problem)
    best: tuple[int, dict[str, str], dict[str, str]] | None = None
    lacking = ""
    for rooms in itertools.islice(_room_choices(words, candidates), MAX_CHOICES):
        wanted = {name: rooms[inroom[name]] for name in fixtures}
        found, missing = _assign(
            *_domains(problem, view, wanted, needs, requirements, rng, excluded, options)
        )
        if not missing:
            return rooms, found
        first = missing[0]
        lacking = lacking or f"{first} of type {problem.objects[first]!r} in {rooms[inroom[first]]}"
        if best is None or len(missing) < best[0]:
            best = (len(missing), rooms, found)
    if best is None or not options.furnishing:
        raise RefusedError(
            RefusalReason.NO_SCENE_OBJECT,
            f"{view.scene.base} has no free object for {lacking or 'the rooms'}",
        )
    return best[1], best[2]


def _rooms_for(scene: Scene, word: str, rng: np.random.Generator) -> list[str]:
    names = [room.name for room in scene.rooms if word in (room.name, room.type)]
    if not names:
        raise RefusedError(
            RefusalReason.ROOM_MISSING,
            f"{scene.base} has no {word!r}: its rooms are {', '.join(room.name for room in scene.rooms)}",
        )
    return [str(name) for name in rng.permutation(names)]


def _renumbered(scene: Scene, word: str, rng: np.random.Generator) -> list[str]:
    stem = room_type_of(word)
    if not any(room.type == stem for room in scene.rooms):
        stem = SIMILAR_ROOMS.get(stem, stem)
    return sorted(_rooms_for(scene, stem, rng), key=lambda name: name == word)


def room_type_of(word: str) -> str:
    """Return the room type of a room name: ``kitchen`` for ``kitchen_0`` and for ``kitchen``."""
    return word.rpartition("_")[0] if is_room_instance(word) else word


def _room_choices(words: list[str], options: Mapping[str, list[str]]) -> Iterator[dict[str, str]]:
    for rooms in itertools.product(*(options[word] for word in words)):
        if len(set(rooms)) == len(rooms):
            yield dict(zip(words, rooms, strict=True))


def abilities_needed(problem: BddlProblem) -> Mapping[str, frozenset[str]]:
    """Return the abilities that start and goal require of each object or type."""
    needs: defaultdict[str, set[str]] = defaultdict(set)
    for atom in (*atoms_of(problem.goal), *(item.atom for item in problem.init if item.positive)):
        if atom.predicate == State.OPEN:
            needs[atom.args[0]].add("openable")
        elif atom.predicate == State.TOGGLED_ON:
            needs[atom.args[0]].add("toggleable")
        elif atom.predicate == Relation.INSIDE:
            needs[atom.args[1]].add("container")
    return {name: frozenset(values) for name, values in needs.items()}


def _domains(
    problem: BddlProblem,
    view: SceneView,
    wanted: Mapping[str, str],
    needs: Mapping[str, frozenset[str]],
    requirements: Mapping[str, Requirement],
    rng: np.random.Generator,
    excluded: Container[str],
    options: BindingOptions,
) -> tuple[dict[str, list[str]], list[str]]:
    """Return candidate scene objects for each name, the best first, and the names of furniture without any."""
    hosts = {host for _, host in problem.initial_pairs(Relation.ONTOP, Relation.INSIDE)}
    domains: dict[str, list[str]] = {}
    missing: list[str] = []
    for name, room in wanted.items():
        requirement = requirement_on(requirements, name, problem.objects[name])
        contents = requirement.contents
        categories = set(options.categories_of(problem, name))
        fits = [
            other
            for other in view.in_room.get(room, ())
            if view.category(other) in categories
            and other not in excluded
            and has_abilities(view.asset(other), needs.get(name, frozenset()))
            and not (options.usable and DOORS & needs.get(name, frozenset()) and not view.opens(other))
            and not (requirement.carried and _is_too_heavy(view, other))
        ]
        if fits:
            order = [str(other) for other in rng.permutation(fits)]
            if name in hosts:
                order.sort(key=lambda other: -_spare_m2(view, other))
            if contents:
                order.sort(key=lambda other: room_for(view.asset(other), contents))
            domains[name] = order
        elif not any(_liftable(category) for category in categories):
            missing.append(name)
    return domains, missing


def _is_too_heavy(view: SceneView, name: str) -> bool:
    """True if the robot can't carry the object. A scaled one is added in its place."""
    asset = view.asset(name)
    return not is_liftable(asset.size_m, asset.mass_kg)


def _spare_m2(view: SceneView, name: str) -> float:
    """Return the area of the object's largest surface minus the objects on it. Larger areas are bound first.

    A surface covered by another object, such as a worktop below an oven, has no free area.
    """
    asset, item = view.asset(name), view.item(name)
    x, y, z = item.pose_world_asset.position_m
    top = z + asset.size_m[2] / 2
    taken = 0.0
    for other in view.scene.objects:
        if other.host == name:
            taken += math.prod(view.asset(other.name).size_m[:2])
        elif other.room == item.room and other.name != name and other.fixed:
            size = view.asset(other.name).size_m
            ox, oy, oz = other.pose_world_asset.position_m
            depth, width = size[:2] if abs(math.cos(other.pose_world_asset.yaw)) > 0.5 else size[1::-1]
            if (
                abs(ox - x) < depth / 2
                and abs(oy - y) < width / 2
                and -COVER_M <= oz - size[2] / 2 - top <= COVER_M
            ):
                return -1.0
    return max((math.prod(surface.size_m) for surface in asset.supports), default=0.0) - taken


def _assign(domains: dict[str, list[str]], missing: list[str]) -> tuple[dict[str, str], list[str]]:
    """Assign distinct scene objects to as many names as possible, and return the names of missing furniture.

    Small objects that the scene lacks are in neither result.
    """
    while True:
        found: dict[str, str] = {}
        failed = _backtrack(sorted(domains, key=lambda name: len(domains[name])), domains, found, [0])
        if not failed:
            return found, missing
        missing.append(failed)
        del domains[failed]


def _backtrack(
    order: list[str], domains: Mapping[str, list[str]], found: dict[str, str], steps: list[int]
) -> str:
    """Fill ``found``. Return the name without a free object, or an empty string."""
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


def has_abilities(asset: Asset, needs: Iterable[str]) -> bool:
    """True if the asset has all abilities. A container has a cavity."""
    return all(bool(asset.interiors) if need == "container" else asset.can(need) for need in needs)


def _liftable(category: str) -> bool:
    catalog = Catalog.load()
    try:
        mass = catalog.category(category).mass_kg
    except CatalogError:
        return False
    return any(is_liftable(model.size_m, mass) for model in catalog.models_of(category))
