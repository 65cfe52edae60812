"""Background of homes: enough objects, free surfaces, nothing overlapping, equal seeds."""

from __future__ import annotations

from collections import Counter, defaultdict
from dataclasses import replace

import numpy as np
import pytest

from embomatrix.factory.clutter.background import with_background, without_covered
from embomatrix.factory.clutter.shares import all_shares, host_weight, wanted
from embomatrix.factory.clutter.space import TakenSpace
from embomatrix.factory.clutter.supports import FILLED, surfaces_of
from embomatrix.factory.clutter.tables import shares_of
from embomatrix.factory.evaluate.rooms import objects_by_room
from embomatrix.factory.scenes.check import ProblemKind, check_scene
from embomatrix.factory.scenes.editor import SceneEditor
from embomatrix.world.geometry import Pose
from embomatrix.world.scene import BackgroundObject, Scene


@pytest.fixture(scope="module")
def bare(flat) -> Scene:
    return replace(flat, background=())


def test_equal_scenes_get_equal_backgrounds_and_another_seed_another_one(bare) -> None:
    assert with_background(bare) == with_background(bare)
    assert with_background(replace(bare, seed=1)).background != with_background(bare).background


def test_rooms_of_a_home_hold_about_as_many_objects_as_real_ones(flat, bare) -> None:
    before, after = objects_by_room(bare), objects_by_room(flat)
    assert before["bedroom_0"] < 10
    assert after["bedroom_0"] >= 30
    assert after["living_room_0"] >= 35
    assert after["living_room_0"] <= all_shares()["living_room"].quartiles[2]


def test_background_breaks_no_rule_of_a_scene(flat) -> None:
    assert check_scene(flat) == ()


def test_check_finds_a_background_object_in_the_furniture_and_one_in_the_air(flat) -> None:
    table = flat.by_name["coffee_table_1"]
    asset_id = flat.background[0].asset_id
    x, y, _ = table.pose_world_asset.position_m
    inside = BackgroundObject(asset_id, table.room, Pose((x, y, flat.box_of(table.name).high_m[2])))
    floating = BackgroundObject(asset_id, table.room, Pose((x, y, 1.2)), "coffee_table_1")
    found = check_scene(replace(flat, background=(inside, floating)))
    kinds = {problem.kind for problem in found if problem.names[0] == f"background {asset_id}"}
    assert kinds == {ProblemKind.PENETRATION, ProblemKind.FLOATING}


def test_most_of_every_surface_stays_free(flat, bare) -> None:
    covered: defaultdict[str, float] = defaultdict(float)
    for item in flat.background:
        width, depth, _ = flat.assets[item.asset_id].size_m
        upright = abs(item.pose_world_asset.rotation[2, 2]) > 0.9
        if item.host and upright:
            covered[item.host] += width * depth
    assert covered
    for name, area_m2 in covered.items():
        surfaces = flat.asset_of(name).open_supports
        total_m2 = sum(surface.size_m[0] * surface.size_m[1] for surface in surfaces)
        assert area_m2 <= FILLED * total_m2, name
    assert all(
        s.budget_m2 <= FILLED * s.size_m[0] * s.size_m[1]
        for s in surfaces_of(bare, "kitchen_0", np.random.default_rng(0))
    )


def test_background_keeps_clear_of_doors_on_their_way_and_of_small_objects(flat, bare) -> None:
    taken = TakenSpace.of_scene(bare)
    assert flat.background
    assert all(taken.is_free(box) for box in flat.background_boxes)


def test_shops_and_schools_get_no_background(flat) -> None:
    rooms = tuple(replace(room, type="classroom") for room in flat.rooms)
    school = replace(flat, rooms=rooms, background=())
    assert with_background(school) is school


def test_removed_furniture_takes_its_background_along(flat) -> None:
    host = Counter(item.host for item in flat.background if item.host).most_common(1)[0][0]
    editor = SceneEditor(flat)
    editor.remove(host)
    left = editor.freeze("Rs_int-less")
    assert {item.host for item in flat.background} - {item.host for item in left.background} == {host}
    assert all(item.asset_id in left.assets for item in left.background)


def test_background_gives_way_to_a_new_object(flat) -> None:
    editor = SceneEditor(flat)
    item = next(each for each in flat.background if flat.assets[each.asset_id].category == "painting")
    assert editor.is_free(flat.assets[item.asset_id], item.pose_world_asset)
    editor.insert(flat.assets[item.asset_id], item.pose_world_asset, None, "")
    assert item in flat.background
    assert item not in editor.freeze("Rs_int-more").background


def test_objects_on_a_removed_background_shelf_go_with_it(flat) -> None:
    number = next(
        n for n, each in enumerate(flat.background) if flat.assets[each.asset_id].category == "shelf"
    )
    shelf, box = flat.background[number], flat.background_boxes[number]
    on_it = [
        each
        for each, other in zip(flat.background, flat.background_boxes, strict=True)
        if not each.host and other.overlaps(box, 0.003) and each != shelf
    ]
    assert on_it
    left = without_covered(flat, TakenSpace.of([box]))
    assert not {shelf, *on_it} & set(left)
    assert len(left) > len(flat.background) / 2


def test_objects_belong_where_real_rooms_have_them() -> None:
    assert host_weight("pillow", "bed", "bedroom") > 0
    assert host_weight("pillow", "coffee_table", "bedroom") == 0
    assert host_weight("cell_phone", "bed", "bedroom") == 0
    assert host_weight("soap_dispenser", "countertop", "bathroom") > 0
    assert wanted("corridor") == {}
    assert wanted("bathroom")["toilet_paper"] == all_shares()["bathroom"].means["toilet_paper"] == 2.0


def test_shares_count_objects_by_category_and_host() -> None:
    floor = ["Floor", "", [0, 0, 0], 0, [0, 0, 0], [4, 0, 4], [], 1]
    vase = ["Vase", "", [0, 0, 0], 0, [0, 0, 0], [0, 0, 0], ["Shelf"], 1]
    painting = ["Painting", "", [0, 0, 0], 0, [0, 0, 0], [0, 0, 0], [], 1]
    rooms = [
        {"kind": kind, "objects": [floor, *contents]}
        for kind in ("living_rooms", "bedrooms", "bathrooms", "kitchens")
        for contents in ([vase, vase, painting], [painting])
    ]
    found = shares_of(rooms)["bedroom"]
    assert found["rooms"] == 2
    assert found["means"] == {"painting": 1.0, "vase": 1.0}
    assert found["hosts"] == {"vase": {"Shelf": 1.0}}
    assert found["quartiles"][1] == 3.0
