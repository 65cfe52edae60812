"""Does an asset stand where it is put? Asked of the real engine: two seconds on a floor."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from embomatrix.factory.assets.check import AssetFinding, Rule
from embomatrix.factory.assets.naming import FLAT_ON_WALL, HUNG, family_of
from embomatrix.sim.bullet.client import ClientPool
from embomatrix.sim.bullet.mini_world import MiniWorld
from embomatrix.world.geometry import Pose

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from embomatrix.world.asset import Asset
    from embomatrix.world.catalog import Catalog

STEPS: Final = 480
"""Two seconds at 240 Hz."""
GLANCE_STEPS: Final = 36
"""The shortest time that is worth a look: what rests by then is taken to stand."""
FLOOR_M: Final = 6.0
"""Side of the engine's floor: what is larger would hang over it."""
ROD_M: Final = 0.02
"""A rod thinner than this lies on any of its sides."""
LIFT_M: Final = 5e-4
MOVED_M: Final = 0.01
TILT_DEG: Final = 3.0
SHEET_SHARE: Final = 0.025
"""A sheet whose thickness is less than this share of its height stands because it is fixed: walls, panels, fences."""


def check_standing(
    catalog: Catalog, assets: Iterable[Asset], least_steps: int = STEPS
) -> Iterator[AssetFinding]:
    """Let each asset go on a floor, doors shut, and yield a finding for each that moves, tips or does not come to rest.

    With fewer ``least_steps``, at least `GLANCE_STEPS`, a thing that is slow by then is watched no further. Excused is what
    hangs, what is larger than the floor, and rods that roll over. Raises EngineMissingError where pybullet is missing.
    """
    pool = ClientPool()
    world = MiniWorld(pool)
    try:
        for asset in assets:
            excuse = _excuse(catalog, asset)
            problem = "" if excuse else _let_go(world, asset, least_steps)
            if excuse or problem:
                yield AssetFinding(asset.asset_id, Rule.STANDS, excuse or problem, excused=bool(excuse))
    finally:
        world.close()
        pool.close()


def _excuse(catalog: Catalog, asset: Asset) -> str:
    if family_of(catalog, asset.category) in HUNG or asset.category in FLAT_ON_WALL:
        return "hangs on a wall or from a ceiling, or stands in one"
    if max(asset.size_m[:2]) > FLOOR_M:
        return f"is larger than the floor of {FLOOR_M:g} m that it would stand on"
    if min(asset.size_m[:2]) < SHEET_SHARE * asset.size_m[2]:
        return "is a sheet on edge, which is fixed where it stands"
    if sorted(asset.size_m)[1] < ROD_M:
        return f"is a rod thinner than {ROD_M * 1000:g} mm, which lies on any of its sides"
    return ""


def _let_go(world: MiniWorld, asset: Asset, least_steps: int) -> str:
    """What is wrong with where the asset ends up; empty when it stands."""
    pose = Pose((0.0, 0.0, asset.size_m[2] / 2 + LIFT_M))
    world.stage(asset, pose, [0.0] * len(asset.joints), [])
    settled = world.drop(pose, STEPS, least_steps)
    tilt = math.degrees(settled.tilt_rad)
    if settled.moved_m > MOVED_M or tilt > TILT_DEG:
        return f"moved {settled.moved_m * 1000:.0f} mm and leans {tilt:.1f} degrees"
    return "" if settled.at_rest else f"is not at rest after {STEPS / 240:.0f} s"
