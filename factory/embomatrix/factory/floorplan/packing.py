"""Slot packing: rooms are attached one by one to a side of a placed room; trials differ by order and noise."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from embomatrix.factory.floorplan.spec import (
    HUBS,
    MIN_DOOR_M,
    OPEN_PASSAGE_M,
    OUTDOORS,
    PARENTS,
    PRIVATE,
    RoomSpec,
)
from embomatrix.factory.floorplan.walls import WALL_M, Rect

FloatArray = NDArray[np.float64]

CONTACT_WORTH: Final = 1.5
"""Worth of a metre of shared wall, in square metres of extent."""
CHUNK: Final = 128
"""Candidates tested for overlap at a time, cheapest first; testing all at once costs 7 % of a scene's build time."""


@dataclass(frozen=True, slots=True)
class Packing:
    """Places of all rooms, and the room from which each but the first is entered. A lower score is better."""

    rects: Mapping[str, Rect]
    parents: Mapping[str, str]
    score: float


def pack(rooms: Sequence[RoomSpec], rng: np.random.Generator) -> Packing | None:
    """Run one trial; None if a room finds no side with space for a doorway."""
    order = _order(rooms, rng)
    root = order[0]
    w, h = root.floor_m[0] + WALL_M, root.floor_m[1] + WALL_M
    rects = {root.name: Rect(0.0, 0.0, w, h)}
    parents: dict[str, str] = {}
    penalty = 0.0
    by_name = {r.name: r for r in rooms}
    for spec in order[1:]:
        ranks = {name: 4.0 * _rank(spec.type, by_name[name].type) for name in rects}
        bonus = {name: 8.0 * _share_a_door(spec, by_name[name], rooms) for name in rects}
        slot = _best_slot(spec, rects, [ranks[name] - bonus[name] for name in rects], rng)
        if slot is None:
            return None
        host = tuple(rects)[slot[0]]
        rects[spec.name], parents[spec.name] = slot[1], host
        penalty += ranks[host]
    boxes = np.array([*rects.values()])
    span = boxes[:, 2:].max(axis=0) - boxes[:, :2].min(axis=0)
    return Packing(rects, parents, float(np.mean(span) ** 2) + penalty)


def _order(rooms: Sequence[RoomSpec], rng: np.random.Generator) -> list[RoomSpec]:
    """Order rooms: the hub first, large rooms roughly before small ones, private rooms late, gardens last."""

    def hub_value(room: RoomSpec) -> float:
        return (8.0 if room.type in HUBS else 0.0) + sum(room.floor_m) + 1.5 * len(room.doors)

    # A garden lies beside the house, not in the middle of it.
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
    """Return the cost of entering a room of type ``child`` from one of type ``parent``; 0 is natural."""
    wanted = PARENTS.get(child, HUBS)
    if parent in wanted:
        return 0.5 * wanted.index(parent)
    if parent in PRIVATE or parent == "kitchen":
        return 9.0
    return 1.5 if parent in HUBS else 4.0


def _share_a_door(a: RoomSpec, b: RoomSpec, rooms: Sequence[RoomSpec]) -> bool:
    """True if a door model is listed in exactly these two rooms: the inventory lists a door in both its rooms."""
    shared = {d.model for d in a.doors} & {d.model for d in b.doors}
    return any(sum(any(d.model == m for d in r.doors) for r in rooms) == 2 for m in shared)


def _best_slot(
    spec: RoomSpec, rects: Mapping[str, Rect], oddness: Sequence[float], rng: np.random.Generator
) -> tuple[int, Rect] | None:
    """Return the index of the room to attach to and the cheapest free rectangle beside it; None if no side has space.

    The cost in square metres is the extent of the house, less the worth of shared walls, plus the host's oddness.
    """
    placed = np.array([*rects.values()])  # (m, 4)
    door = max([MIN_DOOR_M, *(min(d.width_m, OPEN_PASSAGE_M) for d in spec.doors)]) + 0.05
    sizes = [(w + WALL_M, h + WALL_M) for w, h in (spec.floor_m, spec.floor_m[::-1])]
    found = [_beside(placed, w, h, door + WALL_M) for w, h in sizes]
    hosts = np.concatenate([host for host, _ in found])  # (n,)
    boxes = np.concatenate([box for _, box in found])  # (n, 4)
    low = np.minimum(boxes[:, :2], placed[:, :2].min(axis=0))
    high = np.maximum(boxes[:, 2:], placed[:, 2:].max(axis=0))
    # The square of the mean side instead of the area keeps the house from becoming a long row of rooms.
    extent = np.mean(high - low, axis=1) ** 2
    cost = extent + np.asarray(oddness)[hosts] + rng.uniform(0.0, 4.0, len(boxes))
    order = np.argsort(cost)
    most_contact = CONTACT_WORTH * 2 * sum(sizes[0])
    best: tuple[float, int] | None = None
    for first in range(0, len(order), CHUNK):
        if best is not None and cost[order[first]] - most_contact >= best[0]:
            break
        picks = order[first : first + CHUNK]
        free, contact = _fit(boxes[picks], placed)
        total = np.where(free, cost[picks] - CONTACT_WORTH * contact, np.inf)
        pick = int(np.argmin(total))
        if free[pick] and (best is None or total[pick] < best[0]):
            best = (float(total[pick]), int(picks[pick]))
    if best is None:
        return None
    return int(hosts[best[1]]), Rect(*boxes[best[1]].tolist())


def _fit(boxes: FloatArray, placed: FloatArray) -> tuple[NDArray[np.bool_], FloatArray]:
    """Mark the boxes (n, 4) that overlap no placed one (m, 4); return also the length of wall that each shares with them."""
    gap = np.maximum(boxes[:, None, :2], placed[None, :, :2]) - np.minimum(
        boxes[:, None, 2:], placed[None, :, 2:]
    )  # (n, m, 2), negative where the two overlap along an axis
    free = ~np.any(np.all(gap < -1e-6, axis=2), axis=1)
    touching = np.abs(gap).min(axis=2) < 1e-6
    contact = np.where(touching, np.maximum(0.0, -gap.min(axis=2)), 0.0).sum(axis=1)
    return np.asarray(free), np.asarray(contact)


def _beside(placed: FloatArray, w: float, h: float, need: float) -> tuple[NDArray[np.int64], FloatArray]:
    """Return rectangles of size (w, h) that touch a placed one and share at least ``need`` metres of an edge with it.

    Result: indices of the hosts (n,) and the rectangles (n, 4).
    """
    x0, y0, x1, y1 = placed.T
    by_y, y = _starts(y0, y1, h, need)
    by_x, x = _starts(x0, x1, w, need)
    hosts = np.concatenate([by_y, by_y, by_x, by_x])
    low_x = np.concatenate([x1[by_y], x0[by_y] - w, x, x])
    low_y = np.concatenate([y, y, y1[by_x], y0[by_x] - h])
    return hosts, np.stack([low_x, low_y, low_x + w, low_y + h], axis=1)


def _starts(
    low: FloatArray, high: FloatArray, size: float, need: float
) -> tuple[NDArray[np.int64], FloatArray]:
    """Return the starts of a side of this size along each host's edge from ``low`` to ``high`` (m,): hosts (n,), starts (n,).

    A side is flush with an end of the edge, centred on it, or flush with any other room.
    """
    m = len(low)
    own = np.stack([low, high - size, (low + high - size) / 2], axis=1)  # (m, 3)
    others = np.broadcast_to(np.concatenate([high, low - size]), (m, 2 * m))
    starts = np.concatenate([own, others], axis=1)
    shared = np.minimum(starts + size, high[:, None]) - np.maximum(starts, low[:, None])
    least = np.maximum(MIN_DOOR_M + WALL_M, np.minimum(min(need, size), high - low))
    host, column = np.nonzero(shared >= least[:, None] - 1e-9)
    return host, starts[host, column]
