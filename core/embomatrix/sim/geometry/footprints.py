"""Footprint classes: a solid box that represents every object which stands firmly within it.

Most pairs of an object and a support appear in no analysis. Two facts together give a pose for any pair: a box of the object's
size stands level and free there, and the object stands by itself on a level floor.
"""

import math
from dataclasses import dataclass
from typing import Final

from embomatrix.sim.geometry.bounds import bounds_of
from embomatrix.world.asset import Asset, Link
from embomatrix.world.geometry import IDENTITY, ConvexPart, Pose, Shape

SIDES_M: Final = (0.06, 0.09, 0.13, 0.19, 0.27, 0.38, 0.54)
"""Sides of footprints round up to these; each is about 40 % larger than the one before."""
HEIGHTS_M: Final = (0.06, 0.12, 0.24, 0.48)
DENSITY_KG_M3: Final = 300.0
"""Density of the boxes; weight has no influence on stability."""
LEVEL_FLOOR: Final = "level-floor"
"""Name of a level floor as a support in a pose cache: the poses in which objects stand by themselves."""


@dataclass(frozen=True, slots=True)
class Footprint:
    """Sides and height of a box, the long side first."""

    long_m: float
    short_m: float
    height_m: float

    @property
    def name(self) -> str:
        """Name of the class in a pose cache, in centimetres."""
        sides = "x".join(f"{value * 100:.0f}" for value in (self.long_m, self.short_m, self.height_m))
        return f"footprint-{sides}cm"


def footprint_of(asset: Asset, pose_floor_asset: Pose) -> Footprint | None:
    """Smallest class for the asset standing at a pose on a level floor; None if it is too large."""
    x, y, z = bounds_of(asset).box(pose_floor_asset).size_m
    sides = [_rounded_up(extent, SIDES_M) for extent in (max(x, y), min(x, y))]
    height = _rounded_up(z, HEIGHTS_M)
    if sides[0] is None or sides[1] is None or height is None:
        return None
    return Footprint(sides[0], sides[1], height)


def _rounded_up(value: float, steps: tuple[float, ...]) -> float | None:
    return next((step for step in steps if value <= step), None)


def box_of(footprint: Footprint) -> Asset:
    """Box of a class: its long side along x, its origin in the middle."""
    size = (footprint.long_m, footprint.short_m, footprint.height_m)
    box = ConvexPart(Shape.BOX, IDENTITY, size)
    mass_kg = DENSITY_KG_M3 * math.prod(size)
    return Asset(footprint.name, "footprint", "", size, mass_kg, (Link("base", (box,)),))


def pose_box_asset(footprint: Footprint, asset: Asset, pose_floor_asset: Pose) -> Pose:
    """Pose of an asset in the frame of its class's box: centred as on the floor, long side along the box's."""
    box = bounds_of(asset).box(pose_floor_asset)
    width, depth, _ = box.size_m
    turn = Pose.from_xyz_yaw(0.0, 0.0, -footprint.height_m / 2, 0.0 if width >= depth else math.pi / 2)
    x, y, _ = box.center_m
    return turn @ Pose((-x, -y, -box.low_m[2])) @ pose_floor_asset
