"""Furniture of a house file's rooms: models for the wished categories, or the furniture of a similar room of the catalog."""

from collections import Counter
from collections.abc import Iterator
from typing import Final

import numpy as np

from embomatrix.factory.floorplan.house_file import HouseRoom
from embomatrix.world.catalog import Catalog, Model, RoomInventory

SIMILAR: Final = 3
"""Rooms of the catalog, nearest in floor area, of which one furnishes a room without wishes."""
PASSAGE_M: Final = 0.6
"""Floor that a piece of furniture must leave along each side of its room."""
MOST_HEIGHT_M: Final = 2.3


def inventory_of(catalog: Catalog, room: HouseRoom, rng: np.random.Generator) -> RoomInventory:
    """Return what a room is to hold, without doors and windows. Equal generator states give equal inventories."""
    if room.furniture is None:
        items = _similar(catalog, room, rng).items
    else:
        wishes = room.furniture.items()
        items = tuple((*_model_for(catalog, wish, room, rng), count) for wish, count in wishes)
    return RoomInventory(room.name, room.type, room.floor_m, items, (), ())


def _similar(catalog: Catalog, room: HouseRoom, rng: np.random.Generator) -> RoomInventory:
    """Return one of the catalog's rooms of the same type that are nearest in floor area, and not empty."""
    area = room.floor_m[0] * room.floor_m[1]
    rooms = sorted(
        (other for other in _rooms(catalog) if other.type == room.type),
        key=lambda other: (not other.items, abs(other.floor_m[0] * other.floor_m[1] - area)),
    )
    return rooms[int(rng.integers(min(SIMILAR, len(rooms))))]


def _model_for(catalog: Catalog, wish: str, room: HouseRoom, rng: np.random.Generator) -> tuple[str, str]:
    """Return category and model of a wish. A category gets a model that fits the room, if possible one of the inventories."""
    category, _, model_id = wish.rpartition("-")
    if category:
        return category, model_id
    models = [model for model in catalog.models_of(wish) if _fits(model, room)] or [
        min(catalog.models_of(wish), key=lambda model: max(model.size_m))
    ]
    listed = Counter(
        model
        for other in _rooms(catalog)
        for kind, model, _ in other.items
        if kind == wish and other.type == room.type
    )
    usual = [model for model in models if model.model_id in listed] or models
    return wish, usual[int(rng.integers(len(usual)))].model_id


def _fits(model: Model, room: HouseRoom) -> bool:
    """True if the robot can pass the model in this room."""
    short, long = sorted(model.size_m[:2])
    narrow, wide = sorted(side - PASSAGE_M for side in room.floor_m)
    return short <= narrow and long <= wide and model.size_m[2] <= MOST_HEIGHT_M


def _rooms(catalog: Catalog) -> Iterator[RoomInventory]:
    for scene_id in catalog.scene_ids:
        yield from catalog.inventory(scene_id).rooms
