"""Geometric verification of objects added to a scene, independent of the code of all layout methods.

Bullet finds penetrations. Boxes of parts decide on supports, rooms and doorways. A flood fill over a grid finds the floor
that the robot reaches.
"""

import contextlib
from collections.abc import Iterator, Sequence
from enum import StrEnum
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from embomatrix.sim.bullet.engine import BulletEngine
from embomatrix.sim.engine import FLOOR
from embomatrix.skills.limits import ROBOT
from embomatrix.world.geometry import IDENTITY
from embomatrix.world.scene import Scene, SceneObject

FloatArray = NDArray[np.float64]

CELL_M: Final = 0.05
REST_M: Final = 0.012
"""Greatest gap between an underside and its support: 1 cm as in the relations, plus the sinking in physics."""
WALL_M: Final = 0.03
"""Depth by which boxes may overlap the edge of a room: objects may touch walls."""
DOOR_M: Final = 0.6
"""Free depth before a doorway: the robot's width and some clearance."""
RUG_M: Final = 0.03
HUNG_M: Final = 2.0
"""Objects that hang higher need not be reached."""


class Flaw(StrEnum):
    """Flaw of an added object."""

    PENETRATES = "penetrates"
    FLOATS = "floats"
    OUTSIDE = "outside"
    BARS_DOORWAY = "bars_doorway"
    UNREACHED = "unreached"


def flaws_of(scene: Scene, added: Sequence[str]) -> tuple[tuple[str, Flaw], ...]:
    """Flaws of the added objects, with their names; none for a sound scene. Raises EngineError where the engine is missing."""
    boxes = {item.name: _parts(scene, item) for item in scene.objects if not item.absent}
    names = [name for name in added if name in boxes and boxes[name][:, 5].max() > 0.0]
    reached = _reached(scene, boxes)
    found: list[tuple[str, Flaw]] = [(name, Flaw.PENETRATES) for name in _penetrating(scene, names)]
    for name in names:
        if not _is_borne(scene, name, boxes):
            found.append((name, Flaw.FLOATS))
        if not _is_within(scene, name, boxes[name]):
            found.append((name, Flaw.OUTSIDE))
        if _blocks_doorway(scene, boxes[name]):
            found.append((name, Flaw.BARS_DOORWAY))
        hung = scene.by_name[name].fixed and boxes[name][:, 2].min() > HUNG_M
        if not hung and not _is_reached(boxes[name], reached):
            found.append((name, Flaw.UNREACHED))
    return tuple(found)


def _parts(scene: Scene, item: SceneObject) -> FloatArray:
    """Return the boxes of an object's parts with shut joints, rows (x0, y0, z0, x1, y1, z1)."""
    rows = [
        (*box.low_m, *box.high_m)
        for link in scene.assets[item.asset_id].links
        for part in link.parts
        for box in (part.aabb(item.pose_world_asset),)
    ]
    return np.array(rows, dtype=np.float64)


def _penetrating(scene: Scene, names: Sequence[str]) -> Iterator[str]:
    with contextlib.closing(BulletEngine(scene)) as engine:
        for name in names:
            if engine.penetrates(name, ignore=frozenset({FLOOR})):
                yield name


def _is_borne(scene: Scene, name: str, boxes: dict[str, FloatArray]) -> bool:
    """True if something supports the object: the floor, a part below it, a wall behind it, or the ceiling."""
    mine = boxes[name]
    low = mine[:, 2].min()
    if low <= REST_M:
        return bool(low >= -REST_M)
    x0, y0 = mine[:, :2].min(axis=0)
    x1, y1 = mine[:, 3:5].max(axis=0)
    for other, parts in boxes.items():
        if other != name:
            under = (parts[:, 0] < x1) & (parts[:, 3] > x0) & (parts[:, 1] < y1) & (parts[:, 4] > y0)
            if np.any(under & (np.abs(parts[:, 5] - low) <= REST_M)):
                return True
    item = scene.by_name[name]
    if not item.fixed:
        # A round bottom may rest in a hollow: the box of its host then reaches above its underside.
        host = boxes.get(item.host)
        return host is not None and bool(np.any((host[:, 2] <= low) & (host[:, 5] >= low - REST_M)))
    walls = np.array([(*box.low_m, *box.high_m) for wall in scene.walls for box in (wall.aabb(IDENTITY),)])
    near = np.all(
        (walls[:, :3] <= mine[:, 3:].max(axis=0) + WALL_M)
        & (walls[:, 3:] >= mine[:, :3].min(axis=0) - WALL_M),
        axis=1,
    )
    return bool(near.any() or mine[:, 5].max() > HUNG_M)


def _is_within(scene: Scene, name: str, parts: FloatArray) -> bool:
    room = next((room for room in scene.rooms if room.name == scene.by_name[name].room), None)
    if room is None:
        return False
    low, high = parts[:, :2].min(axis=0), parts[:, 3:5].max(axis=0)
    return bool(
        np.all(low >= np.array(room.low_m) - WALL_M) and np.all(high <= np.array(room.high_m) + WALL_M)
    )


def _blocks_doorway(scene: Scene, parts: FloatArray) -> bool:
    """True if an obstacle to the robot stands in a doorway or right before it."""
    blocking = parts[(parts[:, 2] < ROBOT.height_m) & (parts[:, 5] > RUG_M)]
    for door in scene.doorways:
        half = np.array((door.width_m / 2, DOOR_M) if door.along == "x" else (DOOR_M, door.width_m / 2))
        low, high = np.array(door.center_m) - half, np.array(door.center_m) + half
        if np.any(np.all((blocking[:, :2] < high) & (blocking[:, 3:5] > low), axis=1)):
            return True
    return False


def _reached(scene: Scene, boxes: dict[str, FloatArray]) -> FloatArray:
    """Return the centres of the cells that the robot's base reaches from its start, shape (n, 2)."""
    low = np.min([room.low_m for room in scene.rooms], axis=0) - 0.5
    high = np.max([room.high_m for room in scene.rooms], axis=0) + 0.5
    shape = np.ceil((high - low) / CELL_M).astype(int)
    floor = np.zeros(shape, dtype=bool)

    def window(a: FloatArray, b: FloatArray) -> tuple[slice, slice]:
        i, j = (
            np.clip(((a - low) / CELL_M).astype(int), 0, shape),
            np.clip(np.ceil((b - low) / CELL_M).astype(int), 0, shape),
        )
        return slice(int(i[0]), int(j[0])), slice(int(i[1]), int(j[1]))

    for room in scene.rooms:
        floor[window(np.array(room.low_m), np.array(room.high_m))] = True
    for door in scene.doorways:
        if door.rooms[1]:
            half = np.array((door.width_m / 2, 0.3) if door.along == "x" else (0.3, door.width_m / 2))
            floor[window(np.array(door.center_m) - half, np.array(door.center_m) + half)] = True
    walls = np.array([(*box.low_m, *box.high_m) for wall in scene.walls for box in (wall.aabb(IDENTITY),)])
    solid = np.concatenate([walls.reshape(-1, 6), *boxes.values()])
    for row in solid[(solid[:, 2] < ROBOT.height_m) & (solid[:, 5] > RUG_M)]:
        floor[window(row[:2], row[3:5])] = False
    # A partly occupied cell counts as full, which takes half a cell on average: the threshold gives it back.
    free = ndimage.distance_transform_edt(floor) * CELL_M >= ROBOT.radius_m - CELL_M / 2
    labels, _ = ndimage.label(free, structure=np.ones((3, 3)))
    cells = np.argwhere(free)
    if not len(cells):
        return np.empty((0, 2))
    middles = low + (cells + 0.5) * CELL_M
    start = int(np.argmin(np.hypot(*(middles - (scene.robot.x_m, scene.robot.y_m)).T)))
    here = labels[tuple(cells[start])]
    return np.asarray(middles[labels[tuple(cells.T)] == here])


def _is_reached(parts: FloatArray, cells: FloatArray) -> bool:
    """True if the robot can stand within arm's length of the object, and the object is not too high."""
    low, high = parts[:, :2].min(axis=0), parts[:, 3:5].max(axis=0)
    away = np.hypot(*(cells - np.clip(cells, low, high)).T)
    return bool(np.any(away <= ROBOT.reach_m)) and bool(parts[:, 2].min() <= ROBOT.reach_high_m)
