"""Plan language: skills, arguments, profiles and calls."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from embomatrix.world.task import Profile

MAX_STEPS: Final = 64
MAX_PLAN_BYTES: Final = 64 * 1024
"""Plans with more steps and texts with more bytes are not parsable."""
MAX_ROOM_NAME: Final = 64
"""Longest room name, in characters."""


class Skill(StrEnum):
    """The 13 skills of the paper under its names, and three more for goals that those can't reach."""

    MOVE = "move"
    TURN = "turn"
    PICK_UP = "pick_up"
    PLACE = "place"
    MOVE_FORWARD = "move_forward"
    OPEN = "open"
    CLOSE = "close"
    TOGGLE_ON = "toggle_on"
    TOGGLE_OFF = "toggle_off"
    HEAT = "heat_object_with_source"
    COOK = "cook_object_with_tool"
    FREEZE = "froze_object_with_source"
    GO_TO_ROOM = "go_to_room"
    SLICE = "slice_object_with_tool"
    CLEAN = "clean_object_with_tool"
    SOAK = "soak_object_in_source"


class Arg(StrEnum):
    """Argument names of a call in JSON. ``source_index`` is the second object of a call: a source or a tool."""

    OBJECT = "object_index"
    SOURCE = "source_index"
    RELATION = "relation"
    YAW = "yaw"
    DISTANCE = "distance"
    ROOM = "room_name"


class PlaceRelation(StrEnum):
    """Relations that ``place`` accepts."""

    ONTOP = "ontop"
    INSIDE = "inside"
    UNDER = "under"
    NEXTTO = "nextto"


SIGNATURES: Final[Mapping[Skill, tuple[Arg, ...]]] = {
    Skill.MOVE: (Arg.OBJECT,),
    Skill.TURN: (Arg.YAW,),
    Skill.PICK_UP: (Arg.OBJECT,),
    Skill.PLACE: (Arg.OBJECT, Arg.RELATION),
    Skill.MOVE_FORWARD: (Arg.DISTANCE, Arg.YAW),
    Skill.OPEN: (Arg.OBJECT,),
    Skill.CLOSE: (Arg.OBJECT,),
    Skill.TOGGLE_ON: (Arg.OBJECT,),
    Skill.TOGGLE_OFF: (Arg.OBJECT,),
    Skill.HEAT: (Arg.OBJECT, Arg.SOURCE),
    Skill.COOK: (Arg.OBJECT, Arg.SOURCE),
    Skill.FREEZE: (Arg.OBJECT, Arg.SOURCE),
    Skill.GO_TO_ROOM: (Arg.ROOM,),
    Skill.SLICE: (Arg.OBJECT, Arg.SOURCE),
    Skill.CLEAN: (Arg.OBJECT, Arg.SOURCE),
    Skill.SOAK: (Arg.OBJECT, Arg.SOURCE),
}

_ADDED: Final = (Skill.SLICE, Skill.CLEAN, Skill.SOAK)
PROFILES: Final[Mapping[Profile, tuple[Skill, ...]]] = {
    Profile.PAPER: tuple(skill for skill in Skill if skill not in _ADDED),
    Profile.HOUSEHOLD: tuple(Skill),
}
"""Skills of each profile, in the order in which a prompt lists them."""
ALIASES: Final[Mapping[str, Arg]] = {"tool_index": Arg.SOURCE}
"""Alternative argument names that the JSON form accepts."""


@dataclass(frozen=True, slots=True)
class SkillCall:
    """One step of a plan. Arguments that the skill does not take are None. Yaw is in radians, distance in metres."""

    skill: Skill
    object_index: int | None = None
    source_index: int | None = None
    relation: PlaceRelation | None = None
    yaw: float | None = None
    distance: float | None = None
    room_name: str | None = None


Plan = tuple[SkillCall, ...]
