"""Truth of furnished base scenes: rugs under furniture, worktops with a support, seats at tables, lamps above head height.

The figures read finished scenes only and share no code with the furnishing.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from embomatrix.pages.figures import Better, Figure
from embomatrix.world.geometry import IDENTITY
from embomatrix.world.scene import Scene, SceneObject

FloatArray = NDArray[np.float64]

RUG_SHARE: Final = 0.25
"""Share of a rug's area that must lie under furniture."""
LEG_PAIR: Final = 2
"""Number of legs on a rug that also make it lie under furniture."""
HEAD_M: Final = 2.0
"""Lamps hang at least this high, unless they hang over furniture that keeps people away."""
SEAT_GAP_M: Final = 0.35
"""Greatest gap between a seat and its table."""
_GRID: Final = 24
_REST_M: Final = 0.005
_LOW_M: Final = 0.05
"""Undersides below this height stand on the floor, or on a rug."""
_DINING: Final = frozenset(("breakfast_table", "dining_table", "pedestal_table", "conference_table", "booth"))
_CHAIRS: Final = frozenset(
    ("straight_chair", "swivel_chair", "armchair", "eames_chair", "garden_chair", "rocking_chair")
)
_GROUP: Final = 2
"""Number of chairs that form a group; a rug beside a single one is in its place."""
_SEATS: Final = _CHAIRS | {"taboret", "bench", "music_stool"}
_SOFT: Final = frozenset(("sofa", "bed", "coffee_table", "garden_coffee_table", "desk"))
_LAMPS: Final = frozenset(("chandelier", "paper_lantern", "room_light", "ceiling_fan"))


@dataclass(frozen=True, slots=True)
class FurnishingCounts:
    """Counts of one scene or of several. Each pair holds those that fulfil the rule, and all to which it applies."""

    carpets_under: tuple[int, int] = (0, 0)
    slabs_floating: tuple[int, int] = (0, 0)
    desks_seated: tuple[int, int] = (0, 0)
    chairs_at_tables: tuple[int, int] = (0, 0)
    lamps_low: tuple[int, int] = (0, 0)

    def plus(self, other: FurnishingCounts) -> FurnishingCounts:
        """Return the sums of both."""
        return FurnishingCounts(
            _sum(self.carpets_under, other.carpets_under),
            _sum(self.slabs_floating, other.slabs_floating),
            _sum(self.desks_seated, other.desks_seated),
            _sum(self.chairs_at_tables, other.chairs_at_tables),
            _sum(self.lamps_low, other.lamps_low),
        )


NOTHING_COUNTED: Final = FurnishingCounts()


def furnishing_counts(scene: Scene) -> FurnishingCounts:
    """Count the rules of one base scene."""
    rooms: dict[str, list[SceneObject]] = {room.name: [] for room in scene.rooms}
    parts = {item.name: _parts(scene, item) for item in scene.objects if not item.absent}
    walls = np.array([(*box.low_m, *box.high_m) for wall in scene.walls for box in (wall.aabb(IDENTITY),)])
    for item in scene.objects:
        if item.room in rooms and not item.absent:
            rooms[item.room].append(item)
    counts = NOTHING_COUNTED
    for items in rooms.values():
        counts = counts.plus(_room_counts(scene, items, parts, walls.reshape(-1, 6)))
    return counts


def furnishing_figures(counts: FurnishingCounts) -> tuple[Figure, ...]:
    """Return the figures of the counts; figures without any object to judge are left out."""
    up, down = Better.HIGHER, Better.LOWER
    rows = (
        ("carpet_under_share", counts.carpets_under, True, "", up, 0.9),
        ("floating_slabs", counts.slabs_floating, False, "slabs", down, 0.0),
        ("desk_seat_share", counts.desks_seated, True, "", up, None),
        ("chair_at_table_share", counts.chairs_at_tables, True, "", up, None),
        ("low_lamps", counts.lamps_low, False, "lamps", down, 0.0),
    )
    return tuple(
        Figure(name, found / total if shared else float(found), unit, better, total, goal)
        for name, (found, total), shared, unit, better, goal in rows
        if total
    )


def _room_counts(
    scene: Scene, items: Sequence[SceneObject], parts: dict[str, FloatArray], walls: FloatArray
) -> FurnishingCounts:
    kinds = {item.name: scene.assets[item.asset_id].category for item in items}

    def boxes(categories: Iterable[str]) -> list[FloatArray]:
        wanted = frozenset(categories)
        return [parts[item.name] for item in items if kinds[item.name] in wanted]

    chairs = boxes(_CHAIRS)
    beside = boxes(_DINING | _SOFT) + (chairs if len(chairs) >= _GROUP else [])
    everything = [parts[item.name] for item in items]
    rugs = boxes(("carpet",)) if beside else []
    slabs, desks, dining_chairs = boxes(("countertop",)), boxes(("desk",)), boxes(("straight_chair",))
    seats, tables, lamps = boxes(_SEATS), boxes(_DINING), boxes(_LAMPS)
    seated = min(len(desks), len(seats))
    return FurnishingCounts(
        (sum(_lies_under(rug, beside) for rug in rugs), len(rugs)),
        (sum(not _is_carried(slab, [*everything, walls]) for slab in slabs), len(slabs)),
        (min(sum(_has_near(desk, seats) for desk in desks), seated), seated),
        (sum(_has_near(chair, tables) for chair in dining_chairs), len(dining_chairs)) if tables else (0, 0),
        (sum(_is_low(lamp, everything) for lamp in lamps), len(lamps)),
    )


def _sum(a: tuple[int, int], b: tuple[int, int]) -> tuple[int, int]:
    return (a[0] + b[0], a[1] + b[1])


def _parts(scene: Scene, item: SceneObject) -> FloatArray:
    """Return the boxes of an object's parts with shut joints, rows (x0, y0, z0, x1, y1, z1)."""
    found = [
        (*box.low_m, *box.high_m)
        for link in scene.assets[item.asset_id].links
        for part in link.parts
        for box in (part.aabb(item.pose_world_asset),)
    ]
    return np.array(found, dtype=np.float64)


def _lies_under(rug: FloatArray, others: Sequence[FloatArray]) -> bool:
    """True if a quarter of the rug lies under furniture, or if two legs of one piece stand on it."""
    low, high = rug[:, :2].min(axis=0), rug[:, 3:5].max(axis=0)
    steps = (np.arange(_GRID) + 0.5) / _GRID
    x, y = np.meshgrid(low[0] + steps * (high[0] - low[0]), low[1] + steps * (high[1] - low[1]))
    covered = np.zeros(x.shape, dtype=bool)
    for boxes in others:
        for x0, y0, _, x1, y1, _ in boxes:
            covered |= (x > x0) & (x < x1) & (y > y0) & (y < y1)
        feet = boxes[boxes[:, 2] < _LOW_M]
        middles = (feet[:, :2] + feet[:, 3:5]) / 2
        if np.all((middles > low) & (middles < high), axis=1).sum() >= LEG_PAIR:
            return True
    return bool(covered.mean() >= RUG_SHARE)


def _is_carried(slab: FloatArray, others: Sequence[FloatArray]) -> bool:
    """True if the slab stands on the floor, or if a part of another object ends right below it."""
    low = slab[:, 2].min()
    if low <= _LOW_M:
        return True
    x0, y0 = slab[:, :2].min(axis=0)
    x1, y1 = slab[:, 3:5].max(axis=0)
    for boxes in others:
        if boxes is slab:
            continue
        under = (boxes[:, 0] < x1) & (boxes[:, 3] > x0) & (boxes[:, 1] < y1) & (boxes[:, 4] > y0)
        if np.any(under & (np.abs(boxes[:, 5] - low) <= _REST_M)):
            return True
    return False


def _has_near(piece: FloatArray, others: Sequence[FloatArray]) -> bool:
    """True if one of the others stands within reach of a seat."""
    low, high = piece[:, :2].min(axis=0), piece[:, 3:5].max(axis=0)
    for boxes in others:
        apart = np.maximum(boxes[:, :2].min(axis=0) - high, low - boxes[:, 3:5].max(axis=0))
        if np.hypot(*np.maximum(apart, 0.0)) <= SEAT_GAP_M:
            return True
    return False


def _is_low(lamp: FloatArray, others: Sequence[FloatArray]) -> bool:
    """True if people could walk into the lamp: it ends below head height with no furniture under its middle."""
    bottom = lamp[:, 2].min()
    if bottom >= HEAD_M:
        return False
    x, y = (lamp[:, :2].min(axis=0) + lamp[:, 3:5].max(axis=0)) / 2
    for boxes in others:
        under = (boxes[:, 0] <= x) & (boxes[:, 3] >= x) & (boxes[:, 1] <= y) & (boxes[:, 4] >= y)
        if boxes is not lamp and np.any(under & (boxes[:, 5] > 0.3) & (boxes[:, 5] <= bottom)):
            return False
    return True
