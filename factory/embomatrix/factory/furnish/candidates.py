"""Candidate places of a group: stops along the walls or a lattice over the open floor, each with its cost."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from embomatrix.factory.furnish.pieces import FurnitureGroup, Placed, Style
from embomatrix.factory.furnish.roles import FurnitureRole
from embomatrix.factory.furnish.space import BoolArray, FloatArray, RoomSpace

WALL_GAP_M: Final = 0.006
SIDE_GAP_M: Final = 0.005
STEP_M: Final = 0.05
AHEAD: Final = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)])
"""Heading of a group after 0 to 3 quarter turns."""
_RUN_ROLES: Final = (FurnitureRole.RUN, FurnitureRole.COUNTERTOP, FurnitureRole.HUNG_CABINET)
_SIGHT_M: Final = 0.8
_MANY: Final = 4
_BED_SHARE: Final = 0.28
"""Greatest distance of plants from a garden's edges, as a share of its shorter side."""


@dataclass(frozen=True, slots=True)
class GroupFrames:
    """Group frames as x, y and quarter turns. All arrays have n rows."""

    x: FloatArray
    y: FloatArray
    turns: NDArray[np.int64]

    @staticmethod
    def joined(parts: Sequence[GroupFrames]) -> GroupFrames:
        return GroupFrames(
            np.concatenate([part.x for part in parts]),
            np.concatenate([part.y for part in parts]),
            np.concatenate([part.turns for part in parts]),
        )

    def __len__(self) -> int:
        return len(self.x)

    def take(self, rows: NDArray[np.int64] | BoolArray) -> GroupFrames:
        return GroupFrames(self.x[rows], self.y[rows], self.turns[rows])

    def moved(self, x: float, y: float, turns: int = 0) -> GroupFrames:
        """Return the frames at this point of each group, rotated by ``turns`` more quarters."""
        c, s = AHEAD[self.turns, 0], AHEAD[self.turns, 1]
        return GroupFrames(self.x + c * x - s * y, self.y + s * x + c * y, (self.turns + turns) % 4)


class RoomSurroundings:
    """Index of the furniture in a room: centres and headings by category, and the boxes of runs."""

    def __init__(self, space: RoomSpace) -> None:
        self._spots: dict[str, list[tuple[float, float, float]]] = defaultdict(list)
        self._spots["doorway"] = [(*d.center_m, 0.0) for d in space.doorways]
        self._spots["window"] = [(*w.center_m, 0.0) for w in space.windows]
        self._runs: list[tuple[float, ...]] = []

    def add(self, items: Iterable[Placed]) -> None:
        for item in items:
            self._spots[item.piece.category].append((item.x, item.y, item.yaw))
            if item.piece.role in _RUN_ROLES:
                self._runs.append(item.box)

    def of(self, categories: Iterable[str]) -> FloatArray:
        """Return (x, y, yaw) of everything of these categories, shape (k, 3)."""
        found = [spot for category in categories for spot in self._spots.get(category, ())]
        return np.array(found).reshape(-1, 3)

    def runs(self, level_m: float) -> FloatArray:
        """Return boxes of counters, cabinets and appliances with their underside within 1 m of a height, shape (k, 6)."""
        boxes = np.array(self._runs).reshape(-1, 6)
        return boxes[np.abs(boxes[:, 2] - level_m) < 1.0]


def candidates_of(
    group: FurnitureGroup, space: RoomSpace, around: RoomSurroundings
) -> tuple[GroupFrames, FloatArray]:
    """Return all places that the group's style allows, and their costs. Collisions are not tested."""
    if group.style in (Style.FREE, Style.OVERHEAD, Style.AISLE):
        frames = _open_floor(group, space)
    else:
        frames = _along_walls(group, space)
    if group.style is Style.EDGE:
        frames = GroupFrames.joined([frames, _open_floor(group, space)])
        # The centre of a garden stays open.
        frames = frames.take(_to_edge(space, frames) <= _BED_SHARE * min(space.room.size_m))
    if not len(frames):
        return frames, np.empty(0)
    cost = _style_cost(group, space, around, frames)
    cost = cost + 1.2 * _nearest(around.of(group.near), frames) + _sight(around.of(group.faces), frames)
    # Equal objects keep apart; distances beyond 2.5 m make no difference.
    return frames, np.asarray(cost - 1.5 * np.minimum(_nearest(around.of(group.spread), frames), 2.5))


def _along_walls(group: FurnitureGroup, space: RoomSpace) -> GroupFrames:
    gx0, gy0, _, gy1 = group.bounds
    (x0, y0), (x1, y1) = space.room.low_m, space.room.high_m
    found = [GroupFrames(np.empty(0), np.empty(0), np.empty(0, dtype=np.int64))]
    for turns in range(4):
        along_y = turns % 2 == 0  # the front looks along x, so the wall runs along y
        low, high = (y0, y1) if along_y else (x0, x1)
        left, right = (gy0, gy1) if turns in (0, 3) else (-gy1, -gy0)
        first, last = low + WALL_GAP_M - left, high - WALL_GAP_M - right
        if last < first:
            continue
        stops = np.concatenate([np.arange(first, last, STEP_M), [last], _flush(space, along_y, left, right)])
        stops = np.unique(stops[(stops >= first - 1e-9) & (stops <= last + 1e-9)].round(6))
        back = WALL_GAP_M - gx0
        fixed = np.full_like(stops, (x0 + back, y0 + back, x1 - back, y1 - back)[turns])
        x, y = (fixed, stops) if along_y else (stops, fixed)
        found.append(GroupFrames(x, y, np.full(len(stops), turns)))
    return GroupFrames.joined(found)


def _flush(space: RoomSpace, along_y: bool, left: float, right: float) -> FloatArray:
    """Return stops that leave a gap of 5 mm to furniture in the room."""
    axis = 1 if along_y else 0
    solids = space.solids.rows
    return np.concatenate([solids[:, axis + 3] + SIDE_GAP_M - left, solids[:, axis] - SIDE_GAP_M - right])


def _open_floor(group: FurnitureGroup, space: RoomSpace) -> GroupFrames:
    (x0, y0), (x1, y1) = space.room.low_m, space.room.high_m
    # At most about 60 x 60 places: a hall takes no longer than a small room.
    step = max(0.1, math.sqrt((x1 - x0) * (y1 - y0)) / 60)
    gx, gy = np.meshgrid(np.arange(x0 + 0.1, x1, step), np.arange(y0 + 0.1, y1, step), indexing="ij")
    headings = {Style.OVERHEAD: 2, Style.AISLE: 2, Style.EDGE: 1}.get(group.style, 4)
    turns = np.repeat(np.arange(headings), gx.size)
    return GroupFrames(np.tile(gx.ravel(), headings), np.tile(gy.ravel(), headings), turns)


def _style_cost(
    group: FurnitureGroup, space: RoomSpace, around: RoomSurroundings, frames: GroupFrames
) -> FloatArray:
    """Return the cost of each place by the group's style, in metres or so; lower is better."""
    room, x, y, turns = space.room, frames.x, frames.y, frames.turns
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
        case Style.NOOK:
            right = np.where((turns == 0) | (turns == 3), middle - along, along - middle)
            cost = 1.5 * (half - right)
        case Style.RUN:
            cost = 0.3 * (half - off) + 3.0 * _gap_to_run(group, around, frames)
        case Style.FREE:
            cost = 0.6 * np.hypot(x - cx, y - cy)
        case Style.AISLE:
            # Lines of shelves fill the hall from one side, an aisle apart.
            across = np.where(turns % 2 == 0, x - room.low_m[0], y - room.low_m[1])
            shorter = np.where(turns % 2 == 0, room.size_m[0], room.size_m[1])
            cost = 0.4 * across + 0.8 * off - 0.6 * shorter
        case Style.EDGE:
            cost = 0.6 * _to_edge(space, frames)
        case Style.OVERHEAD:
            cost = 0.1 * np.hypot(x - cx, y - cy)
        case Style.ALONG:
            cost = np.zeros(len(x))
    return np.asarray(cost)


def _to_edge(space: RoomSpace, frames: GroupFrames) -> FloatArray:
    """Return the distance from each place to the nearest edge of the room."""
    (x0, y0), (x1, y1) = space.room.low_m, space.room.high_m
    x, y = frames.x, frames.y
    return np.asarray(np.minimum(np.minimum(x - x0, x1 - x), np.minimum(y - y0, y1 - y)))


def _gap_to_run(group: FurnitureGroup, around: RoomSurroundings, frames: GroupFrames) -> FloatArray:
    """Return the distance from the group's edge to the nearest counter, cabinet or appliance at its height."""
    boxes = around.runs(group.members[0].bottom)
    if not len(boxes):
        return np.zeros(len(frames))
    gx0, gy0, gx1, gy1 = group.bounds
    hx = np.where(frames.turns % 2 == 0, gx1 - gx0, gy1 - gy0)[:, None] / 2
    hy = np.where(frames.turns % 2 == 0, gy1 - gy0, gx1 - gx0)[:, None] / 2
    middles = frames.moved((gx0 + gx1) / 2, (gy0 + gy1) / 2)
    x, y = middles.x[:, None], middles.y[:, None]
    dx = np.maximum(0, np.maximum(boxes[:, 0] - x, x - boxes[:, 3]) - hx)
    dy = np.maximum(0, np.maximum(boxes[:, 1] - y, y - boxes[:, 4]) - hy)
    return np.asarray(np.hypot(dx, dy).min(axis=1))


def _nearest(spots: FloatArray, frames: GroupFrames) -> FloatArray:
    """Return the distance from each place to the nearest of the spots, shape (k, 3); 0 if there are none."""
    if not len(spots):
        return np.zeros(len(frames))
    x, y = frames.x, frames.y
    if len(spots) <= 2 * _MANY:
        return np.asarray(np.hypot(x[:, None] - spots[:, 0], y[:, None] - spots[:, 1]).min(axis=1))
    return np.asarray(cKDTree(spots[:, :2]).query(np.stack([x, y], axis=1))[0])


def _sight(partners: FloatArray, frames: GroupFrames) -> FloatArray:
    """Return the sideways distance of the best partner from both lines of sight; a partner behind costs more.

    More than four partners, such as a class before its board, count as one at their centre.
    """
    if not len(partners):
        return np.zeros(len(frames))
    if len(partners) > _MANY:
        heading = float(np.median(partners[:, 2]))
        partners = np.array([(*partners[:, :2].mean(axis=0), heading)])
    ahead = AHEAD[frames.turns]  # (n, 2)
    delta = partners[None, :, :2] - np.stack([frames.x, frames.y], axis=1)[:, None]  # (n, k, 2)
    forward = np.einsum("nkd,nd->nk", delta, ahead)
    aside = np.abs(delta[..., 0] * ahead[:, None, 1] - delta[..., 1] * ahead[:, None, 0])
    theirs = np.stack([np.cos(partners[:, 2]), np.sin(partners[:, 2])], axis=1)  # (k, 2)
    back = -np.einsum("nkd,kd->nk", delta, theirs)
    off = np.abs(delta[..., 0] * theirs[:, 1] - delta[..., 1] * theirs[:, 0])
    cost = np.where(forward > _SIGHT_M, 1.2 * aside, 6.0) + np.where(back > _SIGHT_M, off, 4.0)
    return np.asarray(cost.min(axis=1))
