"""View of the world on which preconditions are checked, and the refusal of a call."""

from collections.abc import Set
from dataclasses import dataclass
from string import Formatter
from typing import Final, Protocol

from embomatrix.skills.failure import FailureReason
from embomatrix.skills.syntax import PlaceRelation, SkillCall
from embomatrix.world.asset import Asset
from embomatrix.world.state import SubstanceFact

_FIELDS_AT_FAULT: Final = ("other", "container", "source", "target")
"""Fields of a sentence that name the object at fault, the most specific one first."""


def _blocker_field(sentence: str) -> str:
    fields = {field for _, field, _, _ in Formatter().parse(sentence)}
    return next((name for name in _FIELDS_AT_FAULT if name in fields), "")


_BLOCKER_FIELD: Final = {reason: _blocker_field(reason.sentence) for reason in FailureReason}


@dataclass(frozen=True, slots=True)
class SkillRefusal:
    """Reason why a call can't be carried out, a sentence for people, and the object at fault for code.

    ``blocker`` names the object that blocks the call or must change first: the obstacle, the closed container, the object on
    top, else the source or the target itself. Obstacles without a name are ``a wall`` or ``something``; "" means no object.
    """

    reason: FailureReason
    sentence: str
    blocker: str = ""


@dataclass(frozen=True, slots=True)
class ObjectReach:
    """Distance of an object from the robot.

    ``distance_m`` is horizontal, from the centre of the base to the nearest point of the object. ``height_m`` is the height
    of the object's centre above the floor.
    """

    distance_m: float
    height_m: float


class WorldView(Protocol):
    """Questions that preconditions ask about the state of a rollout. Objects are identified by name."""

    @property
    def table(self) -> tuple[str, ...]:
        """Object table of the task, to which indices refer."""

    @property
    def rooms(self) -> tuple[str, ...]: ...

    @property
    def carried(self) -> tuple[str, ...]:
        """The held object, then its contents; empty for an empty hand."""

    def asset(self, name: str) -> Asset: ...

    def is_fixed(self, name: str) -> bool: ...

    def is_open(self, name: str) -> bool: ...

    def is_on(self, name: str) -> bool: ...

    def cargo(self, name: str) -> tuple[str, ...]:
        """The object and its contents: everything that is lifted with it."""

    def burden(self, name: str) -> str:
        """An object that rests on this one and would fall if it were lifted; "" for none."""

    def closed_around(self, name: str) -> str:
        """A closed container around the object; "" for none."""

    def reach(self, name: str) -> ObjectReach: ...

    def is_approachable(self, name: str) -> bool:
        """True if no wall and no furniture lies between the robot and the object."""

    def is_at(self, name: str, source: str) -> bool:
        """True if a heat or cold source would act on the object at its present place, were the source running."""

    def is_real(self, name: str) -> bool:
        """True if the object exists now: neither a future piece nor an object that was cut up."""

    def is_sliced(self, name: str) -> bool: ...

    def is_inside(self, name: str, container: str) -> bool: ...

    def facts_about(self, name: str) -> Set[SubstanceFact]:
        """Substances that cover, fill or soak the object."""


def refuse(reason: FailureReason, **values: str) -> SkillRefusal:
    """Return a refusal with the values filled into the sentence. Values that the sentence does not use are ignored.

    Raises KeyError if the sentence needs a value that is not given.
    """
    return SkillRefusal(reason, reason.sentence.format(**values), values.get(_BLOCKER_FIELD[reason], ""))


def target_of(world: WorldView, call: SkillCall) -> str:
    """Name of the call's object; "" if the call has none or its index is outside the table."""
    index, table = call.object_index, world.table
    return table[index] if index is not None and 0 <= index < len(table) else ""


def source_of(world: WorldView, call: SkillCall) -> str:
    """Name of the call's source; "" if the call has none or its index is outside the table."""
    index, table = call.source_index, world.table
    return table[index] if index is not None and 0 <= index < len(table) else ""


def metres(value: float) -> str:
    """Format a length for a sentence, to the centimetre."""
    return f"{value:.2f}"


def preposition(relation: PlaceRelation) -> str:
    """Format a relation for a sentence."""
    match relation:
        case PlaceRelation.ONTOP:
            return "on top of"
        case PlaceRelation.NEXTTO:
            return "next to"
        case _:
            return relation.value
