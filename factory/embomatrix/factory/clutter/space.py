"""Space of a scene that background objects may not take: bodies, the paths of doors, room for hands, openings."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Final

import numpy as np
from numpy.typing import NDArray

from embomatrix.sim.geometry.bounds import bounds_of
from embomatrix.sim.joints.swings import SWING
from embomatrix.world.asset import Asset
from embomatrix.world.geometry import Aabb, FloatArray, Pose
from embomatrix.world.scene import Room, Scene, SceneObject

HAND_M: Final = 0.08
"""Free space for the hand around an object that the robot may pick up, and before a device."""
ABOVE_M: Final = 0.25
FRONT_M: Final = 0.3
DOORWAY_M: Final = 0.6
PANE_M: Final = 0.2
"""Depth of the free space on each side of a doorway, and of a window."""
APART_M: Final = 0.004
"""Least gap between a background object and a body beside it."""
UNDER_M: Final = 0.0002
"""Least gap above and below: less than that between an object and its support."""


class TakenSpace:
    """Boxes, shape (n, 6), that new objects must stay clear of, perhaps in one room."""

    def __init__(self, rows: FloatArray, room: Room | None = None) -> None:
        self._rows = rows
        self._room = room

    @staticmethod
    def of(boxes: Iterable[Aabb]) -> TakenSpace:
        """Return the space of these boxes."""
        rows = [(*box.low_m, *box.high_m) for box in boxes]
        return TakenSpace(np.array(rows, dtype=np.float64).reshape(-1, 6))

    @staticmethod
    def of_scene(scene: Scene) -> TakenSpace:
        """Return the space of a scene's objects and openings. Walls are not part of it: rooms end before them."""
        bodies = (box for item in scene.objects for box in needed_space(scene.assets[item.asset_id], item))
        return TakenSpace.of((*_openings(scene), *bodies))

    def within(self, room: Room) -> TakenSpace:
        """Return the part of this space that reaches into a room."""
        (x0, y0), (x1, y1), rows = room.low_m, room.high_m, self._rows
        inside = (rows[:, 0] < x1) & (rows[:, 3] > x0) & (rows[:, 1] < y1) & (rows[:, 4] > y0)
        return TakenSpace(rows[inside], room)

    def is_free(self, box: Aabb) -> bool:
        """Return True if a box is clear of everything."""
        return bool(self.free(np.array([(*box.low_m, *box.high_m)]))[0])

    def free(self, boxes: FloatArray) -> NDArray[np.bool_]:
        """Mask, (k,), of the boxes, (k, 6), that are clear of everything."""
        gap = np.array([APART_M, APART_M, UNDER_M])
        low, high = boxes[:, None, :3] - gap, boxes[:, None, 3:] + gap  # (k, 1, 3)
        apart = (self._rows[:, 3:] <= low) | (self._rows[:, :3] >= high)  # (k, n, 3)
        return np.asarray(apart.any(axis=2).all(axis=1))

    def inside(self, boxes: FloatArray) -> NDArray[np.bool_]:
        """Mask, (k,), of the boxes, (k, 6), that do not reach into the walls of the room."""
        if self._room is None:
            return np.ones(len(boxes), dtype=np.bool_)
        low, high = np.array(self._room.low_m), np.array(self._room.high_m)
        return np.asarray(((boxes[:, :2] >= low) & (boxes[:, 3:5] <= high)).all(axis=1))

    def take(self, box: Aabb) -> None:
        """Add the box of a new object."""
        self._rows = np.concatenate([self._rows, [(*box.low_m, *box.high_m)]])


def box_of(asset: Asset, pose: Pose) -> Aabb:
    """Return the box of a background object: that of its asset's bounding box at a pose."""
    reach = np.abs(pose.rotation) @ (np.asarray(asset.size_m) / 2)  # (3,)
    x, y, z = pose.position_m
    a, b, c = reach.tolist()
    return Aabb((x - a, y - b, z - c), (x + a, y + b, z + c))


def needed_space(asset: Asset, item: SceneObject) -> Iterator[Aabb]:
    """Yield boxes of an object's parts, of its doors on their way, and of the space that a hand needs."""
    if item.absent:
        return
    pose = item.pose_world_asset
    bounds = bounds_of(asset)
    yield from bounds.part_boxes(pose, item.joints)
    if asset.joints:
        for share in SWING:
            yield from bounds.panel_boxes(pose, (share,) * len(asset.joints))
    box = bounds.box(pose, item.joints)
    (a, b, c), (d, e, f) = box.low_m, box.high_m
    if not item.fixed:
        yield Aabb((a - HAND_M, b - HAND_M, c), (d + HAND_M, e + HAND_M, f + ABOVE_M))
    elif item.host and (asset.joints or asset.can("toggleable")):
        x, y, _ = pose.rotation[:, 0].tolist()
        (x0, x1), (y0, y1) = sorted((0.0, x * FRONT_M)), sorted((0.0, y * FRONT_M))
        yield Aabb((a + x0 - HAND_M, b + y0 - HAND_M, c), (d + x1 + HAND_M, e + y1 + HAND_M, f))


def _openings(scene: Scene) -> Iterator[Aabb]:
    """Yield the space before doorways and windows."""
    for door in scene.doorways:
        half = (
            (door.width_m / 2 + 0.1, DOORWAY_M) if door.along == "x" else (DOORWAY_M, door.width_m / 2 + 0.1)
        )
        (x, y), (a, b) = door.center_m, half
        yield Aabb((x - a, y - b, 0.0), (x + a, y + b, door.height_m + 0.1))
    for window in scene.windows:
        half = (window.width_m / 2, PANE_M) if window.along == "x" else (PANE_M, window.width_m / 2)
        (x, y), (a, b) = window.center_m, half
        yield Aabb((x - a, y - b, max(window.sill_m, 0.9)), (x + a, y + b, window.head_m))
