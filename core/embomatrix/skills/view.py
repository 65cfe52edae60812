"""What preconditions are decided on: a view of the world, and a refusal when one does not hold."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from embomatrix.skills.failure import SENTENCES, FailureReason
from embomatrix.skills.syntax import PlaceRelation

if TYPE_CHECKING:
    from collections.abc import Set

    from embomatrix.skills.syntax import SkillCall
    from embomatrix.world.asset import Asset
    from embomatrix.world.state import SubstanceFact


@dataclass(frozen=True, slots=True)
class SkillRefusal:
    """Why a call can't be carried out, and the same as a sentence about the things at hand."""

    reason: FailureReason
    sentence: str


@dataclass(frozen=True, slots=True)
class ObjectReach:
    """How far an object is from the robot.

    ``distance_m`` is horizontal, from the base's centre to the nearest point of the object; ``height_m`` is that of its
    middle above the floor.
    """

    distance_m: float
    height_m: float


class WorldView(Protocol):
    """What the preconditions ask of the state of a rollout. Objects are called by their names."""

    @property
    def table(self) -> tuple[str, ...]:
        """The task's object table: what indices refer to."""

    @property
    def rooms(self) -> tuple[str, ...]: ...

    @property
    def carried(self) -> tuple[str, ...]:
        """What the hand holds, then what lies in it; empty for an empty hand."""

    def asset(self, name: str) -> Asset: ...

    def is_fixed(self, name: str) -> bool: ...

    def is_open(self, name: str) -> bool: ...

    def is_on(self, name: str) -> bool: ...

    def cargo(self, name: str) -> tuple[str, ...]:
        """The object and what lies in it: all that is lifted with it."""

    def burden(self, name: str) -> str:
        """Something that rests on the object and would fall when it is lifted; "" when nothing does."""

    def closed_around(self, name: str) -> str:
        """A closed container that the object is in; "" when there is none."""

    def reach(self, name: str) -> ObjectReach: ...

    def is_approachable(self, name: str) -> bool:
        """Whether no wall and no furniture lies between the robot and the object."""

    def is_at(self, name: str, source: str) -> bool:
        """Whether a heat or cold source acts on the object where it lies, were the source running."""

    def is_real(self, name: str) -> bool:
        """Whether the object is in the world, be it in the hand: not a piece that is still to come, nor cut up."""

    def is_sliced(self, name: str) -> bool: ...

    def is_inside(self, name: str, container: str) -> bool: ...

    def facts_about(self, name: str) -> Set[SubstanceFact]:
        """What the object is covered, filled and soaked with."""


def refuse(reason: FailureReason, **values: str) -> SkillRefusal:
    """Refusal with the reason's sentence filled in. Raises KeyError for a value that the sentence lacks."""
    return SkillRefusal(reason, SENTENCES[reason].format(**values))


def target_of(world: WorldView, call: SkillCall) -> str:
    """Name of the call's object, "" for calls without one or with an index outside the table."""
    index, table = call.object_index, world.table
    return table[index] if index is not None and 0 <= index < len(table) else ""


def source_of(world: WorldView, call: SkillCall) -> str:
    """Name of the call's source, "" for calls without one or with an index outside the table."""
    index, table = call.source_index, world.table
    return table[index] if index is not None and 0 <= index < len(table) else ""


def metres(value: float) -> str:
    """A length for a sentence, to the centimetre."""
    return f"{value:.2f}"


def preposition(relation: PlaceRelation) -> str:
    """The relation as a word of a sentence."""
    return "on top of" if relation is PlaceRelation.ONTOP else relation.value
