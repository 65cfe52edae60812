"""Slot packing: rooms attach one by one to a side of a room that is already placed; trials differ by order and noise."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from embomatrix.factory.floorplan_spec import HUBS, MIN_DOOR_M, OPEN_PASSAGE_M, OUTDOORS, PARENTS, PRIVATE
from embomatrix.factory.floorplan_walls import WALL_M, Rect

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from embomatrix.factory.floorplan_spec import RoomSpec


@dataclass(frozen=True, slots=True)
class Packing:
    """Places of all rooms and the room that each but the first is entered from. A lower score is better."""

    rects: Mapping[str, Rect]
    parents: Mapping[str, str]
    score: float


def pack(rooms: Sequence[RoomSpec], rng: np.random.Generator) -> Packing | None:
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
    return Packing(rects, parents, float(np.mean(span) ** 2) + penalty)


def _order(rooms: Sequence[RoomSpec], rng: np.random.Generator) -> list[RoomSpec]:
    """The hub first, then big rooms roughly before small ones, private rooms late, gardens last."""

    def hub_value(room: RoomSpec) -> float:
        return (8.0 if room.type in HUBS else 0.0) + sum(room.floor_m) + 1.5 * len(room.doors)

    # A garden lies beside the house, never in the middle of it.
    root = max([r for r in rooms if r.type not in OUTDOORS] or rooms, key=hub_value)
    rest = [r for r in rooms if r is not root]
    keys = {
        r.name: r.floor_m[0] * r.floor_m[1] * rng.uniform(0.4, 1.6)
        - 30.0 * (r.type in PRIVATE)
        - 1e6 * (r.type in OUTDOORS)
        for r in rest
    }
    return [root, *sorted(rest, key=lambda r: -keys[r.name])]


def _rank(child: str, parent: str) -> float:
    """How odd it is to enter a room of type ``child`` from one of type ``parent``: 0 is natural."""
    wanted = PARENTS.get(child, HUBS)
    if parent in wanted:
        return 0.5 * wanted.index(parent)
    if parent in PRIVATE or parent == "kitchen":
        return 9.0
    return 1.5 if parent in HUBS else 4.0


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
    door = max([MIN_DOOR_M, *(min(d.width_m, OPEN_PASSAGE_M) for d in spec.doors)]) + 0.05
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
