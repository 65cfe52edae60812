"""Doors, drawers and lids: where they swing, what rides on them, and what stops them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from embomatrix.sim.engine import FLOOR, WALL
from embomatrix.sim.geometry.bounds import bounds_of, parts_of
from embomatrix.sim.geometry.surfaces import link_frame
from embomatrix.world.geometry import Aabb

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from embomatrix.sim.engine import PhysicsEngine
    from embomatrix.sim.state.relations import Relations
    from embomatrix.world.geometry import Pose

LEAF_SLACK_M: Final = 0.02
"""What is further than this from the boxes of all leaves is not looked at."""

HALVINGS: Final = 7
"""A leaf that is let go on stops within this many halvings of its last step: a door of half a metre within 2 mm."""


@dataclass(frozen=True, slots=True)
class Rider:
    """An object that moves along with a link; its pose before, and in the frame of the link."""

    name: str
    link: str
    before: Pose
    pose_link_object: Pose


def swing_leaves(engine: PhysicsEngine, relations: Relations, name: str, shares: Sequence[float]) -> None:
    """Lead all leaves of an object through shares of their travel, with what rides on them, as far as there is room."""
    Leaves(engine, relations, name).swing([(share,) * len(engine.joints(name)) for share in shares])


class Leaves:
    """The moving links of one object, with all that rests on or lies in them."""

    def __init__(self, engine: PhysicsEngine, relations: Relations, name: str) -> None:
        self._engine = engine
        self._name = name
        self._asset = engine.scene.asset_of(name)
        self._base = engine.pose(name)
        self._before = engine.joints(name)
        self._riders = tuple(self._riders_of(relations))
        self._contacts: dict[str, frozenset[str]] = {}
        self._around: frozenset[str] = frozenset()

    @property
    def riders(self) -> tuple[str, ...]:
        """Names of the objects that move along."""
        return tuple(rider.name for rider in self._riders)

    def carried(self, fractions: Sequence[float]) -> tuple[tuple[str, Pose], ...]:
        """Where the riders are when the leaves are at these shares of their travel."""
        return tuple((rider.name, self._carried(rider, fractions)) for rider in self._riders)

    def swing(self, course: Iterable[Sequence[float]]) -> tuple[int, str]:
        """Go through joint positions until something is in the way.

        Returns how many of them were reached, and what stopped the next: the name of a body, or of the rider that bumped
        into something; "" at the end of the course. The leaves stay at the last that was reached.
        """
        stops = [self._before, *map(tuple, course)]
        self._around = self._neighbours(stops)
        reached, last = 0, self._before
        for fractions in stops[1:]:
            near = self._near_leaves(fractions)
            if near or self._riders:
                self._put(fractions)
                other = self._stopped_by(near)
                if other:
                    self._put(last)
                    return reached, other
            reached, last = reached + 1, fractions
        self._put(last)
        return reached, ""

    def go_on(self, free: Sequence[float], barred: Sequence[float]) -> None:
        """After a swing: from joint positions that it reached, go as far towards those that it did not as there is room."""
        low, high = 0.0, 1.0
        for _ in range(HALVINGS):
            middle = (low + high) / 2
            fractions = [one + middle * (other - one) for one, other in zip(free, barred, strict=True)]
            near = self._near_leaves(fractions)
            self._put(fractions)
            low, high = (low, middle) if self._stopped_by(near) else (middle, high)
        self._put([one + low * (other - one) for one, other in zip(free, barred, strict=True)])

    def put_back(self) -> None:
        """Undo the swing, to the bit."""
        self._put(self._before)
        for rider in self._riders:
            self._engine.set_pose(rider.name, rider.before)

    def _put(self, fractions: Sequence[float]) -> None:
        self._engine.set_joints(self._name, fractions)
        for name, pose in self.carried(fractions):
            self._engine.set_pose(name, pose)

    def _carried(self, rider: Rider, fractions: Sequence[float]) -> Pose:
        return link_frame(self._asset, self._base, fractions, rider.link) @ rider.pose_link_object

    def _stopped_by(self, near: frozenset[str]) -> str:
        """A body that the leaves or their riders run into where they are; "" when there is none."""
        riders = frozenset(self.riders)
        # Most of what stands in and on the furniture is near to no leaf: it is out of their way.
        hit = self._hits(self._name, riders | (self._around - near))
        if hit:
            return hit
        # For a rider the furniture itself counts: what sticks out of a drawer keeps it from closing.
        return next((name for name in self.riders if self._hits(name, riders - {name})), "")

    def _hits(self, name: str, ignore: frozenset[str]) -> str:
        """A body that the object penetrates and did not before; "" when there is none."""
        if not self._engine.penetrates(name, ignore=ignore):
            return ""
        return self._engine.penetrates(name, ignore=ignore | self._contacts_of(name))

    def _neighbours(self, stops: Sequence[Sequence[float]]) -> frozenset[str]:
        """Objects near the furniture as it swings from stop to stop."""
        bounds = bounds_of(self._asset)
        swept = Aabb.around(bounds.box(self._base, fractions) for fractions in stops)
        return frozenset(self._engine.near(swept.grown(LEAF_SLACK_M), frozenset((self._name,))))

    def _near_leaves(self, fractions: Sequence[float]) -> frozenset[str]:
        """Objects, walls and floor that some leaf comes near to at these joint positions."""
        engine, near = self._engine, set[str]()
        for leaf in parts_of(self._asset).leaves(self._base, fractions):
            box = leaf.grown(LEAF_SLACK_M)
            near.update(engine.near(box))
            if leaf.low_m[2] < 0.0:
                near.add(FLOOR)
            if engine.is_at_wall(box):
                near.add(WALL)
        return frozenset(near - {self._name})

    def _contacts_of(self, name: str) -> frozenset[str]:
        """Bodies that the object penetrated before anything moved: built-in neighbours, not in the way of a door."""
        if name not in self._contacts:
            now = self._engine.joints(self._name)
            self.put_back()
            found: set[str] = set()
            while other := self._engine.penetrates(name, ignore=frozenset(found)):
                found.add(other)
            self._contacts[name] = frozenset(found)
            self._put(now)
        return self._contacts[name]

    def _riders_of(self, relations: Relations) -> Iterable[Rider]:
        """What rests on or lies in a moving link, and what rests on or in that."""
        links = {surface.name: surface.link for surface in self._asset.supports if surface.link}
        links |= {interior.name: interior.link for interior in self._asset.interiors if interior.link}
        if not links:
            return
        seen = {self._name}
        waiting = [(other, "") for other in relations.resting_on(self._name)]
        while waiting:
            other, link = waiting.pop(0)
            host = relations.host_of(other)
            if not link and host is not None:
                link = links.get(host.spot, "")
            if not link or other in seen or self._engine.scene.by_name[other].fixed:
                continue
            seen.add(other)
            frame = link_frame(self._asset, self._base, self._before, link)
            pose = self._engine.pose(other)
            yield Rider(other, link, pose, frame.inverse() @ pose)
            waiting += [(item, link) for item in relations.resting_on(other)]


def measure_swing(engine: PhysicsEngine, name: str, shares: Iterable[float]) -> None:
    """Measure an object with all its joints at each of these shares of their travel, so that a swing finds it done."""
    asset, pose = engine.scene.asset_of(name), engine.pose(name)
    for share in shares:
        fractions = (share,) * len(asset.joints)
        bounds_of(asset).box(pose, fractions)
        parts_of(asset).leaves(pose, fractions)
