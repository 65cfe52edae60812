"""Ways to bring a relation about: what is carried where. Some relations follow from placing either object, or both."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from embomatrix.sim.geometry.candidates import candidates
from embomatrix.skills.syntax import PlaceRelation
from embomatrix.world.asset import FLOOR_CATEGORY
from embomatrix.world.state import Relation

if TYPE_CHECKING:
    from collections.abc import Iterator

    from embomatrix.sim.live_world import LiveWorld


@dataclass(frozen=True, slots=True)
class PlacementGoal:
    """``relation(name, target)`` must hold. The target of INROOM is a room."""

    name: str
    relation: Relation
    target: str


@dataclass(frozen=True, slots=True)
class Carry:
    """An object is placed on, in or under a target, by a robot that stands at ``near`` if anything is to be near."""

    name: str
    target: str
    relation: PlaceRelation
    near: str = ""


Way = tuple[Carry, ...]
"""What is carried, in this order, so that a relation holds."""

LYING: Final = (PlaceRelation.ONTOP, PlaceRelation.INSIDE)
MIDDLE: Final = (0.5, 0.5)
CANDIDATES: Final = 16
"""Poses that are looked at before a thing is taken to fit nowhere on another."""


def ways(item: PlacementGoal, world: LiveWorld, rows: tuple[str, ...]) -> tuple[Way, ...]:
    """Ways by which the relation between two objects may come about, the surest first; none when nothing fits.

    What is asked for is tried as it is asked. Then what means the same: a thing is under another that is put on it, on or in
    one whose open cavity it lies in, and in what it lies in on something else. No skill aims at ``nextto``: two things that
    share a small surface may be, and what is placed from beside another where poses beside it were found.
    """
    return tuple(dict.fromkeys(_ways(item, world, rows)))


def _ways(item: PlacementGoal, world: LiveWorld, rows: tuple[str, ...]) -> Iterator[Way]:
    match item.relation:
        case Relation.ONTOP:
            yield from _placed(item, world, PlaceRelation.ONTOP, PlaceRelation.INSIDE)
        case Relation.INSIDE:
            yield from _placed(item, world, PlaceRelation.INSIDE, PlaceRelation.ONTOP)
            for other in rows:
                if other != item.name and world.relations.inside(other, item.target):
                    yield from _placed(
                        PlacementGoal(item.name, Relation.ONTOP, other), world, PlaceRelation.ONTOP
                    )
        case Relation.UNDER:
            yield from _placed(item, world, PlaceRelation.UNDER)
            yield from _placed(_turned(item), world, PlaceRelation.ONTOP)
            yield from _placed(item, world, PlaceRelation.INSIDE, PlaceRelation.ONTOP)
        case Relation.TOUCHING:
            yield from _placed(item, world, *LYING)
            yield from _placed(_turned(item), world, *LYING)
        case Relation.NEXTTO:
            yield from _beside(item, world, rows)
        case Relation.INROOM:
            return


def _placed(
    item: PlacementGoal, world: LiveWorld, *relations: PlaceRelation, near: str = ""
) -> Iterator[Way]:
    for relation in relations:
        if _fits(world, item.name, item.target, relation):
            yield (Carry(item.name, item.target, relation, near),)


def _beside(item: PlacementGoal, world: LiveWorld, rows: tuple[str, ...]) -> Iterator[Way]:
    """On or in what either stands on or in, be it the floor, then both on or in anything of the table, small surfaces first."""
    one, other = item, _turned(item)
    pair = (item.name, item.target)
    for mover in (one, other):
        for host, relation in _borne_by(mover.target, world, rows):
            if host not in pair:
                yield from _placed(
                    PlacementGoal(mover.name, Relation.ONTOP, host), world, relation, near=mover.target
                )
    surfaces = [name for name in rows if name not in pair and world.asset(name).supports]
    for host_name in sorted(surfaces, key=lambda name: _least_area_m2(world, name)):
        placed = [
            next(_placed(PlacementGoal(name, Relation.ONTOP, host_name), world, *LYING), ())
            for name in pair
            if not world.is_fixed(name)
        ]
        if placed and all(placed):
            yield tuple(carry for way in placed for carry in way)


def _borne_by(name: str, world: LiveWorld, rows: tuple[str, ...]) -> Iterator[tuple[str, PlaceRelation]]:
    """What the object stands on or in, with how; the floor of its room where that is an object of the table."""
    host = world.relations.host_of(name)
    if host is not None:
        yield host.name, PlaceRelation(host.relation.value)
        return
    for floor in rows:
        if world.asset(floor).category == FLOOR_CATEGORY and world.room_of(floor) == world.room_of(name):
            yield floor, PlaceRelation.ONTOP


def _turned(item: PlacementGoal) -> PlacementGoal:
    return PlacementGoal(item.target, item.relation, item.name)


def _least_area_m2(world: LiveWorld, name: str) -> float:
    return min(math.prod(surface.size_m) for surface in world.asset(name).supports)


def _fits(world: LiveWorld, name: str, target: str, relation: PlaceRelation) -> bool:
    """Whether the object can be carried and has a pose on, in or under the target, by geometry alone."""
    if world.is_fixed(name):
        return False
    poses = candidates(world.asset(name), world.asset(target), Relation(relation.value), MIDDLE, CANDIDATES)
    return next(poses, None) is not None
