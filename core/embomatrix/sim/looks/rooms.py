"""Floors and walls by the type of a room: tiles in bathrooms, planks in living rooms, grass in gardens."""

from typing import Final

from embomatrix.sim.looks.materials import MATERIALS, Material, MaterialKind, Pattern, Rgb

_WET: Final = frozenset({"bathroom", "hammam", "spa", "sauna", "utility_room", "locker_room", "pool"})
_KITCHENS: Final = frozenset({"kitchen", "break_room", "pantry_room", "bar"})
_LABS: Final = frozenset({"biology_lab", "chemistry_lab", "computer_lab", "infirmary", "classroom"})
_OFFICES: Final = frozenset(
    {"private_office", "shared_office", "meeting_room", "copy_room", "phone_room", "conference_hall"}
)
_CONCRETE: Final = frozenset({"garage", "storage_room", "closet", "staircase", "empty_room"})
_HALLS: Final = frozenset({"grocery_store", "lobby", "hall", "gym", "exercise_room"})
_BEDROOMS: Final = frozenset({"bedroom", "childs_room", "playroom"})

_WALLS: Final[dict[str, Rgb]] = {
    "bathroom": (0.82, 0.89, 0.90),
    "kitchen": (0.93, 0.90, 0.78),
    "bedroom": (0.82, 0.86, 0.91),
    "childs_room": (0.94, 0.86, 0.80),
    "playroom": (0.94, 0.86, 0.80),
    "living_room": (0.92, 0.89, 0.83),
    "dining_room": (0.91, 0.86, 0.78),
    "private_office": (0.84, 0.87, 0.84),
    "meeting_room": (0.84, 0.87, 0.84),
}
CEILING: Final = Material((0.95, 0.95, 0.93), Pattern.PLASTER)
WALL: Final = MATERIALS[MaterialKind.PLASTER]
DOOR_PANEL: Final = Material((0.62, 0.42, 0.26), Pattern.PANEL)
PANE: Final = Material((0.62, 0.78, 0.92), glow=1.0)
"""Window pane: pictures show the sky in it."""


def floor_of(room_type: str) -> Material:
    """Return the material of the floor of a type of room."""
    if room_type == "garden":
        return MATERIALS[MaterialKind.LAWN]
    if room_type in _WET:
        return Material((0.74, 0.80, 0.82), Pattern.TILES, gloss=0.05)
    if room_type in _KITCHENS:
        return Material((0.80, 0.76, 0.70), Pattern.TILES, gloss=0.04)
    if room_type in _LABS:
        return Material((0.70, 0.74, 0.76), Pattern.TILES, gloss=0.04)
    if room_type in _OFFICES:
        return Material((0.52, 0.55, 0.60), Pattern.CARPET)
    if room_type in _BEDROOMS:
        return Material((0.74, 0.66, 0.56), Pattern.PLANKS, gloss=0.02)
    if room_type in _CONCRETE:
        return Material((0.70, 0.68, 0.65), Pattern.STONE)
    if room_type in _HALLS:
        return Material((0.84, 0.82, 0.77), Pattern.TILES, gloss=0.06)
    return Material((0.57, 0.47, 0.39), Pattern.PLANKS, gloss=0.03)  # darker and greyer than furniture


def wall_of(room_type: str) -> Rgb:
    """Return the colour of the walls of a type of room, seen from inside."""
    return _WALLS.get(room_type, WALL.color)
