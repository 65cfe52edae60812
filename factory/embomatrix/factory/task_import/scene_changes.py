"""Changes that an import makes to a scene, and the furniture of a problem that a scene lacks.

A binding without changes is *faithful*: the problem's own small objects were added, as it demands, and nothing else.
"""

import functools
import itertools
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from types import MappingProxyType
from typing import Final

from embomatrix.factory.scenes.view import SceneView, is_liftable
from embomatrix.factory.task_import.binding import Binding, fixtures_of
from embomatrix.factory.task_import.search import room_type_of
from embomatrix.factory.task_import.sources import SourceText
from embomatrix.world.bddl import BddlProblem
from embomatrix.world.catalog import Catalog, SceneInventory, share_of
from embomatrix.world.scene import Scene
from embomatrix.world.state import Relation

MAX_ROOM_CHOICES: Final = 500
"""Maximum number of room assignments compared in a scene."""


class SceneChange(StrEnum):
    """Changes that make a binding unfaithful."""

    FURNITURE_ADDED = "furniture_added"  # the rooms lack it
    FURNITURE_REMOVED = "furniture_removed"  # it left no room for the problem's objects
    OBJECT_RESIZED = "object_resized"  # no model of its type meets the requirements
    OTHER_ROOM_TYPE = "other_room_type"  # the scene has no room of the type
    OTHER_SCENE = "other_scene"  # the problem's author names other scenes


def changes_of(
    source: SourceText, base: Scene, binding: Binding, names: Mapping[str, str], scene: Scene
) -> tuple[SceneChange, ...]:
    """Return one change for each piece, object or room that differs from the base scene or from the problem.

    ``names`` maps the problem's objects to those of the task's ``scene``.
    """
    added = sum(
        each.is_missing_furniture and scene.by_name[names[each.name]].fixed for each in binding.additions
    )
    removed = sum(item.fixed and item.name not in scene.by_name for item in base.objects)
    resized = sum(share_of(scene.by_name[names[each.name]].asset_id) != 1 for each in binding.additions)
    types = {room.name: room.type for room in base.rooms}
    other_types = sum(types[room] != room_type_of(word) for word, room in binding.rooms.items())
    counts = {
        SceneChange.FURNITURE_ADDED: added,
        SceneChange.FURNITURE_REMOVED: removed,
        SceneChange.OBJECT_RESIZED: resized,
        SceneChange.OTHER_ROOM_TYPE: other_types,
        SceneChange.OTHER_SCENE: int(bool(source.named_scenes) and base.base not in source.named_scenes),
    }
    return tuple(change for change, count in counts.items() for _ in range(count))


@dataclass(frozen=True, slots=True)
class RoomStock:
    """Number of pieces of furniture of each category in a room."""

    name: str
    type: str
    pieces: Mapping[str, int]


def stock_of(scene: Scene) -> tuple[RoomStock, ...]:
    """Return the furniture of a built scene."""
    view = SceneView(scene)
    return tuple(
        RoomStock(room.name, room.type, Counter(map(view.category, view.in_room.get(room.name, ()))))
        for room in scene.rooms
    )


def listed_stock(inventory: SceneInventory) -> tuple[RoomStock, ...]:
    """Return the furniture that the catalog lists for a scene, including pieces that found no place in it."""
    rooms: list[RoomStock] = []
    for room in inventory.rooms:
        pieces = Counter[str]()
        for category, _, count in (*room.items, *room.doors, *room.windows):
            pieces[category] += count
        rooms.append(RoomStock(room.name, room.type, pieces))
    return tuple(rooms)


def lacking(problem: BddlProblem, stock: Sequence[RoomStock]) -> int | None:
    """Return the smallest number of pieces of the problem's furniture that its rooms lack; None without such rooms.

    Portable objects don't count, since an import adds them.
    """
    inroom = dict(problem.initial_pairs(Relation.INROOM))
    wanted = Counter(
        (inroom[name], problem.objects[name])
        for name in fixtures_of(problem)
        if _is_furniture(problem.objects[name])
    )
    choices = itertools.islice(_room_choices(sorted(set(inroom.values())), stock), MAX_ROOM_CHOICES)
    return min((_missing(wanted, rooms) for rooms in choices), default=None)


@functools.cache
def _is_furniture(type_name: str) -> bool:
    """True if the robot can't carry most models of the type. A shelf is furniture though one model is small."""
    catalog = Catalog.load()
    carried = [
        is_liftable(model.size_m, catalog.category(category).mass_kg)
        for category in (catalog.categories_of(type_name) if catalog.has_synset(type_name) else ())
        for model in catalog.models_of(category)
    ]
    return 2 * sum(carried) < len(carried) or not carried


def _room_choices(words: Sequence[str], stock: Sequence[RoomStock]) -> Iterator[Mapping[str, RoomStock]]:
    """Yield assignments of distinct rooms to the problem's room names."""
    options = [[room for room in stock if word in (room.name, room.type)] for word in words]
    for rooms in itertools.product(*options):
        if len({room.name for room in rooms}) == len(rooms):
            yield dict(zip(words, rooms, strict=True))


def _missing(wanted: Mapping[tuple[str, str], int], rooms: Mapping[str, RoomStock]) -> int:
    catalog = Catalog.load()
    left = {word: Counter(room.pieces) for word, room in rooms.items()}
    missing = 0
    for (word, type_name), count in wanted.items():
        for category in catalog.categories_of(type_name) if catalog.has_synset(type_name) else ():
            taken = min(count, left[word][category])
            left[word][category] -= taken
            count -= taken
        missing += count
    return missing


def find_right_scene(
    source: SourceText,
    problem: BddlProblem,
    scenes: Sequence[str],
    own: Mapping[str, Scene] = MappingProxyType({}),
) -> str | None:
    """Return the first scene with all rooms and all furniture of the problem, according to the catalog.

    The scenes ``own``, by name, come from files and hold what stands in them. If the problem's author names scenes, no others
    count.
    """
    catalog = Catalog.load()

    def stock(name: str) -> tuple[RoomStock, ...]:
        return stock_of(own[name]) if name in own else listed_stock(catalog.inventory(name))

    right = [scene for scene in scenes if not source.named_scenes or scene in source.named_scenes]
    return next((scene for scene in right if lacking(problem, stock(scene)) == 0), None)
