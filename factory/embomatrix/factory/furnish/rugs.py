"""Rugs under furniture: between the legs of a table, under the front of a sofa or a bed, or below a whole group.

A rug lies flat on the floor, so each leg stands either beside it or on it. A piece with all legs on the rug is lifted by the
rug's thickness, together with everything on top of it; no piece stands on an edge.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from embomatrix.factory.furnish.candidates import WALL_GAP_M
from embomatrix.factory.furnish.pieces import REST_GAP_M, FurniturePiece, Placed
from embomatrix.factory.furnish.roles import FurnitureRole
from embomatrix.factory.furnish.solver import RoomSolver
from embomatrix.factory.furnish.space import BoolArray, FloatArray
from embomatrix.factory.furnish.worktops import side_panels
from embomatrix.world.state import Relation

_ANCHORS: Final = (
    "coffee_table",
    "garden_coffee_table",
    "sofa",
    "bed",
    "dining_table",
    "breakfast_table",
    "pedestal_table",
    "conference_table",
    "armchair",
    "desk",
    "straight_chair",
    "garden_chair",
    "booth",
)
"""Furniture that rugs lie under, the most usual first."""
_LIFTED_ROLES: Final = frozenset(
    (FurnitureRole.TABLE, FurnitureRole.SEAT, FurnitureRole.LOW_TABLE, FurnitureRole.CORNER)
)
_LIFTED: Final = frozenset(("sofa", "bed", "armchair", "nightstand", "eames_chair", "stand"))
"""Furniture that may stand on a rug, besides that of the roles above."""
_UNDER: Final = 0.3
"""Least share of a rug's area under the furniture."""
_LEAST: Final = 0.02
"""Least share even if the furniture stands on the rug: a small table on a large rug."""
_HALF_UNDER: Final = 0.5
_SOLID: Final = frozenset(("sofa", "bed", "armchair"))
_HIDDEN: Final = 0.75
"""Greatest share of a rug under solid furniture, which hides it."""
_STEPS: Final = 36
_LEG_GAP_M: Final = 0.004
_ASIDE_COST: Final = 0.4
"""Cost of a metre beside the middle axis of the furniture."""
_RANK_COST: Final = 0.06
_LIFT_COST: Final = 0.15
_DOORWAY_COST: Final = 0.5
_AGAIN_COST: Final = 0.5
"""Cost of a second rug under the same piece."""


@dataclass(frozen=True, slots=True)
class RugSpot:
    """Place of a rug with its cost, and the indices of the pieces that stand on it."""

    cost: float
    x: float
    y: float
    turned: bool
    lifted: tuple[int, ...]


class Feet:
    """Footprints of everything in a room that reaches down to a rug, each with the index of its piece."""

    def __init__(self, placed: Sequence[Placed], rug_top_m: float) -> None:
        rows: list[tuple[float, float, float, float]] = []
        owners: list[int] = []
        for index, item in enumerate(placed):
            for box in (*_low_boxes(item, rug_top_m), *side_panels(item)):
                rows.append((box[0], box[1], box[3], box[4]))
                owners.append(index)
        self.rows: FloatArray = np.array(rows, dtype=np.float64).reshape(-1, 4)
        self._owned = np.zeros((len(owners), len(placed)), dtype=np.int64)
        self._owned[np.arange(len(owners)), owners] = 1
        self._liftable = np.array([_may_be_lifted(item) for item in placed], dtype=bool)

    def standing(self, rugs: FloatArray) -> tuple[BoolArray, BoolArray]:
        """Return the rugs without a leg on an edge, (n,), and the pieces that stand on each of them, (n, pieces).

        rugs: (n, 4).
        """
        reach = np.concatenate([rugs[:, :2].min(axis=0), rugs[:, 2:].max(axis=0)])
        near = np.all(
            (self.rows[:, :2] < reach[2:] + _LEG_GAP_M) & (self.rows[:, 2:] > reach[:2] - _LEG_GAP_M), axis=1
        )
        low, high = self.rows[None, near, :2], self.rows[None, near, 2:]
        meets = np.all(
            (low < rugs[:, None, 2:] + _LEG_GAP_M) & (high > rugs[:, None, :2] - _LEG_GAP_M), axis=2
        )
        inside = np.all((low > rugs[:, None, :2]) & (high < rugs[:, None, 2:]), axis=2)  # (n, feet)
        feet_on = inside @ self._owned[near]  # (n, pieces)
        on = feet_on > 0
        whole = feet_on == self._owned.sum(axis=0)
        clear = ~np.any(meets & ~inside, axis=1) & np.all(~on | (whole & self._liftable), axis=1)
        return np.asarray(clear), np.asarray(on)


def lay_rugs(solver: RoomSolver, rugs: Sequence[FurniturePiece]) -> list[FurniturePiece]:
    """Lay rugs under the room's furniture, the largest first; return those without such a place."""
    left: list[FurniturePiece] = []
    for rug in sorted(rugs, key=lambda p: -p.size_m[0] * p.size_m[1]):
        spot = _best_spot(solver, rug)
        if spot is None:
            left.append(rug)
        else:
            _lay(solver, rug, spot)
    return left


def _best_spot(solver: RoomSolver, rug: FurniturePiece) -> RugSpot | None:
    feet = Feet(solver.placed, rug.size_m[2] + REST_GAP_M + _LEG_GAP_M)
    spots = [
        spot
        for index, item in enumerate(solver.placed)
        if item.piece.category in _ANCHORS and item.bottom < _LEG_GAP_M
        for turned in (False, True)
        if (spot := _spot_under(solver, feet, rug, index, turned=turned)) is not None
    ]
    return min(spots, key=lambda spot: spot.cost, default=None)


def _spot_under(
    solver: RoomSolver, feet: Feet, rug: FurniturePiece, index: int, *, turned: bool
) -> RugSpot | None:
    """Return the cheapest place under one piece for a rug at this heading; None if a leg would stand on each one's edge."""
    anchor = solver.placed[index]
    size = np.array(rug.size_m[1::-1] if turned else rug.size_m[:2])
    offsets, rects = _around(solver, anchor, size)
    under = _share_under(anchor, rects, float(np.prod(size)))
    offsets, rects, under = (values[under >= _LEAST] for values in (offsets, rects, under))
    if not len(rects):
        return None
    clear, on = feet.standing(rects)
    hides = (under > _HIDDEN) & ~on[:, index] & (anchor.piece.category in _SOLID)
    good = clear & ((under >= _UNDER) | on[:, index]) & ~hides
    if not good.any():
        return None
    before_door = solver.space.zones.meets(np.insert(rects, [2, 4], 0.05, axis=1))
    cost = (
        np.abs(under - _HALF_UNDER)
        + _ASIDE_COST * _off_axis(anchor, offsets)
        + _AGAIN_COST * _has_rug(solver.placed, anchor)
        + _LIFT_COST * on.any(axis=1)
        + _DOORWAY_COST * before_door
        + _RANK_COST * _ANCHORS.index(anchor.piece.category)
    )
    best = int(np.argmin(np.where(good, cost, np.inf)))
    x, y = (rects[best, :2] + rects[best, 2:]) / 2
    lifted = tuple(int(number) for number in np.flatnonzero(on[best]))
    return RugSpot(float(cost[best]), float(x), float(y), turned, lifted)


def _around(solver: RoomSolver, anchor: Placed, size: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return offsets (n, 2) of a rug's centre from that of the furniture, and its rectangles (n, 4) within the room."""
    x0, y0, _, x1, y1, _ = anchor.box
    reach = (np.array([x1 - x0, y1 - y0]) + size) / 2
    steps = np.linspace(-1.0, 1.0, _STEPS + 1)
    dx, dy = np.meshgrid(reach[0] * steps, reach[1] * steps, indexing="ij")
    offsets = np.stack([dx.ravel(), dy.ravel()], axis=1)
    middles = offsets + np.array(((x0 + x1) / 2, (y0 + y1) / 2))
    rects = np.concatenate([middles - size / 2, middles + size / 2], axis=1)
    room = solver.space.room
    inside = np.all(rects[:, :2] >= np.array(room.low_m) + WALL_GAP_M, axis=1)
    inside &= np.all(rects[:, 2:] <= np.array(room.high_m) - WALL_GAP_M, axis=1)
    return offsets[inside], rects[inside]


def _share_under(anchor: Placed, rects: FloatArray, area_m2: float) -> FloatArray:
    """Return the share of each rug's area that lies under the furniture, (n,)."""
    share = np.zeros(len(rects))
    blocks = np.array(anchor.boxes)
    flat = np.unique(blocks[:, (0, 1, 3, 4)], axis=0) if len(blocks) > 1 else blocks[:, (0, 1, 3, 4)]
    for x0, y0, x1, y1 in flat:
        wide = np.minimum(rects[:, 2], x1) - np.maximum(rects[:, 0], x0)
        deep = np.minimum(rects[:, 3], y1) - np.maximum(rects[:, 1], y0)
        share = np.maximum(share, np.maximum(wide, 0.0) * np.maximum(deep, 0.0) / area_m2)
    return share


def _off_axis(anchor: Placed, offsets: FloatArray) -> FloatArray:
    """Return the distance of each rug from the nearest middle axis of the furniture; a sofa's is the one to its front."""
    across = np.abs(offsets)
    if anchor.piece.category != "sofa":
        return np.asarray(across.min(axis=1))
    return np.asarray(across[:, 0 if abs(np.sin(anchor.yaw)) > 0.5 else 1])


def _has_rug(placed: Sequence[Placed], anchor: Placed) -> bool:
    """True if a rug lies under the piece."""
    x0, y0, _, x1, y1, _ = anchor.box
    rugs = (item.box for item in placed if item.piece.role is FurnitureRole.RUG)
    return any(box[0] < x1 and box[3] > x0 and box[1] < y1 and box[4] > y0 for box in rugs)


def _low_boxes(item: Placed, below_m: float) -> list[tuple[float, ...]]:
    """Return the world boxes of the piece's parts that reach below a height."""
    if item.bottom >= below_m:
        return []
    boxes = (part.aabb(item.pose) for link in item.piece.asset.links for part in link.parts)
    return [(*box.low_m, *box.high_m) for box in boxes if box.low_m[2] < below_m]


def _may_be_lifted(item: Placed) -> bool:
    piece = item.piece
    return item.host < 0 and (piece.role in _LIFTED_ROLES or piece.category in _LIFTED)


def _lay(solver: RoomSolver, rug: FurniturePiece, spot: RugSpot) -> None:
    """Add the rug before everything else, since hosts precede what they carry, and lift what stands on it."""
    yaw = np.pi / 2 if spot.turned else 0.0
    placed = Placed(rug, solver.space.room.name, spot.x, spot.y, REST_GAP_M, yaw)
    lifted = set(spot.lifted)
    moved: list[Placed] = []
    for index, item in enumerate(solver.placed):
        if item.host in lifted:
            lifted.add(index)
        host = item.host + 1 if item.host >= 0 else item.host
        if index in lifted:
            host = max(host, 0)
            item = replace(
                item, bottom=item.bottom + placed.bottom + rug.size_m[2] + REST_GAP_M, relation=Relation.ONTOP
            )
        moved.append(replace(item, host=host))
    solver.placed = [placed, *moved]
    solver.space.occupy([placed.box])
