"""Surfaces and cavities of an asset, with the tolerances of resting on them and lying in them.

Surfaces and cavities of a drawer or a door move with their link. They are defined with every joint at zero, so queries about
them use the link's frame. The frame of the base is the asset's own.
"""

import math
from collections.abc import Sequence
from typing import Final

from embomatrix.sim.geometry.bounds import bounds_of, joint_motion
from embomatrix.world.asset import Asset, Interior
from embomatrix.world.geometry import IDENTITY, Aabb, Pose
from embomatrix.world.state import OPEN_FRACTION, Relation

REST_M: Final = 0.01
"""An underside this near to a surface rests on it."""
EDGE_M: Final = 0.005
"""A centre may lie this far outside the rectangle of its surface."""
INSIDE_M: Final = 0.01
"""A box may reach this far out of its cavity."""
UPRIGHT_COSINE: Final = math.cos(math.radians(10.0))
"""Nothing rests on, in or counts as under an object whose vertical axis leans by more than 10 degrees."""
TOP: Final = "top of the box"
"""Name of the surface that every asset has: the top of its bounding box."""


def is_upright(pose: Pose) -> bool:
    """Return True if the vertical axis leans by 10 degrees or less."""
    x, y, _, _ = pose.quat_xyzw
    return 1 - 2 * (x * x + y * y) >= UPRIGHT_COSINE


def is_shut(asset: Asset, interior: Interior, fractions: Sequence[float]) -> bool:
    """Return True if every joint that closes the interior is shut. One open door of two is an opening."""
    positions = {name: fraction for (name, _), fraction in zip(asset.joints, fractions, strict=True)}
    barring = [positions[name] for name in interior.closed_by if name in positions]
    return bool(barring) and all(position <= OPEN_FRACTION for position in barring)


def link_frame(asset: Asset, pose: Pose, fractions: Sequence[float], link: str) -> Pose:
    """Frame of a link's contents for an asset at ``pose``: the asset's own for the base.

    It coincides with the asset's frame if the link's joint is at zero. Raises KeyError for a link that does not move.
    """
    if not link:
        return pose
    for (name, joint), fraction in zip(asset.joints, fractions, strict=True):
        if name == link:
            return pose @ joint_motion(joint, fraction) if fraction else pose
    raise KeyError(f"asset {asset.asset_id!r} has no moving link {link!r}: expected one of its joints' links")


def surface_under(
    box: Aabb, asset: Asset, pose: Pose, fractions: Sequence[float] = (), *, in_cavities: bool
) -> str:
    """Name of the surface of an asset at ``pose`` that a box rests on; "" for none.

    The box's underside lies within 1 cm of the surface and its centre above the rectangle, 5 mm outside allowed; a thin object
    beside another is not on it. Surfaces are the asset's supports at the current joint positions and the top of its bounding
    box; supports in cavities count only if ``in_cavities``. Without ``fractions`` the joints are shut.
    """
    if not is_upright(pose):
        return ""
    fractions = fractions or (0.0,) * len(asset.joints)
    bottom, center = box.low_m[2], box.center_m
    frames = {"": pose}
    for surface in asset.supports:
        frame = frames.get(surface.link)
        if frame is None:
            frame = frames[surface.link] = link_frame(asset, pose, fractions, surface.link)
        cx, cy, cz = surface.center_m
        if abs(bottom - frame.position_m[2] - cz) > REST_M or (surface.interior and not in_cavities):
            continue
        if center[2] - frame.position_m[2] <= cz or not is_upright(frame):
            continue
        x, y, _ = frame.inverse().apply(center)
        if abs(x - cx) <= surface.size_m[0] / 2 + EDGE_M and abs(y - cy) <= surface.size_m[1] / 2 + EDGE_M:
            return surface.name
    return TOP if _on_top(box, asset, pose) else ""


def _on_top(box: Aabb, asset: Asset, pose: Pose) -> bool:
    half_x, half_y, half_z = (extent / 2 for extent in asset.size_m)
    level = pose.position_m[2] + half_z
    if abs(box.low_m[2] - level) > REST_M or box.center_m[2] <= level:
        return False
    x, y, _ = pose.inverse().apply(box.center_m)
    return abs(x) <= half_x + EDGE_M and abs(y) <= half_y + EDGE_M


def interior_around(box_in_asset: Aabb, asset: Asset, link: str | None = None) -> Interior | None:
    """Smallest interior of an asset that contains a box: of one link's, or of all with the joints shut.

    The box is given in the link's frame; "" names the base. Its centre lies in the cavity, and the box within it, 1 cm outside
    allowed; out of an always open cavity it may stick out at the top.
    """
    found = [item for item in asset.interiors if link in (None, item.link) and _within(box_in_asset, item)]
    return min(found, key=lambda interior: math.prod(interior.size_m), default=None)


def _within(box: Aabb, interior: Interior) -> bool:
    for axis, (middle, extent) in enumerate(zip(interior.center_m, interior.size_m, strict=True)):
        low, high = middle - extent / 2, middle + extent / 2
        edge_low, edge_high = box.low_m[axis], box.high_m[axis]
        if not low <= (edge_low + edge_high) / 2 <= high or edge_low < low - INSIDE_M:
            return False
        if edge_high > high + INSIDE_M and (axis < 2 or interior.closed_by):
            return False
    return True


def links_with_surfaces(asset: Asset) -> set[str]:
    """Links with surfaces or cavities; "" for the base."""
    return {surface.link for surface in asset.supports} | {interior.link for interior in asset.interiors}


def link_under(box_in_asset: Aabb, asset: Asset, relation: Relation) -> str:
    """Link that carries a box in the relation to an asset with its joints shut; "" for the base."""
    if relation is Relation.INSIDE:
        interior = interior_around(box_in_asset, asset)
        return interior.link if interior is not None else ""
    if relation is Relation.ONTOP:
        surface = surface_under(box_in_asset, asset, IDENTITY, in_cavities=False)
        return next((item.link for item in asset.supports if item.name == surface), "")
    return ""


def is_under(box: Aabb, asset: Asset, pose: Pose) -> bool:
    """Return True if a box is under an asset at ``pose``.

    Parts of the asset's base lie over the box's centre, and all of these begin above the box's top, 1 cm deeper allowed.
    """
    over = heights_over(box, asset, pose)
    return bool(over) and all(bottom >= box.high_m[2] - REST_M for bottom in over)


def heights_over(box: Aabb, asset: Asset, pose: Pose) -> list[float]:
    """World heights at which the parts of an asset's base over or below a box's centre begin."""
    if not is_upright(pose):
        return []
    cx, cy, _ = box.center_m
    return [
        part_box.low_m[2]
        for part_box in bounds_of(asset).base_boxes(pose)
        if part_box.low_m[0] <= cx <= part_box.high_m[0] and part_box.low_m[1] <= cy <= part_box.high_m[1]
    ]
