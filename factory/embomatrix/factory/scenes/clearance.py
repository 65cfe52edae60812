"""Clearance: the floor before doorways and the space before windows must stay free of objects with shut joints."""

import functools
from collections.abc import Iterator
from typing import Final

import numpy as np
from numpy.typing import NDArray

from embomatrix.factory.furnish.space import DOOR_CLEAR_M, DOOR_HEIGHT_M, LOW_M, WINDOW_CLEAR_M, WINDOW_FROM_M
from embomatrix.world.geometry import Aabb, FloatArray
from embomatrix.world.scene import Doorway, Room, Scene, Window

BoolArray = NDArray[np.bool_]

SHALLOW: Final = 0.7
"""Upper limit of the clearance as a share of the room's shorter side."""
_TOUCH_M: Final = 1e-3


class Clearance:
    """Test of a scene's objects against the clear zones. Objects that rest on furniture are ignored, except on a rug."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._rooms = {room.name: room for room in scene.rooms}
        rows, names = [], []
        for item in scene.objects:
            if item.host and not _lies_flat(scene, item.host):
                continue
            for link in scene.assets[item.asset_id].links:
                for part in link.parts:
                    box = part.aabb(item.pose_world_asset)
                    rows.append((*box.low_m, *box.high_m))
                    names.append(item.name)
        self._boxes = np.array(rows).reshape(-1, 6)
        self._names = names

    def before_doorways(self) -> Iterator[tuple[Doorway, str, tuple[str, ...]]]:
        """Yield for each side of each doorway: the doorway, the room, and the objects on its clear floor."""
        for doorway, room, zone in self._door_zones:
            yield doorway, room, self._within(zone)

    def bars_a_doorway(self, box: Aabb) -> bool:
        """True if a box reaches into the clear floor before any doorway."""
        corners = np.array((*box.low_m, *box.high_m))
        return any(_overlap(corners[None], zone)[0] for _, _, zone in self._door_zones)

    def doorway_floor(self, room: str) -> Iterator[tuple[float, float, float, float]]:
        """Yield the rectangles (x0, y0, x1, y1) of a room's floor that stay clear before its doorways."""
        for _, side, zone in self._door_zones:
            if side == room:
                x0, y0, _, x1, y1, _ = zone.tolist()
                yield (x0, y0, x1, y1)

    def before_windows(self) -> Iterator[tuple[Window, str, tuple[str, ...]]]:
        """Yield for each side of each window: the window, the room, and the objects that block its light."""
        for window in self._scene.windows:
            low = max(window.sill_m, WINDOW_FROM_M)
            for room in self._sides(window):
                zone = self._zone(window, self._rooms[room], WINDOW_CLEAR_M, low, window.head_m)
                yield window, room, self._within(zone)

    @functools.cached_property
    def _door_zones(self) -> list[tuple[Doorway, str, FloatArray]]:
        return [
            (doorway, room, self._zone(doorway, self._rooms[room], DOOR_CLEAR_M, LOW_M, DOOR_HEIGHT_M))
            for doorway in self._scene.doorways
            for room in self._sides(doorway)
        ]

    def _sides(self, opening: Doorway | Window) -> list[str]:
        return [room for room in opening.rooms if room in self._rooms]

    @staticmethod
    def _zone(
        opening: Doorway | Window, room: Room, depth_m: float, low_m: float, high_m: float
    ) -> FloatArray:
        """Return the corners (6,) of the clear space before an opening, from the room's wall inwards."""
        depth = min(depth_m, SHALLOW * min(room.size_m))
        across = 1 if opening.along == "x" else 0
        half = opening.width_m / 2
        low, high = np.array(opening.center_m) - half, np.array(opening.center_m) + half
        if opening.center_m[across] < room.center_m[across]:
            low[across], high[across] = room.low_m[across], room.low_m[across] + depth
        else:
            low[across], high[across] = room.high_m[across] - depth, room.high_m[across]
        return np.array([*low, low_m, *high, high_m])

    def _within(self, zone: FloatArray) -> tuple[str, ...]:
        hits = np.flatnonzero(_overlap(self._boxes, zone))
        return tuple(dict.fromkeys(self._names[hit] for hit in hits))


def _lies_flat(scene: Scene, name: str) -> bool:
    """True for a rug, which counts as floor."""
    return name in scene.by_name and scene.box_of(name).high_m[2] <= LOW_M


def _overlap(boxes: FloatArray, zone: FloatArray) -> BoolArray:
    """Mark the boxes (n, 6) that overlap a zone (6,) by more than 1 mm."""
    over = np.minimum(boxes[:, 3:], zone[3:]) - np.maximum(boxes[:, :3], zone[:3])
    return np.asarray((over > _TOUCH_M).all(axis=1))
