"""Places for background objects on furniture: along the back of each surface, in one cluster, within a share of its area."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from embomatrix.factory.clutter.space import TakenSpace, box_of
from embomatrix.world.asset import Asset, SupportSurface
from embomatrix.world.geometry import Aabb, Pose, Quat
from embomatrix.world.scene import Scene, SceneObject

FILLED: Final = 0.36
"""Share of a surface that objects cover at most, those of the scene included: tasks need the rest."""
SHELF_FILLED: Final = 0.8
"""The same for shelves that belong to the background."""
LOWEST_M: Final = 0.15
HIGHEST_M: Final = 1.75
_MOST: Final[Mapping[str, int]] = {
    "bed": 4,
    "sofa": 3,
    "armchair": 1,
    "bookcase": 3,
    "shelf": 8,
    "coffee_table": 4,
}
MOST: Final = 5
"""Objects on one surface at most; a row of books counts as one."""
RIM_M: Final = 0.012
GRID_M: Final = 1 / 1024
"""Positions are multiples of this length: their binary fractions are short, and a bundle compresses them well."""
LEVEL_M: Final = 1 / 8192
REST_M: Final = 0.0003
"""Least gap above a surface; the greatest is ``LEVEL_M`` more."""
TURN: Final = math.pi / 12
BOOK_GAP_M: Final = 0.002
ACROSS: Final = 25
ALONG: Final = 5
"""Candidates along the width of a surface, and from its back to its middle."""
AT_ONCE: Final = 25
"""Candidates that are compared together."""
UPRIGHT_BOOK: Final[Quat] = (-0.5, -0.5, -0.5, 0.5)
"""Rotation that stands a lying book on its short edge, its spine to the front."""


@dataclass(slots=True)
class FreeSurface:
    """Support surface with the area that may still be covered.

    ``pose`` is the middle of the surface, with x towards the front of its furniture. ``anchor`` is the end of the back edge,
    in shares of the width from -0.5 to 0.5, at which objects gather.
    """

    host: str
    category: str
    pose: Pose
    size_m: tuple[float, float]
    clearance_m: float
    budget_m2: float
    anchor: float
    kinds: list[str] = field(default_factory=list)
    """Categories of the background objects on it, a row of books as one."""

    @property
    def is_full(self) -> bool:
        return len(self.kinds) >= _MOST.get(self.category, MOST)


def surfaces_of(scene: Scene, room: str, rng: np.random.Generator) -> Iterator[FreeSurface]:
    """Yield the open surfaces of a room's fixed furniture that do not move."""
    for item in scene.objects:
        if item.room != room or not item.fixed or item.absent:
            continue
        asset = scene.assets[item.asset_id]
        upright = abs(item.pose_world_asset.rotation[2, 2]) > 0.99
        for surface in asset.supports if upright else ():
            free = free_surface(item.name, asset, item.pose_world_asset, surface, FILLED, rng)
            if not surface.link and not surface.interior and LOWEST_M < free.pose.position_m[2] < HIGHEST_M:
                free.budget_m2 -= _covered_m2(scene, item, free)
                yield free


def free_surface(
    host: str, asset: Asset, pose: Pose, surface: SupportSurface, share: float, rng: np.random.Generator
) -> FreeSurface:
    """Return a surface of an asset at a pose, of which objects may cover a share."""
    area_m2 = surface.size_m[0] * surface.size_m[1]
    anchor = float(rng.choice([-0.5, 0.5]))
    place = pose @ Pose(surface.center_m)
    return FreeSurface(
        host, asset.category, place, surface.size_m, surface.clearance_m, share * area_m2, anchor
    )


def spot_on(
    surface: FreeSurface, asset: Asset, taken: TakenSpace, rng: np.random.Generator
) -> tuple[Pose, Aabb] | None:
    """Return a free pose of an asset on a surface, at the back and near the anchor, with its box; None if there is none."""
    depth, width, height = asset.size_m
    room = (surface.size_m[0] - depth - 2 * RIM_M, surface.size_m[1] - width - 2 * RIM_M)
    if min(room) < 0 or height + 0.01 > surface.clearance_m or depth * width > surface.budget_m2:
        return None
    turn = TURN * int(rng.integers(-1, 2)) if max(depth, width) < 0.3 else 0.0
    back, side = np.meshgrid(np.linspace(0.0, 0.5, ALONG), np.linspace(0.0, 1.0, ACROSS))
    local = np.column_stack([(back.ravel() - 0.5) * room[0], (side.ravel() - 0.5) * room[1]])  # (k, 2)
    end = np.array([-0.5 * room[0], surface.anchor * room[1]])
    order = np.argsort(np.hypot(*(local - end).T) + rng.uniform(0.0, 0.06, len(local)))
    for first in range(0, len(order), AT_ONCE):
        places = local[order[first : first + AT_ONCE]].tolist()
        found = _first_free([_on(surface, asset, (x, y), turn) for x, y in places], asset, taken)
        if found is not None:
            return found
    return None


def row_of_books(
    surface: FreeSurface, books: list[Asset], taken: TakenSpace
) -> list[tuple[Asset, Pose, Aabb]]:
    """Stand books side by side at the back of a surface, from the anchor on; leave out those that do not fit."""
    found: list[tuple[Asset, Pose, Aabb]] = []
    sign = -math.copysign(1.0, surface.anchor)
    at = surface.anchor * (surface.size_m[1] - 2 * RIM_M)
    for book in books:
        height, depth, thick = book.size_m
        x = -surface.size_m[0] / 2 + RIM_M + depth / 2
        if height + 0.01 > surface.clearance_m or depth + 2 * RIM_M > surface.size_m[0]:
            continue
        while abs(at + sign * thick) < surface.size_m[1] / 2 - RIM_M and thick * depth <= surface.budget_m2:
            pose = _lifted(surface, (x, at + sign * thick / 2), height, UPRIGHT_BOOK)
            at += sign * (thick + BOOK_GAP_M)
            box = box_of(book, pose)
            near = _shrunk(box)
            if taken.is_free(near) and taken.inside(np.array([(*near.low_m, *near.high_m)]))[0]:
                found.append((book, pose, box))
                surface.budget_m2 -= thick * depth
                break
    return found


def cover(surface: FreeSurface, asset: Asset) -> None:
    """Count the footprint of an object that was put on a surface."""
    surface.budget_m2 -= asset.size_m[0] * asset.size_m[1]
    surface.kinds.append(asset.category)


def _shrunk(box: Aabb) -> Aabb:
    """Return a box that may touch its neighbours: books stand close together."""
    (a, b, c), (d, e, f) = box.low_m, box.high_m
    by = 0.0035
    return Aabb((a + by, b + by, c), (d - by, e - by, f))


def _first_free(poses: list[Pose], asset: Asset, taken: TakenSpace) -> tuple[Pose, Aabb] | None:
    boxes = [box_of(asset, pose) for pose in poses]
    rows = np.array([(*box.low_m, *box.high_m) for box in boxes])
    free = np.flatnonzero(taken.free(rows) & taken.inside(rows))
    return (poses[free[0]], boxes[free[0]]) if len(free) else None


def _on(surface: FreeSurface, asset: Asset, place: tuple[float, float], turn: float) -> Pose:
    return _lifted(surface, place, asset.size_m[2], Pose.from_xyz_yaw(0.0, 0.0, 0.0, turn).quat_xyzw)


def _lifted(surface: FreeSurface, place: tuple[float, float], height: float, turned: Quat) -> Pose:
    """Return the pose of an object of this height at a place of a surface, on the grid of positions."""
    x, y, z = surface.pose.apply((*place, height / 2 + REST_M))
    quat = (surface.pose @ Pose((0.0, 0.0, 0.0), turned)).quat_xyzw
    return on_grid((x, y, math.ceil(z / LEVEL_M) * LEVEL_M), quat)


def on_grid(position_m: tuple[float, float, float], quat: Quat) -> Pose:
    """Return a pose with x and y on the grid of positions."""
    x, y, z = position_m
    return Pose((round(x / GRID_M) * GRID_M, round(y / GRID_M) * GRID_M, z), quat)


def _covered_m2(scene: Scene, host: SceneObject, surface: FreeSurface) -> float:
    """Return the area of a surface under the boxes of the scene's objects on it."""
    total: NDArray[np.float64] = np.zeros(())
    z = surface.pose.position_m[2]
    for item in scene.objects:
        if item.host == host.name:
            box = scene.box_of(item.name)
            if abs(box.low_m[2] - z) < 0.02:
                total = total + box.size_m[0] * box.size_m[1]
    return float(total)
