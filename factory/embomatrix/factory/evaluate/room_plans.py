"""Simplified rooms for the aesthetics score: furniture as boxes on a rectangle, and small objects on the furniture."""

import gzip
import math
import re
import zlib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from embomatrix.factory.metrics.figures import EvaluationError
from embomatrix.world.json_text import parse_json
from embomatrix.world.scene import Scene, SceneObject

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
_BUILT_IN: Final = frozenset(
    {"counter_top", "shelf", "cabinet", "sink", "sink_basin", "bathtub_basin", "drawer", "stove_burner", "towel_holder",
     "hand_towel_holder", "toilet_paper_hanger"}
)  # fmt: skip
"""Kinds that hold objects in iTHOR without being furniture on the floor."""
FAMILY: Final = 5
"""RoboTHOR furnishes each of its 15 floor plans five times: five consecutive rooms share their walls."""
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


_SQUARE: Final = 0.2
"""Least cosine of twice a box's angle at which its sides can be told from its extents along the room's axes."""
_THINNEST: Final = 0.2
"""Least side of a turned box, as a share of its extents."""


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
    """Room with ``pieces`` on the floor, hosts that are ``built_in``, and small objects (``things``) on or in both.

    ``carried`` lists for each small object the indices of its hosts in ``bearers``, the direct one first. Only objects at
    the indices ``added_pieces`` and ``added_things`` are scored; the others are the room around them. Rooms of one
    ``family`` have the same walls.
    """

    name: str
    family: str
    low_m: tuple[float, float]
    high_m: tuple[float, float]
    pieces: tuple[RoomBox, ...]
    built_in: tuple[RoomBox, ...]
    things: tuple[RoomBox, ...]
    carried: tuple[tuple[int, ...], ...]
    added_pieces: tuple[int, ...]
    added_things: tuple[int, ...]

    @property
    def bearers(self) -> tuple[RoomBox, ...]:
        return (*self.pieces, *self.built_in)


def kind_of(category: str) -> str:
    """Return iTHOR's kind for a category in lower case; the category itself if iTHOR has none."""
    return _ALIASES.get(category, category)


def plan_of(scene: Scene, room_name: str, added: Collection[str]) -> RoomPlan:
    """Return one room of a scene; ``added`` names the objects that are scored. Raises KeyError for an unknown room."""
    room = {item.name: item for item in scene.rooms}[room_name]
    here = [item for item in scene.objects if item.room == room_name and not item.absent]
    boxes = {item.name: _box_in(scene, item) for item in here}
    hosted = {item.name for item in here if item.host in boxes and not _is_rug(scene, item.host)}
    things = [item.name for item in here if item.name in hosted]
    pieces = [
        item.name
        for item in here
        if item.name not in hosted and _stands(boxes[item.name], wide=item.name not in added)
    ]
    hosts = {item.host for item in here if item.name in hosted}
    built_in = sorted(hosts - set(pieces))
    number = {name: index for index, name in enumerate((*pieces, *built_in))}
    return RoomPlan(
        name=room_name,
        family=scene.scene_id,
        low_m=(room.low_m[0], room.low_m[1]),
        high_m=(room.high_m[0], room.high_m[1]),
        pieces=tuple(boxes[name] for name in pieces),
        built_in=tuple(boxes[name] for name in built_in),
        things=tuple(boxes[name] for name in things),
        carried=tuple(tuple(number[host] for host in _hosts_of(scene, name, boxes)) for name in things),
        added_pieces=tuple(index for index, name in enumerate(pieces) if name in added),
        added_things=tuple(index for index, name in enumerate(things) if name in added),
    )


def _box_in(scene: Scene, item: SceneObject) -> RoomBox:
    asset, pose = scene.asset_of(item.name), item.pose_world_asset
    x, y, z = pose.position_m
    half = (asset.size_m[0] / 2, asset.size_m[1] / 2)
    turned, tilt = _quarter(pose.yaw)
    on_floor = item.host not in scene.by_name or _is_rug(scene, item.host)
    host = FLOOR if on_floor else kind_of(scene.asset_of(item.host).category)
    return RoomBox(
        kind_of(asset.category),
        (x, y),
        half[::-1] if turned else half,
        tilt,
        z - asset.size_m[2] / 2,
        z + asset.size_m[2] / 2,
        host,
    )


def _is_rug(scene: Scene, name: str) -> bool:
    """True for a rug, which is a part of the floor: what stands on it is furniture of the room."""
    return scene.asset_of(name).category == "carpet"


def _stands(box: RoomBox, *, wide: bool) -> bool:
    """True for objects on the floor, with ``wide`` only for those as wide as furniture."""
    return box.low_m < STANDS_M and not (wide and 2 * max(box.half_m) < MIN_PIECE_M)


def _hosts_of(scene: Scene, name: str, boxes: Mapping[str, RoomBox]) -> list[str]:
    """Return an object's hosts in its room, the direct one first: a plate, then the table below it."""
    found: list[str] = []
    host = scene.by_name[name].host
    while host in boxes and host not in found and not _is_rug(scene, host):
        found.append(host)
        host = scene.by_name[host].host
    return found


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
    ends = np.array([[row[3][0], row[3][2], row[4][0], row[4][2]] for row in rows])  # (n, 4)
    low, high = ends[:, :2] - ends[:, 2:] / 2, ends[:, :2] + ends[:, 2:] / 2  # (n, 2) each
    pieces, built_in, things = [], [], []
    for kind, _, yaw_deg, center, size, hosts, *_ in rows:
        host = _snake(hosts[0]) if hosts else FLOOR
        tilt = _quarter(math.radians(yaw_deg))[1]
        box = (center[1] - size[1] / 2, center[1] + size[1] / 2)
        item = RoomBox(kind, (center[0], center[2]), _turned_back(size[0], size[2], tilt), tilt, *box, host)
        if kind in _BUILT_IN and host == FLOOR:
            # Built-in parts lie along the walls; the source gives some of them the yaw of their model.
            built_in.append(replace(item, tilt_rad=0.0, half_m=(size[0] / 2, size[2] / 2)))
        elif kind in _PARTS or (not hosts and box[0] > STANDS_M):
            continue
        elif host != FLOOR:
            things.append(item)
        elif 2 * max(item.half_m) >= MIN_PIECE_M:
            pieces.append(item)
    low_m, high_m = low.min(axis=0), high.max(axis=0)
    kind, index = str(value["kind"]), int(value.get("index", number))
    return RoomPlan(
        name=f"{kind}-{number}",
        family=f"{kind}-{index // FAMILY if kind == 'robothor' else index}",
        low_m=(float(low_m[0]), float(low_m[1])),
        high_m=(float(high_m[0]), float(high_m[1])),
        pieces=tuple(pieces),
        built_in=tuple(built_in),
        things=tuple(things),
        carried=tuple(_bearer(item, [*pieces, *built_in]) for item in things),
        added_pieces=tuple(range(len(pieces))),
        added_things=tuple(range(len(things))),
    )


def _turned_back(width: float, depth: float, tilt_rad: float) -> tuple[float, float]:
    """Return the half extents of a turned box from its extents along the room's axes.

    Near 45° they are undetermined, and the box counts as square.
    """
    c, s = abs(math.cos(tilt_rad)), abs(math.sin(tilt_rad))
    if c * c - s * s < _SQUARE:
        half = (width + depth) / 4 / (c + s)
        return half, half
    least = _THINNEST * min(width, depth) / 2
    halves = ((width * c - depth * s) / (c * c - s * s) / 2, (depth * c - width * s) / (c * c - s * s) / 2)
    return max(halves[0], least), max(halves[1], least)


def _bearer(thing: RoomBox, bearers: Sequence[RoomBox]) -> tuple[int, ...]:
    """Return the index of the host whose top is nearest to the object's underside; empty if there is none."""
    kinds = {thing.host, f"{thing.host}_basin"}
    below = [
        (abs(thing.low_m - bearer.high_m), index)
        for index, bearer in enumerate(bearers)
        if bearer.kind in kinds
        and bearer.low_m < thing.low_m + STANDS_M
        and all(
            abs(a - b) <= reach + 0.05
            for a, b, reach in zip(thing.center_m, bearer.center_m, bearer.reach_m, strict=True)
        )
    ]
    return (min(below)[1],) if below else ()


def _quarter(yaw_rad: float) -> tuple[bool, float]:
    """Return True if the yaw is nearest to an odd quarter turn, and the remaining angle in ±π/4."""
    turns = round(yaw_rad / (math.pi / 2))
    return bool(turns % 2), yaw_rad - turns * math.pi / 2


def _snake(name: str) -> str:
    return re.sub(r"(?<=[a-z])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", "_", name).lower()
