"""Facts: what goals ask, answered from the engine's metric state and the symbolic states beside it."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

from embomatrix.world.state import Relation, State, SubstanceRelation
from embomatrix.world.substances import MEANINGS, fact_holds

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence, Set

    from embomatrix.sim.state.relations import Relations
    from embomatrix.world.state import SubstanceFact

T = TypeVar("T")

RELATIONS = {relation.value: relation for relation in Relation}
STATES = {state.value: state for state in State}
SUBSTANCES = {relation.value: relation for relation in SubstanceRelation}
REAL, FUTURE = "real", "future"


class Symbols(dict[str, set[T]]):
    """Sets by object name. Only those that were asked for by name can have been changed: it remembers which.

    Read with ``items`` and ``values``, which do not remember; change through ``[]``.
    """

    def __init__(self) -> None:
        super().__init__()
        self._asked: set[str] = set()
        self._kept: dict[str, frozenset[T]] = {}

    def __getitem__(self, name: str) -> set[T]:
        self._asked.add(name)
        return super().__getitem__(name)

    def __setitem__(self, name: str, members: set[T]) -> None:
        self._asked.add(name)
        super().__setitem__(name, members)

    def keep(self) -> None:
        """Take what is so now as that which ``restore`` goes back to."""
        self._kept = {name: frozenset(members) for name, members in self.items()}
        self._asked.clear()

    def changed(self) -> Sequence[tuple[str, set[T]]]:
        """Names and sets that are not as kept, by name."""
        if not self._asked:
            return ()
        asked = [(name, super(Symbols, self).__getitem__(name)) for name in sorted(self._asked)]
        return [(name, members) for name, members in asked if members != self._kept[name]]

    def restore(self) -> None:
        """Make every set equal to the one that was kept."""
        for name, _ in self.changed():
            super().__setitem__(name, set(self._kept[name]))
        self._asked.clear()


class FactError(ValueError):
    """A goal asks something that the simulator can't answer."""


class EngineFacts:
    """Facts of the present moment: they change as the engine and the states do."""

    def __init__(
        self,
        relations: Relations,
        states: Mapping[str, Set[State]],
        substances: Mapping[str, Set[SubstanceFact]],
        absent: Set[str],
        future: Set[str],
    ) -> None:
        """``states`` and ``substances`` map each object to what is so of it; ``absent`` are those not in the world.

        All are read at every question, not copied. ``future`` are the objects that were absent at the start.
        """
        self._relations = relations
        self._states = states
        self._substances = substances
        self._absent = absent
        self._future = future

    def holds(self, predicate: str, args: tuple[str, ...]) -> bool:
        """Whether ``predicate(args)`` holds. Raises FactError for an unknown predicate, object or number of arguments."""
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
        """What is not in the world is in no state."""
        if name in self._absent:
            return False
        if state in MEANINGS:
            return MEANINGS[state] in self._substances[name]
        return self._relations.open(name) if state is State.OPEN else state in self._states[name]

    def _check_objects(self, names: tuple[str, ...]) -> None:
        for name in names:
            if name not in self._states:
                raise FactError(f"there is no object {name!r} in the scene: expected one of its objects")
