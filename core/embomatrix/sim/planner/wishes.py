"""What the literals of a choice say about where a thing may be left on the way to the goal."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from embomatrix.world.state import Relation

if TYPE_CHECKING:
    from embomatrix.sim.planner.choices import Choice

AT: Final = frozenset({Relation.ONTOP, Relation.INSIDE, Relation.TOUCHING})
"""Relations that lying on a thing may bring about."""


@dataclass(frozen=True, slots=True)
class GoalLiterals:
    """The literals that a plan is to make true. Without any, everything may be left anywhere."""

    choice: Choice = ()

    def may_lie_on(self, name: str, surface: str, room: str) -> bool:
        """Whether leaving a thing on a surface in this room makes no literal false."""
        for item in self.choice:
            predicate, args = item.atom.predicate, item.atom.args
            if args[0] != name:
                continue
            if predicate == Relation.INROOM and (args[1] == room) is not item.positive:
                return False
            if predicate in AT and not item.positive and args[1] == surface:
                return False
        return True

    def belongs_at(self, name: str, target: str) -> bool:
        """Whether a literal asks for the thing to be in some relation to the target."""
        return any(item.positive and item.atom.args == (name, target) for item in self.choice)
