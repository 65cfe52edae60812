"""Placement of groups in a room: the cheapest free candidate that keeps everything within the robot's reach.

Equal groups are placed as rows: on a lattice, an aisle apart, like desks of a class, tables of a restaurant, mats of a gym.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from embomatrix.factory.furnish.candidates import (
    AHEAD,
    WALL_GAP_M,
    GroupFrames,
    RoomSurroundings,
    candidates_of,
)
from embomatrix.factory.furnish.pieces import (
    Access,
    FurnitureGroup,
    FurniturePiece,
    Member,
    Placed,
    Rows,
    access_of,
    front_depth_m,
)
from embomatrix.factory.furnish.roles import FurnitureRole
from embomatrix.factory.furnish.space import LOW_M, BoolArray, Box, FloatArray, Rect4, RoomSpace
from embomatrix.skills.limits import ROBOT
from embomatrix.world.state import Relation

TRIES: Final = 12
"""Candidates of a group that are tested for reachability before the group is given up."""
_ACCESS_TOP_M: Final = 1.35

_FLAT_M: Final = 0.25
_RUG_SEEN_M: Final = 0.6
"""Height that stays free over a rug, so that it is not hidden under a sofa."""
_CLEAR_SHARES: Final = (1.0, 0.5, 0.0)
_APART_M: Final = 0.12
"""Candidates this close to a failed one are skipped; the distance grows with every failure."""


class RoomSolver:
    """Places the groups of one room, one after the other."""

    def __init__(self, space: RoomSpace, rng: np.random.Generator) -> None:
        self.space = space
        self.placed: list[Placed] = []
        self._around = RoomSurroundings(space)
        self._rng = rng

    def place(self, group: FurnitureGroup, *, wobble: float = 1.0) -> bool:
        """Place the group at its cheapest free candidate; False if none keeps the room passable.

        ``wobble`` scales the noise on the costs: attempts differ more with a larger value. The clearance that the group asks
        for is halved, then dropped, if no candidate has it.
        """
        shares = _CLEAR_SHARES if group.clear_m else (0.0,)
        return any(self._place(replace(group, clear_m=share * group.clear_m), wobble) for share in shares)

    def _place(self, group: FurnitureGroup, wobble: float) -> bool:
        options, cost = candidates_of(group, self.space, self._around)
        if not len(options):
            return False
        cost = cost + wobble * self._rng.uniform(0.0, 0.5, len(options))
        options = options.take(np.argsort(cost))
        failed: list[tuple[float, float, int]] = []
        for index in np.flatnonzero(self.free(group, options)):
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
        """Place the group in a frame that is known to be free; False if the robot could then not reach everything."""
        items = self._items(group, x, y, turns)
        boxes = [_with_knee_room(item, box) for item in items for box in item.boxes]
        targets, zones, fronts = _access(items)
        passable = not targets and all(box[2] >= ROBOT.height_m or box[5] <= LOW_M for box in boxes)
        if not passable and not self.space.reachable(boxes, targets):
            return False
        self.placed += items
        self._around.add(items)
        self.space.occupy(boxes, zones, fronts, targets)
        return True

    def is_free_at(self, group: FurnitureGroup, x: float, y: float, turns: int) -> bool:
        """True if the group and the space before its fronts are free in this frame."""
        spot = GroupFrames(np.array([x]), np.array([y]), np.array([turns]))
        return bool(self.free(group, spot)[0])

    def free(self, group: FurnitureGroup, options: GroupFrames) -> BoolArray:
        """Mark the candidates that are free, with free space before their fronts; shape (n,)."""
        free = self._inside(group, options)
        rows = np.flatnonzero(free)
        free[rows] = self._is_free(group, options.take(rows))
        return free

    def _inside(self, group: FurnitureGroup, options: GroupFrames) -> BoolArray:
        """Mark the candidates that lie within the room; shape (n,)."""
        (x0, y0), (x1, y1) = self.space.room.low_m, self.space.room.high_m
        gap = WALL_GAP_M - 1e-6 + group.clear_m
        free = np.ones(len(options), dtype=bool)
        for member in group.members:
            for boxes in _boxes(member, options):
                free &= (boxes[:, 0] >= x0 + gap) & (boxes[:, 1] >= y0 + gap)
                free &= (boxes[:, 3] <= x1 - gap) & (boxes[:, 4] <= y1 - gap)

            front = _front(member, options)
            if front is not None:
                free &= (front[:, 0] >= x0) & (front[:, 1] >= y0) & (front[:, 3] <= x1) & (front[:, 4] <= y1)

        return free

    def _is_free(self, group: FurnitureGroup, options: GroupFrames) -> BoolArray:
        free = np.ones(len(options), dtype=bool)
        for member in group.members:
            for boxes in _boxes(member, options):
                free &= ~self.space.solids.meets(_grown(_seen(member, boxes), group.clear_m))
                if _hangs(member):
                    free &= ~self.space.zones.meets(boxes)
                elif len(boxes) and boxes[0, 5] > LOW_M:
                    free &= ~self.space.blocks_zone(boxes)
            front = _front(member, options)
            if front is not None:
                free &= ~self.space.solids.meets(front)
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
    """True for flat objects on a wall: they take no floor away."""
    return member.piece.role is FurnitureRole.WALL and member.piece.size_m[0] <= _FLAT_M


def _access(items: Sequence[Placed]) -> tuple[list[Rect4], list[Box], list[Box]]:
    """Return the targets of these pieces, the zones in which their doors swing, and the fronts where nothing may stand."""
    targets: list[Rect4] = []
    zones: list[Box] = []
    fronts: list[Box] = []
    for item in items:
        kind = access_of(item.piece)
        if kind is Access.NONE:
            continue
        x0, y0, _, x1, y1, _ = item.box
        if kind in (Access.BESIDE, Access.HUNG):
            # Less than the full reach: the grid is coarse, and objects may lie further in.
            wide = ROBOT.reach_m - 0.15
            targets.append((x0 - wide, y0 - wide, x1 + wide, y1 + wide))
            if kind is Access.BESIDE:
                continue
        depth = front_depth_m(item.piece.asset)
        ax, ay = round(math.cos(item.yaw)), round(math.sin(item.yaw))
        fx0, fy0, fx1, fy1 = _before(item.box, ax, ay, 0.0, depth)
        if kind is Access.HUNG:
            zones.append((fx0, fy0, item.box[2], fx1, fy1, item.box[5]))
            continue
        targets.append(_before(item.box, ax, ay, 0.2, depth + 0.45))
        opens = zones if item.piece.asset.joints else fronts
        opens.append((fx0, fy0, 0.0, fx1, fy1, _ACCESS_TOP_M))
    return targets, zones, fronts


def _before(box: Box, ax: int, ay: int, near: float, far: float) -> Rect4:
    """Return the strip from ``near`` to ``far`` metres before the face of the box that looks along (ax, ay)."""
    x0, y0, _, x1, y1, _ = box
    if ax:
        a, b = (x1 + near, x1 + far) if ax > 0 else (x0 - far, x0 - near)
        return (a, y0, b, y1)
    a, b = (y1 + near, y1 + far) if ay > 0 else (y0 - far, y0 - near)
    return (x0, a, x1, b)


def _yaw(turns: int) -> float:
    return (0.0, math.pi / 2, math.pi, -math.pi / 2)[turns % 4]


def _on_panels(piece: FurniturePiece, host: int) -> bool:
    """True for a worktop on side panels: the space below it is for knees, not for furniture."""
    return piece.role is FurnitureRole.COUNTERTOP and host < 0


def _with_knee_room(item: Placed, box: Box) -> Box:
    """Return the box of a piece, extended down to the floor if nothing may stand under it."""
    return (*box[:2], 0.0, *box[3:]) if _on_panels(item.piece, item.host) else box


def _seen(member: Member, boxes: FloatArray) -> FloatArray:
    """Return the boxes; those of a rug include the space over it that stays free."""
    if member.piece.role is not FurnitureRole.RUG:
        return boxes
    return np.concatenate([boxes[:, :5], np.maximum(boxes[:, 5:], _RUG_SEEN_M)], axis=1)


def _grown(boxes: FloatArray, by_m: float) -> FloatArray:
    return boxes + np.array([-by_m, -by_m, 0.0, by_m, by_m, 0.0]) if by_m else boxes


def _boxes(member: Member, options: GroupFrames) -> Iterator[FloatArray]:
    """Yield the world boxes of each of the member's blocks for every candidate, shape (n, 6)."""
    for x0, y0, z0, x1, y1, z1 in member.piece.blocks:
        low = 0.0 if _on_panels(member.piece, member.on) else member.bottom + z0
        yield _turned(member, options, (x0, y0, x1, y1), (low, member.bottom + z1))


def _front(member: Member, options: GroupFrames) -> FloatArray | None:
    """Return the free space that the member needs before it for every candidate, (n, 6); None if it needs none."""
    kind = access_of(member.piece)
    if kind not in (Access.FRONT, Access.HUNG):
        return None
    depth, width, height = member.piece.size_m
    hung = kind is Access.HUNG
    span = (member.bottom, member.bottom + height) if hung else (LOW_M + 0.001, _ACCESS_TOP_M)
    reach = front_depth_m(member.piece.asset)
    return _turned(member, options, (depth / 2, -width / 2, depth / 2 + reach, width / 2), span)


def _turned(member: Member, options: GroupFrames, flat: Rect4, span: tuple[float, float]) -> FloatArray:
    """Return a rectangle in the member's frame as boxes in the world for every candidate, (n, 6)."""
    x0, y0, x1, y1 = flat
    frames = options.moved(member.x, member.y, member.turns)
    turned = np.array([(x0, y0, x1, y1), (-y1, x0, -y0, x1), (-x1, -y1, -x0, -y0), (y0, -x1, y1, -x0)])
    corners, full = turned[frames.turns], np.ones(len(options))
    low = (frames.x + corners[:, 0], frames.y + corners[:, 1], full * span[0])
    high = (frames.x + corners[:, 2], frames.y + corners[:, 3], full * span[1])
    return np.stack([*low, *high], axis=1)


_MARGINS_M: Final = ((0.75, 0.75), (0.75, 0.05), (0.05, 0.75), (0.05, 0.05))
"""Free floor along the walls in x and y: a passage around the rows, or none."""
_SPARE: Final = 0.04
"""Cost of a superfluous lattice node, as a share of the cost of a group without a place."""
_LATTICES: Final = 4
"""Lattices tried for each heading and margin, those closest to the room's shape first."""


def lay_rows(solver: RoomSolver, rows: Rows, wobble: float, rng: np.random.Generator) -> list[FurnitureGroup]:
    """Place the groups on the lattice with room for most of them. Return the groups without a place."""
    unit = _unit(rows.groups)
    best: tuple[float, GroupFrames] | None = None
    for turns in range(4):
        for lattice in _lattices(solver, unit, rows, turns):
            nodes = GroupFrames(lattice[:, 0], lattice[:, 1], np.full(len(lattice), turns))
            free = nodes.take(np.flatnonzero(_all_free(solver, rows, nodes)))
            score = (
                min(len(free), len(rows.groups)) - _SPARE * len(nodes) + wobble * float(rng.uniform(0.0, 0.5))
            )
            if best is None or score > best[0]:
                best = (score, free)
    if best is None:
        return list(rows.groups)
    return _fill(solver, rows.groups, best[1])


def _fill(solver: RoomSolver, groups: Sequence[FurnitureGroup], nodes: GroupFrames) -> list[FurnitureGroup]:
    left = list(groups)
    for index in range(len(nodes)):
        if not left:
            break
        spot = float(nodes.x[index]), float(nodes.y[index]), int(nodes.turns[index])
        if solver.is_free_at(left[0], *spot) and solver.place_at(left[0], *spot):
            left.pop(0)
    return left


def _all_free(solver: RoomSolver, rows: Rows, nodes: GroupFrames) -> BoolArray:
    """Mark the nodes where the largest group is free: every other group fits there too."""
    largest = max(rows.groups, key=lambda g: len(g.members))
    return solver.free(replace(largest, clear_m=rows.clear_m), nodes)


def _unit(groups: Sequence[FurnitureGroup]) -> Rect4:
    """Return bounds that hold each of the groups in its own frame."""
    bounds = np.array([g.bounds for g in groups])
    low, high = bounds[:, :2].min(axis=0), bounds[:, 2:].max(axis=0)
    return (float(low[0]), float(low[1]), float(high[0]), float(high[1]))


def _lattices(solver: RoomSolver, unit: Rect4, rows: Rows, turns: int) -> Iterator[FloatArray]:
    """Yield lattices of group frames in the middle of the room, nodes of the first row first; each (n, 2)."""
    x0, y0, x1, y1 = unit
    room = solver.space.room
    size, gap = np.array([x1 - x0, y1 - y0]), np.array(rows.gap_m)
    middle = np.array([(x0 + x1) / 2, (y0 + y1) / 2])
    if turns % 2:
        size, gap = size[::-1], gap[::-1]
    c, s = ((1, 0), (0, 1), (-1, 0), (0, -1))[turns]
    offset = np.array([c * middle[0] - s * middle[1], s * middle[0] + c * middle[1]])
    for margin in _MARGINS_M:
        space = np.asarray(room.size_m) - 2 * np.array(margin)
        most = np.floor((space + gap + 1e-9) / (size + gap)).astype(int)
        if min(most) < 1:
            continue
        for nx, ny in _counts(len(rows.groups), int(most[0]), int(most[1])):
            number = np.array([nx, ny])
            pitch = size + gap
            free = np.where(number > 1, (space - size) / np.maximum(1, number - 1), pitch)
            pitch = np.clip(free, pitch, rows.stretch * pitch)
            start = np.asarray(room.center_m) - pitch * (number - 1) / 2
            gx, gy = np.meshgrid(
                start[0] + pitch[0] * np.arange(nx), start[1] + pitch[1] * np.arange(ny), indexing="ij"
            )
            nodes = np.stack([gx.ravel(), gy.ravel()], axis=1) - offset
            ahead = nodes @ np.array([c, s])
            yield nodes[np.argsort(-ahead.round(3), kind="stable")]


def _counts(wanted: int, most_x: int, most_y: int) -> list[tuple[int, int]]:
    """Return (columns, rows) with enough nodes, those shaped like the room and without waste first; the full floor last."""
    found = []
    for nx in range(1, most_x + 1):
        ny = min(most_y, -(-wanted // nx))
        if nx * ny >= wanted:
            found.append((nx, ny))
    found.sort(key=lambda n: (n[0] * n[1] - wanted) / wanted + abs(n[0] / most_x - n[1] / most_y))
    return [*found[:_LATTICES], (most_x, most_y)]
