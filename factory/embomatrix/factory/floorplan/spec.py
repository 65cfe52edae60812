"""Input of the floor planner: rooms with their floor sizes, doors and windows, and preferred neighbours by room type."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from embomatrix.world.geometry import Vec2
from embomatrix.world.scene import ROOM_HEIGHT_M

MIN_DOOR_M: Final = 0.8
MAX_DOOR_HEIGHT_M: Final = 2.1
OPEN_PASSAGE_M: Final = 1.8
"""Width of a passage between two rooms of an open plan, if their wall is long enough."""

ENTRANCES: Final = (
    "entryway",
    "lobby",
    "corridor",
    "dining_room",
    "living_room",
    "grocery_store",
    "shared_office",
)
HUBS: Final = (
    "corridor",
    "living_room",
    "lobby",
    "entryway",
    "dining_room",
    "shared_office",
    "grocery_store",
    "empty_room",
)
PARENTS: Final[Mapping[str, tuple[str, ...]]] = {
    "bathroom": ("bedroom", "corridor", "entryway", "living_room", "lobby", "dining_room", "locker_room"),
    "kitchen": ("dining_room", "living_room", "corridor", "bar"),
    "pantry_room": ("kitchen", "corridor"),
    "bar": ("dining_room", "lobby", "living_room"),
    "dining_room": ("living_room", "kitchen", "corridor", "lobby"),
    "closet": ("bedroom", "childs_room", "corridor"),
    "storage_room": ("corridor", "kitchen", "living_room", "utility_room", "dining_room"),
    "utility_room": ("corridor", "kitchen", "living_room", "garage"),
    "bedroom": ("corridor", "living_room", "lobby"),
    "childs_room": ("corridor", "living_room"),
    "private_office": ("corridor", "shared_office", "lobby", "living_room"),
    "meeting_room": ("corridor", "shared_office", "lobby"),
    "copy_room": ("corridor", "shared_office"),
    "phone_room": ("corridor", "shared_office"),
    "break_room": ("corridor", "shared_office", "lobby"),
    "sauna": ("spa", "bathroom", "corridor"),
    "hammam": ("spa", "bathroom", "corridor"),
    "locker_room": ("gym", "spa", "corridor"),
    "entryway": ("living_room", "corridor", "lobby", "dining_room"),
    "living_room": ("corridor", "living_room", "entryway", "dining_room", "lobby"),
    "corridor": ("living_room", "corridor", "lobby", "entryway", "dining_room"),
    "garage": ("corridor", "utility_room", "entryway", "kitchen", "living_room"),
    "garden": ("living_room", "corridor", "dining_room", "kitchen", "entryway"),
}
"""Room types from which rooms of a type are entered, most natural first; any hub for unlisted types."""
PRIVATE: Final = frozenset(
    {
        "bathroom",
        "storage_room",
        "closet",
        "pantry_room",
        "bedroom",
        "childs_room",
        "copy_room",
        "phone_room",
        "sauna",
    }
)
SLEEPING: Final = ("bedroom", "childs_room")
OPEN_PLAN: Final = frozenset(
    {"kitchen", "living_room", "dining_room", "entryway", "corridor", "bar", "lobby"}
)


OUTDOORS: Final = frozenset({"garden"})
"""Outdoor types: windows of the house face them."""


class FloorPlanError(ValueError):
    """The rooms can't be packed into one plan."""


@dataclass(frozen=True, slots=True)
class OpeningSpec:
    """Door or window model of the inventory with its width and height in metres."""

    model: str
    width_m: float
    height_m: float


@dataclass(frozen=True, slots=True)
class RoomSpec:
    """Room of the inventory before it is placed; ``floor_m`` may be turned by a quarter."""

    name: str
    type: str
    floor_m: Vec2
    doors: tuple[OpeningSpec, ...] = ()
    windows: tuple[OpeningSpec, ...] = ()
    height_m: float = ROOM_HEIGHT_M
