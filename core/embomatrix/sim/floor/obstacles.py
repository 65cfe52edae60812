"""Obstacles of the robot's base and arm: rectangles of the plane with their height range."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from embomatrix.skills.limits import ROBOT
from embomatrix.world.geometry import Aabb, FloatArray, Vec2

BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int32]

FLAT_M: Final = 0.03
"""The robot drives over lower objects, such as rugs."""
OVER_M: Final = 0.1
"""The arm passes over obstacles up to this much higher than its target."""
SLACK_M: Final = 0.005
WALLS: Final = -1
"""Owner number of the walls."""


class Obstacles:
    """Boxes of parts, shape (n, 6), and their owners.

    Columns: x low, y low, x high, y high, z low, z high. ``owners`` holds the number of the scene object, -1 for walls;
    ``is_panel`` marks doors and drawers.
    """

    def __init__(self, boxes: FloatArray, owners: IntArray, is_panel: BoolArray) -> None:
        self.boxes = boxes
        self.owners = owners
        self.is_panel = is_panel

    @staticmethod
    def of(boxes: Sequence[Aabb], owner: int, is_panel: Sequence[bool]) -> Obstacles:
        """Boxes of one owner."""
        rows = [(*box.low_m[:2], *box.high_m[:2], box.low_m[2], box.high_m[2]) for box in boxes]
        return Obstacles(
            np.array(rows, dtype=np.float64).reshape(-1, 6),
            np.full(len(rows), owner, dtype=np.int32),
            np.array(is_panel, dtype=np.bool_),
        )

    @staticmethod
    def joined(parts: Sequence[Obstacles]) -> Obstacles:
        """Concatenation in this order."""
        return Obstacles(
            np.concatenate([item.boxes for item in parts]),
            np.concatenate([item.owners for item in parts]),
            np.concatenate([item.is_panel for item in parts]),
        )

    def only(self, owners: Sequence[int]) -> Obstacles:
        """Boxes of these owners."""
        return self._chosen(np.isin(self.owners, owners))

    def without(self, owners: Sequence[int]) -> Obstacles:
        """Boxes of all other owners."""
        return self._chosen(~np.isin(self.owners, owners))

    @property
    def blocking(self) -> FloatArray:
        """Boxes that block the robot's base, shape (m, 6)."""
        return self.boxes[self._blocks_base()]

    def owners_near(self, points: FloatArray) -> dict[int, int]:
        """Number of points, shape (n, 2), at which each owner keeps the robot from standing."""
        blocks = self._blocks_base()
        boxes, owners = self.boxes[blocks], self.owners[blocks]
        counts: dict[int, int] = {}
        for owner in dict.fromkeys(owners.tolist()):
            mine = boxes[owners == owner]
            off = np.maximum(mine[:, None, :2] - points, points - mine[:, None, 2:4])  # (m, n, 2)
            away = np.linalg.norm(np.maximum(off, 0.0), axis=2).min(axis=0)  # (n,)
            counts[owner] = int((away < ROBOT.radius_m).sum())
        return counts

    def blockers(self, box: Aabb, own: Sequence[int]) -> FloatArray:
        """Rectangles, shape (4, m), that block the arm on its way to a box: x low, y low, x high, y high.

        These are walls and parts much taller than the box. ``own`` are the numbers of the object in the box and of its hosts.
        Hosts do not block, unless one roofs the object over; then its sides do.
        """
        rows, owners = self.boxes, self.owners
        low, top = box.low_m[2], box.high_m[2]
        x, y, _ = box.center_m
        blocking = (rows[:, 5] > top + OVER_M) & (rows[:, 4] < max(top, ROBOT.shoulder_m))
        for place, number in enumerate(own):
            mine = np.flatnonzero(owners == number)
            blocking[mine] = False
            if place == 0:
                continue
            parts = rows[mine]
            over = (parts[:, 0] <= x) & (x <= parts[:, 2]) & (parts[:, 1] <= y) & (y <= parts[:, 3])
            # A lid is no roof: the arm reaches in from above while it is open, and a shut lid is refused elsewhere.
            stiff = ~self.is_panel[mine]
            if (over & stiff & (parts[:, 4] >= top)).any():
                beside = (parts[:, 4] < top - SLACK_M) & (parts[:, 5] > low + SLACK_M)
                blocking[mine] = beside & stiff
        return np.ascontiguousarray(rows[blocking, :4].T)

    def block_line(self, start: Vec2, end: Vec2, box: Aabb, own: Sequence[int]) -> bool:
        """Return True if the line between two points of the plane crosses one of ``blockers``."""
        (x, y), (to_x, to_y) = start, end
        a, b, c, d, *_ = self._columns
        near = (a <= max(x, to_x)) & (c >= min(x, to_x))
        near &= (b <= max(y, to_y)) & (d >= min(y, to_y))
        found = np.flatnonzero(near)
        low, top = box.low_m[2], box.high_m[2]
        crossed: list[list[float]] = []
        for row, owner, is_panel in zip(
            self.boxes[found].tolist(),
            self.owners[found].tolist(),
            self.is_panel[found].tolist(),
            strict=True,
        ):
            if owner == own[0]:
                continue
            if owner in own:
                beside = not is_panel and row[4] < top - SLACK_M and row[5] > low + SLACK_M
                blocks = beside and self._roofs(owner, box)
            else:
                blocks = row[5] > top + OVER_M and row[4] < max(top, ROBOT.shoulder_m)
            if blocks:
                crossed.append(row[:4])
        return any(_passes(x, y, to_x - x, to_y - y, rectangle) for rectangle in crossed)

    def _roofs(self, owner: int, box: Aabb) -> bool:
        """Return True if a part of an object other than a panel lies over the middle of a box."""
        (x, y, _), top = box.center_m, box.high_m[2]
        mine = np.flatnonzero(self.owners == owner)
        return any(
            not is_panel and e >= top and a <= x <= c and b <= y <= d
            for (a, b, c, d, e, _), is_panel in zip(
                self.boxes[mine].tolist(), self.is_panel[mine].tolist(), strict=True
            )
        )

    @functools.cached_property
    def _columns(self) -> FloatArray:
        """Boxes by column, shape (6, n), which compare faster."""
        return np.ascontiguousarray(self.boxes.T)

    def _chosen(self, rows: BoolArray) -> Obstacles:
        return Obstacles(self.boxes[rows], self.owners[rows], self.is_panel[rows])

    def _blocks_base(self) -> BoolArray:
        return np.asarray((self.boxes[:, 4] < ROBOT.height_m) & (self.boxes[:, 5] > FLAT_M))


def crosses(start: Vec2, end: Vec2, rectangles: FloatArray) -> bool:
    """Slab test: return True if the segment between two points of the plane crosses a rectangle, shape (4, n).

    A plain loop: the median is three rectangles, too few for whole arrays to pay off.
    """
    (x, y), (to_x, to_y) = start, end
    low_x, high_x = min(x, to_x), max(x, to_x)
    low_y, high_y = min(y, to_y), max(y, to_y)
    for rectangle in rectangles.T.tolist():
        a, b, c, d = rectangle
        near = a <= high_x and c >= low_x and b <= high_y and d >= low_y
        if near and _passes(x, y, to_x - x, to_y - y, rectangle):
            return True
    return False


def _passes(x: float, y: float, dx: float, dy: float, rectangle: Sequence[float]) -> bool:
    low_x, low_y, high_x, high_y = rectangle
    dx, dy = (dx if abs(dx) > 1e-12 else 1e-12), (dy if abs(dy) > 1e-12 else 1e-12)
    first_x, last_x = (low_x - x) / dx, (high_x - x) / dx
    first_y, last_y = (low_y - y) / dy, (high_y - y) / dy
    enter = max(min(first_x, last_x), min(first_y, last_y))
    leave = min(max(first_x, last_x), max(first_y, last_y))
    return enter < leave and leave > 0.0 and enter < 1.0
