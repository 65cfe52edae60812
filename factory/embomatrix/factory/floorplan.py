"""Floor plans: pack a house's true floor rectangles edge to edge and join them by doorways.

Every room is packed as its floor grown by half a wall on each side, so neighbouring floors lie exactly one wall apart. Rooms
attach one by one to a side of a room that is already placed (slot packing); the best of many seeded trials wins.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from embomatrix.factory.floorplan_walls import WALL_M, DoorCut, Rect, build_walls, shared_edge
from embomatrix.world.scene import Doorway, Room, Window

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from embomatrix.world.geometry import Part, Vec2

MIN_DOOR_M: Final = 0.8
MAX_DOOR_HEIGHT_M: Final = 2.1
TRIALS: Final = 80
_OPEN_PASSAGE_M: Final = 1.8

_ENTRANCES: Final = (
    "entryway",
    "lobby",
    "corridor",
    "dining_room",
    "living_room",
    "grocery_store",
    "shared_office",
)
_HUBS: Final = (
    "corridor",
    "living_room",
    "lobby",
    "entryway",
    "dining_room",
    "shared_office",
    "grocery_store",
    "empty_room",
)
_PARENTS: Final[Mapping[str, tuple[str, ...]]] = {
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
_PRIVATE: Final = frozenset(
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
_OPEN_PLAN: Final = frozenset(
    {"kitchen", "living_room", "dining_room", "entryway", "corridor", "bar", "lobby"}
)


class FloorPlanError(ValueError):
    """The rooms can't be packed into one plan."""


@dataclass(frozen=True, slots=True)
class DoorSpec:
    """A door model of the inventory: leaf width and height in metres."""

    model: str
    width_m: float
    height_m: float


@dataclass(frozen=True, slots=True)
class RoomSpec:
    """A room of the inventory before it has a place; ``floor_m`` may be turned by a quarter."""

    name: str
    type: str
    floor_m: Vec2
    doors: tuple[DoorSpec, ...] = ()


@dataclass(frozen=True, slots=True)
class FloorPlan:
    """Rooms, walls and doorways. The last doorway leads outside; it is filled by a closed leaf, part of ``walls``."""

    rooms: tuple[Room, ...]
    walls: tuple[Part, ...]
    doorways: tuple[Doorway, ...]
    windows: tuple[Window, ...] = ()

    @property
    def compactness(self) -> float:
        """Share of the plan's bounding box that is room floor or wall, in (0, 1]."""
        low = np.min([r.low_m for r in self.rooms], axis=0) - WALL_M / 2
        high = np.max([r.high_m for r in self.rooms], axis=0) + WALL_M / 2
        used = sum((r.size_m[0] + WALL_M) * (r.size_m[1] + WALL_M) for r in self.rooms)
        return float(used / np.prod(high - low))


@dataclass(frozen=True, slots=True)
class _Packing:
    rects: Mapping[str, Rect]
    parents: Mapping[str, str]
    score: float


def plan_floor(rooms: Sequence[RoomSpec], rng: np.random.Generator, *, trials: int = TRIALS) -> FloorPlan:
    """Pack the rooms, connect all of them by doorways and raise the walls.

    Deterministic for a given generator state. Raises FloorPlanError when there are no rooms or they can't be joined by doors.
    """
    if not rooms:
        raise FloorPlanError("no rooms to pack: expected at least one")
    packings = [p for p in (_pack(rooms, rng) for _ in range(trials)) if p is not None]
    if not packings:
        raise FloorPlanError(
            f"{len(rooms)} rooms found no joint plan in {trials} trials: every room needs a side of at least {MIN_DOOR_M} m"
        )
    best = min(packings, key=lambda p: p.score)
    low = np.min([r.low for r in best.rects.values()], axis=0)
    rects = {name: rect.moved(-float(low[0]), -float(low[1])) for name, rect in best.rects.items()}
    cuts = _doorways(rooms, rects, best.parents, rng)
    placed = tuple(Room(s.name, s.type, *rects[s.name].floor) for s in rooms)
    return FloorPlan(placed, build_walls(rects, cuts), tuple(c.doorway for c in cuts))


# Packing -------------------------------------------------------------------------------------------------------------


def _pack(rooms: Sequence[RoomSpec], rng: np.random.Generator) -> _Packing | None:
    order = _order(rooms, rng)
    root = order[0]
    w, h = root.floor_m[0] + WALL_M, root.floor_m[1] + WALL_M
    rects = {root.name: Rect(0.0, 0.0, w, h)}
    parents: dict[str, str] = {}
    penalty = 0.0
    by_name = {r.name: r for r in rooms}
    for spec in order[1:]:
        best: tuple[float, Rect, str] | None = None
        for name in rects:
            oddness = 4.0 * _rank(spec.type, by_name[name].type) - 8.0 * _share_a_door(
                spec, by_name[name], rooms
            )
            for score, rect in _slots(spec, name, rects, rng):
                if best is None or score + oddness < best[0]:
                    best = (score + oddness, rect, name)
        if best is None:
            return None
        rects[spec.name], parents[spec.name] = best[1], best[2]
        penalty += 4.0 * _rank(spec.type, by_name[best[2]].type)
    boxes = np.array([r.as_tuple() for r in rects.values()])
    span = boxes[:, 2:].max(axis=0) - boxes[:, :2].min(axis=0)
    return _Packing(rects, parents, float(np.mean(span) ** 2) + penalty)


def _order(rooms: Sequence[RoomSpec], rng: np.random.Generator) -> list[RoomSpec]:
    """The hub first, then big rooms roughly before small ones, private rooms last."""

    def hub_value(room: RoomSpec) -> float:
        return (8.0 if room.type in _HUBS else 0.0) + sum(room.floor_m) + 1.5 * len(room.doors)

    root = max(rooms, key=hub_value)
    rest = [r for r in rooms if r is not root]
    keys = {
        r.name: r.floor_m[0] * r.floor_m[1] * rng.uniform(0.4, 1.6) - 30.0 * (r.type in _PRIVATE)
        for r in rest
    }
    return [root, *sorted(rest, key=lambda r: -keys[r.name])]


def _rank(child: str, parent: str) -> float:
    """How odd it is to enter a room of type ``child`` from one of type ``parent``: 0 is natural."""
    wanted = _PARENTS.get(child, _HUBS)
    if parent in wanted:
        return 0.5 * wanted.index(parent)
    if parent in _PRIVATE or parent == "kitchen":
        return 9.0
    return 1.5 if parent in _HUBS else 4.0


def _share_a_door(a: RoomSpec, b: RoomSpec, rooms: Sequence[RoomSpec]) -> bool:
    """True when a door model is listed in these two rooms and nowhere else: the inventory lists a door in both its rooms."""
    shared = {d.model for d in a.doors} & {d.model for d in b.doors}
    return any(sum(any(d.model == m for d in r.doors) for r in rooms) == 2 for m in shared)


def _slots(
    spec: RoomSpec, parent: str, rects: Mapping[str, Rect], rng: np.random.Generator
) -> list[tuple[float, Rect]]:
    """Free rectangles for the room along the parent's four sides, each with its cost in square metres."""
    host = rects[parent]
    placed = np.array([r.as_tuple() for r in rects.values()])  # (m, 4)
    door = max([MIN_DOOR_M, *(min(d.width_m, _OPEN_PASSAGE_M) for d in spec.doors)]) + 0.05
    found: list[Rect] = []
    for w, h in {(spec.floor_m[0], spec.floor_m[1]), (spec.floor_m[1], spec.floor_m[0])}:
        found += _along(host, placed, w + WALL_M, h + WALL_M, door + WALL_M)
    if not found:
        return []
    boxes = np.array([r.as_tuple() for r in found])  # (n, 4)
    gap = np.maximum(boxes[:, None, :2], placed[None, :, :2]) - np.minimum(
        boxes[:, None, 2:], placed[None, :, 2:]
    )
    free = ~np.any(np.all(gap < -1e-6, axis=2), axis=1)  # (n,)
    contact = np.where(
        np.abs(gap).min(axis=2) < 1e-6, np.maximum(0.0, -gap.min(axis=2)), 0.0
    )  # shared length (n, m)
    low = np.minimum(boxes[:, :2], placed[:, :2].min(axis=0))
    high = np.maximum(boxes[:, 2:], placed[:, 2:].max(axis=0))
    # The square of the mean side, not the area: it keeps the house from growing into a long row of rooms.
    cost = np.mean(high - low, axis=1) ** 2 - 1.5 * contact.sum(axis=1) + rng.uniform(0.0, 4.0, len(found))
    return [(float(cost[i]), found[i]) for i in np.flatnonzero(free)]


def _along(host: Rect, placed: NDArray[np.float64], w: float, h: float, need: float) -> list[Rect]:
    """Rectangles of size (w, h) that touch the host from outside and share at least ``need`` of an edge with it."""
    found = []
    least = MIN_DOOR_M + WALL_M
    need_y = max(least, min(need, h, host.y1 - host.y0))
    need_x = max(least, min(need, w, host.x1 - host.x0))
    starts_y = {host.y0, host.y1 - h, (host.y0 + host.y1 - h) / 2, *placed[:, 3], *(placed[:, 1] - h)}
    for y in map(float, sorted(starts_y)):
        if min(y + h, host.y1) - max(y, host.y0) >= need_y - 1e-9:
            found += [Rect(host.x1, y, host.x1 + w, y + h), Rect(host.x0 - w, y, host.x0, y + h)]
    starts_x = {host.x0, host.x1 - w, (host.x0 + host.x1 - w) / 2, *placed[:, 2], *(placed[:, 0] - w)}
    for x in map(float, sorted(starts_x)):
        if min(x + w, host.x1) - max(x, host.x0) >= need_x - 1e-9:
            found += [Rect(x, host.y1, x + w, host.y1 + h), Rect(x, host.y0 - h, x + w, host.y0)]
    return found


# Doorways ------------------------------------------------------------------------------------------------------------


def _doorways(
    rooms: Sequence[RoomSpec], rects: Mapping[str, Rect], parents: Mapping[str, str], rng: np.random.Generator
) -> list[DoorCut]:
    left = {r.name: list(r.doors) for r in rooms}
    types = {r.name: r.type for r in rooms}
    front = _front_door(rooms, rects)
    if front.doorway.model:
        room = front.doorway.rooms[0]
        left[room].remove(next(d for d in left[room] if d.model == front.doorway.model))
    # Pairs that list the same door go first, or a third room could take it.
    pairs = sorted(
        parents.items(), key=lambda p: not {d.model for d in left[p[0]]} & {d.model for d in left[p[1]]}
    )
    cuts = [_join(child, parent, rects, left, types, rng) for child, parent in pairs]
    joined = {frozenset(pair) for pair in parents.items()}
    names = [r.name for r in rooms]
    for i, a in enumerate(names):
        for b in names[i + 1 :]:
            shared = {d.model for d in left[a]} & {d.model for d in left[b]}
            edge = shared_edge(rects[a], rects[b])
            if frozenset((a, b)) in joined or not shared or edge is None or edge.length < MIN_DOOR_M + 0.2:
                continue
            cuts.append(_join(a, b, rects, left, types, rng))
    return [*cuts, front]


def _join(
    a: str,
    b: str,
    rects: Mapping[str, Rect],
    left: Mapping[str, list[DoorSpec]],
    types: Mapping[str, str],
    rng: np.random.Generator,
) -> DoorCut:
    """A doorway between two neighbours; takes the door out of the rooms' lists of doors that are left."""
    edge = shared_edge(rects[a], rects[b])
    if edge is None:
        raise FloorPlanError(f"rooms {a!r} and {b!r} share no wall: expected neighbours")
    door = _take_door(left[a], left[b])
    if door is not None:
        width, height = door.width_m, door.height_m
    elif types[a] in _OPEN_PLAN and types[b] in _OPEN_PLAN:
        # Short walls keep a counter's depth on either side of the passage.
        width, height = min(_OPEN_PASSAGE_M, max(MIN_DOOR_M, edge.length - 1.4)), MAX_DOOR_HEIGHT_M
    else:
        width, height = 0.9, 2.05
    width = min(max(width, MIN_DOOR_M), edge.length)
    slack = edge.length - width
    # Doors hang near a corner, which keeps the walls long; wide passages may sit in the middle too.
    ends = (
        (slack / 2,) if slack < 0.5 else (0.2, slack - 0.2) if width <= 1.2 else (0.1, slack / 2, slack - 0.1)
    )
    start = edge.start + float(rng.choice(ends))
    return edge.cut((a, b), start, width, min(height, MAX_DOOR_HEIGHT_M), door.model if door else "")


def _take_door(a: list[DoorSpec], b: list[DoorSpec]) -> DoorSpec | None:
    """The door that both rooms list, else the first of either; removed from the lists."""
    both = [d for d in a if d in b]
    if both:
        a.remove(both[0])
        b.remove(both[0])
        return both[0]
    return a.pop(0) if a else b.pop(0) if b else None


def _front_door(rooms: Sequence[RoomSpec], rects: Mapping[str, Rect]) -> DoorCut:
    """The exterior door, in the most public room that has enough of an outer wall.

    A door that a single room lists is an exterior one, so a public room with such a door goes first.
    """
    listed = Counter(model for r in rooms for model in {d.model for d in r.doors})

    def own_doors(room: RoomSpec) -> list[DoorSpec]:
        return [d for d in room.doors if listed[d.model] == 1 and room.type in _ENTRANCES]

    def order(room: RoomSpec) -> tuple[bool, int]:
        rank = (
            _ENTRANCES.index(room.type)
            if room.type in _ENTRANCES
            else len(_ENTRANCES) + (room.type in _PRIVATE)
        )
        return (not own_doors(room), rank)

    for room in sorted(rooms, key=order):
        door = max(own_doors(room), key=lambda d: d.width_m, default=DoorSpec("", 0.9, 2.05))
        outer = rects[room.name].outer_edges([r for n, r in rects.items() if n != room.name])
        fitting = [e for e in outer if e.length >= MIN_DOOR_M + 0.1]
        if fitting:
            edge = max(fitting, key=lambda e: e.length)
            width = min(max(door.width_m, MIN_DOOR_M), edge.length - 0.1)
            start = edge.start + (edge.length - width) / 2
            height = min(door.height_m, MAX_DOOR_HEIGHT_M)
            return edge.cut((room.name, ""), start, width, height, door.model)
    raise FloorPlanError("no room has an outer wall wide enough for a front door")
