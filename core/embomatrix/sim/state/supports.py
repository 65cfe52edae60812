"""Support of objects by their neighbours, cached until something near them changes."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

from embomatrix.sim.caches import BoundedCache
from embomatrix.sim.engine import PhysicsEngine
from embomatrix.sim.geometry.bounds import ASSETS_KEPT, bounds_of, square_box
from embomatrix.sim.geometry.surfaces import (
    REST_M,
    interior_around,
    is_shut,
    is_upright,
    link_frame,
    surface_under,
)
from embomatrix.world.asset import Asset, Interior
from embomatrix.world.geometry import Aabb, Pose, Vec3
from embomatrix.world.state import Relation

SLACK_M: Final = 0.05


@dataclass(frozen=True, slots=True)
class AssetCavities:
    """Cavities of an asset by the link that carries them, and a width that no object inside one has."""

    by_link: tuple[tuple[str, tuple[Interior, ...]], ...]
    too_wide_m: float


@dataclass(frozen=True, slots=True)
class Host:
    """Object that another one rests on or in. ``spot`` names the support surface or the interior."""

    name: str
    relation: Relation
    spot: str


@dataclass(frozen=True, slots=True)
class Enclosure:
    """Container around an object; ``closed`` if it has joints that close it and all are shut."""

    name: str
    interior: str
    closed: bool


@dataclass(frozen=True, slots=True)
class SupportState:
    """Support of an object: its host, the containers around it, and the objects that it is on top of."""

    host: Host | None = None
    enclosures: tuple[Enclosure, ...] = ()
    on: frozenset[str] = frozenset()


UNSUPPORTED: Final = SupportState()
"""State of objects in the hand or outside the world."""


class SupportTracker:
    """Support states in an engine's present state.

    A state follows from the object and its neighbours alone. States whose surroundings have not changed since loading stay
    valid; the others last until the next change near them.
    """

    def __init__(self, engine: PhysicsEngine) -> None:
        self._engine = engine
        self._scene = engine.scene
        count = len(engine.scene.objects)
        self._at_start = BoundedCache(count, self._find)
        self._now = BoundedCache(count, self._find)
        self._cavities = BoundedCache(ASSETS_KEPT, self._find_cavities)
        self._stale: set[str] = set()
        """Objects with a change in their surroundings, whose support may differ since."""
        self._round = engine.journal.rounds
        self._read = 0

    def of(self, name: str) -> SupportState:
        """Support of an object."""
        return self._cache_of(name)[name]

    def are_untouched(self, names: Iterable[str]) -> bool:
        """Return True if none of these objects changed since loading, nor anything that their support depends on."""
        self._catch_up()
        return self._stale.isdisjoint(names)

    def _cache_of(self, name: str) -> BoundedCache[str, SupportState]:
        """Cache for the object's state, after the journal is read."""
        self._catch_up()
        return self._now if name in self._stale else self._at_start

    def _catch_up(self) -> None:
        journal = self._engine.journal
        if len(journal.entries) != self._read or journal.rounds != self._round:
            self._read_journal()

    def warm_up(self) -> Iterator[None]:
        """Compute the support of every object, one per step. Changes no answer."""
        for item in self._scene.objects:
            self.of(item.name)
            yield

    def _read_journal(self) -> None:
        """Drop the cached states of objects near a change."""
        journal = self._engine.journal
        if journal.rounds != self._round:
            self._round, self._read = journal.rounds, 0
            self._now.clear()
            self._stale.clear()
        before: dict[str, Aabb | None] = {}
        for name, box in journal.entries[self._read :]:
            before.setdefault(name, box)
        self._read = len(journal.entries)
        for name, box in before.items():
            places = [box] if box is not None else []
            if not self._engine.is_parked(name):
                places.append(self._engine.aabb(name))
            self._forget(name)
            has_cavities = bool(self._scene.asset_of(name).interiors)
            for place in places:
                for other in self._engine.near(place.grown(REST_M)):
                    # A table neither rests on nor lies in a mug that stands on it.
                    if _is_over(self._engine.aabb(other), place) or (
                        has_cavities and self._fits(other, place)
                    ):
                        self._forget(other)

    def _forget(self, name: str) -> None:
        self._stale.add(name)
        self._now.pop(name, None)

    def _fits(self, name: str, place: Aabb) -> bool:
        """Return True if an object may fit into something of this size."""
        width, depth, _ = place.size_m
        return _middle_m(self._scene.asset_of(name)) <= math.hypot(width, depth) + SLACK_M

    def _find_cavities(self, asset_id: str) -> AssetCavities:
        """Cavities of an asset that has at least one."""
        interiors = self._scene.assets[asset_id].interiors
        links = dict.fromkeys(item.link for item in interiors)
        by_link = ((link, tuple(item for item in interiors if item.link == link)) for link in links)
        widest_m = max(math.hypot(*item.size_m[:2]) for item in interiors)
        return AssetCavities(tuple(by_link), widest_m + SLACK_M)

    def _find(self, name: str) -> SupportState:
        engine, scene = self._engine, self._scene
        if engine.is_parked(name):
            return UNSUPPORTED
        box = engine.aabb(name)
        hosts: list[tuple[float, str, Host]] = []
        around: list[tuple[float, str, Enclosure]] = []
        on: list[str] = []
        for other in engine.near(box.grown(REST_M), frozenset((name,))):
            asset = scene.asset_of(other)
            over = _is_over(box, engine.aabb(other))
            if not (over or asset.interiors):
                continue
            pose, fractions = engine.pose(other), engine.joints(other)
            interior = self._interior(name, asset, pose, fractions) if asset.interiors else None
            surface = surface_under(box, asset, pose, fractions, in_cavities=True) if over else ""
            if surface and interior is None and _is_outside(box, asset, pose, fractions):
                on.append(other)
            if interior is None and not surface:
                continue
            volume = math.prod(asset.size_m)
            if interior is not None:
                hosts.append((volume, other, Host(other, Relation.INSIDE, interior.name)))
                enclosure = Enclosure(other, interior.name, is_shut(asset, interior, fractions))
                around.append((math.prod(interior.size_m), other, enclosure))
            else:
                hosts.append((volume, other, Host(other, Relation.ONTOP, surface)))
        return SupportState(
            min(hosts, key=_first_two)[2] if hosts else None,
            tuple(item for _, _, item in sorted(around, key=_first_two)),
            frozenset(on),
        )

    def is_on(self, name: str, other: str) -> bool:
        """Return True if the object rests on a surface of another one outside its cavities."""
        known = self._cache_of(name).get(name)
        return other in known.on if known is not None else self.would_be_on(name, other)

    def is_in(self, name: str, other: str) -> bool:
        """Return True if the object lies in a cavity of another one."""
        known = self._cache_of(name).get(name)
        if known is not None:
            return any(item.name == other for item in known.enclosures)
        return self.would_be_in(name, other)

    def would_be_on(self, name: str, other: str, pose: Pose | None = None) -> bool:
        """Evaluate ``is_on`` without the cache, for an object that is tried in many places: at ``pose``, or where it is."""
        engine = self._engine
        box, there = self._box(name, pose), engine.aabb(other)
        if not box.overlaps(there, REST_M) or not _is_over(box, there):
            return False
        asset, frame, fractions = self._scene.asset_of(other), engine.pose(other), engine.joints(other)
        return bool(surface_under(box, asset, frame, fractions, in_cavities=False)) and not self.would_be_in(
            name, other, pose
        )

    def would_be_in(self, name: str, other: str, pose: Pose | None = None) -> bool:
        """Evaluate ``is_in`` without the cache, for an object at ``pose``, or where it is."""
        engine, asset = self._engine, self._scene.asset_of(other)
        if not asset.interiors or not self._box(name, pose).overlaps(engine.aabb(other), REST_M):
            return False
        return self._interior(name, asset, engine.pose(other), engine.joints(other), pose) is not None

    def _box(self, name: str, pose: Pose | None) -> Aabb:
        """World box of an object at a pose, or where it is."""
        if pose is None:
            return self._engine.aabb(name)
        return bounds_of(self._scene.asset_of(name)).box(pose, self._engine.joints(name))

    def _interior(
        self, name: str, asset: Asset, pose: Pose, fractions: tuple[float, ...], at: Pose | None = None
    ) -> Interior | None:
        """Smallest cavity of an asset at a pose that contains the object, which is tried at another pose or where it is."""
        engine, own = self._engine, self._scene.asset_of(name)
        cavities = self._cavities[asset.asset_id]
        if _middle_m(own) > cavities.too_wide_m:
            return None
        box = self._box(name, at)
        # In every orientation the centre of the object's box moves less than this.
        slack = math.dist(box.low_m, box.high_m) / 2
        found: list[Interior] = []
        for link, interiors in cavities.by_link:
            frame = link_frame(asset, pose, fractions, link)
            if not is_upright(frame):
                continue
            inverse = frame.inverse()
            if not _may_be_in(inverse.apply(box.center_m), interiors, slack):
                continue
            placed = square_box(box, inverse) or bounds_of(own).box(
                inverse @ (at or engine.pose(name)), engine.joints(name)
            )
            interior = interior_around(placed, asset, link)
            if interior is not None:
                found.append(interior)
        return min(found, key=lambda interior: math.prod(interior.size_m), default=None)


def _is_over(box: Aabb, other: Aabb) -> bool:
    """Return True if a box may rest on something in another: its centre is over it, with 5 cm tolerance for coarse models."""
    x, y, _ = box.center_m
    (low_x, low_y, _), (high_x, high_y, _) = other.low_m, other.high_m
    return low_x - SLACK_M <= x <= high_x + SLACK_M and low_y - SLACK_M <= y <= high_y + SLACK_M


def _middle_m(asset: Asset) -> float:
    """Middle one of the three extents: in every orientation, one axis of the plane is at least this wide."""
    return sorted(asset.size_m)[1]


def _may_be_in(center: Vec3, interiors: Sequence[Interior], slack: float) -> bool:
    """Return True if a point lies in any cavity grown by ``slack`` on all sides."""
    x, y, z = center
    for item in interiors:
        (cx, cy, cz), (width, depth, height) = item.center_m, item.size_m
        if (
            abs(z - cz) <= height / 2 + slack
            and abs(x - cx) <= width / 2 + slack
            and abs(y - cy) <= depth / 2 + slack
        ):
            return True
    return False


def _is_outside(box: Aabb, asset: Asset, pose: Pose, fractions: tuple[float, ...]) -> bool:
    """Return True if a box that rests on a surface does so outside cavities."""
    return not asset.interiors or bool(surface_under(box, asset, pose, fractions, in_cavities=False))


def _first_two(item: tuple[float, str, object]) -> tuple[float, str]:
    return item[0], item[1]
