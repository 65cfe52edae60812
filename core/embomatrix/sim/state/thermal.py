"""Effects of temperature: whatever lies at a working heat or cold source gets hot, cooked or frozen.

The effects follow from the state alone, whichever call brought it about, and are there at once. What is hot stays hot, and
what is frozen stays frozen, until a source undoes it: a rollout is shorter than it takes to cool down. What is cooked stays
cooked.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from embomatrix.skills.appliances import cold_source, cooks, freezes, heat_source, heats
from embomatrix.world.geometry import Aabb
from embomatrix.world.state import Relation, State

if TYPE_CHECKING:
    from collections.abc import Iterator, MutableMapping

    from embomatrix.sim.engine import PhysicsEngine
    from embomatrix.sim.state.news import News
    from embomatrix.sim.state.relations import Relations
    from embomatrix.skills.appliances import ThermalSource
    from embomatrix.world.asset import Asset


@dataclass(frozen=True, slots=True)
class Change:
    """What became of an object, as words that follow "is now": ``hot``, ``soaked``."""

    name: str
    words: str


class Thermal:
    """The sources of a scene and what they do. ``states`` maps each object to its symbolic states, and is changed."""

    def __init__(
        self, engine: PhysicsEngine, relations: Relations, states: MutableMapping[str, set[State]]
    ) -> None:
        self._engine = engine
        self._relations = relations
        self._scene = engine.scene
        self._states = states
        self._sources: list[tuple[str, ThermalSource]] = []
        self._acted = False
        for item in self._scene.objects:
            asset = self._scene.assets[item.asset_id]
            found = (heat_source(asset), cold_source(asset))
            self._sources += [(item.name, source) for source in found if source is not None]

    def apply(self, news: News) -> list[Change]:
        """Let every working source act. Returns what changed, in scene order of the sources."""
        changes: list[Change] = []
        first, self._acted = not self._acted, True
        for name, source in self._sources:
            # One that acts by itself has acted on all that is there, unless something has changed there since.
            if not self.works(name, source):
                continue
            if first or source.requires_on or news.concerns(name, self._area(name)):
                for item in self._acted_on(name, source):
                    changes += self._expose(item, source)
        return changes

    def works(self, name: str, source: ThermalSource) -> bool:
        """Whether the source is on and closed, as far as it must be."""
        # The switch first: most sources of a scene are off, and all are asked after every change.
        if source.requires_on and State.TOGGLED_ON not in self._states.get(name, ()):
            return False
        if self._engine.is_parked(name):
            return False
        return not (source.requires_closed and self._relations.open(name))

    def is_at(self, item: str, name: str, source: ThermalSource) -> bool:
        """Whether the source acts on the object where it lies: inside it, or on it, or in or on a vessel on it."""
        if source.requires_inside:
            return self._relations.inside(item, name)
        if self._relations.ontop(item, name):
            return True
        vessels = self._above(name)
        return any(
            self._relations.ontop(vessel, name) and self._bears(vessel, item)
            for vessel in vessels
            if vessel != item
        )

    def _acted_on(self, name: str, source: ThermalSource) -> Iterator[str]:
        """Objects where the source acts, of those that it would change."""
        for item in self._above(name):
            if self._gained(item, source) and self.is_at(item, name, source):
                yield item

    def _above(self, name: str) -> tuple[str, ...]:
        """Movable objects in or near the source's box, or above it as far as vessels reach."""
        near = self._engine.near(self._area(name), frozenset((name,)))
        return tuple(item for item in near if not self._scene.by_name[item].fixed)

    def _area(self, name: str) -> Aabb:
        """The source's box, and as far above it as vessels reach."""
        box = self._engine.aabb(name)
        x, y, z = box.high_m
        return Aabb(box.low_m, (x, y, z + VESSEL_M))

    def _bears(self, vessel: str, item: str) -> bool:
        return self._relations.holds(Relation.INSIDE, item, vessel) or self._relations.ontop(item, vessel)

    def _gained(self, item: str, source: ThermalSource) -> list[State]:
        """States that the object would get from the source and does not have."""
        states = self._states.get(item, ())
        return [state for state in _states_at(self._scene.asset_of(item), source) if state not in states]

    def _expose(self, item: str, source: ThermalSource) -> list[Change]:
        """Give the object the states of the source's temperature that its asset can have."""
        gained, states = self._gained(item, source), self._states[item]
        if State.HOT in gained:
            states.discard(State.FROZEN)
        if State.FROZEN in gained:
            states.discard(State.HOT)
        states.update(gained)
        return [Change(item, state.value) for state in gained]


VESSEL_M = 0.3
"""What stands in a vessel on a source has its underside no higher than this above it."""


def _states_at(asset: Asset, source: ThermalSource) -> list[State]:
    found: list[State] = []
    if heats(source) and asset.can("heatable"):
        found.append(State.HOT)
    if cooks(source, asset):
        found.append(State.COOKED)
    if freezes(source) and asset.can("freezable"):
        found.append(State.FROZEN)
    return found
