"""Scene variants: a base scene with small things about, some doors open and some lights on. Several tasks share one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from embomatrix.factory.editor import PlacementError, SceneEditor
from embomatrix.factory.scenes.joints import bumped_into
from embomatrix.factory.scenes.solids import Solids, placed_parts
from embomatrix.factory.writer.tables import BASKETS, MEMBERS, Group, groups_for, suits
from embomatrix.factory.writer.view import SceneView, is_liftable
from embomatrix.world.catalog import Catalog
from embomatrix.world.state import Relation, State

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np

    from embomatrix.world.scene import Room, Scene

THINGS: Final = 12
"""Small things that a variant adds, over all its rooms."""
TRIES: Final = 3
"""Hosts that are tried for one thing before it is left out."""
INSIDE_SHARE: Final = 0.3
BASKET_SHARE: Final = 0.5
OPEN_SHARE: Final = 0.2
ON_SHARE: Final = 0.3


@dataclass(frozen=True, slots=True)
class Variant:
    """A scene to write tasks in. ``rooms`` are those that the tasks may use; ``added`` the small things in them."""

    scene: Scene
    rooms: tuple[str, ...]
    added: tuple[str, ...]


def build_variant(base: Scene, rooms: Sequence[str], scene_id: str, rng: np.random.Generator) -> Variant:
    """Put small things about in these rooms of a base scene. The same generator state gives the same variant."""
    editor = SceneEditor(base, rng)
    view = SceneView(base)
    added: list[str] = []
    by_name = {room.name: room for room in base.rooms}
    for name in rooms:
        added += _add_basket(editor, view, by_name[name], rng)
        share = max(4, round(THINGS / len(rooms)))
        added += _add_things(editor, view, by_name[name], share, rng)
    _set_doors_and_lights(editor, view, rooms, rng)
    return Variant(editor.freeze(scene_id), tuple(rooms), tuple(added))


def _add_basket(editor: SceneEditor, view: SceneView, room: Room, rng: np.random.Generator) -> list[str]:
    if rng.random() >= BASKET_SHARE:
        return []
    category = BASKETS[int(rng.integers(len(BASKETS)))]
    surfaces = [name for name in view.in_room[room.name] if view.is_surface(name)]
    hosts: list[str] = [str(host) for host in rng.permutation(surfaces)[:1]] if surfaces else []
    for host in (*hosts, room.name):
        relation = None if host == room.name else Relation.ONTOP
        try:
            return [editor.add(category, _model(category, rng), relation, host, room=room.name)]
        except PlacementError:
            continue
    return []


def _add_things(
    editor: SceneEditor, view: SceneView, room: Room, count: int, rng: np.random.Generator
) -> list[str]:
    """Things that suit the room, each of another category than what is there, so that words can tell them apart."""
    names = view.in_room[room.name]
    surfaces = [name for name in names if view.is_surface(name)]
    containers = [name for name in names if view.is_container(name)]
    present = {view.category(name) for name in names}
    added: list[str] = []
    for category in _categories(room.type, rng):
        if len(added) >= count or not (surfaces or containers):
            break
        if category in present:
            continue
        fit_surfaces, fit_containers = (
            [host for host in hosts if suits(category, view.category(host))]
            for hosts in (surfaces, containers)
        )
        for _ in range(TRIES if fit_surfaces or fit_containers else 0):
            inside = bool(fit_containers) and (not fit_surfaces or rng.random() < INSIDE_SHARE)
            pool = fit_containers if inside else fit_surfaces
            host = pool[int(rng.integers(len(pool)))]
            relation = Relation.INSIDE if inside else Relation.ONTOP
            try:
                added.append(editor.add(category, _model(category, rng), relation, host, room=room.name))
            except PlacementError:
                continue
            break
    return added


def _categories(room_type: str, rng: np.random.Generator) -> list[str]:
    """Categories that suit a room, in random order, the likelier groups first."""
    groups = groups_for(room_type)
    pools: dict[Group, list[str]] = {
        group: [str(name) for name in rng.permutation(MEMBERS[group])] for group in dict.fromkeys(groups)
    }
    order: list[str] = []
    while any(pools.values()):
        group = groups[int(rng.integers(len(groups)))]
        if pools[group]:
            order.append(pools[group].pop())
    return order


def _model(category: str, rng: np.random.Generator) -> str:
    """A model that the robot can carry."""
    catalog = Catalog.load()
    mass = catalog.category(category).mass_kg
    models = [model for model in catalog.models_of(category) if is_liftable(model.size_m, mass)]
    return models[int(rng.integers(len(models)))].model_id


def _set_doors_and_lights(
    editor: SceneEditor, view: SceneView, rooms: Sequence[str], rng: np.random.Generator
) -> None:
    """Open some doors that have room, switch some things on. What runs only when closed stays off: its door may be open."""
    scene = editor.freeze(view.scene.scene_id)
    solids = Solids.of_scene(scene)
    for room in rooms:
        for name in view.in_room[room]:
            if view.is_openable(name) and rng.random() < OPEN_SHARE:
                asset, wide = view.asset(name), [1.0] * len(view.asset(name).joints)
                if not bumped_into(scene, solids, name, wide):
                    editor.set_joints(name, wide)
                    solids.add(name, placed_parts(asset, view.item(name).pose_world_asset, wide))
            elif view.is_toggleable(name) and not view.asset(name).joints and rng.random() < ON_SHARE:
                editor.set_states(name, view.item(name).states | {State.TOGGLED_ON})
