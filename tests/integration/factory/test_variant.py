"""Scene variants allow every task to start: open doors obstruct nothing."""

import numpy as np
import pytest

from embomatrix.factory.assets.solids import Solids, placed_parts
from embomatrix.factory.furnish.small_objects import BASKETS, belongs, is_left_on
from embomatrix.factory.scenes.build import build_base_scene
from embomatrix.factory.scenes.check import reach_problems
from embomatrix.factory.scenes.floor import ReachableFloor, box_of
from embomatrix.factory.writer.variant import build_variant
from embomatrix.world.scene import Scene


@pytest.fixture(scope="module")
def base() -> Scene:
    return build_base_scene("Rs_int", seed=0)


@pytest.mark.parametrize("seed", [0, 2])
def test_open_doors_obstruct_no_path_and_no_other_door(base: Scene, seed: int) -> None:
    rooms = [room.name for room in base.rooms]
    changed = build_variant(base, rooms, "open", np.random.default_rng(seed)).scene
    ajar = [item.name for item in changed.objects if any(item.joints)]
    assert ajar
    before, after = ({p.names for p in reach_problems(each)} for each in (base, changed))
    assert after <= before
    floor = ReachableFloor(changed)
    for item in changed.objects:
        if not item.fixed and item.name not in base.by_name:
            assert len(floor.spots(box_of(changed, item))) > 0, item.name
    solids = Solids()
    for name in ajar:
        item = changed.by_name[name]
        solids.add(name, placed_parts(changed.asset_of(name), item.pose_world_asset, item.joints))
    for item in changed.objects:
        asset = changed.asset_of(item.name)
        if asset.can("openable") and asset.joints and item.name not in ajar:
            wide = placed_parts(asset, item.pose_world_asset, [1.0] * len(asset.joints))
            assert not solids.overlaps(wide), item.name


def test_small_objects_are_on_usual_hosts() -> None:
    office = build_base_scene("office_cubicles_right", seed=0)
    rooms = [room.name for room in office.rooms if room.type in {"private_office", "bathroom", "break_room"}]
    types = {room.name: room.type for room in office.rooms}
    for seed in range(3):
        variant = build_variant(office, rooms[-3:], "tidy", np.random.default_rng(seed))
        things = [name for name in variant.added if variant.scene.by_name[name].host]
        assert things
        for name in things:
            item = variant.scene.by_name[name]
            category = variant.scene.asset_of(name).category
            assert category in BASKETS or belongs(category, types[item.room]), (name, item.room)


def test_food_is_never_left_on_a_chair() -> None:
    office = build_base_scene("office_bike", seed=0)
    rooms = [room.name for room in office.rooms if room.type == "break_room"]
    found = []
    for seed in range(3):
        scene = (variant := build_variant(office, rooms, "seats", np.random.default_rng(seed))).scene
        hosts = {name: scene.by_name[name].host for name in variant.added}
        found += [
            (scene.asset_of(name).category, scene.asset_of(host).category)
            for name, host in hosts.items()
            if host
        ]
    assert found
    assert [(thing, host) for thing, host in found if not is_left_on(thing, host)] == []


@pytest.mark.parametrize(
    ("category", "host", "left"),
    [
        ("potato", "rocking_chair", False),
        ("teacup", "bar_stool", False),
        ("magazine", "rocking_chair", True),
        ("potato", "breakfast_table", True),
        ("vase", "coffee_maker", False),
    ],
)
def test_objects_lie_on_usual_hosts(category: str, host: str, left: bool) -> None:
    assert is_left_on(category, host) == left


@pytest.mark.parametrize(
    ("category", "room_type", "found"),
    [
        ("saucepan", "private_office", False),
        ("saucepan", "kitchen", True),
        ("mug", "private_office", True),
        ("toilet_paper", "dining_room", False),
        ("chopping_board", "classroom", False),
        ("vase", "corridor", True),
    ],
)
def test_each_room_type_has_its_small_objects(category: str, room_type: str, found: bool) -> None:
    assert belongs(category, room_type) == found
