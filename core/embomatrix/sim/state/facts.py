"""Facts for goals, from the engine's metric state and the symbolic states."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from typing import TYPE_CHECKING, TypeVar

from embomatrix.world.state import Relation, State, SubstanceFact, SubstanceRelation
from embomatrix.world.substances import MEANINGS, fact_holds

if TYPE_CHECKING:
    from embomatrix.sim.state.relations import Relations

T = TypeVar("T")

RELATIONS = {relation.value: relation for relation in Relation}
STATES = {state.value: state for state in State}
SUBSTANCES = {relation.value: relation for relation in SubstanceRelation}
REAL, FUTURE = "real", "future"
"""Predicates of BDDL: the object is in the world; the object was absent at the start and still is."""


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

    def changed(self) -> Sequence[tuple[str, set[T]]]:
        """Names and sets that differ from the snapshot, by name."""
        if not self._touched:
            return ()
        touched = [(name, super(TrackedSets, self).__getitem__(name)) for name in sorted(self._touched)]
        return [(name, members) for name, members in touched if members != self._kept[name]]

    def restore(self) -> None:
        """Restore the snapshot."""
        for name, _ in self.changed():
            super().__setitem__(name, set(self._kept[name]))
        self._touched.clear()


class FactError(ValueError):
    """Goal that asks for a fact which the simulator can't answer."""


class EngineFacts:
    """Facts of the present moment; they change with the engine and the states."""

    def __init__(
        self,
        relations: Relations,
        states: Mapping[str, Set[State]],
        substances: Mapping[str, Set[SubstanceFact]],
        absent: Set[str],
        future: Set[str],
    ) -> None:
        """``states`` and ``substances`` map each object to its states and facts; ``absent`` are the objects outside the world.

        All are read at every query, not copied. ``future`` are the objects that were absent at the start.
        """
        self._relations = relations
        self._states = states
        self._substances = substances
        self._absent = absent
        self._future = future

    def holds(self, predicate: str, args: tuple[str, ...]) -> bool:
        """Return True if ``predicate(args)`` holds. Raises FactError for unknown predicates, objects or argument counts."""
        if predicate in RELATIONS and len(args) == 2:
            first, second = args
            relation = RELATIONS[predicate]
            self._check_objects(args[:1] if relation is Relation.INROOM else args)
            return self._relations.holds(relation, first, second)
        if predicate in STATES and len(args) == 1:
            self._check_objects(args)
            return self._state(args[0], STATES[predicate])
        if predicate in SUBSTANCES and len(args) == 2:
            self._check_objects(args[:1])
            there = args[0] not in self._absent
            return there and fact_holds(SUBSTANCES[predicate], args[1], self._substances[args[0]])
        if predicate in (REAL, FUTURE) and len(args) == 1:
            self._check_objects(args)
            absent = args[0] in self._absent
            return (absent and args[0] in self._future) if predicate == FUTURE else not absent
        raise FactError(
            f"found ({' '.join((predicate, *args))}): expected one of {', '.join((*RELATIONS, *SUBSTANCES))} with "
            f"two arguments or one of {', '.join((*STATES, REAL, FUTURE))} with one"
        )

    def _state(self, name: str, state: State) -> bool:
        """An object outside the world has no state."""
        if name in self._absent:
            return False
        if state in MEANINGS:
            return MEANINGS[state] in self._substances[name]
        return self._relations.open(name) if state is State.OPEN else state in self._states[name]

    def _check_objects(self, names: tuple[str, ...]) -> None:
        for name in names:
            if name not in self._states:
                raise FactError(f"there is no object {name!r} in the scene: expected one of its objects")
