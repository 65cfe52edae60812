"""Facts: what goals ask, answered from the engine's metric state and the symbolic states beside it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from embomatrix.world.state import Relation, State

if TYPE_CHECKING:
    from collections.abc import Mapping, Set

    from embomatrix.sim.relations import Relations

RELATIONS = {relation.value: relation for relation in Relation}
STATES = {state.value: state for state in State}


class FactError(ValueError):
    """A goal asks something that the simulator can't answer."""


class SceneFacts:
    """Facts of the present moment: they change as the engine and the states do."""

    def __init__(self, relations: Relations, states: Mapping[str, Set[State]]) -> None:
        """``states`` maps each object to its symbolic states; it is read at every question, not copied."""
        self._relations = relations
        self._states = states

    def holds(self, predicate: str, args: tuple[str, ...]) -> bool:
        """Whether ``predicate(args)`` holds. Raises FactError for an unknown predicate, object or number of arguments."""
        if predicate in RELATIONS and len(args) == 2:
            first, second = args
            relation = RELATIONS[predicate]
            self._check_objects(args[:1] if relation is Relation.INROOM else args)
            return self._relations.holds(relation, first, second)
        if predicate in STATES and len(args) == 1:
            self._check_objects(args)
            state = STATES[predicate]
            return self._relations.open(args[0]) if state is State.OPEN else state in self._states[args[0]]
        raise FactError(
            f"found ({' '.join((predicate, *args))}): expected one of {', '.join(RELATIONS)} with two arguments "
            f"or one of {', '.join(STATES)} with one"
        )

    def _check_objects(self, names: tuple[str, ...]) -> None:
        for name in names:
            if name not in self._states:
                raise FactError(f"there is no object {name!r} in the scene: expected one of its objects")
