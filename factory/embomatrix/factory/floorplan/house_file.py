"""House files: floor plans that a person writes, with rooms, doors, windows and wishes for furniture, in TOML."""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final

from msgspec import UNSET, Meta, UnsetType

from embomatrix.factory.floorplan.spec import MIN_DOOR_M
from embomatrix.factory.floorplan.walls import WALL_M, Rect, shared_edge
from embomatrix.factory.toml_files import TomlFileError, check_keys, read_toml, record_of, wrong, wrong_room
from embomatrix.world.bddl import is_room_instance
from embomatrix.world.catalog import Catalog, CatalogError
from embomatrix.world.records import Record, SceneInvalidError

SUFFIX: Final = ".toml"
MAX_BYTES: Final = 1024 * 1024
MAX_HOUSE_ROOMS: Final = 40
LEAST_SIDE_M: Final = 1.0
"""Shortest side of a floor: the robot turns in it, and a doorway fits."""
MOST_SIDE_M: Final = 40.0
MOST_DOOR_M: Final = 4.0
MOST_WINDOWS: Final = 20
MOST_OF_A_KIND: Final = 120
OUTSIDE: Final = "outside"
CORNER_M: Final = 0.1
"""Least length of wall beside a doorway."""
_ROOT: Final = "house"
_NAME: Final = re.compile(r"[A-Za-z0-9_]{1,40}\Z")

Side = Annotated[float, Meta(ge=LEAST_SIDE_M, le=MOST_SIDE_M)]
Place = Annotated[float, Meta(ge=-1000.0, le=1000.0)]


class HouseFileError(ValueError):
    """House file that can't be used. The message names the file, the key, what was found and what was expected."""


@dataclass(frozen=True, slots=True)
class HouseDoor:
    """Door between two rooms; the second one is empty for the door to the outside. ``width_m`` is 0 for the usual width."""

    rooms: tuple[str, str]
    width_m: float

    @property
    def needs_m(self) -> float:
        """Length of wall that the door needs between its two rooms."""
        return max(self.width_m, MIN_DOOR_M) + CORNER_M


@dataclass(frozen=True, slots=True)
class HouseRoom:
    """Room of a house file.

    ``rect`` runs along the centre lines of its walls; it is None for a room that the packing places. ``furniture`` maps
    categories or models to counts; None stands for the furniture of a room of this type in the catalog. ``height_m`` is 0
    for the usual height.
    """

    name: str
    type: str
    floor_m: tuple[float, float]
    rect: Rect | None
    windows: int
    furniture: Mapping[str, int] | None
    height_m: float


@dataclass(frozen=True, slots=True)
class House:
    """Floor plan that a person wrote: the name of its scene, rooms and doors."""

    scene: str
    rooms: tuple[HouseRoom, ...]
    doors: tuple[HouseDoor, ...]

    @property
    def rects(self) -> Mapping[str, Rect]:
        """Rectangles of the rooms that have one: all of them, or none."""
        return {room.name: room.rect for room in self.rooms if room.rect is not None}


class HouseRoomTable(Record):
    size_m: tuple[Side, Side] | UnsetType = UNSET
    rect_m: tuple[Place, Place, Place, Place] | UnsetType = UNSET
    windows: Annotated[int, Meta(ge=0, le=MOST_WINDOWS)] = 0
    height_m: Annotated[float, Meta(ge=2.2, le=7.0)] | UnsetType = UNSET
    furniture: dict[str, Annotated[int, Meta(ge=1, le=MOST_OF_A_KIND)]] | UnsetType = UNSET


class HouseDoorTable(Record):
    rooms: tuple[str, str]
    width_m: Annotated[float, Meta(ge=MIN_DOOR_M, le=MOST_DOOR_M)] | UnsetType = UNSET


class HouseTable(Record):
    scene: str
    rooms: dict[str, HouseRoomTable]
    doors: tuple[HouseDoorTable, ...] = ()


def read_house(path: Path) -> House:
    """Read and check a house file of at most MAX_BYTES. Raises HouseFileError."""
    try:
        value = read_toml(path, at_most=MAX_BYTES, expected="a floor plan")
    except TomlFileError as error:
        raise HouseFileError(str(error)) from error
    try:
        _check_keys(value)
        house = _house(record_of(value, HouseTable, _ROOT))
        _check_places(house)
        _check_doors(house)
    except SceneInvalidError as error:
        raise HouseFileError(f"{path}: {str(error).removeprefix(f'{_ROOT}.')}") from error
    return house


def _check_keys(value: Mapping[str, Any]) -> None:
    """Raise SceneInvalidError for a missing or unknown key. `convert` checks the values."""
    check_keys("", value, HouseTable, needed=("scene", "rooms"))
    rooms, doors = value.get("rooms"), value.get("doors")
    for name, table in rooms.items() if isinstance(rooms, dict) else ():
        check_keys(f"rooms.{name[:60]}", table, HouseRoomTable)
    for number, table in enumerate(doors if isinstance(doors, list) else ()):
        check_keys(f"doors[{number}]", table, HouseDoorTable, needed=("rooms",))


def _house(table: HouseTable) -> House:
    if not _NAME.match(table.scene):
        raise wrong("scene", repr(table.scene[:60]), "a name of up to 40 letters, digits and underscores")
    if table.scene in Catalog.load().scene_ids:
        raise wrong("scene", f"{table.scene!r}, a base scene of the catalog", "a name of its own")
    if not 1 <= len(table.rooms) <= MAX_HOUSE_ROOMS:
        raise wrong(
            "rooms", f"{len(table.rooms)} rooms", f"1 to {MAX_HOUSE_ROOMS} tables [rooms.TYPE_NUMBER]"
        )
    return House(
        table.scene,
        tuple(_room(name, room) for name, room in table.rooms.items()),
        tuple(
            HouseDoor(_ends(number, door), 0.0 if door.width_m is UNSET else door.width_m)
            for number, door in enumerate(table.doors)
        ),
    )


def _room(name: str, table: HouseRoomTable) -> HouseRoom:
    key = f"rooms.{name[:60]}"
    if not (is_room_instance(name) and name.isascii()):
        raise wrong_room(key, name, repr(name[:60]), "a room type and a number, such as kitchen_0")
    if (table.size_m is UNSET) is (table.rect_m is UNSET):
        given = "neither size_m nor rect_m" if table.size_m is UNSET else "both size_m and rect_m"
        raise wrong(key, given, "one of them")
    rect = None if table.rect_m is UNSET else _rect(key, table.rect_m)
    if rect is not None:
        (x0, y0), (x1, y1) = rect.floor
        floor = (x1 - x0, y1 - y0)
    else:
        assert table.size_m is not UNSET
        floor = table.size_m
    furniture = None if table.furniture is UNSET else table.furniture
    for wish in furniture or ():
        _check_wish(f"{key}.furniture", wish)
    return HouseRoom(
        name,
        name.rpartition("_")[0],
        floor,
        rect,
        table.windows,
        furniture,
        0.0 if table.height_m is UNSET else table.height_m,
    )


def _rect(key: str, corners: tuple[float, float, float, float]) -> Rect:
    rect = Rect(*corners)
    sides = (rect.x1 - rect.x0 - WALL_M, rect.y1 - rect.y0 - WALL_M)
    if not all(LEAST_SIDE_M - 1e-9 <= side <= MOST_SIDE_M for side in sides):
        floor = f"a floor of {sides[0]:.2f} x {sides[1]:.2f} m between the walls"
        raise wrong(
            f"{key}.rect_m",
            f"{list(corners)}, {floor}",
            f"[x0, y0, x1, y1] in metres with sides of {LEAST_SIDE_M:g} to {MOST_SIDE_M:g} m",
        )
    return rect


def _check_wish(key: str, wish: str) -> None:
    """Raise SceneInvalidError unless the wish is a category, ``sofa``, or a model, ``sofa-mnfbbh``, of the catalog."""
    catalog = Catalog.load()
    category, _, model = wish.rpartition("-")
    try:
        if category:
            catalog.model(category, model)
        elif not catalog.models_of(wish):
            raise CatalogError(f"the category {wish!r} has no model")
    except CatalogError as error:
        raise SceneInvalidError(key, str(error)) from error


def _ends(number: int, table: HouseDoorTable) -> tuple[str, str]:
    """Return the rooms of a door, the outside as an empty second name."""
    first, second = table.rooms
    if first == second:
        raise wrong(
            f"doors[{number}].rooms", f"{first[:60]!r} twice", f"two rooms, or a room and {OUTSIDE!r}"
        )
    if first == OUTSIDE:
        first, second = second, first
    return first, "" if second == OUTSIDE else second


def _check_places(house: House) -> None:
    """Raise SceneInvalidError if some rooms have a place and others do not, or if two rooms overlap or nearly touch."""
    rects = house.rects
    if rects and len(rects) < len(house.rooms):
        free = next(room.name for room in house.rooms if room.rect is None)
        raise wrong(
            f"rooms.{free}", "size_m beside rooms with rect_m", "rect_m for all rooms, or size_m for all"
        )
    names = list(rects)
    for at, a in enumerate(names):
        for b in names[at + 1 :]:
            gap = _gap(rects[a], rects[b])
            if gap < -1e-6:
                raise wrong(f"rooms.{b}.rect_m", f"an overlap with {a}", "rectangles side by side")
            if 1e-6 < gap < 2 * WALL_M:
                raise wrong(
                    f"rooms.{b}.rect_m",
                    f"a gap of {gap:.2f} m to {a}",
                    f"rooms that share the centre line of a wall, or at least {2 * WALL_M:g} m between them",
                )


def _gap(a: Rect, b: Rect) -> float:
    """Return the distance of two rectangles in metres; negative where they overlap."""
    return max(max(a.x0, b.x0) - min(a.x1, b.x1), max(a.y0, b.y0) - min(a.y1, b.y1))


def _check_doors(house: House) -> None:
    """Raise SceneInvalidError for a door that joins no two rooms, a second one, and rooms that no door leads to."""
    known = [room.name for room in house.rooms]
    seen: set[frozenset[str]] = set()
    for number, door in enumerate(house.doors):
        key = f"doors[{number}].rooms"
        for name in door.rooms:
            if name and name not in known:
                raise wrong(key, repr(name[:60]), f"{OUTSIDE!r} or a room of the file: {', '.join(known)}")
        if not door.rooms[0]:
            raise wrong(key, f"{OUTSIDE!r} twice", "a room")
        if frozenset(door.rooms) in seen:
            raise wrong(key, "a second door between the same rooms", "one door for two rooms")
        seen.add(frozenset(door.rooms))
        _check_wall(key, house.rects, door)
    if sum(not door.rooms[1] for door in house.doors) > 1:
        raise wrong("doors", f"several doors to {OUTSIDE!r}", "one front door")
    inner = [door.rooms for door in house.doors if door.rooms[1]]
    if house.rects and not inner and len(known) > 1:
        raise wrong("doors", "none", "the doors between rooms with rect_m, as tables [[doors]]")
    if inner and (shut := unreached(known, inner)):
        raise wrong("doors", f"no way from {known[0]} to {', '.join(shut)}", "doors that join all rooms")


def _check_wall(key: str, rects: Mapping[str, Rect], door: HouseDoor) -> None:
    a, b = door.rooms
    if not rects or not b:
        return
    edge = shared_edge(rects[a], rects[b])
    if edge is None or edge.length < door.needs_m:
        shared = "no wall" if edge is None else f"{edge.length:.2f} m of wall"
        raise wrong(key, f"{shared} between {a} and {b}", f"at least {door.needs_m:.2f} m for this door")


def unreached(rooms: Sequence[str], doors: Iterable[tuple[str, str]]) -> list[str]:
    """Return the rooms that no way through the doors joins to the first one."""
    pairs = list(doors)
    reached, waiting = {rooms[0]}, [rooms[0]]
    while waiting:
        here = waiting.pop()
        beyond = {b if a == here else a for a, b in pairs if here in (a, b)} - reached
        reached |= beyond
        waiting += beyond
    return [name for name in rooms if name not in reached]
