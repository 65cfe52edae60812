"""The sanity test of assets: are they of the catalog's size, do their cavities hold something, do their doors move freely?

`check_asset` looks at geometry alone and takes a millisecond or two; `settles` in ``standing`` asks the engine whether the
thing stands.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Final

import numpy as np

from embomatrix.factory.assets.families import Family
from embomatrix.factory.assets.library import FLAT_ON_WALL, HUNG, family_of, family_of_model
from embomatrix.factory.assets.shapes import mesh_of
from embomatrix.sim.bullet.client import ClientPool
from embomatrix.sim.bullet.mini_world import MiniWorld
from embomatrix.sim.geometry.bounds import IDENTITY, joint_motion
from embomatrix.world.geometry import Aabb, Pose, Shape

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from embomatrix.world.asset import Asset, Link
    from embomatrix.world.catalog import Catalog
    from embomatrix.world.geometry import ConvexPart, FloatArray

SIZE_TOLERANCE: Final = 0.05
PROBE_M: Final = 0.03
"""A thing that can be filled holds a cube of this edge."""
DEPTH_M: Final = 1e-4
"""Deeper than this is a collision; two parts may touch."""
TRAVEL: Final = (0.0, 0.05, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9, 1.0)
"""Shares of the travel at which moving parts are tested."""


class Rule(StrEnum):
    """What is asked of an asset."""

    SIZE = "size"
    FILLABLE = "fillable"
    OPENABLE = "openable"
    STANDS = "stands"


@dataclass(frozen=True, slots=True)
class AssetFinding:
    """A rule that an asset does not keep. ``excused`` tells that it need not, for the reason in ``detail``."""

    asset_id: str
    rule: Rule
    detail: str
    excused: bool = False


EXCUSED_FROM_PROBE: Final[Mapping[Family, str]] = {
    Family.BOTTLE: "a closed bottle: what it is filled with is a substance, and its neck is narrower than the probe",
    Family.CAN: "a closed can or jar: what it is filled with is a substance",
    Family.SLAB: "a closed carton or package: what it is filled with is a substance",
    Family.SOFT: "a closed bag: what it is filled with is a substance",
    Family.PLATE: "flat: things lie on it, and what it is filled with is a substance",
}
"""Families of fillable categories that have no cavity, and why."""


def check_asset(catalog: Catalog, asset: Asset) -> tuple[AssetFinding, ...]:
    """What is wrong with the geometry of an asset, and what is excused. Empty for most."""
    return (*_size(asset), *_fillable(catalog, asset), *_openable(asset))


def _size(asset: Asset) -> Iterator[AssetFinding]:
    box = Aabb.around(part.aabb(IDENTITY) for link in asset.links for part in link.parts)
    for axis, found, wanted in zip("xyz", box.size_m, asset.size_m, strict=True):
        if abs(found - wanted) > SIZE_TOLERANCE * wanted:
            yield AssetFinding(
                asset.asset_id,
                Rule.SIZE,
                f"{found:.4f} m along {axis}, the table has {wanted:.4f} m: expected within {SIZE_TOLERANCE:.0%}",
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
        yield AssetFinding(asset.asset_id, Rule.FILLABLE, EXCUSED_FROM_PROBE[family], excused=True)
        return
    # A cavity is as large as its box but for the walls: what is under two probes wide may be too small for one.
    small = min(asset.size_m) < 2 * PROBE_M
    detail = f"its largest cavity is {widest:.3f} m wide, the probe {PROBE_M} m; the table's box is {asset.size_m} m"
    yield AssetFinding(asset.asset_id, Rule.FILLABLE, detail, excused=small)


def _openable(asset: Asset) -> Iterator[AssetFinding]:
    if asset.can("openable") != bool(asset.joints):
        yield AssetFinding(
            asset.asset_id, Rule.OPENABLE, "openable without a joint, or a joint without being openable"
        )
    base, moving = asset.links[0], asset.links[1:]
    if not moving:
        return
    still = [_Solid.of(part) for part in base.parts]
    shut = [_moved(link, 0.0) for link in moving]
    for share in TRAVEL:
        placed = [_moved(link, share) for link in moving]
        for number, (link, parts) in enumerate(zip(moving, placed, strict=True)):
            # the frame, the doors that open with it, and those that stay shut
            others = [*still, *itertools.chain.from_iterable(placed[number + 1 :])]
            others += [part for k, parts_of in enumerate(shut) if k != number for part in parts_of]
            depth = max((_depth(a, b) for a, b in itertools.product(parts, others)), default=0.0)
            if depth > DEPTH_M:
                yield AssetFinding(
                    asset.asset_id,
                    Rule.OPENABLE,
                    f"{link.name} at {share:.0%} of its travel is {depth * 1000:.1f} mm deep in another part",
                )
                return


@dataclass(frozen=True, slots=True)
class _Solid:
    """A convex part in the asset's frame: corners (n, 3), face normals (m, 3), and the box around it."""

    corners: FloatArray
    normals: FloatArray
    low: FloatArray
    high: FloatArray

    @staticmethod
    def of(part: ConvexPart, motion: Pose = IDENTITY) -> _Solid:
        pose = motion @ part.pose
        if part.shape is Shape.BOX:
            normals = pose.rotation.T
            corners = pose.apply_all(_CUBE * np.asarray(part.size_m))
        else:
            mesh = mesh_of(part)
            normals = mesh.face_normals @ motion.rotation.T
            corners = motion.apply_all(np.asarray(mesh.vertices))
        return _Solid(corners, normals, corners.min(axis=0), corners.max(axis=0))


_CUBE: Final = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))


def _moved(link: Link, share: float) -> Sequence[_Solid]:
    assert link.joint is not None
    motion = joint_motion(link.joint, share)
    return [_Solid.of(part, motion) for part in link.parts]


def _depth(a: _Solid, b: _Solid) -> float:
    """Least overlap along the face normals of both: never less than the true depth of penetration."""
    if (a.low > b.high).any() or (b.low > a.high).any():
        return 0.0
    axes = np.vstack((a.normals, b.normals))
    of_a, of_b = a.corners @ axes.T, b.corners @ axes.T
    overlap = np.minimum(of_a.max(axis=0) - of_b.min(axis=0), of_b.max(axis=0) - of_a.min(axis=0))
    return max(0.0, float(overlap.min()))


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
