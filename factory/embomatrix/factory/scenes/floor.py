"""Floor of a scene that the robot can reach, and the places on it from which the arm reaches an object."""

import functools
import math
from collections.abc import Iterable, Iterator
from typing import Final

import numpy as np
from numpy.typing import NDArray

from embomatrix.sim.floor.grid import CELL_M, FloorGrid
from embomatrix.sim.geometry.bounds import joint_motion
from embomatrix.skills.limits import ROBOT
from embomatrix.world.asset import Asset
from embomatrix.world.geometry import IDENTITY, Aabb, FloatArray, Pose
from embomatrix.world.scene import Room, Scene, SceneObject

BoolArray = NDArray[np.bool_]

_FLAT_M: Final = 0.03
_REACH_SLACK_M: Final = 0.05
_FRONT_COSINE: Final = math.cos(math.radians(65.0))


class SceneBoxes:
    """Boxes of walls and objects, computed once for each asset, pose and joint position.

    Scenes that differ by objects alone share them: an editor judges hundreds of poses, each in a scene of its own. Equal
    names of assets must mean equal assets.
    """

    def __init__(self) -> None:
        self._whole: dict[tuple[str, Pose], Aabb] = {}
        self._parts: dict[tuple[str, Pose, tuple[float, ...]], FloatArray] = {}
        self._walls: FloatArray | None = None

    def whole(self, asset: Asset, pose: Pose) -> Aabb:
        """Return the bounding box in the world of an asset at a pose, with its joints shut."""
        key = (asset.asset_id, pose)
        box = self._whole.get(key)
        if box is None:
            box = self._whole[key] = box_at(asset, pose)
        return box

    def barring_parts(self, asset: Asset, item: SceneObject) -> FloatArray:
        """Return the rows of an object's parts that block the robot, with its current joint positions, shape (n, 6)."""
        key = (asset.asset_id, item.pose_world_asset, item.joints)
        rows = self._parts.get(key)
        if rows is None:
            rows = self._parts[key] = _barring(_part_boxes(asset, item))
        return rows

    def barring_walls(self, scene: Scene) -> FloatArray:
        """Return the rows of the walls that block the robot, shape (n, 6)."""
        if self._walls is None:
            self._walls = _barring(wall.aabb(IDENTITY) for wall in scene.walls)
        return self._walls


class ReachableFloor:
    """Free floor connected to the robot's start. Open doors and drawers occupy floor."""

    def __init__(self, scene: Scene, boxes: SceneBoxes | None = None) -> None:
        self._rooms = scene.rooms
        self.boxes = boxes or SceneBoxes()
        """Boxes of the scene, and of earlier ones that shared them."""
        placed = [(scene.assets[item.asset_id], item) for item in scene.objects]
        self._standing = np.concatenate(
            [np.empty((0, 6)), *(self.boxes.barring_parts(asset, item) for asset, item in placed)]
        )
        self._footprints = _barring(self.boxes.whole(asset, item.pose_world_asset) for asset, item in placed)[
            :, :4
        ]
        self._grid = FloorGrid(scene, np.concatenate([self.boxes.barring_walls(scene), self._standing]))
        cell = self._grid.cell(scene.robot.x_m, scene.robot.y_m)
        self._label = self._grid.label(cell) if cell is not None else 0

    @property
    def has_start(self) -> bool:
        """True if the robot's start is on free floor."""
        return self._label > 0

    @property
    def free_share(self) -> float:
        """Share of the rooms' floor without objects up to the robot's height."""
        free = total = 0
        for room in self._rooms:
            floor = np.ones(np.ceil(np.array(room.size_m) / CELL_M).astype(int), dtype=bool)
            low = np.array([*room.low_m, *room.low_m])
            for x0, y0, x1, y1 in np.rint((self._standing[:, :4] - low) / CELL_M).astype(int).clip(0):
                floor[x0:x1, y0:y1] = False
            free, total = free + int(floor.sum()), total + floor.size
        return free / total

    def cells(self, low: tuple[float, float], high: tuple[float, float]) -> FloatArray:
        """Return the centres of the reachable cells in a rectangle, shape (n, 2)."""
        if not self.has_start:
            return np.empty((0, 2))
        return self._grid.free_centers(low, high, self._label)

    def enters(self, room: Room) -> bool:
        """True if any floor of the room is reachable."""
        return len(self.cells(room.low_m, room.high_m)) > 0

    def cut_off_m2(self, room: Room) -> float:
        """Return the area of the room's floor on which the robot fits but which it can't reach, outside of objects' boxes."""
        centers = [self._grid.free_centers(room.low_m, room.high_m, label) for label in self._islands]
        spots = np.concatenate([np.empty((0, 2)), *centers])
        return int((~_within(spots, self._footprints)).sum()) * CELL_M**2

    @functools.cached_property
    def _islands(self) -> list[int]:
        """Labels of free floor that the robot can't reach."""
        return sorted(set(np.unique(self._grid.labels).tolist()) - {0, self._label})

    def spots(self, box: Aabb, *, front_of: Pose | None = None) -> FloatArray:
        """Return the cells from which the arm reaches a box, shape (n, 2); only those before the front of ``front_of``."""
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
    """Mark the points (n, 2) that lie within any of the rectangles (m, 4)."""
    taken = np.zeros(len(spots), dtype=np.bool_)
    for box in boxes:
        taken |= ((spots > box[:2]) & (spots < box[2:])).all(axis=1)
    return taken


def box_of(scene: Scene, item: SceneObject) -> Aabb:
    """Return the bounding box of an object in the world with its joints shut."""
    return box_at(scene.assets[item.asset_id], item.pose_world_asset)


def box_at(asset: Asset, pose: Pose) -> Aabb:
    """Return the bounding box in the world of an asset at a pose, with its joints shut."""
    return Aabb.around(part.aabb(pose) for link in asset.links for part in link.parts)


def _part_boxes(asset: Asset, item: SceneObject) -> Iterator[Aabb]:
    """Yield the boxes in the world of an object's parts with their current joint positions."""
    shares = iter(item.joints)
    for link in asset.links:
        frame = item.pose_world_asset
        if link.joint is not None and (share := next(shares, 0.0)):
            frame = frame @ joint_motion(link.joint, share)
        for part in link.parts:
            yield part.aabb(frame)


def _barring(boxes: Iterable[Aabb]) -> FloatArray:
    """Return rows (x0, y0, x1, y1, z0, z1) of the boxes that block the robot: no rugs, nothing above its head."""
    rows = [(*box.low_m[:2], *box.high_m[:2], box.low_m[2], box.high_m[2]) for box in boxes]
    table = np.array(rows, dtype=np.float64).reshape(-1, 6)
    return np.asarray(table[(table[:, 4] < ROBOT.height_m) & (table[:, 5] > _FLAT_M)])


def _pair(values: FloatArray) -> tuple[float, float]:
    return (float(values[0]), float(values[1]))
