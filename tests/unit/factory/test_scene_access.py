"""Furniture that the robot can't use is removed with its contents and reported."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from embomatrix.factory.scenes.access import unserved, with_all_served
from embomatrix.factory.scenes.build import build_base_scene
from embomatrix.factory.scenes.floor import ReachableFloor
from embomatrix.factory.scenes.report import unaccounted
from embomatrix.world.geometry import Pose

if TYPE_CHECKING:
    from embomatrix.world.scene import Scene

CABINET = "top_cabinet_1"


def turned_to_the_wall(scene: Scene) -> Scene:
    """Return the scene with a cabinet that faces the wall and contains an object of the living room."""
    x, y, z = scene.by_name[CABINET].pose_world_asset.position_m
    changed = {
        CABINET: {
            "pose_world_asset": Pose.from_xyz_yaw(
                x, y, z, scene.by_name[CABINET].pose_world_asset.yaw + 3.14159
            )
        },
        "laptop_1": {"host": CABINET},
    }
    return replace(
        scene, objects=tuple(replace(item, **changed.get(item.name, {})) for item in scene.objects)
    )


def test_furnished_flat_keeps_all_furniture(flat: Scene) -> None:
    assert with_all_served(flat) is flat


def test_cabinet_facing_the_wall_is_removed_with_its_contents(flat: Scene) -> None:
    scene = turned_to_the_wall(flat)
    assert [item.name for item, _ in unserved(scene, ReachableFloor(scene))] == [CABINET]
    left = with_all_served(scene)
    assert {item.name for item in scene.objects} - {item.name for item in left.objects} == {
        CABINET,
        "laptop_1",
    }
    assert [note.split(": ")[1] for note in left.left_out[len(flat.left_out) :]] == [
        "nobody could stand before its front",
        "it lay in a cabinet that nobody could stand before",
    ]
    assert unaccounted(left) == ()
    assert {item.asset_id for item in left.objects} == set(left.assets)


def test_chair_that_blocks_another_table_is_removed() -> None:
    scene = build_base_scene(
        "grocery_store_cafe", seed=1
    )  # four small tables with twelve chairs in one small room
    assert not list(unserved(scene, ReachableFloor(scene)))
    assert [note for note in scene.left_out if "where one gets at" in note] == [
        "1 straight_chair-qnjtxe in dining_room_0: it stood where one gets at pedestal_table_3"
    ]
    assert unaccounted(scene) == ()
