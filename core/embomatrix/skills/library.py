"""Skill library: the preconditions, effect and possible failures of each skill in one table.

Angles are relative, in radians, counter-clockwise seen from above. ``turn`` adds to the heading; ``move_forward`` turns first
and then drives straight. A failed skill changes nothing.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from embomatrix.skills.failure import FailureReason
from embomatrix.skills.syntax import Skill


class Precondition(StrEnum):
    """Condition that a skill needs before it starts. *Target* is the call's object, *source* its source."""

    OBJECT_LISTED = "the target is a row of the object table, and in the world"
    SOURCE_LISTED = "the source is a row of the object table, and in the world"
    ROOM_KNOWN = "the scene has the room"
    STEP_SHORT = "the distance is short enough for one step"
    NOT_CARRIED = "the target is neither in the hand nor inside the held object"
    HAND_FREE = "the hand is empty"
    HAND_HOLDS = "the hand holds something"
    NOT_ITSELF = "the target is neither the held object nor inside it"
    PORTABLE = "the target is not fixed"
    LIGHT_ENOUGH = "the target with its contents is light enough to lift"
    SMALL_ENOUGH = "the target fits the gripper"
    BEARS_NOTHING = "nothing rests on the target"
    IN_REACH = "the arm reaches the target from where the robot stands"
    APPROACHABLE = "no wall and no furniture lies between the robot and the target"
    ACCESSIBLE = "no closed container is around the target"
    OPENABLE = "the target has a door, a drawer or a lid"
    IS_CLOSED = "the target is closed"
    IS_OPEN = "the target is open"
    NOT_RUNNING = "the target is not running, if it runs only when closed"
    TOGGLEABLE = "the target has a switch"
    IS_OFF = "the target is off"
    IS_ON = "the target is on"
    CLOSED_TO_START = "the target is closed, if it starts only when closed"
    HAS_CAVITY = "the target has a cavity, if the object goes inside"
    OPENED_FOR = "the target is open, if the object goes inside"
    SOURCE_HEATS = "the source is a heat source"
    SOURCE_COOLS = "the source is a cold source"
    HEATABLE = "the target can be heated"
    COOKABLE = "the target can be cooked"
    FREEZABLE = "the target can be frozen"
    SOURCE_IN_REACH = "the arm reaches the source from where the robot stands"
    SOURCE_APPROACHABLE = "no wall and no furniture lies between the robot and the source"
    AT_SOURCE = "the target is inside or on the source, as the source requires"
    SOURCE_ON = "the source is on, if it works only when on"
    SOURCE_CLOSED = "the source is closed, if it works only when closed"
    HOT_ENOUGH = "the source is hot enough to make objects hot"
    COOKS = "the source is hot enough to cook the target"
    COLD_ENOUGH = "the source is cold enough to freeze"
    SOURCE_CUTS = "the source is a cutting tool"
    SLICEABLE = "the target can be sliced"
    NOT_SLICED = "the target is not sliced"
    SOURCE_HELD = "the hand holds the source, unless the source washes its contents"
    SOURCE_CLEANS = "the source removes substances from objects, or holds a liquid that may do so"
    WORKED_ON = "the arm reaches the target and no closed container is around it, unless the source washes it"
    WASHED = (
        "the target lies in the source, which is on, and closed if it must be; applies to sources that wash"
    )
    COMES_OFF = "the source removes a substance that covers the target, and is soaked or on if that is needed"
    SOURCE_WETS = "the source holds a liquid, or a liquid flows out of it"
    SOAKABLE = "the target absorbs or holds liquids"
    SOURCE_ACCESSIBLE = "no closed container is around the source"
    UNDER_SOURCE = "the target is in the hand, or in the source"
    SOURCE_FLOWS = "the source is on, if it holds no liquid"


@dataclass(frozen=True, slots=True)
class SkillDefinition:
    """Definition of one skill. ``preconditions`` are checked in this order; the first that fails gives the reason.

    ``effect`` states the change after a success. ``outcomes`` are reasons that appear only during execution.
    """

    effect: str
    preconditions: tuple[Precondition, ...]
    outcomes: tuple[FailureReason, ...] = ()


NO_PLACE: Final = (
    FailureReason.NO_FREE_POSE,
    FailureReason.PLACES_OUT_OF_REACH,
    FailureReason.PLACES_BEHIND_DOOR,
)
"""Reasons why an object that fits a place, as far as its shape goes, can't be put there now."""
_AT_HAND: Final = (Precondition.IN_REACH, Precondition.APPROACHABLE, Precondition.ACCESSIBLE)
_HAND_FREE_FOR: Final = (Precondition.OBJECT_LISTED, Precondition.HAND_FREE)
_DOOR: Final = (*_HAND_FREE_FOR, Precondition.OPENABLE, *_AT_HAND)
_SWITCH: Final = (*_HAND_FREE_FOR, Precondition.TOGGLEABLE, *_AT_HAND)
_BOTH_LISTED: Final = (Precondition.OBJECT_LISTED, Precondition.SOURCE_LISTED)
_SOURCE_AT_HAND: Final = (
    Precondition.SOURCE_IN_REACH,
    Precondition.SOURCE_APPROACHABLE,
    Precondition.AT_SOURCE,
    Precondition.SOURCE_ON,
    Precondition.SOURCE_CLOSED,
)

LIBRARY: Final[Mapping[Skill, SkillDefinition]] = {
    Skill.MOVE: SkillDefinition(
        "the robot stands beside the object and faces it",
        (Precondition.OBJECT_LISTED, Precondition.NOT_CARRIED),
        (FailureReason.NO_STANDING_POSE, FailureReason.NO_PATH),
    ),
    Skill.TURN: SkillDefinition("the heading grows by the angle", ()),
    Skill.PICK_UP: SkillDefinition(
        "the hand holds the object, and its relations end",
        (
            *_HAND_FREE_FOR,
            Precondition.PORTABLE,
            Precondition.LIGHT_ENOUGH,
            Precondition.SMALL_ENOUGH,
            *_AT_HAND,
            Precondition.BEARS_NOTHING,
        ),
        (FailureReason.ARM_BLOCKED,),
    ),
    Skill.PLACE: SkillDefinition(
        "the held object is in the relation to the object, and the hand is empty",
        (
            Precondition.OBJECT_LISTED,
            Precondition.HAND_HOLDS,
            Precondition.NOT_ITSELF,
            *_AT_HAND,
            Precondition.HAS_CAVITY,
            Precondition.OPENED_FOR,
        ),
        (*NO_PLACE, FailureReason.NO_SURFACE, FailureReason.NO_CAVITY),
    ),
    Skill.MOVE_FORWARD: SkillDefinition(
        "the heading grows by the angle, and the robot stands further along it",
        (Precondition.STEP_SHORT,),
        (FailureReason.BLOCKED,),
    ),
    Skill.OPEN: SkillDefinition(
        "the object is open",
        (*_DOOR, Precondition.IS_CLOSED, Precondition.NOT_RUNNING),
        (FailureReason.DOOR_BLOCKED, FailureReason.ARM_BLOCKED),
    ),
    Skill.CLOSE: SkillDefinition(
        "the object is closed",
        (*_DOOR, Precondition.IS_OPEN),
        (FailureReason.DOOR_BLOCKED, FailureReason.ARM_BLOCKED),
    ),
    Skill.TOGGLE_ON: SkillDefinition(
        "the object is on",
        (*_SWITCH, Precondition.IS_OFF, Precondition.CLOSED_TO_START),
        (FailureReason.ARM_BLOCKED,),
    ),
    Skill.TOGGLE_OFF: SkillDefinition(
        "the object is off",
        (*_SWITCH, Precondition.IS_ON),
        (FailureReason.ARM_BLOCKED,),
    ),
    Skill.HEAT: SkillDefinition(
        "the object is hot, and no longer frozen",
        (
            *_BOTH_LISTED,
            Precondition.SOURCE_HEATS,
            Precondition.HEATABLE,
            *_SOURCE_AT_HAND,
            Precondition.HOT_ENOUGH,
        ),
    ),
    Skill.COOK: SkillDefinition(
        "the food is cooked and hot",
        (
            *_BOTH_LISTED,
            Precondition.SOURCE_HEATS,
            Precondition.COOKABLE,
            *_SOURCE_AT_HAND,
            Precondition.COOKS,
        ),
    ),
    Skill.FREEZE: SkillDefinition(
        "the object is frozen, and no longer hot",
        (
            *_BOTH_LISTED,
            Precondition.SOURCE_COOLS,
            Precondition.FREEZABLE,
            *_SOURCE_AT_HAND,
            Precondition.COLD_ENOUGH,
        ),
    ),
    Skill.GO_TO_ROOM: SkillDefinition(
        "the robot stands in the room",
        (Precondition.ROOM_KNOWN,),
        (FailureReason.NO_PATH,),
    ),
    Skill.SLICE: SkillDefinition(
        "the object is sliced; if it has pieces, they replace it",
        (
            *_BOTH_LISTED,
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
    Skill.CLEAN: SkillDefinition(
        "the substances that the tool removes are off the object",
        (
            *_BOTH_LISTED,
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
    Skill.SOAK: SkillDefinition(
        "a cloth is soaked with the liquid of the source; a vessel is filled with it",
        (
            *_BOTH_LISTED,
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
