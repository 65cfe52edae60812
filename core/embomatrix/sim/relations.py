"""Spatial relations, read from metric state: one definition each, with its tolerance.

The functions take geometry and serve the offline sampling too; ``Relations`` asks them of a live engine. A parked object
stands in no relation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from embomatrix.sim.bounds import AssetBounds
from embomatrix.world.geometry import Aabb, Pose
from embomatrix.world.state import OPEN_FRACTION, Relation

if TYPE_CHECKING:
    from collections.abc import Sequence

    from embomatrix.sim.engine import PhysicsEngine
    from embomatrix.world.asset import Asset, Interior, SupportSurface

REST_M: Final = 0.01
"""An underside this near to a surface rests on it."""
EDGE_M: Final = 0.005
"""A centre may lie this far outside the rectangle of its surface."""
INSIDE_M: Final = 0.01
"""A box may reach this far out of the cavity that it is in."""
TOUCH_M: Final = 0.005
NEXT_SHARE: Final = 1 / 6
"""Things are next to each other within this share of the mean of their six extents: OmniGibson's rule."""
NEXT_MIN_M: Final = 0.05
NEXT_MAX_M: Final = 0.5
UPRIGHT_COSINE: Final = math.cos(math.radians(10.0))
"""Nothing rests on or in a thing whose vertical axis leans more than 10 degrees, nor is under it."""
TOP: Final = "top of the box"
"""Name of the surface that every asset has: the top of its bounding box."""


@dataclass(frozen=True, slots=True)
class Host:
    """What an object rests on or in. ``spot`` names the support surface or the interior."""

    name: str
    relation: Relation
    spot: str


@dataclass(frozen=True, slots=True)
class Enclosure:
    """A container around an object: ``closed`` when every joint that bars the way in is shut, and there is one."""

    name: str
    interior: str
    closed: bool


def is_upright(pose: Pose) -> bool:
    """Whether the vertical axis leans by 10 degrees or less."""
    x, y, _, _ = pose.quat_xyzw
    return 1 - 2 * (x * x + y * y) >= UPRIGHT_COSINE


def is_shut(asset: Asset, interior: Interior, fractions: Sequence[float]) -> bool:
    """Whether every joint that bars the way into the interior is shut. One open door of two is a way in."""
    positions = {name: fraction for (name, _), fraction in zip(asset.joints, fractions, strict=True)}
    barring = [positions[name] for name in interior.closed_by if name in positions]
    return bool(barring) and all(position <= OPEN_FRACTION for position in barring)


def surface_under(box: Aabb, asset: Asset, pose: Pose, *, doored: bool) -> str:
    """Name of the surface of an asset at ``pose`` that a box rests on, "" when there is none.

    Its underside lies within 1 cm of the surface's height and its centre above the rectangle, 5 mm outside allowed, so a thin
    thing beside another is not on it.
    Surfaces are the asset's supports and the top of its bounding box; those within a cavity that can be shut only
    when ``doored``.
    """
    if not is_upright(pose):
        return ""
    x, y, _ = pose.inverse().apply(box.center_m)
    bottom, middle = (height - pose.position_m[2] for height in (box.low_m[2], box.center_m[2]))
    shut_off = {interior.name for interior in asset.interiors if interior.closed_by}
    for surface in asset.supports:
        if (
            middle > surface.center_m[2]
            and (doored or surface.interior not in shut_off)
            and _on_rectangle(x, y, bottom, surface)
        ):
            return surface.name
    half_x, half_y, half_z = (extent / 2 for extent in asset.size_m)
    above = abs(x) <= half_x + EDGE_M and abs(y) <= half_y + EDGE_M
    return TOP if above and middle > half_z and abs(bottom - half_z) <= REST_M else ""


def _on_rectangle(x: float, y: float, bottom: float, surface: SupportSurface) -> bool:
    cx, cy, cz = surface.center_m
    sx, sy = surface.size_m
    return abs(bottom - cz) <= REST_M and abs(x - cx) <= sx / 2 + EDGE_M and abs(y - cy) <= sy / 2 + EDGE_M


def interior_around(box_in_asset: Aabb, asset: Asset) -> Interior | None:
    """The smallest interior of an asset that a box, given in the asset's frame, is in.

    The box's centre lies in the cavity, and the box within it, 1 cm outside allowed; out of a cavity that is always open
    it may stick out at the top.
    """
    found = [interior for interior in asset.interiors if _within(box_in_asset, interior)]
    return min(found, key=lambda interior: math.prod(interior.size_m), default=None)


def _within(box: Aabb, interior: Interior) -> bool:
    low = tuple(c - s / 2 for c, s in zip(interior.center_m, interior.size_m, strict=True))
    high = tuple(c + s / 2 for c, s in zip(interior.center_m, interior.size_m, strict=True))
    if not all(lo <= c <= hi for lo, c, hi in zip(low, box.center_m, high, strict=True)):
        return False
    if any(edge < lo - INSIDE_M for edge, lo in zip(box.low_m, low, strict=True)):
        return False
    bounded = 3 if interior.closed_by else 2
    return all(box.high_m[axis] <= high[axis] + INSIDE_M for axis in range(bounded))


def is_under(box: Aabb, asset: Asset, pose: Pose) -> bool:
    """Whether a box is under an asset at ``pose``.

    Some part of the asset's base lies over the box's centre, and every part that does so begins above the box's top, 1 cm
    deeper allowed.
    """
    if not is_upright(pose):
        return False
    cx, cy, _ = box.center_m
    over = [
        part_box.low_m[2]
        for part_box in (part.aabb(pose) for part in asset.links[0].parts)
        if part_box.low_m[0] <= cx <= part_box.high_m[0] and part_box.low_m[1] <= cy <= part_box.high_m[1]
    ]
    return bool(over) and all(bottom >= box.high_m[2] - REST_M for bottom in over)


class Relations:
    """The relations between the objects of an engine, as they are at the moment of the call.

    Object names that the engine does not know raise EngineError.
    """

    def __init__(self, engine: PhysicsEngine) -> None:
        self._engine = engine
        self._scene = engine.scene
        self._bounds = {key: AssetBounds(asset) for key, asset in engine.scene.assets.items()}

    def holds(self, relation: Relation, a: str, b: str) -> bool:
        """Whether ``relation(a, b)`` holds; ``b`` is a room for INROOM and an object otherwise."""
        match relation:
            case Relation.ONTOP:
                return self.ontop(a, b)
            case Relation.INSIDE:
                return self.inside(a, b)
            case Relation.UNDER:
                return self.under(a, b)
            case Relation.NEXTTO:
                return self.nextto(a, b)
            case Relation.TOUCHING:
                return self.touching(a, b)
            case Relation.INROOM:
                return self.inroom(a, b)

    def ontop(self, a: str, b: str) -> bool:
        """``a`` rests on a surface of ``b``: underside within 1 cm of it, centre above its rectangle (5 mm outside allowed).

        Open shelf boards and the bottoms of bowls count, boards behind a door do not: what lies there is inside.
        """
        return self._apart(a, b) and bool(self._surface(a, b, doored=False))

    def inside(self, a: str, b: str) -> bool:
        """The centre of ``a`` lies in a cavity of ``b``, and its box within the cavity, 1 cm outside allowed.

        What stands in an open cavity may stick out at the top. Holds through nested containers.
        """
        return self._apart(a, b) and self._interior(a, b) is not None

    def under(self, a: str, b: str) -> bool:
        """Some part of ``b`` lies over the centre of ``a``, and all that do begin above its top, 1 cm deeper allowed."""
        if not self._apart(a, b):
            return False
        return is_under(self._engine.aabb(a), self._scene.asset_of(b), self._engine.pose(b))

    def nextto(self, a: str, b: str) -> bool:
        """Side by side: their heights overlap, neither's centre is over the other, and the gap between them is small.

        Small is a sixth of the mean of their six extents, but at least 5 cm and at most 50 cm.
        """
        if not self._apart(a, b):
            return False
        box_a, box_b = self._engine.aabb(a), self._engine.aabb(b)
        if box_a.low_m[2] >= box_b.high_m[2] or box_b.low_m[2] >= box_a.high_m[2]:
            return False
        if _over(box_a, box_b) or _over(box_b, box_a):
            return False
        mean = (sum(box_a.size_m) + sum(box_b.size_m)) / 6
        limit = min(max(mean * NEXT_SHARE, NEXT_MIN_M), NEXT_MAX_M)
        return self._engine.gap(a, b, limit) is not None

    def touching(self, a: str, b: str) -> bool:
        """Their surfaces are 5 mm apart or less."""
        return self._apart(a, b) and self._engine.gap(a, b, TOUCH_M) is not None

    def inroom(self, a: str, room: str) -> bool:
        """The centre of ``a`` is over the floor of the room; in a wall, of the first room within 15 cm."""
        return not self._engine.is_parked(a) and self.room_of(a) == room

    def open(self, a: str) -> bool:
        """Any joint of ``a`` is past 5 % of its travel."""
        return any(fraction > OPEN_FRACTION for fraction in self._engine.joints(a))

    def body(self, name: str) -> Aabb:
        """Box of the object with its joints shut: an open door neither brings it nearer nor pushes the robot away."""
        shut = (0.0,) * len(self._engine.joints(name))
        return self._bounds[self._scene.by_name[name].asset_id].box(self._engine.pose(name), shut)

    def room_of(self, name: str) -> str:
        """Room that the object's centre is over, "" when it is in none."""
        return self._scene.room_at(self.body(name).center_m)

    def host_of(self, name: str) -> Host | None:
        """What the object rests on or in; None on the floor, at a wall or in the hand.

        Of several, the smallest: food on a plate on a table is on the plate. Lying in a cavity goes before resting on a
        surface.
        """
        if self._engine.is_parked(name):
            return None
        found: list[tuple[float, Host]] = []
        for other in self._engine.near(_grown(self._engine.aabb(name), REST_M), frozenset((name,))):
            interior = self._interior(name, other)
            if interior is not None:
                found.append((self._volume(other), Host(other, Relation.INSIDE, interior.name)))
            elif surface := self._surface(name, other, doored=True):
                found.append((self._volume(other), Host(other, Relation.ONTOP, surface)))
        return min(found, key=lambda item: (item[0], item[1].name))[1] if found else None

    def resting_on(self, name: str) -> tuple[str, ...]:
        """Objects whose host is this one, in scene order: on its surfaces and in its cavities."""
        if self._engine.is_parked(name):
            return ()
        around = self._engine.near(_grown(self._engine.aabb(name), REST_M), frozenset((name,)))
        return tuple(other for other in around if self._is_host(name, other))

    def group_of(self, name: str) -> tuple[str, ...]:
        """The object and all that moves along with it: what lies in its cavities, and what rests on or in that."""
        group = {name: None}
        waiting = [other for other in self.resting_on(name) if self._lies_in(other, name)]
        while waiting:
            other = waiting.pop(0)
            if other not in group:
                group[other] = None
                waiting += self.resting_on(other)
        return tuple(group)

    def enclosing(self, name: str) -> tuple[Enclosure, ...]:
        """Containers around the object, the innermost first."""
        if self._engine.is_parked(name):
            return ()
        found: list[tuple[float, Enclosure]] = []
        for other in self._engine.near(self._engine.aabb(name), frozenset((name,))):
            interior = self._interior(name, other)
            if interior is not None:
                asset = self._scene.asset_of(other)
                closed = is_shut(asset, interior, self._engine.joints(other))
                found.append((math.prod(interior.size_m), Enclosure(other, interior.name, closed)))
        return tuple(item for _, item in sorted(found, key=lambda pair: (pair[0], pair[1].name)))

    def _lies_in(self, name: str, container: str) -> bool:
        host = self.host_of(name)
        return host is not None and host.name == container and host.relation is Relation.INSIDE

    def _is_host(self, name: str, other: str) -> bool:
        host = self.host_of(other)
        return host is not None and host.name == name

    def _apart(self, a: str, b: str) -> bool:
        """Whether both are in the world, and two: nothing stands in a relation to itself."""
        return a != b and not self._engine.is_parked(a) and not self._engine.is_parked(b)

    def _surface(self, a: str, b: str, *, doored: bool) -> str:
        return surface_under(
            self._engine.aabb(a), self._scene.asset_of(b), self._engine.pose(b), doored=doored
        )

    def _interior(self, a: str, b: str) -> Interior | None:
        asset = self._scene.asset_of(b)
        pose = self._engine.pose(b)
        if not asset.interiors or not is_upright(pose):
            return None
        bounds = self._bounds[self._scene.by_name[a].asset_id]
        return interior_around(
            bounds.box(pose.inverse() @ self._engine.pose(a), self._engine.joints(a)), asset
        )

    def _volume(self, name: str) -> float:
        return math.prod(self._scene.asset_of(name).size_m)


def _grown(box: Aabb, margin_m: float) -> Aabb:
    (a, b, c), (d, e, f) = box.low_m, box.high_m
    return Aabb((a - margin_m, b - margin_m, c - margin_m), (d + margin_m, e + margin_m, f + margin_m))


def _over(a: Aabb, b: Aabb) -> bool:
    """Whether the centre of ``a`` is over or under ``b``."""
    x, y, _ = a.center_m
    return b.low_m[0] <= x <= b.high_m[0] and b.low_m[1] <= y <= b.high_m[1]
