"""Effects of water: what lies in a sink or a machine that runs is soaked, filled and washed.

As with heat, the effects follow from the state alone, whichever call brought it about, and are there at once. Nothing dries,
and nothing is emptied.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from embomatrix.sim.state.thermal import Change
from embomatrix.skills.appliances import coverings, liquids_given, soaked_with, washed_away, washing
from embomatrix.world.state import State, SubstanceFact, SubstanceRelation
from embomatrix.world.substances import flows_from, in_words, word_of

if TYPE_CHECKING:
    from collections.abc import Mapping, MutableMapping, Set

    from embomatrix.sim.engine import PhysicsEngine
    from embomatrix.sim.state.news import News
    from embomatrix.sim.state.relations import Relations
    from embomatrix.skills.appliances import Washing


class Water:
    """The sinks and washing machines of a scene. ``substances`` maps each object to facts, and is changed."""

    def __init__(
        self,
        engine: PhysicsEngine,
        relations: Relations,
        states: Mapping[str, Set[State]],
        substances: MutableMapping[str, set[SubstanceFact]],
    ) -> None:
        self._engine = engine
        self._relations = relations
        self._scene = engine.scene
        self._states = states
        self._substances = substances
        self._changes: list[Change] = []
        self._acting: set[str] = set()
        self._acting_at_start: frozenset[str] | None = None
        self._sources: list[tuple[str, Washing | None]] = []
        for item in self._scene.objects:
            asset = self._scene.assets[item.asset_id]
            machine = washing(asset)
            if machine is not None or flows_from(asset.synset):
                self._sources.append((item.name, machine))

    def apply(self, news: News) -> list[Change]:
        """Let every source that runs act on what lies in it. Returns what changed since the last time, by hand or by itself."""
        if news.again and self._acting_at_start is not None:
            self._acting = set(self._acting_at_start)
        for name, machine in self._sources:
            if State.TOGGLED_ON not in self._states.get(name, ()) or not self._runs(name, machine):
                self._acting.discard(name)
            # What a source did to a thing nothing undoes: it acts again when it was started, or something came.
            elif name not in self._acting or news.concerns(name, self._engine.aabb(name)):
                self._acting.add(name)
                self._act(name, machine)
        if self._acting_at_start is None:
            self._acting_at_start = frozenset(self._acting)
        changes, self._changes = self._changes, []
        return changes

    def _runs(self, name: str, machine: Washing | None) -> bool:
        """Whether a source that is switched on is in the world, and closed if it must be."""
        if self._engine.is_parked(name):
            return False
        return machine is None or not machine.requires_closed or not self._relations.open(name)

    def _act(self, name: str, machine: Washing | None) -> None:
        liquids = liquids_given(self._scene.asset_of(name), (), on=True)
        for item in self._engine.near(self._engine.aabb(name), frozenset((name,))):
            if self._scene.by_name[item].fixed or not self._relations.inside(item, name):
                continue
            if machine is not None:
                self.take_off(item, washed_away(machine, coverings(self._substances[item])))
            self.wet(item, liquids)

    def wet(self, name: str, liquids: tuple[str, ...]) -> None:
        """Let liquids run over an object."""
        gained = soaked_with(self._scene.asset_of(name), liquids) - self._substances[name]
        self._substances[name] |= gained
        self._changes += [Change(name, in_words(fact)) for fact in sorted(gained)]

    def take_off(self, name: str, covering: tuple[str, ...]) -> None:
        """Take substances off an object that is covered with them."""
        lost = {SubstanceFact(SubstanceRelation.COVERED, substance) for substance in covering}
        self._substances[name] -= lost
        self._changes += [Change(name, f"free of {word_of(fact.substance)}") for fact in sorted(lost)]
