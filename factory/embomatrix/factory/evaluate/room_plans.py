"""Simplified rooms for the aesthetics score: furniture as boxes on a rectangle, and small objects on the furniture."""

import gzip
import math
import re
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from embomatrix.factory.metrics.figures import EvaluationError
from embomatrix.world.json_text import parse_json
from embomatrix.world.scene import Scene

FLOOR: Final = "floor"
MAX_CHARS: Final = 64 * 1024 * 1024
"""Characters of a table of rooms; that of iTHOR and RoboTHOR has 0.7 million."""
DAMAGE: Final = (
    OSError, EOFError, zlib.error, ValueError, TypeError, LookupError, AttributeError, OverflowError,
)  # fmt: skip
"""Errors of reading a damaged table."""
MIN_PIECE_M: Final = 0.25
"""Least horizontal extent of furniture among objects on the floor."""
STANDS_M: Final = 0.2
"""Greatest height of the underside of objects on the floor, for sources that name no host: RoboTHOR's furniture."""
_PARTS: Final = frozenset(
    {"floor", "drawer", "cabinet", "shelf", "stove_burner", "stove_knob", "faucet", "sink_basin", "bathtub_basin", "blinds",
     "curtains", "window", "light_switch", "painting", "mirror", "poster", "shower_door", "shower_glass", "shower_curtain",
     "shower_head", "towel_holder", "hand_towel_holder", "toilet_paper_hanger", "room_decor", "sink"}
)  # fmt: skip
"""Kinds that iTHOR lists besides furniture: parts of it, and objects on walls."""
_ALIASES: Final[Mapping[str, str]] = {
    "breakfast_table": "dining_table", "conference_table": "dining_table", "gaming_table": "dining_table",
    "countertop": "counter_top", "bottom_cabinet": "dresser", "bottom_cabinet_no_top": "counter_top",
    "console_table": "side_table", "nightstand": "side_table", "pedestal_table": "side_table", "straight_chair": "chair",
    "swivel_chair": "chair", "armchair": "arm_chair", "shelf": "shelving_unit", "bookcase": "shelving_unit",
    "standing_tv": "television", "trash_can": "garbage_can", "hardback": "book",
    "paperback_book": "book", "comic_book": "book", "notebook": "book", "teacup": "cup",
    "water_glass": "cup", "tablefork": "fork", "table_knife": "butter_knife", "tablespoon": "spoon", "frying_pan": "pan",
    "saucepan": "pot", "bar_soap": "soap_bar", "beefsteak_tomato": "tomato",
    "pillar_candle": "candle", "bottle_of_wine": "wine_bottle", "sponge": "dish_sponge",
    "box_of_tissues": "tissue_box", "table_lamp": "desk_lamp", "pot_plant": "house_plant",
}  # fmt: skip
"""iTHOR's kind for categories of the catalog."""


@dataclass(frozen=True, slots=True)
class RoomBox:
    """Box of an object. ``half_m`` are half extents in its own frame, ``tilt_rad`` its angle to the room's axes, in ±π/4.

    ``host`` is the kind of its support; `FLOOR` for furniture.
    """

    kind: str
    center_m: tuple[float, float]
    half_m: tuple[float, float]
    tilt_rad: float
    low_m: float
    high_m: float
    host: str

    @property
    def reach_m(self) -> tuple[float, float]:
        """Half extents of the box's projection on the room's axes."""
        c, s = abs(math.cos(self.tilt_rad)), abs(math.sin(self.tilt_rad))
        return self.half_m[0] * c + self.half_m[1] * s, self.half_m[0] * s + self.half_m[1] * c


@dataclass(frozen=True, slots=True)
class RoomPlan:
    """Room with ``pieces`` on the floor and small objects (``things``) on or in them.

    ``carried`` is the index of the piece below each small object, -1 for none.
    """

    name: str
    low_m: tuple[float, float]
    high_m: tuple[float, float]
    pieces: tuple[RoomBox, ...]
    things: tuple[RoomBox, ...]
    carried: tuple[int, ...]


def kind_of(category: str) -> str:
    """Return iTHOR's kind for a category in lower case; the category itself if iTHOR has none."""
    return _ALIASES.get(category, category)


def plan_of(scene: Scene, room_name: str) -> RoomPlan:
    """Return one room of a scene. Raises KeyError for an unknown room."""
    room = {item.name: item for item in scene.rooms}[room_name]
    pieces: list[RoomBox] = []
    things: list[tuple[RoomBox, str]] = []
    number: dict[str, int] = {}
    for item in scene.objects:
        if item.room != room_name:
            continue
        asset, pose = scene.asset_of(item.name), item.pose_world_asset
        x, y, z = pose.position_m
        half = (asset.size_m[0] / 2, asset.size_m[1] / 2)
        turned, tilt = _quarter(pose.yaw)
        half = half[::-1] if turned else half
        box = (z - asset.size_m[2] / 2, z + asset.size_m[2] / 2)
        on_rug = item.host in scene.by_name and scene.asset_of(item.host).category == "carpet"
        if item.host in scene.by_name and not on_rug:
            host = kind_of(scene.asset_of(item.host).category)
            things.append((RoomBox(kind_of(asset.category), (x, y), half, tilt, *box, host), item.host))
        elif item.fixed and 2 * max(half) >= MIN_PIECE_M and box[0] < 0.1:
            number[item.name] = len(pieces)
            pieces.append(RoomBox(kind_of(asset.category), (x, y), half, tilt, *box, FLOOR))
    return RoomPlan(
        room_name,
        (room.low_m[0], room.low_m[1]),
        (room.high_m[0], room.high_m[1]),
        tuple(pieces),
        tuple(item for item, _ in things),
        tuple(number.get(host, -1) for _, host in things),
    )


def read_rooms(path: Path) -> list[RoomPlan]:
    """Read the hand-made rooms of iTHOR and RoboTHOR from the table described in `docs/tasks.md`. Raises EvaluationError."""
    try:
        with gzip.open(path, "rt", encoding="utf-8") as file:
            value = parse_json(file.read(MAX_CHARS + 1))
        return [_room_from(room, number) for number, room in enumerate(value["rooms"])]
    except DAMAGE as error:
        raise EvaluationError(
            f"{path} is not a table of hand-made rooms ({error}): expected gzipped JSON with 'rooms' and their 'objects'"
        ) from error


def _room_from(value: Mapping[str, Any], number: int) -> RoomPlan:
    """Convert a room. The source's x and z axes span the floor; the rectangle is the box around all objects."""
    rows = [(_snake(row[0]), *row[2:]) for row in value["objects"] if row[0] != "Floor"]
    boxes = np.array([[row[3][0], row[3][2], row[4][0], row[4][2]] for row in rows])  # (n, 4)
    low, high = boxes[:, :2] - boxes[:, 2:] / 2, boxes[:, :2] + boxes[:, 2:] / 2  # (n, 2) each
    pieces, things = [], []
    for row in rows:
        kind, _, yaw_deg, center, size, hosts, *_ = row
        box = (center[1] - size[1] / 2, center[1] + size[1] / 2)
        if kind in _PARTS or (not hosts and box[0] > STANDS_M):
            continue
        host = _snake(hosts[0]) if hosts else FLOOR
        tilt = _quarter(math.radians(yaw_deg))[1]
        half = (size[0] / 2, size[2] / 2)
        item = RoomBox(kind, (center[0], center[2]), half, tilt, *box, host)
        if host != FLOOR:
            things.append(replace(item, tilt_rad=0.0))
        elif 2 * max(half) >= MIN_PIECE_M:
            # The source's boxes lie along the axes, so furniture that is off by a degree still has a straight box.
            pieces.append(item)
    low_m, high_m = low.min(axis=0), high.max(axis=0)
    return RoomPlan(
        f"{value['kind']}-{number}",
        (float(low_m[0]), float(low_m[1])),
        (float(high_m[0]), float(high_m[1])),
        tuple(pieces),
        tuple(things),
        tuple(_bearer(item, pieces) for item in things),
    )


def _bearer(thing: RoomBox, pieces: Sequence[RoomBox]) -> int:
    """Return the index of the piece of the host's kind below the object, -1 if there is none."""
    for index, piece in enumerate(pieces):
        inside = all(
            abs(a - b) <= reach + 0.05
            for a, b, reach in zip(thing.center_m, piece.center_m, piece.reach_m, strict=True)
        )
        if piece.kind == thing.host and inside:
            return index
    return -1


def _quarter(yaw_rad: float) -> tuple[bool, float]:
    """Return True if the yaw is nearest to an odd quarter turn, and the remaining angle in ±π/4."""
    turns = round(yaw_rad / (math.pi / 2))
    return bool(turns % 2), yaw_rad - turns * math.pi / 2


def _snake(name: str) -> str:
    return re.sub(r"(?<=[a-z])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", "_", name).lower()
