"""Scene variants: a base scene with small objects, some open doors and some lights on. Several tasks share one."""

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from embomatrix.factory.assets.solids import Solids, placed_parts
from embomatrix.factory.furnish.small_objects import (
    BASKETS,
    MEMBERS,
    ItemKind,
    belongs,
    groups_for,
    is_left_on,
)
from embomatrix.factory.layout.generator import lay
from embomatrix.factory.layout.organization import LayoutTree
from embomatrix.factory.layout.request import LayoutAgents, RequestedObject
from embomatrix.factory.scenes.check import reach_problems
from embomatrix.factory.scenes.editor import SceneEditor
from embomatrix.factory.scenes.floor import ReachableFloor, box_of
from embomatrix.factory.scenes.joints import bumped_into, with_joints
from embomatrix.factory.scenes.view import SceneView, is_liftable
from embomatrix.world.catalog import Catalog
from embomatrix.world.scene import Scene
from embomatrix.world.state import State

SWEEP: Final = (1 / 3, 2 / 3, 1.0)
"""Fractions of a door's travel at which its swing is checked."""


class DoorOpener:
    """Opener of doors in an editor's scene. ``doors`` are those that tasks may ask to open."""

    def __init__(self, editor: SceneEditor, doors: Iterable[str]) -> None:
        self._editor = editor
        self._doors = tuple(doors)
        self._scene = editor.freeze(editor.base.scene_id)
        self._solids = Solids.of_scene(self._scene)
        self._lost = _out_of_reach(self._scene)

    def open(self, name: str) -> bool:
        """Open an object's doors and drawers fully. Return False if that would obstruct something."""
        item = self._scene.by_name[name]
        asset = self._scene.asset_of(name)
        wide = (1.0,) * len(asset.joints)
        if bumped_into(self._scene, self._solids, name, wide):
            return False
        changed = with_joints(self._scene.by_name, self._scene.assets, name, wide)
        objects = tuple(changed.get(other.name, other) for other in self._scene.objects)
        trial = replace(self._scene, objects=objects)
        if self._in_the_way_of_doors(name, trial) or not _out_of_reach(trial) <= self._lost:
            return False
        self._editor.set_joints(name, wide)
        self._solids.add(name, placed_parts(asset, item.pose_world_asset, wide))
        self._scene = trial
        return True

    def _in_the_way_of_doors(self, name: str, trial: Scene) -> bool:
        item = trial.by_name[name]
        panel = Solids()
        panel.add(name, placed_parts(trial.asset_of(name), item.pose_world_asset, item.joints))
        for other in self._doors:
            swinging = trial.by_name[other]
            if other == name or any(swinging.joints):
                continue
            asset = trial.asset_of(other)
            sweep = (placed_parts(asset, swinging.pose_world_asset, [s] * len(asset.joints)) for s in SWEEP)
            if any(panel.overlaps(parts) for parts in sweep):
                return True
        return False


def _out_of_reach(scene: Scene) -> frozenset[str]:
    """Return rooms and furniture that the robot can't reach, and loose objects out of its reach."""
    floor = ReachableFloor(scene)
    found = {name for problem in reach_problems(scene) for name in problem.names}
    for item in scene.objects:
        if item.fixed or item.absent:
            continue
        host = scene.by_name.get(item.host)
        doored = host is not None and bool(scene.asset_of(host.name).joints)
        front = host.pose_world_asset if host is not None and doored else None
        if not len(floor.spots(box_of(scene, item), front_of=front)):
            found.add(item.name)
    return frozenset(found)


SMALL_OBJECTS: Final = 12
"""Number of small objects that a variant adds over all its rooms."""
TRIES: Final = 3
"""Number of models tried for one object."""
BASKET_SHARE: Final = 0.5
OPEN_SHARE: Final = 0.2
ON_SHARE: Final = 0.3


@dataclass(frozen=True, slots=True)
class Variant:
    """Scene for tasks. ``rooms`` are the rooms that tasks may use; ``added`` lists the small objects in them.

    ``trees`` holds the layout tree of the added objects by room.
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
    """Add small objects to these rooms of a base scene. Equal generator states give equal variants."""
    editor = SceneEditor(base)
    view = SceneView(base)
    items = _requested_objects(view, rooms, rng)
    layout = lay(editor, items, int(rng.integers(2**31)), agents)
    for name in [*layout.names.values()]:
        if name in editor.objects and not _is_well_placed(editor, name):
            editor.remove(name)
    _set_doors_and_lights(editor, view, rooms, rng)
    added = tuple(layout.names[item.name] for item in items if layout.names.get(item.name) in editor.objects)
    trees = {room: tree.pruned(added) for room, tree in layout.trees.items()}
    return Variant(editor.freeze(scene_id), tuple(rooms), added, trees)


def _is_well_placed(editor: SceneEditor, name: str) -> bool:
    """True if an added object stands on a usual host, or on the floor if it belongs there."""
    category, host = editor.asset_of(name).category, editor.objects[name].host
    if category in BASKETS:
        return True
    return bool(host) and is_left_on(category, editor.asset_of(host).category)


def _requested_objects(
    view: SceneView, rooms: Sequence[str], rng: np.random.Generator
) -> list[RequestedObject]:
    """Return the objects to add: sometimes a basket, and objects that suit the rooms, each of a new category.

    Distinct categories let words identify the objects. The layout agents choose the rooms.
    """
    types = {room.name: room.type for room in view.scene.rooms}
    present = {view.category(name) for room in rooms for name in view.in_room[room]}
    chosen: dict[str, tuple[str, ...]] = {}
    for room in rooms:
        if rng.random() < BASKET_SHARE:
            chosen.setdefault(BASKETS[int(rng.integers(len(BASKETS)))], (room,))
        share = max(4, round(SMALL_OBJECTS / len(rooms)))
        fresh = (name for name in _categories(types[room], rng) if name not in present | chosen.keys())
        for name in itertools.islice(fresh, share):
            chosen[name] = tuple(each for each in rooms if belongs(name, types[each]))
    return [RequestedObject(name, _models(name, rng), rooms=where) for name, where in chosen.items()]


def _categories(room_type: str, rng: np.random.Generator) -> list[str]:
    """Return the categories that suit a room in random order, likelier groups first."""
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
    """Return portable models in random order."""
    catalog = Catalog.load()
    mass = catalog.category(category).mass_kg
    models = [model for model in catalog.models_of(category) if is_liftable(model.size_m, mass)]
    return tuple((category, models[index].model_id) for index in rng.permutation(len(models))[:TRIES])


def _set_doors_and_lights(
    editor: SceneEditor, view: SceneView, rooms: Sequence[str], rng: np.random.Generator
) -> None:
    """Open some doors that have space and switch some devices on. Devices with doors stay off, since they only run closed."""
    names = [name for room in rooms for name in view.in_room[room]]
    starts = DoorOpener(editor, filter(view.is_openable, names))
    for name in names:
        if view.is_openable(name) and rng.random() < OPEN_SHARE:
            starts.open(name)
        elif view.is_toggleable(name) and not view.asset(name).joints and rng.random() < ON_SHARE:
            editor.set_states(name, view.item(name).states | {State.TOGGLED_ON})
