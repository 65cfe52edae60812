"""Routes of the base over the free floor: out of the reach of open panels, and to poses beside occupied ones."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Final

import numpy as np

from embomatrix.sim.floor.obstacles import FLAT_M
from embomatrix.sim.physical.space import Boxes
from embomatrix.skills.limits import ROBOT
from embomatrix.world.geometry import FloatArray, Vec2
from embomatrix.world.poses import StandPose

if TYPE_CHECKING:
    from embomatrix.sim.floor.grid import FloorGrid
    from embomatrix.sim.floor.navigation import Navigator
    from embomatrix.sim.floor.paths import Cell

OUT_M: Final = 0.45
OUT_TRIED: Final = 60
ASIDE_M: Final = 0.9
"""Radius around an occupied standing place in which a free one replaces it."""


class Floor:
    """Free floor in the present state of the planning scene."""

    def __init__(self, navigator: Navigator) -> None:
        self._navigator = navigator

    @property
    def grid(self) -> FloorGrid:
        """Grid of the places that the base fits."""
        return self._navigator.ground.grid

    def with_cut_off_last(self, bases: Sequence[FloatArray], panel: Boxes) -> list[FloatArray]:
        """Order groups of standing places, (b, 3) each, so that those come last which the open panel cuts off.

        ``panel``: boxes of the panels in their final position. A place is cut off if it leaves the largest part of the
        free floor that it belongs to now.
        """
        grid = self.grid
        after = grid.narrowed(_blocking_rows(panel))
        first, last = [], []
        for group in bases:
            good = np.array([self._stays_joined(grid, after, x, y) for x, y in group[:, :2].tolist()])
            first.append(group[good])
            last.append(group[~good])
        return [group for group in (*first, *last) if len(group)]

    def _stays_joined(self, grid: FloorGrid, after: FloorGrid, x_m: float, y_m: float) -> bool:
        return after is grid or after.label_at(x_m, y_m) == after.main_part_of(grid, x_m, y_m)

    def route(
        self, start: Vec2, goal: StandPose, serves: Callable[[StandPose], bool]
    ) -> tuple[FloatArray, StandPose] | None:
        """Return points, (n, 2), from here to a pose, and that pose; None if there is no route.

        If the pose is occupied, the nearest free pose that ``serves`` replaces it, else the nearest free pose.
        """
        grid = self.grid
        first = self._exit_cell(start)
        if first is None:
            return None
        end = self._free_near(goal, grid.label(first), serves)
        last = grid.cell(end.x_m, end.y_m) if end is not None else None
        corners = grid.path(first, last) if last is not None else None
        if end is None or corners is None:
            return None
        out = () if grid.is_free(*start) else (grid.center(first),)
        return np.array([start, *out, *corners[1:-1], (end.x_m, end.y_m)]), end

    def _exit_cell(self, start: Vec2) -> Cell | None:
        """Return the free cell at which a route starts. A robot beside a door first drives to a cell that it fits."""
        grid = self.grid
        if grid.is_free(*start):
            return grid.cell(*start)
        low, high = (start[0] - OUT_M, start[1] - OUT_M), (start[0] + OUT_M, start[1] + OUT_M)
        spots = grid.free_centers(low, high)
        here = np.array(start)
        air = self._air(here[None])[0]
        for number in np.argsort(np.linalg.norm(spots - here, axis=1), kind="stable")[:OUT_TRIED].tolist():
            line = here + np.linspace(0.2, 1.0, 5)[:, None] * (spots[number] - here)
            if self._air(line).min() >= min(air, ROBOT.radius_m) - 0.01:
                return grid.cell(float(spots[number, 0]), float(spots[number, 1]))
        return grid.cell(*start)

    def _air(self, points: FloatArray) -> FloatArray:
        """Distances from points, (n, 2), to the nearest obstacle, (n,)."""
        ground = self._navigator.ground
        rows = np.concatenate([ground.obstacles.blocking, ground.open_panels.blocking])
        nearest = np.clip(points[:, None], rows[:, :2], rows[:, 2:4])
        return np.asarray(np.linalg.norm(points[:, None] - nearest, axis=2).min(axis=1, initial=np.inf))

    def _free_near(
        self, goal: StandPose, label: int, serves: Callable[[StandPose], bool]
    ) -> StandPose | None:
        cell = self.grid.cell(goal.x_m, goal.y_m)
        if cell is not None and self.grid.is_free(goal.x_m, goal.y_m) and self.grid.label(cell) == label:
            return goal
        low, high = (goal.x_m - ASIDE_M, goal.y_m - ASIDE_M), (goal.x_m + ASIDE_M, goal.y_m + ASIDE_M)
        spots = self.grid.free_centers(low, high, label)
        away = np.hypot(spots[:, 0] - goal.x_m, spots[:, 1] - goal.y_m)
        order = [number for number in np.argsort(away, kind="stable").tolist() if away[number] <= ASIDE_M]
        near = [StandPose(float(spots[number, 0]), float(spots[number, 1]), goal.yaw) for number in order]
        return next((spot for spot in near[::4] if serves(spot)), near[0] if near else None)


def _blocking_rows(boxes: Boxes) -> FloatArray:
    """Bounds of the boxes that block the robot: rows of low x, low y, high x, high y, low z, high z."""
    half = np.einsum("mij,mj->mi", np.abs(boxes.rotation), boxes.half)
    low, high = boxes.centre - half, boxes.centre + half
    rows = np.column_stack([low[:, :2], high[:, :2], low[:, 2], high[:, 2]])
    return np.asarray(rows[(rows[:, 4] < ROBOT.height_m) & (rows[:, 5] > FLAT_M)])
