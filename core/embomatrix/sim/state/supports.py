"""How objects stand among their neighbours, kept for as long as nothing near them changes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from embomatrix.sim.geometry.bounds import bounds_of, square_box
from embomatrix.sim.geometry.surfaces import (
    REST_M,
    interior_around,
    is_shut,
    is_upright,
    link_frame,
    surface_under,
)
from embomatrix.world.state import Relation

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from embomatrix.sim.engine import PhysicsEngine
    from embomatrix.world.asset import Asset, Interior
    from embomatrix.world.geometry import Aabb, Pose, Vec3


SLACK_M: Final = 0.05


@dataclass(frozen=True, slots=True)
class Hollows:
    """The cavities of an asset by the links that they ride on, and a width that nothing has which lies in one of them."""

    by_link: tuple[tuple[str, tuple[Interior, ...]], ...]
    too_wide_m: float

    @staticmethod
    def of(asset: Asset) -> Hollows:
        """The cavities of an asset that has some."""
        links = dict.fromkeys(item.link for item in asset.interiors)
        by_link = [(link, tuple(item for item in asset.interiors if item.link == link)) for link in links]
        return Hollows(
            tuple(by_link), max(math.hypot(*item.size_m[:2]) for item in asset.interiors) + SLACK_M
        )


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


@dataclass(frozen=True, slots=True)
class Footing:
    """How an object stands among its neighbours: its host, the containers around it, and what it is on top of."""

    host: Host | None = None
    enclosures: tuple[Enclosure, ...] = ()
    on: frozenset[str] = frozenset()


NOWHERE: Final = Footing()
"""Of what is in the hand, or not in the world."""


class Footings:
    """Footings in an engine's present state.

    A footing follows from the object and its neighbours alone. Those of neighbourhoods in which nothing has changed since
    the scene was loaded are good for ever; the others until the next change near them.
    """

    def __init__(self, engine: PhysicsEngine) -> None:
        self._engine = engine
        self._scene = engine.scene
        self._at_start: dict[str, Footing] = {}
        self._now: dict[str, Footing] = {}
        self._middles_m: dict[str, float] = {}
        """Of an asset's three extents the middle one: however it lies, it is nowhere narrower along both axes of the plane."""
        self._hollows: dict[str, Hollows] = {}
        self._stale: set[str] = set()
        """Objects near to which something has changed, so that they may stand otherwise since."""
        self._round = engine.journal.rounds
        self._read = 0

    def of(self, name: str) -> Footing:
        """How the object stands: its host, the containers around it, what it is on top of."""
        journal = self._engine.journal
        if len(journal.entries) != self._read or journal.rounds != self._round:
            self._read_journal()
        known = self._now if name in self._stale else self._at_start
        footing = known.get(name)
        if footing is None:
            footing = known[name] = self._find(name)
        return footing

    def complete(self) -> Iterator[None]:
        """Find out how everything stands, one object at a step: work for a process that waits. Changes no answer."""
        for item in self._scene.objects:
            self.of(item.name)
            yield

    def _read_journal(self) -> None:
        """Forget what is kept of the objects that were near to a change."""
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
            hollow = bool(self._scene.asset_of(name).interiors)
            for place in places:
                for other in self._engine.near(place.grown(REST_M)):
                    # A table neither rests on nor lies in a mug that stands on it.
                    if _is_over(self._engine.aabb(other), place) or (hollow and self._fits(other, place)):
                        self._forget(other)

    def _forget(self, name: str) -> None:
        self._stale.add(name)
        self._now.pop(name, None)

    def _fits(self, name: str, place: Aabb) -> bool:
        """Whether an object may lie in something that takes a place."""
        width, depth, _ = place.size_m
        return self._middle_m(self._scene.asset_of(name)) <= math.hypot(width, depth) + SLACK_M

    def _middle_m(self, asset: Asset) -> float:
        known = self._middles_m.get(asset.asset_id)
        if known is None:
            _, known, _ = sorted(asset.size_m)
            self._middles_m[asset.asset_id] = known
        return known

    def _find(self, name: str) -> Footing:
        engine, scene = self._engine, self._scene
        if engine.is_parked(name):
            return NOWHERE
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
            surface = surface_under(box, asset, pose, fractions, doored=True) if over else ""
            if surface and _is_open(box, asset, pose, fractions):
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
        return Footing(
            min(hosts, key=_first_two)[2] if hosts else None,
            tuple(item for _, _, item in sorted(around, key=_first_two)),
            frozenset(on),
        )

    def is_on(self, name: str, other: str) -> bool:
        """Whether the object rests on a surface of another that no door shuts off."""
        known = self._known(name)
        return other in known.on if known is not None else self.would_be_on(name, other)

    def is_in(self, name: str, other: str) -> bool:
        """Whether the object lies in a cavity of another."""
        known = self._known(name)
        if known is not None:
            return any(item.name == other for item in known.enclosures)
        return self.would_be_in(name, other)

    def would_be_on(self, name: str, other: str) -> bool:
        """As ``is_on``, without a look at what is kept: for an object that is being tried in many places."""
        engine = self._engine
        box, there = engine.aabb(name), engine.aabb(other)
        if not box.overlaps(there, REST_M) or not _is_over(box, there):
            return False
        asset, pose, fractions = self._scene.asset_of(other), engine.pose(other), engine.joints(other)
        return bool(surface_under(box, asset, pose, fractions, doored=False))

    def would_be_in(self, name: str, other: str) -> bool:
        """As ``is_in``, without a look at what is kept."""
        engine, asset = self._engine, self._scene.asset_of(other)
        if not asset.interiors or not engine.aabb(name).overlaps(engine.aabb(other), REST_M):
            return False
        return self._interior(name, asset, engine.pose(other), engine.joints(other)) is not None

    def _known(self, name: str) -> Footing | None:
        journal = self._engine.journal
        if len(journal.entries) != self._read or journal.rounds != self._round:
            self._read_journal()
        return (self._now if name in self._stale else self._at_start).get(name)

    def _interior(self, name: str, asset: Asset, pose: Pose, fractions: tuple[float, ...]) -> Interior | None:
        """The smallest cavity of an asset at a pose that the object is in."""
        engine, own = self._engine, self._scene.asset_of(name)
        hollows = self._hollows.get(asset.asset_id)
        if hollows is None:
            hollows = self._hollows[asset.asset_id] = Hollows.of(asset)
        if self._middle_m(own) > hollows.too_wide_m:
            return None
        box = engine.aabb(name)
        # However the object turns, the centre of its box moves less than this.
        slack = math.dist(box.low_m, box.high_m) / 2
        found: list[Interior] = []
        for link, interiors in hollows.by_link:
            frame = link_frame(asset, pose, fractions, link)
            if not is_upright(frame):
                continue
            inverse = frame.inverse()
            if not _may_be_in(inverse.apply(box.center_m), interiors, slack):
                continue
            placed = square_box(box, inverse) or bounds_of(own).box(
                inverse @ engine.pose(name), engine.joints(name)
            )
            interior = interior_around(placed, asset, link)
            if interior is not None:
                found.append(interior)
        return min(found, key=lambda interior: math.prod(interior.size_m), default=None)


def _is_over(box: Aabb, other: Aabb) -> bool:
    """Whether a box may rest on something in another: its centre is over it, give or take 5 cm for what a model lacks."""
    x, y, _ = box.center_m
    (low_x, low_y, _), (high_x, high_y, _) = other.low_m, other.high_m
    return low_x - SLACK_M <= x <= high_x + SLACK_M and low_y - SLACK_M <= y <= high_y + SLACK_M


def _may_be_in(center: Vec3, interiors: Sequence[Interior], slack: float) -> bool:
    """Whether a point lies in any of some cavities that are grown by a length on all sides."""
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


def _is_open(box: Aabb, asset: Asset, pose: Pose, fractions: tuple[float, ...]) -> bool:
    """Whether a box that rests on a surface of an asset rests on one that no door shuts off."""
    if not any(interior.closed_by for interior in asset.interiors):
        return True
    return bool(surface_under(box, asset, pose, fractions, doored=False))


def _first_two(item: tuple[float, str, object]) -> tuple[float, str]:
    return item[0], item[1]
