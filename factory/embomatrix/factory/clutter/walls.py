"""Places for background objects on the walls of a room."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from embomatrix.factory.clutter.space import TakenSpace, box_of
from embomatrix.factory.clutter.supports import on_grid
from embomatrix.factory.furnish.roles import wall_height_m
from embomatrix.skills.limits import ROBOT
from embomatrix.world.asset import Asset
from embomatrix.world.geometry import Aabb, Pose, Quat
from embomatrix.world.scene import Room

OFF_M: Final = 0.006
"""Gap between a wall and an object on it, as for the scene's own objects."""
STEP_M: Final = 0.11
APART_M: Final = 0.08
"""Free wall around an object."""
FLAT_M: Final = 0.05
"""Objects that stand out further hang above the robot or above furniture."""
HEAD_M: Final = ROBOT.height_m + 0.02
_UPENDED: Final[Quat] = (0.0, math.sqrt(0.5), 0.0, math.sqrt(0.5))
"""Rotation that turns the face of a flat model from +z of its asset frame to +x."""
_HEIGHTS_M: Final = {"bath_towel": 1.25, "hand_towel": 1.25, "poster": 1.5, "towel_rack": 1.42, "shelf": 1.62}


@dataclass(frozen=True, slots=True)
class WallSide:
    """Inner side of a wall: an edge of the room's floor. ``axis`` is 0 for a wall along x; ``yaw`` faces the room."""

    axis: int
    edge_m: float
    low_m: float
    high_m: float
    yaw: float

    def pose(self, along_m: float, height_m: float, depth_m: float, turned: Quat) -> Pose:
        """Return the pose of an object of this depth whose middle is at a place on the wall."""
        out = self.edge_m + math.copysign(OFF_M + depth_m / 2, self._inward)
        x, y = (along_m, out) if self.axis == 0 else (out, along_m)
        frame = Pose.from_xyz_yaw(0.0, 0.0, 0.0, self.yaw) @ Pose((0.0, 0.0, 0.0), turned)
        return on_grid((x, y, height_m), frame.quat_xyzw)

    @property
    def _inward(self) -> float:
        return math.sin(self.yaw) if self.axis == 0 else math.cos(self.yaw)


def sides_of(room: Room) -> tuple[WallSide, ...]:
    """Return the four sides of a room."""
    (x0, y0), (x1, y1) = room.low_m, room.high_m
    return (
        WallSide(0, y0, x0, x1, math.pi / 2),
        WallSide(0, y1, x0, x1, -math.pi / 2),
        WallSide(1, x0, y0, y1, 0.0),
        WallSide(1, x1, y0, y1, math.pi),
    )


def spot_on_wall(
    room: Room, asset: Asset, taken: TakenSpace, low: TakenSpace, rng: np.random.Generator
) -> tuple[Pose, Aabb] | None:
    """Return a free pose of an asset on a wall, with its box; None if there is none.

    ``low`` holds the furniture on the floor: objects that stand out from the wall hang over it, or above the robot.
    """
    turned = _turned(asset)
    depth, width = _hung_size(asset, turned)
    middle = _HEIGHTS_M.get(asset.category, wall_height_m(asset.category))
    found = list(_candidates(room, asset, width, (depth, middle), turned))
    order = rng.permutation(len(found))
    for index in order.tolist():
        pose = found[index]
        box = box_of(asset, pose)
        around = _widened(box)
        if not taken.is_free(around):
            continue
        if depth > FLAT_M and box.low_m[2] < HEAD_M and low.is_free(_below(box)):
            continue
        return pose, box
    return None


def _candidates(
    room: Room, asset: Asset, width: float, place: tuple[float, float], turned: Quat
) -> Iterator[Pose]:
    depth, height_m = place
    for side in sides_of(room):
        first, last = side.low_m + width / 2 + APART_M, side.high_m - width / 2 - APART_M
        for along_m in np.arange(first, last, STEP_M).tolist():
            yield side.pose(along_m, height_m, depth, turned)


def _turned(asset: Asset) -> Quat:
    flat = asset.size_m[2] < min(asset.size_m[:2])
    return _UPENDED if flat and asset.category not in ("shelf", "towel_rack") else (0.0, 0.0, 0.0, 1.0)


def _hung_size(asset: Asset, turned: Quat) -> tuple[float, float]:
    """Return how far an object stands out from the wall, and its width along it."""
    x, y, z = asset.size_m
    return (z, y) if turned == _UPENDED else (x, y)


def _widened(box: Aabb) -> Aabb:
    (a, b, c), (d, e, f) = box.low_m, box.high_m
    return Aabb((a - APART_M, b - APART_M, c - APART_M / 2), (d + APART_M, e + APART_M, f + APART_M / 2))


def _below(box: Aabb) -> Aabb:
    """Return the space between an object on a wall and the floor."""
    (a, b, c), (d, e, _) = box.low_m, box.high_m
    return Aabb((a, b, 0.05), (d, e, c))
