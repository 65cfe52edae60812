"""The skill library as one table: what each skill does, what must hold before it, what may still stop it.

Angles are relative and in radians, counter-clockwise seen from above: ``turn`` adds to the heading, ``move_forward`` turns
first and then drives straight on. A skill that fails changes nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Final

from embomatrix.skills.failure import FailureReason
from embomatrix.skills.syntax import Skill

if TYPE_CHECKING:
    from collections.abc import Mapping


class Precondition(StrEnum):
    """What a skill asks of the world before it starts. *Target* is the call's object, *source* its source."""

    OBJECT_LISTED = "the target is a row of the object table, and in the world"
    SOURCE_LISTED = "the source is a row of the object table, and in the world"
    ROOM_KNOWN = "the scene has the room"
    STEP_SHORT = "the distance is one that can be driven in one step"
    NOT_CARRIED = "the target is not in the hand, nor in what the hand holds"
    HAND_FREE = "the hand is empty"
    HAND_HOLDS = "the hand holds something"
    NOT_ITSELF = "the target is neither what the hand holds nor in it"
    PORTABLE = "the target is not fixed"
    LIGHT_ENOUGH = "the target, with what lies in it, is light enough to lift"
    SMALL_ENOUGH = "the gripper can take the target"
    BEARS_NOTHING = "nothing rests on the target"
    IN_REACH = "the arm reaches the target from where the robot stands"
    APPROACHABLE = "no wall and no furniture lies between the robot and the target"
    ACCESSIBLE = "no closed container is around the target"
    OPENABLE = "the target has a door, a drawer or a lid"
    IS_CLOSED = "the target is closed"
    IS_OPEN = "the target is open"
    NOT_RUNNING = "the target does not run, if it runs only when closed"
    TOGGLEABLE = "the target has a switch"
    IS_OFF = "the target is off"
    IS_ON = "the target is on"
    CLOSED_TO_START = "the target is closed, if it starts only when closed"
    HAS_CAVITY = "the target has a cavity, if something is to go inside"
    OPENED_FOR = "the target is open, if something is to go inside"
    SOURCE_HEATS = "the source is a heat source"
    SOURCE_COOLS = "the source is a cold source"
    HEATABLE = "the target can be heated"
    COOKABLE = "the target can be cooked"
    FREEZABLE = "the target can be frozen"
    SOURCE_IN_REACH = "the arm reaches the source from where the robot stands"
    SOURCE_APPROACHABLE = "no wall and no furniture lies between the robot and the source"
    AT_SOURCE = "the target is in the source, or on it, as the source asks"
    SOURCE_ON = "the source is on, if it works only when on"
    SOURCE_CLOSED = "the source is closed, if it works only when closed"
    HOT_ENOUGH = "the source is hot enough to make things hot"
    COOKS = "the source is hot enough to cook the target"
    COLD_ENOUGH = "the source is cold enough to freeze"
    SOURCE_CUTS = "the source is something to cut with"
    SLICEABLE = "the target can be sliced"
    NOT_SLICED = "the target is not sliced"
    SOURCE_HELD = "the source is what the hand holds, unless it washes what lies in it"
    SOURCE_CLEANS = "the source takes substances off other things, or holds a liquid that may"
    WORKED_ON = "the arm reaches the target, and no closed container is around it, unless it is washed"
    WASHED = "the target lies in the source, which runs and is closed if it must be, if the source washes"
    COMES_OFF = "the source takes off something of what is on the target, soaked or on if it must be"
    SOURCE_WETS = "the source holds a liquid, or one flows out of it"
    SOAKABLE = "the target takes up liquids, or holds them"
    SOURCE_ACCESSIBLE = "no closed container is around the source"
    UNDER_SOURCE = "the target is in the hand, or in the source"
    SOURCE_FLOWS = "the source is on, if it holds no liquid"


REASONS: Final[Mapping[Precondition, tuple[FailureReason, ...]]] = {
    Precondition.OBJECT_LISTED: (FailureReason.UNKNOWN_INDEX, FailureReason.NOT_THERE),
    Precondition.SOURCE_LISTED: (FailureReason.UNKNOWN_INDEX, FailureReason.NOT_THERE),
    Precondition.ROOM_KNOWN: (FailureReason.UNKNOWN_ROOM,),
    Precondition.STEP_SHORT: (FailureReason.STEP_TOO_LONG,),
    Precondition.NOT_CARRIED: (FailureReason.HAND_FULL,),
    Precondition.HAND_FREE: (FailureReason.HAND_FULL,),
    Precondition.HAND_HOLDS: (FailureReason.HAND_EMPTY,),
    Precondition.NOT_ITSELF: (FailureReason.PLACE_ON_ITSELF,),
    Precondition.PORTABLE: (FailureReason.NOT_PORTABLE,),
    Precondition.LIGHT_ENOUGH: (FailureReason.TOO_HEAVY,),
    Precondition.SMALL_ENOUGH: (FailureReason.TOO_LARGE,),
    Precondition.BEARS_NOTHING: (FailureReason.SUPPORTS_OTHERS,),
    Precondition.IN_REACH: (FailureReason.OUT_OF_REACH, FailureReason.TOO_HIGH),
    Precondition.APPROACHABLE: (FailureReason.NO_LINE_OF_APPROACH,),
    Precondition.ACCESSIBLE: (FailureReason.CONTAINER_CLOSED,),
    Precondition.OPENABLE: (FailureReason.NOT_OPENABLE,),
    Precondition.IS_CLOSED: (FailureReason.ALREADY_OPEN,),
    Precondition.IS_OPEN: (FailureReason.ALREADY_CLOSED,),
    Precondition.NOT_RUNNING: (FailureReason.OPENED_WHILE_ON,),
    Precondition.TOGGLEABLE: (FailureReason.NOT_TOGGLEABLE,),
    Precondition.IS_OFF: (FailureReason.ALREADY_ON,),
    Precondition.IS_ON: (FailureReason.ALREADY_OFF,),
    Precondition.CLOSED_TO_START: (FailureReason.MUST_BE_CLOSED,),
    Precondition.HAS_CAVITY: (FailureReason.NO_CAVITY,),
    Precondition.OPENED_FOR: (FailureReason.CONTAINER_CLOSED,),
    Precondition.SOURCE_HEATS: (FailureReason.NOT_A_HEAT_SOURCE,),
    Precondition.SOURCE_COOLS: (FailureReason.NOT_A_COLD_SOURCE,),
    Precondition.HEATABLE: (FailureReason.NOT_HEATABLE,),
    Precondition.COOKABLE: (FailureReason.NOT_COOKABLE,),
    Precondition.FREEZABLE: (FailureReason.NOT_FREEZABLE,),
    Precondition.SOURCE_IN_REACH: (FailureReason.OUT_OF_REACH, FailureReason.TOO_HIGH),
    Precondition.SOURCE_APPROACHABLE: (FailureReason.NO_LINE_OF_APPROACH,),
    Precondition.AT_SOURCE: (FailureReason.NOT_AT_SOURCE,),
    Precondition.SOURCE_ON: (FailureReason.SOURCE_OFF,),
    Precondition.SOURCE_CLOSED: (FailureReason.SOURCE_OPEN,),
    Precondition.HOT_ENOUGH: (FailureReason.NOT_HOT_ENOUGH,),
    Precondition.COOKS: (FailureReason.NOT_HOT_ENOUGH,),
    Precondition.COLD_ENOUGH: (FailureReason.NOT_COLD_ENOUGH,),
    Precondition.SOURCE_CUTS: (FailureReason.NOT_A_SLICER,),
    Precondition.SLICEABLE: (FailureReason.NOT_SLICEABLE,),
    Precondition.NOT_SLICED: (FailureReason.ALREADY_SLICED,),
    Precondition.SOURCE_HELD: (FailureReason.TOOL_NOT_HELD,),
    Precondition.SOURCE_CLEANS: (FailureReason.NOT_A_CLEANER,),
    Precondition.WORKED_ON: (
        FailureReason.OUT_OF_REACH,
        FailureReason.TOO_HIGH,
        FailureReason.NO_LINE_OF_APPROACH,
        FailureReason.CONTAINER_CLOSED,
    ),
    Precondition.WASHED: (FailureReason.NOT_AT_SOURCE, FailureReason.SOURCE_OFF, FailureReason.SOURCE_OPEN),
    Precondition.COMES_OFF: (FailureReason.NEEDS_SOAKING, FailureReason.SOURCE_OFF, FailureReason.STAYS_ON),
    Precondition.SOURCE_WETS: (FailureReason.GIVES_NO_LIQUID,),
    Precondition.SOAKABLE: (FailureReason.NOT_SOAKABLE,),
    Precondition.SOURCE_ACCESSIBLE: (FailureReason.CONTAINER_CLOSED,),
    Precondition.UNDER_SOURCE: (FailureReason.NOT_AT_SOURCE,),
    Precondition.SOURCE_FLOWS: (FailureReason.SOURCE_OFF,),
}
"""Reasons with which a call fails when the precondition does not hold."""


@dataclass(frozen=True, slots=True)
class Entry:
    """One skill. ``preconditions`` are checked in order, the first that does not hold is the reason of the failure.

    ``effect`` says what a success changes; ``outcomes`` are reasons that show only when the skill is carried out.
    """

    doc: str
    effect: str
    preconditions: tuple[Precondition, ...]
    outcomes: tuple[FailureReason, ...] = ()


_AT_HAND: Final = (Precondition.IN_REACH, Precondition.APPROACHABLE, Precondition.ACCESSIBLE)
_SOURCE_AT_HAND: Final = (
    Precondition.SOURCE_IN_REACH,
    Precondition.SOURCE_APPROACHABLE,
    Precondition.AT_SOURCE,
    Precondition.SOURCE_ON,
    Precondition.SOURCE_CLOSED,
)

LIBRARY: Final[Mapping[Skill, Entry]] = {
    Skill.MOVE: Entry(
        "Drive to a place from which the object can be reached.",
        "the robot stands beside the object and faces it",
        (Precondition.OBJECT_LISTED, Precondition.NOT_CARRIED),
        (FailureReason.NO_STANDING_POSE, FailureReason.NO_PATH),
    ),
    Skill.TURN: Entry(
        "Turn on the spot by an angle in radians, counter-clockwise, relative to the present heading.",
        "the heading grows by the angle",
        (),
    ),
    Skill.PICK_UP: Entry(
        "Take the object into the empty hand, with whatever lies in it.",
        "the hand holds the object, which is in no relation any more",
        (
            Precondition.OBJECT_LISTED,
            Precondition.HAND_FREE,
            Precondition.PORTABLE,
            Precondition.LIGHT_ENOUGH,
            Precondition.SMALL_ENOUGH,
            *_AT_HAND,
            Precondition.BEARS_NOTHING,
        ),
        (FailureReason.ARM_BLOCKED,),
    ),
    Skill.PLACE: Entry(
        "Put what the hand holds on top of, inside or under the object.",
        "what the hand held stands in the relation to the object, and the hand is empty",
        (
            Precondition.OBJECT_LISTED,
            Precondition.HAND_HOLDS,
            Precondition.NOT_ITSELF,
            *_AT_HAND,
            Precondition.HAS_CAVITY,
            Precondition.OPENED_FOR,
        ),
        (FailureReason.NO_FREE_POSE, FailureReason.NO_SURFACE, FailureReason.NO_CAVITY),
    ),
    Skill.MOVE_FORWARD: Entry(
        "Turn by an angle in radians relative to the present heading, then drive straight on for a distance in metres; "
        "a negative distance drives backwards.",
        "the heading grows by the angle and the robot stands further along it",
        (Precondition.STEP_SHORT,),
        (FailureReason.BLOCKED,),
    ),
    Skill.OPEN: Entry(
        "Open every door, drawer or lid of the object with the empty hand.",
        "the object is open",
        (
            Precondition.OBJECT_LISTED,
            Precondition.HAND_FREE,
            Precondition.OPENABLE,
            *_AT_HAND,
            Precondition.IS_CLOSED,
            Precondition.NOT_RUNNING,
        ),
        (FailureReason.DOOR_BLOCKED, FailureReason.ARM_BLOCKED),
    ),
    Skill.CLOSE: Entry(
        "Close every door, drawer or lid of the object with the empty hand.",
        "the object is closed",
        (
            Precondition.OBJECT_LISTED,
            Precondition.HAND_FREE,
            Precondition.OPENABLE,
            *_AT_HAND,
            Precondition.IS_OPEN,
        ),
        (FailureReason.DOOR_BLOCKED, FailureReason.ARM_BLOCKED),
    ),
    Skill.TOGGLE_ON: Entry(
        "Switch the object on with the empty hand.",
        "the object is on",
        (
            Precondition.OBJECT_LISTED,
            Precondition.HAND_FREE,
            Precondition.TOGGLEABLE,
            *_AT_HAND,
            Precondition.IS_OFF,
            Precondition.CLOSED_TO_START,
        ),
        (FailureReason.ARM_BLOCKED,),
    ),
    Skill.TOGGLE_OFF: Entry(
        "Switch the object off with the empty hand.",
        "the object is off",
        (
            Precondition.OBJECT_LISTED,
            Precondition.HAND_FREE,
            Precondition.TOGGLEABLE,
            *_AT_HAND,
            Precondition.IS_ON,
        ),
        (FailureReason.ARM_BLOCKED,),
    ),
    Skill.HEAT: Entry(
        "Wait beside a working heat source until the object at it is hot.",
        "the object is hot, and no longer frozen",
        (
            Precondition.OBJECT_LISTED,
            Precondition.SOURCE_LISTED,
            Precondition.SOURCE_HEATS,
            Precondition.HEATABLE,
            *_SOURCE_AT_HAND,
            Precondition.HOT_ENOUGH,
        ),
    ),
    Skill.COOK: Entry(
        "Wait beside a working heat source until the food at it is cooked.",
        "the food is cooked and hot",
        (
            Precondition.OBJECT_LISTED,
            Precondition.SOURCE_LISTED,
            Precondition.SOURCE_HEATS,
            Precondition.COOKABLE,
            *_SOURCE_AT_HAND,
            Precondition.COOKS,
        ),
    ),
    Skill.FREEZE: Entry(
        "Wait beside a working cold source until the object at it is frozen.",
        "the object is frozen, and no longer hot",
        (
            Precondition.OBJECT_LISTED,
            Precondition.SOURCE_LISTED,
            Precondition.SOURCE_COOLS,
            Precondition.FREEZABLE,
            *_SOURCE_AT_HAND,
            Precondition.COLD_ENOUGH,
        ),
    ),
    Skill.GO_TO_ROOM: Entry(
        "Drive through the doors to a free spot of the room.",
        "the robot stands in the room",
        (Precondition.ROOM_KNOWN,),
        (FailureReason.NO_PATH,),
    ),
    Skill.SLICE: Entry(
        "Cut the object with the knife in the hand.",
        "the object is sliced; if it has pieces, these lie where it was and it is gone",
        (
            Precondition.OBJECT_LISTED,
            Precondition.SOURCE_LISTED,
            Precondition.SOURCE_CUTS,
            Precondition.SLICEABLE,
            Precondition.SOURCE_HELD,
            Precondition.NOT_CARRIED,
            *_AT_HAND,
            Precondition.NOT_SLICED,
            Precondition.BEARS_NOTHING,
        ),
        (FailureReason.NO_FREE_POSE,),
    ),
    Skill.CLEAN: Entry(
        "Wipe or brush the object with the tool in the hand, or wait while it is washed in a sink or a machine.",
        "what the tool takes off is no longer on the object",
        (
            Precondition.OBJECT_LISTED,
            Precondition.SOURCE_LISTED,
            Precondition.SOURCE_CLEANS,
            Precondition.SOURCE_HELD,
            Precondition.NOT_CARRIED,
            Precondition.SOURCE_IN_REACH,
            Precondition.SOURCE_APPROACHABLE,
            Precondition.WORKED_ON,
            Precondition.WASHED,
            Precondition.COMES_OFF,
        ),
    ),
    Skill.SOAK: Entry(
        "Let the liquid of the source run over the object, which is in the hand or in the source.",
        "a cloth is soaked with what the source gives, a vessel filled with it",
        (
            Precondition.OBJECT_LISTED,
            Precondition.SOURCE_LISTED,
            Precondition.SOURCE_WETS,
            Precondition.SOAKABLE,
            Precondition.SOURCE_IN_REACH,
            Precondition.SOURCE_APPROACHABLE,
            Precondition.SOURCE_ACCESSIBLE,
            Precondition.UNDER_SOURCE,
            Precondition.SOURCE_FLOWS,
        ),
    ),
}


_AT_WORK: Final = (FailureReason.COLLIDED, FailureReason.ARM_BLOCKED)

MISHAPS: Final[Mapping[Skill, tuple[FailureReason, ...]]] = {
    Skill.MOVE: (FailureReason.COLLIDED, FailureReason.SLIPPED),
    Skill.TURN: (FailureReason.COLLIDED, FailureReason.SLIPPED),
    Skill.PICK_UP: (*_AT_WORK, FailureReason.SLIPPED),
    Skill.PLACE: (*_AT_WORK, FailureReason.SLIPPED, FailureReason.FELL),
    Skill.MOVE_FORWARD: (FailureReason.COLLIDED, FailureReason.SLIPPED),
    Skill.OPEN: _AT_WORK,
    Skill.CLOSE: _AT_WORK,
    Skill.TOGGLE_ON: _AT_WORK,
    Skill.TOGGLE_OFF: _AT_WORK,
    Skill.HEAT: (),
    Skill.COOK: (),
    Skill.FREEZE: (),
    Skill.GO_TO_ROOM: (FailureReason.COLLIDED, FailureReason.SLIPPED),
    Skill.SLICE: _AT_WORK,
    Skill.CLEAN: _AT_WORK,
    Skill.SOAK: _AT_WORK,
}
"""What else stops a skill when a robot really carries it out; cached mode gives what was foreseen of it."""


def reasons_of(skill: Skill) -> frozenset[FailureReason]:
    """Every reason with which a call of the skill can fail."""
    entry = LIBRARY[skill]
    foreseen = frozenset(reason for item in entry.preconditions for reason in REASONS[item])
    return foreseen | frozenset(entry.outcomes) | frozenset(MISHAPS[skill])
