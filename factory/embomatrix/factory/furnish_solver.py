"""Placing groups in a room: candidates along walls, in corners or in the open, scored, and checked for access."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from embomatrix.factory.furnish_pieces import Access, Group, Style, access_of, front_depth_m
from embomatrix.factory.furnish_roles import Role
from embomatrix.factory.furnish_space import RoomSpace, Target
from embomatrix.skills.limits import ROBOT
from embomatrix.world.state import Relation

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from embomatrix.factory.furnish_pieces import Member, Piece
    from embomatrix.factory.furnish_space import Box
    from embomatrix.world.geometry import Pose

    FloatArray = NDArray[np.float64]

WALL_GAP_M: Final = 0.006
STEP_M: Final = 0.05
TRIES: Final = 12
"""Candidates of a group whose access is checked before the group is given up."""
_ACCESS_TOP_M: Final = 1.35


@dataclass(frozen=True, slots=True)
class Placed:
    """A piece with its place: centre of the footprint, underside, quarter turns, and its host's number (-1: none)."""

    piece: Piece
    room: str
    x: float
    y: float
    bottom: float
    yaw: float
    host: int = -1
    relation: Relation | None = None
    interior: str = ""

    @property
    def pose(self) -> Pose:
        return self.piece.pose(self.x, self.y, self.bottom, self.yaw)

    @property
    def box(self) -> Box:
        """Bounding box in the world."""
        sx, sy, sz = self.piece.size_m
        c, s = abs(math.cos(self.yaw)), abs(math.sin(self.yaw))
        hx, hy = (sx * c + sy * s) / 2, (sx * s + sy * c) / 2
        return (self.x - hx, self.y - hy, self.bottom, self.x + hx, self.y + hy, self.bottom + sz)


@dataclass(frozen=True, slots=True)
class _Candidates:
    """Group frames: x, y and quarter turns, with the cost of each. All arrays have n rows."""

    x: FloatArray
    y: FloatArray
    turns: NDArray[np.int64]
    cost: FloatArray


class RoomSolver:
    """Places the groups of one room one after the other; what doesn't fit is returned as such."""

    def __init__(self, space: RoomSpace, rng: np.random.Generator) -> None:
        self.space = space
        self.placed: list[Placed] = []
        self._rng = rng

    def place(self, group: Group, *, wobble: float = 1.0) -> bool:
        """Place the group at its best free candidate; False when none leaves the room passable.

        ``wobble`` scales the noise on the costs: more of it makes attempts differ more.
        """
        options = self._candidates(group)
        if not len(options.x):
            return False
        cost = options.cost + wobble * self._rng.uniform(0.0, 0.5, len(options.cost))
        free = self._free(group, options)
        order = np.flatnonzero(free)[np.argsort(cost[free])]
        # Neighbouring candidates fail for the same reason: look at the best, then at ever more distant ones.
        picks = (
            order[np.unique((np.arange(TRIES) / TRIES) ** 2 * len(order)).astype(int)]
            if len(order)
            else order
        )
        for index in picks:
            items = self._items(
                group, float(options.x[index]), float(options.y[index]), int(options.turns[index])
            )
            boxes = [item.box for item in items]
            targets, zones = self._access(items)
            bars_no_way = not targets and all(box[2] >= ROBOT.height_m for box in boxes)
            if bars_no_way or self.space.reachable(boxes, targets):
                self.placed += items
                self.space.solids += boxes
                self.space.zones += zones
                self.space.targets += targets
                return True
        return False

    # Candidates

    def _candidates(self, group: Group) -> _Candidates:
        if group.style in (Style.FREE, Style.OVERHEAD):
            x, y, turns = self._open_floor(group)
        else:
            x, y, turns = self._along_walls(group)
        return _Candidates(x, y, turns, self._costs(group, x, y, turns))

    def _along_walls(self, group: Group) -> tuple[FloatArray, FloatArray, NDArray[np.int64]]:
        gx0, gy0, _, gy1 = group.bounds
        (x0, y0), (x1, y1) = self.space.room.low_m, self.space.room.high_m
        xs, ys, ts = [], [], []
        for turns in range(4):
            along_y = turns % 2 == 0  # the front looks along x, so the wall runs along y
            low, high = (y0, y1) if along_y else (x0, x1)
            left, right = (gy0, gy1) if turns in (0, 3) else (-gy1, -gy0)
            first, last = low + WALL_GAP_M - left, high - WALL_GAP_M - right
            if last < first:
                continue
            stops = np.concatenate(
                [np.arange(first, last, STEP_M), [last], self._flush(along_y, left, right)]
            )
            stops = stops[(stops >= first - 1e-9) & (stops <= last + 1e-9)]
            back = WALL_GAP_M - gx0
            fixed = (x0 + back, y0 + back, x1 - back, y1 - back)[turns]
            xs.append(np.full_like(stops, fixed) if along_y else stops)
            ys.append(stops if along_y else np.full_like(stops, fixed))
            ts.append(np.full(len(stops), turns))
        if not xs:
            return np.empty(0), np.empty(0), np.empty(0, dtype=np.int64)
        return np.concatenate(xs), np.concatenate(ys), np.concatenate(ts)

    def _flush(self, along_y: bool, left: float, right: float) -> FloatArray:
        """Stops that leave 5 mm to something that stands already."""
        axis = 1 if along_y else 0
        edges = [(b[axis], b[axis + 3]) for b in self.space.solids]
        return np.array(
            [*(high + 0.005 - left for _, high in edges), *(low - 0.005 - right for low, _ in edges)]
        )

    def _open_floor(self, group: Group) -> tuple[FloatArray, FloatArray, NDArray[np.int64]]:
        (x0, y0), (x1, y1) = self.space.room.low_m, self.space.room.high_m
        # About 60 x 60 places at most, so that a hall takes no longer than a parlour.
        step = max(0.1, math.sqrt((x1 - x0) * (y1 - y0)) / 60)
        gx, gy = np.meshgrid(np.arange(x0 + 0.1, x1, step), np.arange(y0 + 0.1, y1, step), indexing="ij")
        ways = 2 if group.style is Style.OVERHEAD else 4
        turns = np.repeat(np.arange(ways), gx.size)
        return np.tile(gx.ravel(), ways), np.tile(gy.ravel(), ways), turns

    def _costs(self, group: Group, x: FloatArray, y: FloatArray, turns: NDArray[np.int64]) -> FloatArray:
        """Lower is better; the unit is about a metre."""
        if not len(x):
            return np.empty(0)
        room = self.space.room
        cx, cy = room.center_m
        along = np.where(turns % 2 == 0, y, x)
        middle = np.where(turns % 2 == 0, cy, cx)
        half = np.where(turns % 2 == 0, room.size_m[1], room.size_m[0]) / 2
        off = np.abs(along - middle)
        match group.style:
            case Style.CENTERED:
                cost = 0.8 * off - 0.3 * half
            case Style.CORNER:
                cost = 1.5 * (half - off)
            case Style.RUN:
                cost = 0.3 * (half - off) + 1.2 * self._gap_to_run(group, x, y, turns)
            case Style.FREE:
                cost = 0.6 * np.hypot(x - cx, y - cy)
            case Style.OVERHEAD:
                cost = 0.1 * np.hypot(x - cx, y - cy)
            case Style.ALONG:
                cost = np.zeros(len(x))
        cost = cost + self._pull(group.near, x, y) + self._sight(group.faces, x, y, turns)
        return np.asarray(cost - self._push(group.spread, x, y))

    def _gap_to_run(self, group: Group, x: FloatArray, y: FloatArray, turns: NDArray[np.int64]) -> FloatArray:
        """Distance from the group's edge to the nearest counter, cabinet or appliance at its height."""
        level = group.members[0].bottom
        run = (Role.RUN, Role.COUNTERTOP, Role.HUNG_CABINET)
        boxes = np.array([p.box for p in self.placed if p.piece.role in run and abs(p.bottom - level) < 1.0])
        if not len(boxes):
            return np.zeros(len(x))
        gx0, gy0, gx1, gy1 = group.bounds
        hx = np.where(turns % 2 == 0, gx1 - gx0, gy1 - gy0)[:, None] / 2
        hy = np.where(turns % 2 == 0, gy1 - gy0, gx1 - gx0)[:, None] / 2
        dx = np.maximum(0, np.maximum(boxes[:, 0] - x[:, None], x[:, None] - boxes[:, 3]) - hx)
        dy = np.maximum(0, np.maximum(boxes[:, 1] - y[:, None], y[:, None] - boxes[:, 4]) - hy)
        return np.asarray(np.hypot(dx, dy).min(axis=1))

    def _pull(self, categories: tuple[str, ...], x: FloatArray, y: FloatArray) -> FloatArray:
        spots = np.array([(p.x, p.y) for p in self.placed if p.piece.category in categories])
        if not len(spots):
            return np.zeros(len(x))
        return np.asarray(1.2 * np.hypot(x[:, None] - spots[:, 0], y[:, None] - spots[:, 1]).min(axis=1))

    def _push(self, categories: tuple[str, ...], x: FloatArray, y: FloatArray) -> FloatArray:
        """Keeps equal things apart: up to 2 m count."""
        spots = np.array([(p.x, p.y) for p in self.placed if p.piece.category in categories])
        if not len(spots):
            return np.zeros(len(x))
        gap = np.hypot(x[:, None] - spots[:, 0], y[:, None] - spots[:, 1]).min(axis=1)
        return np.asarray(1.5 * np.minimum(gap, 2.5))

    def _sight(
        self, categories: tuple[str, ...], x: FloatArray, y: FloatArray, turns: NDArray[np.int64]
    ) -> FloatArray:
        """Sideways distance of the best partner from the line of sight, theirs and ours; one that is behind costs more."""
        partners = np.array([(p.x, p.y, p.yaw) for p in self.placed if p.piece.category in categories])
        if not len(partners):
            return np.zeros(len(x))
        ahead = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)])[turns]  # (n, 2)
        delta = partners[None, :, :2] - np.stack([x, y], axis=1)[:, None]  # (n, k, 2)
        forward = np.einsum("nkd,nd->nk", delta, ahead)
        aside = np.abs(delta[..., 0] * ahead[:, None, 1] - delta[..., 1] * ahead[:, None, 0])
        theirs = np.stack([np.cos(partners[:, 2]), np.sin(partners[:, 2])], axis=1)  # (k, 2)
        back = -np.einsum("nkd,kd->nk", delta, theirs)
        off = np.abs(delta[..., 0] * theirs[:, 1] - delta[..., 1] * theirs[:, 0])
        cost = np.where(forward > 0.8, 1.2 * aside, 6.0) + np.where(back > 0.8, off, 4.0)
        return np.asarray(cost.min(axis=1))

    # Feasibility

    def _free(self, group: Group, options: _Candidates) -> NDArray[np.bool_]:
        (x0, y0), (x1, y1) = self.space.room.low_m, self.space.room.high_m
        gap = WALL_GAP_M - 1e-6
        free = np.ones(len(options.x), dtype=bool)
        for member in group.members:
            boxes = _boxes(member, options)
            free &= (boxes[:, 0] >= x0 + gap) & (boxes[:, 1] >= y0 + gap)
            free &= (boxes[:, 3] <= x1 - gap) & (boxes[:, 4] <= y1 - gap)
            free &= ~self.space.collides(boxes)
            if boxes[0, 5] > 0.03:
                free &= ~self.space.blocks_zone(boxes)
            kind = access_of(member.piece)
            if kind in (Access.FRONT, Access.HUNG):
                fronts = _boxes(member, options, front=front_depth_m(member.piece.asset))
                if kind is Access.HUNG:
                    fronts[:, 2], fronts[:, 5] = boxes[:, 2], boxes[:, 5]
                free &= ~self.space.collides(fronts)
                free &= (
                    (fronts[:, 0] >= x0) & (fronts[:, 1] >= y0) & (fronts[:, 3] <= x1) & (fronts[:, 4] <= y1)
                )
        return free

    def _items(self, group: Group, x: float, y: float, turns: int) -> list[Placed]:
        start = len(self.placed)
        c, s = ((1, 0), (0, 1), (-1, 0), (0, -1))[turns]
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

    def _access(self, items: Sequence[Placed]) -> tuple[list[Target], list[Box]]:
        """Where the robot must be able to stand for these pieces, and the floor before them that stays free."""
        targets, zones = [], []
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
            if kind is Access.HUNG:
                fx0, fy0, fx1, fy1 = _before(item.box, ax, ay, 0.0, depth)
                zones.append((fx0, fy0, item.box[2], fx1, fy1, item.box[5]))
                continue
            near = 0.2
            targets.append(Target(_before(item.box, ax, ay, near, depth + 0.45)))
            fx0, fy0, fx1, fy1 = _before(item.box, ax, ay, 0.0, depth)
            zones.append((fx0, fy0, 0.0, fx1, fy1, _ACCESS_TOP_M))
        return targets, zones


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


def _boxes(member: Member, options: _Candidates, front: float = 0.0) -> FloatArray:
    """World boxes of the member for every candidate, (n, 6); with ``front``, of the free space before it instead."""
    c = np.array([1, 0, -1, 0])[options.turns]
    s = np.array([0, 1, 0, -1])[options.turns]
    x = options.x + c * member.x - s * member.y
    y = options.y + s * member.x + c * member.y
    yaw = (options.turns + member.turns) % 4
    depth, width, height = member.piece.size_m
    hx = np.where(yaw % 2 == 0, depth, width) / 2
    hy = np.where(yaw % 2 == 0, width, depth) / 2
    low, high = member.bottom, member.bottom + height
    if front:
        ax, ay = np.array([1, 0, -1, 0])[yaw], np.array([0, 1, 0, -1])[yaw]
        x, y = x + ax * (hx + front / 2), y + ay * (hy + front / 2)
        hx, hy = np.where(ax != 0, front / 2, hx), np.where(ay != 0, front / 2, hy)
        low, high = 0.031, _ACCESS_TOP_M
    full = np.ones(len(x))
    return np.stack([x - hx, y - hy, full * low, x + hx, y + hy, full * high], axis=1)
