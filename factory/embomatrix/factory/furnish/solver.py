"""Placing groups in a room: the best of their candidates that is free and leaves everything within the robot's reach."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Final

import numpy as np

from embomatrix.factory.furnish.candidates import (
    AHEAD,
    WALL_GAP_M,
    GroupCandidates,
    RoomSurroundings,
    candidates_of,
)
from embomatrix.factory.furnish.pieces import Access, Placed, access_of, front_depth_m
from embomatrix.factory.furnish.roles import FurnitureRole
from embomatrix.factory.furnish.space import LOW_M, Target
from embomatrix.skills.limits import ROBOT
from embomatrix.world.state import Relation

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from embomatrix.factory.furnish.boxes import BoolArray, Box, FloatArray
    from embomatrix.factory.furnish.pieces import FurnitureGroup, FurniturePiece, Member
    from embomatrix.factory.furnish.space import RoomSpace

TRIES: Final = 12
"""Candidates of a group whose access is checked before the group is given up."""
_ACCESS_TOP_M: Final = 1.35
_CHUNK: Final = 256
_FLAT_M: Final = 0.25
_RUG_SEEN_M: Final = 0.6
"""Over a rug nothing is lower than this: one under a sofa is seen by nobody."""
_CLEAR_SHARES: Final = (1.0, 0.5, 0.0)
_APART_M: Final = 0.12
"""A candidate this close to one that failed fails for the same reason; the distance grows with every failure."""


class RoomSolver:
    """Places the groups of one room one after the other; what doesn't fit is returned as such."""

    def __init__(self, space: RoomSpace, rng: np.random.Generator) -> None:
        self.space = space
        self.placed: list[Placed] = []
        self._around = RoomSurroundings(space)
        self._rng = rng

    def place(self, group: FurnitureGroup, *, wobble: float = 1.0) -> bool:
        """Place the group at its best free candidate; False when none leaves the room passable.

        ``wobble`` scales the noise on the costs: more of it makes attempts differ more. Where no place has the clearance that
        the group asks for, it does with half of it, then with none.
        """
        shares = _CLEAR_SHARES if group.clear_m else (0.0,)
        return any(self._place(replace(group, clear_m=share * group.clear_m), wobble) for share in shares)

    def _place(self, group: FurnitureGroup, wobble: float) -> bool:
        options = candidates_of(group, self.space, self._around)
        if not len(options):
            return False
        cost = options.cost + wobble * self._rng.uniform(0.0, 0.5, len(options))
        options = options.take(np.argsort(cost))
        failed: list[tuple[float, float, int]] = []
        for index in self._free(group, options):
            x, y, turns = float(options.x[index]), float(options.y[index]), int(options.turns[index])
            near = _APART_M * (1 + len(failed))
            if any(t == turns and math.hypot(x - a, y - b) < near for a, b, t in failed):
                continue
            if self.place_at(group, x, y, turns):
                return True
            failed.append((x, y, turns))
            if len(failed) == TRIES:
                break
        return False

    def place_at(self, group: FurnitureGroup, x: float, y: float, turns: int) -> bool:
        """Place the group in a frame known to be free, unless that takes something out of the robot's reach."""
        items = self._items(group, x, y, turns)
        boxes = [_with_knee_room(item, box) for item in items for box in item.boxes]
        targets, zones, fronts = _access(items)
        bars_no_way = not targets and all(box[2] >= ROBOT.height_m or box[5] <= LOW_M for box in boxes)
        if not bars_no_way and not self.space.reachable(boxes, targets):
            return False
        self.placed += items
        self._around.add(items)
        self.space.occupy(boxes, zones, fronts, targets)
        return True

    def is_free_at(self, group: FurnitureGroup, x: float, y: float, turns: int) -> bool:
        """Whether the group stands free in this frame, its fronts included."""
        spot = GroupCandidates(np.array([x]), np.array([y]), np.array([turns]), np.zeros(1))
        return bool(self.free(group, spot)[0])

    def free(self, group: FurnitureGroup, options: GroupCandidates) -> BoolArray:
        """Which candidates stand free of everything, with their fronts free too; shape (n,)."""
        free = self._looks_free(group, options)
        rows = np.flatnonzero(free)
        free[rows] = self._is_free(group, options.take(rows))
        return free

    def _free(self, group: FurnitureGroup, options: GroupCandidates) -> Iterator[int]:
        """Numbers of the free candidates in their order, checked a few at a time."""
        rows = np.flatnonzero(self._looks_free(group, options))
        for start in range(0, len(rows), _CHUNK):
            chunk = rows[start : start + _CHUNK]
            yield from (int(row) for row in chunk[self._is_free(group, options.take(chunk))])

    def _looks_free(self, group: FurnitureGroup, options: GroupCandidates) -> BoolArray:
        """Candidates inside the room that the quick look does not rule out."""
        (x0, y0), (x1, y1) = self.space.room.low_m, self.space.room.high_m
        gap = WALL_GAP_M - 1e-6 + group.clear_m
        free = np.ones(len(options), dtype=bool)
        for member in group.members:
            for boxes in _boxes(member, options):
                free &= (boxes[:, 0] >= x0 + gap) & (boxes[:, 1] >= y0 + gap)
                free &= (boxes[:, 3] <= x1 - gap) & (boxes[:, 4] <= y1 - gap)
                free &= ~self.space.surely_barred(boxes, hung=_hangs(member))
            front = _front(member, options)
            if front is not None:
                free &= (front[:, 0] >= x0) & (front[:, 1] >= y0) & (front[:, 3] <= x1) & (front[:, 4] <= y1)
                free &= ~self.space.surely_collides(front)
        return free

    def _is_free(self, group: FurnitureGroup, options: GroupCandidates) -> BoolArray:
        free = np.ones(len(options), dtype=bool)
        for member in group.members:
            for boxes in _boxes(member, options):
                free &= ~self.space.collides(_grown(_seen(member, boxes), group.clear_m))
                if _hangs(member):
                    free &= ~self.space.hangs_in_zone(boxes)
                elif len(boxes) and boxes[0, 5] > LOW_M:
                    free &= ~self.space.blocks_zone(boxes)
            front = _front(member, options)
            if front is not None:
                free &= ~self.space.collides(front)
        return free

    def _items(self, group: FurnitureGroup, x: float, y: float, turns: int) -> list[Placed]:
        start = len(self.placed)
        c, s = (int(v) for v in AHEAD[turns])
        return [
            Placed(
                m.piece,
                self.space.room.name,
                x + c * m.x - s * m.y,
                y + s * m.x + c * m.y,
                m.bottom,
                _yaw(turns + m.turns),
                start + m.on if m.on >= 0 else -1,
                Relation.ONTOP if m.on >= 0 else None,
            )
            for m in group.members
        ]


def _hangs(member: Member) -> bool:
    """Whether it is a flat thing on a wall, which takes no floor before what stands opposite."""
    return member.piece.role is FurnitureRole.WALL and member.piece.size_m[0] <= _FLAT_M


def _access(items: Sequence[Placed]) -> tuple[list[Target], list[Box], list[Box]]:
    """Where the robot must be able to stand for these pieces, what their doors need to open, floor that stays free."""
    targets: list[Target] = []
    zones: list[Box] = []
    fronts: list[Box] = []
    for item in items:
        kind = access_of(item.piece)
        if kind is Access.NONE:
            continue
        x0, y0, _, x1, y1, _ = item.box
        if kind in (Access.BESIDE, Access.HUNG):
            # A little less than the reach: the grid is coarse, and what is served may lie further in.
            wide = ROBOT.reach_m - 0.15
            targets.append(Target((x0 - wide, y0 - wide, x1 + wide, y1 + wide)))
            if kind is Access.BESIDE:
                continue
        depth = front_depth_m(item.piece.asset)
        ax, ay = round(math.cos(item.yaw)), round(math.sin(item.yaw))
        fx0, fy0, fx1, fy1 = _before(item.box, ax, ay, 0.0, depth)
        if kind is Access.HUNG:
            zones.append((fx0, fy0, item.box[2], fx1, fy1, item.box[5]))
            continue
        targets.append(Target(_before(item.box, ax, ay, 0.2, depth + 0.45)))
        opens = zones if item.piece.asset.joints else fronts
        opens.append((fx0, fy0, 0.0, fx1, fy1, _ACCESS_TOP_M))
    return targets, zones, fronts


def _before(box: Box, ax: int, ay: int, near: float, far: float) -> tuple[float, float, float, float]:
    """The strip from ``near`` to ``far`` metres before the face of the box that looks along (ax, ay)."""
    x0, y0, _, x1, y1, _ = box
    if ax:
        a, b = (x1 + near, x1 + far) if ax > 0 else (x0 - far, x0 - near)
        return (a, y0, b, y1)
    a, b = (y1 + near, y1 + far) if ay > 0 else (y0 - far, y0 - near)
    return (x0, a, x1, b)


def _yaw(turns: int) -> float:
    return (0.0, math.pi / 2, math.pi, -math.pi / 2)[turns % 4]


def _on_brackets(piece: FurniturePiece, host: int) -> bool:
    """Whether it is a worktop on brackets, with room for knees under it rather than for other furniture."""
    return piece.role is FurnitureRole.COUNTERTOP and host < 0


def _with_knee_room(item: Placed, box: Box) -> Box:
    """The box down to the floor, where nothing shall stand under the piece."""
    return (*box[:2], 0.0, *box[3:]) if _on_brackets(item.piece, item.host) else box


def _seen(member: Member, boxes: FloatArray) -> FloatArray:
    """The boxes with the space over a rug that keeps it in sight."""
    if member.piece.role is not FurnitureRole.RUG:
        return boxes
    return np.concatenate([boxes[:, :5], np.maximum(boxes[:, 5:], _RUG_SEEN_M)], axis=1)


def _grown(boxes: FloatArray, by_m: float) -> FloatArray:
    return boxes + np.array([-by_m, -by_m, 0.0, by_m, by_m, 0.0]) if by_m else boxes


def _boxes(member: Member, options: GroupCandidates) -> Iterator[FloatArray]:
    """World boxes of the member's blocks for every candidate, each (n, 6)."""
    x, y, yaw = _frames(member, options)
    for x0, y0, z0, x1, y1, z1 in member.piece.blocks:
        low = 0.0 if _on_brackets(member.piece, member.on) else member.bottom + z0
        yield _turned(x, y, yaw, (x0, y0, x1, y1), (low, member.bottom + z1))


def _front(member: Member, options: GroupCandidates) -> FloatArray | None:
    """Free space that the member needs before it for every candidate, (n, 6); None when it needs none."""
    kind = access_of(member.piece)
    if kind not in (Access.FRONT, Access.HUNG):
        return None
    depth, width, height = member.piece.size_m
    hung = kind is Access.HUNG
    span = (member.bottom, member.bottom + height) if hung else (LOW_M + 0.001, _ACCESS_TOP_M)
    reach = front_depth_m(member.piece.asset)
    return _turned(*_frames(member, options), (depth / 2, -width / 2, depth / 2 + reach, width / 2), span)


def _frames(member: Member, options: GroupCandidates) -> tuple[FloatArray, FloatArray, NDArray[np.int64]]:
    c, s = AHEAD[options.turns, 0], AHEAD[options.turns, 1]
    x = options.x + c * member.x - s * member.y
    y = options.y + s * member.x + c * member.y
    return x, y, (options.turns + member.turns) % 4


def _turned(
    x: FloatArray,
    y: FloatArray,
    yaw: NDArray[np.int64],
    flat: tuple[float, float, float, float],
    span: tuple[float, float],
) -> FloatArray:
    """The rectangle (x0, y0, x1, y1) of a piece's frame as boxes in the world, (n, 6)."""
    x0, y0, x1, y1 = flat
    corners = np.array([(x0, y0, x1, y1), (-y1, x0, -y0, x1), (-x1, -y1, -x0, -y0), (y0, -x1, y1, -x0)])[yaw]
    full = np.ones(len(x))
    low, high = full * span[0], full * span[1]
    return np.stack(
        [x + corners[:, 0], y + corners[:, 1], low, x + corners[:, 2], y + corners[:, 3], high], axis=1
    )
