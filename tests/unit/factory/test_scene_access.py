"""Furniture that the robot can't use is removed with its contents and reported."""

from __future__ import annotations

from dataclasses import replace

from embomatrix.factory.assets.library import build_asset
from embomatrix.factory.scenes.access import unserved, with_all_served
from embomatrix.factory.scenes.floor import ReachableFloor
from embomatrix.factory.scenes.report import unaccounted
from embomatrix.world.catalog import Catalog
from embomatrix.world.geometry import Pose
from embomatrix.world.scene import RobotStart, Room, Scene, SceneObject

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
    scene = narrow_room_with(("pedestal_table", 0.5), ("straight_chair", 1.6))
    assert [item.name for item, _ in unserved(scene, ReachableFloor(scene))] == ["pedestal_table_1"]
    left = with_all_served(scene)
    assert [item.name for item in left.objects] == ["pedestal_table_1"]
    assert [note for note in left.left_out if "where one gets at" in note] == [
        f"1 {scene.by_name['straight_chair_1'].asset_id} in corridor_0: it stood where one gets at pedestal_table_1"
    ]
    assert not list(unserved(left, ReachableFloor(left)))


def narrow_room_with(*furniture: tuple[str, float]) -> Scene:
    """Return a corridor 1.1 m wide with furniture in its middle, given by category and distance from its end."""
    catalog = Catalog.load()
    room = Room("corridor_0", "corridor", (0.0, 0.0), (1.1, 5.0))
    objects, assets = [], {}
    for category, y in furniture:
        asset = build_asset(catalog, category, catalog.models_of(category)[0].model_id)
        assets[asset.asset_id] = asset
        pose = Pose((0.55, y, asset.size_m[2] / 2))
        objects.append(SceneObject(f"{category}_1", asset.asset_id, room.name, pose, fixed=True))
    robot = RobotStart(0.55, 4.0, 0.0, room.name)
    return Scene("narrow", "narrow", 0, (room,), (), (), tuple(objects), assets, robot)
