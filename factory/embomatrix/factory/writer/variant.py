"""Scene variants: a base scene with small things about, some doors open and some lights on. Several tasks share one."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from embomatrix.factory.furnish.small_objects import (
    BASKETS,
    MEMBERS,
    ItemKind,
    belongs,
    groups_for,
    is_left_on,
)
from embomatrix.factory.layout.generator import lay
from embomatrix.factory.layout.jobs import RequestedObject
from embomatrix.factory.scenes.editor import SceneEditor
from embomatrix.factory.scenes.view import SceneView, is_liftable
from embomatrix.factory.writer.starts import OpenStarts
from embomatrix.world.catalog import Catalog
from embomatrix.world.state import State

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import numpy as np

    from embomatrix.factory.layout.jobs import LayoutAgents
    from embomatrix.factory.layout.tree import LayoutTree
    from embomatrix.world.scene import Scene

THINGS: Final = 12
"""Small things that a variant adds, over all its rooms."""
TRIES: Final = 3
"""Models that are tried for one thing before it is left out."""
BASKET_SHARE: Final = 0.5
OPEN_SHARE: Final = 0.2
ON_SHARE: Final = 0.3


@dataclass(frozen=True, slots=True)
class Variant:
    """A scene to write tasks in. ``rooms`` are those that the tasks may use; ``added`` the small things in them.

    ``trees`` tell by room how what was added hangs together.
    """

    scene: Scene
    rooms: tuple[str, ...]
    added: tuple[str, ...]
    trees: Mapping[str, LayoutTree] = field(default_factory=dict)


def build_variant(
    base: Scene,
    rooms: Sequence[str],
    scene_id: str,
    rng: np.random.Generator,
    agents: LayoutAgents | None = None,
) -> Variant:
    """Put small things about in these rooms of a base scene. The same generator state gives the same variant."""
    editor = SceneEditor(base)
    view = SceneView(base)
    items = _things(view, rooms, rng)
    layout = lay(editor, items, int(rng.integers(2**31)), agents)
    for name in [*layout.names.values()]:
        if name in editor.objects and not _is_in_its_place(editor, name):
            editor.remove(name)
    _set_doors_and_lights(editor, view, rooms, rng)
    added = tuple(layout.names[item.name] for item in items if layout.names.get(item.name) in editor.objects)
    trees = {room: tree.pruned(added) for room, tree in layout.trees.items()}
    return Variant(editor.freeze(scene_id), tuple(rooms), added, trees)


def _is_in_its_place(editor: SceneEditor, name: str) -> bool:
    """Whether an added thing stands where people leave such things, or is one that they put on the floor."""
    category, host = editor.asset_of(name).category, editor.objects[name].host
    if category in BASKETS:
        return True
    return bool(host) and is_left_on(category, editor.asset_of(host).category)


def _things(view: SceneView, rooms: Sequence[str], rng: np.random.Generator) -> list[RequestedObject]:
    """What goes into the rooms: a basket now and then, and things that suit them, each of another category than what is there.

    So words can tell them apart. Which of the rooms that suit a thing it goes to is not decided here.
    """
    types = {room.name: room.type for room in view.scene.rooms}
    present = {view.category(name) for room in rooms for name in view.in_room[room]}
    chosen: dict[str, tuple[str, ...]] = {}
    for room in rooms:
        if rng.random() < BASKET_SHARE:
            chosen.setdefault(BASKETS[int(rng.integers(len(BASKETS)))], (room,))
        share = max(4, round(THINGS / len(rooms)))
        fresh = (name for name in _categories(types[room], rng) if name not in present | chosen.keys())
        for name in itertools.islice(fresh, share):
            chosen[name] = tuple(each for each in rooms if belongs(name, types[each]))
    return [RequestedObject(name, _models(name, rng), rooms=where) for name, where in chosen.items()]


def _categories(room_type: str, rng: np.random.Generator) -> list[str]:
    """Categories that suit a room, in random order, the likelier groups first."""
    groups = groups_for(room_type)
    pools: dict[ItemKind, list[str]] = {
        group: [str(name) for name in rng.permutation(MEMBERS[group])] for group in dict.fromkeys(groups)
    }
    order: list[str] = []
    while any(pools.values()):
        group = groups[int(rng.integers(len(groups)))]
        if pools[group]:
            order.append(pools[group].pop())
    return [name for name in order if belongs(name, room_type)]


def _models(category: str, rng: np.random.Generator) -> tuple[tuple[str, str], ...]:
    """Models that the robot can carry, in random order."""
    catalog = Catalog.load()
    mass = catalog.category(category).mass_kg
    models = [model for model in catalog.models_of(category) if is_liftable(model.size_m, mass)]
    return tuple((category, models[index].model_id) for index in rng.permutation(len(models))[:TRIES])


def _set_doors_and_lights(
    editor: SceneEditor, view: SceneView, rooms: Sequence[str], rng: np.random.Generator
) -> None:
    """Open some doors that have room, switch some things on. What runs only when closed stays off: its door may be open."""
    names = [name for room in rooms for name in view.in_room[room]]
    starts = OpenStarts(editor, filter(view.is_openable, names))
    for name in names:
        if view.is_openable(name) and rng.random() < OPEN_SHARE:
            starts.open(name)
        elif view.is_toggleable(name) and not view.asset(name).joints and rng.random() < ON_SHARE:
            editor.set_states(name, view.item(name).states | {State.TOGGLED_ON})
