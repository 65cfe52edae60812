"""What is to be done in a house so that a goal holds, and the order in which one arm does it.

What must be cut, cleaned and wetted comes first. Then the sources: what must get hot, cooked or frozen is taken there, all of
it before the source is shut and started. Then everything goes to its place. Doors and switches come as soon as nothing
more goes through them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from embomatrix.sim.planner.calls import StuckError
from embomatrix.sim.planner.chores import do_chores
from embomatrix.sim.planner.ways import ways
from embomatrix.skills.appliances import cold_source, heat_source
from embomatrix.skills.syntax import PlaceRelation
from embomatrix.world.state import Relation

if TYPE_CHECKING:
    from collections.abc import Mapping

    from embomatrix.sim.executor import Simulator
    from embomatrix.sim.live_world import LiveWorld
    from embomatrix.sim.planner.chores import Chore, ChoreMethod
    from embomatrix.sim.planner.script import PlanScript
    from embomatrix.sim.planner.ways import PlacementGoal
    from embomatrix.skills.appliances import ThermalSource


@dataclass(frozen=True, slots=True)
class Warming:
    """An object must be exposed to a heat source, or to a cold one."""

    name: str
    source: str
    hot: bool


@dataclass(frozen=True)
class Errands:
    """``open`` and ``on`` say how doors and switches must end; ``leave`` are relations that must end.

    ``way`` is the rank of the way in which relations are brought about; ``singly`` has sources work on one thing at a time.
    """

    placements: tuple[PlacementGoal, ...]
    warmings: tuple[Warming, ...]
    open: Mapping[str, bool]
    on: Mapping[str, bool]
    leave: tuple[PlacementGoal, ...]
    chores: tuple[tuple[Chore, ChoreMethod], ...] = ()
    way: int = 0
    singly: bool = False

    def run(self, script: PlanScript, simulator: Simulator) -> None:
        """Do it all. Raises StuckError."""
        world = simulator.world
        do_chores(script, world, self.chores)
        self._warm(script, world)
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
        """Whether something that is yet to be carried lies in the target."""
        if target in world.rooms:
            return False
        waiting = {other.name for other in self.placements[number + 1 :]} | {item.name for item in self.leave}
        return any(world.relations.inside(name, target) for name in waiting)

    def _warm(self, script: PlanScript, world: LiveWorld) -> None:
        for hot in (True, False):
            batch = [item for item in self.warmings if item.hot is hot]
            for source in dict.fromkeys(item.source for item in batch):
                names = [item.name for item in batch if item.source == source]
                for group in [[name] for name in names] if self.singly else [names]:
                    self._expose(group, source, hot, script, world)
                    if self.singly:
                        script.put_away(group[0], frozenset((group[0], source)))

    def _expose(self, names: list[str], source: str, hot: bool, script: PlanScript, world: LiveWorld) -> None:
        """Take the objects to the source, then let it run."""
        asset = world.asset(source)
        parameters = heat_source(asset) if hot else cold_source(asset)
        if parameters is None:
            raise StuckError(f"{source} is no source")
        for name in names:
            if not world.thermal.is_at(name, source, parameters):
                script.transfer(name, source, _way_in(parameters))
        if parameters.requires_closed:
            script.close(source)
        if parameters.requires_on:
            script.switch_on(source)

    def _place(self, item: PlacementGoal, script: PlanScript, world: LiveWorld) -> None:
        if script.holds(item.relation, item.name, item.target):
            return
        if item.relation is Relation.INROOM:
            elsewhere = frozenset(name for name in world.scene.by_name if world.room_of(name) != item.target)
            script.put_away(item.name, elsewhere)
            return
        found = ways(item, world, script.rows)
        if not found:
            raise StuckError(f"{item.name} fits nowhere so that it is {item.relation.value} {item.target}")
        for carry in found[self.way % len(found)]:
            script.transfer(carry.name, carry.target, carry.relation, near=carry.near)

    def _leave(self, script: PlanScript, world: LiveWorld) -> str:
        """End the relations that must end. Returns what has to end in the hand, as there is no room for it; else "".

        What the hand holds stands in no relation, and it holds one thing.
        """
        kept = ""
        for item in self.leave:
            if not script.holds(item.relation, item.name, item.target):
                continue
            carried = item.name if item.relation is Relation.INROOM else _carried_of(item, world)
            try:
                self._part(item, script, world)
            except StuckError:
                if kept not in ("", carried):
                    raise
                kept = carried
        return kept

    def _part(self, item: PlacementGoal, script: PlanScript, world: LiveWorld) -> None:
        """End a relation: carry the first object elsewhere, or the second where the first can't be carried."""
        if item.relation is Relation.INROOM:
            here = frozenset(name for name in world.scene.by_name if world.room_of(name) == item.target)
            script.put_away(item.name, here)
        else:
            script.put_away(_carried_of(item, world), frozenset((item.name, item.target)))

    def _finish(self, name: str, script: PlanScript) -> None:
        """Bring the doors and the switch of an object into the position in which they must end."""
        if self.on.get(name) is False:
            script.switch_off(name)
        if name in self.open:
            if self.open[name]:
                script.open(name)
            else:
                script.close(name)
        if self.on.get(name):
            script.switch_on(name)


def _carried_of(item: PlacementGoal, world: LiveWorld) -> str:
    """Which of two objects is carried away from the other: the first, unless it is fixed."""
    return item.target if world.is_fixed(item.name) else item.name


def _way_in(source: ThermalSource) -> PlaceRelation:
    return PlaceRelation.INSIDE if source.requires_inside else PlaceRelation.ONTOP
