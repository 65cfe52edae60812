"""House files: floor plans that a person writes are laid out as written, and each mistake is named."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from embomatrix.factory.floorplan.house_file import MAX_BYTES, House, HouseFileError, read_house
from embomatrix.factory.floorplan.houses import plan_house
from embomatrix.factory.floorplan.spec import FloorPlanError, RoomSpec
from embomatrix.factory.floorplan.walls import WALL_M
from embomatrix.factory.scenes.build import build_house
from embomatrix.factory.scenes.check import check_scene
from embomatrix.world.catalog import Catalog

EXAMPLE = Path(__file__).parents[3] / "docs" / "examples" / "two_bedroom_flat.toml"
DRAWN = """
scene = "drawn_flat"
doors = [
    {rooms = ["outside", "kitchen_0"], width_m = 1.0},
    {rooms = ["living_room_0", "kitchen_0"]},
    {rooms = ["living_room_0", "bedroom_0"], width_m = 1.2},
]
[rooms.living_room_0]
rect_m = [0, 0, 5.5, 5]
windows = 2
furniture = {sofa = 1, coffee_table = 1}
[rooms.kitchen_0]
rect_m = [5.5, 0, 9, 3]
height_m = 2.8
furniture = {fridge-xyejdx = 1, breakfast_table = 1, straight_chair = 2}
[rooms.bedroom_0]
rect_m = [5.5, 3, 9.5, 7]
furniture = {}
"""


def read(tmp_path: Path, text: str) -> House:
    path = tmp_path / "flat.toml"
    path.write_text(text, encoding="utf-8")
    return read_house(path)


def specs(house: House) -> list[RoomSpec]:
    return [RoomSpec(room.name, room.type, room.floor_m) for room in house.rooms]


def test_rooms_with_rectangles_stand_where_they_are_drawn(tmp_path: Path) -> None:
    scene = build_house(read(tmp_path, DRAWN), seed=4)
    half = WALL_M / 2
    floors = {room.name: (*room.low_m, *room.high_m) for room in scene.rooms}
    assert floors["kitchen_0"] == pytest.approx((5.5 + half, half, 9 - half, 3 - half))
    assert floors["bedroom_0"] == pytest.approx((5.5 + half, 3 + half, 9.5 - half, 7 - half))
    assert {room.name: room.height_m for room in scene.rooms}["kitchen_0"] == 2.8
    assert {door.rooms: round(door.width_m, 3) for door in scene.doorways} == {
        ("living_room_0", "kitchen_0"): pytest.approx(1.48),  # an open plan: as wide as the wall allows
        ("living_room_0", "bedroom_0"): 1.2,
        ("kitchen_0", ""): 1.0,
    }
    assert scene.doorways[-1].rooms == ("kitchen_0", "")
    assert len(scene.windows) == 2


def test_rooms_hold_what_is_wished_and_an_empty_wish_leaves_them_empty(tmp_path: Path) -> None:
    scene = build_house(read(tmp_path, DRAWN), background=False)
    held = {(item.room, scene.assets[item.asset_id].category) for item in scene.objects}
    assert held == {
        ("living_room_0", "sofa"),
        ("living_room_0", "coffee_table"),
        ("kitchen_0", "fridge"),
        ("kitchen_0", "breakfast_table"),
        ("kitchen_0", "straight_chair"),
    }
    assert "fridge-xyejdx" in scene.assets
    assert sum(item.name.startswith("straight_chair") for item in scene.objects) == 2
    assert not check_scene(scene)


def test_room_without_wishes_is_furnished_like_one_of_the_catalog(tmp_path: Path) -> None:
    text = DRAWN.replace("furniture = {}", "")
    scene = build_house(read(tmp_path, text), background=False)
    placed = {item.asset_id for item in scene.objects if item.room == "bedroom_0"}
    catalog = Catalog.load()
    bedrooms = [
        {f"{category}-{model}" for category, model, _ in room.items}
        for name in catalog.scene_ids
        for room in catalog.inventory(name).rooms
        if room.type == "bedroom"
    ]
    assert placed
    assert any(placed <= listed for listed in bedrooms)


@pytest.mark.parametrize("seed", [0, 1])
def test_packed_house_has_the_written_doors_and_no_others(seed: int) -> None:
    house = read_house(EXAMPLE)
    scene = build_house(house, seed=seed)
    assert {frozenset(door.rooms) for door in scene.doorways} == {
        frozenset(door.rooms) for door in house.doors
    }
    sizes = {room.name: sorted(round(side, 6) for side in room.size_m) for room in scene.rooms}
    assert sizes == {room.name: sorted(room.floor_m) for room in house.rooms}
    assert not check_scene(scene)


def test_equal_seeds_give_equal_houses_and_another_seed_another() -> None:
    house = read_house(EXAMPLE)
    assert build_house(house, seed=3) == build_house(house, seed=3)
    assert build_house(house, seed=3).objects != build_house(house, seed=4).objects


def test_house_without_doors_gets_those_that_join_its_rooms(tmp_path: Path) -> None:
    house = read(
        tmp_path, 'scene = "s"\n[rooms.kitchen_0]\nsize_m = [3, 3]\n[rooms.living_room_0]\nsize_m = [4, 4]\n'
    )
    plan = plan_house(house, specs(house), np.random.default_rng(0))
    assert {frozenset(door.rooms) for door in plan.doorways} >= {frozenset(("kitchen_0", "living_room_0"))}


def test_doors_that_no_arrangement_allows_are_reported() -> None:
    house = read_house(EXAMPLE)
    names = [room.name for room in house.rooms]
    pairs = [(a, b) for at, a in enumerate(names) for b in names[at + 1 :]]
    everywhere = replace(house, doors=tuple(replace(house.doors[0], rooms=pair) for pair in pairs))
    with pytest.raises(FloorPlanError, match=r"no arrangement of the 6 rooms .*rect_m"):
        plan_house(everywhere, specs(house), np.random.default_rng(0))


def test_front_door_without_an_outer_wall_is_reported(tmp_path: Path) -> None:
    around = [(0, 0, 9, 3), (0, 6, 9, 9), (0, 3, 3, 6), (6, 3, 9, 6)]
    rooms = [f"[rooms.bedroom_{n}]\nrect_m = {list(rect)}\n" for n, rect in enumerate(around)]
    doors = [f'{{rooms = ["corridor_0", "bedroom_{n}"]}}' for n in range(4)]
    text = f'scene = "ring"\ndoors = [{{rooms = ["corridor_0", "outside"]}}, {", ".join(doors)}]\n'
    house = read(tmp_path, f"{text}[rooms.corridor_0]\nrect_m = [3, 3, 6, 6]\n{''.join(rooms)}")
    with pytest.raises(FloorPlanError, match="'corridor_0' has no outer wall"):
        plan_house(house, specs(house), np.random.default_rng(0))


MISTAKES = [
    ("windows = 2", "windows = 'two'", "rooms.living_room_0.windows: found 'two': expected a whole number"),
    ("windows = 2", "window = 2", "rooms.living_room_0: found the key 'window': expected only size_m, rect_m"),
    ("windows = 2", "windows =", "is not TOML"),
    ("windows = 2", "size_m = [3, 3]", "rooms.living_room_0: found both size_m and rect_m"),
    ("rect_m = [5.5, 0, 9, 3]", "", "rooms.kitchen_0: found neither size_m nor rect_m"),
    ("[5.5, 0, 9, 3]", "[5.4, 0, 9, 3]", "rooms.kitchen_0.rect_m: found an overlap with living_room_0"),
    ("[5.5, 0, 9, 3]", "[5.6, 0, 9, 3]", "rooms.kitchen_0.rect_m: found a gap of 0.10 m to living_room_0"),
    ("[5.5, 0, 9, 3]", "[9, 0, 5.5, 3]", "rooms.kitchen_0.rect_m: found [9.0, 0.0, 5.5, 3.0], a floor of -3.62"),
    ("[5.5, 0, 9, 3]", "[5.5, 0, 9, nan]", "rooms.kitchen_0.rect_m[3]: found nan"),
    ("rect_m = [5.5, 0, 9, 3]", "size_m = [3, 3]", "rooms.kitchen_0: found size_m beside rooms with rect_m"),
    ("rect_m = [5.5, 0, 9, 3]", "rect_m = 1979-05-27", "rooms.kitchen_0.rect_m: found datetime.date"),
    ("[rooms.kitchen_0]", "[rooms.kitchn_0]", "a room type and a number, such as kitchen_0; did you mean kitchen?"),
    ("[rooms.kitchen_0]", "[rooms.kitchen]", "a room type and a number, such as kitchen_0; write kitchen_0"),
    ("rect_m = [5.5, 0, 9, 3]", "size_m = '3 x 3'", "rooms.kitchen_0.size_m: found '3 x 3': expected a list"),
    ('scene = "drawn_flat"', 'goal = ""', "this file is a task, for `embomatrix factory try`"),
    ("[rooms.kitchen_0]", '[rooms."kitchen_٣"]', "expected a room type and a number"),
    ("[rooms.kitchen_0]", "[rooms.kitchen_0.rooms]", "rooms.kitchen_0: found the key 'rooms'"),
    ('scene = "drawn_flat"', "", "found no key 'scene'"),
    ("drawn_flat", "Rs_int", "scene: found 'Rs_int', a base scene of the catalog"),
    ("drawn_flat", "../flat", "scene: found '../flat': expected a name of up to 40 letters"),
    ("drawn_flat", "drawn-flat", "scene: found 'drawn-flat'"),
    ("breakfast_table", "brekfast_table", "rooms.kitchen_0.furniture: unknown category 'brekfast_table'"),
    ("fridge-xyejdx", "fridge-xyejdy", "rooms.kitchen_0.furniture: unknown model of fridge 'xyejdy'"),
    ("sofa = 1", "sofa = 0", "rooms.living_room_0.furniture.sofa: found 0"),
    ('"bedroom_0"]', '"bedroom_1"]', "doors[2].rooms: found 'bedroom_1': expected 'outside' or a room"),
    ('"bedroom_0"]', '"living_room_0"]', "doors[2].rooms: found 'living_room_0' twice"),
    ('"bedroom_0"]', '"kitchen_0"]', "doors[2].rooms: found a second door between the same rooms"),
    ('"bedroom_0"]', '"outside"]', "doors: found several doors to 'outside'"),
    ("width_m = 1.2", "width_m = 2.0", "doors[2].rooms: found 1.88 m of wall between living_room_0 and bedroom_0"),
    ("width_m = 1.2", "width_m = 0.5", "doors[2].width_m: found 0.5: expected a number >= 0.8"),
    ('    {rooms = ["living_room_0", "bedroom_0"], width_m = 1.2},\n', "", "no way from living_room_0 to bedroom_0"),
    ("doors = [", "door = [", "found the key 'door': expected only scene, rooms, doors"),
]  # fmt: skip


@pytest.mark.parametrize(("part", "wrong", "words"), MISTAKES, ids=[wrong for _, wrong, _ in MISTAKES])
def test_mistake_is_named_with_file_key_and_expectation(
    tmp_path: Path, part: str, wrong: str, words: str
) -> None:
    assert part in DRAWN
    with pytest.raises(HouseFileError) as caught:
        read(tmp_path, DRAWN.replace(part, wrong))
    assert words in str(caught.value)
    assert str(caught.value).startswith(str(tmp_path / "flat.toml"))


def test_file_that_is_missing_too_large_or_no_text_is_refused(tmp_path: Path) -> None:
    for name, data in (("big.toml", b"#" * (MAX_BYTES + 1)), ("bytes.toml", b"\xff\xfe\x00")):
        (tmp_path / name).write_bytes(data)
    for name in ("big.toml", "bytes.toml", "nothing.toml"):
        with pytest.raises(HouseFileError, match=name):
            read_house(tmp_path / name)


def test_rooms_with_rectangles_need_their_doors(tmp_path: Path) -> None:
    start, end = DRAWN.index("doors = ["), DRAWN.index("]\n[rooms") + 2
    with pytest.raises(HouseFileError, match=r"doors: found none: expected the doors between rooms"):
        read(tmp_path, DRAWN[:start] + DRAWN[end:])
