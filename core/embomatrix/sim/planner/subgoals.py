"""Subgoals of a plan and the order in which one arm reaches them.

Tool work comes first. Then heat and cold sources: all objects for a source go there before it is closed and started. Then
every object goes to its final place. Doors and switches get their final position as soon as nothing more passes through them.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from embomatrix.sim.geometry.candidates import candidates
from embomatrix.sim.planner.calls import StuckError
from embomatrix.sim.planner.script import PlanScript
from embomatrix.sim.planner.tool_work import ToolMethod, ToolSubgoal, do_tool_work
from embomatrix.skills.appliances import cold_source, heat_source
from embomatrix.skills.syntax import PlaceRelation
from embomatrix.world.state import Relation

if TYPE_CHECKING:
    from embomatrix.sim.executor import Simulator
    from embomatrix.sim.live_world import LiveWorld

ON_OR_IN: Final = (PlaceRelation.ONTOP, PlaceRelation.INSIDE)
MIDDLE: Final = (0.5, 0.5)
CANDIDATES: Final = 16
"""Poses to try before an object counts as not fitting on another."""


@dataclass(frozen=True, slots=True)
class PlacementGoal:
    """``relation(name, target)`` must hold. The target of INROOM is a room."""

    name: str
    relation: Relation
    target: str

    @property
    def inverse(self) -> PlacementGoal:
        return PlacementGoal(self.target, self.relation, self.name)


@dataclass(frozen=True, slots=True)
class Carry:
    """Place an object on, in, under or next to a target."""

    name: str
    target: str
    relation: PlaceRelation


CarrySequence = tuple[Carry, ...]
"""Objects to carry, in order, so that a relation holds."""


@dataclass(frozen=True, slots=True)
class Exposure:
    """An object must be exposed to a heat source if ``hot``, else to a cold source."""

    name: str
    source: str
    hot: bool


@dataclass(frozen=True)
class Subgoals:
    """Everything that must change. ``open`` and ``on``: final positions of doors and switches; ``leave``: relations to end.

    ``variant`` selects among the ways to bring relations about. ``singly``: a source works on one object at a time.
    """

    placements: tuple[PlacementGoal, ...] = ()
    exposures: tuple[Exposure, ...] = ()
    open: Mapping[str, bool] = field(default_factory=dict)
    on: Mapping[str, bool] = field(default_factory=dict)
    leave: tuple[PlacementGoal, ...] = ()
    tool_work: tuple[tuple[ToolSubgoal, ToolMethod], ...] = ()
    variant: int = 0
    singly: bool = False

    def run(self, script: PlanScript, simulator: Simulator) -> None:
        """Write the calls for all subgoals into the script. Raises StuckError."""
        world = simulator.world
        do_tool_work(script, world, self.tool_work)
        for hot in (True, False):
            self._expose_all(hot, script, world)
        for number, item in enumerate(self.placements):
            self._place(item, script, world)
            rest = {other.target for other in self.placements[number + 1 :]}
            if item.target not in rest and not self._still_holds_something(item.target, number, world):
                self._finish(item.target, script)
        kept = self._leave(script, world)
        for name in dict.fromkeys((*self.open, *self.on)):
            self._finish(name, script)
        if kept:
            script.take(kept)

    def _still_holds_something(self, target: str, number: int, world: LiveWorld) -> bool:
        """True if the target contains an object that a later subgoal carries."""
        if target in world.rooms:
            return False
        waiting = {other.name for other in self.placements[number + 1 :]} | {item.name for item in self.leave}
        return any(world.relations.inside(name, target) for name in waiting)

    def _expose_all(self, hot: bool, script: PlanScript, world: LiveWorld) -> None:
        batch = [item for item in self.exposures if item.hot is hot]
        for source in dict.fromkeys(item.source for item in batch):
            names = [item.name for item in batch if item.source == source]
            for group in [[name] for name in names] if self.singly else [names]:
                self._expose(group, source, hot, script, world)
                if self.singly:
                    script.put_away(group[0], frozenset((group[0], source)))

    def _expose(self, names: list[str], source: str, hot: bool, script: PlanScript, world: LiveWorld) -> None:
        """Carry the objects to the source, then start it."""
        asset = world.asset(source)
        parameters = heat_source(asset) if hot else cold_source(asset)
        if parameters is None:
            raise StuckError(f"{source} is not a {'heat' if hot else 'cold'} source")
        relation = PlaceRelation.INSIDE if parameters.requires_inside else PlaceRelation.ONTOP
        for name in names:
            if not world.thermal.is_at(name, source, parameters):
                script.transfer(name, source, relation)
        if parameters.requires_closed:
            script.close(source)
        if parameters.requires_on:
            script.switch_on(source)

    def _place(self, item: PlacementGoal, script: PlanScript, world: LiveWorld) -> None:
        if world.relations.holds(item.relation, item.name, item.target):
            return
        if item.relation is Relation.INROOM:
            elsewhere = frozenset(name for name in world.scene.by_name if world.room_of(name) != item.target)
            script.put_away(item.name, elsewhere)
            return
        found = carry_sequences(item, world, world.table)
        if not found:
            raise StuckError(f"{item.name} fits nowhere so that it is {item.relation.value} {item.target}")
        for carry in found[self.variant % len(found)]:
            script.transfer(carry.name, carry.target, carry.relation)

    def _leave(self, script: PlanScript, world: LiveWorld) -> str:
        """End relations. Return the object that must stay in the hand because there is no room for it, else "".

        A held object is in no relation, and the hand holds one object.
        """
        kept = ""
        for item in self.leave:
            if not world.relations.holds(item.relation, item.name, item.target):
                continue
            in_room = item.relation is Relation.INROOM
            # The first object is carried away from the second, unless it is fixed.
            carried = item.target if not in_room and world.is_fixed(item.name) else item.name
            avoid = frozenset((item.name, item.target))
            if in_room:
                avoid = frozenset(name for name in world.scene.by_name if world.room_of(name) == item.target)
            try:
                script.put_away(carried, avoid)
            except StuckError:
                if kept not in ("", carried):
                    raise
                kept = carried
        return kept

    def _finish(self, name: str, script: PlanScript) -> None:
        """Bring the doors and the switch of an object into their final position."""
        if self.on.get(name) is False:
            script.switch_off(name)
        if name in self.open:
            if self.open[name]:
                script.open(name)
            else:
                script.close(name)
        if self.on.get(name):
            script.switch_on(name)


def carry_sequences(
    item: PlacementGoal, world: LiveWorld, rows: tuple[str, ...]
) -> tuple[CarrySequence, ...]:
    """Return ways to bring a relation about, the surest first; none when the object fits nowhere.

    The requested relation comes first, then relations that imply it. An object is under another that is put on it, or when it
    lies in an open cavity. An object is inside a container when it is on top of something in it. If there is no room next to an
    object that can be carried, both go to another surface.
    """
    return tuple(dict.fromkeys(_carry_sequences(item, world, rows)))


def _carry_sequences(item: PlacementGoal, world: LiveWorld, rows: tuple[str, ...]) -> Iterator[CarrySequence]:
    match item.relation:
        case Relation.ONTOP:
            yield from _placed(item, world, PlaceRelation.ONTOP)
        case Relation.INSIDE:
            yield from _placed(item, world, PlaceRelation.INSIDE)
            for other in rows:
                if other != item.name and world.relations.inside(other, item.target):
                    on_other = PlacementGoal(item.name, Relation.ONTOP, other)
                    yield from _placed(on_other, world, PlaceRelation.ONTOP)
        case Relation.UNDER:
            yield from _placed(item, world, PlaceRelation.UNDER)
            yield from _placed(item.inverse, world, PlaceRelation.ONTOP)
            yield from _placed(item, world, PlaceRelation.INSIDE, PlaceRelation.ONTOP)
        case Relation.TOUCHING:
            yield from _placed(item, world, *ON_OR_IN)
            yield from _placed(item.inverse, world, *ON_OR_IN)
        case Relation.NEXTTO:
            yield from _beside(item, world, rows)
        case Relation.INROOM:
            return


def _placed(item: PlacementGoal, world: LiveWorld, *relations: PlaceRelation) -> Iterator[CarrySequence]:
    for relation in relations:
        if _fits(world, item.name, item.target, relation):
            yield (Carry(item.name, item.target, relation),)


def _beside(item: PlacementGoal, world: LiveWorld, rows: tuple[str, ...]) -> Iterator[CarrySequence]:
    """Yield placements of either object next to the other, then next to it on another surface, large surfaces first."""
    for mover in (item, item.inverse):
        yield from _placed(mover, world, PlaceRelation.NEXTTO)
    surfaces = [name for name in rows if name not in (item.name, item.target) and world.asset(name).supports]
    for surface in sorted(surfaces, key=lambda name: -_area_m2(world, name)):
        for mover in (item, item.inverse):
            first = PlacementGoal(mover.target, Relation.ONTOP, surface)
            for there in itertools.islice(_placed(first, world, *ON_OR_IN), 1):
                for beside in _placed(mover, world, PlaceRelation.NEXTTO):
                    yield (*there, *beside)


def _area_m2(world: LiveWorld, name: str) -> float:
    return max(math.prod(surface.size_m) for surface in world.asset(name).supports)


def _fits(world: LiveWorld, name: str, target: str, relation: PlaceRelation) -> bool:
    """True if the object is portable and, by geometry alone, may have a pose in this relation to the target."""
    if world.is_fixed(name):
        return False
    if relation is PlaceRelation.NEXTTO:
        return True
    poses = candidates(world.asset(name), world.asset(target), Relation(relation.value), MIDDLE, CANDIDATES)
    return next(poses, None) is not None
