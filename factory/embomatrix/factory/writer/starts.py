"""Which doors may stand open when a task begins: all that the robot could get at and open before, it still can."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

from embomatrix.factory.scenes.check import reach_problems
from embomatrix.factory.scenes.floor import ReachableFloor, box_of
from embomatrix.factory.scenes.joints import bumped_into, with_joints
from embomatrix.factory.scenes.solids import Solids, placed_parts

if TYPE_CHECKING:
    from collections.abc import Iterable

    from embomatrix.factory.scenes.editor import SceneEditor
    from embomatrix.world.scene import Scene

SWEEP: Final = (1 / 3, 2 / 3, 1.0)
"""Shares of a travel at which a door is looked at while it swings."""


class OpenStarts:
    """Opens doors in an editor's scene. ``doors`` are those that tasks may ask to open."""

    def __init__(self, editor: SceneEditor, doors: Iterable[str]) -> None:
        self._editor = editor
        self._doors = tuple(doors)
        self._scene = editor.freeze(editor.base.scene_id)
        self._solids = Solids.of_scene(self._scene)
        self._lost = _out_of_reach(self._scene)

    def open(self, name: str) -> bool:
        """Open an object's doors and drawers fully, unless that is in the way of something. Whether they are open now."""
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
        leaf = Solids()
        leaf.add(name, placed_parts(trial.asset_of(name), item.pose_world_asset, item.joints))
        for other in self._doors:
            swinging = trial.by_name[other]
            if other == name or any(swinging.joints):
                continue
            asset = trial.asset_of(other)
            sweep = (placed_parts(asset, swinging.pose_world_asset, [s] * len(asset.joints)) for s in SWEEP)
            if any(leaf.overlaps(parts) for parts in sweep):
                return True
        return False


def _out_of_reach(scene: Scene) -> frozenset[str]:
    """Rooms and furniture that the robot can't get at, and loose things that it can't reach from where it can drive."""
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
