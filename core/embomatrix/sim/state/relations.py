"""Spatial relations between the objects of a live engine, over the geometry of ``surfaces``.

A parked object has no relations.
"""

import math
from typing import Final

from embomatrix.sim.engine import PhysicsEngine
from embomatrix.sim.geometry.bounds import bounds_of
from embomatrix.sim.geometry.surfaces import REST_M, heights_over, is_under
from embomatrix.sim.state.supports import Enclosure, Host, SupportTracker
from embomatrix.world.geometry import Aabb
from embomatrix.world.state import OPEN_FRACTION, Relation

TOUCH_M: Final = 0.005
NEXT_SHARE: Final = 1 / 6
"""Two objects are next to each other within this share of the mean of their six extents: OmniGibson's rule."""
NEXT_MIN_M: Final = 0.05
NEXT_MAX_M: Final = 0.5


class Relations:
    """Relations between the objects of an engine at the moment of the call.

    An object's support follows from it and its neighbours alone; answers are cached until one of these changes. Unknown object
    names raise EngineError.
    """

    def __init__(self, engine: PhysicsEngine) -> None:
        self._engine = engine
        self._scene = engine.scene
        self.supports = SupportTracker(engine)
        self._hosts_at_start: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {}
        """Chain of each object with its hosts, and of its hosts alone, in the scene as loaded."""
        self._resting: dict[str, tuple[str, ...]] = {}
        self._groups: dict[str, tuple[str, ...]] = {}
        """Answers that last until the next change."""
        self._answered_at = (-1, 0)

    def holds(self, relation: Relation, a: str, b: str) -> bool:
        """Return True if ``relation(a, b)`` holds; ``b`` is a room for INROOM and an object otherwise.

        An object is in the room under its centre; in a wall, the first room within 15 cm counts.
        """
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
                return not self._engine.is_parked(a) and self.room_of(a) == b

    def ontop(self, a: str, b: str) -> bool:
        """Return True if ``a`` rests on a surface of ``b``: underside within 1 cm, centre above the rectangle (+ 5 mm).

        Shelf boards count. Floors of cavities do not: an object in a bowl or a fridge is inside, and never on top as well.
        """
        return self._apart(a, b) and self.supports.is_on(a, b)

    def inside(self, a: str, b: str) -> bool:
        """Return True if the centre of ``a`` lies in a cavity of ``b`` and its box within the cavity, 1 cm outside allowed.

        An object in an open cavity may stick out at the top. The relation holds through nested containers.
        """
        return self._apart(a, b) and self.supports.is_in(a, b)

    def under(self, a: str, b: str) -> bool:
        """Return True if parts of ``b`` lie over the centre of ``a`` and all of these begin above its top, 1 cm tolerance.

        Centre and top are those of ``a`` with its joints shut: an open door moves nothing out from under a shelf. A roof ends
        the relation: an object in the oven is not under the worktop, one on a shelf not under a vase on the bookcase.
        """
        if not self._apart(a, b):
            return False
        box, asset, pose = self.body(a), self._scene.asset_of(b), self._engine.pose(b)
        if not is_under(box, asset, pose):
            return False
        height_m = min(heights_over(box, asset, pose))
        around = {item.name for item in self.enclosing(a)} | set(self.hosts_of(a))
        return not any(self._roof_m(box, name) < height_m for name in around - {b})

    def _roof_m(self, box: Aabb, name: str) -> float:
        """Height of the lowest part of an object over a box; infinite for none."""
        heights = heights_over(box, self._scene.asset_of(name), self._engine.pose(name))
        return min((height for height in heights if height >= box.high_m[2] - REST_M), default=math.inf)

    def nextto(self, a: str, b: str) -> bool:
        """Return True if two objects stand side by side with a small gap: heights overlap, neither centre is over the other.

        A small gap is a sixth of the mean of their six extents, at least 5 cm and at most 50 cm.
        """
        if not self._apart(a, b):
            return False
        box_a, box_b = self._engine.aabb(a), self._engine.aabb(b)
        if box_a.low_m[2] >= box_b.high_m[2] or box_b.low_m[2] >= box_a.high_m[2]:
            return False
        if _over(box_a, box_b) or _over(box_b, box_a):
            return False
        return self._engine.gap(a, b, next_gap_m(box_a, box_b)) is not None

    def touching(self, a: str, b: str) -> bool:
        """Return True if two surfaces are 5 mm apart or less."""
        return self._apart(a, b) and self._engine.gap(a, b, TOUCH_M) is not None

    def open(self, a: str) -> bool:
        """Return True if any joint of ``a`` is beyond 5 % of its travel."""
        return max(self._engine.joints(a), default=0.0) > OPEN_FRACTION

    def body(self, name: str) -> Aabb:
        """Box of the object with its joints shut: an open door does not change the distance to the object."""
        fractions = self._engine.joints(name)
        if not any(fractions):
            return self._engine.aabb(name)
        return bounds_of(self._scene.asset_of(name)).box(self._engine.pose(name), (0.0,) * len(fractions))

    def room_of(self, name: str) -> str:
        """Room under the object's centre; "" outside all rooms."""
        return self._scene.room_at(self.body(name).center_m)

    def host_of(self, name: str) -> Host | None:
        """Object that this one rests on or in; None on the floor, at a wall or in the hand.

        Of several hosts the smallest counts: food on a plate on a table is on the plate. A cavity takes precedence over a
        surface.
        """
        return self.supports.of(name).host

    def hosts_of(self, name: str) -> tuple[str, ...]:
        """Chain of hosts: the object's host, that one's host, and so on."""
        known = self._hosts_at_start.get(name)
        if known is not None and self.supports.are_untouched(known[0]):
            return known[1]
        chain = [name]
        while (host := self.host_of(chain[-1])) is not None and host.name not in chain:
            chain.append(host.name)
        if known is None and self.supports.are_untouched(chain):
            self._hosts_at_start[name] = tuple(chain), tuple(chain[1:])
        return tuple(chain[1:])

    def are_untouched(self, name: str) -> bool:
        """Return True if the object and its hosts have certainly not changed since loading."""
        known = self._hosts_at_start.get(name)
        return known is not None and self.supports.are_untouched(known[0])

    def resting_on(self, name: str) -> tuple[str, ...]:
        """Objects with this host, in scene order: on its surfaces and in its cavities."""
        self._forget_if_changed()
        found = self._resting.get(name)
        if found is None:
            found = self._resting[name] = self._find_resting(name)
        return found

    def group_of(self, name: str) -> tuple[str, ...]:
        """Object and all that moves with it: the contents of its cavities and what rests on or in those."""
        self._forget_if_changed()
        found = self._groups.get(name)
        if found is None:
            found = self._groups[name] = self._find_group(name)
        return found

    def _forget_if_changed(self) -> None:
        journal = self._engine.journal
        now = journal.rounds, len(journal.entries)
        if now != self._answered_at:
            self._answered_at = now
            self._resting.clear()
            self._groups.clear()

    def _find_resting(self, name: str) -> tuple[str, ...]:
        if self._engine.is_parked(name):
            return ()
        around = self._engine.near(self._engine.aabb(name).grown(REST_M), frozenset((name,)))
        hosts = ((other, self.host_of(other)) for other in around)
        return tuple(other for other, host in hosts if host is not None and host.name == name)

    def _find_group(self, name: str) -> tuple[str, ...]:
        group = {name: None}
        waiting = [other for other in self.resting_on(name) if self._lies_in_host(other)]
        while waiting:
            other = waiting.pop(0)
            if other not in group:
                group[other] = None
                waiting.extend(self.resting_on(other))
        return tuple(group)

    def enclosing(self, name: str) -> tuple[Enclosure, ...]:
        """Containers around the object, innermost first."""
        return self.supports.of(name).enclosures

    def _lies_in_host(self, name: str) -> bool:
        host = self.host_of(name)
        return host is not None and host.relation is Relation.INSIDE

    def _apart(self, a: str, b: str) -> bool:
        """Return True if both objects are in the world and differ."""
        return a != b and not self._engine.is_parked(a) and not self._engine.is_parked(b)


def next_gap_m(a: Aabb, b: Aabb) -> float:
    """Return the largest gap at which objects with these boxes are next to each other."""
    mean = (sum(a.size_m) + sum(b.size_m)) / 6
    return min(max(mean * NEXT_SHARE, NEXT_MIN_M), NEXT_MAX_M)


def _over(a: Aabb, b: Aabb) -> bool:
    """Return True if the centre of ``a`` is over or under ``b``."""
    x, y, _ = a.center_m
    return b.low_m[0] <= x <= b.high_m[0] and b.low_m[1] <= y <= b.high_m[1]
