"""Sources that change objects by themselves: heat, cold and water.

The effects follow from the state alone, whichever call caused it, and are immediate. Hot objects stay hot and frozen ones stay
frozen until a source undoes it: a rollout is shorter than cooling. Cooked objects stay cooked. Nothing dries or empties.
"""

from collections.abc import Mapping, MutableMapping, Set
from dataclasses import dataclass
from typing import Final

from embomatrix.sim.engine import PhysicsEngine
from embomatrix.sim.state.relations import Relations
from embomatrix.skills.appliances import (
    ThermalSource,
    Washing,
    cold_source,
    cooks,
    coverings,
    freezes,
    heat_source,
    heats,
    liquids_given,
    soaked_with,
    washed_away,
    washing,
)
from embomatrix.world.geometry import Aabb
from embomatrix.world.state import State, SubstanceFact, SubstanceRelation
from embomatrix.world.substances import flows_from, in_words, word_of

VESSEL_M: Final = 0.3
"""Largest height over a source of the underside of an object that stands in a vessel on the source."""


@dataclass(frozen=True, slots=True)
class Unread:
    """Changes that a ``ChangeReader`` has not read, and whether the engine was reset before them."""

    entries: tuple[tuple[str, Aabb | None], ...]
    was_reset: bool


class ChangeReader:
    """Reader of an engine's journal. A reset alone is not a change."""

    def __init__(self, engine: PhysicsEngine) -> None:
        self.was_reset = False
        """True if the engine was reset between the last two reads."""
        self._engine = engine
        self._round = engine.journal.rounds
        self._read = 0
        self._kept = Unread((), was_reset=False)
        """Unread changes of the state that the engine returned to."""
        self._names: set[str] = set()
        self._places: list[Aabb] = []

    def unread(self) -> Unread:
        """Return the changes since the last ``read``, for ``keep``."""
        journal = self._engine.journal
        if journal.rounds != self._round:
            return Unread(tuple(journal.entries), was_reset=True)
        return Unread((*self._kept.entries, *journal.entries[self._read :]), was_reset=self._kept.was_reset)

    def keep(self, unread: Unread) -> None:
        """Take these changes for the unread ones, instead of those in the journal."""
        journal = self._engine.journal
        self._round, self._read, self._kept = journal.rounds, len(journal.entries), unread

    def read(self) -> None:
        """Read the changes since the last call."""
        unread = self.unread()
        self.was_reset = unread.was_reset
        names = self._names = set[str]()
        self._places.clear()
        for name, box in unread.entries:
            if name not in names:
                names.add(name)
                if box is not None:
                    self._places.append(box)
        self.keep(Unread((), was_reset=False))
        self._places += [self._engine.aabb(name) for name in names if not self._engine.is_parked(name)]

    def affects(self, name: str, area: Aabb) -> bool:
        """Return True if the object changed, or if anything in the area changed, before or after."""
        return name in self._names or any(area.overlaps(box) for box in self._places)


@dataclass(frozen=True, slots=True)
class Change:
    """Change of an object, in words that follow "is now": ``hot``, ``soaked``."""

    name: str
    words: str


class Thermal:
    """Heat and cold sources of a scene.

    Changes ``states``, the symbolic states by object, and ``treatments``, the thermal states with their sources.
    """

    def __init__(
        self,
        engine: PhysicsEngine,
        relations: Relations,
        states: MutableMapping[str, set[State]],
        treatments: MutableMapping[str, set[tuple[State, str]]],
    ) -> None:
        self._engine = engine
        self._relations = relations
        self._scene = engine.scene
        self._states = states
        self._treatments = treatments
        self._sources: list[tuple[str, ThermalSource]] = []
        self._acted = False
        self._areas: dict[str, tuple[Aabb, Aabb]] = {}
        """Box and area of each source when it was asked for last."""
        for item in self._scene.objects:
            asset = self._scene.assets[item.asset_id]
            found = (heat_source(asset), cold_source(asset))
            self._sources += [(item.name, source) for source in found if source is not None]

    def apply(self, changed: ChangeReader) -> list[Change]:
        """Let every working source act. Return the changes in scene order of the sources."""
        changes: list[Change] = []
        first, self._acted = not self._acted, True
        states = self._states
        for name, source in self._sources:
            # Most sources are off, and all are checked after every change: so this is checked before anything is called.
            if source.requires_on and State.TOGGLED_ON not in states.get(name, ()):
                continue
            # A source without a switch has already acted on everything there, unless something changed since.
            if not self.works(name, source):
                continue
            if first or source.requires_on or changed.affects(name, self._area(name)):
                for item in self._above(name):
                    if self._gained(item, name, source) and self.is_at(item, name, source):
                        changes += self._expose(item, name, source)
        return changes

    def works(self, name: str, source: ThermalSource) -> bool:
        """Return True if the source is on and closed, as far as it must be."""
        if source.requires_on and State.TOGGLED_ON not in self._states.get(name, ()):
            return False
        if self._engine.is_parked(name):
            return False
        return not (source.requires_closed and self._relations.open(name))

    def is_at(self, item: str, name: str, source: ThermalSource) -> bool:
        """Return True if the source acts on the object: inside it, on it, or in or on a vessel on it."""
        if self._relations.inside(item, name):
            return True
        if source.requires_inside:
            return False
        if self._relations.ontop(item, name):
            return True
        return any(
            self._relations.ontop(vessel, name) and self._bears(vessel, item)
            for vessel in self._above(name)
            if vessel != item
        )

    def _above(self, name: str) -> tuple[str, ...]:
        """Movable objects in or near the source's box, or above it up to the height of vessels."""
        near = self._engine.near(self._area(name), frozenset((name,)))
        return tuple(item for item in near if not self._scene.by_name[item].fixed)

    def _area(self, name: str) -> Aabb:
        """Box of the source, extended upwards by the height of vessels."""
        box = self._engine.aabb(name)
        known = self._areas.get(name)
        if known is None or known[0] is not box:
            x, y, z = box.high_m
            known = self._areas[name] = box, Aabb(box.low_m, (x, y, z + VESSEL_M))
        return known[1]

    def _bears(self, vessel: str, item: str) -> bool:
        return self._relations.inside(item, vessel) or self._relations.ontop(item, vessel)

    def _gained(self, item: str, name: str, source: ThermalSource) -> list[State]:
        """States that the object would have from this source, and has not."""
        treated, asset = self._treatments.get(item, ()), self._scene.asset_of(item)
        effects = {
            State.HOT: heats(source) and asset.can("heatable"),
            State.COOKED: cooks(source, asset),
            State.FROZEN: freezes(source) and asset.can("freezable"),
        }
        return [state for state, occurs in effects.items() if occurs and (state, name) not in treated]

    def _expose(self, item: str, name: str, source: ThermalSource) -> list[Change]:
        """Apply the source's temperature to the object. Return its new states."""
        gained, states = self._gained(item, name, source), self._states[item]
        for ends, begins in ((State.FROZEN, State.HOT), (State.HOT, State.FROZEN)):
            if begins in gained and ends in states:
                states.discard(ends)
                ended = {treatment for treatment in self._treatments[item] if treatment[0] is ends}
                self._treatments[item] -= ended
        new = [state for state in gained if state not in states]
        states.update(new)
        self._treatments[item].update((state, name) for state in gained)
        return [Change(item, state.value) for state in new]


class Water:
    """Sinks and washing machines of a scene. Changes ``substances``, the facts by object."""

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

    @property
    def acting(self) -> frozenset[str]:
        """Sources that have acted since they were started."""
        return frozenset(self._acting)

    def return_to(self, acting: frozenset[str]) -> None:
        """Take on the state in which these sources were acting."""
        self._acting = set(acting)

    def apply(self, changed: ChangeReader) -> list[Change]:
        """Let every running source act on its contents. Return the changes since the last call, also those by hand."""
        if changed.was_reset and self._acting_at_start is not None:
            self._acting = set(self._acting_at_start)
        for name, machine in self._sources:
            if State.TOGGLED_ON not in self._states.get(name, ()) or not self._runs(name, machine):
                self._acting.discard(name)
            # Effects are permanent: a source acts again only after it was started or something arrived.
            elif name not in self._acting or changed.affects(name, self._engine.aabb(name)):
                self._acting.add(name)
                self._act(name, machine)
        if self._acting_at_start is None:
            self._acting_at_start = frozenset(self._acting)
        changes, self._changes = self._changes, []
        return changes

    def _runs(self, name: str, machine: Washing | None) -> bool:
        """Return True if a source that is on is in the world, and closed if it must be."""
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
        """Wet an object with liquids."""
        gained = soaked_with(self._scene.asset_of(name), liquids) - self._substances[name]
        self._substances[name] |= gained
        self._changes += [Change(name, in_words(fact)) for fact in sorted(gained)]

    def take_off(self, name: str, covering: tuple[str, ...]) -> None:
        """Remove substances that cover an object."""
        lost = {SubstanceFact(SubstanceRelation.COVERED, substance) for substance in covering}
        self._substances[name] -= lost
        self._changes += [Change(name, f"free of {word_of(fact.substance)}") for fact in sorted(lost)]
