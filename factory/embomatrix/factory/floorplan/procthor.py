"""Houses of ProcTHOR as house files: rooms, doors, windows and counts of furniture.

A house of ProcTHOR (Deitke et al., ProcTHOR: Large-Scale Embodied AI Using Procedural Generation, 2022) is a JSON object with
``rooms``, whose floors are polygons, ``doors``, ``windows`` and ``objects``. Positions are metres with y up; x and z become our
x and y. Objects are counted and arranged anew, since AI2-THOR's models are not ours.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
from msgspec import Meta

from embomatrix.factory.floorplan.house_file import (
    CORNER_M,
    LEAST_SIDE_M,
    MAX_HOUSE_ROOMS,
    MOST_DOOR_M,
    MOST_WINDOWS,
    OUTSIDE,
    HouseFileError,
)
from embomatrix.factory.floorplan.spec import MIN_DOOR_M
from embomatrix.factory.floorplan.walls import WALL_M, Rect, shared_edge
from embomatrix.world.geometry import Vec2
from embomatrix.world.json_text import parse_json
from embomatrix.world.records import Record, SceneInvalidError, convert
from embomatrix.world.whole_file import read_whole

MARK: Final = b"# A house of ProcTHOR, written by `embomatrix scene import`. Lengths are metres."
"""First line of the house files."""
MAX_BYTES: Final = 16 * 1024 * 1024
MOST_CORNERS: Final = 40
"""Corners of a floor."""
ROOM_TYPES: Final[Mapping[str, str]] = {
    "Kitchen": "kitchen",
    "LivingRoom": "living_room",
    "Bedroom": "bedroom",
    "Bathroom": "bathroom",
}
FURNITURE: Final[Mapping[str, str]] = {
    "ArmChair": "armchair",
    "Bathtub": "bathtub",
    "Bed": "bed",
    "Chair": "straight_chair",
    "ClothesDryer": "clothes_dryer",
    "CoffeeTable": "coffee_table",
    "CounterTop": "bottom_cabinet",
    "Desk": "desk",
    "DiningTable": "breakfast_table",
    "Dresser": "bottom_cabinet",
    "FloorLamp": "floor_lamp",
    "Fridge": "fridge",
    "GarbageCan": "trash_can",
    "HousePlant": "pot_plant",
    "LaundryHamper": "hamper",
    "Microwave": "microwave",
    "Ottoman": "ottoman",
    "Painting": "picture",
    "ShelvingUnit": "shelf",
    "SideTable": "nightstand",
    "Sofa": "sofa",
    "Stool": "bar_stool",
    "Television": "standing_tv",
    "Toilet": "toilet",
    "TVStand": "console_table",
    "WashingMachine": "washer",
}
"""Categories of the catalog by object types of AI2-THOR, for what stands on the floor or hangs. The rest is small."""
SINKS: Final[Mapping[str, str]] = {"Kitchen": "furniture_sink"}
SINK: Final = "pedestal_sink"
"""Category of a sink, by the type of its room and elsewhere."""
_ROUND: Final = 3
"""Digits after the point: millimetres."""


class _Point(Record, forbid_unknown_fields=False):
    x: float
    z: float


class _Room(Record, forbid_unknown_fields=False):
    id: str
    roomType: str  # noqa: N815
    floorPolygon: Annotated[list[_Point], Meta(min_length=4, max_length=MOST_CORNERS)]  # noqa: N815


class _Opening(Record, forbid_unknown_fields=False):
    room0: str = ""
    room1: str = ""


class _Wall(Record, forbid_unknown_fields=False):
    roomId: str = ""  # noqa: N815
    empty: bool = False


class _Object(Record, forbid_unknown_fields=False):
    id: str
    position: _Point
    children: tuple[_Object, ...] = ()


class _House(Record, forbid_unknown_fields=False):
    rooms: Annotated[list[_Room], Meta(min_length=1, max_length=MAX_HOUSE_ROOMS)]
    doors: tuple[_Opening, ...] = ()
    walls: tuple[_Wall, ...] = ()
    windows: tuple[_Opening, ...] = ()
    objects: tuple[_Object, ...] = ()


@dataclass(slots=True)
class _Piece:
    """Rectangle of a room's floor, which becomes a room of the house file."""

    name: str
    room: str
    rect: Rect
    windows: int = 0
    furniture: Counter[str] = field(default_factory=Counter)


def house_file_of(path: Path, scene: str) -> tuple[str, list[str]]:
    """Return a house of ProcTHOR as the text of a house file, and sentences about what was left out.

    Raises HouseFileError for a file that holds no such house, or OSError.
    """
    try:
        value = parse_json(read_whole(path, at_most=MAX_BYTES))
        if not isinstance(value, dict):
            raise ValueError(f"found {type(value).__name__}, expected an object with rooms")
        house = convert(value, _House, "house")
        return _text(house, scene)
    except (ValueError, SceneInvalidError) as error:
        raise HouseFileError(
            f"{path} is no house of ProcTHOR: {str(error).removeprefix('house.')}"
        ) from error


def _text(house: _House, scene: str) -> tuple[str, list[str]]:
    notes: list[str] = []
    pieces = _pieces(house.rooms, notes)
    doors = _doors(house, pieces, notes)
    for window in house.windows:
        own = [piece for piece in pieces if piece.room == (window.room0 or window.room1)]
        if own:
            own[0].windows = min(own[0].windows + 1, MOST_WINDOWS)
    types = {room.id: room.roomType for room in house.rooms}
    _furnish(house.objects, pieces, types, notes)
    lines = [MARK.decode("ascii"), f'scene = "{scene}"', "doors = ["]
    for a, b, width in doors:
        lines.append(f'    {{rooms = ["{a}", "{b}"]{f", width_m = {width:g}" if width else ""}}},')
    lines.append("]")
    for piece in pieces:
        corners = ", ".join(f"{value:g}" for value in piece.rect)
        lines += ["", f"[rooms.{piece.name}]", f"rect_m = [{corners}]"]
        if piece.windows:
            lines.append(f"windows = {piece.windows}")
        wishes = ", ".join(f"{category} = {count}" for category, count in sorted(piece.furniture.items()))
        lines.append(f"furniture = {{{wishes}}}")
    return "\n".join(lines) + "\n", notes


def _pieces(rooms: Sequence[_Room], notes: list[str]) -> list[_Piece]:
    """Return the rectangles of all rooms, the largest of each room first."""
    numbers: Counter[str] = Counter()
    found = []
    for room in rooms:
        kind = ROOM_TYPES.get(room.roomType)
        if kind is None:
            raise ValueError(
                f"the room {room.id[:60]!r} has the type {room.roomType[:60]!r}: expected {', '.join(ROOM_TYPES)}"
            )
        for rect in _rectangles(room):
            sides = (rect.x1 - rect.x0 - WALL_M, rect.y1 - rect.y0 - WALL_M)
            if min(sides) < LEAST_SIDE_M:
                notes.append(
                    f"a part of {room.id} of {sides[0]:.2f} x {sides[1]:.2f} m between the walls: it is too narrow for "
                    "the robot"
                )
                continue
            found.append(_Piece(f"{kind}_{numbers[kind]}", room.id, rect))
            numbers[kind] += 1
    if not found:
        raise ValueError(f"no floor is {LEAST_SIDE_M:g} m wide")
    return found


def _rectangles(room: _Room) -> list[Rect]:
    """Cut a floor into rectangles, the largest first. Raises ValueError for a floor with slanting walls."""
    corners = [(round(point.x, _ROUND), round(point.z, _ROUND)) for point in room.floorPolygon]
    if not all(math.isfinite(value) and abs(value) < 1e3 for corner in corners for value in corner):
        raise ValueError(f"the floor of {room.id[:60]!r} reaches beyond 1,000 m")
    for a, b in itertools.pairwise([*corners, corners[0]]):
        if a[0] != b[0] and a[1] != b[1]:
            raise ValueError(
                f"the floor of {room.id[:60]!r} has a slanting wall from {a} to {b}: expected walls along x and z"
            )
    xs, ys = (sorted({corner[axis] for corner in corners}) for axis in (0, 1))
    left = np.array(
        [
            [_is_inside(((x0 + x1) / 2, (y0 + y1) / 2), corners) for y0, y1 in itertools.pairwise(ys)]
            for x0, x1 in itertools.pairwise(xs)
        ]
    )
    found = []
    while left.any():
        columns, rows = max(_blocks(left), key=lambda block: _area_m2(block, xs, ys))
        left[columns, rows] = False
        found.append(Rect(xs[columns.start], ys[rows.start], xs[columns.stop], ys[rows.stop]))
    return found


def _blocks(left: np.ndarray[Any, np.dtype[np.bool_]]) -> list[tuple[slice, slice]]:
    """Return all blocks of cells that are left."""
    return [
        (slice(i, j), slice(k, m))
        for i, j in itertools.combinations(range(left.shape[0] + 1), 2)
        for k, m in itertools.combinations(range(left.shape[1] + 1), 2)
        if left[i:j, k:m].all()
    ]


def _area_m2(block: tuple[slice, slice], xs: Sequence[float], ys: Sequence[float]) -> float:
    columns, rows = block
    return float((xs[columns.stop] - xs[columns.start]) * (ys[rows.stop] - ys[rows.start]))


def _is_inside(point: Vec2, corners: Sequence[Vec2]) -> bool:
    """True if a point lies in a polygon, by the number of its sides to the right of the point."""
    x, y = point
    crossed = False
    for (ax, ay), (bx, by) in itertools.pairwise([*corners, corners[0]]):
        if (ay > y) != (by > y) and x < ax + (y - ay) / (by - ay) * (bx - ax):
            crossed = not crossed
    return crossed


def _doors(house: _House, pieces: Sequence[_Piece], notes: list[str]) -> list[tuple[str, str, float]]:
    """Return the doors with their widths: 0 for the usual one.

    Pieces of one room, and rooms between which the house has no wall, are joined by wide openings.
    """
    found: list[tuple[str, str, float]] = []
    rooms = {room.id for room in house.rooms}
    fronts = 0
    for door in house.doors:
        here = [piece for piece in pieces if piece.room == door.room0]
        there = [piece for piece in pieces if piece.room == door.room1]
        between = f"the door between {door.room0} and {door.room1}"
        if door.room0 == door.room1 or not {door.room0, door.room1} <= rooms:
            fronts += bool(here or there)
            if (here or there) and fronts == 1:
                found.insert(0, ((here or there)[0].name, OUTSIDE, 0.0))
            continue
        if not (here and there):
            notes.append(f"{between}: one of the rooms was left out")
            continue
        a, b, wall_m = max(_walls(here, there), key=lambda wall: wall[2])
        if wall_m < MIN_DOOR_M + CORNER_M:
            notes.append(f"{between}: {wall_m:.2f} m of wall are left for it")
        elif any({a.name, b.name} == {*other[:2]} for other in found):
            notes.append(f"{between}: they have another")
        else:
            found.append((a.name, b.name, 0.0))
    if fronts > 1:
        notes.append(f"{fronts - 1} more doors to the outside: a scene has one")
    open_rooms = {wall.roomId for wall in house.walls if wall.empty}
    for one, other, wall_m in _walls(pieces, pieces):
        joined = one.room == other.room or {one.room, other.room} <= open_rooms
        known = any({one.name, other.name} == {*door[:2]} for door in found)
        if joined and not known and wall_m >= MIN_DOOR_M + CORNER_M:
            width_m = math.floor(min(MOST_DOOR_M, wall_m - CORNER_M) * 100) / 100
            found.append((one.name, other.name, width_m))
    return found


def _walls(some: Sequence[_Piece], others: Sequence[_Piece]) -> list[tuple[_Piece, _Piece, float]]:
    """Return all pairs of pieces with the length of wall that they share."""
    found = []
    for one, other in itertools.product(some, others):
        edge = shared_edge(one.rect, other.rect) if one is not other else None
        found.append((one, other, edge.length if edge is not None else 0.0))
    return found


def _furnish(
    objects: Sequence[_Object], pieces: Sequence[_Piece], types: Mapping[str, str], notes: list[str]
) -> None:
    """Count the furniture of each piece. An object stands in the piece that its position lies in."""
    unknown: Counter[str] = Counter()
    for item in objects:
        kind = item.id.partition("|")[0]
        piece = next((each for each in pieces if _holds(each.rect, item.position)), None)
        if piece is None:
            unknown[kind] += 1
            continue
        for name in (kind, *(child.id.partition("|")[0] for child in item.children)):
            category = FURNITURE.get(name)
            if name == "Sink":
                category = SINKS.get(types[piece.room], SINK)
            if category is not None:
                piece.furniture[category] += 1
            elif name == kind:
                unknown[name] += 1
    if unknown:
        listed = ", ".join(f"{count} {name}" for name, count in sorted(unknown.items()))
        notes.append(f"objects that are no furniture of the catalog, or outside all rooms: {listed}")


def _holds(rect: Rect, point: _Point) -> bool:
    return rect.x0 <= point.x <= rect.x1 and rect.y0 <= point.z <= rect.y1
