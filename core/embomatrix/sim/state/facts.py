"""Facts for goals, from the engine's metric state and the symbolic states."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

from embomatrix.world.state import THERMAL, Relation, State, SubstanceFact, SubstanceRelation
from embomatrix.world.substances import MEANINGS, fact_holds

if TYPE_CHECKING:
    from embomatrix.sim.state.relations import Relations

T = TypeVar("T")

RELATIONS = {relation.value: relation for relation in Relation}
STATES = {state.value: state for state in State}
SUBSTANCES = {relation.value: relation for relation in SubstanceRelation}
REAL, FUTURE = "real", "future"
"""Predicates of BDDL: the object is in the world; the object was absent at the start and still is."""
ARGUMENTS = (
    dict.fromkeys((*RELATIONS, *SUBSTANCES), (2,))
    | dict.fromkeys((*STATES, REAL, FUTURE), (1,))
    | dict.fromkeys(THERMAL, (1, 2))
)
"""Numbers of arguments that each predicate takes. The second one of a thermal state is its source."""


class TrackedSets(dict[str, set[T]]):
    """Sets by object name that remember which names were accessed and so may have changed.

    ``items`` and ``values`` do not count as access; change a set only through ``[]``.
    """

    def __init__(self) -> None:
        super().__init__()
        self._touched: set[str] = set()
        self._kept: dict[str, frozenset[T]] = {}

    def __getitem__(self, name: str) -> set[T]:
        self._touched.add(name)
        return super().__getitem__(name)

    def __setitem__(self, name: str, members: set[T]) -> None:
        self._touched.add(name)
        super().__setitem__(name, members)

    def snapshot(self) -> None:
        """Save the current sets for ``restore``."""
        self._kept = {name: frozenset(members) for name, members in self.items()}
        self._touched.clear()

    def is_untouched(self, name: str) -> bool:
        """Return True if the set of a name is certainly as in the snapshot."""
        return name not in self._touched

    def changed(self) -> Sequence[tuple[str, set[T]]]:
        """Names and sets that differ from the snapshot, by name."""
        if not self._touched:
            return ()
        touched = [(name, super(TrackedSets, self).__getitem__(name)) for name in sorted(self._touched)]
        return [(name, members) for name, members in touched if members != self._kept[name]]

    def mark(self) -> Mapping[str, frozenset[T]]:
        """Return the sets that differ from the snapshot, for ``return_to``."""
        return {name: frozenset(members) for name, members in self.changed()}

    def return_to(self, mark: Mapping[str, frozenset[T]]) -> None:
        """Take on the sets of a mark."""
        self.restore()
        for name, members in mark.items():
            self[name] = set(members)

    def restore(self) -> None:
        """Restore the snapshot."""
        for name, _ in self.changed():
            super().__setitem__(name, set(self._kept[name]))
        self._touched.clear()


class FactError(ValueError):
    """Goal that asks for a fact which the simulator can't answer."""


@dataclass(frozen=True, slots=True)
class EngineFacts:
    """Facts of the present moment; they change with the engine and the states.

    ``states`` and ``substances`` map each object to its states and facts; ``absent`` are the objects outside the world;
    ``carried`` are the relations between the held object and its contents; ``treatments`` maps each object to its thermal
    states with the sources that brought them about. All are read at every query, not copied. ``future`` are the objects that
    were absent at the start.
    """

    relations: Relations
    states: Mapping[str, Set[State]]
    substances: Mapping[str, Set[SubstanceFact]]
    absent: Set[str]
    future: Set[str]
    carried: Set[tuple[Relation, str, str]]
    treatments: Mapping[str, Set[tuple[State, str]]]

    def holds(self, predicate: str, args: tuple[str, ...]) -> bool:
        """Return True if ``predicate(args)`` holds. Raises FactError for unknown predicates, objects or argument counts.

        An object outside the world has no state and no substances.
        """
        if len(args) not in ARGUMENTS.get(predicate, ()):
            raise FactError(
                f"found ({' '.join((predicate, *args))}): expected one of {', '.join((*RELATIONS, *SUBSTANCES))} with "
                f"two arguments or one of {', '.join((*STATES, REAL, FUTURE))} with one; "
                f"{', '.join(sorted(THERMAL))} may name their source as a second"
            )
        relation = RELATIONS.get(predicate)
        for item in args[:1] if relation is Relation.INROOM or predicate in SUBSTANCES else args:
            if item not in self.states:
                raise FactError(f"there is no object {item!r} in the scene: expected one of its objects")
        if relation is not None:
            return (relation, *args) in self.carried or self.relations.holds(relation, *args)
        name, absent = args[0], args[0] in self.absent
        if predicate in SUBSTANCES:
            return not absent and fact_holds(SUBSTANCES[predicate], args[1], self.substances[name])
        if predicate in STATES:
            state, sources = STATES[predicate], args[1:]
            treated = not sources or (state, sources[0]) in self.treatments[name]
            return not absent and treated and self._has_state(name, state)
        return (absent and name in self.future) if predicate == FUTURE else not absent

    def _has_state(self, name: str, state: State) -> bool:
        if state in MEANINGS:
            return MEANINGS[state] in self.substances[name]
        return self.relations.open(name) if state is State.OPEN else state in self.states[name]
