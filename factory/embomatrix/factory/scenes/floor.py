"""The floor that the robot can reach in a scene, and where on it the robot could stand to work."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from embomatrix.sim.floor.grid import CELL_M, FloorGrid
from embomatrix.sim.geometry.bounds import joint_motion
from embomatrix.skills.limits import ROBOT
from embomatrix.world.geometry import Aabb, Pose

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from numpy.typing import NDArray

    from embomatrix.world.geometry import FloatArray
    from embomatrix.world.scene import Room, Scene, SceneObject

    BoolArray = NDArray[np.bool_]

_ORIGIN: Final = Pose((0.0, 0.0, 0.0))
_FLAT_M: Final = 0.03
_REACH_SLACK_M: Final = 0.05
_FRONT_COSINE: Final = math.cos(math.radians(65.0))


class ReachableFloor:
    """Free floor connected to the robot's start, with doors and drawers as they stand: open ones take floor."""

    def __init__(self, scene: Scene) -> None:
        self._rooms = scene.rooms
        walls = [wall.aabb(_ORIGIN) for wall in scene.walls]
        self._standing = _barring(box for item in scene.objects for box in _part_boxes(scene, item))
        boxes = [box_of(scene, item) for item in scene.objects]
        self._footprints = _barring(boxes)[:, :4]
        self._grid = FloorGrid(scene, np.concatenate([_barring(walls), self._standing]))
        cell = self._grid.cell(scene.robot.x_m, scene.robot.y_m)
        self._label = self._grid.label(cell) if cell is not None else 0

    @property
    def has_start(self) -> bool:
        """Whether the robot's start is free floor."""
        return self._label > 0

    @property
    def reachable_share(self) -> float:
        """Share of the places where the robot fits that it can drive to from its start; 0 when there are none."""
        free = int(self._grid.free.sum())
        return float((self._grid.labels == self._label).sum() / free) if free and self.has_start else 0.0

    @property
    def free_share(self) -> float:
        """Share of the rooms' floor over which nothing stands up to the robot's height."""
        free = total = 0
        for room in self._rooms:
            floor = np.ones(np.ceil(np.array(room.size_m) / CELL_M).astype(int), dtype=bool)
            low = np.array([*room.low_m, *room.low_m])
            for x0, y0, x1, y1 in np.rint((self._standing[:, :4] - low) / CELL_M).astype(int).clip(0):
                floor[x0:x1, y0:y1] = False
            free, total = free + int(floor.sum()), total + floor.size
        return free / total

    def cells(self, low: tuple[float, float], high: tuple[float, float]) -> FloatArray:
        """Centres of the reachable cells in a rectangle, shape (n, 2)."""
        if not self.has_start:
            return np.empty((0, 2))
        return self._grid.free_centers(low, high, self._label)

    def enters(self, room: Room) -> bool:
        """Whether any floor of the room is reachable."""
        return len(self.cells(room.low_m, room.high_m)) > 0

    def cut_off_m2(self, room: Room) -> float:
        """Area of the places in the room where the robot fits but can't drive to; none of it lies within an object's box."""
        islands = set(np.unique(self._grid.labels).tolist()) - {0, self._label}
        centers = [self._grid.free_centers(room.low_m, room.high_m, label) for label in sorted(islands)]
        spots = np.concatenate([np.empty((0, 2)), *centers])
        return int((~_within(spots, self._footprints)).sum()) * CELL_M**2

    def spots(self, box: Aabb, *, front_of: Pose | None = None) -> FloatArray:
        """Cells from which the arm reaches a box, shape (n, 2); with ``front_of`` only those before that pose's front."""
        low, high = np.asarray(box.low_m[:2]), np.asarray(box.high_m[:2])
        reach = ROBOT.reach_m - _REACH_SLACK_M
        cells = self.cells(_pair(low - reach), _pair(high + reach))
        away = np.linalg.norm(cells - np.clip(cells, low, high), axis=1)
        fits = (away >= ROBOT.shoulder_m) & (away <= reach)
        if front_of is not None:
            delta = cells - np.asarray(box.center_m[:2])
            cosine = delta @ np.array([math.cos(front_of.yaw), math.sin(front_of.yaw)])
            fits &= cosine >= _FRONT_COSINE * np.linalg.norm(delta, axis=1)
        return np.asarray(cells[fits])


def _within(spots: FloatArray, boxes: FloatArray) -> BoolArray:
    """Which middles of cells, (n, 2), lie within any of some rectangles, (m, 4): marked on a grid, as both are many."""
    if not len(spots):
        return np.zeros(0, dtype=np.bool_)
    low, high = spots.min(axis=0), spots.max(axis=0)
    cells = np.rint((spots - low) / CELL_M).astype(int)
    shape = cells.max(axis=0) + 1
    axes = [low[axis] + CELL_M * np.arange(shape[axis]) for axis in (0, 1)]
    for axis in (0, 1):
        axes[axis][cells[:, axis]] = spots[:, axis]  # to the bit, where there is a spot
    taken = np.zeros(shape, dtype=np.bool_)
    for box in boxes[((boxes[:, :2] < high) & (boxes[:, 2:] > low)).all(axis=1)]:
        rows, columns = (
            slice(np.searchsorted(line, box[axis], "right"), np.searchsorted(line, box[axis + 2], "left"))
            for axis, line in enumerate(axes)
        )
        taken[rows, columns] = True
    return np.asarray(taken[cells[:, 0], cells[:, 1]])


def box_of(scene: Scene, item: SceneObject) -> Aabb:
    """Bounding box of an object in the world, joints shut."""
    asset = scene.assets[item.asset_id]
    return Aabb.around(part.aabb(item.pose_world_asset) for link in asset.links for part in link.parts)


def _part_boxes(scene: Scene, item: SceneObject) -> Iterator[Aabb]:
    """Boxes in the world of an object's parts, joints as they stand."""
    shares = iter(item.joints)
    for link in scene.assets[item.asset_id].links:
        frame = item.pose_world_asset
        if link.joint is not None and (share := next(shares, 0.0)):
            frame = frame @ joint_motion(link.joint, share)
        for part in link.parts:
            yield part.aabb(frame)


def _barring(boxes: Iterable[Aabb]) -> FloatArray:
    """Rows (x0, y0, x1, y1, z0, z1) of the boxes that stand in the robot's way: no rugs, nothing above its head."""
    rows = [(*box.low_m[:2], *box.high_m[:2], box.low_m[2], box.high_m[2]) for box in boxes]
    table = np.array(rows, dtype=np.float64).reshape(-1, 6)
    return np.asarray(table[(table[:, 4] < ROBOT.height_m) & (table[:, 5] > _FLAT_M)])


def _pair(values: FloatArray) -> tuple[float, float]:
    return (float(values[0]), float(values[1]))
