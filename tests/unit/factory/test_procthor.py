"""Houses of ProcTHOR become house files that build, and what they lose is told."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import pytest

from embomatrix.factory.floorplan.house_file import HouseFileError, read_house
from embomatrix.factory.floorplan.procthor import FURNITURE, SINK, SINKS, house_file_of
from embomatrix.factory.scenes.build import build_house
from embomatrix.factory.scenes.check import check_scene
from embomatrix.world.catalog import Catalog


def floor(*corners: tuple[float, float]) -> list[dict[str, float]]:
    return [{"x": x, "y": 0.0, "z": z} for x, z in corners]


def thing(name: str, x: float, z: float, *children: dict[str, Any]) -> dict[str, Any]:
    return {"id": name, "assetId": "A_1", "position": {"x": x, "y": 0.5, "z": z}, "children": [*children]}


HOUSE: dict[str, Any] = {
    "rooms": [
        {
            "id": "room|1",
            "roomType": "LivingRoom",
            "floorPolygon": floor((0, 0), (0, 6), (4, 6), (4, 4), (7, 4), (7, 0)),
            "ceilings": [],
        },
        {"id": "room|2", "roomType": "Kitchen", "floorPolygon": floor((4, 4), (4, 8), (7, 8), (7, 4))},
        {"id": "room|3", "roomType": "Bedroom", "floorPolygon": floor((0, 6), (0, 10), (4, 10), (4, 6))},
        {"id": "room|4", "roomType": "Bathroom", "floorPolygon": floor((4, 8), (4, 10), (7, 10), (7, 8))},
    ],
    "doors": [
        {"id": "door|1|2", "room0": "room|1", "room1": "room|2", "openness": 1},
        {"id": "door|1|3", "room0": "room|1", "room1": "room|3"},
        {"id": "door|3|4", "room0": "room|3", "room1": "room|4"},
        {"id": "door|1", "room0": "room|1", "room1": "room|1"},
    ],
    "windows": [{"room0": "room|3", "room1": "room|3"}],
    "objects": [
        thing("Sofa|1|0", 1, 3),
        thing("Chair|1|4", 1, 5),
        thing("CounterTop|2|0", 6.5, 6.5, thing("Sink|2|5", 6.5, 6.5), thing("Microwave|2|3", 6.5, 7)),
        thing("Bed|3|0", 1.5, 8.5),
        thing("Sink|4|1", 5, 9.6),
        thing("TeddyBear|3|7", 1, 8),
    ],
    "proceduralParameters": {"skyboxId": "Sky1"},
}


def converted(tmp_path: Path, house: object) -> tuple[Path, list[str]]:
    (tmp_path / "house.json").write_text(json.dumps(house))
    text, notes = house_file_of(tmp_path / "house.json", "procthor_7")
    (tmp_path / "house.toml").write_text(text)
    return tmp_path / "house.toml", notes


def test_rooms_doors_windows_and_furniture_are_those_of_the_house(tmp_path: Path) -> None:
    path, notes = converted(tmp_path, HOUSE)
    house = read_house(path)
    rects = {name: tuple(rect) for name, rect in house.rects.items()}
    assert rects["kitchen_0"] == (4, 4, 7, 8)
    assert (rects["living_room_0"], rects["living_room_1"]) == ((0, 0, 7, 4), (0, 4, 4, 6))
    doors = {door.rooms: door.width_m for door in house.doors}
    assert doors == {
        ("living_room_0", ""): 0.0,
        ("living_room_0", "kitchen_0"): 0.0,
        ("living_room_1", "bedroom_0"): 0.0,  # the part of the living room that has a wall with it
        ("bedroom_0", "bathroom_0"): 0.0,
        ("living_room_0", "living_room_1"): pytest.approx(3.78),
    }
    assert {room.name: room.windows for room in house.rooms}["bedroom_0"] == 1
    wishes = {room.name: dict(room.furniture or {}) for room in house.rooms}
    assert wishes == {
        "living_room_0": {"sofa": 1},
        "living_room_1": {"straight_chair": 1},
        "kitchen_0": {"bottom_cabinet": 1, "furniture_sink": 1, "microwave": 1},
        "bedroom_0": {"bed": 1},
        "bathroom_0": {"pedestal_sink": 1},
    }
    assert notes == ["objects that are no furniture of the catalog, or outside all rooms: 1 TeddyBear"]


def test_the_house_builds_without_a_fault(tmp_path: Path) -> None:
    path, _ = converted(tmp_path, HOUSE)
    scene = build_house(read_house(path), seed=0)
    assert not check_scene(scene)
    assert {"bed_1", "sofa_1", "microwave_1", "pedestal_sink_1"} <= scene.by_name.keys()


def test_all_categories_are_in_the_catalog() -> None:
    catalog = Catalog.load()
    assert all(catalog.models_of(category) for category in (*FURNITURE.values(), *SINKS.values(), SINK))


def test_rooms_without_a_wall_between_them_are_joined_by_a_wide_opening(tmp_path: Path) -> None:
    house = copy.deepcopy(HOUSE)
    del house["doors"][0]
    house["walls"] = [
        {"id": "wall|1", "roomId": "room|1", "empty": True, "polygon": []},
        {"id": "wall|2", "roomId": "room|2", "empty": True},
        {"id": "wall|3", "roomId": "room|3"},
    ]
    path, _ = converted(tmp_path, house)
    doors = {frozenset(door.rooms): door.width_m for door in read_house(path).doors}
    assert doors[frozenset({"living_room_0", "kitchen_0"})] == pytest.approx(2.78)
    assert frozenset({"living_room_1", "kitchen_0"}) in doors
    assert frozenset({"kitchen_0", "bedroom_0"}) not in doors


def test_doors_that_cannot_be_kept_are_told(tmp_path: Path) -> None:
    house = copy.deepcopy(HOUSE)
    house["rooms"][3]["floorPolygon"] = floor((4, 8), (4, 9), (7, 9), (7, 8))
    house["doors"] += [
        {"room0": "room|2", "room1": "room|1"},
        {"room0": "room|3", "room1": "room|3"},
        {"room0": "room|2", "room1": "exterior"},
    ]
    path, notes = converted(tmp_path, house)
    assert read_house(path).doors[0].rooms == ("living_room_0", "")
    assert {
        "the door between room|3 and room|4: one of the rooms was left out",
        "the door between room|2 and room|1: they have another",
        "2 more doors to the outside: a scene has one",
    } <= {*notes}


def test_a_niche_that_is_too_narrow_is_left_out_and_told(tmp_path: Path) -> None:
    house = copy.deepcopy(HOUSE)
    house["rooms"][2]["floorPolygon"] = floor((0, 6), (0, 10), (3, 10), (3, 10.6), (4, 10.6), (4, 6))
    _, notes = converted(tmp_path, house)
    assert "a part of room|3 of 0.88 x 0.48 m between the walls: it is too narrow for the robot" in notes


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda house: house.pop("rooms"), "rooms"),
        (
            lambda house: house["rooms"][0].update(roomType="Garage"),
            "has the type 'Garage': expected Kitchen",
        ),
        (
            lambda house: house["rooms"][1].update(floorPolygon=floor((4, 4), (4, 8), (7, 9), (7, 4))),
            r"slanting wall from \(4.0, 8.0\) to \(7.0, 9.0\)",
        ),
        (lambda house: house["rooms"][1].update(floorPolygon=floor((4, 4), (4, 8), (7, 8))), "floorPolygon"),
        (lambda house: house["rooms"][1]["floorPolygon"][0].update(x=1e9), "reaches beyond"),
        (lambda house: house["objects"][0].update(position=None), "position"),
    ],
)
def test_what_is_no_house_is_named(tmp_path: Path, change: Any, words: str) -> None:
    house = copy.deepcopy(HOUSE)
    change(house)
    with pytest.raises(HouseFileError, match=rf"house\.json is no house of ProcTHOR: .*{words}"):
        converted(tmp_path, house)


@pytest.mark.parametrize("text", [b"", b"[1]", b"\xff", b'{"rooms": 3}'])
def test_other_files_are_named(tmp_path: Path, text: bytes) -> None:
    (tmp_path / "house.json").write_bytes(text)
    with pytest.raises(HouseFileError, match=r"house\.json is no house of ProcTHOR"):
        house_file_of(tmp_path / "house.json", "name")
