from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from embomatrix.factory.layout.sampling import ObjectSampler
from embomatrix.factory.scenes.check import check_scene
from embomatrix.factory.scenes.editor import LayoutReason, PlacementError, SceneEditor
from embomatrix.factory.scenes.floor import ReachableFloor, box_of
from embomatrix.world.asset import Credit
from embomatrix.world.state import Relation, State

if TYPE_CHECKING:
    from embomatrix.world.scene import Scene


def sampler(edit: SceneEditor, seed: int = 0) -> ObjectSampler:
    return ObjectSampler(edit, np.random.default_rng(seed))


def a_host(scene: Scene, prefix: str) -> str:
    return next(item.name for item in scene.objects if item.name.startswith(prefix))


@pytest.mark.parametrize(
    ("relation", "host"),
    [(Relation.ONTOP, "breakfast_table"), (Relation.INSIDE, "fridge"), (Relation.INSIDE, "bottom_cabinet")],
)
def test_added_object_rests_on_its_host(flat: Scene, relation: Relation, host: str) -> None:
    edit = SceneEditor(flat)
    names = [sampler(edit, n).add("apple", None, relation, a_host(flat, host)) for n in range(2)]
    scene = edit.freeze("task-scene")
    assert check_scene(scene) == ()
    assert names == ["apple_1", "apple_2"]
    assert all(
        scene.by_name[n].host == a_host(flat, host) and scene.by_name[n].relation is relation for n in names
    )
    assert not any(scene.by_name[n].fixed for n in names)


def test_new_object_of_an_imported_model_is_the_imported_one(flat: Scene) -> None:
    name = a_host(flat, "breakfast_table")
    imported = replace(flat.asset_of(name), credit=Credit("A. Maker", "CC0-1.0", "table.obj"))
    edit = SceneEditor(replace(flat, assets={**flat.assets, imported.asset_id: imported}))
    category, _, model = imported.asset_id.partition("-")
    added = sampler(edit).add(category, model, None, "living_room_0")
    scene = edit.freeze("task-scene")
    assert scene.asset_of(added) is scene.asset_of(name) is imported


def test_floor_object_is_in_its_room_and_reachable(flat: Scene) -> None:
    edit = SceneEditor(flat)
    name = sampler(edit).add("bucket", None, None, "living_room_0")
    scene = edit.freeze("task-scene")
    assert scene.by_name[name].room == "living_room_0"
    assert box_of(scene, scene.by_name[name]).low_m[2] == pytest.approx(0.0, abs=0.005)
    assert len(ReachableFloor(flat).spots(box_of(scene, scene.by_name[name]))) > 0
    assert check_scene(scene) == ()


def test_next_to_means_on_the_same_surface(flat: Scene) -> None:
    edit = SceneEditor(flat)
    table = a_host(flat, "breakfast_table")
    first = sampler(edit).add("bowl", None, Relation.ONTOP, table)
    second = sampler(edit).add("apple", None, Relation.NEXTTO, first)
    assert edit.objects[second].host == table
    assert check_scene(edit.freeze("task-scene")) == ()


def test_base_scene_is_unchanged_and_used_assets_are_included(flat: Scene) -> None:
    before = flat.objects
    edit = SceneEditor(flat)
    name = sampler(edit).add("apple", None, Relation.ONTOP, a_host(flat, "breakfast_table"))
    scene = edit.freeze("task-scene")
    assert flat.objects == before
    assert scene.scene_id == "task-scene"
    assert scene.base == flat.base
    assert set(scene.assets) == {item.asset_id for item in (*scene.objects, *scene.background)}
    assert scene.by_name[name].asset_id in scene.assets


def test_equal_seeds_give_equal_poses(flat: Scene) -> None:
    def pose(seed: int) -> object:
        edit = SceneEditor(flat)
        return edit.objects[
            sampler(edit, seed).add("apple", None, Relation.ONTOP, a_host(flat, "breakfast_table"))
        ].pose_world_asset

    assert pose(5) == pose(5)
    assert pose(5) != pose(6)


def test_states_and_joints_are_set_by_name(flat: Scene) -> None:
    edit = SceneEditor(flat)
    fridge = a_host(flat, "fridge")
    edit.set_states(fridge, frozenset({State.DUSTY}))
    edit.set_joints(fridge, (1.0,) * len(edit.objects[fridge].joints))
    item = edit.freeze("task-scene").by_name[fridge]
    assert item.states == {State.DUSTY}
    assert set(item.joints) == {1.0}
    with pytest.raises(ValueError, match="between 0 and 1"):
        edit.set_joints(fridge, (2.0,) * len(item.joints))


@pytest.mark.parametrize(
    ("category", "relation", "host", "reason"),
    [
        ("apple", Relation.ONTOP, "throne_1", LayoutReason.UNKNOWN_HOST),
        ("apple", None, "ballroom_0", LayoutReason.UNKNOWN_HOST),
        ("aple", Relation.ONTOP, "bed_1", LayoutReason.UNKNOWN_MODEL),
        ("sofa", Relation.INSIDE, "fridge_1", LayoutReason.TOO_LARGE),
    ],
)
def test_unplaceable_object_raises_with_its_reason(
    flat: Scene, category: str, relation: Relation | None, host: str, reason: LayoutReason
) -> None:
    with pytest.raises(PlacementError) as caught:
        sampler(SceneEditor(flat)).add(category, None, relation, host)
    assert caught.value.reason is reason


def test_full_shelf_raises_no_free_spot(flat: Scene) -> None:
    edit = SceneEditor(flat)

    def fill() -> None:
        for _ in range(9):
            sampler(edit).add("tray", "txcjux", Relation.ONTOP, a_host(flat, "breakfast_table"))

    with pytest.raises(PlacementError) as caught:
        fill()
    assert caught.value.reason in (LayoutReason.NO_FREE_SPOT, LayoutReason.OUT_OF_REACH)
