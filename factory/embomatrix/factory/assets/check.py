"""Checks of assets: catalog size, usable cavities, doors that move freely, and standing upright in the engine.

`check_asset` uses geometry alone and takes about two milliseconds. `check_standing` drops the asset in the engine.
"""

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from embomatrix.factory.assets.families import Family
from embomatrix.factory.assets.library import FLAT_ON_WALL, HUNG, family_of, family_of_model
from embomatrix.factory.assets.solids import Convex, Solids, convex_of
from embomatrix.sim.bullet.client import ClientPool
from embomatrix.sim.bullet.mini_world import MiniWorld
from embomatrix.sim.geometry.bounds import joint_motion
from embomatrix.world.asset import Asset, Link
from embomatrix.world.catalog import Catalog
from embomatrix.world.geometry import IDENTITY, Aabb, Pose

SIZE_TOLERANCE: Final = 0.05
PROBE_M: Final = 0.03
"""Edge of the cube that the cavity of a fillable asset must hold."""
DEPTH_M: Final = 1e-4
"""Parts may touch; a deeper overlap is a collision."""
TRAVEL: Final = (0.0, 0.05, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9, 1.0)
"""Shares of the travel at which moving parts are tested."""


class AssetRule(StrEnum):
    """Requirement that an asset is checked against."""

    SIZE = "size"
    FILLABLE = "fillable"
    OPENABLE = "openable"
    STANDS = "stands"


@dataclass(frozen=True, slots=True)
class AssetFinding:
    """A violated rule. ``excused`` means that the rule does not apply, for the reason in ``detail``."""

    asset_id: str
    rule: AssetRule
    detail: str
    excused: bool = False


EXCUSED_FROM_PROBE: Final[Mapping[Family, str]] = {
    Family.BOTTLE: "a closed bottle: it is filled with substances, and its neck is narrower than the probe",
    Family.CAN: "a closed can or jar: it is filled with substances",
    Family.SLAB: "a closed carton or package: it is filled with substances",
    Family.SOFT: "a closed bag: it is filled with substances",
    Family.PLATE: "flat: objects lie on it, and it is filled with substances",
    Family.SHELVING: "open: objects stand on its boards",
    Family.TRAY: "flat: objects stand on it",
}
"""Families that have no cavity although their categories are fillable, with the reason."""


def check_asset(catalog: Catalog, asset: Asset) -> tuple[AssetFinding, ...]:
    """Return violations of the geometric rules, excused ones included; empty for most assets."""
    return (*_size(asset), *_fillable(catalog, asset), *_openable(asset))


def _size(asset: Asset) -> Iterator[AssetFinding]:
    box = Aabb.around(part.aabb(IDENTITY) for link in asset.links for part in link.parts)
    for axis, found, wanted in zip("xyz", box.size_m, asset.size_m, strict=True):
        if abs(found - wanted) > SIZE_TOLERANCE * wanted:
            yield AssetFinding(
                asset.asset_id,
                AssetRule.SIZE,
                f"{found:.4f} m along {axis}, the catalog has {wanted:.4f} m: expected within {SIZE_TOLERANCE:.0%}",
            )


def _fillable(catalog: Catalog, asset: Asset) -> Iterator[AssetFinding]:
    if not asset.can("fillable"):
        return
    widest = max((min(interior.size_m) for interior in asset.interiors), default=0.0)
    if widest >= PROBE_M:
        return
    model = asset.asset_id.removeprefix(f"{asset.category}-")
    family = family_of_model(catalog, asset.category, model)
    if not asset.interiors and family in EXCUSED_FROM_PROBE:
        yield AssetFinding(asset.asset_id, AssetRule.FILLABLE, EXCUSED_FROM_PROBE[family], excused=True)
        return
    # Walls take part of the box: an asset less than two probes wide may have no room for one.
    small = min(asset.size_m) < 2 * PROBE_M
    detail = f"its largest cavity is {widest:.3f} m wide, the probe {PROBE_M} m; the catalog's box is {asset.size_m} m"
    yield AssetFinding(asset.asset_id, AssetRule.FILLABLE, detail, excused=small)


def _openable(asset: Asset) -> Iterator[AssetFinding]:
    if asset.can("openable") != bool(asset.joints):
        yield AssetFinding(
            asset.asset_id,
            AssetRule.OPENABLE,
            "it is openable without a joint, or has a joint and is not openable",
        )
    base, moving = asset.links[0], asset.links[1:]
    shut = [_placed(link, 0.0) for link in moving]
    for share in TRAVEL if moving else ():
        placed = [_placed(link, share) for link in moving]
        for number, link in enumerate(moving):
            # Obstacles: the frame, later doors opened equally far, and all other doors shut.
            others = Solids()
            for parts in (_placed(base, 0.0), *placed[number + 1 :], *shut[:number], *shut[number + 1 :]):
                others.add("obstacle", parts)
            depth = others.overlaps(placed[number], tolerance_m=DEPTH_M).get("obstacle", 0.0)
            if depth > DEPTH_M:
                yield AssetFinding(
                    asset.asset_id,
                    AssetRule.OPENABLE,
                    f"{link.name} at {share:.0%} of its travel is {depth * 1000:.1f} mm deep in another part",
                )
                return


def _placed(link: Link, share: float) -> list[Convex]:
    motion = joint_motion(link.joint, share) if link.joint is not None else IDENTITY
    return [convex_of(part, motion) for part in link.parts]


STEPS: Final = 480
"""Two seconds at 240 Hz."""
GLANCE_STEPS: Final = 36
"""Shortest meaningful run: an asset that is at rest after it counts as standing."""
FLOOR_M: Final = 6.0
"""Side of the engine's floor: larger assets would stand over its edge."""
ROD_M: Final = 0.02
"""A thinner rod may come to rest on any of its sides."""
LIFT_M: Final = 5e-4
MOVED_M: Final = 0.01
TILT_DEG: Final = 3.0
SHEET_SHARE: Final = 0.025
"""A sheet thinner than this share of its height needs fixing to stand: walls, panels, fences."""


def check_standing(
    catalog: Catalog, assets: Iterable[Asset], least_steps: int = STEPS
) -> Iterator[AssetFinding]:
    """Drop each asset on a floor with its doors shut and yield a finding if it moves, tips or does not come to rest.

    A run ends early, after ``least_steps`` at the earliest, once the asset is slow. Hanging assets, assets larger than the
    floor, and rods that roll are excused. Raises EngineMissingError if pybullet is missing.
    """
    pool = ClientPool()
    world = MiniWorld(pool)
    try:
        for asset in assets:
            excuse = _excuse(catalog, asset)
            problem = "" if excuse else _let_go(world, asset, least_steps)
            if excuse or problem:
                yield AssetFinding(asset.asset_id, AssetRule.STANDS, excuse or problem, excused=bool(excuse))
    finally:
        world.close()
        pool.close()


def _excuse(catalog: Catalog, asset: Asset) -> str:
    if family_of(catalog, asset.category) in HUNG or asset.category in FLAT_ON_WALL:
        return "hangs on a wall or from a ceiling, or is set into one"
    if max(asset.size_m[:2]) > FLOOR_M:
        return f"is larger than the test floor of {FLOOR_M:g} m"
    if min(asset.size_m[:2]) < SHEET_SHARE * asset.size_m[2]:
        return "is a sheet on edge, which must be fixed to stand"
    if sorted(asset.size_m)[1] < ROD_M:
        return f"is a rod thinner than {ROD_M * 1000:g} mm, which lies on any of its sides"
    return ""


def _let_go(world: MiniWorld, asset: Asset, least_steps: int) -> str:
    """Return a sentence on how the asset fails to stand; empty if it stands."""
    pose = Pose((0.0, 0.0, asset.size_m[2] / 2 + LIFT_M))
    world.stage(asset, pose, [0.0] * len(asset.joints), [])
    settled = world.drop(pose, STEPS, least_steps)
    tilt = math.degrees(settled.tilt_rad)
    if settled.moved_m > MOVED_M or tilt > TILT_DEG:
        return f"moved {settled.moved_m * 1000:.0f} mm and leans {tilt:.1f} degrees"
    return "" if settled.at_rest else f"is not at rest after {STEPS / 240:.0f} s"
