"""What is to be done in a house so that a goal holds, and the order in which one arm does it.

Sources first: what must get hot, cooked or frozen is taken there, all of it before the source is shut and started. Then
everything goes to its place. Doors and switches come as soon as nothing more goes through them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from embomatrix.sim.plan_script import StuckError
from embomatrix.skills.appliance import cold_source, heat_source
from embomatrix.skills.syntax import PlaceRelation
from embomatrix.world.state import Relation

if TYPE_CHECKING:
    from collections.abc import Mapping

    from embomatrix.sim.executor import Simulator
    from embomatrix.sim.live_world import LiveWorld
    from embomatrix.sim.plan_script import PlanScript
    from embomatrix.skills.appliance import Source


@dataclass(frozen=True, slots=True)
class Placement:
    """``relation(name, target)`` must hold. The target of INROOM is a room."""

    name: str
    relation: Relation
    target: str


@dataclass(frozen=True, slots=True)
class Warming:
    """An object must be exposed to a heat source, or to a cold one."""

    name: str
    source: str
    hot: bool


@dataclass(frozen=True)
class Errands:
    """``open`` and ``on`` say how doors and switches must end; ``leave`` are pairs that must not stay together."""

    placements: tuple[Placement, ...]
    warmings: tuple[Warming, ...]
    open: Mapping[str, bool]
    on: Mapping[str, bool]
    leave: tuple[tuple[str, str], ...]

    def run(self, script: PlanScript, simulator: Simulator) -> None:
        """Do it all. Raises StuckError."""
        world = simulator.world
        self._warm(script, world)
        settled: set[str] = set()
        for number, item in enumerate(self.placements):
            self._place(item, script, world)
            rest = {other.target for other in self.placements[number + 1 :]}
            if item.target not in rest and not self._still_holds_something(item.target, number, world):
                self._finish(item.target, script)
                settled.add(item.target)
        for name, other in self.leave:
            if world.relations.inside(name, other) or world.relations.ontop(name, other):
                script.put_away(name, frozenset((name, other)))
        for name in dict.fromkeys((*self.open, *self.on)):
            self._finish(name, script)

    def _still_holds_something(self, target: str, number: int, world: LiveWorld) -> bool:
        """Whether something that is yet to be carried lies in the target."""
        waiting = {other.name for other in self.placements[number + 1 :]} | {name for name, _ in self.leave}
        return any(world.relations.inside(name, target) for name in waiting)

    def _warm(self, script: PlanScript, world: LiveWorld) -> None:
        for hot in (True, False):
            batch = [item for item in self.warmings if item.hot is hot]
            for source in dict.fromkeys(item.source for item in batch):
                names = [item.name for item in batch if item.source == source]
                self._expose(names, source, hot, script, world)

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

    def _place(self, item: Placement, script: PlanScript, world: LiveWorld) -> None:
        if script.holds(item.relation, item.name, item.target):
            return
        match item.relation:
            case Relation.ONTOP | Relation.INSIDE | Relation.UNDER:
                script.transfer(item.name, item.target, PlaceRelation(item.relation.value))
            case Relation.TOUCHING:
                script.transfer(item.name, item.target, PlaceRelation.ONTOP)
            case Relation.NEXTTO:
                self._place_beside(item, script, world)
            case Relation.INROOM:
                elsewhere = frozenset(
                    name for name in world.scene.by_name if world.room_of(name) != item.target
                )
                script.put_away(item.name, elsewhere)

    def _place_beside(self, item: Placement, script: PlanScript, world: LiveWorld) -> None:
        """On or in what the other thing stands on or in: next to it, if there is not much room."""
        host = world.relations.host_of(item.target)
        if host is None or host.name == item.name:
            raise StuckError(f"nothing can be put beside {item.target}: it stands on the floor")
        script.transfer(item.name, host.name, PlaceRelation(host.relation.value))

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


def _way_in(source: Source) -> PlaceRelation:
    return PlaceRelation.INSIDE if source.requires_inside else PlaceRelation.ONTOP
