"""Poses on walls, clear of doors and windows, and under the ceiling."""

import math
from collections.abc import Iterator
from typing import Final

import numpy as np

from embomatrix.factory.furnish.roles import HUNG_BOTTOM_M, FurnitureRole, role_of, wall_height_m
from embomatrix.factory.scenes.editor import LayoutReason, PlacementError, SceneEditor
from embomatrix.factory.scenes.floor import box_at
from embomatrix.sim.geometry.bounds import bounds_of
from embomatrix.skills.limits import ROBOT
from embomatrix.world.asset import Asset
from embomatrix.world.geometry import IDENTITY, Pose
from embomatrix.world.scene import Doorway, Room, Window

TRIES: Final = 80
GAP_M: Final = 0.002
"""Gap between an object and its wall, or between its top and the ceiling."""
SPARE_M: Final = 0.05
"""Free strip beside doors, windows and corners."""


class Hanger:
    """Search for places on the walls and under the ceiling of one room."""

    def __init__(self, editor: SceneEditor, room: Room, rng: np.random.Generator) -> None:
        self._editor = editor
        self._room = room
        self._rng = rng

    def on_wall(self, asset: Asset) -> Pose:
        """Return a reachable pose with the asset's back to a wall. Raise PlacementError."""
        free = 0
        for pose in self._on_walls(asset):
            objection = self._editor.objection(asset, pose)
            if objection is None and not self._editor.clearance.bars_a_doorway(box_at(asset, pose)):
                return pose
            free += objection is not LayoutReason.NO_FREE_SPOT
        reason = LayoutReason.OUT_OF_REACH if free else LayoutReason.NO_FREE_SPOT
        raise PlacementError(
            reason,
            f"no wall of {self._room.name} has space for {asset.asset_id}, {asset.size_m[1]:.2f} m wide: try another room",
        )

    def under_ceiling(self, asset: Asset) -> Pose:
        """Return a pose under the ceiling, near the room's centre first. Reach is not required. Raise PlacementError."""
        (cx, cy), (sx, sy) = self._room.center_m, self._room.size_m
        z = self._room.height_m - GAP_M - bounds_of(asset).box(IDENTITY).high_m[2]
        for number in range(TRIES):
            spread = 0.4 * number / TRIES
            x, y = self._rng.uniform(-spread, spread, 2)
            pose = Pose((cx + sx * float(x), cy + sy * float(y), z))
            if self._editor.is_free(asset, pose):
                return pose
        raise PlacementError(
            LayoutReason.NO_FREE_SPOT,
            f"the ceiling of {self._room.name} has no space for {asset.asset_id}: try another room",
        )

    def _on_walls(self, asset: Asset) -> Iterator[Pose]:
        depth, width, height = asset.size_m
        if role_of(asset.category, asset.size_m, asset.mass_kg) is FurnitureRole.HUNG_CABINET:
            middle = HUNG_BOTTOM_M + height / 2
        else:
            middle = min(wall_height_m(asset.category), ROBOT.reach_high_m - SPARE_M)
        z = min(max(middle, height / 2 + SPARE_M), self._room.height_m - height / 2 - GAP_M)
        for _ in range(TRIES):
            axis, sign = int(self._rng.integers(2)), (1, -1)[int(self._rng.integers(2))]
            low, high = self._room.low_m[1 - axis], self._room.high_m[1 - axis]
            half = width / 2 + SPARE_M
            if high - low < 2 * half:
                continue
            along = float(self._rng.uniform(low + half, high - half))
            edge = self._room.low_m[axis] if sign > 0 else self._room.high_m[axis]
            across = edge + sign * (GAP_M + depth / 2)
            if self._meets_opening(
                axis, edge, (along - half, along + half), (z - height / 2, z + height / 2)
            ):
                continue
            yaw = (0.0 if sign > 0 else math.pi) if axis == 0 else sign * math.pi / 2
            x, y = (across, along) if axis == 0 else (along, across)
            yield Pose.from_xyz_yaw(x, y, z, yaw)

    def _meets_opening(
        self, axis: int, edge_m: float, span_m: tuple[float, float], heights_m: tuple[float, float]
    ) -> bool:
        """True if a door or window of this wall overlaps the span and heights."""
        scene = self._editor.base
        openings: tuple[Doorway | Window, ...] = (*scene.doorways, *scene.windows)
        for opening in openings:
            if self._room.name not in opening.rooms or (opening.along == "x") is (axis == 0):
                continue
            if abs(opening.center_m[axis] - edge_m) > 0.3:
                continue
            low, high = _heights(opening)
            middle, half = opening.center_m[1 - axis], opening.width_m / 2
            beside = middle + half <= span_m[0] or middle - half >= span_m[1]
            if not beside and low < heights_m[1] and high > heights_m[0]:
                return True
        return False


def _heights(opening: Doorway | Window) -> tuple[float, float]:
    """Return the lower and upper end of an opening above the floor."""
    return (0.0, opening.height_m) if isinstance(opening, Doorway) else (opening.sill_m, opening.head_m)
